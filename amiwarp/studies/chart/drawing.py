"""Drawing of the speed-error charts as PNG and SVG.

Each measured setting (row) is a point. The rows on the Pareto fronts are numbered and listed below.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.imaging.palette import (
    BLACK,
    BLUE,
    GREEN,
    MODEL_COLOURS,
    ORANGE,
    PINK,
    SKY_BLUE,
    VERMILION,
)
from amiwarp.imaging.uploaded_events import TURNS
from amiwarp.optics.models.registry import MODELS, rungs
from amiwarp.plotting import figures
from amiwarp.studies.chart.rows import Row, beaten_by, fronts, told_apart

WIDTH = 11.0
PANEL = 4.4
LEFT = 0.85
RIGHT = 0.3
BETWEEN = 0.3
"""Figure width, panel height, left and right margins, and gap between panels [inch]."""
TITLE = 0.42
AXIS = 0.82
LINE = 0.225
KEY = 0.2
NOTE = 0.42
"""Heights of the title above a panel, of the axis below it, of a line of the list, of a line of the legend, and of the
note [inch]."""
COLUMNS = 5
"""Number of columns of the legend."""
LETTERS = 12.5
SMALL = 10.5
TINY = 9.5
"""Font sizes of the chart [point], legible when the figure is shown at two thirds of its size."""
QUANTISATION = 0.29
"""Rounding error of a pixel along one axis [px]."""
PAPER = (1.5, 2.0)
"""Range of the error that the paper reports [px]."""
_SIMPLE_MODELS_FIRST = sorted(rungs(), key=lambda name: not MODELS[name].SIMPLIFIES)
COLOURS = {
    **dict(zip(_SIMPLE_MODELS_FIRST, MODEL_COLOURS, strict=False)),
    "other libraries": "#6b6b6b",
    "default": BLACK,
    "model": ORANGE,
    "algorithms": BLUE,
    "events": GREEN,
    "folding": PINK,
    "pairs": SKY_BLUE,
    "events and pairs": VERMILION,
}
"""Colour of each family of settings in the charts."""
WORDS = {
    **{name: model.TEXT for name, model in rungs().items()},
    "default": "all settings default",
    "other libraries": "other libraries (circle)",
}
"""Legend text of the families whose text differs from the name."""
MARKS = {
    "bilinear": "o",
    "nearest": "s",
    "share of events": "^",
    "file to file": "D",
    "NumPy": "x",
    "Numba": "+",
    "PyTorch": "*",
    "CuPy": "P",
    "both stages": "o",
    "sharpness alone": "s",
    "with a guess": "^",
}
"""Marker of each kind of measured setting."""
HOLLOW = ("share of events", "with a guess")
"""Kinds of settings with hollow markers."""
THIN = "x+"
"""Markers without area."""
LINES = ("-", (0, (5, 2)))
"""Line styles of the Pareto fronts."""
NAMED = "other libraries"
"""Family of settings whose points are labelled with their names."""
DIRECTIONS = ((1, 1), (1, -1), (-1, 1), (-1, -1), (0, 1), (0, -1), (1, 0), (-1, 0), (0.5, 1), (0.5, -1), (-0.5, 1),
              (-0.5, -1), (2, 1), (2, -1), (-2, 1), (-2, -1))  # fmt: skip
"""Directions from a point in which its label may be placed, in order of preference."""
DISTANCES = (0.0, 4.0, 9.0, 15.0, 22.0, 30.0, 40.0, 55.0, 70.0, 90.0)
"""Distances between a point and its label that are tried [point]."""


class ChartPanel:
    """Axes of a chart with its points and labels, and the boxes that these occupy [screen px]."""

    def __init__(
        self, ax: Any, rows: Sequence[Row], limits: tuple[float, float], errors: tuple[float, float]
    ) -> None:
        from matplotlib.transforms import Bbox

        self.ax = ax
        self.timed = rows[0].chart == "calibration"
        self.unit = ax.figure.dpi / 72.0
        ax.set(xscale="log", yscale="log", xlim=limits, ylim=errors)
        figures.number_logarithmic(ax.xaxis, ax.yaxis)
        ax.tick_params(which="both", labelsize=SMALL)
        # Keeps clear of the lowest number of the other axis
        ax.tick_params(axis="x", which="both", pad=8.0)
        ax.grid(True, color="#e4e4e4", linewidth=0.8)
        ax.set_axisbelow(True)
        ax.axhspan(*PAPER, color="#bdbdbd", alpha=0.55, linewidth=0)
        ax.axhline(QUANTISATION, color="#555555", linestyle=":", linewidth=1.4)
        across = "time of a calibration [ms]" if self.timed else "speed [million events/s]"
        ax.set_xlabel(across, fontsize=LETTERS)

        low, high = limits
        self.rows = [row for row in rows if low < _across(row) < high]
        self.points: list[Any] = []
        self.lines: list[Any] = []
        self.letters: list[Any] = []
        # The default lies over all others.
        for row in sorted(self.rows, key=lambda row: row.default):
            half = (8.5 if row.default else 5.0) * self.unit
            middle = self.at(row)
            self.points.append(Bbox([middle - half, middle + half]))
            self._point(row)

    def at(self, row: Row) -> Any:
        """Return the position of a row's point [screen px]."""
        return self.ax.transData.transform((_across(row), row.error_px))

    def _point(self, row: Row) -> None:
        """Draw the point of a measured setting."""
        colour = COLOURS[row.family]
        mark = MARKS[row.mark]
        size = 8.5
        if row.settings.get("angles", TURNS) < TURNS:
            size = 5.0
        elif mark == "*":
            size = 12.0
        is_hollow = row.mark in HOLLOW
        has_only_lines = is_hollow or mark in THIN
        style = {
            "markersize": size,
            "markerfacecolor": "none" if is_hollow else colour,
            "markeredgecolor": colour if has_only_lines else "white",
            "markeredgewidth": 1.8 if has_only_lines else 0.5,
        }
        x = [_across(row)]
        y = [row.error_px]
        self.ax.plot(x, y, mark, zorder=3, **style)
        if row.default:
            ring = {
                "markersize": 16,
                "markerfacecolor": "none",
                "markeredgecolor": "black",
                "markeredgewidth": 1.6,
            }
            self.ax.plot(x, y, "o", zorder=4, **ring)

    def step(self, chosen: list[Row], style: Any) -> None:
        """Draw a Pareto front as steps: the smallest error that each time budget allows."""
        from matplotlib.transforms import Bbox

        # The fastest row comes first, so errors fall along the list. The steps begin at the upper border, as no row
        # is faster than the first, and end at the slow border, as none is more accurate than the last.
        x = [_across(row) for row in chosen]
        y = [row.error_px for row in chosen]
        left, right = self.ax.get_xlim()
        slow_border = right if self.timed else left
        _, upper_border = self.ax.get_ylim()
        x = [x[0], *x, slow_border]
        y = [upper_border, *y, y[-1]]
        # A step changes y first, then x.
        step_x = np.repeat(x, 2)[1:]
        step_y = np.repeat(y, 2)[:-1]
        self.ax.plot(step_x, step_y, color="black", linewidth=1.1, linestyle=style, zorder=2)

        corners = self.ax.transData.transform(np.column_stack([step_x, step_y]))
        for start, end in itertools.pairwise(corners):
            low = np.minimum(start, end)
            high = np.maximum(start, end)
            self.lines.append(Bbox([low - 1.5, high + 1.5]))

    def write(self, text: str, row: Row, **style: Any) -> None:
        """Write a label near a point, where it covers neither points nor other labels."""
        from matplotlib.patheffects import withStroke
        from matplotlib.text import Text
        from matplotlib.transforms import Bbox

        place = self.at(row)
        label = self.ax.annotate(
            text,
            (_across(row), row.error_px),
            (0.0, 0.0),
            zorder=5,
            textcoords="offset points",
            ha="center",
            va="center",
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
            arrowprops={
                "arrowstyle": "-",
                "linewidth": 0.6,
                "color": "#707070",
                "shrinkA": 1.0,
                "shrinkB": 4.0,
                "relpos": (0.5, 0.5),
            },
            **style,
        )
        half = np.array(Text.get_window_extent(label).size) / 2.0
        near = half + (9.0 if row.default else 5.0) * self.unit
        inner = self.ax.get_window_extent().padded(-3.0)

        def box(spot: Any) -> Any:
            return Bbox([spot - half, spot + half])

        def covered(spot: Any) -> tuple[int, ...]:
            outside = inner.count_contains(box(spot).corners()) < 4
            letters = box(spot).count_overlaps(self.letters)
            drawn = box(spot).count_overlaps(self.points + self.lines)
            return outside, letters, drawn

        def crosses(spot: Any) -> bool:
            line = place + np.linspace(0.05, 0.95, 19)[:, None] * (spot - place)
            other_points = [point for point in self.points if not point.contains(*place)]
            return any(one.count_contains(line) for one in [*self.letters, *other_points])

        # Of the spots that cover least, the nearest to which the label's line crosses nothing
        spots = []
        for distance in DISTANCES:
            for direction in DIRECTIONS:
                spots.append(place + np.array(direction) * (near + distance * self.unit))
        costs = [covered(spot) for spot in spots]
        least = min(costs)
        best = [spot for spot, cost in zip(spots, costs, strict=True) if cost == least]
        spot = next((candidate for candidate in best if not crosses(candidate)), best[0])
        label.xyann = (spot - place) / self.unit
        self.letters.append(box(spot))
        self.lines.append(Bbox([np.minimum(place, spot), np.maximum(place, spot)]))


def _across(row: Row) -> float:
    """Return the horizontal coordinate of a row: time [ms] or speed [million events/s]."""
    return row.seconds * 1e3 if row.chart == "calibration" else row.mev_per_s


def draw(path: Path, rows: Sequence[Row], title: str, note: str) -> None:
    """Write the chart as ``path`` with the endings .png and .svg; each write is atomic. ``note`` is a line below.

    Raises :class:`ModuleNotFoundError` if Matplotlib or Pillow is missing.
    """
    lines = []
    for number, (job, chosen) in enumerate(fronts(rows)):
        if chosen:
            lines.append((job, chosen, LINES[number % len(LINES)]))
    lists = _numbered(rows, lines)
    keys = _keys(rows, lines)

    listed = LINE * max(len(list_of_labels) for list_of_labels in lists)
    # The panels of compensation have titles of their own.
    titles = TITLE * (1 if rows[0].chart == "calibration" else 1.75)
    legend = KEY * math.ceil(len(keys) / COLUMNS)
    height = titles + PANEL + AXIS + listed + legend + NOTE
    figure = figures.blank((WIDTH, height), dpi=150)
    below = height - titles - PANEL
    panels = _panels(figure, rows, below / height)
    for panel in panels:
        for _, chosen, style in lines:
            panel.step(chosen, style)
    figure.text(LEFT / WIDTH, (height - 0.3) / height, title, fontsize=LETTERS + 1.0)

    def closest(row: Row) -> ChartPanel:
        return [panel for panel in panels if row in panel.rows][-1]

    for entries in lists:
        for mark, row in entries:
            if isinstance(row, Row) and mark.isdigit():
                closest(row).write(mark, row, fontsize=SMALL, fontweight="bold")
    # From the right, because a name is placed to the right of its point if possible
    for row in sorted(rows, key=lambda row: row.cost):
        if row.family == NAMED:
            name = row.label.removesuffix(" (circle)").replace(" on the", ",")
            closest(row).write(name, row, fontsize=TINY, color=COLOURS[NAMED])
    for column, entries in enumerate(lists):
        _list(figure, entries, column, below - AXIS)
    figure.legend(
        handles=keys,
        loc="upper left",
        ncols=COLUMNS,
        frameon=False,
        fontsize=TINY,
        handletextpad=0.5,
        bbox_to_anchor=(LEFT / WIDTH, (below - AXIS - listed - 0.1) / height),
        borderpad=0.0,
        borderaxespad=0.2,
        columnspacing=1.6,
        labelspacing=0.45,
    )
    figure.text(LEFT / WIDTH, 0.08 / height, note, fontsize=TINY, color="#404040")
    figures.save_png_and_svg(figure, path)


def _panels(figure: Any, rows: Sequence[Row], bottom: float) -> list[ChartPanel]:
    """Return a panel of all rows, and for compensation an enlarged panel of the models."""
    errors = [row.error_px for row in rows]
    least = max(min(errors), 1e-5) / 1.8
    most = max(2.6, max(errors) * 1.6)
    x = [_across(row) for row in rows]
    shown = [(min(x) / 1.4, max(x) * 1.4)]
    timed = rows[0].chart == "calibration"
    if not timed:
        close = []
        for row in rows:
            if row.job == rows[0].job and row.comparable and row.family != NAMED:
                close.append(_across(row))
        close = close or x
        shown.append((min(close) / 1.04, max(close) * 1.04))
    sides = {
        "left": LEFT / WIDTH,
        "right": 1.0 - RIGHT / WIDTH,
        "wspace": 0.05,
        "bottom": bottom,
        "top": bottom + PANEL / figure.get_figheight(),
    }
    axes = figure.subplots(1, len(shown), sharey=True, squeeze=False, gridspec_kw=sides)[0]
    panels = []
    for ax, limits in zip(axes, shown, strict=True):
        panels.append(ChartPanel(ax, rows, limits, (least, most)))
    upwards = "model error [px rms]" if timed else "displacement error [px rms]"
    axes[0].set_ylabel(upwards, fontsize=LETTERS)
    if not timed:
        whole, enlarged = axes
        low, high = shown[1]
        whole.axvspan(low, high, color="#56b4e9", alpha=0.18, linewidth=0, zorder=0)
        whole.set_title("all", fontsize=LETTERS, loc="left")
        enlarged.set_title("shaded part, enlarged", fontsize=LETTERS, loc="left")
    return panels


def _numbered(
    rows: Sequence[Row], lines: Sequence[tuple[str, list[Row], Any]]
) -> list[list[tuple[str, Any]]]:
    """Return two columns of list lines: headings, numbered rows of the Pareto fronts, and the default.

    The default is listed separately if it is on no front.
    """
    lists: list[list[tuple[str, Any]]] = []
    numbers = itertools.count(1)
    for job, chosen, _ in lines:
        listed: list[tuple[str, Any]] = [("", job)]
        for row in told_apart(chosen):
            listed.append((str(next(numbers)), row))
        for row in rows:
            if row.default and row.job == job and row not in chosen:
                listed.append(("–" if beaten_by(row, rows) else "≈", row))
        lists.append(listed)

    # A long single list becomes two columns, both with the heading.
    if len(lists) == 1 and len(lists[0]) > 5:
        only = lists[0]
        half = math.ceil(len(only) / 2) + 1
        lists = [only[:half], [only[0], *only[half:]]]
    return lists


def _list(figure: Any, listed: list[tuple[str, Any]], column: int, top: float) -> None:
    """Write one column of the list below the panels."""
    width = (WIDTH - LEFT - RIGHT - BETWEEN) / 2.0
    left = LEFT + column * (width + BETWEEN)
    unit = "ms" if listed[-1][1].chart == "calibration" else "Mev/s"
    for k, (number, row) in enumerate(listed):
        if isinstance(row, Row):
            label = row.label
            if row.default and row.label != "default":
                label += " (default)"
            value = _across(row)
            value_text = f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"
            words = (number, label, value_text, _pixels(row.error_px))
            style: dict[str, Any] = {"fontweight": "bold"} if row.default else {}
        else:
            words = ("", f"Pareto front, {row}", unit, "px rms")
            style = {"color": "#404040"}
        y = (top - LINE * (k + 0.75)) / figure.get_figheight()
        places = (left + 0.12, left + 0.22, left + width - 0.85, left + width)
        sides = ("right", "left", "right", "right")
        for x, side, text in zip(places, sides, words, strict=True):
            figure.text(x / WIDTH, y, text, ha=side, va="baseline", fontsize=SMALL - 0.5, **style)


def _pixels(error: float) -> str:
    """Return an error [px] as text."""
    digits = 3 if error >= 0.001 else 1
    return np.format_float_positional(error, precision=digits, fractional=False, trim="-")


def _keys(rows: Sequence[Row], lines: Sequence[tuple[str, list[Row], Any]]) -> list[Any]:
    """Return the entries of the legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def mark(
        label: str, shape: str, size: float = 7.5, edge: str = "#404040", face: str = "none"
    ) -> Any:
        return Line2D(
            [],
            [],
            marker=shape,
            linestyle="none",
            markersize=size,
            markerfacecolor=face,
            markeredgecolor=edge,
            label=label,
        )

    def line(label: str, style: Any, width: float, colour: str) -> Any:
        return Line2D([], [], color=colour, linewidth=width, linestyle=style, label=label)

    families = {row.family for row in rows}
    # Points of other libraries are labelled with their names.
    marks = {row.mark for row in rows if row.family != NAMED}
    keys: list[Any] = []
    for family, colour in COLOURS.items():
        if family in families:
            keys.append(Patch(color=colour, label=WORDS.get(family, family)))
    for name, shape in MARKS.items():
        if name in marks:
            keys.append(mark(name, shape, face="none" if name in HOLLOW else "#404040"))
    keys.append(mark("default of the command", "o", 12, "black"))
    for job, _, style in lines:
        label = "Pareto front" if len(lines) == 1 else f"front, {job}"
        keys.append(line(label, style, 1.1, "black"))
    keys.append(line(f"quantisation {QUANTISATION} px", ":", 1.4, "#555555"))
    keys.append(Patch(color="#bdbdbd", alpha=0.55, label=f"paper {PAPER[0]} to {PAPER[1]} px"))
    return keys
