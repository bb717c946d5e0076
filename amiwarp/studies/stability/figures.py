"""Figures of the stability study: a page per axis, all pages as one PDF, and an overview of every axis on one sheet."""

import io
import math
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.imaging.palette import BLACK, BLUE, PINK, SKY_BLUE
from amiwarp.io.outputs import NewFile
from amiwarp.plotting.figures import blank, save
from amiwarp.studies.stability.aims import DEFAULT, PAPER
from amiwarp.studies.stability.atlas import Atlas
from amiwarp.studies.stability.axes import Axis
from amiwarp.studies.stability.judging import LIMIT_PX, Outcome
from amiwarp.studies.stability.points import AxisPoint, axis_label, value_label

COLOURS = {
    Outcome.SUCCESS: SKY_BLUE,
    Outcome.NAMED: "#f5d76e",
    Outcome.REFUSAL: "#d0d0d0",
    Outcome.SILENT: "#e6702e",
}
"""Colour of each outcome: distinguishable with colour vision deficiency, and light enough for black text."""
MARKS = {DEFAULT: ("o", BLACK, -0.17), PAPER: ("D", PINK, 0.17)}
"""Marker, colour and horizontal offset of the errors of each method."""
LEAST_PX = 1e-4
"""Smallest error that is drawn [px]; smaller errors are drawn at this value."""
OVERVIEW = (DEFAULT, PAPER, "sharpness")
"""Names of the methods that the overview shows."""

# Page of an axis [inch]
WIDTH = 11.0
"""Width of a page."""
LEFT = 1.45
"""Left margin."""
RIGHT = 0.25
"""Right margin."""
TOP = 1.05
"""Top margin."""
ROW = 0.52
"""Height of a method's row."""
ERRORS = 2.7
"""Height of the panel of errors."""
BETWEEN = 0.32
"""Height of the gap between rows and errors."""
BOTTOM = 0.85
"""Bottom margin."""

# Overview [inch]
SHEET = 12.4
"""Width of the sheet."""
COLUMNS = 2
"""Number of its columns."""
STRIP = 0.23
"""Height of a method's strip."""
HEAD = 0.58
"""Height of an axis heading."""
HEADLINE = 0.66
"""Height of the sheet's heading."""

LARGE = 14.0
NORMAL = 11.0
SMALL = 9.0
"""Font sizes of the figures [point]; bold digits below 9 points are illegible."""


def draw(atlas: Atlas, folder: Path) -> dict[str, Path]:
    """Write overview.png, a PNG for each axis and atlas.pdf into ``folder``; each write is atomic."""
    pages = [_page(atlas, axis) for axis in atlas.axes]
    sheet = _overview(atlas)
    files = {"overview": folder / "overview.png", "pages": folder / "atlas.pdf"}
    save(sheet, files["overview"])
    for axis, page in zip(atlas.axes, pages, strict=True):
        files[axis.name] = folder / f"axis_{re.sub('[^a-z0-9]+', '_', axis.name.lower())}.png"
        save(page, files[axis.name])
    _save_pdf([sheet, *pages], files["pages"])
    return files


def _save_pdf(figures: Sequence[Any], path: Path) -> None:
    """Write figures as the pages of a PDF."""
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    with PdfPages(buffer, metadata={"CreationDate": None}) as pages:
        for figure in figures:
            pages.savefig(figure)
    with NewFile(path) as new:
        new.part.write_bytes(buffer.getvalue())


def _page(atlas: Atlas, axis: Axis) -> Any:
    """Draw the page of an axis: outcomes of every method above, errors of the default and the paper's method below."""
    spots = atlas.of(axis)
    values = _values(axis, spots)
    rows = ROW * len(atlas.methods)
    height = TOP + rows + BETWEEN + ERRORS + BOTTOM
    figure = blank((WIDTH, height), dpi=130)
    wide = (WIDTH - LEFT - RIGHT) / WIDTH
    heat = figure.add_axes((LEFT / WIDTH, 1.0 - (TOP + rows) / height, wide, rows / height))
    errors = figure.add_axes((LEFT / WIDTH, BOTTOM / height, wide, ERRORS / height))
    _shares(heat, spots, values, atlas.methods)
    middle = {"ha": "center", "va": "center"}
    for (method, value), spot in spots.items():
        x = values.index(value)
        y = atlas.methods.index(method)
        share = f"{_share(spot)} %" if spot.results else _share(spot)
        heat.text(x, y - 0.13, share, fontsize=NORMAL, fontweight="bold", **middle)
        heat.text(x, y + 0.27, _count(spot), fontsize=SMALL, **middle)
    _heat_grid(heat, len(values), atlas.methods, NORMAL)
    heat.tick_params(axis="x", labelbottom=False)
    _errors(errors, spots, values)
    labels = [_broken(value_label(axis, value)) for value in values]
    errors.set_xticks(range(len(values)), labels, fontsize=NORMAL)
    errors.set_xlabel(axis_label(axis), fontsize=NORMAL)
    figure.text(LEFT / WIDTH, 1.0 - 0.3 / height, axis_label(axis), fontsize=LARGE, va="center")
    _legend(figure, WIDTH, height, 0.72)
    return figure


def _overview(atlas: Atlas) -> Any:
    """Draw the overview: a block for each axis (varied quantity), with one strip per method.

    The blocks fill the columns of the sheet from top to bottom.
    """
    methods = [name for name in OVERVIEW if name in atlas.methods] or atlas.methods[:1]
    strips = STRIP * len(methods)
    block = HEAD + strips
    deep = math.ceil(len(atlas.axes) / COLUMNS)
    height = HEADLINE + deep * block + 0.15
    figure = blank((SHEET, height), dpi=130)
    left = 0.85
    between = 0.25
    wide = (SHEET - between) / COLUMNS - left
    for number, axis in enumerate(atlas.axes):
        column, row = divmod(number, deep)
        x = column * (left + wide + between) + left
        top = HEADLINE + row * block + HEAD
        ax = figure.add_axes(
            (x / SHEET, 1.0 - (top + strips) / height, wide / SHEET, strips / height)
        )
        _strips(ax, axis, atlas.of(axis), methods)
        figure.text(
            x / SHEET,
            1.0 - (top - 0.32) / height,
            axis_label(axis),
            fontsize=NORMAL,
            fontweight="bold",
            va="center",
        )
    figure.text(left / SHEET, 1.0 - 0.22 / height, _headline(atlas), fontsize=LARGE, va="center")
    lost = any(not spot.results for spot in atlas.spots)
    text = "numbers: successes [%]; –: failed in the study" if lost else "numbers: successes [%]"
    _legend(figure, SHEET, height, 0.52, left=left, text=text)
    return figure


def _headline(atlas: Atlas) -> str:
    """Return the title of the overview."""
    most = max(len(s.results) for s in atlas.spots)
    title = f"Where calibration works: {atlas.cells:,} simulated recordings, up to {most} for each value"
    if atlas.failed_cells:
        title += f"; {atlas.failed_cells:,} failed"
    return title


def _strips(
    ax: Any, axis: Axis, spots: dict[tuple[str, Any], AxisPoint], methods: Sequence[str]
) -> None:
    """Draw the overview's block of one axis: a strip per method."""
    values = _values(axis, spots)
    _shares(ax, spots, values, methods)
    for (method, value), spot in spots.items():
        if method in methods:
            ax.text(
                values.index(value),
                methods.index(method) + 0.03,
                _share(spot),
                fontsize=SMALL,
                fontweight="bold",
                ha="center",
                va="center",
            )
    _heat_grid(ax, len(values), methods, SMALL)
    ax.xaxis.tick_top()
    ax.tick_params(axis="x", length=0, pad=1.0)
    names = [value_label(axis, v) for v in values]
    points_per_name = 72.0 * ax.get_position().width * SHEET / len(names)
    size = min(SMALL, *(points_per_name / (0.6 * len(name)) for name in names))
    ax.set_xticks(range(len(values)), names, fontsize=size)


def _values(axis: Axis, spots: dict[tuple[str, Any], AxisPoint]) -> list[Any]:
    """Return the values of an axis for which there are results."""
    there = [value for _, value in spots]
    return [value for value in axis.values if value in there]


def _shares(
    ax: Any, spots: dict[tuple[str, Any], AxisPoint], values: Sequence[Any], methods: Sequence[str]
) -> None:
    """Draw the cells of the heat map; each cell is divided by the shares of the outcomes."""
    from matplotlib.collections import PolyCollection

    parts: dict[str, list[list[tuple[float, float]]]] = {colour: [] for colour in COLOURS.values()}
    for row, method in enumerate(methods):
        top = row - 0.5
        bottom = row + 0.5
        for column, value in enumerate(values):
            spot = spots.get((method, value))
            if spot is None or not spot.results:
                continue
            shares = [spot.rate(outcome).share for outcome in COLOURS]
            edges = np.cumsum([0.0, *shares]) + column - 0.5
            for part, (left, right) in zip(parts.values(), pairwise(edges), strict=True):
                part.append([(left, top), (right, top), (right, bottom), (left, bottom)])
    for colour, part in parts.items():
        ax.add_collection(PolyCollection(part, facecolors=colour, linewidths=0))


def _share(spot: AxisPoint) -> str:
    """Return the share of successful calibrations in per cent, as text; a dash if the study failed for all."""
    if not spot.results:
        return "–"
    return f"{100 * spot.rate(Outcome.SUCCESS).share:.0f}"


def _count(spot: AxisPoint) -> str:
    """Return the number of successes, the total, and the median time, as text, or how many failed in the study."""
    if not spot.results:
        return f"{spot.failed} failed"
    success = spot.rate(Outcome.SUCCESS)
    if spot.failed:
        return f"{success.count}/{success.total}, {spot.failed} failed"
    return f"{success.count}/{success.total}, {spot.seconds:.2g} s"


def _heat_grid(ax: Any, columns: int, methods: Sequence[str], size: float) -> None:
    """Draw the grid lines and method names of a heat map."""
    ax.set(xlim=(-0.5, columns - 0.5), ylim=(len(methods) - 0.5, -0.5))
    ax.set_yticks(range(len(methods)), methods, fontsize=size)
    ax.tick_params(axis="both", length=0)
    ax.vlines(np.arange(columns + 1) - 0.5, -0.5, len(methods) - 0.5, color="white", linewidth=3.0)
    ax.hlines(np.arange(len(methods) + 1) - 0.5, -0.5, columns - 0.5, color="white", linewidth=1.5)
    for side in ax.spines.values():
        side.set_visible(False)


def _errors(ax: Any, spots: dict[tuple[str, Any], AxisPoint], values: Sequence[Any]) -> None:
    """Draw all errors as markers, their median as a line, and the limit of a success as a dashed line."""
    ax.set_yscale("log")
    shown = []
    for (method, _), point in spots.items():
        if method in MARKS:
            shown += point.errors
    least = max(min(shown, default=LIMIT_PX), LEAST_PX)
    most = max(shown, default=LIMIT_PX)
    low = min(least / 1.5, LIMIT_PX / 3.0)
    high = max(most * 1.5, LIMIT_PX * 3.0)
    ax.set(xlim=(-0.5, len(values) - 0.5), ylim=(low, high))
    for method, (mark, colour, aside) in MARKS.items():
        for column, value in enumerate(values):
            spot = spots.get((method, value))
            if spot is None or not spot.errors:
                continue
            x = column + aside
            errors = np.maximum(np.sort(spot.errors), LEAST_PX)
            # Spread sideways, so that equal errors do not hide each other
            spread = 0.11 * np.sin(2.4 * np.arange(len(errors)))
            ax.plot(
                x + spread,
                errors,
                mark,
                color=colour,
                markersize=4.0,
                alpha=0.55,
                markeredgewidth=0,
            )
            ax.hlines(np.median(errors), x - 0.15, x + 0.15, color=colour, linewidth=2.0)
            if spot.limit_px > LIMIT_PX:
                ax.hlines(
                    spot.limit_px,
                    x - 0.16,
                    x + 0.16,
                    color=colour,
                    linewidth=1.2,
                    linestyle=(0, (2, 1.5)),
                )
    ax.axhline(LIMIT_PX, color=BLUE, linewidth=1.2, linestyle="--", zorder=1)
    ax.set_ylabel("model error [px rms]", fontsize=NORMAL)
    ax.grid(True, axis="y", color="#e4e4e4")
    ax.set_axisbelow(True)
    ax.yaxis.set_major_formatter(lambda y, _: f"{y:g}")
    ax.tick_params(axis="y", labelsize=NORMAL)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    _key(ax)


def _key(ax: Any) -> None:
    """Draw the legend of the errors."""
    from matplotlib.lines import Line2D

    handles = []
    for name, (mark, colour, _) in MARKS.items():
        style: Any = {"marker": mark, "color": colour, "markersize": 5, "linewidth": 2.0}
        handles.append(Line2D([], [], label=f"{name}, median", **style))
    handles.append(
        Line2D([], [], color=BLUE, linestyle="--", linewidth=1.2, label=f"{LIMIT_PX} px")
    )
    handles.append(
        Line2D(
            [],
            [],
            color=BLACK,
            linestyle=(0, (2, 1.5)),
            linewidth=1.2,
            label="limit of a success if the model itself has a larger error",
        )
    )
    ax.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=4,
        frameon=False,
        fontsize=SMALL,
        borderpad=0.0,
        borderaxespad=0.1,
        columnspacing=1.5,
    )


def _legend(
    figure: Any, width: float, height: float, down: float, *, left: float = LEFT, text: str = ""
) -> None:
    """Draw the legend of the outcomes."""
    from matplotlib.patches import Patch

    handles = [Patch(color=colour, label=outcome.value) for outcome, colour in COLOURS.items()]
    if not text:
        text = "share of successes; successes of recordings, median time"
    handles.append(Patch(color="none", label=text))
    figure.legend(
        handles=handles,
        loc="center left",
        ncols=5,
        frameon=False,
        fontsize=NORMAL,
        borderpad=0.0,
        borderaxespad=0.0,
        bbox_to_anchor=(left / width, 1.0 - down / height),
        columnspacing=1.5,
        handletextpad=0.5,
    )


def _broken(text: str) -> str:
    """Return a long text broken into two lines."""
    if len(text) <= 12:
        return text
    words = text.split()
    half = (len(words) + 1) // 2
    return "\n".join([" ".join(words[:half]), " ".join(words[half:])])
