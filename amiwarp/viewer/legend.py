"""VTK actors of a legend: rows with a mark in a colour and its meaning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amiwarp.viewer.truth_colours import Legend

CORNER = (0.05, 0.985)
"""Upper left corner of the legend, as shares of its strip's width and height from the lower left corner."""
FONT_SIZE, MARK = 12, "■"
"""Size of the text [px], and mark of a row."""
LETTER_PX, MARGIN_PX, LARGEST_STRIP = 7.2, 48, 0.35
"""Width of a letter and of everything else in the strip [px]; largest share of the strip in the picture."""
ROW_PX, LEAST_ROWS, MOST_ROWS = 40, 3, 12
"""Height of the picture for each colour [px], and limits of the number of colours."""


def rows_in(height: int) -> int:
    """Return how many colours a legend has at most in a picture of this height [px]."""
    return max(LEAST_ROWS, min(MOST_ROWS, height // ROW_PX))


def strip_share(legend: Legend, width: int) -> float:
    """Return the share of a picture's ``width`` [px] that the legend needs; 0 for an empty legend."""
    if not legend:
        return 0.0
    return min((MARGIN_PX + LETTER_PX * max(len(text) for _, text in legend)) / width, LARGEST_STRIP)


def legend_actors(legend: Legend, ink: str, font: Path) -> list[Any]:
    """Return the actors of a legend in the upper left corner of its strip; ``ink`` is the colour of the text."""
    actors = []
    for k, (colour, text) in enumerate(legend):
        # all texts begin at the same corner: the rows keep their distance when the size of the picture changes
        if colour:
            actors.append(_text("\n" * k + MARK, colour, font))
        actors.append(_text("\n" * k + ("     " if colour else "") + text, ink, font))
    return actors


def _text(text: str, colour: str, font: Path) -> Any:
    import pyvista

    actor = pyvista.Text(text)
    actor.prop = pyvista.TextProperty(
        color=colour, font_size=FONT_SIZE, font_file=str(font), justification_horizontal="left",
        justification_vertical="top",
    )  # fmt: skip
    actor.GetPositionCoordinate().SetCoordinateSystemToNormalizedViewport()
    actor.position = CORNER
    return actor
