"""Cell of the stability study: a condition, a seed, and the result of each calibration method on that recording."""

import contextlib
import enum
import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache, partial
from typing import Annotated, Any

import numpy as np
from scipy.optimize import minimize

from amiwarp._version import __version__
from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.calib.model_choice import Places
from amiwarp.calib.paper_method import calibrate_as_paper
from amiwarp.calib.parameters import build_model
from amiwarp.calib.presets import settings_to
from amiwarp.calib.settings import AUTO, STAGES
from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import model_error
from amiwarp.io.json_files import CellStore, build, fields_of, value_of
from amiwarp.optics.models import ExactModel, predicted_error
from amiwarp.progress import Progress
from amiwarp.studies.cluster import Workers, machine, result_of, run_jobs
from amiwarp.studies.stability.conditions import AXES, Axis, Condition, SimulatedSample, make
from amiwarp.validation import instance, real, whole

LIMIT_PX = 0.1
"""Largest model error of a successful calibration [px rms], unless the model's best fit to the truth has a large error
itself."""
BEST_FIT = 1.5
"""Multiple of the error of the model's best fit to the truth that a successful calibration may have."""
JUDGED = 5_000
"""Number of events at which the error of a smaller model is measured: enough for an rms error accurate to 1 %."""
LARGEST_PX = 1e3
"""Largest model error that is stored [px rms]; that of a model without a valid position anywhere is this too."""
MOST_DEVIATION = 1e9
"""Largest stored distance of the apex angle from the true one [standard deviations]."""
FORMAT = 3
"""Version of the file format of a stored cell, which is part of the cell's identity."""


class Outcome(enum.StrEnum):
    """Outcome of one calibration."""

    SUCCESS = "success"
    REFUSAL = "refusal"
    """Refusal: the method raised an error that names the cause."""
    SILENT = "silent failure"
    """Silent failure: the result is wrong and there was no error. A crash counts as a silent failure too."""


@dataclass(frozen=True)
class Method:
    """Calibration method. Without settings it is the paper's method."""

    name: str
    """Name of the method in reports."""
    settings: Settings | None
    """Settings of the calibration; None for the paper's method."""

    @property
    def model(self) -> str:
        """Name of the largest refraction model that the result can have."""
        if self.settings is None:
            return "circle"
        return "exact" if self.settings.model == AUTO else self.settings.model

    @property
    def identity(self) -> dict[str, Any]:
        """Settings that identify the method, as JSON data."""
        return (
            {"method": "paper"}
            if self.settings is None
            else settings_to(self.settings) | {"sharpness": self.settings.sharpness.value}
        )

    def run(self, sample: SimulatedSample, condition: Condition, seed: int, device: str) -> Calibration:
        """Calibrate a sample. Raises :class:`AmiwarpError` if the method refuses it."""
        if self.settings is None:
            return calibrate_as_paper(sample.recording, start=sample.hardware, device=device)
        known = sample.hardware if condition.start != "none" else {}
        return calibrate(sample.recording, replace(self.settings, seed=seed, start=known), device=device)


_SHARP = Settings(model="exact", stages=STAGES[:1])
METHODS = (
    Method("default", Settings()),
    Method("paper", None),
    Method("sharpness", _SHARP),
    Method("circle", Settings(model="circle")),
    Method("gradient", replace(_SHARP, sharpness=Sharpness.GRADIENT)),
    Method("entropy", replace(_SHARP, sharpness=Sharpness.ENTROPY)),
    Method("J by DIRECT", replace(_SHARP, sharpness=Sharpness.PAPER_J)),
    Method("CRS + Sbplx", replace(_SHARP, global_algorithm="GN_CRS2_LM", local_algorithm="LN_SBPLX")),
)
"""All methods of the study: sharpness measures, models and algorithms, with and without the photometric stage.

The paper's method and the default are always run.
"""


@dataclass(frozen=True)
class Result:
    """Result of one calibration method on one recording."""

    outcome: Outcome
    """Outcome: success, refusal or silent failure."""
    error_px: Annotated[float, partial(real, low=0.0, high=LARGEST_PX)] | None
    """Model error relative to the ground truth [px rms]; None if the method refused the recording."""
    limit_px: Annotated[float, partial(real, low=0.0, high=LARGEST_PX)]
    """Largest model error with which this calibration counts as a success [px rms]."""
    seconds: Annotated[float, partial(real, low=0.0, high=1e9)]
    """Run time of the calibration [s]."""
    message: str = ""
    """Error message of a refusal, or warnings of the calibration."""
    machine: str = ""
    """Description of the machine that ran the calibration."""
    deviation: Annotated[float, partial(real, low=0.0, high=MOST_DEVIATION)] | None = None
    """Distance of the apex angle from the true one, in standard deviations that the calibration states; None for a
    circle and for a refused recording."""

    def __post_init__(self) -> None:
        """Raise :class:`AmiwarpError` for an outcome that does not follow from the error."""
        within = self.error_px is not None and self.error_px <= self.limit_px
        if within != (self.outcome is Outcome.SUCCESS) or (
            self.outcome is Outcome.REFUSAL and self.error_px is not None
        ):
            raise AmiwarpError(f"outcome {self.outcome} does not fit error_px = {self.error_px} and {self.limit_px}")


@dataclass(frozen=True)
class Cell:
    """Condition and seed of one recording of the study."""

    condition: Condition
    """Condition under which the recording is simulated."""
    seed: int
    """Seed of the simulated recording and of the search."""

    @property
    def name(self) -> str:
        """Name of the file of the cell, without its ending."""
        return f"{self.condition.key}_{self.seed}"


@dataclass
class Stored:
    """Known results of the calibration methods for one cell."""

    cell: Cell
    """Cell (condition and seed) to which the results belong."""
    events: int = 0
    """Number of events of the cell's recording."""
    results: dict[str, Result] = field(default_factory=dict)
    """Results by :func:`identity` of the method."""


def identity(method: Method) -> str:
    """Return a text that identifies a method's results by its settings and the package version."""
    text = json.dumps([FORMAT, __version__, method.identity], sort_keys=True, default=str)
    return f"{method.name} {hashlib.sha256(text.encode()).hexdigest()[:8]}"


def run_cell(cell: Cell, methods: tuple[Method, ...], device: str) -> Stored:
    """Simulate the recording of a cell, run the methods on it, and return their results."""
    sample = make(cell.condition, cell.seed, device)
    done = Stored(cell, len(sample.recording.events))
    where = machine(device)
    for method in methods:
        done.results[identity(method)] = replace(_judge(cell, method, sample, device), machine=where)
    return done


def _judge(cell: Cell, method: Method, sample: SimulatedSample, device: str) -> Result:
    """Run one method on a recording, and compare its result with the ground truth."""
    truth = _truth(cell.condition, sample)
    limit = max(LIMIT_PX, BEST_FIT * best_fit(cell.condition, method.model))
    began = time.perf_counter()
    try:
        found = method.run(sample, cell.condition, cell.seed, device)
    except AmiwarpError as error:
        return Result(Outcome.REFUSAL, None, limit, time.perf_counter() - began, str(error))
    except Exception as error:  # a crash is no clear error, so it is no refusal
        return Result(Outcome.SILENT, None, limit, time.perf_counter() - began, f"crashed: {error!r}")
    took = time.perf_counter() - began
    error_px = _error_px(found, sample, truth)
    outcome = Outcome.SUCCESS if error_px <= limit else Outcome.SILENT
    return Result(
        outcome, error_px if error_px < LARGEST_PX else LARGEST_PX, limit, took, "; ".join(found.warnings),
        deviation=_deviation(found, cell.condition) if method.model == "exact" else None,
    )  # fmt: skip


def _deviation(found: Calibration, condition: Condition) -> float | None:
    """Return the distance of the apex angle from the true one [standard deviations]; None if none is stated."""
    exact = found.exact
    std = exact.uncertainty.get("apex", 0.0)
    return min(abs(exact.parameters["apex"] - condition.prism.apex) / std, MOST_DEVIATION) if std > 0.0 else None


def _error_px(found: Calibration, sample: SimulatedSample, truth: ExactModel) -> float:
    """Return the model error over the image [px rms].

    If a smaller model was selected because it suffices at the events' positions, the error is that at these positions.
    """
    if found.ladder is not None and found.model_name != "exact":
        recording = sample.recording
        assert recording.encoder is not None
        events = recording.events.slice(0, len(recording.events))
        return Places.of(events, recording.encoder, JUDGED).distance(found.model, truth, remove_lag=True)
    try:
        return model_error(found.model, truth).rms
    except AmiwarpError:
        return math.inf


def _truth(condition: Condition, sample: SimulatedSample) -> ExactModel:
    """Return the optical model with the true parameters of a simulated recording."""
    assert sample.recording.truth is not None
    return ExactModel(condition.camera, condition.prism, sample.recording.truth.parameters["phase"])


@cache
def best_fit(condition: Condition, model: str) -> float:
    """Return the error of the best fit of ``model`` to the true model [px rms].

    It is 0 for the exact model: a wrong camera or prism that the recording states is no excuse.
    """
    if model != "circle":
        return 0.0
    truth = ExactModel(condition.camera, condition.prism)

    def error(v: np.ndarray[Any, np.dtype[np.float64]]) -> float:
        values = {"deflection": condition.prism.deflection * abs(float(v[0])), "phase": float(v[1])}
        fitted = build_model(model, condition.camera, condition.prism, values)
        return predicted_error(fitted, truth, grid=8).rms

    return float(minimize(error, [1.0, 0.0], method="Nelder-Mead", options={"maxfev": 80}).fun)


class Store(CellStore):
    """Folder of stored cells. A cell is written when it finishes, and is not run again."""

    def load(self, cell: Cell) -> Stored:
        """Return the known results of ``cell``; none if its file is missing or damaged."""
        known = self._load(f"{cell.name}.json")
        return Stored(cell) if known is None or known.cell != cell else known

    def load_all(self) -> list[Stored]:
        """Return all cells of the folder; damaged ones and those of other versions are left out."""
        found = (self._load(path.name) for path in sorted(self.folder.glob("*.json")))
        return [known for known in found if known is not None]

    def _load(self, name: str) -> Stored | None:
        """Return the cell of a file; None if it is missing, damaged, of another version or renamed."""

        def make(data: dict[str, Any]) -> Stored | None:
            fields_of(data, "", "format", "condition", "seed", "events", "results")
            if data["format"] != FORMAT:
                return None
            condition = instance(data["condition"], dict, "field condition")
            if not condition.keys() <= {f.name for f in fields(Condition)}:
                return None  # a version with other fields wrote it
            cell = Cell(build(Condition, condition, "condition"), whole(data["seed"], "field seed", 0, 2**31))
            events = whole(data["events"], "field events", 0, 10**12)
            results = value_of(dict[str, Result], data["results"], "results")
            return Stored(cell, events, results) if f"{cell.name}.json" == name else None

        return self.read(name, make)

    def save(self, known: Stored) -> None:
        """Write all known results of a cell."""
        self.write(f"{known.cell.name}.json", {
            "format": FORMAT, "condition": asdict(known.cell.condition), "seed": known.cell.seed,
            "events": known.events, "results": {name: asdict(r) for name, r in sorted(known.results.items())},
        })  # fmt: skip


QUICK_METHODS = ("default", "paper", "sharpness")
"""Names of the methods of a quick run."""


def quick_axes() -> tuple[Axis, ...]:
    """Return each axis with at most three values: both ends and the middle."""
    return tuple(
        replace(a, values=tuple(dict.fromkeys(a.values[i] for i in (0, len(a.values) // 2, -1))))
        for a in AXES
        if a.name != "many events"
    )


def conditions(axes: Sequence[Axis]) -> list[Condition]:
    """Return every condition of the axes once; all axes share the condition with default values."""
    return list(dict.fromkeys(c for axis in axes for c in axis.conditions()))


def run(
    axes: Sequence[Axis],
    seeds: int,
    methods: Sequence[Method],
    store: Store,
    workers: Workers,
    *,
    device: str = "cpu",
    first: int = 0,
    progress: Progress | None = None,
    until: Callable[[], bool] | None = None,
) -> list[Stored]:
    """Run all cells (conditions and seeds) of the axes, and return their results.

    Cells in ``store`` are reused; if a cell lacks a method, only that method is run. Seeds begin at ``first``. The
    seed is the outer loop: an interrupted run covers every condition, with fewer seeds. No new cell starts after
    ``until`` returns True.
    """
    cells = [Cell(c, seed) for seed in range(first, first + seeds) for c in conditions(axes)]
    known = {cell: store.load(cell) for cell in cells}
    missing = {cell: tuple(m for m in methods if identity(m) not in known[cell].results) for cell in cells}
    todo = [(cell, lacking) for cell, lacking in missing.items() if lacking]
    done = len(cells) - len(todo)
    with contextlib.closing(run_jobs(workers, partial(_run_missing, device), todo)) as running:
        for (cell, _), future in running:
            found = result_of(future)
            known[cell] = replace(found, results={**known[cell].results, **found.results})
            store.save(known[cell])
            done += 1
            if progress is not None:
                progress(f"{done:,} of {len(cells):,} cells", done / len(cells))
            if until is not None and until():
                break
    return [known[cell] for cell in cells]


def _run_missing(device: str, job: tuple[Cell, tuple[Method, ...]]) -> Stored:
    """Run the methods that a cell lacks."""
    return run_cell(*job, device)


def chosen(names: Sequence[str] = ()) -> tuple[Method, ...]:
    """Return methods by their names; the default and the paper's method are always included."""
    return tuple(m for m in METHODS if not names or m.name in (*names, "default", "paper"))
