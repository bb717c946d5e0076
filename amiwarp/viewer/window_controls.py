"""Column of the window: texts, and sliders that the mouse drags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from amiwarp.viewer.drawing import ORBIT_COLOUR
from amiwarp.viewer.texts import LINE, fitting_font, wrapped
from amiwarp.viewer.window_layout import NOWHERE, SLIDER_EM, Rect
from amiwarp.viewer.window_paper import OVER, Paper

HANDLE_EM = (0.8, 1.2)
"""Width and height of a slider's handle, in sizes of the font."""


@dataclass
class Slider:
    """A value between two ends, which the mouse drags."""

    name: str
    value: float
    least: float
    most: float
    step: float
    title: str
    """Text above the slider: name, value, unit, and where the value comes from."""
    track: Rect = NOWHERE
    """Where its line is."""
    place: Rect = NOWHERE
    """Where the mouse takes it."""

    def column(self) -> float:
        """Return the column of the window in which the handle is."""
        share = (self.value - self.least) / max(self.most - self.least, 1e-12)
        return self.track.left + min(max(share, 0.0), 1.0) * self.track.width

    def value_at(self, x: float) -> float:
        """Return the value at a column of the window, in whole steps."""
        share = min(max((x - self.track.left) / self.track.width, 0.0), 1.0)
        value = self.least + share * (self.most - self.least)
        return min(max(round(value / self.step) * self.step, self.least), self.most)


class Controls:
    """Texts at the top of the column, and sliders at its bottom."""

    def __init__(self, slide: Callable[[str, float], None]) -> None:
        """``slide``: sets the value of a slider, by its name."""
        self._slide = slide
        self.sliders: dict[str, Slider] = {}
        self.chosen = ""
        """Name of the slider that the arrow keys move."""
        self.texts: list[str] = []
        """Paragraphs; an empty one is a gap."""
        self.lines: list[str] = []
        """The lines as they are written."""
        self.rows: list[str] = []
        """Rows above the sliders: figures of a live stream."""
        self._dragged: Slider | None = None
        self._offset = 0.0  # of the mouse from the handle

    def set(self, sliders: list[Slider], chosen: str) -> None:
        """Show sliders. One that is dragged stays the same object."""
        known = self.sliders
        self.sliders = {}
        for new in sliders:
            slider = known.get(new.name, new)
            slider.value, slider.least, slider.most = new.value, new.least, new.most
            slider.step, slider.title = new.step, new.title
            self.sliders[new.name] = slider
        self.chosen = chosen

    def press(self, place: tuple[int, int]) -> bool:
        """Take the slider under the mouse. Its handle jumps to the mouse unless the mouse is on it."""
        self._dragged = next((slider for slider in self.sliders.values() if slider.place.holds(place)), None)
        if self._dragged is None:
            return False
        self._offset = place[0] - self._dragged.column()
        if abs(self._offset) > 0.5 * self._dragged.place.height:
            self._offset = 0.0
            self.drag(place)
        return True

    def drag(self, place: tuple[int, int]) -> None:
        """Follow the mouse."""
        if self._dragged is not None:
            self._slide(self._dragged.name, self._dragged.value_at(place[0] - self._offset))

    def release(self) -> None:
        """Leave the slider."""
        self._dragged = None

    def wheel(self, place: tuple[int, int], steps: int) -> bool:
        """Move the slider under the mouse by steps; return whether there is one."""
        for slider in self.sliders.values():
            if slider.place.holds(place):
                value = slider.value + steps * slider.step
                self._slide(slider.name, min(max(value, slider.least), slider.most))
                return True
        return False

    def draw(self, paper: Paper, rect: Rect) -> None:
        """Draw the column."""
        em, line = paper.font_px, LINE * paper.font_px
        inner = rect.inset(em, em, em, em)
        top = inner.low + SLIDER_EM * em * len(self.sliders)
        for k, slider in enumerate(self.sliders.values()):
            self._draw_slider(paper, slider, inner, top - k * SLIDER_EM * em)
        rows = [part for row in self.rows for part in wrapped(row, inner.width, em)]
        for k, row in enumerate(rows):
            paper.text(row, inner.left, top + (len(rows) - k) * line, up="top")
        most = max(0, int((inner.top - top) / line) - len(rows))
        self.lines = [part for text in self.texts for part in wrapped(text, inner.width, em)]
        shown = self.lines if len(self.lines) <= most else [*self.lines[: most - 1], "…"]
        for k, words in enumerate(shown):
            paper.text(words, inner.left, inner.top - k * line, up="top")

    def _draw_slider(self, paper: Paper, slider: Slider, inner: Rect, top: float) -> None:
        em = paper.font_px
        wide, high = (share * em for share in HANDLE_EM)
        ink = ORBIT_COLOUR if slider.name == self.chosen else ""
        size = fitting_font(slider.title, inner.width, em)
        paper.text(slider.title, inner.left, top, colour=ink, up="top", font_px=size)
        middle = top - 2.3 * em
        slider.track = Rect(inner.left + 0.5 * wide, middle - 1, inner.right - 0.5 * wide, middle + 1)
        slider.place = Rect(inner.left - 0.5 * em, middle - high, inner.right + 0.5 * em, middle + high)
        paper.line([(slider.track.left, middle), (slider.track.right, middle)], ink, 2.0)
        x = slider.column()
        paper.area(Rect(x - 0.5 * wide, middle - 0.5 * high, x + 0.5 * wide, middle + 0.5 * high), ink, layer=OVER)
