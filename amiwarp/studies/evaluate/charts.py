"""Charts of the tables of an evaluation, for print: drawn from the table alone."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.imaging.palette import BLACK, BLUE, GREEN, ORANGE, PINK, SKY_BLUE, VERMILION
from amiwarp.io.outputs import NewFile
from amiwarp.studies.evaluate.results import Chart, ChartKind, Table, Value
from amiwarp.studies.evaluate.streams import Frames, Stream

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


WIDTH = 7.2
"""Width of a figure [inch]."""
HEIGHT = 2.5
"""Height of a row of panels [inch]."""
COLUMNS = 3
"""Largest number of panels of a row."""
FEW_TICKS = 7
"""Largest number of values of the horizontal axis that are all labelled."""
FEW_POINTS = 12
"""Largest number of points of a line that have markers."""
TITLE_LENGTH = 26
"""Largest number of characters of a panel's title in one line."""
STYLE = {
    "font.size": 8.5, "axes.titlesize": 8.5, "axes.labelsize": 8.5, "legend.fontsize": 8.0, "axes.linewidth": 0.6,
    "axes.spines.top": False, "axes.spines.right": False, "lines.linewidth": 1.3, "lines.markersize": 3.5,
    "xtick.major.width": 0.6, "ytick.major.width": 0.6, "legend.frameon": False, "svg.hashsalt": "amiwarp",
}  # fmt: skip
"""Settings of Matplotlib."""
GREY = "0.55"


STREAM_COLOURS: dict[str, str] = {
    Stream.PLAIN: BLUE,
    Stream.SAME_COUNT: SKY_BLUE,
    Stream.TRUE: GREEN,
    Stream.CALIBRATED: VERMILION,
    Stream.SELF: PINK,
    Stream.RAW: ORANGE,
    Frames.SLOW: "0.75",
    Frames.FAST: "0.3",
}
"""Colours of the streams and of the standard cameras, the same in all charts."""
OTHERS = (VERMILION, BLUE, GREEN, ORANGE, PINK, SKY_BLUE, BLACK, GREY)
"""Colours of other series, in their order."""
CHANCE = "chance"
"""Name of the level of chance."""
REFERENCE_COLOURS = {
    CHANCE: GREY,
    "zero flow": GREY,
    "truth": BLACK,
    "one disparity": GREY,
    "gyroscope": BLACK,
    "true flow": GREY,
    "no motion": "0.8",
    "AMI-EV, turn to turn": PINK,
}
"""Colours of the levels of chance of predicting nothing, of the truth, and of other sources, next to the streams."""
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
    if not rows:
        return None
    rows_of_panel: dict[tuple[Value, ...], list[dict[str, Value]]] = {}
    for row in rows:
        panel = tuple(row[column] for column in chart.panels)
        rows_of_panel.setdefault(panel, []).append(row)
    series = list(dict.fromkeys(row[chart.series] for row in rows))

    # Four panels fill two rows better than a row of three and a single one.
    count = len(rows_of_panel)
    across = 2 if count == 4 else min(COLUMNS, count)
    down = math.ceil(count / across)
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT * down + 0.5), layout="constrained")
        axes = figure.subplots(down, across, sharey=True, squeeze=False).ravel()
        for ax, (panel, chosen) in zip(axes, rows_of_panel.items(), strict=False):
            _panel(ax, chart, chosen, series)
            ax.set_title(_title(panel))
        lowest = min(float(row[chart.y]) for row in rows)  # type: ignore[arg-type]
        if not chart.log_y and lowest >= 0:
            # After all panels are drawn, as they share the axis
            axes[0].set_ylim(bottom=0)
        for ax in axes[count:]:
            ax.set_axis_off()
        for row_of_axes in axes.reshape(down, across):
            row_of_axes[0].set_ylabel(chart.y)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=min(4, len(labels)))
        return figure


def _title(panel: Sequence[Value]) -> str:
    """Return the title of a panel, in two lines if it is long."""
    text = ", ".join(map(str, panel))
    if len(text) <= TITLE_LENGTH:
        return text
    first_line = ", ".join(map(str, panel[:-1]))
    return f"{first_line},\n{panel[-1]}"


def _panel(ax: Axes, chart: Chart, rows: list[dict[str, Value]], series: list[Value]) -> None:
    """Draw one panel. Its ``series`` are the whole chart's, so that each has the same colour in all panels."""
    rows_of_series = {}
    for name in series:
        rows_of_series[name] = [row for row in rows if row[chart.series] == name]
    if chart.kind is ChartKind.BARS:
        _bars(ax, chart, rows_of_series)
    else:
        _lines(ax, chart, rows_of_series)

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

    ticks = sorted({float(row[chart.x]) for row in rows})  # type: ignore[arg-type]
    if len(ticks) <= FEW_TICKS:
        ax.set_xticks(ticks, [f"{x:g}" for x in ticks])
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.xaxis.set_minor_locator(NullLocator())


def _lines(ax: Axes, chart: Chart, rows_of_series: dict[Value, list[dict[str, Value]]]) -> None:
    """Draw a line for each series, with a band of one standard deviation."""
    for number, (name, unsorted) in enumerate(rows_of_series.items()):
        rows = sorted(unsorted, key=lambda row: row[chart.x])  # type: ignore[arg-type,return-value]
        x = np.array([row[chart.x] for row in rows], np.float64)
        y = np.array([row[chart.y] for row in rows], np.float64)
        colour = _colour(name, number)
        marker = MARKERS[number % len(MARKERS)] if len(x) <= FEW_POINTS else None
        ax.plot(x, y, color=colour, marker=marker, label=str(name))
        if chart.spread is not None:
            std = np.array([row[chart.spread] or 0.0 for row in rows], np.float64)
            ax.fill_between(x, y - std, y + std, color=colour, alpha=0.15, linewidth=0)


def _bars(ax: Axes, chart: Chart, rows_of_series: dict[Value, list[dict[str, Value]]]) -> None:
    """Draw a group of bars for each value of the horizontal axis."""
    groups = list(dict.fromkeys(row[chart.x] for rows in rows_of_series.values() for row in rows))
    count = len(rows_of_series)
    width = 0.8 / max(1, count)
    for number, (name, rows) in enumerate(rows_of_series.items()):
        shift = (number - (count - 1) / 2) * width
        places = [groups.index(row[chart.x]) + shift for row in rows]
        y: Any = [row[chart.y] for row in rows]
        std: Any = None
        if chart.spread is not None:
            std = [row[chart.spread] or 0.0 for row in rows]
        ax.bar(
            places,
            y,
            0.9 * width,
            yerr=std,
            color=_colour(name, number),
            label=str(name),
            error_kw={"elinewidth": 0.8, "capsize": 2.0},
        )
    ax.set_xticks(range(len(groups)), [str(group) for group in groups])


def _colour(name: Value, number: int) -> str:
    """Return the colour of a stream, or of another series by its ``number``."""
    if name in REFERENCE_COLOURS:
        return REFERENCE_COLOURS[str(name)]
    return STREAM_COLOURS.get(str(name), OTHERS[number % len(OTHERS)])


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
