"""Speed-error charts of compensation and calibration: measured on one recording, written as figures, JSON and CSV."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.calib.presets import Preset
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.imaging.iwe import TURNS
from amiwarp.imaging.palette import BLACK, BLUE, GREEN, MODEL_COLOURS, ORANGE, PINK, SKY_BLUE, VERMILION
from amiwarp.io.files import check_output, read_text, write_csv, write_text
from amiwarp.io.formats import make_folder
from amiwarp.optics.models import MODELS, rungs
from amiwarp.plotting import figures
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.studies.chart import measurement
from amiwarp.studies.chart.measurement import KnownRecording, Row
from amiwarp.studies.cluster import machine, versions
from amiwarp.studies.demo import Demo, simulation
from amiwarp.tasks import Progress, part, silent

# Drawing of the speed-error charts as PNG and SVG.
#
# Each measured setting (row) is a point. The rows on the Pareto fronts are numbered and listed below.

WIDTH, PANEL, LEFT, RIGHT, BETWEEN = 11.0, 4.4, 0.85, 0.3, 0.3
"""Figure width, panel height, left and right margins, and gap between panels [inch]."""
TITLE, AXIS, LINE, KEY, NOTE = 0.42, 0.82, 0.225, 0.2, 0.42
"""Heights of the title above a panel, of the axis below it, of a line of the list, of a line of the legend, and of the
note [inch]."""
COLUMNS = 5
"""Number of columns of the legend."""
LETTERS, SMALL, TINY = 12.5, 10.5, 9.5
"""Font sizes of the chart [point], legible when the figure is shown at two thirds of its size."""
QUANTISATION, PAPER = 0.29, (1.5, 2.0)
"""Rounding error of a pixel along one axis, and range of the error that the paper reports [px]."""
COLOURS = {
    **dict(zip(sorted(rungs(), key=lambda name: not MODELS[name].SIMPLIFIES), MODEL_COLOURS, strict=False)),
    "other libraries": "#6b6b6b",
    "default": BLACK, "model": ORANGE, "algorithms": BLUE, "events": GREEN, "folding": PINK, "pairs": SKY_BLUE,
    "events and pairs": VERMILION,
}  # fmt: skip
"""Colour of each family of settings in the charts."""
WORDS = {**{name: model.TEXT for name, model in rungs().items()}, "default": "all settings default",
         "other libraries": "other libraries (circle)"}  # fmt: skip
"""Legend text of the families whose text differs from the name."""
MARKS = {
    "bilinear": "o", "nearest": "s", "share of events": "^", "file to file": "D", "NumPy": "x", "Numba": "+",
    "PyTorch": "*", "CuPy": "P", "both stages": "o", "sharpness alone": "s", "with a guess": "^",
}  # fmt: skip
"""Marker of each kind of measured setting."""
HOLLOW, THIN = ("share of events", "with a guess"), "x+"
"""Kinds of settings with hollow markers, and markers without area."""
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

    def __init__(self, ax: Any, rows: Sequence[Row], limits: tuple[float, float], errors: tuple[float, float]) -> None:
        from matplotlib.transforms import Bbox

        self.ax, self.timed = ax, rows[0].chart == "calibration"
        self.unit = ax.figure.dpi / 72.0
        ax.set(xscale="log", yscale="log", xlim=limits, ylim=errors)
        figures.number_logarithmic(ax.xaxis, ax.yaxis)
        ax.tick_params(which="both", labelsize=SMALL)
        ax.tick_params(axis="x", which="both", pad=8.0)  # keeps clear of the lowest number of the other axis
        ax.grid(True, color="#e4e4e4", linewidth=0.8)
        ax.set_axisbelow(True)
        ax.axhspan(*PAPER, color="#bdbdbd", alpha=0.55, linewidth=0)
        ax.axhline(QUANTISATION, color="#555555", linestyle=":", linewidth=1.4)
        ax.set_xlabel("time of a calibration [ms]" if self.timed else "speed [million events/s]", fontsize=LETTERS)
        self.rows = [row for row in rows if limits[0] < _across(row) < limits[1]]
        self.points: list[Any] = []
        self.lines: list[Any] = []
        self.letters: list[Any] = []
        for row in sorted(self.rows, key=lambda r: r.default):
            half = (8.5 if row.default else 5.0) * self.unit
            self.points.append(Bbox([self.at(row) - half, self.at(row) + half]))
            self._point(row)

    def at(self, row: Row) -> Any:
        """Return the position of a row's point [screen px]."""
        return self.ax.transData.transform((_across(row), row.error_px))

    def _point(self, row: Row) -> None:
        """Draw the point of a measured setting."""
        colour, mark = COLOURS[row.family], MARKS[row.mark]
        size = 5.0 if row.settings.get("angles", TURNS) < TURNS else 12.0 if mark == "*" else 8.5
        lines = row.mark in HOLLOW or mark in THIN
        place = ([_across(row)], [row.error_px])
        self.ax.plot(*place, mark, markersize=size, markerfacecolor="none" if row.mark in HOLLOW else colour,
                     markeredgecolor=colour if lines else "white", markeredgewidth=1.8 if lines else 0.5,
                     zorder=3)  # fmt: skip
        if row.default:
            self.ax.plot(*place, "o", markersize=16, markerfacecolor="none", markeredgecolor="black",
                         markeredgewidth=1.6, zorder=4)  # fmt: skip

    def step(self, chosen: list[Row], style: Any) -> None:
        """Draw a Pareto front as steps: the smallest error that each time budget allows."""
        from matplotlib.transforms import Bbox

        # fastest first, so errors fall along the list; no row is faster than the first or more accurate than the last
        x, y = [_across(row) for row in chosen], [row.error_px for row in chosen]
        x, y = [x[0], *x, self.ax.get_xlim()[self.timed]], [self.ax.get_ylim()[1], *y, y[-1]]
        corners = np.column_stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]])
        self.ax.plot(*corners.T, color="black", linewidth=1.1, linestyle=style, zorder=2)
        ends = itertools.pairwise(self.ax.transData.transform(corners))
        self.lines += [Bbox([np.minimum(a, b) - 1.5, np.maximum(a, b) + 1.5]) for a, b in ends]

    def write(self, text: str, row: Row, **style: Any) -> None:
        """Write a label near a point, where it covers neither points nor other labels."""
        from matplotlib.patheffects import withStroke
        from matplotlib.text import Text
        from matplotlib.transforms import Bbox

        here = self.at(row)
        label = self.ax.annotate(
            text, (_across(row), row.error_px), (0.0, 0.0), zorder=5, textcoords="offset points", ha="center",
            va="center", path_effects=[withStroke(linewidth=2.5, foreground="white")],
            arrowprops={"arrowstyle": "-", "linewidth": 0.6, "color": "#707070", "shrinkA": 1.0, "shrinkB": 4.0,
                        "relpos": (0.5, 0.5)}, **style,
        )  # fmt: skip
        half = np.array(Text.get_window_extent(label).size) / 2.0
        near = half + (9.0 if row.default else 5.0) * self.unit
        inner = self.ax.get_window_extent().padded(-3.0)

        def box(spot: Any) -> Any:
            return Bbox([spot - half, spot + half])

        def covered(spot: Any) -> tuple[int, ...]:
            outside = inner.count_contains(box(spot).corners()) < 4
            return outside, *(box(spot).count_overlaps(boxes) for boxes in (self.letters, self.points + self.lines))

        def crosses(spot: Any) -> bool:
            way = here + np.linspace(0.05, 0.95, 19)[:, None] * (spot - here)
            others = [b for b in self.points if not b.contains(*here)]
            return any(b.count_contains(way) for b in [*self.letters, *others])

        spots = [here + np.array(d) * (near + more * self.unit) for more in DISTANCES for d in DIRECTIONS]
        costs = [covered(spot) for spot in spots]
        best = [spot for spot, cost in zip(spots, costs, strict=True) if cost == min(costs)]
        spot = next((s for s in best if not crosses(s)), best[0])
        label.xyann = (spot - here) / self.unit
        self.letters.append(box(spot))
        self.lines.append(Bbox([np.minimum(here, spot), np.maximum(here, spot)]))


def _across(row: Row) -> float:
    """Return the horizontal coordinate of a row: time [ms] or speed [million events/s]."""
    return row.seconds * 1e3 if row.chart == "calibration" else row.mev_per_s


def draw(path: Path, rows: Sequence[Row], title: str, note: str) -> None:
    """Write the chart as ``path`` with the endings .png and .svg; each write is atomic. ``note`` is a line below.

    Raises :class:`ModuleNotFoundError` if Matplotlib or Pillow is missing.
    """
    lines = [(job, chosen, LINES[k % len(LINES)]) for k, (job, chosen) in enumerate(measurement.fronts(rows)) if chosen]
    lists = _numbered(rows, lines)
    keys = _keys(rows, lines)
    listed = LINE * max(len(each) for each in lists)
    titles = TITLE * (1 if rows[0].chart == "calibration" else 1.75)
    height = titles + PANEL + AXIS + listed + KEY * -(-len(keys) // COLUMNS) + NOTE
    figure = figures.blank((WIDTH, height), dpi=150)
    below = height - titles - PANEL
    panels = _panels(figure, rows, below / height)
    for panel in panels:
        for _, chosen, style in lines:
            panel.step(chosen, style)
    figure.text(LEFT / WIDTH, (height - 0.3) / height, title, fontsize=LETTERS + 1.0)

    def closest(row: Row) -> ChartPanel:
        return [panel for panel in panels if row in panel.rows][-1]

    for number, row in (pair for each in lists for pair in each if isinstance(pair[1], Row)):
        if number.isdigit():
            closest(row).write(number, row, fontsize=SMALL, fontweight="bold")
    # from the right, because a name is placed to the right of its point if possible
    for row in sorted(rows, key=lambda r: r.cost):
        if row.family == NAMED:
            name = row.label.removesuffix(" (circle)").replace(" on the", ",")
            closest(row).write(name, row, fontsize=TINY, color=COLOURS[NAMED])
    for k, each in enumerate(lists):
        _list(figure, each, k, below - AXIS)
    figure.legend(handles=keys, loc="upper left", ncols=COLUMNS, frameon=False, fontsize=TINY, handletextpad=0.5,
                  bbox_to_anchor=(LEFT / WIDTH, (below - AXIS - listed - 0.1) / height),
                  borderpad=0.0, borderaxespad=0.2, columnspacing=1.6, labelspacing=0.45)  # fmt: skip
    figure.text(LEFT / WIDTH, 0.08 / height, note, fontsize=TINY, color="#404040")
    figures.save_png_and_svg(figure, path)


def _panels(figure: Any, rows: Sequence[Row], bottom: float) -> list[ChartPanel]:
    """Return a panel of all rows, and for compensation an enlarged panel of the models."""
    errors = [row.error_px for row in rows]
    heights = max(min(errors), 1e-5) / 1.8, max(2.6, max(errors) * 1.6)
    x = [_across(row) for row in rows]
    shown = [(min(x) / 1.4, max(x) * 1.4)]
    timed = rows[0].chart == "calibration"
    if not timed:
        close = [_across(r) for r in rows if r.job == rows[0].job and r.comparable and r.family != NAMED] or x
        shown.append((min(close) / 1.04, max(close) * 1.04))
    sides = {"left": LEFT / WIDTH, "right": 1.0 - RIGHT / WIDTH, "wspace": 0.05, "bottom": bottom,
             "top": bottom + PANEL / figure.get_figheight()}  # fmt: skip
    axes = figure.subplots(1, len(shown), sharey=True, squeeze=False, gridspec_kw=sides)[0]
    panels = [ChartPanel(ax, rows, span, heights) for ax, span in zip(axes, shown, strict=True)]
    axes[0].set_ylabel("model error [px rms]" if timed else "displacement error [px rms]", fontsize=LETTERS)
    if not timed:
        axes[0].axvspan(*shown[1], color="#56b4e9", alpha=0.18, linewidth=0, zorder=0)
        for ax, name in zip(axes, ("all", "shaded part, enlarged"), strict=True):
            ax.set_title(name, fontsize=LETTERS, loc="left")
    return panels


def _numbered(rows: Sequence[Row], lines: Sequence[tuple[str, list[Row], Any]]) -> list[list[tuple[str, Any]]]:
    """Return two columns of list lines: headings, numbered rows of the Pareto fronts, and the default.

    The default is listed separately if it is on no front.
    """
    lists: list[list[tuple[str, Any]]] = []
    numbers = itertools.count(1)
    for job, chosen, _ in lines:
        listed: list[tuple[str, Any]] = [
            ("", job),
            *((str(next(numbers)), row) for row in measurement.told_apart(chosen)),
        ]
        listed += [("–" if measurement.beaten_by(row, rows) else "≈", row)
                   for row in rows if row.default and row.job == job and row not in chosen]  # fmt: skip
        lists.append(listed)
    if len(lists) == 1 and len(lists[0]) > 5:
        (only,) = lists
        half = -(-len(only) // 2) + 1
        lists = [only[:half], [only[0], *only[half:]]]
    return lists


def _list(figure: Any, listed: list[tuple[str, Any]], column: int, top: float) -> None:
    """Write one column of the list below the panels."""
    width = (WIDTH - LEFT - RIGHT - BETWEEN) / 2.0
    left = LEFT + column * (width + BETWEEN)
    unit = "ms" if listed[-1][1].chart == "calibration" else "Mev/s"
    for k, (number, row) in enumerate(listed):
        if isinstance(row, Row):
            label = f"{row.label} (default)" if row.default and row.label != "default" else row.label
            value = _across(row)
            words = (number, label, f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}", _pixels(row.error_px))
            style: dict[str, Any] = {"fontweight": "bold"} if row.default else {}
        else:
            words = ("", f"Pareto front, {row}", unit, "px rms")
            style = {"color": "#404040"}
        y = (top - LINE * (k + 0.75)) / figure.get_figheight()
        places = (left + 0.12, left + 0.22, left + width - 0.85, left + width)
        for x, align, text in zip(places, ("right", "left", "right", "right"), words, strict=True):
            figure.text(x / WIDTH, y, text, ha=align, va="baseline", fontsize=SMALL - 0.5, **style)


def _pixels(error: float) -> str:
    """Return an error [px] as text."""
    return np.format_float_positional(error, precision=3 if error >= 0.001 else 1, fractional=False, trim="-")


def _keys(rows: Sequence[Row], lines: Sequence[tuple[str, list[Row], Any]]) -> list[Any]:
    """Return the entries of the legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def mark(label: str, shape: str, size: float = 7.5, edge: str = "#404040", face: str = "none") -> Any:
        return Line2D([], [], marker=shape, linestyle="none", markersize=size, markerfacecolor=face,
                      markeredgecolor=edge, label=label)  # fmt: skip

    marks = [name for name in MARKS if any(row.mark == name and row.family != NAMED for row in rows)]
    return [
        *(Patch(color=COLOURS[f], label=WORDS.get(f, f)) for f in COLOURS if any(row.family == f for row in rows)),
        *(mark(name, MARKS[name], face="none" if name in HOLLOW else "#404040") for name in marks),
        mark("default of the command", "o", 12, "black"),
        *(Line2D([], [], color="black", linewidth=1.1, linestyle=style,
                 label="Pareto front" if len(lines) == 1 else f"front, {job}") for job, _, style in lines),
        Line2D([], [], color="#555555", linestyle=":", linewidth=1.4, label=f"quantisation {QUANTISATION} px"),
        Patch(color="#bdbdbd", alpha=0.55, label=f"paper {PAPER[0]} to {PAPER[1]} px"),
    ]  # fmt: skip


PACKAGES = ("warp-lang", "numpy", "nlopt", "numba", "torch", "cupy-cuda12x", "cupy-cuda13x")
"""Packages whose versions are recorded with a chart."""
ABOUT = ("format", "version", "date", "machine", "device", "processor", "versions", "recording")
"""Keys of the description of machine and recording in ``chart.json``."""
USUAL, QUICK = (640, 480, 2.0), (320, 240, 0.2)
"""Width [px], height [px] and length [s] of the simulated recording: usual size, and size for a quick run."""
CONTRAST = 0.54
"""Contrast threshold [log intensity] of the simulated sensor. With it the map of the earth gives ten million events in
two seconds."""
REPEATS = {"compensation": 5, "calibration": 45}
"""Number of repeated measurements of each setting, by chart. On the host of a GPU, the time of a calibration may vary
by half between repeats: the ratio of two medians of 45 is then accurate to 1 to 3 %."""


@dataclass(frozen=True)
class Charts:
    """Measured settings (rows) of both charts, and the written files."""

    compensation: tuple[Row, ...]
    """Measured settings of the compensation chart."""
    calibration: tuple[Row, ...]
    """Measured settings of the calibration chart."""
    files: dict[str, Path]
    """Paths of the written files, by name."""
    notes: tuple[str, ...]
    """Notes on settings that could not be measured or were refused."""
    about: dict[str, Any]
    """Description of the machine, the versions, the date and the recording."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """Error of each setting that could not be measured because it failed, by its label."""

    @classmethod
    def load(cls, data: Path) -> Charts:
        """Read ``chart.json``. Raises :class:`AmiwarpError` if it is damaged or another file."""
        names = [f.name for f in fields(Row)]
        try:
            held = json.loads(read_text(data, noted=False))
            rows = {k: tuple(Row(**{n: r[n] for n in names}) for r in held[k]["rows"]) for k in REPEATS}
            about = {name: held[name] for name in ABOUT}
            failed = {str(label): str(error) for label, error in held.get("failed", {}).items()}
        except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
            raise AmiwarpError(
                f"{data}: cannot be read as the data of charts ({error!r}); measure the charts again"
            ) from error
        return cls(rows["compensation"], rows["calibration"], {"data": data}, tuple(held["notes"]), about, failed)

    def draw(self, out: Path) -> Charts:
        """Draw both figures into the folder ``out``; add a note if Matplotlib or Pillow is missing."""
        try:
            measured = [chart for chart in REPEATS if any(chosen for _, chosen in measurement.fronts(self.rows(chart)))]
            files = {name: path for chart in measured for name, path in self._draw(chart, out).items()}
        except ModuleNotFoundError as missing:
            later = "python -m benchmarks.chart --from chart.json --out FOLDER"
            return replace(self, notes=(*self.notes, f"charts: not drawn, {missing}; install it and run: {later}"))
        notes = [f"{chart}: not drawn, no setting was measured" for chart in REPEATS if chart not in measured]
        return replace(self, files=self.files | files, notes=(*self.notes, *notes))

    def rows(self, chart: str) -> tuple[Row, ...]:
        """Return the measured settings of a chart."""
        found: tuple[Row, ...] = getattr(self, chart)
        return found

    def _draw(self, chart: str, out: Path) -> dict[str, Path]:
        """Draw one figure, and return the paths of its files."""
        rows = self.rows(chart)
        events = self.about["recording"]["events"] / 1e6
        title = f"{chart.capitalize()} on {self.about['machine']}: {events:.1f} M events"
        note = _share_note(rows) if chart == "compensation" else _guess_note(rows)
        if self.failed:
            note += f" {len(self.failed)} settings failed: see chart.json."
        draw(out / chart, rows, title, note)
        return _drawn(chart, out)

    def answer(
        self, folder: Path, *, budget_px: float | None = None, budget_ms: float | None = None
    ) -> dict[str, Row | None]:
        """Return for each command the best row within a budget (or None), and write it as a preset to ``folder``.

        ``budget_px`` selects the fastest rows of both commands; ``budget_ms`` the most accurate calibration.
        """
        out: dict[str, Row | None] = {}
        files = [r for r in self.compensation if r.job == measurement.FILE]
        if budget_px is not None:
            out["calibration"] = measurement.fastest_within(self.calibration, budget_px)
            # without whole files, the images give the order of the models
            out["compensation"] = measurement.fastest_within(files or _as_files(self.compensation), budget_px)
        if budget_ms is not None:
            out["calibration"] = measurement.most_accurate_within(self.calibration, budget_ms * 1e-3)
        for kind, row in out.items():
            if row is not None:
                _preset(kind, row).save(folder / f"preset_{kind}.json")
        return out


def _as_files(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of images of events that use all events, all angles and bilinear votes."""
    whole = {"vote": "bilinear", "angles": TURNS, "share": 1.0}
    return [r for r in rows if "library" not in r.settings and all(r.settings[n] == v for n, v in whole.items())]


def _preset(kind: str, row: Row) -> Preset:
    """Return a measured setting as a preset of a command."""
    settings = {n: v for n, v in row.settings.items() if n != "device"}
    if kind == "compensation":
        settings = {"model": settings["model"]}
    return Preset(kind, settings, {"label": row.label, "device": row.settings["device"], **_measured(row)})


def _measured(row: Row) -> dict[str, float]:
    """Return speed and error of a row by name, for its preset."""
    speed = {"ms": row.seconds * 1e3} if row.chart == "calibration" else {"mev_per_s": row.mev_per_s}
    return {**speed, "error_px": row.error_px}


def simulated(
    picture: Path | None = None, *, seed: int = 0, device: str = "cpu", quick: bool = False,
    progress: Progress | None = None,
) -> Recording:  # fmt: skip
    """Simulate the recording of ``amiwarp demo`` in memory, with 24 turns.

    ``picture``: picture of the scene; None for the map of the earth.
    """
    width, height, seconds = QUICK if quick else USUAL
    simulated_scene = simulation(Demo(Path(), picture, width, height, seconds, seed, device))
    if not quick:
        simulated_scene = replace(simulated_scene, sensor=SensorModel(contrast_on=CONTRAST, contrast_off=CONTRAST))
    recording = simulated_scene.run(progress=progress)
    assert recording.truth is not None
    # the charts need no ground truth of single events, which is almost as large as the events
    return replace(recording, truth=replace(recording.truth, stored_points=None, stored_causes=None))


def make(
    recording: Recording,
    out: Path,
    *,
    device: str = "cpu",
    seed: int = 0,
    quick: bool = False,
    libraries: measurement.Libraries | None = None,
    progress: Progress | None = None,
) -> Charts:
    """Measure a recording with ground truth; write both charts and their data into the folder ``out``.

    A setting that fails is named in the results, and does not stop the others. ``quick`` measures a few settings, once
    each. ``libraries`` adds rows of other libraries. Raises
    :class:`AmiwarpError` for a recording without ground truth, a folder that cannot be created or that holds these
    files, and a wrong image.
    """
    known = KnownRecording.of(recording)
    make_folder(out)
    files = {"data": out / "chart.json", "table": out / "chart.csv"}
    for path in (*files.values(), *(path for chart in REPEATS for path in _drawn(chart, out).values())):
        check_output(path)
    report = progress or silent
    failed: dict[str, str] = {}
    repeats = dict.fromkeys(REPEATS, 1) if quick else REPEATS
    compensated, notes = measurement.compensation_rows(
        known,
        device,
        repeats=repeats["compensation"],
        quick=quick,
        folder=out,
        progress=part(report, 0.0, 0.3),
        failed=failed,
        libraries=libraries,
    )
    calibrated, more = measurement.calibration_rows(
        known,
        device,
        repeats=repeats["calibration"],
        quick=quick,
        seed=seed,
        progress=part(report, 0.3, 0.97),
        failed=failed,
    )
    report("drawing", 0.97)
    about = _about(known, device)
    charts = Charts(tuple(compensated), tuple(calibrated), files, (*notes, *more), about, failed)
    # figures come last, because a GPU machine may lack their packages
    write_text(files["data"], json.dumps({**charts.about, **_data(charts)}, indent=1, allow_nan=False) + "\n")
    _write_csv(files["table"], [*compensated, *calibrated])
    return charts.draw(out)


def _drawn(chart: str, out: Path) -> dict[str, Path]:
    """Return the paths of the figures of a chart."""
    return {chart: out / f"{chart}.png", f"{chart} (SVG)": out / f"{chart}.svg"}


def _share_note(rows: Sequence[Row]) -> str:
    """Return the note that is printed below the compensation chart."""
    errors = [f"{100 * r.image_error:.0f} % of its contrast for 1/{round(1 / r.settings['share'])}"
              for r in rows if not r.comparable and r.image_error is not None]  # fmt: skip
    small = "Small markers: fewer angles per turn. " if any(r.settings.get("angles", 0) < TURNS
                                                        for r in rows if "angles" in r.settings) else ""  # fmt: skip
    return f"{small}A share of the events adds noise to the image: {', '.join(errors)}."


def _guess_note(rows: Sequence[Row]) -> str:
    """Return the note that is printed below the calibration chart."""
    text = "Model error: rms over image and turn, without the constant lag."
    guess = round(math.degrees(measurement.GUESS))
    if any(not r.comparable for r in rows):
        text += f" With a guess: the phase is known to {guess}°, so these points are not part of the front."
    return text


def _about(known: KnownRecording, device: str) -> dict[str, Any]:
    """Return the description of the machine and the recording by name."""
    return {
        "format": "amiwarp-chart",
        "version": 1,
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(device),
        "device": device,
        "processor": machine("cpu"),
        "versions": versions(PACKAGES),
        "recording": {"name": known.recording.name, "events": len(known.events), "width": known.camera.width,
                      "height": known.camera.height, "truth": known.recording.truth.parameters
                      if known.recording.truth else {}},
    }  # fmt: skip


def _data(charts: Charts) -> dict[str, Any]:
    """Return as JSON data the rows, those on the Pareto fronts, and rows that are better than a default."""
    out: dict[str, Any] = {"notes": list(charts.notes), "failed": dict(charts.failed)}
    for name in REPEATS:
        rows = charts.rows(name)
        out[name] = {
            "rows": [{**asdict(r), **_measured(r)} for r in rows],
            "fronts": {job: [r.label for r in chosen] for job, chosen in measurement.fronts(rows)},
            "defaults": {
                r.label: {"beaten_by": [b.label for b in measurement.beaten_by(r, rows)]} for r in rows if r.default
            },
        }
    return out


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows as CSV, one line per measured setting. Settings that a row lacks are empty."""
    fixed = ("chart", "job", "label", "default", "on_front", "error_px", "mev_per_s", "ms", "spread",
             "repeats", "image_error")  # fmt: skip
    on = {
        id(r)
        for name in REPEATS
        for _, chosen in measurement.fronts([r for r in rows if r.chart == name])
        for r in chosen
    }
    flat = []
    for r in rows:
        nested = r.settings.get("photometric", {})
        plain = {n: v for n, v in r.settings.items() if n != "photometric"}
        plain |= {f"photometric_{n}": v for n, v in nested.items()}
        if isinstance(plain.get("stages"), list):
            plain["stages"] = "+".join(plain["stages"])
        known = {n: getattr(r, n, None) for n in fixed} | {"on_front": id(r) in on, "ms": r.seconds * 1e3}
        flat.append(known | plain)
    names = dict.fromkeys([*fixed, *(n for line in flat for n in line)])
    write_csv(path, names, ([line.get(name, "") for name in names] for line in flat))
