"""Evaluations: their names, their run on local processes or a cluster, and their report in HTML, JSON and figures."""

from __future__ import annotations

import base64
import contextlib
import importlib
import io
import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from amiwarp._version import __version__
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.palette import BLACK, BLUE, GREEN, ORANGE, PINK, SKY_BLUE, VERMILION
from amiwarp.io import open_recording
from amiwarp.io.files import NewFile, check_output, only_writer, own_folder, write_csv, write_text
from amiwarp.io.formats import make_folder
from amiwarp.io.json_files import CellStore, fields_of, value_of
from amiwarp.kernels.launch import load_all, load_kernels
from amiwarp.studies.cluster import Workers, failure_of, machine, run_jobs, start_workers, versions, worker_count
from amiwarp.studies.demo import EXACT_KERNELS
from amiwarp.studies.evaluate import study
from amiwarp.studies.evaluate.claims import PAPER, Claim
from amiwarp.studies.evaluate.study import CellResult, Chart, Condition, Settings, Stream, Table, Value
from amiwarp.studies.failures import failure_text
from amiwarp.tasks import Progress, cpu_threads, limited_cpu_threads, release_memory, silent
from amiwarp.translation.sources import limited_opencv
from amiwarp.validation import guarded, real, whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Evaluations by name. A new one needs its module in this folder and its name in :data:`EVALUATIONS`.

EVALUATIONS = (
    "texture", "edges", "pictures", "corners", "segmentation", "flow", "pose", "apex_speed", "fading", "convexity",
)  # fmt: skip
"""Names of the evaluations, in the order of the report: each is a module of this folder, see :class:`Evaluation`."""
BYTES_PER_PIXEL = 52_000
"""Memory of a worker [bytes per pixel]: 50 million events of two seconds, with their ground truth, at 320x240 px."""
UNCALIBRATED = ("apex_speed", "fading", "convexity")
"""Names of the evaluations that need no calibration."""


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
        """Return the paper's claims, and checks of their robustness, with the verdicts that follow from the results.

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
STREAM_COLOURS: dict[str, str] = {
    Stream.PLAIN: BLUE,
    Stream.SAME_COUNT: SKY_BLUE,
    Stream.TRUE: GREEN,
    Stream.CALIBRATED: VERMILION,
    Stream.SELF: PINK,
    Stream.RAW: ORANGE,
    study.Frames.SLOW: "0.75",
    study.Frames.FAST: "0.3",
}
"""Colours of the streams and of the standard cameras, the same in all charts."""
OTHERS = (VERMILION, BLUE, GREEN, ORANGE, PINK, SKY_BLUE, BLACK, GREY)
"""Colours of other series, in their order."""
CHANCE = "chance"
"""Name of the level of chance."""
REFERENCE_COLOURS = {CHANCE: GREY, "zero flow": GREY, "truth": BLACK}
"""Colours of the levels of chance and of predicting nothing, and of the truth, next to the streams."""
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
    (_bars if chart.kind is study.ChartKind.BARS else _lines)(ax, chart, by)
    for (label, value), dashes in zip(chart.marks.items(), ("--", ":", "-."), strict=False):
        ax.axhline(value, color="0.35", linestyle=dashes, linewidth=0.9, label=label)
    if chart.log_x:
        ax.set_xscale("log")
    if chart.log_y:
        ax.set_yscale("log")
    if chart.kind is study.ChartKind.LINES:
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
    return STREAM_COLOURS.get(str(name), OTHERS[k % len(OTHERS)])


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
    """Claims of the paper, and checks of their robustness, with verdicts."""
    tables: list[Table]
    """Tables."""
    pictures: list[study.Picture]
    """Pictures and films."""
    cells: int
    """Number of cells."""
    errors: list[str]
    """Messages of cells that failed."""
    processor_s: float
    """Processor time of the measures [s]."""


def section(name: str, results: Sequence[CellResult]) -> Section:
    """Return the section of an evaluation from the results of its cells."""
    evaluation = load(name)
    good = [r for r in results if not r.error]
    errors = [f"{r.condition.text}: {r.error}" for r in results if r.error]
    shown = evaluation.tables(good) if good else []
    pictures: list[study.Picture] = getattr(evaluation, "pictures", lambda _: [])(good)
    return Section(
        name, evaluation.TITLE, evaluation.PROTOCOL, evaluation.DIFFERENCES, evaluation.claims(good), shown,
        pictures, len(results), errors, sum(r.processor_s for r in results),
    )  # fmt: skip


def write(out: Path, sections: Sequence[Section], settings: Settings, processor_s: float) -> dict[str, Path]:
    """Write the report, its tables and its figures to a folder, and return the main files."""
    for folder in ("tables", "figures"):
        make_folder(out / folder)
    figures: dict[str, Figure] = {}
    for table in (t for s in sections for t in s.tables):
        write_csv(out / "tables" / f"{table.name}.csv", table.columns, table.rows)
        if (figure := draw(table)) is not None:
            figures[table.name] = figure
            for kind in ("png", "pdf"):
                save(figure, out / "figures" / f"{table.name}.{kind}")
    films = {p.name: _encode(p) for s in sections for p in s.pictures}
    for picture in (p for s in sections for p in s.pictures):
        with NewFile(out / "figures" / f"{picture.name}.{_kind(picture)}") as new:
            new.part.write_bytes(films[picture.name])
    counts = {"cells": sum(s.cells for s in sections), "failed": sum(len(s.errors) for s in sections)}
    about = _about(settings, processor_s) | counts
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
    return {**data, "claims": [asdict(c) | {"paper": c.paper} for c in one.claims], "tables": tables}


def _kind(picture: study.Picture) -> str:
    return "gif" if len(picture.frames) > 1 else "png"


def _encode(picture: study.Picture) -> bytes:
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
    jinja2 = study.library("jinja2")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    images = {name: _data("image/svg+xml", to_svg(figure)) for name, figure in figures.items()}
    kinds = {p.name: _kind(p) for s in sections for p in s.pictures}
    images |= {name: _data(f"image/{kinds[name]}", data) for name, data in films.items()}
    compact = {t.name: pivoted(t) for s in sections for t in s.tables if not t.long}
    claims = {n: (paper, [c for s in sections for c in s.claims if c.number == n]) for n, paper in PAPER.items()}
    template = environment.get_template("report.html.j2")
    return str(template.render(sections=sections, claims=claims, images=images, compact=compact, about=about))


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


# Run on local processes or a cluster. A cell is one evaluation under one condition. Each is a file, so that a stopped
# run can be continued.

FORMAT = 5
"""Version of the files of cells, and of the streams and measures that all evaluations share."""


@dataclass(frozen=True)
class Job:
    """Evaluations of one condition, which share its simulation."""

    condition: Condition | study.RecordedCondition
    """Condition."""
    evaluations: tuple[str, ...]
    """Names of the evaluations."""
    settings: Settings
    """Size of the run."""
    threads: int | None = None
    """Number of CPU threads; None for all."""
    setup: study.Setup | None = None
    """What is known of the prism from another recording; None if that is not needed."""

    @property
    def setup_condition(self) -> Condition | None:
        """Condition of the recording that the prism is calibrated from, if an evaluation needs that."""
        needed = isinstance(self.condition, Condition) and not set(self.evaluations) <= set(UNCALIBRATED)
        return self.condition.setup if needed and isinstance(self.condition, Condition) else None


@dataclass(frozen=True)
class JobResult:
    """Results of a job."""

    cells: list[CellResult]
    """Result of each evaluation."""
    processor_s: float
    """Processor time of the whole job [s]."""


def run_job(job: Job) -> JobResult:
    """Run the evaluations of a job, and release their memory, which a worker would otherwise keep for long."""
    began = time.process_time()
    cells = _run_cells(job)
    release_memory()
    return JobResult(cells, time.process_time() - began)


def failed(job: Job, message: str) -> list[CellResult]:
    """Return the results of a job's evaluations that failed for one reason."""
    return [CellResult(name, job.condition, error=message) for name in job.evaluations]


def _run_cells(job: Job) -> list[CellResult]:
    """Simulate the condition of a job once, or open its recording, and run its evaluations."""
    with limited_cpu_threads(job.threads), limited_opencv(study.library("cv2"), cpu_threads()):
        try:
            if isinstance(job.condition, Condition):
                streams: study.RecordedStreams = study.Streams(job.condition, job.settings.device, job.setup)
            else:
                streams = study.RecordedStreams(open_recording(job.condition.path), job.settings.device)
            return [_run_cell(name, streams, job) for name in job.evaluations]
        except Exception as error:  # whatever one recording raises must not stop the others
            return failed(job, failure_text(error))


def run_setup(job: Job) -> tuple[study.Setup, float]:
    """Return what is known of the prism of a job from one recording of it, and the processor time [s]."""
    began = time.process_time()
    assert job.setup_condition is not None
    with limited_cpu_threads(job.threads):
        found = study.known_setup(job.setup_condition, job.settings.device)
    release_memory()
    return found, time.process_time() - began


def compile_kernels(names: Sequence[str], device: str) -> float:
    """Compile the kernels of evaluations, which else each worker would compile. Return the processor time [s]."""
    began = time.process_time()
    for name in names:
        load(name)
    load_all(device)
    if device == "cpu":
        load_kernels(EXACT_KERNELS, device)
    return time.process_time() - began


def _run_cell(name: str, streams: study.RecordedStreams, job: Job) -> CellResult:
    """Run one evaluation. An error of any kind, such as a refused calibration, becomes its result."""
    began = time.process_time()
    try:
        values, error = _as_stored(name, load(name).measure(streams, job.settings)), ""
    except Exception as raised:
        values, error = {}, failure_text(raised)
    return CellResult(name, job.condition, values, error, time.process_time() - began)


def _as_stored(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of an evaluation as their cell will give them; numbers that are not finite become None."""
    plain = json.loads(json.dumps(values), parse_constant=lambda word: None)
    return value_of(load(name).Values, plain, f"values of {name}")


class Store(CellStore):
    """Folder of the cells of evaluations."""

    @staticmethod
    def _name(name: str, condition: Condition | study.RecordedCondition, settings: Settings) -> str:
        return f"{name}_{'quick' if settings.quick else 'full'}_{condition.key}.json"

    @staticmethod
    def _version(name: str, condition: Condition | study.RecordedCondition, settings: Settings) -> list[Any]:
        """Return all that a cell depends on: its condition, versions, settings and the kind of device.

        Seeds are left out, so that a run with more of them keeps its cells; the first one is shown in pictures.
        """
        size = asdict(settings) | {"device": settings.device.partition(":")[0]}
        del size["seeds"]
        return [FORMAT, __version__, load(name).VERSION, size, condition.key]

    def load(self, name: str, condition: Condition | study.RecordedCondition, settings: Settings) -> CellResult | None:
        """Return a stored cell; None if it is missing, damaged, or of another version, other settings or a device."""

        def make(data: dict[str, Any]) -> CellResult | None:
            fields_of(data, "", "version", "condition", "values", "error", "processor_s")
            if data["version"] != self._version(name, condition, settings):
                return None
            error, seconds = value_of(str, data["error"], "error"), real(data["processor_s"], "processor_s", 0.0, 1e9)
            values = {} if error else value_of(load(name).Values, data["values"], "values")
            return CellResult(name, condition, values, error, seconds)

        return self.read(self._name(name, condition, settings), make)

    def save(self, cell: CellResult, settings: Settings) -> None:
        """Write a cell."""
        condition = {name: str(v) if isinstance(v, Path) else v for name, v in asdict(cell.condition).items()}
        self.write(self._name(cell.evaluation, cell.condition, settings), {
            "version": self._version(cell.evaluation, cell.condition, settings),
            "condition": condition,
            "values": cell.values,
            "error": cell.error,
            "processor_s": cell.processor_s,
        })  # fmt: skip


def plan(names: Sequence[str], settings: Settings, recordings: Iterable[Path], *, worlds: bool = True) -> list[Job]:
    """Return one job for each condition and each recording, with all evaluations that need it.

    Without ``worlds`` there are only the recordings.
    """
    by: dict[Condition | study.RecordedCondition, list[str]] = {}
    for name in names:
        evaluation = load(name)
        for condition in evaluation.conditions(settings) if worlds else ():
            by.setdefault(condition, []).append(name)
        for path in () if evaluation.NEEDS_TRUTH else recordings:
            by.setdefault(study.RecordedCondition(path), []).append(name)
    return [Job(condition, tuple(evaluations), settings) for condition, evaluations in by.items()]


@guarded
@dataclass(frozen=True)
class EvaluationSummary:
    """What :func:`evaluate` did.

    Examples
    --------
    >>> summary = amiwarp.EvaluationSummary(
    ...     cells=4, new_cells=1, failed=0, verdicts={"reproduced": 3}, files={}, seconds=2.0, processor_seconds=3.0)
    >>> summary.verdicts["reproduced"]
    3
    """

    cells: int
    """Number of cells: evaluations under a condition, with a seed."""
    new_cells: int
    """Number of cells that were run; the others were there already."""
    failed: int
    """Number of cells that ended with an error, which the report states. The next call runs them again."""
    verdicts: dict[str, int]
    """Number of tested parts of the paper's claims, by the verdict on them."""
    files: dict[str, Path]
    """Files of the report, ``report`` and ``data``."""
    seconds: float
    """Elapsed time [s]."""
    processor_seconds: float
    """Processor time of all workers [s]."""
    damaged: tuple[str, ...] = ()
    """What was wrong with each damaged cell, which was run again."""
    failures: Mapping[str, str] = field(default_factory=dict)
    """Error message of each cell that failed, by its evaluation and condition."""


@guarded
def evaluate(
    out: str | Path,
    *,
    only: Sequence[str] = (),
    full: bool = False,
    seeds: int | None = None,
    recordings: Sequence[str | Path] = (),
    scheduler: str | None = None,
    workers: int | None = None,
    device: str = "cpu",
    seed: int = 0,
    progress: Progress | None = None,
) -> EvaluationSummary:
    """Evaluate the AMI-EV against a plain event camera as its paper does, and write a report.

    Finished cells in ``out`` are kept: the same call continues a stopped run. A cell that fails is reported, and does
    not stop the others; the same call runs it again.

    Parameters
    ----------
    out : str or Path
        Folder for the report, its tables and figures, and the cells.
    only : sequence of str, optional
        Names of the evaluations, by default all.
    full : bool, optional
        Run the full study: 320×240, ten seeds, all values. By default the run is quick: 240×180, two seeds.
    seeds : int, optional
        Number of seeds instead.
    recordings : sequence of str or Path, optional
        Recordings on which to run the evaluations that need no ground truth. Without names in ``only``, nothing else is
        run then.
    scheduler : str, optional
        Address of a Dask scheduler. By default the work is done on this machine.
    workers : int, optional
        Number of local processes, by default up to four for each GPU, or one for each core without a GPU, as far
        as the memory goes. With 1 everything runs in this process.
    device : str, optional
        Device of the workers; ``cuda`` for all GPUs.
    seed : int, optional
        Offset of the seeds. With 0 they begin at 1, because settings were chosen with seed 0.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    EvaluationSummary
        Numbers of cells and verdicts, the files, and the time.

    Raises
    ------
    AmiwarpError
        If there is no evaluation of a name, a folder has the name of a cell, or a package is missing.

    Examples
    --------
    >>> amiwarp.evaluate("report", only=["texture"])  # doctest: +SKIP
    """
    began = time.perf_counter()
    settings = study.FULL if full else study.QUICK
    settings = replace(settings, first_seed=settings.first_seed + seed, device=device)
    if seeds is not None:
        settings = replace(settings, seeds=whole(seeds, "seeds", 1, 10_000))
    chosen = only or EVALUATIONS
    jobs = plan(chosen, settings, [Path(r) for r in recordings], worlds=bool(only) or not recordings)
    folder = Path(out)
    make_folder(folder / "cells")
    with only_writer(folder):
        earlier = any((folder / "cells").iterdir())  # an existing report was made from these cells and may be replaced
        for name in () if earlier else REPORT_FILES:
            check_output(folder / name)
        count = worker_count(workers, device, settings.width * settings.height * BYTES_PER_PIXEL)
        if scheduler is None:
            jobs = [replace(job, threads=max(1, cpu_threads() // count)) for job in jobs]
        store = Store(folder / "cells")
        with start_workers("amiwarp evaluate", "evaluate", scheduler, count, device) as there:
            results, new, processor_s = _run(jobs, store, there, progress or silent)
        names = [name for name in EVALUATIONS if any(r.evaluation == name for r in results)]
        sections = [section(name, [r for r in results if r.evaluation == name]) for name in names]
        with contextlib.ExitStack() as stack:
            for own in (folder, folder / "tables", folder / "figures") if earlier else ():
                stack.enter_context(own_folder(own))
            files = write(folder, sections, settings, processor_s)
    verdicts = [claim.verdict.value for s in sections for claim in s.claims if claim.number is not None]
    return EvaluationSummary(
        len(results), new, sum(bool(r.error) for r in results), {v: verdicts.count(v) for v in dict.fromkeys(verdicts)},
        files, time.perf_counter() - began, processor_s, tuple(store.damaged),
        {f"{r.evaluation}, {r.condition.text}": r.error for r in results if r.error},
    )  # fmt: skip


def _run(
    jobs: Sequence[Job], store: Store, workers: Workers, progress: Progress
) -> tuple[list[CellResult], int, float]:
    """Run the missing cells of the jobs, and those that failed before.

    Return all cells, the number of new ones, and the processor time [s]. A cell that fails, or whose worker dies, does
    not stop the others.
    """
    results: list[CellResult] = []
    todo: list[Job] = []
    for job in jobs:
        known = {name: store.load(name, job.condition, job.settings) for name in job.evaluations}
        finished = {name: cell for name, cell in known.items() if cell is not None and not cell.error}
        results += finished.values()
        if missing := tuple(name for name in known if name not in finished):
            todo.append(replace(job, evaluations=missing))
    processor_s, done, new = 0.0, 0, 0
    if len(todo) > 1 and workers.count() > 1:
        progress("compiling kernels", 0.0)
        names = dict.fromkeys(name for job in todo for name in job.evaluations)
        compiling = workers.executor.submit(compile_kernels, tuple(names), todo[0].settings.device)
        # if it fails, each worker compiles its kernels, and the cells say what fails then
        processor_s = compiling.result() if not failure_of(compiling) else 0.0
    setups: dict[Condition | None, study.Setup | None] = {None: None}
    needed = {job.setup_condition: job for job in todo if job.setup_condition is not None}
    share = max(1, workers.count() // max(1, len(needed)))  # they are few, and take the threads of idle workers, too
    first = [replace(job, threads=job.threads and job.threads * share) for job in needed.values()]
    refused: dict[Condition | None, str] = {}
    for begun, calibrated in run_jobs(workers, run_setup, first):
        if message := failure_of(calibrated):
            refused[begun.setup_condition] = f"calibration of the prism: {message}"
            continue
        setups[begun.setup_condition], seconds = calibrated.result()
        processor_s += seconds
        progress(f"calibrated {len(setups) - 1} of {len(needed)} prisms", 0.0)
    todo, lost = _without_setups(todo, refused)
    for job, message in lost:
        results += _kept(failed(job, message), job, store)
        new += len(job.evaluations)
    todo = [replace(job, setup=setups[job.setup_condition]) for job in todo]
    with contextlib.closing(run_jobs(workers, run_job, todo)) as running:
        for job, future in running:
            message = failure_of(future)
            result = JobResult(failed(job, message), 0.0) if message else future.result()
            results += _kept(result.cells, job, store)
            processor_s, done, new = processor_s + result.processor_s, done + 1, new + len(result.cells)
            progress(f"{done:,} of {len(todo):,} recordings", done / len(todo))
    order = {(job.condition, name): k for k, job in enumerate(jobs) for name in job.evaluations}
    return sorted(results, key=lambda r: order[r.condition, r.evaluation]), new, processor_s


def _without_setups(
    jobs: Sequence[Job], refused: Mapping[Condition | None, str]
) -> tuple[list[Job], list[tuple[Job, str]]]:
    """Return the jobs that can be run although the calibration of some prisms failed, and the others with the reason.

    A job is divided if some of its evaluations need no calibration.
    """
    able, lost = list[Job](), list[tuple[Job, str]]()
    for job in jobs:
        if job.setup_condition not in refused:
            able.append(job)
            continue
        without = tuple(name for name in job.evaluations if name in UNCALIBRATED)
        needing = tuple(name for name in job.evaluations if name not in UNCALIBRATED)
        lost.append((replace(job, evaluations=needing), refused[job.setup_condition]))
        if without:
            able.append(replace(job, evaluations=without))
    return able, lost


def _kept(cells: list[CellResult], job: Job, store: Store) -> list[CellResult]:
    """Return new results of a job after writing them to the store."""
    for cell in cells:
        store.save(cell, job.settings)
    return cells
