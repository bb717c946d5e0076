"""Step of the stage that looks at what is left in each sector of each angle, after all that could be corrected.

Errors of an angle beyond its second harmonic, and steps of it, repeat every turn too. They leave residuals of one sign
in some sectors of the angle.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.photometric.angles import examined_errors, find_high_harmonics, harmonics_of
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.findings import SectorError
from amiwarp.calib.photometric.linear_fit import SQUARE_PX, pseudo_inverse
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.verdicts import angle_names
from amiwarp.optics.models.registry import MODELS

if TYPE_CHECKING:
    Vector = NDArray[np.float64]
    Integers = NDArray[np.int64]

ERROR_THAT_REPEATS = "an error that repeats with"
"""Words of what could hide in an angle of the model, before the name of the angle."""
SECTORS = 12
"""Number of sectors of a turn."""
FOUND_SHARE = 0.3
"""Share of an error that is found while the map is fixed, which has absorbed the rest. It was 0.27 to 0.3 for third
harmonics of 1 and 2 degrees of a wedge and of a pair."""
LEAST_FOUND_SHARE = 0.1
"""Smallest share of an error that was found, for the bound of what could hide. It was 0.12 of a third harmonic of 1
degree of a wedge."""
LEAST_RATIO = 3.0
"""Size of the offsets relative to the size that chance gives, above which they are examined."""


def note_what_sectors_leave(state: Refinement) -> Refinement:
    """Note the angle with the largest error that is left in some of its sectors.

    Slow pixels leave a part of their lags, which looks alike and is reported already.
    """
    if not state.are_angles_examined or state.time_constant_us:
        return state
    space = state.space
    kind = MODELS[space.model]
    cost = state.search.cost
    v = state.answer.x
    cost.converge(v)
    all_offsets, ratios = sector_offsets(cost, v)
    found: list[SectorError] = []
    for angle in range(kind.ANGLES):
        if harmonics_of(angle) not in examined_errors(kind):
            continue
        offsets = all_offsets[angle]
        left_px = px_per_rad(space, v, angle) * float(offsets.std())
        words = f"{ERROR_THAT_REPEATS} {angle_names(kind)[angle]}"
        state = state.hiding(words, left_px / LEAST_FOUND_SHARE)
        if ratios[angle] >= LEAST_RATIO:
            worst = int(np.argmax(np.abs(offsets)))
            at_rad = (worst + 0.5) * math.tau / SECTORS
            error_px = left_px / FOUND_SHARE
            found.append(SectorError(space.model, angle, at_rad, error_px))
    if not found:
        return state
    largest = max(found, key=lambda each: each.moved_px)
    if space.depths is None:
        largest = replace(largest, harmonics=find_high_harmonics(state.search, v))
    return state.noticing(largest)


def sector_offsets(cost: Cost, v: Vector) -> tuple[Vector, Vector]:
    """Return the offsets of each angle in its sectors that remove most of the residuals while the map is fixed.

    The map must be solved at ``v``.

    Returns
    -------
    offsets : numpy.ndarray
        Correction of each angle in each of its sectors [rad], without their mean, which is part of the phase, shape
        (angles, SECTORS).
    ratios : numpy.ndarray
        Size of the offsets of each angle relative to the size that chance gives, by the scatter of squares of pixels,
        shape (angles,).
    """
    angles = MODELS[cost.space.model].ANGLES
    hessian, gradients = _normal_equations(cost, v)

    # the mean of all sectors of an angle is a part of its phase
    without_mean = np.eye(SECTORS) - 1.0 / SECTORS
    centred = np.kron(np.eye(angles), without_mean)
    inverse = pseudo_inverse(centred @ hessian @ centred)
    offsets = -inverse @ gradients.sum(axis=0)
    scatter = (gradients - gradients.mean(axis=0)) @ inverse
    variances = np.sum(scatter**2, axis=0).reshape(angles, SECTORS)
    by_chance = np.sqrt(variances.sum(axis=1))
    of_angles = offsets.reshape(angles, SECTORS)
    sizes = np.linalg.norm(of_angles, axis=1)
    return of_angles, sizes / np.maximum(by_chance, 1e-12)


def _normal_equations(cost: Cost, v: Vector) -> tuple[Vector, Vector]:
    """Return the Hessian by the offsets of all sectors, and the gradient of each square of pixels that has pairs."""
    angles = MODELS[cost.space.model].ANGLES
    residuals = cost.brightness.residuals
    pairs = len(cost.brightness.pairs)
    residual = _on_host(residuals.values, pairs)
    weight = _on_host(residuals.weight, pairs)

    # The column of each angle's sector, and the slope by that angle, at both events of a pair.
    column: list[Integers] = []
    slope: list[Vector] = []
    for angle in range(angles):
        for sector in _sectors_of(cost, angle):
            column.append(SECTORS * angle + sector)
        for at_event in cost.by_angle(v, angle):
            slope.append(_on_host(at_event, pairs))

    columns = angles * SECTORS
    squares, square = _squares_of(cost)
    hessian = np.zeros((columns, columns))
    gradients = np.zeros((squares, columns))
    for at, by in zip(column, slope, strict=True):
        place = square * columns + at
        gradient = np.bincount(place, weight * by * residual, gradients.size)
        gradients += gradient.reshape(gradients.shape)
        for other_at, other_by in zip(column, slope, strict=True):
            place = at * columns + other_at
            products = np.bincount(place, weight * by * other_by, hessian.size)
            hessian += products.reshape(hessian.shape)
    return hessian, gradients


def _squares_of(cost: Cost) -> tuple[int, Integers]:
    """Return the number of the squares of pixels that have pairs, and the number of each pair's square among them."""
    pairs = cost.brightness.pairs
    columns = math.ceil(cost.space.camera.width / SQUARE_PX)
    row = pairs.column("y").astype(np.int64) // SQUARE_PX
    column = pairs.column("x").astype(np.int64) // SQUARE_PX
    used, square = np.unique(row * columns + column, return_inverse=True)
    return len(used), square


def _sectors_of(cost: Cost, angle: int) -> Integers:
    """Return the number of the sector of an angle at both events of each pair, shape (2, pairs)."""
    pairs = cost.brightness.pairs
    padded = pairs.arrays.azimuth.numpy().reshape(2, 2, -1)
    stored = padded[:, :, : len(pairs)]
    if MODELS[cost.space.model].ANGLES > 1:
        turned = stored[:, angle].astype(np.float64)
    else:
        cos = stored[:, 0]
        sin = stored[:, 1]
        turned = np.arctan2(sin, cos).astype(np.float64)
    share_of_turn = turned % math.tau / math.tau
    sector = np.floor(share_of_turn * SECTORS)
    return sector.astype(np.int64) % SECTORS


def _on_host(column: Any, count: int) -> Vector:
    """Return a column of the pairs as numbers, with 0 for pairs off the map, shape (count,)."""
    of_pairs = column.numpy()[:count]
    return np.nan_to_num(of_pairs).astype(np.float64)
