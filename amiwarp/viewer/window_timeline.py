"""Timeline of the window: rates of ON and OFF events, and the time window, which the mouse moves and resizes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.plotting.colours import ticks
from amiwarp.viewer.axes import tick_texts
from amiwarp.viewer.filters import unit_of
from amiwarp.viewer.look import ORBIT_COLOUR
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
        self._move = move
        self._resize = resize
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
        # Time at which the mouse was pressed, and the ends of what it moves, as they were then.
        self._from = 0.0
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
        x, _ = place
        start, length = self.window
        self._from = self.time_at(x)
        if shift:
            self._dragged = "time"
            self._held = self.span
            return True

        self._held = (float(start), float(start + length))
        first = self.column_of(start)
        last = self.column_of(start + length)
        near_start = abs(x - first) < GRIP_PX
        near_end = abs(x - last) < GRIP_PX
        has_room_between = last - first > 3.0 * GRIP_PX
        if near_start and has_room_between:
            self._dragged = "start"
        elif near_end and has_room_between:
            self._dragged = "end"
        else:
            self._dragged = "window"
            is_on_window = first - GRIP_PX <= x <= last + GRIP_PX
            if not is_on_window:  # a click moves its middle there
                self._held = (self._from - 0.5 * length, self._from + 0.5 * length)
                self._move(round(self._held[0]))
        return True

    def drag(self, place: tuple[int, int]) -> None:
        """Follow the mouse."""
        low, high = self._held
        time = self.time_at(place[0])
        if self._dragged == "time":
            self._show(self.span[0] + self._from - time, high - low)
            return
        moved = time - self._from
        if self._dragged == "window":
            self._move(round(low + moved))
        elif self._dragged == "start":
            start = min(max(low + moved, 0.0), high - 1.0)
            self._resize(round(start), round(high))
        elif self._dragged == "end":
            end = max(min(high + moved, self.whole_us), low + 1.0)
            self._resize(round(low), round(end))

    def release(self) -> None:
        """Leave the time window."""
        self._dragged = ""

    def wheel(self, place: tuple[int, int], steps: int) -> bool:
        """Zoom about the mouse; return whether it is on the timeline."""
        if not self.rect.holds(place):
            return False
        low, high = self.span
        time = self.time_at(place[0])
        length = min(max((high - low) * ZOOM**-steps, LEAST_US), float(self.whole_us))
        # The time under the mouse stays there.
        self._show(time - (time - low) * length / (high - low), length)
        return True

    def _show(self, start: float, length: float) -> None:
        start = max(0.0, min(start, self.whole_us - length))
        self.span = start, start + length

    def draw(self, paper: Paper, rect: Rect) -> None:
        """Draw the timeline into a part of the window."""
        em = paper.font_px
        inner = rect.inset(NUMBERS_EM * em, 1.7 * em, 1.5 * em, 0.5 * em)
        self.rect = rect
        self._inner = inner
        self._draw_window(paper, inner)
        known = self.rates[np.isfinite(self.rates)]
        most = float(known.max()) if len(known) else 0.0
        self._draw_rates(paper, inner, most)

        paper.line([(inner.left, inner.top), (inner.left, inner.low), (inner.right, inner.low)])
        middle = inner.low + 0.5 * inner.height
        right = inner.left - 0.5 * em
        paper.text(_short(most), right, inner.top, across="right", up="top")
        paper.text("events/s", right, middle, across="right", up="middle")
        paper.text("0", right, inner.low, across="right", up="bottom")
        self._draw_times(paper, inner)
        if self.note:
            paper.text(self.note, inner.right, inner.top, across="right", up="top")

    def _draw_window(self, paper: Paper, inner: Rect) -> None:
        """Draw the time window, and its ends where they are shown."""
        low, high = self.span
        start, length = self.window
        stop = start + length
        if low < stop and start < high:
            first = min(max(self.column_of(start), inner.left), inner.right)
            last = min(max(self.column_of(stop), inner.left), inner.right)
            area = Rect(first, inner.low, max(last, first + 2.0), inner.top)
            paper.area(area, ORBIT_COLOUR, 0.25)
        for time in (start, stop):
            if low <= time <= high:
                column = self.column_of(time)
                paper.line([(column, inner.low), (column, inner.top)], ORBIT_COLOUR, 2.0)

    def _draw_rates(self, paper: Paper, inner: Rect, most: float) -> None:
        """Draw the rates as stairs. ``most``: the highest of them [1/s]."""
        low, high = self.span
        times = np.repeat(self.edges, 2)[1:-1]
        columns = inner.left + (times - low) / (high - low) * inner.width
        for rates, colour in zip(self.rates, (OFF_COLOUR, ON_COLOUR), strict=True):
            rows = inner.low + np.repeat(rates, 2) / (most or 1.0) * 0.95 * inner.height
            paper.line(np.column_stack([columns, rows]), colour, 1.5)

    def _draw_times(self, paper: Paper, inner: Rect) -> None:
        """Draw the numbers of the time axis; the last one has the unit."""
        em = paper.font_px
        low, high = self.span
        unit, scale = ("s", 1e-6) if high - low >= SECONDS_US else ("ms", 1e-3)
        most = int(min(max(inner.width / (8.0 * em), 2), 12))
        values = ticks(low * scale, high * scale, most)
        texts = tick_texts(values.tolist())
        if texts:
            texts[-1] = f"{texts[-1]} {unit}"
        for text, value in zip(texts, values, strict=True):
            column = self.column_of(value / scale)
            paper.line([(column, inner.low), (column, inner.low - 0.3 * em)])
            middle = min(column, inner.right - 0.5 * text_width(text, em) + em)
            paper.text(text, middle, inner.low - 0.4 * em, across="center", up="top")


def _short(rate: float) -> str:
    """Return a rate [1/s] with three digits, in thousands or millions."""
    if not (rate and math.isfinite(rate)):
        return ""
    size, prefix = unit_of(rate)
    return f"{rate / size:.3g} {prefix}".rstrip()
