"""Systematic errors of an answer, which do not scatter from place to place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.parameters import ParameterSpace, phase_names
from amiwarp.calib.photometric.causes import FLAT_SIDE, Cause
from amiwarp.calib.photometric.cost import size_and_phase_directions
from amiwarp.calib.photometric.derivatives import orbit_of, path_of
from amiwarp.calib.photometric.distances import FOLLOW_PX, displacements
from amiwarp.calib.photometric.linear_fit import LinearFit
from amiwarp.optics.camera import LENS, given_lens
from amiwarp.optics.models import rms

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

GAP_SHARE = 0.5
"""Standard deviation of the answer as a share of the difference between the answers of pairs with long and with short
gaps. Measured on recordings with known truth."""
LEAST_STD_PX = 0.002
"""Least systematic standard deviation [px]."""
MAP_ERROR = {"size": 0.008, "phase": 0.03}
"""Standard deviation of the errors of brightness that all pairs share because the map is interpolated linearly between
nodes [thresholds], as far as they change size and phase. It holds for nodes 1 px apart, and grows with the square of
their distance. Edges in a map are too soft, so that an ON event and the OFF event after it seem further apart: 68 of 73
phases came out too large, by 0.017 thresholds in the median for nodes 1 px apart, and by 0.036 at most in 95 %."""
LENS_DOUBT = 0.01
"""Standard deviation of a given lens: what moves points at the border of the image by this share of their distance from
its middle. Focusing from far to 100 focal lengths changes a focal length by as much."""
DOUBT = 2.0
"""Factor of the standard deviation that a doubtful lens adds: a linearised fit finds too small changes."""


def gap_errors(space: ParameterSpace, fit: LinearFit) -> Vector:
    """Return the covariance of errors that pairs with long and with short gaps do not share [px²]."""
    names = path_of(space)
    which = [space.names.index(n) for n in names]
    change = np.zeros(len(space.names))
    change[which] = fit.fit((*space.names, *(f"long {n}" for n in names))).change[len(space.names) :]
    least = np.zeros(len(change))
    least[which] = LEAST_STD_PX**2
    return np.asarray(GAP_SHARE**2 * np.outer(change, change) + np.diag(least))


def map_errors(space: ParameterSpace, best: Vector, fit: LinearFit, pairs: int, density: float) -> Vector:
    """Return the covariance of errors that the map's interpolation between nodes causes [px²].

    An error of brightness that all pairs share moves the answer by at most its size times the root of their number, in
    standard deviations for independent errors of one threshold.
    """
    others = [n for n in path_of(space) if n not in orbit_of(space)]
    units = [np.eye(len(best))[space.names.index(n)] for n in others]
    along = np.array([*size_and_phase_directions(space, best), *units]).reshape(-1, len(best))
    kinds = ["phase" if name in phase_names() else "size" for name in (*orbit_of(space), *others)]
    error = np.array([MAP_ERROR[kind] / density**2 for kind in kinds])
    inverse = fit.fit(space.names).inverse
    variances = error**2 * pairs * np.einsum("ki,ij,kj->k", along, inverse, along)
    return np.asarray(along.T * variances @ along)


def lens_errors(space: ParameterSpace, best: Vector, fit: LinearFit, least_gain: float) -> Vector:
    """Return the covariance of size and phase [px²] by errors of the given lens that the check cannot see.

    The events tell the displacements. Which apex these mean depends on the lens. Its errors are those of
    :data:`LENS_DOUBT`, up to the size that would be found.
    """
    n = len(best)
    camera = space.camera
    values = space.to_values(best)
    covariance = np.zeros((n, n))
    names = [name for name in LENS if name not in space.names]
    if space.model != "exact" or not space.cartesian or not names:
        return covariance
    # what moves points at the border of the image by as much as the doubt says
    scale = {"focal_length": camera.fx, "k1": (2.0 * camera.fx / camera.width) ** 2, "fy_over_fx": 1.0}
    given = {**given_lens(camera), **values}
    doubts = []
    for name in names:
        error = LENS_DOUBT * scale.get(name, 0.5 * camera.width)
        doubts.append({**values, name: given[name] + error})
    steps = [space.to_values(best + FOLLOW_PX * unit) for unit in np.eye(n)]
    here, *ends = displacements([space.build(each) for each in (values, *steps, *doubts)])
    moved = np.stack(ends, axis=1) - here[:, None]
    moved = moved[np.isfinite(moved).all(axis=1)]
    # largest error that the check would not find, as a multiple of the doubt
    unseen = np.full(len(names), math.inf)
    for k, name in enumerate(names):
        if name in fit.names:
            found = least_gain * fit.squares_sum * float(fit.fit((*space.names, name)).inverse[-1, -1])
            unseen[k] = DOUBT * math.sqrt(found) / max(rms(moved[:, n + k].reshape(-1, 2)), 1e-9)
    # a lens parameter that was not tested looks like a wrong scale
    if names[0] == "focal_length":
        unseen[np.isinf(unseen)] = unseen[0]
    lens = moved[:, n:] * np.minimum(unseen, 1.0)
    follows = FOLLOW_PX * np.linalg.lstsq(moved[:, :n], lens, rcond=None)[0]
    which = [space.names.index(name) for name in orbit_of(space)]
    covariance[np.ix_(which, which)] = follows[which] @ follows[which].T
    return covariance


def errors_of_a_wrong_lens(space: ParameterSpace, fit: LinearFit, causes: Sequence[Cause]) -> Vector:
    """Return the covariance of the answer [px²] if everything else about a lens that was given wrongly is doubtful."""
    others = [n for cause in causes for n in cause.names if n in fit.names and n != FLAT_SIDE]
    estimate = fit.fit((*space.names, *others))
    n = len(space.names)
    return np.asarray(DOUBT**2 * (estimate.covariance[:n, :n] + np.outer(estimate.change[:n], estimate.change[:n])))
