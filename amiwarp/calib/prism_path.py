"""Path of the prism's angle over time, found in the events: without an encoder, or where that tells too little.

:func:`varying_paths` finds a smooth path from the repetition of the events alone, if the speed varies much.
:class:`PathFit` finds ripple and remaining errors by the brightness map that the photometric stage uses too.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.solver import BrightnessMap, Tiles, off_excess
from amiwarp.calib.calibration_events import middle_time, thin
from amiwarp.calib.first_guess import autocorrelation
from amiwarp.calib.photometric.cost import SLOPE_PX, Cost, size_and_phase_directions
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.pairs import check_pairs, collect_everywhere, fine_map_is_determined
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording

if TYPE_CHECKING:
    from amiwarp.calib.sharpness_search import Search

Vector = NDArray[np.float64]

SAMPLE_US = 1000
"""Time between samples of a path that was found [us]."""


# Smooth path from the repetition of the events. A still scene gives equally many events in each turn, whatever the
# speed. With time counted in events, ON minus OFF events per cell therefore repeat with a constant period. A smooth
# speed then follows from the events' times.

MOST_EVENTS = 2_000_000
"""Largest number of events that are counted, evenly thinned."""
EVENTS_PER_BIN, FEWEST_BINS, MOST_BINS = 500, 256, 8192
"""Number of events per bin, and limits of the number of bins."""
CELL, MOST_CELLS = 8, 1500
"""Smallest side of the cells in which events are counted [px], and the largest number of cells."""
COMPONENTS, HARMONICS = 12, 6
"""Number of principal components of the counts, and of harmonics of the angle that describe each of them."""
UNLIKE = 0.3
"""Correlation below which two bins are different views of the scene."""
LIKE = 0.7
"""Smallest correlation after a turn, as a share of the largest one."""
LEAST_CORRELATION = 0.4
"""Smallest correlation at which events are considered to repeat. It was 0.7 at least where they do, 0.3 by chance."""
STEPS, LONGEST_STEP = 12, 0.5
"""Largest number of Gauss-Newton steps, and the largest change of the angle in one of them [rad]."""
CONVERGED = 0.003
"""Change of the angle at which the steps end [rad]."""
GAUGE_HARMONICS = 4
"""Number of harmonics of the angle by which the path may be changed, to become smooth in time."""
ENDS = 8
"""Number of bins at each end of a recording that give the speed there."""
LEAST_VARIATION = 0.1
"""Smallest deviation from constant speed that is found by repetition [rad rms]. Smaller ones are left to the map."""
LEAST_RATIO = 1.3
"""Smallest ratio of what a constant speed leaves of the counts to what the path leaves. It was 3 at least for ramps."""


def varying_paths(recording: Recording) -> list[Encoder]:
    """Return the path of the prism's angle for each sense of rotation, if its speed varies much; else nothing.

    The angle is 0 in the middle of the recording.
    """
    try:
        t, u, counts = _count(recording)
    except AmiwarpError:
        return []
    if t[-1] <= t[0]:  # all events have the same time
        return []
    theta, left = _follow(u, counts)
    constant = np.asarray(np.polyval(np.polyfit(t, theta, 1), t), np.float64)
    if float(np.std(theta - constant)) < LEAST_VARIATION:
        return []
    if _unexplained(constant, counts)[2] < LEAST_RATIO * left:
        return []
    return [_encoder(recording, t, sign * _smooth(t, theta)) for sign in (1.0, -1.0)]


def _count(recording: Recording) -> tuple[Vector, Vector, Vector]:
    """Return for each bin of equally many events its time [us], its angle [rad], and its counts, shape (bins, m).

    Times are from the first event on. The angles assume equally many events in each turn. The counts are principal
    components of ON minus OFF events per cell. Raises :class:`AmiwarpError` if they do not repeat.
    """
    events = thin(recording, MOST_EVENTS)
    width, height = recording.events.size
    n, side = len(events), max(CELL, math.ceil(math.sqrt(width * height / MOST_CELLS)))
    bins, columns = min(max(n // EVENTS_PER_BIN, FEWEST_BINS), MOST_BINS), -(-width // side)
    cells = columns * -(-height // side)
    at = np.arange(n) * bins // n * cells + events.y // side * columns + events.x // side
    counts = np.bincount(at, weights=2.0 * events.p - 1.0, minlength=bins * cells).reshape(bins, cells)
    counts -= counts.mean(axis=0)
    along = np.random.default_rng(0).normal(size=(cells, 2 * COMPONENTS))
    for _ in range(6):  # subspace iteration
        along = np.linalg.qr(counts.T @ (counts @ along))[0]
    found: Any = counts @ along
    found = found @ np.linalg.svd(found, full_matrices=False)[2][:COMPONENTS].T
    t = (events.t[((np.arange(bins) + 0.5) * n / bins).astype(np.int64)] - events.t[0]).astype(np.float64)
    period = _period(autocorrelation(found.astype(np.float32)), recording.name)
    return t, np.asarray(np.arange(bins) * (math.tau / period), np.float64), np.asarray(found, np.float64)


def _period(correlation: Vector, name: str) -> float:
    """Return the lag after which events repeat [bins]: the first strong peak after the correlation has fallen."""
    inner = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inner > correlation[:-2]) & (inner >= correlation[2:]))
    peaks = peaks[peaks > np.argmax(correlation < UNLIKE)]
    if correlation.min() >= UNLIKE or not len(peaks) or correlation[peaks].max() < LEAST_CORRELATION:
        raise AmiwarpError(f"{name}: the events do not repeat, so the prism's path cannot be found; use an encoder")
    first = peaks[correlation[peaks] >= LIKE * correlation[peaks].max()][0]
    near = peaks[(peaks >= first) & (peaks < 1.3 * first)]
    return float(near[np.argmax(correlation[near])])


def _unexplained(theta: Vector, counts: Vector) -> tuple[Vector, Vector, float]:
    """Fit the counts by harmonics of the angle. Return an orthonormal basis, the fit's derivative, and the share left.

    The derivative by the angle has the shape of the counts.
    """
    k = np.arange(1, HARMONICS + 1)
    cos, sin = np.cos(np.outer(theta, k)), np.sin(np.outer(theta, k))
    design = np.concatenate([np.ones((len(theta), 1)), cos, sin], axis=1)
    fit = np.linalg.lstsq(design, counts, rcond=None)[0]
    slope = np.concatenate([-k * sin, k * cos], axis=1) @ fit[1:]
    left = float(((counts - design @ fit) ** 2).sum() / max(float((counts**2).sum()), 1e-30))
    return np.linalg.qr(design)[0], slope, left


def _follow(u: Vector, counts: Vector) -> tuple[Vector, float]:
    """Return the angles for which functions of the angle explain the counts best, and the share that they leave.

    ``u`` are first angles; a spline with a knot per turn corrects them, because noise gives events in slow turns too.
    """
    theta = u.copy()
    spline = _design(_knots(u, u, 1.0), u).toarray()
    for _ in range(STEPS):
        basis, slope, _ = _unexplained(theta, counts)
        columns = (slope[:, :, None] * spline[:, None, :]).reshape(len(u), -1)
        columns -= basis @ (basis.T @ columns)
        residual = counts - basis @ (basis.T @ counts)
        columns = columns.reshape(-1, spline.shape[1])
        normal = columns.T @ columns
        ridge = 1e-6 * float(np.trace(normal)) / len(normal) * np.eye(len(normal))
        step = spline @ np.linalg.solve(normal + ridge, columns.T @ residual.ravel())
        step -= step.mean()
        largest = float(np.abs(step).max())
        theta += step * min(1.0, LONGEST_STEP / max(largest, 1e-12))
        if largest < CONVERGED:
            break
    return theta, _unexplained(theta, counts)[2]


def _smooth(t: Vector, theta: Vector) -> Vector:
    """Return the path that is smooth in time, with a knot per turn.

    Counts that repeat determine the angle up to a periodic function of itself, which is chosen here.
    """
    spline = _design(_knots(t, theta, 1.0), t).toarray()
    k = np.arange(1, GAUGE_HARMONICS + 1)
    columns = np.concatenate([spline, np.cos(np.outer(theta, k)), np.sin(np.outer(theta, k))], axis=1)
    normal = columns.T @ columns + 1e-6 * len(t) * np.eye(columns.shape[1])
    return np.asarray(spline @ np.linalg.solve(normal, columns.T @ theta)[: spline.shape[1]])


def _encoder(recording: Recording, t: Vector, theta: Vector) -> Encoder:
    """Return the path through the angles ``theta`` at times ``t`` after the first event [us] as regular samples."""
    first, last = recording.events.t_first, recording.events.t_last
    times = np.arange(-SAMPLE_US, last - first + 2 * SAMPLE_US, SAMPLE_US, dtype=np.int64)
    begin = _on_line(t[:ENDS], theta[:ENDS], times[0])
    end = _on_line(t[-ENDS:], theta[-ENDS:], times[-1])
    t = np.concatenate([times[:1], t, times[-1:]])
    theta = np.concatenate([[begin], theta, [end]])
    theta -= np.interp(middle_time(recording) - first, t, theta)
    return Encoder(times + first, np.interp(times, t, theta))


def _on_line(t: Vector, theta: Vector, at: float) -> float:
    """Return the angle at the time ``at`` on the line fitted to some angles; the mean if they have the same time."""
    from_mean = t - t.mean()
    speed = float(from_mean @ theta) / max(float(from_mean @ from_mean), 1e-30)
    return float(theta.mean()) + speed * (at - float(t.mean()))


# Cubic splines whose knots are equally far apart in the prism's angle.


def _knots(t: Vector, theta: Vector, per_turn: float) -> Vector:
    """Return the knots of a cubic spline over the times ``t``, ``per_turn`` for each turn of the angle ``theta``."""
    turned = np.maximum.accumulate(np.abs(theta - theta[0])) / math.tau
    turned += 1e-9 * np.arange(len(t))
    pieces = max(1, round(float(turned[-1]) * per_turn))
    inner = np.interp(np.linspace(0.0, float(turned[-1]), pieces + 1), turned, t)
    before, after = float(inner[1] - inner[0]), float(inner[-1] - inner[-2])
    steps = np.arange(1, 4)
    return np.concatenate([inner[0] - before * steps[::-1], inner, inner[-1] + after * steps])


def _design(knots: Vector, t: Vector) -> Any:
    """Return the cubic B-splines of the knots at the times ``t``, constant outside: sparse, shape (n, splines)."""
    from scipy.interpolate import BSpline

    return BSpline.design_matrix(np.clip(t, knots[3], knots[-4]), knots, 3)


# Path from a brightness map: its correction is a spline whose coefficients are fitted to the residuals of the events.

GATE_PAIRS, GATE_TILES = 130_000, 4
"""Approximate number of pairs of events that tell whether the speed varies, and of tiles of the map."""
PAIRS, TILES = 300_000, 8
"""The same for the path itself."""
KNOTS_PER_TURN = 8.0
"""Number of the spline's knots in a turn. They resolve ripple up to the third harmonic."""
PAIRS_PER_KNOT = 100
"""Smallest mean number of pairs for each knot; with fewer pairs there are fewer knots."""
PLAIN_SCALE = 1.0
"""Scale of the Cauchy weights while the residuals may still be large [thresholds]. A smaller one would make the steps
too short."""
FIRST_STEPS, MOST_STEPS = 5, 10
"""Number of steps with this scale, and the largest number of all steps."""
TOLERANCE_PX = 0.001
"""Length of a step at which the path has converged [px rms]."""
LONGEST_EXTRAPOLATION = 3.0
"""Largest factor by which a step is extended, because the steps before shrank slowly."""
SEARCH_STEPS, SEARCH_TOLERANCE = 10, 0.03
"""Largest number of conjugate-gradient steps for the spline's coefficients, and the residual at which they end."""
MAP_STEPS = 12
"""Number of conjugate-gradient steps that find the part of a derivative that a change of the map explains."""
LEAST_DEVIATION_PX = 0.02
"""Smallest deviation from constant speed that is corrected [px rms]."""
GATE_STEPS, FIRST_SHARE = 2, 0.5
"""Number of steps that tell whether the speed varies, and the share of a deviation that the first one finds, as the map
has adapted to the constant speed."""
SIGNIFICANT = 5.0
"""Number of standard deviations from which on a deviation from constant speed is significant."""
LARGEST_ERROR_PX = 0.1
"""Largest accepted error of the path [px rms]."""

SPEED_SHARE = 1.0 / 16.0
"""Part of a mean turn over which a speed is measured for the text."""
MONOTONE = 0.8
"""Smallest share of the range of the speed between the ends of the recording for it to rise or fall."""


class PathFit:
    """Fit of the path of the prism's angle, and of the prism's size, to pairs of events on a brightness map."""

    def __init__(self, recording: Recording, search: Search, pairs: int = PAIRS, tiles: int = TILES) -> None:
        """Collect about ``pairs`` pairs at the answer of ``search``, and solve the map.

        The encoder of ``search`` is the first path: a constant speed, or the encoder of the recording if it has one.
        Raises :class:`AmiwarpError` for too few pairs.
        """
        space, settings = search.space, search.settings.photometric
        self._recording, self._first = recording, search.calibration_events.encoder
        self._pairs, places = collect_everywhere(recording, search, settings, pairs, tiles)
        self._v = space.to_vector({**space.start, **search.best})
        excess = off_excess(self._pairs, with_leak=False)

        def solved_on(tiles: Tiles) -> tuple[Cost, NDArray[np.float32]]:
            brightness = BrightnessMap(self._pairs, tiles, off_excess=excess, middle_us=space.middle_us)
            cost = Cost.on(brightness, space, settings.steps)
            cost.warm_up(self._v)
            return cost, brightness.coverage(cost.scale)

        self._cost, coverage = solved_on(places)
        if places.density > 1.0 and not fine_map_is_determined(coverage, len(self._pairs)):
            self._cost, coverage = solved_on(places.at_density(1.0))
        check_pairs(recording.name, coverage, len(self._pairs))
        self._along_size = size_and_phase_directions(space, self._v)[0]
        self._px = px_per_rad(space, self._v)
        first, last = recording.events.t_first, recording.events.t_last
        # times of the events of the pairs after the first event of the recording [us], shape (2, pairs)
        self._t = self._pairs.time.astype(np.float64) * 1e6 + (space.middle_us - first)
        self._azimuth = self._pairs.arrays.azimuth.numpy().reshape(4, -1).copy()
        times = np.arange(0, last - first + 1, SAMPLE_US, dtype=np.int64)
        theta = self._first.angle_at(times + first)
        turns = abs(float(theta[-1] - theta[0])) / math.tau
        per_turn = min(KNOTS_PER_TURN, max(1.0, len(self._pairs) / PAIRS_PER_KNOT / turns))
        self._knots = _knots(times.astype(np.float64), theta, per_turn)
        self._splines = [_design(self._knots, t) for t in self._t]
        self._found = np.zeros(self._splines[0].shape[1])  # coefficients of the correction that is applied [rad]
        self._last: Vector | None = None  # the last change of these coefficients and of the size [px]

    def deviates(self) -> bool:
        """Return whether the path deviates significantly from the first one, which has a constant speed.

        A step is repeated only if the first one finds a notable part of the deviation.
        """
        for k in range(GATE_STEPS):
            std_px = self._improve(k)[1]
            if self._deviation_px() < max((1.0 if k else FIRST_SHARE) * LEAST_DEVIATION_PX, SIGNIFICANT * std_px):
                return False
        return True

    def run(self) -> tuple[Encoder, float]:
        """Improve the path and the size until the steps are short; return the path and its deviation [px rms].

        The deviation is that from constant speed, or from the recording's encoder. Raises :class:`AmiwarpError` if the
        events do not determine the path.
        """
        for k in range(MOST_STEPS):
            moved_px, std_px = self._improve(k)
            if k > FIRST_STEPS and moved_px < TOLERANCE_PX:
                break
        error_px = max(moved_px, std_px)
        if not error_px <= LARGEST_ERROR_PX:
            raise AmiwarpError(
                f"{self._recording.name}: the prism's speed varies, and the events determine the path of its angle to "
                f"{error_px:.2f} px only; use an encoder, let the prism turn steadily, or show a scene with more edges"
            )
        t = self._first.t - round(self._first.clock_offset_us) - self._recording.events.t_first
        theta = self._first.angle + _design(self._knots, t.astype(np.float64)) @ self._found
        if self._recording.encoder is not None:  # it keeps its zero: the correction has no mean
            return replace(self._first, angle=theta), self._deviation_px()
        theta -= np.interp(middle_time(self._recording) - self._recording.events.t_first, t, theta)
        return Encoder(self._first.t, theta), self._deviation_px()

    def _improve(self, k: int) -> tuple[float, float]:
        """Take step number ``k``; return its length and the standard deviation of the path [px rms]."""
        plain = k < FIRST_STEPS
        self._cost.set_scale(PLAIN_SCALE if plain else max(0.1, 1.5 * self._cost.brightness.residuals.median()))
        change, size_px, std_px = self._step()
        step = np.append(change * self._px, size_px)
        if not np.isfinite(step).all():
            raise self._undetermined()
        if self._last is not None and k not in (0, FIRST_STEPS):
            shrunk = float(step @ self._last) / max(float(self._last @ self._last), 1e-30)
            step = step / (1.0 - min(max(shrunk, -0.5), 1.0 - 1.0 / LONGEST_EXTRAPOLATION))
        self._last = step
        change = step[:-1] / self._px
        self._move(change, float(step[-1]))
        return self._px * float(np.std(self._splines[0] @ change)), std_px

    def _deviation_px(self) -> float:
        """Return the deviation of the present path from constant speed, or from the encoder [px rms]."""
        if self._recording.encoder is not None:
            return self._px * float(np.std(self._splines[0] @ self._found))
        times = np.rint(self._t[0]).astype(np.int64) + self._recording.events.t_first
        angle = self._first.angle_at(times) + self._splines[0] @ self._found
        t = (self._t[0] - self._t[0].mean()) * 1e-6
        return self._px * float(np.std(angle - np.polyval(np.polyfit(t, angle, 1), t)))

    def _step(self) -> tuple[Vector, float, float]:
        """Return the change of the coefficients [rad] and of the size [px], and the path's standard deviation [px].

        The map is eliminated: conjugate gradients use only products with the part of a column that no map explains.
        """
        from scipy.linalg import cho_factor, cho_solve
        from scipy.sparse import csr_array, diags, hstack

        cost, b, n = self._cost, self._cost.brightness, len(self._pairs)
        cost.residuals(self._v, rounds=2)
        residual, weight = (getattr(b.residuals, name).numpy()[:n].astype(np.float64) for name in ("values", "weight"))
        ends, size = self._slopes()
        good = np.isfinite(residual) & np.isfinite(ends).all(axis=0) & np.isfinite(size) & (weight > 0.0)
        residual, weight, size = (np.where(good, x, 0.0) for x in (residual, weight, size))
        ends = np.where(good, ends, 0.0)
        by_end = [diags(end) @ spline for end, spline in zip(ends, self._splines, strict=True)]
        columns: Any = hstack([by_end[0] + by_end[1], csr_array(size[:, None])]).tocsr()
        b.prepare_projection()

        def unexplained(column: Vector) -> Vector:
            padded = np.zeros(self._pairs.arrays.stride, np.float32)
            padded[:n] = column
            left = b.unexplained(wp.array(padded, dtype=float, device=b.device), steps=MAP_STEPS)
            return np.nan_to_num(left.numpy()[:n].astype(np.float64))

        normal: Vector = (columns.T @ diags(weight) @ columns).toarray()
        ridge = 1e-4 * float(np.median(np.diag(normal))) + 1e-12
        try:
            factor = cho_factor(normal + ridge * np.eye(len(normal)))
        except np.linalg.LinAlgError as error:  # knots without events
            raise self._undetermined() from error
        left = -(columns.T @ (weight * unexplained(residual)))
        x, direction = np.zeros(len(left)), cho_solve(factor, left)
        first = power = float(left @ direction)
        for _ in range(SEARCH_STEPS):
            product = columns.T @ (weight * unexplained(columns @ direction)) + ridge * direction
            length = power / max(float(direction @ product), 1e-30)
            x += length * direction
            left -= length * product
            preconditioned = cho_solve(factor, left)
            before, power = power, float(left @ preconditioned)
            if not power > SEARCH_TOLERANCE**2 * first:
                break
            direction = preconditioned + power / before * direction
        change = x[:-1]
        spline, variance = self._splines[0], float(weight @ residual**2) / max(int(np.count_nonzero(good)), 1)
        products, inverse = (spline.T @ spline).toarray() / n, cho_solve(factor, np.eye(len(normal)))[:-1, :-1]
        std = math.sqrt(variance * float(np.sum(inverse * products)))
        return change - float(np.mean(spline @ change)), float(x[-1]), self._px * std

    def _undetermined(self) -> AmiwarpError:
        return AmiwarpError(
            f"{self._recording.name}: the events do not determine the path of the prism's angle at all times; use "
            "an encoder, or record a scene with more edges"
        )

    def _slopes(self) -> tuple[Vector, Vector]:
        """Return the residuals' derivatives by the angle at each event of a pair, shape (2, pairs), and by the size."""
        b, n = self._cost.brightness, len(self._pairs)
        ends = [end.numpy()[:n].astype(np.float64) for end in self._cost.by_angle(self._v)]
        by = SLOPE_PX * self._along_size
        size = b.find_slope(self._cost.at(self._v + by), self._cost.at(self._v - by), 2.0 * SLOPE_PX)
        return np.array(ends), size.numpy()[:n].astype(np.float64)

    def _move(self, change: Vector, size_px: float) -> None:
        """Change the coefficients [rad] and the size [px], and turn the angles of the pairs."""
        self._found += change
        self._v = self._v + size_px * self._along_size
        n, azimuth = len(self._pairs), self._azimuth.copy()
        for k, spline in enumerate(self._splines):
            turn = (self._azimuth[2 * k, :n] + 1j * self._azimuth[2 * k + 1, :n]) * np.exp(1j * (spline @ self._found))
            azimuth[2 * k, :n], azimuth[2 * k + 1, :n] = turn.real, turn.imag
        self._pairs.arrays.azimuth.assign(azimuth.astype(np.float32).ravel())


def speed_in_words(path: Encoder) -> str:
    """Return how the speed of the prism changes along a path."""
    first, last = int(path.t[0]) + SAMPLE_US, int(path.t[-1]) - 2 * SAMPLE_US  # the events' times
    turn = 60e6 / max(abs(path.rpm), 1e-6)
    edges = np.linspace(first, last, 1 + max(2, round((last - first) / max(SPEED_SHARE * turn, 2.0 * SAMPLE_US))))
    angle = path.angle_at(np.rint(edges).astype(np.int64))
    rpm = np.abs(np.diff(angle) / np.diff(edges)) * 60e6 / math.tau
    low, high = float(rpm.min()), float(rpm.max())
    if abs(rpm[-1] - rpm[0]) >= MONOTONE * (high - low):
        return f"{'rose' if rpm[-1] > rpm[0] else 'fell'} from {rpm[0]:.0f} to {rpm[-1]:.0f} rpm"
    return f"varied between {low:.0f} and {high:.0f} rpm"
