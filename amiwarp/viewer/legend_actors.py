"""Legend of a picture as VTK actors: rows of a coloured mark and the meaning of the colour, or a scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from amiwarp.plotting.colours import Scale, table_of, ticks
from amiwarp.viewer.texts import FONT_PX, font, text_actor, text_width

CORNER = (0.05, 0.985)
"""Upper left corner of the legend in its strip, in shares of the strip's width and height from the lower left."""
BAR_BOTTOM = 0.3
"""Lower end of a scale, in shares of the height of the strip."""
MARK = "■"
"""Character that shows the colour of a row."""
MARGIN_EM = 4.0
LARGEST_STRIP = 0.35
"""Width of mark and margins in sizes of the font, and largest width of the strip as a fraction of the picture."""
TITLE_EM = 2.7
"""Height of the title of a scale, in sizes of the font."""


def strip_share(texts: Sequence[str], width: int, font_px: int = FONT_PX) -> float:
    """Return the fraction of a picture's ``width`` [px] that the texts of a legend need."""
    widest = max(text_width(text, font_px) for text in texts)
    return min((MARGIN_EM * font_px + widest) / width, LARGEST_STRIP)


def bar_actors(bar: Scale, ink: str, height: int, font_px: int = FONT_PX) -> list[Any]:
    """Return the actors of a vertical scale. ``ink``: colour of the text; ``height``: of the bar's renderer [px]."""
    import pyvista
    from vtkmodules.vtkRenderingAnnotation import vtkScalarBarActor

    stops = np.rint(255.0 * np.linspace(0.0, 1.0, 256) ** bar.gamma).astype(int)
    rgb = table_of(bar.colours)[stops]
    opaque = np.full(256, 255, np.uint8)
    table = pyvista.LookupTable(values=np.column_stack([rgb, opaque]))
    table.scalar_range = bar.low, bar.high
    numbers = ticks(bar.low, bar.high, whole=bar.counts)

    left, top = CORNER
    title_height = TITLE_EM * font_px / height
    actor = vtkScalarBarActor()
    actor.SetLookupTable(table)
    actor.SetMaximumNumberOfColors(256)
    actor.SetUseCustomLabels(True)
    actor.SetCustomLabels(pyvista.convert_array(numbers))
    actor.SetLabelFormat("%.4g")
    actor.UnconstrainedFontSizeOn()
    actor.SetPosition(left, BAR_BOTTOM)
    actor.SetWidth(0.5)
    actor.SetHeight(top - title_height - BAR_BOTTOM)
    labels = pyvista.TextProperty(color=ink, font_size=font_px, font_file=str(font()))
    actor.SetLabelTextProperty(labels)
    return [actor, text_actor(bar.label, ink, CORNER, font_px)]
