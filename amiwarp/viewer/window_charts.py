"""Charts of the window: sharpness over two parameters, displacement of a scene point, and intervals of pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.plotting.colours import ticks
from amiwarp.viewer.axes import tick_texts
from amiwarp.viewer.look import ORBIT_COLOUR
from amiwarp.viewer.texts import LINE, fitting_font, text_width
from amiwarp.viewer.window_layout import Rect
from amiwarp.viewer.window_paper import GAP, Paper

MARKS = ((ORBIT_COLOUR, 4.0, "truth"), (ON_COLOUR, 2.0, "now"))
"""Colour, width and name of the lines that mark values on a sharpness curve."""
ORBIT_CURVES = ((ON_COLOUR, 2.0, "in x"), (OFF_COLOUR, 2.0, "in y"))
"""Colour, width and name of the curves of a scene point's displacement."""
INTERVAL_CURVES = ((OFF_COLOUR, 2.0, "intervals"), (ON_COLOUR, 2.0, "median"))
"""Colour, width and name of the histogram of intervals, and of the line at their median."""
LEGEND_EM = 1.5
"""Height of the legend above the curves, in sizes of the font."""
MARK_EM = 1.2
"""Length of the line before a name in the legend, in sizes of the font."""
MARK_GAP_EM = 0.4
"""Gap between the line and the name, in sizes of the font."""
NAME_GAP_EM = 1.2
"""Gap between a name and the next line, in sizes of the font."""
MARK_TEXT = 3 * "m"
"""Text that is wider than the line before a name, and the gaps beside it."""
NUMBERS_EM = 3.6
"""Width of the numbers left of a chart, in sizes of the font."""
TITLE_LINES = 1.2
"""Height of the title above a chart, in lines of text."""
RIGHT_EM = 1.3
"""Space right of a chart, into which its last number may reach, in sizes of the font."""
TICK_EM = 0.3
"""Length of the tick at a number of an axis, in sizes of the font."""
FULL_TURN = 360.0
"""Upper end of an axis of prism angles [deg]; its numbers are at quarters of a turn."""
MARGIN_SHARE = 0.06
"""Space above and below the curves, as a share of their height."""


@dataclass
class Curve:
    """A line of a chart."""

    colour: str
    """Colour; empty for the texts' colour."""
    width: float
    label: str
    x: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    y: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def update(self, x: Any, y: Any) -> None:
        """Set the points."""
        self.x = np.asarray(x, np.float64)
        self.y = np.asarray(y, np.float64)


class Chart:
    """Curves with numbers at both axes, a title that names the axes, and a legend."""

    def __init__(self, title: str, curves: tuple[tuple[str, float, str], ...]) -> None:
        """``title``: what the chart shows over what, with units; ``curves``: colours, widths and names."""
        self.title = title
        self.curves = [Curve(*curve) for curve in curves]
        self.x_range = (0.0, 1.0)
        self.y_range = (0.0, 1.0)

    def fit(
        self, x_range: tuple[float, float], values: NDArray[np.float64], *, least: float = 1e-6
    ) -> None:
        """Set the range of x, and a range of y in which the values are. ``least``: smallest range of the values."""
        low = 0.0
        high = 1.0
        if len(values):
            low = float(values.min())
            high = float(values.max())
        margin = MARGIN_SHARE * max(high - low, least)
        self.x_range = x_range
        self.y_range = (low - margin, max(high, low + least) + margin)

    def plot_area(self, rect: Rect, font_px: int) -> Rect:
        """Return the part of the chart's place in which the curves are."""
        line = LINE * font_px
        return rect.inset(
            NUMBERS_EM * font_px, TITLE_LINES * line, RIGHT_EM * font_px, line + LEGEND_EM * font_px
        )

    def draw(self, paper: Paper, rect: Rect) -> None:
        """Draw the chart into a part of the window."""
        em = paper.font_px
        inner = self.plot_area(rect, em)
        size = fitting_font(self.title, rect.width - em, em)
        paper.text(self.title, rect.left + 0.5 * em, rect.top, up="top", font_px=size)
        self._draw_legend(paper, inner)
        if not any(len(curve.x) for curve in self.curves):  # nothing is computed yet
            return
        self._draw_axes(paper, inner)
        for curve in self.curves:
            if len(curve.x):
                columns = self._x_px(inner, curve.x)
                rows = np.clip(self._y_px(inner, curve.y), inner.low, inner.top)
                paper.line(np.column_stack([columns, rows]), curve.colour, curve.width)

    def _x_px(self, inner: Rect, x: Any) -> Any:
        """Return the columns of the window at which values of x are."""
        low, high = self.x_range
        return inner.left + (x - low) / (high - low) * inner.width

    def _y_px(self, inner: Rect, y: Any) -> Any:
        """Return the rows of the window, from its lower side, at which values of y are."""
        low, high = self.y_range
        return inner.low + (y - low) / (high - low) * inner.height

    def _draw_axes(self, paper: Paper, inner: Rect) -> None:
        """Draw the axes with their numbers, as one line with gaps."""
        em = paper.font_px
        line = [(inner.left, inner.top), (inner.left, inner.low), (inner.right, inner.low), GAP]

        _, high = self.x_range
        fewest = 4 if high == FULL_TURN else 3  # three numbers of a turn would be no quarters
        for text, value in _numbers(self.x_range, inner.width / (5.0 * em), fewest):
            column = self._x_px(inner, value)
            line += [(column, inner.low), (column, inner.low - TICK_EM * em), GAP]
            paper.text(text, column, inner.low - 0.4 * em, across="center", up="top")

        for text, value in _numbers(self.y_range, inner.height / (2.0 * em), 3):
            row = self._y_px(inner, value)
            line += [(inner.left, row), (inner.left - TICK_EM * em, row), GAP]
            paper.text(text, inner.left - 0.5 * em, row, across="right")
        paper.line(line)

    def _draw_legend(self, paper: Paper, inner: Rect) -> None:
        """Name the curves above them, in smaller letters if there is little room."""
        shown = [curve for curve in self.curves if len(curve.x)]
        marks = "".join([MARK_TEXT + curve.label for curve in shown])
        em = fitting_font(marks, inner.width, paper.font_px)
        x = inner.left
        middle = inner.top + 0.5 * LEGEND_EM * paper.font_px
        for curve in shown:
            paper.line([(x, middle), (x + MARK_EM * em, middle)], curve.colour, curve.width)
            paper.text(curve.label, x + (MARK_EM + MARK_GAP_EM) * em, middle, font_px=em)
            x += (MARK_EM + MARK_GAP_EM + NAME_GAP_EM) * em + text_width(curve.label, em)


def _numbers(ends: tuple[float, float], room: float, fewest: int) -> Iterator[tuple[str, float]]:
    """Yield the numbers of an axis as text and value. ``room``: how many fit; at most five are shown."""
    low, high = ends
    values = ticks(low, high, int(min(max(room, fewest), 5)))
    yield from zip(tick_texts(values.tolist()), values.tolist(), strict=True)


def chart_places(rect: Rect) -> tuple[Rect, Rect, Rect]:
    """Return the places of the two sharpness curves, one above the other, and of the displacement right of them."""
    middle = 0.5 * (rect.left + rect.right)
    half = 0.5 * (rect.low + rect.top)
    return (
        Rect(rect.left, half, middle, rect.top),
        Rect(rect.left, rect.low, middle, half),
        Rect(middle, rect.low, rect.right, rect.top),
    )
