"""Thresholds of every pixel from the picture that all pixels see, and the hot and dead pixels among them.

Two successive events of a pixel measure its threshold: L(w(x, θ₂)) − L(w(x, θ₁)) = ±C, with the solved picture L (see
:mod:`amiwarp.brightness.solver`). Every point of the picture is seen by all pixels on the orbit of the prism, so the
picture hardly depends on the threshold of one of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.event_table import EventTable
from amiwarp.brightness.pairs import PairSet
from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.brightness.tiles import Tiles
from amiwarp.calib.bad_pixels import LEAST_TURNS
from amiwarp.calib.hot_pixels import BINS, bin_times, outliers, unrepeated_counts
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.device_events import read_between
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.off_excess import off_excess_by_counts
from amiwarp.reconstruction.reconstruct import SCALES, STEPS, Reconstruction, solve_rounds
from amiwarp.reconstruction.windows import border_displacements
from amiwarp.results.calibration import Calibration
from amiwarp.results.pixel_map import THRESHOLDS, PixelMap
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress
from amiwarp.validation import TIME_LIMIT, whole

DENSITY = 2.0
"""Nodes of the picture per pixel. At 1, the picture's own error in fine texture is as large as the mismatch."""
ROUNDS = 3
"""Number of times that the picture and the thresholds are solved in turn. From the second to the third, thresholds
change by 2 % of the mismatch."""
SCALE = 0.3
"""Deviation from a pixel's threshold at which a pair gets half weight [thresholds]: three times a usual mismatch of
10 %, beyond which noise events lie."""
LEAST_CHANGE = 0.5
"""Change of brightness between the two events of a pair below which one of them is noise [thresholds of the pixel]."""
LEAST_PAIRS = 20
"""Smallest number of pairs of a polarity from which a pixel's threshold is known. Each pair is off by about 0.1
thresholds, so 20 suffice for a mismatch of 10 %."""
MOST_EVENTS = 3_000_000
"""Largest number of events of a window, for one picture, which takes about 2 GB of memory."""
LEAST_RANDOM = 3.0
"""Smallest number of random events of a hot pixel in each turn. A pixel at the limit of its threshold fires a few times
in a turn, and not in every turn: with a threshold of two thirds, it had two random events."""
WORST_RESIDUAL = 0.5
"""Median residual [thresholds] beyond which the events do not show one picture: a random brightness has more."""
SILENT_RANGE = 3.0
"""Least change of brightness along the orbit [median thresholds] at which a silent pixel counts as dead. A working one
would need a threshold of three times the median."""
SILENT_ANGLES = 32
"""Number of prism angles at which the brightness seen by a silent pixel is looked up."""


@dataclass
class _Sums:
    """Weighted sums over the pairs of each pixel and polarity, each of shape (height, width, 2): OFF, ON."""

    weight: NDArray[np.float64]
    value: NDArray[np.float64]
    square: NDArray[np.float64]
    pairs: NDArray[np.int64]
    """Number of pairs of two events."""
    wrong: NDArray[np.int64]
    """Number of pairs between which the brightness changed by far less than a threshold."""
    turns: float = 0.0

    def threshold(self) -> NDArray[np.float64]:
        """Return thresholds, 1 without pairs."""
        one = np.ones_like(self.value)
        return np.divide(self.value, self.weight, out=one, where=self.weight > 0.0)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which thresholds are known: they have enough pairs, most of which are events of the scene."""
        enough = self.pairs - self.wrong >= LEAST_PAIRS
        mostly_of_scene = 2 * self.wrong < self.pairs
        return enough & mostly_of_scene


@guarded
def pixel_thresholds(
    recording: Recording,
    calibration: Calibration | None = None,
    *,
    model: Model | None = None,
    encoder: Encoder | None = None,
    sensor: SensorTiming | None = None,
    start_us: int | None = None,
    length_us: int | None = None,
    device: Any = None,
    progress: Progress | None = None,
) -> PixelMap:
    """Measure the thresholds of every pixel, and find hot and dead pixels, from a calibrated recording.

    The camera must be still, or rotate as calibrated, and so must the scene. Longer recordings reach pixels that see
    less texture: a threshold needs 20 pairs of events of its polarity.

    Parameters
    ----------
    recording : Recording
        Recording with events.
    calibration : Calibration, optional
        Calibration of the same sensor size. It provides model, encoder and camera rotation.
    model : Model, optional
        Optical model of the prism, if there is no calibration.
    encoder : Encoder, optional
        Encoder, if neither calibration nor recording provides one.
    sensor : SensorTiming, optional
        Latency and refractory period of the sensor; by default the refractory period of the calibration.
    start_us : int, optional
        Start of the used time [us]; by default one turn after the first event.
    length_us : int, optional
        Length of the used time [us]; by default until the last event.
    device : str or warp.Device, optional
        Device to compute on, by default the device of :class:`DeviceMemoryEvents`, else the CPU.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    PixelMap
        Thresholds relative to the median of their polarity and of the pixels around: what all pixels of a region have
        in common cannot be told from the contrast of the scene.

    Raises
    ------
    AmiwarpError
        If the events do not show one picture, or no pixel has enough pairs of events, or as for
        :class:`Reconstruction`.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> camera, prism = amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.03)
    >>> recording = amiwarp.simulate(picture, camera, prism, duration_s=1.5)
    >>> pixels = amiwarp.pixel_thresholds(recording, model=amiwarp.ExactModel.from_prism(camera, prism, 0.0))
    >>> pixels.size
    (32, 24)
    """
    work = Reconstruction(recording, calibration, model=model, encoder=encoder, device=device)
    if sensor is None:
        sensor = _timing_of(calibration)
    start, _ = work.span(start_us, length_us)
    start = max(start, recording.events.t_first)
    length = recording.events.t_last + 1 - start
    if length_us is not None:
        length = min(length, whole(length_us, "length_us", 1, TIME_LIMIT, " us"))

    width, height = recording.events.size
    no_weight = np.zeros((height, width, 2))
    no_pairs = np.zeros((height, width, 2), np.int64)
    sums = _Sums(no_weight, no_weight, no_weight, no_pairs, no_pairs)
    count = np.zeros((height, width), np.int64)
    silent = np.ones((height, width), np.bool_)
    excluded = np.zeros((height, width), np.bool_)
    unrepeated = np.zeros((height, width))
    last = None
    windows = list(_windows(work, start, length))
    for k, (window_start, window_length) in enumerate(windows):
        picture = _PixelPicture(work, window_start, window_length, sensor)
        sums = picture.measure(sums, last)
        last = None if work.camera_rotation.moves else picture.solver.unknowns
        count += picture.count
        excluded |= picture.excluded
        unrepeated += picture.unrepeated()
        still_silent = count == 0
        silent &= still_silent & picture.reaches(still_silent)
        if progress is not None:
            progress("measuring the pixels", (k + 1) / len(windows))

    # Events are random if they are off the picture and do not repeat from turn to turn.
    wrong = np.where(excluded, count, sums.wrong.sum(axis=2))
    random = wrong.astype(np.float64)
    if work.turn_us is not None:
        random = np.minimum(wrong, unrepeated)
    least = LEAST_RANDOM * length / (work.turn_us or length)
    hot = outliers(random) & (random >= least)
    excess_hz = _excess(count) / (length * 1e-6)
    hot_hz = np.where(hot, excess_hz, 0.0)
    return _pixel_map(work, sums, hot_hz, silent)


def _timing_of(calibration: Calibration | None) -> SensorTiming:
    """Return the timing of the sensor that a calibration found."""
    if calibration is None or calibration.photometric is None:
        return SensorTiming(refractory_us=0.0)
    return SensorTiming(refractory_us=calibration.photometric.refractory_us)


def _windows(work: Reconstruction, start: int, length: int) -> Iterator[tuple[int, int]]:
    """Yield start and length [us] of windows of about :data:`MOST_EVENTS`, of two turns or longer."""
    source = work.recording.events
    events = source.find(start + length) - source.find(start)
    wanted = -(-events // MOST_EVENTS)  # rounded up
    most = int(length // (LEAST_TURNS * (work.turn_us or length)))
    number = max(1, min(wanted, most))
    edges = np.rint(start + np.arange(number + 1) * (length / number)).astype(np.int64)
    for first, stop in pairwise(edges):
        yield int(first), int(stop - first)


class _PixelPicture:
    """Picture of one window, and the thresholds of the pixels that see it."""

    def __init__(self, work: Reconstruction, start: int, length: int, timing: SensorTiming) -> None:
        events = read_between(work.recording.events, start, start + length)
        self._events = events
        width, height = work.recording.events.size
        table = EventTable([events], np.zeros((height, width), np.int32), work.device)
        self.work = work
        self.turns = max(1.0, length / (work.turn_us or length))
        self.count: NDArray[np.int64] = table.exclude_hot_pixels().astype(np.int64)
        """Number of events of each pixel, shape (height, width)."""
        self.excluded: NDArray[np.bool_] = table.tile_of.numpy() < 0
        """Pixels that fire far more often than all around them, shape (height, width)."""
        self.pairs: PairSet = work._pairs(table, start, length, timing)
        if not self.pairs.of_two_events:
            raise AmiwarpError(
                f"{work.recording.name}: no pixel fires twice; give a recording of more turns",
                ErrorCode.CONTENT_MISSING,
            )
        self.off = off_excess_by_counts(work.recording.events, work.turn_us, start, length)
        left, top, tiles = work._tile(start, length)
        middle = start + length // 2
        count = self.count.astype(np.int32)
        smoothness = work._start_choice(count, self.pairs, middle, (left, top), self.off)()
        self.radius = _radius(work)
        self.offset = np.zeros(self.pairs.arrays.stride, np.float32)
        self.pairs.set_offset(self.offset)
        self.tiles: Tiles = tiles.at_density(DENSITY)
        self.solver: BrightnessMap = work._solver(self.pairs, self.tiles, self.off, middle)
        self.solver.restart(smoothness)

    def measure(self, sums: _Sums, last: NDArray[np.float32] | None) -> _Sums:
        """Solve for the picture and the thresholds in turn, and return ``sums`` with these pairs.

        ``last`` is the solution of the previous window, if it shows the same picture.
        """
        count = self.pairs.of_two_events or 0
        width = self.count.shape[1]
        x = self.pairs.column("x")[:count]
        y = self.pairs.column("y")[:count].astype(np.int64)
        on = (self.pairs.column("on")[:count] & 1) == 1
        # Index of each pair's pixel and polarity in the arrays of the sums
        key = 2 * (y * width + x) + on
        nominal = np.where(on, 1.0, -1.0 - self.off)
        threshold = _normalised(sums, self.radius)
        # Once the thresholds are known from earlier windows, one round suffices.
        rounds = 1 if sums.turns else ROUNDS
        for k in range(rounds):
            self.offset[:count] = nominal * (1.0 - threshold.ravel()[key])
            self.pairs.set_offset(self.offset)
            if k:
                self.solver.solve(SCALES[-1], steps=STEPS)
            else:
                self._solve_first(count, last)
            residual = self.solver.residuals.values.numpy()[:count].astype(np.float64)
            # ΔL = ±C: what the residual lacks of the assumed threshold, relative to the polarity's threshold
            measured = threshold.ravel()[key] - residual / nominal
            total = _add(sums, key, measured, threshold)
            threshold = _normalised(total, self.radius)
        return replace(total, turns=sums.turns + self.turns)

    def _solve_first(self, count: int, last: NDArray[np.float32] | None) -> None:
        """Solve for the picture of this window; raise :class:`AmiwarpError` if the events do not show one."""
        median_residual, self.known = solve_rounds(self.solver, count, last)
        residual = median_residual()
        if residual > WORST_RESIDUAL:
            raise AmiwarpError(
                f"{self.work.recording.name}: the events do not show one picture, the brightness equations are "
                f"off by {residual:.2f} thresholds; calibrate again, or give a time in which the scene is "
                "still (--start and --length, start_us and length_us in Python)"
            )

    def unrepeated(self) -> NDArray[np.float64]:
        """Return how many events of each pixel do not repeat from turn to turn, shape (height, width).

        A pixel with a low threshold has events where its neighbours see too little texture for a picture, but in every
        turn. Infinity if there are less than two turns.
        """
        events = self._events if isinstance(self._events, Events) else self._events.to_host()
        encoder = self.work.encoder
        width = np.int32(self.count.shape[1])
        pixel = events.y.astype(np.int32) * width + events.x
        found = unrepeated_counts(events, pixel, encoder, self.work.recording.events.size)
        if found is None:
            return np.full(self.count.shape, np.inf)
        # Turns are compared in pairs.
        turns = (len(bin_times(events, encoder)) - 1) // BINS
        used = turns // 2 * 2
        return found * (self.turns / used)

    def reaches(self, pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which of the pixels see a change of brightness that every working pixel reports, shape (h, w)."""
        from scipy.ndimage import map_coordinates

        # Follow each pixel along its orbit over the picture.
        y, x = np.nonzero(pixels)
        places = np.stack([x, y], axis=1).astype(np.float32)
        theta = np.arange(SILENT_ANGLES) * (math.tau / SILENT_ANGLES)
        every_place = np.repeat(places, SILENT_ANGLES, axis=0)
        every_angle = np.tile(theta, len(places))
        moved = self.work.model.compensate_points(every_place, every_angle)
        nodes = (np.asarray(moved, np.float64) - self.tiles.origin[0]) * self.tiles.density
        rows_and_columns = np.nan_to_num(nodes.T[::-1], nan=-1e9)

        # Look up the known brightness there, NaN where it is unknown, and 0 if it is unknown everywhere.
        image = np.where(self.known(), self.solver.maps()[0], np.nan)
        brightness = map_coordinates(image, rows_and_columns, order=0, cval=np.nan)
        brightness = brightness.reshape(-1, SILENT_ANGLES)
        known = np.isfinite(brightness).any(axis=1)
        brightness = np.where(known[:, None], brightness, 0.0)

        brightest = np.nanmax(brightness, axis=1)
        darkest = np.nanmin(brightness, axis=1)
        reaches = np.zeros_like(pixels)
        reaches[y, x] = brightest - darkest >= SILENT_RANGE
        return reaches


def _add(
    sums: _Sums,
    key: NDArray[np.int64],
    measured: NDArray[np.float64],
    threshold: NDArray[np.float64],
) -> _Sums:
    """Return the sums with more pairs, whose weights fall with the distance from the pixel's threshold."""

    def added(
        to: NDArray[Any], which: NDArray[np.bool_], weight: NDArray[np.float64] | None = None
    ) -> NDArray[Any]:
        return to + np.bincount(key[which], weight, to.size).reshape(to.shape)

    least = LEAST_CHANGE * np.maximum(threshold.ravel()[key], LEAST_CHANGE)
    holds = measured >= least  # False for NaN, off the picture
    pairs = added(sums.pairs, np.ones_like(holds))
    wrong = added(sums.wrong, ~holds)
    valid = np.isfinite(measured)
    # Weights depend on the threshold, which depends on the weights: three rounds suffice.
    for _ in range(3):
        away = measured[valid] - threshold.ravel()[key[valid]]
        weight = 1.0 / (1.0 + (away / SCALE) ** 2)
        total = _Sums(
            added(sums.weight, valid, weight),
            added(sums.value, valid, weight * measured[valid]),
            added(sums.square, valid, (weight * away) ** 2),
            pairs,
            wrong,
            sums.turns,
        )
        threshold = total.threshold()
    return total


def _radius(work: Reconstruction) -> int:
    """Return half the width of the square over whose mean thresholds are compared: two orbits of the prism [px]."""
    displacements = border_displacements(work.model)
    if not len(displacements):
        return 2
    x, y = displacements.T
    orbit = float(np.median(np.hypot(x, y)))
    return 2 + math.ceil(2.0 * orbit)


def _normalised(sums: _Sums, radius: int) -> NDArray[np.float64]:
    """Return thresholds divided by the mean of the ones around, shape (height, width, 2); 1 where they are not known.

    Without the division, an error of the picture's contrast would grow from round to round.
    """
    from scipy.ndimage import uniform_filter

    known = sums.known
    value = np.where(known, sums.threshold(), 0.0)
    size = (2 * radius + 1, 2 * radius + 1, 1)
    near = uniform_filter(value, size, mode="nearest")
    share = uniform_filter(known.astype(np.float64), size, mode="nearest")
    normalised = np.ones_like(value)
    np.divide(value * share, near, out=normalised, where=known & (near > 1e-9))
    return np.clip(normalised, *THRESHOLDS)


def _excess(count: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how many events a pixel has beyond the median of the pixels around it, at least 1."""
    from scipy.ndimage import median_filter

    around = median_filter(count, 5, mode="mirror")
    return np.maximum(count - around, 1.0)


def _pixel_map(
    work: Reconstruction, sums: _Sums, hot_hz: NDArray[np.float64], dead: NDArray[np.bool_]
) -> PixelMap:
    """Return the map of the sums over all windows."""
    relative = _normalised(sums, _radius(work))
    known = sums.known
    if not known.any():
        raise AmiwarpError(
            f"{work.recording.name}: no pixel has {LEAST_PAIRS} pairs of events of a polarity; give a longer "
            "recording, or a scene with more texture",
            ErrorCode.CONTENT_MISSING,
        )
    # In every turn the pairs of a pixel meet the same errors of the picture: only those within a turn are independent.
    std = np.sqrt(sums.square * max(1.0, sums.turns)) / np.maximum(sums.weight, 1e-9)
    lowest, highest = THRESHOLDS
    arrays = {}
    for k, name in enumerate(("off", "on")):
        used = known[..., k]
        median = np.median(relative[used, k]) if used.any() else 1.0
        value = relative[..., k] / median
        used = used & (value > lowest) & (value < highest)
        arrays[name] = np.where(used, value, np.nan)
        arrays[f"{name}_std"] = np.where(used, std[..., k], np.nan)
        arrays[f"{name}_pairs"] = sums.pairs[..., k].astype(np.int32)
    return PixelMap(**arrays, hot_hz=hot_hz.astype(np.float32), dead=dead)
