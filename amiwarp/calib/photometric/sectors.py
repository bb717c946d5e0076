"""Step of the stage that looks at what is left in each sector of each angle, after all that could be corrected.

Errors of an angle beyond its second harmonic, and steps of it, repeat every turn too. They leave residuals of one sign
in some sectors of the angle.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.photometric.angles import examined_errors, harmonics_of
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.findings import SectorError
from amiwarp.calib.photometric.linear_fit import SQUARE_PX, pseudo_inverse
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.optics.models import MODELS

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

SECTORS = 12
"""Number of sectors of a turn."""
FOUND_SHARE = 0.3
"""Share of an error that is found while the map is fixed, which has absorbed the rest. It was 0.27 to 0.3 for third
harmonics of 1 and 2 degrees of a wedge and of a pair."""
LEAST_RATIO = 3.0
"""Size of the offsets relative to the size that chance gives, from which on they are examined."""


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
    found: list[SectorError] = []
    for angle, (offsets, ratio) in enumerate(zip(*sector_offsets(cost, v), strict=True)):
        if ratio >= LEAST_RATIO and harmonics_of(angle) in examined_errors(kind):
            worst = int(np.argmax(np.abs(offsets)))
            moved_px = px_per_rad(space, v, angle) * float(offsets.std()) / FOUND_SHARE
            found.append(SectorError(space.model, angle, (worst + 0.5) * math.tau / SECTORS, moved_px))
    return state.noticing(max(found, key=lambda each: each.moved_px)) if found else state


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
    pairs = cost.brightness.pairs
    n = len(pairs)
    residual = _on_host(cost.brightness.residuals.values, n)
    weight = _on_host(cost.brightness.residuals.weight, n)
    # the column of each angle's sector, and the slope by that angle, at both events of a pair
    column: list[NDArray[np.int64]] = []
    slope: list[Vector] = []
    for angle in range(angles):
        column += [SECTORS * angle + sector for sector in _sectors_of(cost, angle)]
        slope += [_on_host(end, n) for end in cost.by_angle(v, angle)]
    # squares of pixels, of which only those with pairs are numbered
    width = -(-cost.space.camera.width // SQUARE_PX)
    row_of_squares = pairs.column("y").astype(np.int64) // SQUARE_PX
    column_of_squares = pairs.column("x").astype(np.int64) // SQUARE_PX
    used, square = np.unique(row_of_squares * width + column_of_squares, return_inverse=True)
    count = angles * SECTORS
    hessian = np.zeros((count, count))
    parts = np.zeros((len(used), count))
    for at, by in zip(column, slope, strict=True):
        parts += np.bincount(square * count + at, weight * by * residual, parts.size).reshape(parts.shape)
        for other_at, other_by in zip(column, slope, strict=True):
            products = np.bincount(at * count + other_at, weight * by * other_by, hessian.size)
            hessian += products.reshape(hessian.shape)
    # the mean of all sectors of an angle is a part of its phase
    centred = np.kron(np.eye(angles), np.eye(SECTORS) - 1.0 / SECTORS)
    inverse = pseudo_inverse(centred @ hessian @ centred)
    offsets = -inverse @ parts.sum(axis=0)
    scatter = (parts - parts.mean(axis=0)) @ inverse
    by_chance = np.sqrt(np.sum(scatter**2, axis=0).reshape(angles, SECTORS).sum(axis=1))
    each = offsets.reshape(angles, SECTORS)
    return each, np.linalg.norm(each, axis=1) / np.maximum(by_chance, 1e-12)


def _sectors_of(cost: Cost, angle: int) -> NDArray[np.int64]:
    """Return the number of the sector of an angle at both events of each pair, shape (2, pairs)."""
    pairs = cost.brightness.pairs
    stored = pairs.arrays.azimuth.numpy().reshape(2, 2, -1)[:, :, : len(pairs)]
    if MODELS[cost.space.model].ANGLES > 1:
        turned = stored[:, angle].astype(np.float64)
    else:
        turned = np.arctan2(stored[:, 1], stored[:, 0]).astype(np.float64)
    return np.floor(turned % math.tau / math.tau * SECTORS).astype(np.int64) % SECTORS


def _on_host(column: Any, count: int) -> Vector:
    """Return a column of the pairs as numbers, with 0 for pairs off the map, shape (count,)."""
    return np.nan_to_num(column.numpy()[:count]).astype(np.float64)
