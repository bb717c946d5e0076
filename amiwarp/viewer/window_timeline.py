"""Timeline of the window: rates of ON and OFF events, and the time window, which the mouse moves and resizes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.plotting.colours import ticks
from amiwarp.viewer.axes import tick_texts
from amiwarp.viewer.drawing import ORBIT_COLOUR
from amiwarp.viewer.filters import unit_of
from amiwarp.viewer.texts import text_width
from amiwarp.viewer.window_layout import NOWHERE, Rect
from amiwarp.viewer.window_paper import Paper

GRIP_PX = 7.0
"""Distance within which the mouse takes an end of the time window [px]."""
ZOOM = 1.25
"""Factor of the shown time for one step of the wheel."""
LEAST_US = 10.0
"""Shortest time on the timeline [us]."""
SECONDS_US = 2_000_000.0
"""Shown time from which its numbers are in seconds [us]."""
NUMBERS_EM = 6.0
"""Width of the numbers left of the rates, in sizes of the font."""


class Timeline:
    """Timeline. All times count from the recording's first event [us]."""

    def __init__(self, move: Callable[[int], None], resize: Callable[[int, int], None]) -> None:
        """``move``: sets the start of the time window; ``resize``: sets its start and its end."""
        self._move, self._resize = move, resize
        self.span = 0.0, 1.0
        """Start and end of the shown time [us]."""
        self.whole_us = 1
        self.window = 0, 1
        """Start and length of the time window [us]."""
        self.rates: NDArray[np.float64] = np.zeros((2, 0))
        self.edges: NDArray[np.float64] = np.zeros(0)
        self.note = ""
        self.rect = NOWHERE
        self._inner = NOWHERE
        self._dragged = ""
        self._from = 0.0  # time at which the mouse pressed, and what it moves, then
        self._held: tuple[float, float] = (0.0, 0.0)

    def time_at(self, x: float) -> float:
        """Return the time at a column of the window [us]."""
        low, high = self.span
        return low + (x - self._inner.left) / self._inner.width * (high - low)

    def column_of(self, time_us: float) -> float:
        """Return the column of the window at which a time is."""
        low, high = self.span
        return self._inner.left + (time_us - low) / (high - low) * self._inner.width

    def show_all(self) -> None:
        """Show the whole recording."""
        self.span = 0.0, float(self.whole_us)

    def follow(self) -> None:
        """Move what is shown to the time window if that has left it."""
        start, length = self.window
        low, high = self.span
        if high - low < self.whole_us and not low <= start + 0.5 * length <= high:
            self._show(start + 0.5 * length - 0.5 * (high - low), high - low)

    def press(self, place: tuple[int, int], *, shift: bool) -> bool:
        """Take the mouse if it is on the timeline."""
        if not self.rect.holds(place):
            return False
        start, length = self.window
        self._from, self._held = self.time_at(place[0]), (float(start), float(start + length))
        first, last = self.column_of(start), self.column_of(start + length)
        near = [abs(place[0] - each) < GRIP_PX for each in (first, last)]
        if shift:
            self._dragged, self._held = "time", self.span
        elif any(near) and last - first > 3.0 * GRIP_PX:
            self._dragged = "start" if near[0] else "end"
        else:
            self._dragged = "window"
            if not first - GRIP_PX <= place[0] <= last + GRIP_PX:  # a click moves its middle there
                self._held = self._from - 0.5 * length, self._from + 0.5 * length
                self._move(round(self._held[0]))
        return True

    def drag(self, place: tuple[int, int]) -> None:
        """Follow the mouse."""
        low, high = self._held
        if self._dragged == "time":
            self._show(self.span[0] + self._from - self.time_at(place[0]), high - low)
            return
        moved = self.time_at(place[0]) - self._from
        if self._dragged == "window":
            self._move(round(low + moved))
        elif self._dragged == "start":
            self._resize(round(min(max(low + moved, 0.0), high - 1.0)), round(high))
        elif self._dragged == "end":
            self._resize(round(low), round(max(min(high + moved, self.whole_us), low + 1.0)))

    def release(self) -> None:
        """Leave the time window."""
        self._dragged = ""

    def wheel(self, place: tuple[int, int], steps: int) -> bool:
        """Zoom about the mouse; return whether it is on the timeline."""
        if not self.rect.holds(place):
            return False
        (low, high), at = self.span, self.time_at(place[0])
        length = min(max((high - low) * ZOOM**-steps, LEAST_US), float(self.whole_us))
        self._show(at - (at - low) * length / (high - low), length)
        return True

    def _show(self, start: float, length: float) -> None:
        start = max(0.0, min(start, self.whole_us - length))
        self.span = start, start + length

    def draw(self, paper: Paper, rect: Rect) -> None:
        """Draw the timeline into a part of the window."""
        em = paper.font_px
        self.rect = rect
        self._inner = inner = rect.inset(NUMBERS_EM * em, 1.7 * em, 1.5 * em, 0.5 * em)
        start, length = self.window
        first, last = (min(max(self.column_of(t), inner.left), inner.right) for t in (start, start + length))
        if self.span[0] < start + length and start < self.span[1]:
            paper.area(Rect(first, inner.low, max(last, first + 2.0), inner.top), ORBIT_COLOUR, 0.25)
        for time in (start, start + length):
            if self.span[0] <= time <= self.span[1]:
                at = self.column_of(time)
                paper.line([(at, inner.low), (at, inner.top)], ORBIT_COLOUR, 2.0)
        known = self.rates[np.isfinite(self.rates)]
        top = float(known.max()) if len(known) else 0.0
        for rates, colour in zip(self.rates, (OFF_COLOUR, ON_COLOUR), strict=True):
            columns = (
                inner.left
                + (np.repeat(self.edges, 2)[1:-1] - self.span[0]) / (self.span[1] - self.span[0]) * inner.width
            )
            heights = inner.low + np.repeat(rates, 2) / (top or 1.0) * 0.95 * inner.height
            paper.line(np.column_stack([columns, heights]), colour, 1.5)
        paper.line([(inner.left, inner.top), (inner.left, inner.low), (inner.right, inner.low)])
        for text, at, side in (
            (_short(top), inner.top, "top"),
            ("events/s", inner.low + 0.5 * inner.height, "middle"),
            ("0", inner.low, "bottom"),
        ):
            paper.text(text, inner.left - 0.5 * em, at, across="right", up=side)
        self._draw_times(paper, inner)
        if self.note:
            paper.text(self.note, inner.right, inner.top, across="right", up="top")

    def _draw_times(self, paper: Paper, inner: Rect) -> None:
        em, (low, high) = paper.font_px, self.span
        unit, scale = ("s", 1e-6) if high - low >= SECONDS_US else ("ms", 1e-3)
        values = ticks(low * scale, high * scale, int(min(max(inner.width / (8.0 * em), 2), 12)))
        texts = tick_texts(values.tolist())
        for k, (text, value) in enumerate(zip(texts, values, strict=True)):
            at = self.column_of(value / scale)
            paper.line([(at, inner.low), (at, inner.low - 0.3 * em)])
            text = f"{text} {unit}" if k == len(texts) - 1 else text
            at = min(at, inner.right - 0.5 * text_width(text, em) + em)
            paper.text(text, at, inner.low - 0.4 * em, across="center", up="top")


def _short(rate: float) -> str:
    """Return a rate [1/s] with three digits, in thousands or millions."""
    if not (rate and math.isfinite(rate)):
        return ""
    size, prefix = unit_of(rate)
    return f"{rate / size:.3g} {prefix}".rstrip()
