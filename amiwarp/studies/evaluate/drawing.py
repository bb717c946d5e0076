"""Charts of the tables of an evaluation, for print: drawn from the table alone."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.imaging.palette import BLACK, BLUE, GREEN, ORANGE, PINK, SKY_BLUE, VERMILION
from amiwarp.io.atomic_output import NewFile
from amiwarp.studies.evaluate.conditions import Stream
from amiwarp.studies.evaluate.results import Chart, ChartKind, Table, Value

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT, COLUMNS = 7.2, 2.5, 3
"""Width of a figure and height of a row of panels [inch], and largest number of panels of a row."""
TITLE_LENGTH = 26
"""Largest number of characters of a panel's title in one line."""
STYLE = {
    "font.size": 8.5, "axes.titlesize": 8.5, "axes.labelsize": 8.5, "legend.fontsize": 8.0, "axes.linewidth": 0.6,
    "axes.spines.top": False, "axes.spines.right": False, "lines.linewidth": 1.3, "lines.markersize": 3.5,
    "xtick.major.width": 0.6, "ytick.major.width": 0.6, "legend.frameon": False, "svg.hashsalt": "amiwarp",
}  # fmt: skip
"""Settings of Matplotlib."""
GREY = "0.55"
STREAM_COLOURS = {
    Stream.PLAIN: BLUE,
    Stream.SAME_COUNT: SKY_BLUE,
    Stream.TRUE: GREEN,
    Stream.CALIBRATED: VERMILION,
    Stream.RAW: ORANGE,
}
"""Colours of the streams, the same in all charts."""
OTHERS = (VERMILION, BLUE, GREEN, ORANGE, PINK, SKY_BLUE, BLACK, GREY)
"""Colours of other series, in their order."""
CHANCE = "chance"
"""Name of the level of chance."""
REFERENCE_COLOURS = {CHANCE: GREY, "truth": BLACK}
"""Colours of the level of chance and of the truth, next to the streams."""
MARKERS = "osD^vPX*"
"""Markers that distinguish the series without colour."""


def draw(table: Table) -> Figure | None:
    """Return the chart of a table, or None if it has none or no values."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    chart = table.chart
    if chart is None:
        return None
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    rows = [row for row in rows if row[chart.y] is not None]
    panels = list(dict.fromkeys(tuple(row[c] for c in chart.panels) for row in rows))
    if not panels:
        return None
    series = list(dict.fromkeys(row[chart.series] for row in rows))
    across = 2 if len(panels) == 4 else min(COLUMNS, len(panels))
    down = math.ceil(len(panels) / across)
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT * down + 0.5), layout="constrained")
        axes = figure.subplots(down, across, sharey=True, squeeze=False).ravel()
        for ax, panel in zip(axes, panels, strict=False):
            chosen = [row for row in rows if tuple(row[c] for c in chart.panels) == panel]
            _panel(ax, chart, chosen, series)
            ax.set_title(_title(panel))
        if not chart.log_y and min(float(row[chart.y]) for row in rows) >= 0:  # type: ignore[arg-type]
            axes[0].set_ylim(bottom=0)  # after all panels are drawn, as they share the axis
        for ax in axes[len(panels) :]:
            ax.set_axis_off()
        for row_of_axes in axes.reshape(down, across):
            row_of_axes[0].set_ylabel(chart.y)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=min(4, len(labels)))
        return figure


def _title(panel: Sequence[Value]) -> str:
    """Return the title of a panel, in two lines if it is long."""
    text = ", ".join(map(str, panel))
    return text if len(text) <= TITLE_LENGTH else ", ".join(map(str, panel[:-1])) + f",\n{panel[-1]}"


def _panel(ax: Axes, chart: Chart, rows: list[dict[str, Value]], series: list[Value]) -> None:
    """Draw one panel."""
    by = {s: [row for row in rows if row[chart.series] == s] for s in series}
    (_bars if chart.kind is ChartKind.BARS else _lines)(ax, chart, by)
    for (label, value), dashes in zip(chart.marks.items(), ("--", ":", "-."), strict=False):
        ax.axhline(value, color="0.35", linestyle=dashes, linewidth=0.9, label=label)
    if chart.log_x:
        ax.set_xscale("log")
    if chart.log_y:
        ax.set_yscale("log")
    if chart.kind is ChartKind.LINES:
        ax.set_xlabel(chart.x)
        _ticks(ax, chart, rows)


def _ticks(ax: Axes, chart: Chart, rows: list[dict[str, Value]]) -> None:
    """Label the values of the horizontal axis themselves if they are few."""
    from matplotlib.ticker import NullFormatter, NullLocator

    at = sorted({float(row[chart.x]) for row in rows})  # type: ignore[arg-type]
    if len(at) <= 7:
        ax.set_xticks(at, [f"{x:g}" for x in at])
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.xaxis.set_minor_locator(NullLocator())


def _lines(ax: Axes, chart: Chart, by: dict[Value, list[dict[str, Value]]]) -> None:
    """Draw a line for each series, with a band of one standard deviation."""
    for k, (name, rows) in enumerate(by.items()):
        rows = sorted(rows, key=lambda row: row[chart.x])  # type: ignore[arg-type,return-value]
        x, y = (np.array([row[c] for row in rows], np.float64) for c in (chart.x, chart.y))
        colour = _colour(name, k)
        ax.plot(x, y, color=colour, marker=MARKERS[k % len(MARKERS)] if len(x) <= 12 else None, label=str(name))
        if chart.spread is not None:
            std = np.array([row[chart.spread] or 0.0 for row in rows], np.float64)
            ax.fill_between(x, y - std, y + std, color=colour, alpha=0.15, linewidth=0)


def _bars(ax: Axes, chart: Chart, by: dict[Value, list[dict[str, Value]]]) -> None:
    """Draw a group of bars for each value of the horizontal axis."""
    groups = list(dict.fromkeys(row[chart.x] for rows in by.values() for row in rows))
    width = 0.8 / max(1, len(by))
    for k, (name, rows) in enumerate(by.items()):
        at = [groups.index(row[chart.x]) + (k - (len(by) - 1) / 2) * width for row in rows]
        y: Any = [row[chart.y] for row in rows]
        std: Any = None if chart.spread is None else [row[chart.spread] or 0.0 for row in rows]
        ax.bar(at, y, 0.9 * width, yerr=std, color=_colour(name, k), label=str(name),
               error_kw={"elinewidth": 0.8, "capsize": 2.0})  # fmt: skip
    ax.set_xticks(range(len(groups)), [str(group) for group in groups])


def _colour(name: Value, k: int) -> str:
    """Return the colour of a stream, or of the k-th other series."""
    if name in REFERENCE_COLOURS:
        return REFERENCE_COLOURS[str(name)]
    return STREAM_COLOURS[Stream(name)] if name in set(Stream) else OTHERS[k % len(OTHERS)]


def to_svg(figure: Figure) -> bytes:
    """Return a figure as SVG, without a date."""
    from matplotlib import rc_context

    buffer = io.BytesIO()
    with rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or PDF, by the suffix of ``path``. On failure no file remains."""
    kind = path.suffix[1:]
    with NewFile(path) as new:
        metadata = {"CreationDate": None} if kind == "pdf" else {}
        figure.savefig(new.part, format=kind, dpi=220, metadata=metadata)
