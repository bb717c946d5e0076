"""Charts of the window: sharpness over two parameters, displacement of a scene point, and intervals of pixels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.plotting.colours import ticks
from amiwarp.viewer.axes import tick_texts
from amiwarp.viewer.drawing import ORBIT_COLOUR
from amiwarp.viewer.texts import LINE, fitting_font, text_width
from amiwarp.viewer.window_layout import Rect
from amiwarp.viewer.window_paper import GAP, Paper

MARKS = ((ORBIT_COLOUR, 4.0, "truth"), (ON_COLOUR, 2.0, "now"))
"""Colour, width and name of the lines that mark values on a sharpness curve."""
ORBIT_CURVES = ((ON_COLOUR, 2.0, "in x"), (OFF_COLOUR, 2.0, "in y"))
"""Colour, width and name of the curves of a scene point's displacement."""
INTERVAL_CURVES = ((OFF_COLOUR, 2.0, "intervals"), (ON_COLOUR, 2.0, "median"))
"""Colour, width and name of the histogram of intervals, and of the line at their median."""
LEGEND_EM, MARK_EM = 1.5, 1.2
"""Height of the legend above the curves, and length of the line before a name, in sizes of the font."""
MARK_TEXT = 3 * "m"
"""Text that is wider than the line before a name, and the gap behind it."""
NUMBERS_EM = 3.6
"""Width of the numbers left of a chart, in sizes of the font."""
FULL_TURN = 360.0
"""Range of prism angles, whose numbers are divisors of a turn [deg]."""
ROOM = 0.06
"""Space above and below the curves, as a share of their height."""


@dataclass
class Curve:
    """A line of a chart."""

    colour: str
    """Colour; empty for that of the texts."""
    width: float
    label: str
    x: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    y: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def update(self, x: Any, y: Any) -> None:
        """Set the points."""
        self.x, self.y = np.asarray(x, np.float64), np.asarray(y, np.float64)


class Chart:
    """Curves with numbers at both axes, a title that names the axes, and a legend."""

    def __init__(self, title: str, curves: tuple[tuple[str, float, str], ...]) -> None:
        """``title``: what the chart shows over what, with units; ``curves``: colours, widths and names."""
        self.title = title
        self.curves = [Curve(*each) for each in curves]
        self.x_range, self.y_range = (0.0, 1.0), (0.0, 1.0)

    def fit(self, x_range: tuple[float, float], values: NDArray[np.float64], *, least: float = 1e-6) -> None:
        """Set the ranges to that of x, and so that values are inside. ``least``: smallest range of the values."""
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        room = ROOM * max(high - low, least)
        self.x_range, self.y_range = x_range, (low - room, max(high, low + least) + room)

    def plot_area(self, rect: Rect, font_px: int) -> Rect:
        """Return the part of the chart's place in which the curves are."""
        line = LINE * font_px
        return rect.inset(NUMBERS_EM * font_px, 1.2 * line, 1.3 * font_px, line + LEGEND_EM * font_px)

    def draw(self, paper: Paper, rect: Rect) -> None:
        """Draw the chart into a part of the window."""
        em, inner = paper.font_px, self.plot_area(rect, paper.font_px)
        (x_low, x_high), (y_low, y_high) = self.x_range, self.y_range
        size = fitting_font(self.title, rect.width - em, em)
        paper.text(self.title, rect.left + 0.5 * em, rect.top, up="top", font_px=size)
        self._draw_legend(paper, inner)
        marks = [(inner.left, inner.top), (inner.left, inner.low), (inner.right, inner.low), GAP]
        if not any(len(curve.x) for curve in self.curves):  # nothing is computed yet
            return
        least = 4 if x_high == FULL_TURN else 3
        values = ticks(x_low, x_high, int(min(max(inner.width / (5.0 * em), least), 5)))
        for text, value in zip(tick_texts(values.tolist()), values, strict=True):
            at = inner.left + (value - x_low) / (x_high - x_low) * inner.width
            marks += [(at, inner.low), (at, inner.low - 0.3 * em), GAP]
            paper.text(text, at, inner.low - 0.4 * em, across="center", up="top")
        values = ticks(y_low, y_high, int(min(max(inner.height / (2.0 * em), 3), 5)))
        for text, value in zip(tick_texts(values.tolist()), values, strict=True):
            at = inner.low + (value - y_low) / (y_high - y_low) * inner.height
            marks += [(inner.left, at), (inner.left - 0.3 * em, at), GAP]
            paper.text(text, inner.left - 0.5 * em, at, across="right")
        paper.line(marks)
        for curve in self.curves:
            if len(curve.x):
                across = inner.left + (curve.x - x_low) / (x_high - x_low) * inner.width
                up = inner.low + (curve.y - y_low) / (y_high - y_low) * inner.height
                paper.line(np.column_stack([across, np.clip(up, inner.low, inner.top)]), curve.colour, curve.width)

    def _draw_legend(self, paper: Paper, inner: Rect) -> None:
        """Name the curves above them, in smaller letters if there is little room."""
        shown = [curve for curve in self.curves if len(curve.x)]
        marks = "".join([MARK_TEXT + curve.label for curve in shown])
        em = fitting_font(marks, inner.width, paper.font_px)
        x, middle = inner.left, inner.top + 0.5 * LEGEND_EM * paper.font_px
        for curve in shown:
            paper.line([(x, middle), (x + MARK_EM * em, middle)], curve.colour, curve.width)
            paper.text(curve.label, x + (MARK_EM + 0.4) * em, middle, font_px=em)
            x += (MARK_EM + 1.6) * em + text_width(curve.label, em)


def chart_places(rect: Rect) -> tuple[Rect, Rect, Rect]:
    """Return the places of the two sharpness curves, one above the other, and of the displacement right of them."""
    middle, half = 0.5 * (rect.left + rect.right), 0.5 * (rect.low + rect.top)
    return (
        Rect(rect.left, half, middle, rect.top),
        Rect(rect.left, rect.low, middle, half),
        Rect(middle, rect.low, rect.right, rect.top),
    )
