"""Systematic errors of an answer, which do not scatter from place to place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.photometric.causes import FLAT_SIDE, SuspectedError
from amiwarp.calib.photometric.cost import size_and_phase_directions
from amiwarp.calib.photometric.derivatives import orbit_of, path_of
from amiwarp.calib.photometric.distances import FOLLOW_PX, displacements
from amiwarp.calib.photometric.linear_fit import LinearFit
from amiwarp.optics.camera import LENS, given_lens
from amiwarp.optics.models.comparison import rms
from amiwarp.results.parameters import ParameterSpace, phase_names

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

GAP_SHARE = 0.5
"""Standard deviation of the answer as a share of the difference between the answers of pairs with long and with short
gaps. Measured on recordings with known truth."""
LEAST_STD_PX = 0.002
"""Least systematic standard deviation of a parameter, and of the motion by all of them [px]."""
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
    of_long_gaps = [f"long {name}" for name in names]
    estimate = fit.fit((*space.names, *of_long_gaps))
    count = len(space.names)
    change = np.zeros(count)
    which = [space.names.index(name) for name in names]
    change[which] = estimate.change[count:]
    return np.asarray(GAP_SHARE**2 * np.outer(change, change))


def least_errors(space: ParameterSpace) -> Vector:
    """Return the covariance of the least errors of the parameters of the motion [px²]."""
    of_motion = path_of(space)
    variances = np.zeros(len(space.names))
    for k, name in enumerate(space.names):
        if name in of_motion:
            variances[k] = LEAST_STD_PX**2
    return np.diag(variances)


def map_errors(
    space: ParameterSpace,
    best: Vector,
    fit: LinearFit,
    pairs: int,
    density: float,
) -> Vector:
    """Return the covariance of errors that the map's interpolation between nodes causes [px²].

    An error of brightness that all pairs share moves the answer by at most its size times the root of their number, in
    standard deviations for independent errors of one threshold.
    """
    # The search directions of sizes and phases, and how wrong the map makes each of them.
    orbit = orbit_of(space)
    others = [name for name in path_of(space) if name not in orbit]
    directions = [*size_and_phase_directions(space, best)]
    units = np.eye(len(best))
    for name in others:
        directions.append(units[space.names.index(name)])
    along = np.array(directions).reshape(-1, len(best))

    errors = []
    for name in (*orbit, *others):
        kind = "phase" if name in phase_names() else "size"
        errors.append(MAP_ERROR[kind] / density**2)
    error = np.array(errors)

    inverse = fit.fit(space.names).inverse
    of_one_threshold = np.einsum("ki,ij,kj->k", along, inverse, along)
    variances = error**2 * pairs * of_one_threshold
    return np.asarray(along.T * variances @ along)


def lens_errors(
    space: ParameterSpace,
    best: Vector,
    fit: LinearFit,
    least_gain: float,
) -> Vector:
    """Return the covariance of size and phase [px²] by errors of the given lens that the check cannot see.

    The events tell the displacements. Which apex these mean depends on the lens. Its errors are as large as
    :data:`LENS_DOUBT`, up to the size that would be found.
    """
    count = len(best)
    covariance = np.zeros((count, count))
    names = [name for name in LENS if name not in space.names]
    if space.model != "exact" or not space.cartesian or not names:
        return covariance

    by_parameters, by_lens = _moves(space, best, names)

    # largest error that the check would not find, as a multiple of the doubt
    unseen = np.full(len(names), math.inf)
    for k, name in enumerate(names):
        if name in fit.names:
            estimate = fit.fit((*space.names, name))
            variance = float(estimate.inverse[-1, -1])
            found = least_gain * fit.squares_sum * variance
            by_doubt = by_lens[:, k].reshape(-1, 2)
            doubt_px = max(rms(by_doubt), 1e-9)
            unseen[k] = DOUBT * math.sqrt(found) / doubt_px
    # a lens parameter that was not tested looks like a wrong scale
    if names[0] == "focal_length":
        unseen[np.isinf(unseen)] = unseen[0]

    # The free parameters follow what is not seen.
    hidden = by_lens * np.minimum(unseen, 1.0)
    explained, *_ = np.linalg.lstsq(by_parameters, hidden, rcond=None)
    which = [space.names.index(name) for name in orbit_of(space)]
    follows = FOLLOW_PX * explained
    covariance[np.ix_(which, which)] = follows[which] @ follows[which].T
    return covariance


def _moves(space: ParameterSpace, best: Vector, names: Sequence[str]) -> tuple[Vector, Vector]:
    """Return how displacements change with a step of each free parameter, and with a doubt about each lens parameter.

    Both have a row for each displacement, and a column for each parameter.
    """
    camera = space.camera
    values = space.to_values(best)
    count = len(best)
    models = [space.build(values)]
    for unit in np.eye(count):
        step = space.to_values(best + FOLLOW_PX * unit)
        models.append(space.build(step))

    # what moves points at the border of the image by as much as the doubt says
    scale = {
        "focal_length": camera.fx,
        "k1": (2.0 * camera.fx / camera.width) ** 2,
        "fy_over_fx": 1.0,
    }
    given = {**given_lens(camera), **values}
    for name in names:
        error = LENS_DOUBT * scale.get(name, 0.5 * camera.width)
        doubt = {**values, name: given[name] + error}
        models.append(space.build(doubt))

    here, *ends = displacements(models)
    moved = np.stack(ends, axis=1) - here[:, None]
    seen = np.isfinite(moved).all(axis=1)
    moved = moved[seen]
    return moved[:, :count], moved[:, count:]


def errors_of_a_wrong_lens(
    space: ParameterSpace,
    fit: LinearFit,
    causes: Sequence[SuspectedError],
) -> Vector:
    """Return the covariance of the answer [px²] if everything else about a lens that was given wrongly is doubtful."""
    others: list[str] = []
    for cause in causes:
        for name in cause.names:
            if name in fit.names and name != FLAT_SIDE:
                others.append(name)
    estimate = fit.fit((*space.names, *others))
    count = len(space.names)
    change = estimate.change[:count]
    covariance = estimate.covariance[:count, :count]
    square = np.outer(change, change)
    return np.asarray(DOUBT**2 * (covariance + square))
