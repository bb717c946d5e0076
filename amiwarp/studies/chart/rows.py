"""Measured settings (rows) of a chart with time and error; the Pareto front, and the best row within a budget."""

from __future__ import annotations

import math
import random
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib import Calibration
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.imaging.metrics import truth_model
from amiwarp.memory import only_new_garbage, release_memory
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import ExactModel, axis_rotation
from amiwarp.optics.prism import FlatSide
from amiwarp.progress import Progress

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
        model = truth_model(camera, truth, recording.prism.flat_side)
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
    ``warm_up`` adds an untimed first round, in which kernels are compiled. No new round begins after ``limit_s`` [s].
    ``rest_s`` [s] is a pause before each run, in which threads of the previous run may still be busy. ``again`` decides
    from tasks that were timed once which of them to repeat. Memory that earlier work freed is released first; with
    ``release`` before each run, for runs that need much memory. All runs then start with an equally empty heap.
    """
    release_memory()
    times: list[list[float]] = [[] for _ in tasks]
    results: list[Any] = [None] * len(tasks)
    repeated: Sequence[bool] = [True] * len(tasks)
    first = int(warm_up)  # the first timed round
    rounds, began = repeats + first, time.perf_counter()
    order, rng = list(enumerate(tasks)), random.Random(0)
    for turn in range(rounds):
        if turn > first:
            if time.perf_counter() - began > limit_s:
                break
            if turn == first + 1 and again is not None:
                repeated = again(_timed(tasks, times, results))
            rng.shuffle(order)
        for done, (k, task) in enumerate(order):
            if not repeated[k]:
                continue
            if release:
                release_memory()
            time.sleep(rest_s)
            start = time.perf_counter()
            result = task.run()
            took = time.perf_counter() - start
            if turn == first:
                results[k] = task.keep(result)
            if turn >= first:
                times[k].append(took)
            progress(what, (turn * len(tasks) + done + 1) / (rounds * len(tasks)))
    return _timed(tasks, times, results)


def _timed(tasks: Sequence[Task], times: list[list[float]], results: list[Any]) -> list[Timed]:
    """Return the tasks together with their times and results."""
    slow = slowness(times)
    return [
        Timed(task, tuple(each), slow[: len(each)], result)
        for task, each, result in zip(tasks, times, results, strict=True)
    ]


def slowness(times: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """Return how slow the machine was in each round; 1 is usual.

    ``times``: run times of each task [s]. Tasks that were not repeated in every round do not count. The slowness of a
    round is the median over tasks of the run time relative to the task's median.
    """
    rounds = max(map(len, times))
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
