"""Figures of the stability study: a page per axis, all pages as one PDF, and an overview of every axis on one sheet."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.imaging.palette import BLACK, BLUE, PINK, SKY_BLUE
from amiwarp.io.atomic_output import NewFile
from amiwarp.plotting.figures import save
from amiwarp.studies.stability.cells import LIMIT_PX, Outcome
from amiwarp.studies.stability.conditions import Axis
from amiwarp.studies.stability.report import DEFAULT, PAPER, Atlas, AxisPoint, axis_label, value_label

COLOURS = {Outcome.SUCCESS: SKY_BLUE, Outcome.REFUSAL: "#d0d0d0", Outcome.SILENT: "#e6702e"}
"""Colour of each outcome: distinguishable with colour vision deficiency, and light enough for black text."""
MARKS = {DEFAULT: ("o", BLACK, -0.17), PAPER: ("D", PINK, 0.17)}
"""Marker, colour and horizontal offset of the errors of each method."""
LEAST_PX = 1e-4
"""Smallest error that is drawn [px]; smaller errors are drawn at this value."""
OVERVIEW = (DEFAULT, PAPER, "sharpness")
"""Names of the methods that the overview shows."""
WIDTH, LEFT, RIGHT, TOP = 11.0, 1.45, 0.25, 1.05
"""Width of a page, and its margins left, right and top [inch]."""
ROW, ERRORS, BETWEEN, BOTTOM = 0.52, 2.7, 0.32, 0.85
"""Heights of a method's row, of the error panel, of the gap between them, and of the bottom margin [inch]."""
SHEET, COLUMNS, STRIP, HEAD, HEADLINE = 12.4, 2, 0.23, 0.58, 0.66
"""Sizes of the overview [inch]: width, number of columns, heights of a method's strip, of an axis heading and of the
sheet's heading."""
LARGE, NORMAL, SMALL = 14.0, 11.0, 9.0
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


def _figure(width: float, height: float) -> Any:
    """Return an empty Matplotlib figure of a width and height [inch]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=130)
    FigureCanvasAgg(figure)
    return figure


def _page(atlas: Atlas, axis: Axis) -> Any:
    """Draw the page of an axis: outcomes of every method above, errors of the default and the paper's method below."""
    spots = atlas.of(axis)
    values = _values(axis, spots)
    rows = ROW * len(atlas.methods)
    height = TOP + rows + BETWEEN + ERRORS + BOTTOM
    figure = _figure(WIDTH, height)
    wide = (WIDTH - LEFT - RIGHT) / WIDTH
    heat = figure.add_axes((LEFT / WIDTH, 1.0 - (TOP + rows) / height, wide, rows / height))
    errors = figure.add_axes((LEFT / WIDTH, BOTTOM / height, wide, ERRORS / height))
    _shares(heat, spots, values, atlas.methods)
    middle = {"ha": "center", "va": "center"}
    for (method, value), spot in spots.items():
        x, y = values.index(value), atlas.methods.index(method)
        heat.text(x, y - 0.13, f"{_share(spot)} %", fontsize=NORMAL, fontweight="bold", **middle)
        heat.text(x, y + 0.27, _count(spot), fontsize=SMALL, **middle)
    _grid(heat, len(values), atlas.methods, NORMAL)
    heat.tick_params(axis="x", labelbottom=False)
    _errors(errors, spots, values)
    errors.set_xticks(range(len(values)), [_broken(value_label(axis, v)) for v in values], fontsize=NORMAL)
    errors.set_xlabel(axis_label(axis), fontsize=NORMAL)
    figure.text(LEFT / WIDTH, 1.0 - 0.3 / height, axis_label(axis), fontsize=LARGE, va="center")
    _legend(figure, WIDTH, height, 0.72)
    return figure


def _overview(atlas: Atlas) -> Any:
    """Draw the overview: a block for each axis (varied quantity), with one strip per method.

    The blocks fill the columns of the sheet from top to bottom.
    """
    methods = [m for m in OVERVIEW if m in atlas.methods] or atlas.methods[:1]
    block = HEAD + STRIP * len(methods)
    deep = -(-len(atlas.axes) // COLUMNS)
    height = HEADLINE + deep * block + 0.15
    figure = _figure(SHEET, height)
    left, between = 0.85, 0.25
    wide = (SHEET - between) / COLUMNS - left
    for k, axis in enumerate(atlas.axes):
        x = (k // deep) * (left + wide + between) + left
        top = HEADLINE + (k % deep) * block + HEAD
        strips = STRIP * len(methods)
        ax = figure.add_axes((x / SHEET, 1.0 - (top + strips) / height, wide / SHEET, strips / height))
        _strips(ax, axis, atlas.of(axis), methods)
        figure.text(x / SHEET, 1.0 - (top - 0.32) / height, axis_label(axis), fontsize=NORMAL, fontweight="bold",
                    va="center")  # fmt: skip
    figure.text(left / SHEET, 1.0 - 0.22 / height, _headline(atlas), fontsize=LARGE, va="center")
    _legend(figure, SHEET, height, 0.52, left=left, text="numbers: successes [%]")
    return figure


def _headline(atlas: Atlas) -> str:
    """Return the title of the overview."""
    most = max(len(s.results) for s in atlas.spots)
    return f"Where calibration works: {atlas.cells:,} simulated recordings, up to {most} for each value"


def _strips(ax: Any, axis: Axis, spots: dict[tuple[str, Any], AxisPoint], methods: Sequence[str]) -> None:
    """Draw the overview's block of one axis: a strip per method."""
    values = _values(axis, spots)
    _shares(ax, spots, values, methods)
    for (method, value), spot in spots.items():
        if method in methods:
            ax.text(values.index(value), methods.index(method) + 0.03, _share(spot), fontsize=SMALL,
                    fontweight="bold", ha="center", va="center")  # fmt: skip
    _grid(ax, len(values), methods, SMALL)
    ax.xaxis.tick_top()
    ax.tick_params(axis="x", length=0, pad=1.0)
    names = [value_label(axis, v) for v in values]
    room = 72.0 * ax.get_position().width * SHEET / len(names)
    size = min(SMALL, *(room / (0.6 * len(name)) for name in names))
    ax.set_xticks(range(len(values)), names, fontsize=size)


def _values(axis: Axis, spots: dict[tuple[str, Any], AxisPoint]) -> list[Any]:
    """Return the values of an axis for which there are results."""
    there = [value for _, value in spots]
    return [v for v in axis.values if v in there]


def _shares(ax: Any, spots: dict[tuple[str, Any], AxisPoint], values: Sequence[Any], methods: Sequence[str]) -> None:
    """Draw the cells of the heat map; each cell is divided by the shares of the outcomes."""
    from matplotlib.collections import PolyCollection

    parts: dict[str, list[list[tuple[float, float]]]] = {colour: [] for colour in COLOURS.values()}
    for k, method in enumerate(methods):
        for column, value in enumerate(values):
            if spot := spots.get((method, value)):
                edges = np.cumsum([0.0, *(spot.rate(o).share for o in COLOURS)]) + column - 0.5
                for part, (x0, x1) in zip(parts.values(), pairwise(edges), strict=True):
                    part.append([(x0, k - 0.5), (x1, k - 0.5), (x1, k + 0.5), (x0, k + 0.5)])
    for colour, part in parts.items():
        ax.add_collection(PolyCollection(part, facecolors=colour, linewidths=0))


def _share(spot: AxisPoint) -> str:
    """Return the share of successful calibrations in per cent, as text."""
    return f"{100 * spot.rate(Outcome.SUCCESS).share:.0f}"


def _count(spot: AxisPoint) -> str:
    """Return the number of successes, the total, and the median time, as text."""
    success = spot.rate(Outcome.SUCCESS)
    return f"{success.count}/{success.total}, {spot.seconds:.2g} s"


def _grid(ax: Any, columns: int, methods: Sequence[str], size: float) -> None:
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
    shown = [e for (method, _), spot in spots.items() if method in MARKS for e in spot.errors]
    low, high = max(min(shown, default=LIMIT_PX), LEAST_PX), max(shown, default=LIMIT_PX)
    ax.set(xlim=(-0.5, len(values) - 0.5), ylim=(min(low / 1.5, LIMIT_PX / 3.0), max(high * 1.5, LIMIT_PX * 3.0)))
    for method, (mark, colour, aside) in MARKS.items():
        for column, value in enumerate(values):
            spot = spots.get((method, value))
            if spot is None or not spot.errors:
                continue
            x, errors = column + aside, np.maximum(np.sort(spot.errors), LEAST_PX)
            spread = 0.11 * np.sin(2.4 * np.arange(len(errors))) if len(errors) > 1 else np.zeros(1)
            ax.plot(x + spread, errors, mark, color=colour, markersize=4.0, alpha=0.55, markeredgewidth=0)
            ax.hlines(np.median(errors), x - 0.15, x + 0.15, color=colour, linewidth=2.0)
            if spot.limit_px > LIMIT_PX:
                ax.hlines(spot.limit_px, x - 0.16, x + 0.16, color=colour, linewidth=1.2, linestyle=(0, (2, 1.5)))
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

    handles = [
        Line2D([], [], marker=mark, color=colour, markersize=5, linewidth=2.0, label=f"{name}, median")
        for name, (mark, colour, _) in MARKS.items()
    ]
    handles.append(Line2D([], [], color=BLUE, linestyle="--", linewidth=1.2, label=f"{LIMIT_PX} px"))
    handles.append(Line2D([], [], color=BLACK, linestyle=(0, (2, 1.5)), linewidth=1.2,
                          label="limit of a success if the model itself has a larger error"))  # fmt: skip
    ax.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False, fontsize=SMALL,
              borderpad=0.0, borderaxespad=0.1, columnspacing=1.5)  # fmt: skip


def _legend(figure: Any, width: float, height: float, down: float, *, left: float = LEFT, text: str = "") -> None:
    """Draw the legend of the outcomes."""
    from matplotlib.patches import Patch

    handles = [Patch(color=colour, label=outcome.value) for outcome, colour in COLOURS.items()]
    label = text or "share of successes; number of successes and recordings, median time of a calibration"
    handles.append(Patch(color="none", label=label))
    figure.legend(handles=handles, loc="center left", ncols=4, frameon=False, fontsize=NORMAL, borderpad=0.0,
                  borderaxespad=0.0, bbox_to_anchor=(left / width, 1.0 - down / height), columnspacing=1.5,
                  handletextpad=0.5)  # fmt: skip


def _broken(text: str) -> str:
    """Return a long text broken into two lines."""
    words = text.split()
    half = (len(words) + 1) // 2
    return "\n".join([" ".join(words[:half]), " ".join(words[half:])]) if len(text) > 12 else text
