"""What is said of an answer's error: how well the events determine it, and what could hide that they do not show.

The two are figures of their own. The *deviation* is a standard deviation of the motion that the answer takes out of the
events. A cause that was looked for, and not found, could still be there by as much as the events do not exclude: then
the motion is wrong by up to the *bound* of that cause. Both are for the motion of events, not for a parameter: an apex
angle may be uncertain by 1 % because the focal length is, and the motion is the same for both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.parameters import ParameterSpace
from amiwarp.calib.photometric.causes import SIDE, Cause, with_cause
from amiwarp.calib.photometric.distances import FOLLOW_PX
from amiwarp.calib.photometric.linear_fit import LinearFit
from amiwarp.errors import AmiwarpError
from amiwarp.optics.models import MODELS, Model, compensate_by_each

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

ROWS, COLUMNS = 7, 9
"""Numbers of rows and columns of pixels at which motions are compared."""
ANGLES = 12
"""Number of angles in each turn at which motions are compared."""
TURNS = {1: 1, 2: 12}
"""Number of turns of the first angle in which they are compared, by the number of angles of the optic: two angles meet
in ever new ways."""
LAG_RAD = 0.01
"""Angle of the finite difference that gives the effect of a constant lag [rad]."""
BOUND = 2.0
"""Number of standard deviations that a bound allows a cause beyond its estimate."""


def motion_slopes(space: ParameterSpace, v: Vector) -> Vector:
    """Return how the motion of events changes with each parameter, where no constant lag can make up for it.

    Parameters
    ----------
    space : ParameterSpace
        Space of the search vector.
    v : ndarray
        Search vector [px], shape (n,).

    Returns
    -------
    ndarray
        Changes [px/px], shape (n, points, 2), at pixels and angles over the image and over turns. The mean of each
        pixel is taken out: it moves the picture, not events against each other.
    """
    camera = space.camera
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, COLUMNS), np.linspace(0, camera.height - 1, ROWS))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    turns = TURNS[MODELS[space.model].ANGLES]
    theta = np.arange(turns * ANGLES, dtype=np.float64) * (math.tau / ANGLES)
    steps = [space.to_values(v + FOLLOW_PX * unit) for unit in np.eye(len(v))]
    here = space.build(space.to_values(v))
    at, *ends = _motions([here, *map(space.build, steps)], xy, theta)
    late = _motions([here], xy, theta + LAG_RAD)[0]
    lag = (late - at).ravel() / LAG_RAD
    slopes = np.array([(end - at).ravel() / FOLLOW_PX for end in ends])
    seen = np.isfinite(lag) & np.isfinite(slopes).all(axis=0)
    lag = np.where(seen, lag, 0.0)
    slopes = np.where(seen, slopes, 0.0)
    square = float(lag @ lag)
    if square > 0.0:
        slopes -= np.outer(slopes @ lag / square, lag)
    return np.asarray(slopes.reshape(len(v), -1, 2))


def _motions(models: Sequence[Model], xy: Vector, theta: Vector) -> Vector:
    """Return where models move pixels (m, 2) at angles (k,) [px], without the mean of each pixel, (models, m, k, 2)."""
    points = np.repeat(xy, len(theta), axis=0).astype(np.float32)
    angles = np.tile(theta, len(xy))
    moved = compensate_by_each(models, points, angles).reshape(len(models), len(xy), len(theta), 2)
    return np.asarray(moved - moved.mean(axis=2, keepdims=True))


def spread_px(slopes: Vector, covariance: Vector) -> float:
    """Return the standard deviation of the motion of events [px rms] for a covariance of the search vector [px²].

    ``slopes`` are those of :func:`motion_slopes`, shape (n, points, 2).
    """
    products = np.einsum("ipk,jpk->ij", slopes, slopes) / slopes.shape[1]
    return math.sqrt(max(0.0, float(np.sum(products * covariance))))


def shift_px(slopes: Vector, change: Vector) -> float:
    """Return how far a change of the search vector [px], shape (n,), moves events [px rms]."""
    return spread_px(slopes, np.outer(change, change))


def hidden_px(space: ParameterSpace, v: Vector, fit: LinearFit, causes: Iterable[Cause]) -> dict[str, float]:
    """Return by how much the motion may be wrong for each cause that was looked for [px rms], by its words.

    A cause may be there by its estimate, and by :data:`BOUND` standard deviations more. The free parameters follow it.
    """
    bounds = {}
    for cause in causes:
        if cause == SIDE or not {*cause.names} <= {*fit.names} or {*cause.names} & {*space.names}:
            continue
        try:
            wide, at = with_cause(space, cause, space.to_values(v))
        except AmiwarpError:
            continue  # it moves no event
        estimate = fit.fit((*space.names, *cause.names))
        alone = fit.fit(space.names)
        n = len(space.names)
        # What the parameters scatter by anyway belongs to the deviation.
        covariance = estimate.covariance.copy()
        covariance[:n, :n] -= alone.covariance
        slopes = motion_slopes(wide, at)
        bounds[cause.words] = shift_px(slopes, estimate.change) + BOUND * spread_px(slopes, covariance)
    return bounds
