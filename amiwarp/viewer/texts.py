"""Texts that VTK draws: the one font of pictures and window, and how wide a text is."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

FONT_PX = 12
"""Size of the font in a picture [px]. A window sets its own."""
SMALLEST_PX = 6
"""Smallest size of the font [px]."""
VTK_FONT_FILE = 4
"""VTK's number for a font that comes from a file."""
LINE = 1.35
"""Distance between two lines, as a multiple of the font's size."""


@cache
def font() -> Path:
    """Return a font with Greek letters, which VTK's own font lacks."""
    from matplotlib import get_data_path

    return Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"


@cache
def _letter_width(letter: str, font_px: int) -> float:
    """Return the width of a letter [px], which FreeType rounds to whole pixels, as VTK draws it."""
    from matplotlib.ft2font import FT2Font, LoadFlags

    face = FT2Font(str(font()))
    face.set_size(font_px, 72.0)
    return float(face.load_char(ord(letter), flags=LoadFlags.DEFAULT).horiAdvance) / 64.0


def text_width(text: str, font_px: int) -> float:
    """Return the width of a line of text [px]."""
    return sum(_letter_width(letter, font_px) for letter in text)


def fitting_font(text: str, width_px: float, font_px: int) -> int:
    """Return the largest size of the font up to a given one with which a line of text is at most so wide [px]."""
    for size in range(font_px, SMALLEST_PX, -1):
        if text_width(text, size) <= width_px:
            return size
    return SMALLEST_PX


def wrapped(text: str, width_px: float, font_px: int) -> list[str]:
    """Return a text in lines that are at most so wide [px]; a longer word has a line of its own."""
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            longer = f"{line} {word}" if line else word
            if line and text_width(longer, font_px) > width_px:
                lines.append(line)
                longer = word
            line = longer
        lines.append(line)
    return lines


def _text_property(colour: str, font_px: int, across: str, up: str) -> Any:
    """Return how a text is drawn: in the viewer's font, with the given sides at its place."""
    import pyvista

    return pyvista.TextProperty(
        color=colour,
        font_size=font_px,
        font_file=str(font()),
        justification_horizontal=across,
        justification_vertical=up,
    )


def text_actor(text: str, colour: str, place: tuple[float, float], font_px: int = FONT_PX) -> Any:
    """Return an actor that shows a text below and to the right of a place, in shares of its renderer's size."""
    import pyvista

    actor = pyvista.Text(text)
    actor.prop = _text_property(colour, font_px, "left", "top")
    actor.GetPositionCoordinate().SetCoordinateSystemToNormalizedViewport()
    actor.position = place
    return actor


def on_paper(actor: Any, colour: str) -> None:
    """Give a text a background, so that it can be read before events."""
    actor.prop.background_color = colour
    actor.prop.background_opacity = 1.0


def label_actor(colour: str, font_px: int, across: str = "center", up: str = "center") -> Any:
    """Return an empty text actor that is placed in pixels of its renderer.

    ``across``: which of its sides is at the place, "left", "center" or "right"; ``up``: "bottom", "center" or "top".
    """
    import pyvista

    actor = pyvista.Text("")
    actor.prop = _text_property(colour, font_px, across, up)
    actor.GetPositionCoordinate().SetCoordinateSystemToViewport()
    return actor
