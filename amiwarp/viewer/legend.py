"""Legend of the inspector's picture as VTK actors: rows of a coloured mark and the meaning of the colour."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amiwarp.viewer.truth_colours import Legend

CORNER = (0.05, 0.985)
"""Upper left corner of the legend in the strip of the picture that is reserved for the legend.

The coordinates are fractions of the width and height of the strip, from its lower left corner.
"""
FONT_SIZE, MARK = 12, "■"
"""Font size of the legend [px], and character that shows the colour of a row."""
LETTER_PX, MARGIN_PX, LARGEST_STRIP = 7.2, 48, 0.35
"""Width of a letter, width of mark and margins [px], and largest width of the strip as a fraction of the picture."""
ROW_PX, LEAST_ROWS, MOST_ROWS = 40, 3, 12
"""Height of the picture per row of the legend [px], and smallest and largest number of rows."""


def rows_in(height: int) -> int:
    """Return the largest number of coloured rows of a legend in a picture of a given height [px]."""
    return max(LEAST_ROWS, min(MOST_ROWS, height // ROW_PX))


def strip_share(legend: Legend, width: int) -> float:
    """Return the fraction of a picture's ``width`` [px] that a legend needs; 0 for an empty legend."""
    if not legend:
        return 0.0
    return min((MARGIN_PX + LETTER_PX * max(len(text) for _, text in legend)) / width, LARGEST_STRIP)


def legend_actors(legend: Legend, ink: str, font: Path) -> list[Any]:
    """Return the actors of a legend in the upper left corner of its strip; ``ink`` is the colour of the text."""
    actors = []
    for k, (colour, text) in enumerate(legend):
        # all rows start at one corner, after line breaks: their distance does not depend on the picture's size
        if colour:
            actors.append(_text("\n" * k + MARK, colour, font))
        actors.append(_text("\n" * k + ("     " if colour else "") + text, ink, font))
    return actors


def _text(text: str, colour: str, font: Path) -> Any:
    """Return an actor that shows a text at :data:`CORNER`."""
    import pyvista

    actor = pyvista.Text(text)
    actor.prop = pyvista.TextProperty(
        color=colour, font_size=FONT_SIZE, font_file=str(font), justification_horizontal="left",
        justification_vertical="top",
    )  # fmt: skip
    actor.GetPositionCoordinate().SetCoordinateSystemToNormalizedViewport()
    actor.position = CORNER
    return actor
