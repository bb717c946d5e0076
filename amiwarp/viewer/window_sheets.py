"""What the window shows beside the clouds: column, images, charts, timeline, statistics and help, on paper."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from amiwarp.imaging.palette import OFF_COLOUR
from amiwarp.imaging.regions import Region
from amiwarp.plotting.colours import GREY
from amiwarp.viewer import drawing, layout
from amiwarp.viewer.texts import LINE, SMALLEST_PX, text_width
from amiwarp.viewer.window_charts import INTERVAL_CURVES, MARKS, ORBIT_CURVES, Chart, chart_places
from amiwarp.viewer.window_controls import Controls, Slider
from amiwarp.viewer.window_images import ImageRow, Panel
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
KEY_NAMES = {"?": "h or ?", "ArrowRight": "→", "ArrowLeft": "←", " ": "space", "Up": "↑", "Down": "↓"}
"""How the help writes keys, where it does not use their names."""


class Sheets:
    """Parts of the window beside the clouds. They are drawn anew when what they show has changed."""

    def __init__(self, renderers: list[Any], actions: Any) -> None:
        """``renderers``: the :data:`RENDERERS` of the parts; ``actions``: the window, whose methods input calls."""
        column, strip, side, *self.depth, help_ = renderers
        self.column, self.strip, self.side, self.help = Paper(column), Paper(strip), Paper(side), Paper(help_)
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
        kept = {name: chart for name, chart in self.charts.items() if name in (*names, "orbit", "intervals")}
        self.charts = {}
        for name in names:
            label, unit, *_ = layout.SLIDERS[name]
            title = f"sharpness over {label}{f' [{unit}]' if unit else ''}"
            self.charts[name] = kept.get(name) or Chart(title, (("", 2.0, "sharpness"), *MARKS))
        if names:
            self.charts["orbit"] = kept.get("orbit") or Chart("displacement [px] over θ [°]", ORBIT_CURVES)
        title = "share [%] over log10 of the interval [µs]"
        self.charts["intervals"] = kept.get("intervals") or Chart(title, INTERVAL_CURVES)

    def show_orbit(self, theta_deg: Any, moved_px: Any) -> None:
        """Show how far a scene point is displaced over a turn. ``moved_px``: shape ``(n, 2)``."""
        chart = self.charts["orbit"]
        for k in range(2):
            chart.curves[k].update(theta_deg, moved_px[:, k])
        chart.fit((0.0, 360.0), moved_px, least=1e-3)

    def show_curve(self, name: str, x: Any, y: Any, known: tuple[float | None, float], *, old: bool) -> None:
        """Show the sharpness over a parameter, with its true value, if it is known, and its current one.

        ``old``: whether it is of the window before; it is then grey.
        """
        chart = self.charts[name]
        chart.fit((float(x[0]), float(x[-1])), y)
        curve, *marks = chart.curves
        curve.update(x, y)
        curve.colour, curve.label = (GREY, "former window") if old else ("", "sharpness")
        for mark, value in zip(marks, known, strict=True):
            inside = value is not None and x[0] <= value <= x[-1]
            mark.update([value, value] if inside else [], chart.y_range if inside else [])

    def show_statistics(self, found: dict[str, Any]) -> None:
        """Show the statistics of the selected events, as the page does."""
        self.statistics = [f"{name}:  {text}" for name, text in found["rows"]]
        chart = self.charts["intervals"]
        x, y = (found["x"], found["y"]) if found["x"] else ([0.0, 6.0], [0.0, 0.0])
        chart.fit((float(x[0]), float(x[-1])), np.array([0.0, *y]))
        line, mark = chart.curves
        line.update(x, y)
        known = found["median"] is not None
        mark.update([found["median"]] * 2 if known else [], chart.y_range if known else [])

    def show_images(self, panels: list[Panel], region: Region, note: str = "") -> None:
        """Show images; the clouds show a region. ``note``: what limits the images, or why there are none."""
        self.images.panels, self.images.region, self.images.note = panels, region, note

    # Drawing

    def draw(self, places: Places, *, dark: bool, help_shown: bool, side_shown: bool, depth_shown: bool) -> None:
        """Draw all parts."""
        colours = drawing.BACKGROUND_AND_INK[dark]
        self.column.clear(places.column, places.size, places.font_px, colours)
        self.controls.draw(self.column, places.column)
        self.column.end()
        self._draw_strip(places, dark=dark)
        self._draw_side(places, dark=dark) if side_shown else self.side.hide()
        self._draw_help(places, dark=dark) if help_shown else self.help.hide()
        clouds = places.clouds
        for renderer, (left, right) in zip(self.depth, itertools.pairwise(DEPTH_SHARES), strict=True):
            part = Rect(clouds.left + left * clouds.width, clouds.low, clouds.left + right * clouds.width, clouds.top)
            drawing.place_renderer(renderer, part.shares(places.size), shown=depth_shown)

    def _draw_strip(self, places: Places, *, dark: bool) -> None:
        """Draw images, charts and timeline."""
        paper = self.strip
        paper.clear(places.strip, places.size, places.font_px, drawing.BACKGROUND_AND_INK[dark])
        gap = 0.6 * places.font_px
        self.images.draw(paper, places.images.inset(0, 0, 0, gap))
        names = [name for name in self.charts if name != "intervals"]
        for name, rect in zip(names, chart_places(places.charts), strict=False):
            self.charts[name].draw(paper, rect.inset(0, gap, 0, gap))
        self.timeline.draw(paper, places.timeline)
        paper.end()

    def _draw_side(self, places: Places, *, dark: bool) -> None:
        paper, em = self.side, places.font_px
        paper.clear(places.side, places.size, em, PANEL_COLOURS[dark])
        inner = places.side.inset(em, em, em, em)
        ink = GREY if self.statistics_old else ""
        title = f"Statistics of the {'former window' if self.statistics_old else 'selected events'}"
        for k, row in enumerate([title, *self.statistics]):
            paper.text(row, inner.left, inner.top - k * LINE * em, colour=ink, up="top")
        if inner.width > 1.5 * inner.height:  # the chart beside the rows, or below them
            chart = Rect(0.5 * (inner.left + inner.right), inner.low, inner.right, inner.top)
        else:
            top = inner.top - (len(self.statistics) + 2) * LINE * em
            chart = Rect(inner.left, max(inner.low, top - 20 * em), inner.right, top)
        histogram, _ = self.charts["intervals"].curves
        histogram.colour = ink or OFF_COLOUR
        self.charts["intervals"].draw(paper, chart)
        paper.end()

    def _draw_help(self, places: Places, *, dark: bool) -> None:
        """Draw the keys in two columns over the clouds, with a smaller font if they need it."""
        half = (len(self.help_rows) + 1) // 2
        columns = [self.help_rows[:half], self.help_rows[half:]]
        width, height = places.size
        room = width - places.column.right - 2 * HELP_GAP_PX
        for em in range(places.font_px, SMALLEST_PX - 1, -1):
            widths = [max((text_width(words, em) for _, words in rows), default=0.0) + 7.0 * em for rows in columns]
            if sum(widths) <= room and LINE * em * (half + 1) <= height:
                break
        left, top = places.column.right + HELP_GAP_PX, float(height - HELP_GAP_PX)
        rect = Rect(left, top - LINE * em * (half + 1), left + sum(widths), top)
        self.help.clear(rect, places.size, em, PANEL_COLOURS[dark])
        for rows, x in zip(columns, (left, left + widths[0]), strict=True):
            for row, (key, words) in enumerate(rows):
                y = top - LINE * em * (row + 0.5)
                self.help.text(KEY_NAMES.get(key, key), x + 5.0 * em, y, across="right", up="top")
                self.help.text(words, x + 6.0 * em, y, up="top")
        self.help.end()
