"""What is said of an answer's error: how well the events determine it, and what could hide that they do not show.

The two are figures of their own. The *deviation* is a standard deviation of the motion that the answer takes out of the
events. A cause that was looked for, and not found, could still be there by as much as the events do not exclude: then
the motion is wrong by up to the *bound* of that cause. Both are for the motion of events, not for a parameter: an apex
angle may be uncertain by 1 % because the focal length is, and the motion is the same for both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.photometric.causes import SIDE, SuspectedError, with_cause
from amiwarp.calib.photometric.distances import FOLLOW_PX
from amiwarp.calib.photometric.linear_fit import LinearFit
from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.models.several import compensate_by_each
from amiwarp.results.parameters import ParameterSpace

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

ROWS = 7
COLUMNS = 9
"""Numbers of rows and columns of pixels at which motions are compared."""
ANGLES = 12
"""Number of angles in each turn at which motions are compared."""
TURNS = {1: 1, 2: 12}
"""Number of turns of the first angle in which they are compared, by the number of angles of the optic: two angles meet
in ever new ways."""
LAG_RAD = 0.01
"""Angle of the finite difference that gives the effect of a constant lag [rad]."""
FOUND_OF_LENS = 0.45
"""Share of the error of a lens that a linearised fit finds at depths that were found through it. It was 0.4 of k1 =
-0.08, 0.43 of k1 = -0.03, and 0.48 of k1 = -0.008."""
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
    # Found depths follow a lens. What matters is the motion at depths that are known from elsewhere.
    space = replace(space, depths=None)
    xy = _grid(space.camera)
    turns = TURNS[MODELS[space.model].ANGLES]
    theta = np.arange(turns * ANGLES, dtype=np.float64) * (math.tau / ANGLES)

    # By finite differences: each parameter, and a constant lag.
    here = space.build(space.to_values(v))
    models = [here]
    for unit in np.eye(len(v)):
        values = space.to_values(v + FOLLOW_PX * unit)
        models.append(space.build(values))
    at, *ends = _motions(models, xy, theta)
    changes = [(end - at).ravel() for end in ends]
    slopes = np.array(changes) / FOLLOW_PX
    (late,) = _motions([here], xy, theta + LAG_RAD)
    lag = (late - at).ravel() / LAG_RAD

    # Take out what a constant lag makes up for.
    seen = np.isfinite(lag) & np.isfinite(slopes).all(axis=0)
    lag = np.where(seen, lag, 0.0)
    slopes = np.where(seen, slopes, 0.0)
    square = float(lag @ lag)
    if square > 0.0:
        by_lag = slopes @ lag / square
        slopes -= np.outer(by_lag, lag)
    return np.asarray(slopes.reshape(len(v), -1, 2))


def _grid(camera: Camera) -> Vector:
    """Return the pixels at which motions are compared, shape (n, 2)."""
    columns = np.linspace(0, camera.width - 1, COLUMNS)
    rows = np.linspace(0, camera.height - 1, ROWS)
    x, y = np.meshgrid(columns, rows)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _motions(models: Sequence[Model], xy: Vector, theta: Vector) -> Vector:
    """Return where models move pixels (m, 2) at angles (k,) [px], without the mean of each pixel, (models, m, k, 2)."""
    pixels = len(xy)
    count = len(theta)
    points = np.repeat(xy, count, axis=0).astype(np.float32)
    angles = np.tile(theta, pixels)
    moved = compensate_by_each(models, points, angles)
    of_pixels = moved.reshape(len(models), pixels, count, 2)
    mean = of_pixels.mean(axis=2, keepdims=True)
    return np.asarray(of_pixels - mean)


def spread_px(slopes: Vector, covariance: Vector) -> float:
    """Return the standard deviation of the motion of events [px rms] for a covariance of the search vector [px²].

    ``slopes`` come from :func:`motion_slopes`, shape (n, points, 2).
    """
    points = slopes.shape[1]
    products = np.einsum("ipk,jpk->ij", slopes, slopes) / points
    variance = float(np.sum(products * covariance))
    return math.sqrt(max(0.0, variance))


def shift_px(slopes: Vector, change: Vector) -> float:
    """Return how far a change of the search vector [px], shape (n,), moves events [px rms]."""
    return spread_px(slopes, np.outer(change, change))


def hidden_px(
    space: ParameterSpace,
    v: Vector,
    fit: LinearFit,
    causes: Iterable[SuspectedError],
) -> dict[str, float]:
    """Return by how much the motion may be wrong for each cause that was looked for [px rms], by its words.

    A cause may be there by its estimate, and by :data:`BOUND` standard deviations more. The free parameters follow it.
    """
    alone = fit.fit(space.names)
    count = len(space.names)
    bounds = {}
    for cause in causes:
        names = set(cause.names)
        was_looked_for = cause != SIDE and names.issubset(fit.names)
        if not was_looked_for or not names.isdisjoint(space.names):
            continue
        try:
            wide, at = with_cause(space, cause, space.to_values(v))
        except AmiwarpError:
            continue  # it moves no event
        estimate = fit.fit((*space.names, *cause.names))
        # What the parameters scatter by anyway belongs to the deviation.
        covariance = estimate.covariance.copy()
        covariance[:count, :count] -= alone.covariance
        slopes = motion_slopes(wide, at)
        estimate_px = shift_px(slopes, estimate.change)
        deviation_px = spread_px(slopes, covariance)
        found_share = FOUND_OF_LENS if space.depths is not None else 1.0
        bounds[cause.words] = (estimate_px + BOUND * deviation_px) / found_share
    return bounds
