"""Report of the evaluations: a page of HTML in one file, JSON, tables and figures."""

from __future__ import annotations

import base64
import csv
import importlib
import io
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.palette import BLACK, BLUE, GREEN, ORANGE, PINK, SKY_BLUE, VERMILION
from amiwarp.io.files import NewFile, write_text
from amiwarp.io.formats import make_folder
from amiwarp.studies.cluster import machine, versions
from amiwarp.studies.evaluate.study import (
    CellResult,
    Chart,
    ChartKind,
    Claim,
    Condition,
    Picture,
    Settings,
    Stream,
    Table,
    Value,
    rows_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Evaluations by name. A new one needs its module in this folder and its name in :data:`EVALUATIONS`.

EVALUATIONS = ("texture", "edges", "pictures", "corners", "segmentation", "flow", "pose", "apex_speed", "fading")
"""Names of the evaluations, in the order of the report: each is a module of this folder, see :class:`Evaluation`."""
SHORT = ("texture", "edges", "apex_speed", "fading")
"""Names of the evaluations that together take under ten minutes on two cores in their quick form."""


class Evaluation(Protocol):
    """What the module of an evaluation contains."""

    TITLE: str
    """Title in the report."""
    PROTOCOL: str
    """What is computed, and how."""
    DIFFERENCES: str
    """How that differs from the paper."""
    VERSION: int
    """Version of ``measure``. Raise it when the results change: older cells are then run anew."""
    Values: Any
    """Type of what ``measure`` returns: a typed dict, whose fields have their ranges. A cell of other values is not
    used."""
    NEEDS_TRUTH: bool
    """Whether it needs ground truth. If not, it also runs on recordings."""

    def conditions(self, settings: Settings) -> list[Condition]:
        """Return the conditions under which the evaluation runs."""

    def measure(self, streams: Any, settings: Settings) -> dict[str, Any]:
        """Return the result of one condition, as JSON data. ``streams``: :class:`Streams`."""

    def tables(self, results: Sequence[CellResult]) -> list[Table]:
        """Return the tables of all results, each with its chart. Results of failed cells have no values."""

    def claims(self, results: Sequence[CellResult]) -> list[Claim]:
        """Return the paper's claims with the verdicts that follow from the results.

        The function ``pictures(results)``, which returns the pictures of the evaluation, is optional.
        """


def load(name: str) -> Evaluation:
    """Return an evaluation. Raises :class:`AmiwarpError` if there is none of that name."""
    if name not in EVALUATIONS:
        raise AmiwarpError(f"unknown evaluation {name!r}; choose among {', '.join(EVALUATIONS)}")
    return cast("Evaluation", importlib.import_module(f"amiwarp.studies.evaluate.{name}"))


# Charts of the tables of an evaluation, for print: drawn from the table alone.

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


PACKAGES = ("numpy", "scipy", "warp-lang", "scikit-image", "scikit-learn", "opencv-python-headless", "matplotlib")
"""Packages whose versions the report states."""
REPORT_FILES = ("report.html", "report.json")
"""Names of the report's main files."""
STD = "std"
"""Name of the column of the standard deviation, which is shown behind the value in the column before it."""


@dataclass(frozen=True)
class Section:
    """Section of the report: one evaluation."""

    name: str
    """Name of the evaluation."""
    title: str
    """Title."""
    protocol: str
    """What is computed."""
    differences: str
    """How that differs from the paper."""
    claims: list[Claim]
    """Claims of the paper with verdicts."""
    tables: list[Table]
    """Tables."""
    pictures: list[Picture]
    """Pictures and films."""
    cells: int
    """Number of cells."""
    errors: list[str]
    """Messages of cells that failed."""
    not_calibrated: dict[str, str]
    """Share of the recordings that the calibration refused, by scene and motion of the camera."""
    processor_s: float
    """Processor time of the measures [s]."""


def section(name: str, results: Sequence[CellResult]) -> Section:
    """Return the section of an evaluation from the results of its cells."""
    evaluation = load(name)
    good = [r for r in results if not r.error]
    errors = [f"{r.condition}: {r.error}" for r in results if r.error]
    shown = evaluation.tables(good) if good else []
    pictures: list[Picture] = getattr(evaluation, "pictures", lambda _: [])(good)
    return Section(
        name, evaluation.TITLE, evaluation.PROTOCOL, evaluation.DIFFERENCES, evaluation.claims(good), shown,
        pictures, len(results), errors, refused(good), sum(r.processor_s for r in results),
    )  # fmt: skip


def refused(results: Sequence[CellResult]) -> dict[str, str]:
    """Return the share of recordings without a calibrated stream, by scene and motion of the camera."""
    counts: dict[str, list[bool]] = {}
    for result in results:
        lists = (name for name, value in result.values.items() if isinstance(value, list) and value)
        tables = [name for name in lists if "stream" in result.values[name][0]]
        rows = rows_of([result], tables[0]) if tables else []
        streams = {row["stream"] for row in rows}
        if Stream.RAW in streams:
            counts.setdefault(f"{rows[0]['scene']}, {rows[0]['camera']}", []).append(Stream.CALIBRATED not in streams)
    return {case: f"{sum(missing)} of {len(missing)}" for case, missing in counts.items() if any(missing)}


def write(out: Path, sections: Sequence[Section], settings: Settings, processor_s: float) -> dict[str, Path]:
    """Write the report, its tables and its figures to a folder, and return the main files."""
    for folder in ("tables", "figures"):
        make_folder(out / folder)
    figures: dict[str, Figure] = {}
    for table in (t for s in sections for t in s.tables):
        _write_csv(out / "tables" / f"{table.name}.csv", table)
        if (figure := draw(table)) is not None:
            figures[table.name] = figure
            for kind in ("png", "pdf"):
                save(figure, out / "figures" / f"{table.name}.{kind}")
    films = {p.name: _encode(p) for s in sections for p in s.pictures}
    for picture in (p for s in sections for p in s.pictures):
        with NewFile(out / "figures" / f"{picture.name}.{_kind(picture)}") as new:
            new.part.write_bytes(films[picture.name])
    about = _about(settings, processor_s)
    files = dict(zip(("report", "data"), (out / name for name in REPORT_FILES), strict=True))
    write_text(files["report"], _page(sections, figures, films, about))
    data = {"about": about, "evaluations": [_json(s) for s in sections]}
    write_text(files["data"], json.dumps(data, indent=1, default=str) + "\n")
    return files


def _about(settings: Settings, processor_s: float) -> dict[str, Any]:
    return {
        "date": time.strftime("%Y-%m-%d"), "settings": asdict(settings), "machine": machine(settings.device),
        "versions": versions(PACKAGES), "processor_s": processor_s,
    }  # fmt: skip


def _json(one: Section) -> dict[str, Any]:
    """Return a section as JSON data, without its pictures."""
    data = {name: value for name, value in vars(one).items() if name not in ("pictures", "claims", "tables")}
    tables = [asdict(t) for t in one.tables if not t.long]
    return {**data, "claims": [asdict(c) for c in one.claims], "tables": tables}


def _write_csv(path: Path, table: Table) -> None:
    buffer = io.StringIO()
    rows = csv.writer(buffer, lineterminator="\n")
    rows.writerow(table.columns)
    rows.writerows(table.rows)
    write_text(path, buffer.getvalue())


def _kind(picture: Picture) -> str:
    return "gif" if len(picture.frames) > 1 else "png"


def _encode(picture: Picture) -> bytes:
    """Return a picture as PNG, or a film as GIF."""
    from PIL import Image

    frames = [Image.fromarray(frame) for frame in picture.frames]
    buffer = io.BytesIO()
    if len(frames) == 1:
        frames[0].save(buffer, format="PNG", optimize=True)
    else:
        duration = round(1000 * picture.frame_s)
        frames[0].save(buffer, format="GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)
    return buffer.getvalue()


def _page(
    sections: Sequence[Section], figures: Mapping[str, Figure], films: Mapping[str, bytes], about: dict[str, Any]
) -> str:
    """Return the report as a page of HTML without references to other files."""
    try:
        import jinja2
    except ModuleNotFoundError as error:
        raise AmiwarpError("'amiwarp evaluate' needs Jinja2; run: pip install 'amiwarp[evaluate]'") from error
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    images = {name: _data("image/svg+xml", to_svg(figure)) for name, figure in figures.items()}
    kinds = {p.name: _kind(p) for s in sections for p in s.pictures}
    images |= {name: _data(f"image/{kinds[name]}", data) for name, data in films.items()}
    compact = {t.name: pivoted(t) for s in sections for t in s.tables if not t.long}
    template = environment.get_template("report.html.j2")
    return template.render(sections=sections, images=images, compact=compact, about=about)


def _data(kind: str, data: bytes) -> str:
    """Return data as an address that contains them."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def pivoted(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return the headings and the cells of a table for reading.

    Standard deviations stand behind their values. The series of a chart become columns.
    """
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    if table.chart is None:
        names = [c for c in table.columns if c != STD]
        return names, [[_cell(table, row, name) for name in names] for row in rows]
    chart = table.chart
    index = [c for c in dict.fromkeys((*chart.panels, chart.x)) if c in table.columns]
    series = list(dict.fromkeys(row[chart.series] for row in rows))
    found: dict[tuple[Value, ...], dict[Value, str]] = {}
    for row in rows:
        found.setdefault(tuple(row[c] for c in index), {})[row[chart.series]] = _cell(table, row, chart.y)
    cells = [[*(shown(v) for v in key), *(values.get(s, "–") for s in series)] for key, values in found.items()]
    return [*index, *map(str, series)], cells


def _cell(table: Table, row: dict[str, Value], name: str) -> str:
    """Return a value as text, with its standard deviation if the next column has it."""
    after = table.columns.index(name) + 1
    has_std = after < len(table.columns) and table.columns[after] == STD
    text = shown(row[name])
    return f"{text} ± {shown(row[STD], 2)}" if has_std and row[name] is not None else text


def shown(value: Value, digits: int = 3) -> str:
    """Return a value as a person reads it: a number with a few digits, or a dash for none."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
