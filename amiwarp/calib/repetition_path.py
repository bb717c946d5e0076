"""Smooth path of the prism's angle from the repetition of the events.

A still scene gives equally many events in each turn, whatever the speed. With time counted in events, ON minus OFF
events per cell therefore repeat with a constant period. A smooth speed then follows from the events' times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.first_guess import autocorrelation
from amiwarp.calib.path_splines import SAMPLE_US, knots_over, spline_matrix
from amiwarp.calib.thinning import middle_time, thin
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording

Vector = NDArray[np.float64]

MOST_EVENTS = 2_000_000
"""Largest number of events that are counted, evenly thinned."""
EVENTS_PER_BIN = 500
FEWEST_BINS = 256
MOST_BINS = 8192
"""Number of events per bin, and limits of the number of bins."""
CELL = 8
MOST_CELLS = 1500
"""Smallest side of the cells in which events are counted [px], and the largest number of cells."""
COMPONENTS = 12
HARMONICS = 6
"""Number of principal components of the counts, and of harmonics of the angle that describe each of them."""
UNLIKE = 0.3
"""Correlation below which two bins are different views of the scene."""
LIKE = 0.7
"""Smallest correlation after a turn, as a share of the largest one."""
LEAST_CORRELATION = 0.4
"""Smallest correlation at which events are considered to repeat. It was 0.7 at least where they do, 0.3 by chance."""
STEPS = 12
LONGEST_STEP = 0.5
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
    line = np.polyfit(t, theta, 1)
    constant = np.asarray(np.polyval(line, t), np.float64)
    if float(np.std(theta - constant)) < LEAST_VARIATION:
        return []
    left_by_constant = _unexplained(constant, counts)
    if left_by_constant < LEAST_RATIO * left:
        return []
    forwards = _smooth(t, theta)
    backwards = -forwards
    return [_encoder(recording, t, forwards), _encoder(recording, t, backwards)]


def _count(recording: Recording) -> tuple[Vector, Vector, Vector]:
    """Return for each bin of equally many events its time [us], its angle [rad], and its counts, shape (bins, m).

    Times are from the first event on. The angles assume equally many events in each turn. The counts are principal
    components of ON minus OFF events per cell. Raises :class:`AmiwarpError` if they do not repeat.
    """
    events = thin(recording, MOST_EVENTS)
    count = len(events)

    # Bins of equally many events, with the time of the event in the middle of each.
    bins = min(max(count // EVENTS_PER_BIN, FEWEST_BINS), MOST_BINS)
    bin_of_event = np.arange(count) * bins // count
    middles = (np.arange(bins) + 0.5) * count / bins
    elapsed = events.t[middles.astype(np.int64)] - events.t[0]
    t = elapsed.astype(np.float64)

    # Square cells of pixels.
    width, height = recording.events.size
    least_side = math.sqrt(width * height / MOST_CELLS)
    side = max(CELL, math.ceil(least_side))
    columns = math.ceil(width / side)
    rows = math.ceil(height / side)
    cells = rows * columns
    cell_of_event = events.y // side * columns + events.x // side

    slot = bin_of_event * cells + cell_of_event
    signs = 2.0 * events.p - 1.0
    sums = np.bincount(slot, weights=signs, minlength=bins * cells)
    counts: Any = sums.reshape(bins, cells)
    counts -= counts.mean(axis=0)

    components = _principal_components(counts)
    correlation = autocorrelation(components.astype(np.float32))
    period = _period(correlation, recording.name)
    step = math.tau / period
    theta = np.asarray(np.arange(bins) * step, np.float64)
    return t, theta, np.asarray(components, np.float64)


def _principal_components(counts: Vector) -> Vector:
    """Return the :data:`COMPONENTS` principal components of counts without their mean, shape (bins, components)."""
    cells = counts.shape[1]
    rng = np.random.default_rng(0)
    along = rng.normal(size=(cells, 2 * COMPONENTS))
    for _ in range(6):  # subspace iteration
        along, _ = np.linalg.qr(counts.T @ (counts @ along))
    found: Vector = counts @ along
    axes = np.linalg.svd(found, full_matrices=False)[2]
    return np.asarray(found @ axes[:COMPONENTS].T)


def _period(correlation: Vector, name: str) -> float:
    """Return the lag after which events repeat [bins]: the first strong peak after the correlation has fallen."""
    inner = correlation[1:-1]
    rises = inner > correlation[:-2]
    falls = inner >= correlation[2:]
    peaks = 1 + np.flatnonzero(rises & falls)
    fallen = np.argmax(correlation < UNLIKE)
    peaks = peaks[peaks > fallen]

    always_alike = correlation.min() >= UNLIKE
    if always_alike or not len(peaks) or correlation[peaks].max() < LEAST_CORRELATION:
        raise AmiwarpError(
            f"{name}: the events do not repeat, so the prism's path cannot be found; use an encoder",
            ErrorCode.CALIBRATION_REFUSED,
        )
    height = correlation[peaks]
    is_strong = height >= LIKE * height.max()
    first = peaks[is_strong][0]
    near = peaks[(peaks >= first) & (peaks < 1.3 * first)]
    return float(near[np.argmax(correlation[near])])


@dataclass(frozen=True)
class _HarmonicFit:
    """Fit of the counts by harmonics of the angle."""

    basis: Vector
    """Orthonormal basis of the harmonics, shape (bins, 2 · harmonics + 1)."""
    slope: Vector
    """Derivative of the fitted counts by the angle, in the shape of the counts."""
    left: float
    """Share of the counts' squares that it leaves."""


def _fit_harmonics(theta: Vector, counts: Vector) -> _HarmonicFit:
    """Fit the counts by harmonics of the angle."""
    orders = np.arange(1, HARMONICS + 1)
    cos = np.cos(np.outer(theta, orders))
    sin = np.sin(np.outer(theta, orders))
    constant = np.ones((len(theta), 1))
    design = np.concatenate([constant, cos, sin], axis=1)
    fit = np.linalg.lstsq(design, counts, rcond=None)[0]
    derivative = np.concatenate([-orders * sin, orders * cos], axis=1)
    residual = counts - design @ fit
    squares_left = (residual**2).sum()
    squares = max(float((counts**2).sum()), 1e-30)
    return _HarmonicFit(
        basis=np.linalg.qr(design)[0],
        slope=derivative @ fit[1:],
        left=float(squares_left / squares),
    )


def _unexplained(theta: Vector, counts: Vector) -> float:
    """Return the share of the counts' squares that harmonics of the angle leave."""
    return _fit_harmonics(theta, counts).left


def _follow(u: Vector, counts: Vector) -> tuple[Vector, float]:
    """Return the angles for which functions of the angle explain the counts best, and the share that they leave.

    ``u`` are first angles; a spline with a knot per turn corrects them, because noise gives events in slow turns too.
    """
    theta = u.copy()
    spline = spline_matrix(knots_over(u, u, 1.0), u).toarray()
    for _ in range(STEPS):
        step = _gauss_newton_step(theta, counts, spline)

        # The mean angle is arbitrary.
        step -= step.mean()
        largest = float(np.abs(step).max())
        theta += step * min(1.0, LONGEST_STEP / max(largest, 1e-12))
        if largest < CONVERGED:
            break
    return theta, _unexplained(theta, counts)


def _gauss_newton_step(theta: Vector, counts: Vector, spline: Vector) -> Vector:
    """Return the change of the angles by a spline that explains most of what the harmonics of the angle do not."""
    fit = _fit_harmonics(theta, counts)
    basis = fit.basis
    by_coefficients = fit.slope[:, :, None] * spline[:, None, :]
    columns = by_coefficients.reshape(len(theta), -1)
    columns -= basis @ (basis.T @ columns)
    residual = counts - basis @ (basis.T @ counts)
    columns = columns.reshape(-1, spline.shape[1])

    normal = columns.T @ columns
    curvature = float(np.trace(normal))
    ridge = 1e-6 * curvature / len(normal) * np.eye(len(normal))
    right = columns.T @ residual.ravel()
    coefficients = np.linalg.solve(normal + ridge, right)
    return np.asarray(spline @ coefficients)


def _smooth(t: Vector, theta: Vector) -> Vector:
    """Return the path that is smooth in time, with a knot per turn.

    Counts that repeat determine the angle up to a periodic function of itself, which is chosen here.
    """
    spline = spline_matrix(knots_over(t, theta, 1.0), t).toarray()
    orders = np.arange(1, GAUGE_HARMONICS + 1)
    cos = np.cos(np.outer(theta, orders))
    sin = np.sin(np.outer(theta, orders))
    columns = np.concatenate([spline, cos, sin], axis=1)
    ridge = 1e-6 * len(t) * np.eye(columns.shape[1])
    normal = columns.T @ columns + ridge
    coefficients = np.linalg.solve(normal, columns.T @ theta)
    knots = spline.shape[1]
    return np.asarray(spline @ coefficients[:knots])


def _encoder(recording: Recording, t: Vector, theta: Vector) -> Encoder:
    """Return the path through the angles ``theta`` at times ``t`` after the first event [us] as regular samples."""
    first = recording.events.t_first
    last = recording.events.t_last
    end_us = last - first + 2 * SAMPLE_US
    times = np.arange(-SAMPLE_US, end_us, SAMPLE_US, dtype=np.int64)
    before = times[0]
    behind = times[-1]
    begin = _on_line(t[:ENDS], theta[:ENDS], before)
    end = _on_line(t[-ENDS:], theta[-ENDS:], behind)
    all_times = np.concatenate([[before], t, [behind]])
    angles = np.concatenate([[begin], theta, [end]])
    middle = middle_time(recording) - first
    angles -= np.interp(middle, all_times, angles)
    return Encoder(times + first, np.interp(times, all_times, angles))


def _on_line(t: Vector, theta: Vector, at: float) -> float:
    """Return the angle at the time ``at`` on the line fitted to some angles; the mean if they have the same time."""
    from_mean = t - t.mean()
    square = float(from_mean @ from_mean)
    speed = float(from_mean @ theta) / max(square, 1e-30)
    elapsed = at - float(t.mean())
    return float(theta.mean()) + speed * elapsed
