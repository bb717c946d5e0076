"""Column of the window: texts, and sliders that the mouse drags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from amiwarp.viewer.look import ORBIT_COLOUR
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
            slider.value = new.value
            slider.least = new.least
            slider.most = new.most
            slider.step = new.step
            slider.title = new.title
            self.sliders[new.name] = slider
        self.chosen = chosen

    def press(self, place: tuple[int, int]) -> bool:
        """Take the slider under the mouse. Its handle jumps to the mouse unless the mouse is on it."""
        self._dragged = self._under(place)
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
        slider = self._under(place)
        if slider is None:
            return False
        value = slider.value + steps * slider.step
        self._slide(slider.name, min(max(value, slider.least), slider.most))
        return True

    def _under(self, place: tuple[int, int]) -> Slider | None:
        """Return the slider at a place of the window."""
        for slider in self.sliders.values():
            if slider.place.holds(place):
                return slider
        return None

    def draw(self, paper: Paper, rect: Rect) -> None:
        """Draw the column."""
        em = paper.font_px
        line = LINE * paper.font_px
        inner = rect.inset(em, em, em, em)

        # Sliders at the bottom, and rows above them
        top_of_sliders = inner.low + SLIDER_EM * em * len(self.sliders)
        for k, slider in enumerate(self.sliders.values()):
            self._draw_slider(paper, slider, inner, top_of_sliders - k * SLIDER_EM * em)
        rows = []
        for row in self.rows:
            rows += wrapped(row, inner.width, em)
        for k, row in enumerate(rows):
            paper.text(row, inner.left, top_of_sliders + (len(rows) - k) * line, up="top")

        # Texts at the top, cut off where they would meet the rows
        self.lines = []
        for text in self.texts:
            self.lines += wrapped(text, inner.width, em)
        most = max(0, int((inner.top - top_of_sliders) / line) - len(rows))
        shown = self.lines
        if len(shown) > most:
            shown = [*shown[: most - 1], "…"]
        for k, words in enumerate(shown):
            paper.text(words, inner.left, inner.top - k * line, up="top")

    def _draw_slider(self, paper: Paper, slider: Slider, inner: Rect, top: float) -> None:
        em = paper.font_px
        wide_em, high_em = HANDLE_EM
        wide = wide_em * em
        high = high_em * em
        ink = ORBIT_COLOUR if slider.name == self.chosen else ""
        size = fitting_font(slider.title, inner.width, em)
        paper.text(slider.title, inner.left, top, colour=ink, up="top", font_px=size)

        half_wide = 0.5 * wide
        half_high = 0.5 * high
        middle = top - 2.3 * em
        left = inner.left + half_wide
        right = inner.right - half_wide
        slider.track = Rect(left, middle - 1, right, middle + 1)
        paper.line([(left, middle), (right, middle)], ink, 2.0)

        # The mouse takes the slider around its line, too.
        around = 0.5 * em
        slider.place = Rect(inner.left - around, middle - high, inner.right + around, middle + high)

        x = slider.column()
        handle = Rect(x - half_wide, middle - half_high, x + half_wide, middle + half_high)
        paper.area(handle, ink, layer=OVER)
