"""Step of the stage that looks at what is left in each sector of each angle, after all that could be corrected.

Errors of an angle beyond its second harmonic, and steps of it, repeat every turn too. They leave residuals of one sign
in some sectors of the angle.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.photometric.angles import examined_errors, find_high_harmonics, harmonics_of
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.findings import SectorError
from amiwarp.calib.photometric.linear_fit import products_by_square, pseudo_inverse
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.verdicts import angle_names
from amiwarp.kernels.launch import launch
from amiwarp.kernels.residual_slopes import by_sector
from amiwarp.optics.models.registry import MODELS

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

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
    columns: list[Any] = []
    for angle in range(angles):
        columns += _by_sector(cost, v, angle)
    products, _, _ = products_by_square(cost, columns)
    hessian = products[:, :-1, :-1].sum(axis=0)
    gradients = products[:, :-1, -1]
    return hessian, gradients


def _by_sector(cost: Cost, v: Vector, angle: int) -> list[Any]:
    """Return the derivatives of the residuals by an offset of an angle in each of its sectors, on the device."""
    pairs = cost.brightness.pairs
    device = cost.brightness.device
    first, second = cost.by_angle(v, angle)
    number = angle if MODELS[cost.space.model].ANGLES > 1 else -1
    rows = wp.empty((SECTORS, pairs.arrays.stride), dtype=float, device=device)
    inputs = [pairs.arrays, number, first, second]
    launch(by_sector, len(pairs), inputs, [rows], device=device)
    return [rows[k] for k in range(SECTORS)]
