"""Measurement of the charts of compensation and calibration: each setting with its time and error is a row."""

from __future__ import annotations

import contextlib
import itertools
import math
import random
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.calibration import calibrate
from amiwarp.calib.presets import settings_to, simplified
from amiwarp.calib.result import Calibration
from amiwarp.calib.settings import STAGES, PhotometricSettings, Settings
from amiwarp.choices import Vote
from amiwarp.compensation.recordings import compensate
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.iwe import TURNS, CanvasShape, Image, UploadedEvents, Votes, upload_events
from amiwarp.imaging.metrics import model_error, truth_model
from amiwarp.io import open_recording, save_recording
from amiwarp.io.files import scratch_folder
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import ExactModel, Model, axis_rotation, rungs, wrap_angle
from amiwarp.optics.prism import FlatSide, as_wedge
from amiwarp.studies.failures import failure_text, noted
from amiwarp.tasks import Progress, only_new_garbage, release_memory

# Ground truth of the charts: the recording's true parameters, and the exact model in float64.

MOST_EVENTS = 20_000_000
"""Largest number of events that are taken from the start of the recording, because they are held in memory."""
NEEDED = ("apex", "index", "phase")
"""Parameters that the ground truth must contain."""
PIECE = 1 << 20
"""Number of events that are processed at a time."""


@dataclass(frozen=True, eq=False)
class KnownRecording:
    """Recording in memory with its ground truth."""

    recording: Recording
    """Recording, which is held in memory."""
    events: Events
    """Events of the recording."""
    camera: Camera
    """Camera intrinsics."""
    encoder: Encoder
    """Encoder with the true clock offset."""
    model: ExactModel
    """Optical model with the true parameters."""

    @classmethod
    def of(cls, recording: Recording) -> KnownRecording:
        """Load a recording. Raises :class:`AmiwarpError` if it lacks camera, encoder, prism or ground truth."""
        truth, camera, encoder = recording.truth, recording.camera, recording.encoder
        if truth is None or not set(NEEDED) <= set(truth.parameters):
            raise AmiwarpError(
                f"{recording.name}: has no ground truth (apex, index, phase); create a recording with: amiwarp simulate"
            )
        if camera is None or encoder is None or recording.prism is None:
            raise AmiwarpError(
                f"{recording.name}: lacks camera, encoder or prism; create a recording with: amiwarp simulate"
            )
        events = recording.events.slice(0, MOST_EVENTS)
        if not len(events) or events.x.dtype != np.uint16:
            raise AmiwarpError(
                f"{recording.name}: has no sensor events (uint16); give a recording that is not compensated"
            )
        held = Recording(
            MemoryEvents(events, *recording.events.size), camera, encoder, recording.prism, truth, {}, recording.name
        )
        model = truth_model(camera, truth, as_wedge(recording.prism).flat_side)
        return cls(held, events, camera, encoder.with_clock_offset(truth.parameters.get("clock_offset_us", 0.0)), model)

    def calibration(self) -> Calibration:
        """Return the calibration with the true parameters."""
        model, prism = self.model, self.model.prism
        pairs = {"tilt": model.tilt, "cylinder": model.cylinder, "wobble": model.wobble}
        angles = {f"{name}_{axis}": pair[k] for name, pair in pairs.items() if any(pair) for k, axis in enumerate("xy")}
        values = {"apex": prism.apex, "phase": model.phase, "clock_offset": self.encoder.clock_offset_us, **angles}
        return Calibration(
            model_name="exact", camera=self.camera, prism=prism, parameters=values, uncertainty={}, free=(),
            sharpness_name="variance", sharpness_before=0.0, sharpness_after=0.0, stages=(),
            events=len(self.events), seconds=0.0,
        )  # fmt: skip


def exact_places(model: ExactModel, xy: NDArray[np.float64], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the compensated positions of events [px], in float64; NaN for events without a position.

    ``xy`` (n, 2) [px] are the recorded positions, ``theta`` (n,) [rad] the prism angles. The closed form is that of
    ``docs/explanation/optics.md``. Lens distortion is computed in float32, within 3e-4 px.
    """
    prism, camera = model.prism, model.camera
    axis = axis_rotation(*model.tilt)
    wedge = np.stack([np.cos(theta + model.phase), np.sin(theta + model.phase)], axis=1)
    ray = _tipped(model, _rays(camera, xy) @ axis, wedge, -1.0)
    sine, cosine, w = _local_slope(model, ray, wedge)
    n2 = prism.index**2
    along = sine * np.sum(w * ray[:, :2], axis=1)
    with np.errstate(invalid="ignore"):
        if prism.flat_side is FlatSide.SCENE:
            q = along + cosine * ray[:, 2]
            shift = np.sqrt(n2 - 1.0 + q**2) - q
        else:
            q = along + cosine * np.sqrt(n2 - 1.0 + ray[:, 2] ** 2)
            shift = np.sqrt(1.0 - n2 + q**2) - q
        out = ray[:, :2] + (shift * sine)[:, None] * w
        ahead = np.sqrt(1.0 - np.sum(out**2, axis=1))
    return _pixels(camera, _tipped(model, np.column_stack([out, ahead]), wedge, 1.0) @ axis.T)


def _tipped(
    model: ExactModel, ray: NDArray[np.float64], wedge: NDArray[np.float64], sign: float
) -> NDArray[np.float64]:
    """Return bearing vectors out of the wobbling prism's frame (``sign`` 1), or into it (-1).

    ``wedge`` (n, 2) holds the (cos, sin) of the wedge's azimuths.
    """
    if not any(model.wobble):
        return ray
    from scipy.spatial.transform import Rotation

    x, y = model.wobble
    angle = sign * math.atan(math.hypot(x, y)) / math.hypot(x, y)
    w0, w1 = wedge.T
    turns = np.column_stack([-(x * w1 + y * w0), x * w0 - y * w1, np.zeros(len(ray))])  # z × the direction of the tip
    return np.asarray(Rotation.from_rotvec(angle * turns).apply(ray))


def _local_slope(
    model: ExactModel, ray: NDArray[np.float64], wedge: NDArray[np.float64]
) -> tuple[Any, Any, NDArray[np.float64]]:
    """Return sine and cosine of the apex angle, and its azimuth's (cos, sin), where rays meet the tilted face."""
    apex, (x, y) = model.prism.apex, model.cylinder
    if not (x or y):
        return math.sin(apex), math.cos(apex), wedge
    across = np.column_stack([-wedge[:, 1], wedge[:, 0]])
    t, u = (np.sum(ray[:, :2] * each, axis=1) / ray[:, 2] for each in (wedge, across))
    slope = (math.tan(apex) + x * t + y * u)[:, None] * wedge + (y * t - x * u)[:, None] * across
    steep = np.linalg.norm(slope, axis=1)
    return np.sin(np.arctan(steep)), np.cos(np.arctan(steep)), slope / np.maximum(steep, 1e-300)[:, None]


def _rays(camera: Camera, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit bearing vectors of pixels."""
    if camera.distortion is not None:
        return camera.pixels_to_rays(xy)
    ray = np.column_stack([(xy - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(xy))])
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def _pixels(camera: Camera, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixels of bearing vectors."""
    if camera.distortion is not None:
        return camera.rays_to_pixels(rays)
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent = np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.nan)
    return np.asarray(tangent * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def raw_places(events: Events) -> NDArray[np.float64]:
    """Return the recorded positions of events [px], shape ``(n, 2)``."""
    return np.stack([events.x, events.y], axis=1).astype(np.float64)


def exact_image(known: KnownRecording) -> NDArray[np.float64]:
    """Return the image of all events with bilinear votes at their exact positions, computed in float64.

    The values are numbers of events, shape ``(height, width)``.
    """
    width, height = known.camera.width, known.camera.height
    image = np.zeros((height + 1) * (width + 1) + 1)
    for start in range(0, len(known.events), PIECE):
        piece = known.events[start : start + PIECE]
        places = exact_places(known.model, raw_places(piece), known.encoder.angle_at(piece.t))
        places = places[np.isfinite(places).all(axis=1)]
        low = np.floor(places)
        share = places - low
        for dx in (0, 1):
            for dy in (0, 1):
                at = low + np.array((dx, dy))
                inside = ((at >= 0) & (at < (width, height))).all(axis=1)
                weight = np.abs(1 - dx - share[inside, 0]) * np.abs(1 - dy - share[inside, 1])
                index = (at[inside, 1] * width + at[inside, 0]).astype(np.int64)
                image += np.bincount(index, weight, len(image))
    return image[: width * height].reshape(height, width)


def rms(distance: NDArray[np.float64]) -> float:
    """Return the root mean square length [px] of rows ``(n, 2)``; rows that are not finite are left out."""
    finite = distance[np.isfinite(distance).all(axis=1)]
    if not len(finite):
        raise AmiwarpError(
            "no event has a finite position in both models; check that the ground truth belongs to the recording"
        )
    return float(np.sqrt(np.mean(np.sum(finite**2, axis=1))))


EQUAL_TIME_SHARE = 0.05
"""Relative difference of times below which they are considered equal, because times vary this much between runs."""
CLEARLY_FASTER = 0.7
"""Ratio of times that decides whether to repeat a measurement.

A row cannot reach the Pareto front by repeats if another row takes less than this share of its time and has no larger
error.
"""
EQUAL_ERROR_PX = 0.003
"""Difference of errors below which they are considered equal [px], because another seed of the noise could reverse
their order."""


@dataclass(frozen=True)
class Row:
    """One measured setting, with speed and error of the same run."""

    chart: str
    """Name of the chart: compensation or calibration."""
    job: str
    """Name of the job. Rows of one job do the same work and share one front."""
    label: str
    """Name of the setting in the chart."""
    family: str
    """Family of the setting, shown by the colour of its point."""
    mark: str
    """Kind of the setting, shown by the marker of its point."""
    settings: Mapping[str, Any]
    """Settings of the run, as JSON data."""
    events: int
    """Number of events of the recording, whichever share of them the setting uses."""
    seconds: float
    """Median time of the repeated runs, each divided by how slow the machine was in its round [s]."""
    spread: float
    """Difference of longest and shortest repeat, relative to ``seconds``."""
    repeats: int
    """Number of repeated runs."""
    error_px: float
    """Error of the result [px rms]."""
    image_error: float | None = None
    """Rms difference of the run's image from the float64 image, relative to the standard deviation of the float64
    image; None if the run makes no image."""
    default: bool = False
    """Whether the commands use this setting by default."""
    comparable: bool = True
    """False for settings that add noise or need a guess. These are not part of a Pareto front."""

    @property
    def mev_per_s(self) -> float:
        """Speed [million events of the recording per second]."""
        return self.events / self.seconds / 1e6

    @property
    def cost(self) -> float:
        """Run time per event [s]."""
        return self.seconds / self.events


@dataclass(frozen=True)
class Task:
    """Setting to measure: the function that runs it, and the fields of its row."""

    run: Callable[[], Any]
    """Function to measure; it returns when the device has finished."""
    events: int
    """Number of events that one run processes."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the row that do not depend on the measurement."""
    keep: Callable[[Any], Any] = lambda result: result
    """Function that returns the part of a result to keep; its time does not count."""


@dataclass(frozen=True)
class Timed:
    """Times of a task, and the kept result of its first timed run."""

    task: Task
    """The compensation or calibration that was timed."""
    times: tuple[float, ...]
    """Times of the repeated runs [s]."""
    slowness: tuple[float, ...]
    """How slow the machine was in the round of each run; 1 is usual."""
    result: Any
    """Part of the first timed run's result that was kept."""
    failure: str = ""
    """Error that a run raised, with its place; empty if none did."""

    def row(self, error_px: float, **more: Any) -> Row:
        """Return the row of the measured setting, with its error and further fields."""
        median = statistics.median(t / slow for t, slow in zip(self.times, self.slowness, strict=True))
        spread = (max(self.times) - min(self.times)) / median
        return Row(**self.task.fields, events=self.task.events, seconds=median, spread=spread,
                   repeats=len(self.times), error_px=error_px, **more)  # fmt: skip


@only_new_garbage()
def measure(
    tasks: Sequence[Task],
    repeats: int,
    progress: Progress,
    what: str,
    *,
    warm_up: bool = True,
    limit_s: float = 180.0,
    rest_s: float = 0.0,
    release: bool = False,
    again: Callable[[Sequence[Timed]], Sequence[bool]] | None = None,
) -> list[Timed]:
    """Measure all tasks in rounds, so that a temporary slowdown of the machine affects all of them and can be removed.

    Each timed round after the first has another order, because a run may depend on the one before it.
    A task that raises an error is not run again; the others go on. ``warm_up`` adds an untimed first round, in which
    kernels are compiled. No new round begins after ``limit_s`` [s]. ``rest_s`` [s] is a pause before each run, in which
    threads of the previous run may still be busy. ``again`` decides from tasks that were timed once which of them to
    repeat. Memory that earlier work freed is released first; with ``release`` before each run, for runs that need much
    memory. All runs then start with an equally empty heap.
    """
    release_memory()
    times: list[list[float]] = [[] for _ in tasks]
    results: list[Any] = [None] * len(tasks)
    repeated: Sequence[bool] = [True] * len(tasks)
    failed: dict[int, str] = {}
    first = int(warm_up)  # the first timed round
    rounds, began = repeats + first, time.perf_counter()
    order, rng = list(enumerate(tasks)), random.Random(0)
    for turn in range(rounds):
        if turn > first:
            if time.perf_counter() - began > limit_s:
                break
            if turn == first + 1 and again is not None:
                repeated = again(_timed(tasks, times, results, failed))
            rng.shuffle(order)
        for done, (k, task) in enumerate(order):
            if not repeated[k] or k in failed:
                continue
            if release:
                release_memory()
            time.sleep(rest_s)
            try:
                start = time.perf_counter()
                result = task.run()
                took = time.perf_counter() - start
                if turn == first:
                    results[k] = task.keep(result)
                if turn >= first:
                    times[k].append(took)
            except Exception as error:
                failed[k] = failure_text(error)
            progress(what, (turn * len(tasks) + done + 1) / (rounds * len(tasks)))
    return _timed(tasks, times, results, failed)


def _timed(
    tasks: Sequence[Task], times: list[list[float]], results: list[Any], failed: Mapping[int, str]
) -> list[Timed]:
    """Return the tasks together with their times and results, or with their failures, by the number of the task."""
    slow = slowness([each for k, each in enumerate(times) if k not in failed])
    return [
        Timed(task, (), (), None, failed[k]) if k in failed else Timed(task, tuple(each), slow[: len(each)], result)
        for k, (task, each, result) in enumerate(zip(tasks, times, results, strict=True))
    ]


def slowness(times: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """Return how slow the machine was in each round; 1 is usual.

    ``times``: run times of each task [s]. Tasks that were not repeated in every round do not count. The slowness of a
    round is the median over tasks of the run time relative to the task's median.
    """
    rounds = max(map(len, times), default=0)
    if not rounds:
        return ()
    whole = np.array([each for each in times if len(each) == rounds])
    relative = whole / np.median(whole, axis=1, keepdims=True)
    return tuple(np.median(relative, axis=0).tolist())


def front(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the Pareto front, fastest first: no other row is faster and at least as accurate."""
    best, chosen = float("inf"), []
    for row in sorted((r for r in rows if r.comparable), key=lambda r: (r.cost, r.error_px)):
        if row.error_px < best:
            best = row.error_px
            chosen.append(row)
    return chosen


def fronts(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield the name of each job with the rows on its Pareto front."""
    for job in dict.fromkeys(row.job for row in rows):
        yield job, front([row for row in rows if row.job == job])


def told_apart(chosen: Sequence[Row]) -> list[Row]:
    """Return the rows of a Pareto front that are clearly faster than the next more accurate row, and the default.

    The fastest row comes first.
    """
    kept: list[Row] = []
    for row in reversed(chosen):
        if not kept or row.default or row.cost < kept[-1].cost * (1.0 - EQUAL_TIME_SHARE):
            kept.append(row)
    return kept[::-1]


def beaten_by(row: Row, rows: Sequence[Row]) -> list[Row]:
    """Return rows of the same job that are clearly better than ``row`` in time or error and no worse in the other."""
    out = []
    for other in rows:
        if other.job != row.job or not other.comparable:
            continue
        faster, slower = other.cost < row.cost * (1.0 - EQUAL_TIME_SHARE), other.cost > row.cost
        nearer, further = other.error_px < row.error_px - EQUAL_ERROR_PX, other.error_px > row.error_px
        if (faster and not further) or (nearer and not slower):
            out.append(other)
    return out


def near_front(rows: Sequence[Row | None]) -> list[bool]:
    """Return for each row whether repeated timing may put it on the Pareto front; always True for the default."""
    known = [row for row in rows if row is not None]

    def hopeful(row: Row) -> bool:
        return row.default or all(
            other.cost > row.cost * CLEARLY_FASTER or other.error_px > row.error_px
            for other in known
            if other.comparable
        )

    return [row is not None and hopeful(row) for row in rows]


def fastest_within(rows: Sequence[Row], error_px: float) -> Row | None:
    """Return the fastest row with an error of at most ``error_px`` [px]; of rows of equal time, the most accurate."""
    within = [r for r in rows if r.comparable and r.error_px <= error_px]
    if not within:
        return None
    limit = min(r.cost for r in within) * (1.0 + EQUAL_TIME_SHARE)
    return min((r for r in within if r.cost <= limit), key=lambda r: r.error_px)


def most_accurate_within(rows: Sequence[Row], seconds: float) -> Row | None:
    """Return the most accurate row with a time of at most ``seconds`` [s]; of rows of equal error, the fastest."""
    within = [r for r in rows if r.comparable and r.seconds <= seconds]
    if not within:
        return None
    limit = min(r.error_px for r in within) + EQUAL_ERROR_PX
    return min((r for r in within if r.error_px <= limit), key=lambda r: r.cost)


# Measurement of the calibration chart: models, algorithms, numbers of events, folding of turns, photometric stage.
#
# Folding merges the events of all turns that have the same pixel, polarity
# and bin of the prism angle. Each result is compared with the ground truth.

JOB = "calibration"
"""Name of the job to which all rows of the calibration chart belong."""
SHARP = STAGES[:1]
"""Stages of a calibration that uses sharpness alone."""
EVENTS = (100_000, 300_000, 1_000_000, 10**9)
"""Numbers of events with which the calibration is measured; the last one means all events."""
FOLDS = (1024, 512, 256)
"""Numbers of prism angles per turn to which the events are folded."""
PAIRS = (150_000, 300_000, 600_000, 1_200_000)
"""Numbers of event pairs with which the photometric stage is measured."""
GUESS = math.radians(10.0)
"""Phase error [rad] of the start phase that is given to a search without a global stage."""
PAIRS_OF_ALGORITHMS = (
    ("GN_DIRECT_L", "LN_SBPLX"),
    ("GN_DIRECT_L", "LN_COBYLA"),
    ("GN_DIRECT_L", "LN_NELDERMEAD"),
    ("GN_ORIG_DIRECT_L", "LN_BOBYQA"),
    ("GN_CRS2_LM", "LN_BOBYQA"),
    ("GN_MLSL_LDS", "LN_BOBYQA"),
)
"""Pairs of global and local search algorithm that are measured."""


@dataclass(frozen=True)
class CalibrationSetting:
    """Setting of a calibration that the chart measures."""

    label: str
    """Name of the setting in the chart."""
    family: str
    """Family of the setting, which determines its colour in the chart."""
    settings: Settings
    """Settings of the calibration."""
    comparable: bool = True
    """False if the calibration needs a guess of the phase, so that it cannot be compared with the others."""

    def fields(self, device: str) -> dict[str, Any]:
        """Return the fields of the setting's row that do not depend on the measurement."""
        both = "both stages" if self.settings.stages == STAGES else "sharpness alone"
        plain = settings_to(self.settings)
        return {"chart": "calibration", "job": JOB, "label": self.label, "family": self.family,
                "mark": both if self.comparable else "with a guess", "settings": {**plain, "device": device},
                "default": plain == settings_to(Settings()), "comparable": self.comparable}  # fmt: skip


def calibration_settings(known: KnownRecording, *, quick: bool) -> list[CalibrationSetting]:
    """Return the calibration settings that the chart measures, the default first."""
    if quick:
        few = Settings(events=50_000, global_evaluations=60)
        return [
            CalibrationSetting("default", "default", Settings()),
            CalibrationSetting("50 k events, sharpness", "events", replace(few, stages=SHARP)),
            CalibrationSetting("circle, 50 k events, sharpness", "model", replace(few, model="circle", stages=SHARP)),
        ]
    return [*_stages(known), *_events(), *_folds(), *_algorithms(), *_photometric(), *_mixed()]


def _both(label: str, family: str, s: Settings) -> Iterator[CalibrationSetting]:
    """Yield a setting with both stages of the calibration, and the same setting with sharpness alone."""
    yield CalibrationSetting(label, family, s)
    yield CalibrationSetting(f"{label}, sharpness", family, replace(s, stages=SHARP))


def _stages(known: KnownRecording) -> Iterator[CalibrationSetting]:
    """Yield the default setting, every model, and the local search that starts from a guess."""
    yield from _both("default", "default", Settings())
    for model in rungs():
        yield from _both(model, "model", Settings(model=model))
    guess = Settings(global_algorithm=None, start={"phase": known.model.phase + GUESS})
    for way in _both("local search from a guess", "algorithms", guess):
        yield replace(way, comparable=False)


def _events() -> Iterator[CalibrationSetting]:
    """Yield settings with other numbers of events than the default."""
    for n in EVENTS[:-1]:
        if n != Settings().events:
            name = f"{n // 1000} k" if n < 1_000_000 else f"{n // 1_000_000} M"
            yield from _both(f"{name} events", "events", Settings(events=n))
    # the photometric stage selects its own pairs, so more events would only delay its start
    yield CalibrationSetting("all events, sharpness", "events", Settings(events=EVENTS[-1], stages=SHARP))


def _folds() -> Iterator[CalibrationSetting]:
    """Yield settings with other numbers of angles for folding.

    Folded, all events may cost little more than a part of them.
    """
    for bins in (0, *FOLDS):
        if bins != Settings().fold:
            yield CalibrationSetting(f"{_folded(bins)}, sharpness", "folding", Settings(fold=bins, stages=SHARP))
    if FOLDS[-1] != Settings().fold:
        yield CalibrationSetting(_folded(FOLDS[-1]), "folding", Settings(fold=FOLDS[-1]))
    for bins in FOLDS:
        s = Settings(events=EVENTS[-1], fold=bins, stages=SHARP)
        yield CalibrationSetting(f"all events, {_folded(bins)}, sharpness", "folding", s)


def _folded(bins: int) -> str:
    """Return the label of a setting that folds events to ``bins`` angles; 0: no folding."""
    return f"folded to {bins} angles" if bins else "not folded"


def _algorithms() -> Iterator[CalibrationSetting]:
    """Yield settings with other search algorithms and numbers of search steps."""
    for first, second in PAIRS_OF_ALGORITHMS:
        s = Settings(global_algorithm=first, local_algorithm=second, stages=SHARP)
        yield CalibrationSetting(f"{first[3:]} + {second[3:]}, sharpness", "algorithms", s)
    for budget in (60, 240):
        yield CalibrationSetting(f"{budget} global steps, sharpness", "algorithms",
                      Settings(global_evaluations=budget, stages=SHARP))  # fmt: skip


def _photometric() -> Iterator[CalibrationSetting]:
    """Yield settings with other algorithms and numbers of pairs for the photometric stage."""
    for pairs in PAIRS:
        if pairs != PhotometricSettings().pairs:
            yield CalibrationSetting(
                f"{pairs // 1000} k pairs", "pairs", Settings(photometric=PhotometricSettings(pairs=pairs))
            )
    by_bobyqa = Settings(photometric=PhotometricSettings(algorithm="LN_BOBYQA"))
    yield CalibrationSetting("photometric by BOBYQA", "algorithms", by_bobyqa)


def _mixed() -> Iterator[CalibrationSetting]:
    """Yield settings with few events for the first stage, whose error the photometric stage corrects."""
    for events, pairs in itertools.product(EVENTS[:2], PAIRS[:2]):
        if events != Settings().events and pairs != PhotometricSettings().pairs:
            s = Settings(events=events, photometric=PhotometricSettings(pairs=pairs))
            yield CalibrationSetting(f"{events // 1000} k events, {pairs // 1000} k pairs", "events and pairs", s)


def calibration_rows(
    known: KnownRecording,
    device: str,
    *,
    repeats: int,
    quick: bool,
    seed: int,
    progress: Progress,
    failed: dict[str, str],
) -> tuple[list[Row], list[str]]:
    """Measure all settings; return their rows, and notes on settings that the calibration refuses on this recording.

    Settings that fail are noted in ``failed`` by their labels, with the error.
    """
    ways = calibration_settings(known, quick=quick)

    def run(s: Settings) -> Calibration | AmiwarpError:
        try:
            return calibrate(known.recording, replace(s, seed=seed), device=device)
        except AmiwarpError as error:
            return error

    progress("calibrating", 0.0)
    for s in _kinds(ways):
        with contextlib.suppress(Exception):  # what fails here fails in its measurement too, and is noted there
            short = run(_shortened(s))
            if isinstance(short, AmiwarpError) or (s.stages == STAGES and short.photometric is None):
                run(s)  # the short run may have ended before it used every kernel
    tasks = [Task(partial(run, way.settings), len(known.events), way.fields(device)) for way in ways]

    def row(t: Timed) -> Row | None:
        found: Calibration | AmiwarpError | None = t.result
        if found is None or isinstance(found, AmiwarpError):
            return None
        return _row(t, failed, lambda: (model_error(found.model, known.model).rms, None))

    timed = measure(tasks, repeats, progress, "calibrating", warm_up=False, release=True,
                    again=lambda once: near_front([row(t) for t in once]))  # fmt: skip
    notes = []
    for t, way in zip(timed, ways, strict=True):
        if t.failure:
            failed[way.label] = t.failure
        elif isinstance(t.result, AmiwarpError):
            notes.append(f"{way.label}: refused, {t.result}")
        elif way.settings.stages == STAGES and (t.result.photometric is None or not t.result.photometric.accepted):
            notes.append(f"{way.label}: the photometric stage kept the result of sharpness")
    return [found for found in map(row, timed) if found is not None], notes


def _row(t: Timed, failed: dict[str, str], error: Callable[[], tuple[float, float | None]]) -> Row | None:
    """Return the row of a measured setting; None if it failed, which is noted in ``failed`` by its label.

    ``error`` returns the row's error [px] and the error of its image.
    """
    label = str(t.task.fields["label"])
    if t.failure:
        failed[label] = t.failure
        return None
    try:
        error_px, image_error = error()
        return t.row(error_px, image_error=image_error)
    except Exception as raised:
        failed[label] = failure_text(raised)
        return None


def _kinds(ways: list[CalibrationSetting]) -> list[Settings]:
    """Return one setting of each kind. They run before the measurement, so that their kernels are compiled."""
    every = (way.settings for way in ways)
    return list({(s.model, s.stages, s.fold > 0, s.photometric.algorithm): s for s in every}.values())


def _shortened(s: Settings) -> Settings:
    """Return a setting with few events and steps, for a short run."""
    few = PhotometricSettings(pairs=20_000, algorithm=s.photometric.algorithm)
    return replace(s, events=20_000, global_evaluations=20, local_evaluations=10, photometric=few)


# Measurement of the compensation chart.
#
# Three kinds of work are measured: images of events with every model, vote, number of angles and share of events; the
# same images by other libraries; and the compensation of whole files.

IMAGE, FILE = "image of events", "file to file"
"""Names of the two measured jobs, an image and a file. Rows of one job can be compared and share a Pareto front."""
ANGLES = (TURNS, 4096, 1024, 256)
"""Numbers of distinct prism angles per turn with which images are measured."""
SHARES = (4, 16)
"""Divisors n of the number of events: an image is measured with every n-th event."""
SAMPLE = 200_000
"""Largest number of events on which an error is measured; larger numbers are thinned evenly."""
MANY = 64_000_000
"""Number of events to which a recording is repeated on CUDA. With fewer events, launch times would dominate."""
REST_S = 0.02
"""Pause after a run of another library [s], whose threads stay busy for a while."""
WRONG = 0.02
"""Largest difference of the exact model's bilinear image from the float64 image, relative to the contrast; a larger one
is an error of the device."""


@dataclass(frozen=True, eq=False)
class ErrorSample:
    """Evenly thinned events of the recording with their exact compensated positions."""

    known: KnownRecording
    """Recording with ground truth from which the sample is taken."""
    step: int
    """Interval of the sampled events: every ``step``-th event of the recording."""
    xy: NDArray[np.float64]
    """Recorded positions of the sampled events [px], shape ``(n, 2)``."""
    theta: NDArray[np.float64]
    """Prism angles of the sampled events [rad], shape ``(n,)``."""
    exact: NDArray[np.float64]
    """Exact compensated positions [px], shape ``(n, 2)``."""

    @classmethod
    def of(cls, known: KnownRecording) -> ErrorSample:
        """Take a sample of the events of a recording."""
        step = -(-len(known.events) // SAMPLE)
        some = known.events[::step]
        xy, theta = raw_places(some), known.encoder.angle_at(some.t)
        return cls(known, step, xy, theta, exact_places(known.model, xy, theta))

    def error(self, places: NDArray[np.floating[Any]], vote: Vote) -> float:
        """Return the rms distance [px] of positions ``(n, 2)`` from the exact positions.

        For a nearest vote, the error of its rounding to whole pixels is added.
        """
        voted = np.rint(places) if vote is Vote.NEAREST else places
        return rms(voted - self.exact)


def coarse(theta: NDArray[np.float64], angles: int) -> NDArray[np.float64]:
    """Round prism angles [rad] to ``angles`` steps per turn."""
    step = 2.0 * math.pi / angles
    rounded = theta / step
    np.rint(rounded, out=rounded)
    rounded *= step
    return rounded


class Uploads:
    """Events of the recording on the device, for each number of angles and each share.

    Each version is uploaded once. Versions of one share have the same pixels in memory, only other angles.
    """

    def __init__(self, known: KnownRecording, device: str) -> None:
        self.known, self.device = known, device
        copies = 1 if wp.get_device(device).is_cpu else max(1, MANY // len(known.events))
        self.events = _repeated(known.events, copies)
        self.theta = _tiled(known.encoder.angle_at(known.events.t), copies)
        self.copies = copies
        self._made: dict[tuple[int, int], UploadedEvents] = {}

    def get(self, angles: int, share: int) -> UploadedEvents:
        """Return the uploaded events with ``angles`` distinct angles per turn, every ``share``-th event."""
        if (angles, share) not in self._made:
            # a share of the repeated events could contain all of them
            n = len(self.known.events)
            theta = _tiled(coarse(self.theta[:n:share], angles), self.copies)
            same = next((made for (_, other), made in self._made.items() if other == share), None)
            self._made[angles, share] = self._upload(theta, share) if same is None else same.at_angles(theta)
        return self._made[angles, share]

    def _upload(self, theta: NDArray[np.float64], share: int) -> UploadedEvents:
        """Upload every ``share``-th event with prism angles [rad]."""
        return upload_events(_repeated(self.known.events[::share], self.copies), theta, self.device)


def _repeated(e: Events, copies: int) -> Events:
    """Return the events ``e`` repeated ``copies`` times."""
    return replace(e, **{n: _tiled(getattr(e, n), copies) for n in ("x", "y", "t", "p")})


def _tiled(values: NDArray[Any], copies: int) -> NDArray[Any]:
    """Return ``values`` repeated ``copies`` times; without a copy if that is once."""
    return values if copies == 1 else np.tile(values, copies)


@dataclass(frozen=True)
class ImageSetting:
    """Setting of an image of warped events that the chart measures."""

    model: str
    """Name of the optical model."""
    vote: Vote
    """How a vote is shared among pixels."""
    angles: int = TURNS
    """Number of distinct prism angles per turn."""
    share: int = 1
    """Interval of the used events: every ``share``-th event."""

    @property
    def label(self) -> str:
        """Name of the setting in the chart."""
        words = [self.model, self.vote.value]
        words += [] if self.angles == TURNS else [f"{self.angles} angles"]
        words += [] if self.share == 1 else [f"1/{self.share} of events"]
        return ", ".join(words)

    def fields(self, device: str) -> dict[str, Any]:
        """Return the fields of the setting's row that do not depend on the measurement."""
        settings = {"model": self.model, "vote": self.vote.value, "angles": self.angles, "share": 1.0 / self.share,
                    "device": device}  # fmt: skip
        default = self == ImageSetting("exact", Vote.BILINEAR)
        return {"chart": "compensation", "job": IMAGE, "label": self.label, "family": self.model, "mark": self._mark,
                "settings": settings, "default": default, "comparable": self.share == 1}  # fmt: skip

    @property
    def _mark(self) -> str:
        """Kind of the row, which determines its marker in the chart."""
        return self.vote.value if self.share == 1 else "share of events"


def compensation_settings(*, quick: bool) -> list[ImageSetting]:
    """Return the image settings that the chart measures."""
    angles, models = (ANGLES[::2], ("circle", "exact")) if quick else (ANGLES, tuple(rungs()))
    # a nearest vote hides the error of coarse angles
    whole = [
        ImageSetting(m, v, a) for m in models for v in Vote for a in (angles if v is Vote.BILINEAR else angles[:1])
    ]
    return whole + [ImageSetting("exact", Vote.BILINEAR, TURNS, share) for share in SHARES]


@dataclass(frozen=True, eq=False)
class LibraryTask:
    """Task of another library that makes the same image of events."""

    task: Task
    """Function to measure, with the fields of its row."""
    places: Callable[[slice], NDArray[np.float32]]
    """Function that returns the positions [px], shape ``(n, 2)``, to which the library moves the events of a slice."""


Libraries: TypeAlias = Callable[["ErrorSample", "Uploads", str], tuple[list[LibraryTask], list[str]]]
"""Function that returns tasks of other libraries for a sample, its uploads and a device, and notes on libraries that
are not installed."""


def compensation_rows(
    known: KnownRecording,
    device: str,
    *,
    repeats: int,
    quick: bool,
    progress: Progress,
    folder: Path,
    failed: dict[str, str],
    libraries: Libraries | None = None,
) -> tuple[list[Row], list[str]]:
    """Measure all settings and return their rows, with notes on settings that could not be measured.

    Settings that fail are noted in ``failed`` by their labels, with the error. Temporary files go to ``folder``. Raises
    :class:`AmiwarpError` if the exact model's image differs from the float64 image.
    """
    progress("measuring images of events: the truth", 0.0)
    sample = ErrorSample.of(known)
    images, notes = _image_rows(sample, device, repeats, quick, progress, failed, libraries)
    files, missing = list[Row](), list[str]()
    with noted(failed, FILE):
        files, missing = _file_rows(sample, device, repeats, quick, progress, failed, folder)
    return images + files, notes + missing


def _image_rows(
    sample: ErrorSample,
    device: str,
    repeats: int,
    quick: bool,
    progress: Progress,
    failed: dict[str, str],
    libraries: Libraries | None,
) -> tuple[list[Row], list[str]]:
    """Measure the images of events.

    The uploaded events are freed when this function returns, before files are measured.
    """
    known, truth = sample.known, exact_image(sample.known)
    models = {name: simplified(known.calibration(), name).model for name in rungs()}
    uploads, ways = Uploads(known, device), compensation_settings(quick=quick)
    others, notes = libraries(sample, uploads, device) if libraries is not None else ([], [])
    tasks = [*_image_tasks(ways, models, uploads, device), *(other.task for other in others)]
    timed = measure(tasks, repeats, progress, "measuring images of events", rest_s=REST_S)

    def error(t: Timed, way: ImageSetting) -> tuple[float, float]:
        places = _places(models[way.model], sample, way.angles, device)
        return sample.error(places, way.vote), _image_error(t.result, truth, uploads.copies / way.share)

    def error_of_other(t: Timed, other: LibraryTask) -> tuple[float, float]:
        places = other.places(slice(0, len(known.events), sample.step)).astype(np.float64)
        image = _image_error(t.result, truth, t.task.events / len(known.events))
        return sample.error(places, Vote.BILINEAR), image

    rows = [_row(t, failed, partial(error, t, way)) for t, way in zip(timed, ways, strict=False)]
    rows += [
        _row(t, failed, partial(error_of_other, t, other)) for t, other in zip(timed[len(ways) :], others, strict=True)
    ]
    out = [row for row in rows if row is not None]
    _check(out)
    return out, notes


def _image_tasks(ways: list[ImageSetting], models: dict[str, Model], uploads: Uploads, device: str) -> Iterator[Task]:
    """Yield the measurements of the images of events."""
    camera = uploads.known.camera
    buffers = {}
    for vote in Vote:
        canvas = CanvasShape(camera.width, camera.height, vote=vote)
        buffers[vote] = Votes(canvas, device), Image(canvas, 1, device)

    def run(way: ImageSetting) -> Image:
        votes, image = buffers[way.vote]
        votes.clear()
        votes.add_events(models[way.model], uploads.get(way.angles, way.share))
        votes.read(image)
        wp.synchronize_device(device)
        return image

    for way in ways:
        fields = way.fields(device)
        yield Task(partial(run, way), len(uploads.theta), fields, lambda image: image.numpy()[0])


def _places(model: Model, sample: ErrorSample, angles: int, device: str) -> NDArray[np.float64]:
    """Return compensated positions by the device functions that the votes call, at the rounded angles."""
    theta = wrap_angle(coarse(sample.theta, angles)).astype(np.float32)
    xy = wp.array(sample.xy.astype(np.float32), dtype=wp.vec2, device=device)
    return model.compensate_points(xy, wp.array(theta, dtype=float, device=device)).numpy().astype(np.float64)


def _image_error(image: NDArray[Any], truth: NDArray[np.float64], times: float) -> float:
    """Return the rms difference of ``image`` / ``times`` from ``truth``, relative to the contrast of ``truth``."""
    return float(np.sqrt(np.mean((image / times - truth) ** 2)) / np.std(truth))


def _check(rows: list[Row]) -> None:
    """Raise :class:`AmiwarpError` if the image by the default setting is wrong, unless the setting failed."""
    default = next((row for row in rows if row.default), None)
    if default is None:
        return
    if default.image_error is None or not default.image_error < WRONG:
        raise AmiwarpError(
            f"the image by {default.label} differs from the float64 one by {default.image_error} of its contrast; "
            "this device gives wrong results; run the tests on it"
        )


def circle(sample: ErrorSample) -> tuple[float, float]:
    """Return radius [px] and phase [rad] of the circle that fits the exact displacements of the events best."""
    moved = (sample.xy - sample.exact) @ (1.0, 1.0j)
    best = complex(np.nanmean(moved * np.exp(-1j * sample.theta)))
    return abs(best), float(np.angle(best))


def _file_rows(
    sample: ErrorSample,
    device: str,
    repeats: int,
    quick: bool,
    progress: Progress,
    failed: dict[str, str],
    folder: Path,
) -> tuple[list[Row], list[str]]:
    """Measure the compensation of whole files with each model, reading and writing included.

    The error is that of the events in the written file.
    """
    if missing := [name for name in ("h5py", "hdf5plugin") if find_spec(name) is None]:
        return [], [f"files: not measured, because {' and '.join(missing)} is not installed"]
    known = sample.known

    def error(path: Path) -> float:
        events = open_recording(path).events.slice(0, len(known.events))
        return sample.error(raw_places(events[:: sample.step]), Vote.BILINEAR)

    def run(calibration: Calibration) -> Path:
        compensate(source, calibration, place / "out.h5", device=device, overwrite=True)
        return place / "out.h5"

    with scratch_folder(folder) as place:
        save_recording(place / "in.h5", replace(known.recording, truth=None))
        source = open_recording(place / "in.h5")
        tasks = []
        for model in ("circle", "exact") if quick else rungs():
            calibration = simplified(known.calibration(), model)
            fields = {"chart": "compensation", "job": FILE, "label": f"{model}, file to file", "family": model,
                      "mark": FILE, "settings": {"model": model, "device": device},
                      "default": model == "exact"}  # fmt: skip
            tasks.append(Task(partial(run, calibration), len(known.events), fields, error))
        timed = measure(tasks, repeats, progress, "measuring files")
        rows = [_row(t, failed, lambda t=t: (t.result, None)) for t in timed]  # type: ignore[misc]
        return [row for row in rows if row is not None], []
