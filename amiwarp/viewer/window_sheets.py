"""What the window shows beside the clouds: column, images, charts, timeline, statistics and help, on paper."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from amiwarp.imaging.palette import OFF_COLOUR
from amiwarp.imaging.regions import Region
from amiwarp.plotting.colours import GREY
from amiwarp.viewer import scene
from amiwarp.viewer.look import BACKGROUND_AND_INK
from amiwarp.viewer.sliders import SLIDERS
from amiwarp.viewer.texts import LINE, SMALLEST_PX, text_width
from amiwarp.viewer.window_charts import INTERVAL_CURVES, MARKS, ORBIT_CURVES, Chart, chart_places
from amiwarp.viewer.window_controls import Controls, Slider
from amiwarp.viewer.window_images import ImagePanel, ImageRow
from amiwarp.viewer.window_layout import Places, Rect
from amiwarp.viewer.window_paper import Paper
from amiwarp.viewer.window_timeline import Timeline

RENDERERS = 7
"""Number of renderers of the parts: column, strip, statistics, three of the depth map, and help."""
PANEL_COLOURS = {False: ("#f0f0ea", "#333333"), True: ("#24282e", "#d8d8d8")}
"""Colours of paper and ink of help and statistics, for light (False) and dark (True) mode."""
DEPTH_SHARES = (0.0, 0.16, 0.58, 1.0)
"""Edges between colour bar, image and points of a depth map, in shares of the width of the clouds."""
HELP_GAP_PX = 10
"""Gap between the help and the sides of the window [px]."""
KEY_NAMES = {
    "?": "h or ?",
    "ArrowRight": "→",
    "ArrowLeft": "←",
    " ": "space",
    "Up": "↑",
    "Down": "↓",
}
"""How the help writes keys, where it does not use their names."""


class Sheets:
    """Parts of the window beside the clouds. They are drawn anew when what they show has changed."""

    def __init__(self, renderers: list[Any], actions: Any) -> None:
        """``renderers``: the :data:`RENDERERS` of the parts; ``actions``: the window, whose methods input calls."""
        column, strip, side, *self.depth, help_ = renderers
        self.column = Paper(column)
        self.strip = Paper(strip)
        self.side = Paper(side)
        self.help = Paper(help_)
        self.controls = Controls(actions.slide)
        self.images = ImageRow(actions.draw_region, actions.sheets_changed)
        self.timeline = Timeline(actions.move_window, actions.resize_window)
        self.charts: dict[str, Chart] = {}
        """Charts by the name of the parameter, or "orbit" and "intervals"."""
        self.statistics: list[str] = []
        self.statistics_old = False
        """Whether the statistics are of the window or selection before; they are then grey."""
        self.help_rows: list[tuple[str, str]] = []
        """Keys, and what they do."""

    @property
    def flat(self) -> list[Any]:
        """The renderers that lie beside the clouds, not over them."""
        return [paper.renderer for paper in (self.column, self.strip, self.side)]

    # What the parts show

    def set_sliders(self, sliders: list[Slider], chosen: str) -> None:
        """Show sliders, of which the arrow keys move the chosen one."""
        self.controls.set(sliders, chosen)

    def set_charts(self, names: tuple[str, ...]) -> None:
        """Have charts of the sharpness over these parameters, and of a scene point's displacement; none for none."""
        known = self.charts
        self.charts = {}
        for name in names:
            label, unit, _ = SLIDERS[name]
            title = f"sharpness over {label}"
            if unit:
                title += f" [{unit}]"
            curves = (("", 2.0, "sharpness"), *MARKS)
            self.charts[name] = known.get(name) or Chart(title, curves)
        if names:
            title = "displacement [px] over θ [°]"
            self.charts["orbit"] = known.get("orbit") or Chart(title, ORBIT_CURVES)
        title = "share [%] over log10 of the interval [µs]"
        self.charts["intervals"] = known.get("intervals") or Chart(title, INTERVAL_CURVES)

    def show_orbit(self, theta_deg: Any, moved_px: Any) -> None:
        """Show how far a scene point is displaced over a turn. ``moved_px``: shape ``(n, 2)``."""
        chart = self.charts["orbit"]
        for k in range(2):
            chart.curves[k].update(theta_deg, moved_px[:, k])
        chart.fit((0.0, 360.0), moved_px, least=1e-3)

    def show_curve(
        self, name: str, x: Any, y: Any, known: tuple[float | None, float], *, old: bool
    ) -> None:
        """Show the sharpness over a parameter, with its true value, if it is known, and its current one.

        ``old``: whether it is of the window before; it is then grey.
        """
        chart = self.charts[name]
        chart.fit((float(x[0]), float(x[-1])), y)
        curve, *marks = chart.curves
        curve.update(x, y)
        curve.colour = GREY if old else ""
        curve.label = "former window" if old else "sharpness"
        for mark, value in zip(marks, known, strict=True):
            if value is not None and x[0] <= value <= x[-1]:
                mark.update([value, value], chart.y_range)
            else:
                mark.update([], [])

    def show_statistics(self, found: dict[str, Any]) -> None:
        """Show the statistics of the selected events, as the page does."""
        self.statistics = [f"{name}:  {text}" for name, text in found["rows"]]
        chart = self.charts["intervals"]
        x = [0.0, 6.0]
        y = [0.0, 0.0]
        if found["x"]:
            x = found["x"]
            y = found["y"]
        chart.fit((float(x[0]), float(x[-1])), np.array([0.0, *y]))
        line, mark = chart.curves
        line.update(x, y)
        median = found["median"]
        if median is None:
            mark.update([], [])
        else:
            mark.update([median, median], chart.y_range)

    def show_images(self, panels: list[ImagePanel], region: Region, note: str = "") -> None:
        """Show images; the clouds show a region. ``note``: what limits the images, or why there are none."""
        self.images.panels = panels
        self.images.region = region
        self.images.note = note

    # Drawing

    def draw(
        self, places: Places, *, dark: bool, help_shown: bool, side_shown: bool, depth_shown: bool
    ) -> None:
        """Draw all parts."""
        colours = BACKGROUND_AND_INK[dark]
        self.column.clear(places.column, places.size, places.font_px, colours)
        self.controls.draw(self.column, places.column)
        self.column.end()
        self._draw_strip(places, dark=dark)
        if side_shown:
            self._draw_side(places, dark=dark)
        else:
            self.side.hide()
        if help_shown:
            self._draw_help(places, dark=dark)
        else:
            self.help.hide()

        # The depth map's parts lie in the place of the clouds.
        clouds = places.clouds
        edges = [clouds.left + share * clouds.width for share in DEPTH_SHARES]
        for renderer, (left, right) in zip(self.depth, itertools.pairwise(edges), strict=True):
            part = Rect(left, clouds.low, right, clouds.top)
            scene.place_renderer(renderer, part.shares(places.size), shown=depth_shown)

    def _draw_strip(self, places: Places, *, dark: bool) -> None:
        """Draw images, charts and timeline."""
        paper = self.strip
        paper.clear(places.strip, places.size, places.font_px, BACKGROUND_AND_INK[dark])
        gap = 0.6 * places.font_px
        self.images.draw(paper, places.images.inset(0, 0, 0, gap))
        names = [name for name in self.charts if name != "intervals"]
        for name, rect in zip(names, chart_places(places.charts), strict=False):
            self.charts[name].draw(paper, rect.inset(0, gap, 0, gap))
        self.timeline.draw(paper, places.timeline)
        paper.end()

    def _draw_side(self, places: Places, *, dark: bool) -> None:
        paper = self.side
        em = places.font_px
        paper.clear(places.side, places.size, em, PANEL_COLOURS[dark])
        inner = places.side.inset(em, em, em, em)
        ink = GREY if self.statistics_old else ""
        of = "former window" if self.statistics_old else "selected events"
        title = f"Statistics of the {of}"
        for k, row in enumerate([title, *self.statistics]):
            paper.text(row, inner.left, inner.top - k * LINE * em, colour=ink, up="top")

        # The chart is beside the rows, or below them.
        is_wide = inner.width > 1.5 * inner.height
        if is_wide:
            middle = 0.5 * (inner.left + inner.right)
            chart = Rect(middle, inner.low, inner.right, inner.top)
        else:
            top = inner.top - (len(self.statistics) + 2) * LINE * em
            low = max(inner.low, top - 20 * em)
            chart = Rect(inner.left, low, inner.right, top)
        histogram, _ = self.charts["intervals"].curves
        histogram.colour = ink or OFF_COLOUR
        self.charts["intervals"].draw(paper, chart)
        paper.end()

    def _draw_help(self, places: Places, *, dark: bool) -> None:
        """Draw the keys in two columns over the clouds, with a smaller font if they need it."""
        half = (len(self.help_rows) + 1) // 2
        columns = [self.help_rows[:half], self.help_rows[half:]]
        width, height = places.size
        width_px = width - places.column.right - 2 * HELP_GAP_PX
        for em in range(places.font_px, SMALLEST_PX - 1, -1):
            widths = [_help_width(rows, em) for rows in columns]
            needed_height = LINE * em * (half + 1)
            if sum(widths) <= width_px and needed_height <= height:
                break
        left = places.column.right + HELP_GAP_PX
        top = float(height - HELP_GAP_PX)
        rect = Rect(left, top - needed_height, left + sum(widths), top)
        self.help.clear(rect, places.size, em, PANEL_COLOURS[dark])
        for rows, x in zip(columns, (left, left + widths[0]), strict=True):
            for row, (key, words) in enumerate(rows):
                y = top - LINE * em * (row + 0.5)
                self.help.text(KEY_NAMES.get(key, key), x + 5.0 * em, y, across="right", up="top")
                self.help.text(words, x + 6.0 * em, y, up="top")
        self.help.end()


def _help_width(rows: list[tuple[str, str]], em: int) -> float:
    """Return the width of a column of the help with a size of the font [px]."""
    widest = max((text_width(words, em) for _, words in rows), default=0.0)
    keys_and_gaps = 7.0 * em
    return widest + keys_and_gaps
