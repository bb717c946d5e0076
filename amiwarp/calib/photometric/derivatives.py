"""Derivatives of the residuals at the photometric stage's answer: by parameters, and by what is not free.

They are on the device, and found once for each solution of the map.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.parameters import DRIFTS, RATES, ParameterSpace, orbit_names
from amiwarp.calib.photometric.causes import FLAT_SIDE, SIDE, Cause, other_side, turned, with_cause
from amiwarp.calib.photometric.cost import place_arguments
from amiwarp.errors import AmiwarpError
from amiwarp.kernels.equations import by_shift, multiply
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import CameraRotation
from amiwarp.optics.models import MODELS

if TYPE_CHECKING:
    from amiwarp.calib.photometric.cost import Cost

    Vector = NDArray[np.float64]

SHAKE = ("shake x cos", "shake x sin", "shake y cos", "shake y sin")
"""Names of the unknown amplitudes of a rotation of the camera about x and y that repeats every turn [px]."""
SLOPE_PX = 0.02
"""Step of the finite differences that give the derivatives of the residuals [px]."""


def orbit_of(space: ParameterSpace) -> list[str]:
    """Return the names of the free ones of size and phase, of each prism."""
    return [n for n in space.names if n in orbit_names(MODELS[space.model])]


def path_of(space: ParameterSpace) -> list[str]:
    """Return the names of the free parameters that shape the path of the image: size and phase for glass."""
    kind = MODELS[space.model]
    return orbit_of(space) if kind.PRISM else [n for n in space.names if n in kind.FREE]


def masked(column: Any, factor: Any) -> Any:
    """Return a derivative times a factor for each pair, all on the device."""
    out = wp.empty_like(column)
    launch(multiply, len(column), [column, factor], [out], device=column.device)
    return out


def slopes(cost: Cost, space: ParameterSpace, v: Vector, names: Iterable[str]) -> dict[str, Any]:
    """Return the derivatives of the residuals by parameters of ``space`` at its search vector ``v``, by name.

    They are on the device. The map must be solved at ``v``.
    """

    def by(name: str) -> Any:
        step = np.zeros(len(v))
        step[space.names.index(name)] = SLOPE_PX
        up = place_arguments(space, space.to_values(v + step))
        down = place_arguments(space, space.to_values(v - step))
        return cost.brightness.find_slope(up, down, 2.0 * SLOPE_PX)

    return {name: cost.column(name, partial(by, name)) for name in names}


def shifted(cost: Cost, v: Vector, shift: Any, angle: int | None = None) -> Any:
    """Return the derivative of the residuals by a factor of ``shift``, changes of the angle at the ends of pairs.

    ``angle`` is the number of the only angle that changes; None for a drift of all.

    ``shift`` is a Warp array of shape (2 · padded pairs,), or (2, padded pairs). The map must be solved at ``v``.
    """
    first, second = cost.by_drift(v) if angle is None else cost.by_angle(v, angle)
    out = wp.empty_like(first)
    launch(by_shift, len(first), [first, second, shift.flatten()], [out], device=first.device)
    return out


def by_parts_of_pairs(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by the free parameters, and those of some pairs by size and phase.

    ``long …`` are the derivatives of pairs with long gaps only; ``late …`` grow with the time of the pair.
    """
    space = cost.space
    columns = slopes(cost, space, best, space.names)
    late, long = cost.brightness.pairs.split_by_time()
    for name in path_of(space):
        columns[f"long {name}"] = masked(columns[name], long)
    drifts = bool(set(DRIFTS) & set(space.names)) or space.moving
    for name in [] if drifts else orbit_of(space):
        columns[f"late {name}"] = masked(columns[name], late)
    return columns


def by_rotation(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by a slow rotation of the camera about each axis, if it is not free."""
    space = cost.space
    if space.moving:
        return {}
    at = cost.at(best)
    half_s = max(0.5 * float(np.ptp(cost.brightness.pairs.some_times)), 1e-6)

    def about(axis: Vector) -> Any:
        x, y, z = axis * (SLOPE_PX / space.camera.fx / half_s)
        # one-sided differences: a camera at rest is faster to compute, and only the gain counts
        return cost.brightness.find_slope({**at, "camera_rotation": CameraRotation((x, y, z))}, at, SLOPE_PX)

    return {name: cost.column(name, partial(about, axis)) for name, axis in zip(RATES, np.eye(3), strict=True)}


def by_shake(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by rotations of the camera that repeat every turn, for a still camera.

    They are rotations about x and about y by the cosine and by the sine of the encoder's angle [px at the centre].
    """
    kind = MODELS[cost.space.model]
    if cost.space.moving or not orbit_of(cost.space) or kind.ANGLES > 1 or not kind.PRISM:
        return {}
    rows = cost.brightness.pairs.angle_patterns((0.0, 0.0))
    return {name: by_swing(cost, best, rows[k % 2].flatten(), k // 2) for k, name in enumerate(SHAKE)}


def by_swing(cost: Cost, best: Vector, wave: Any, axis: int) -> Any:
    """Return the derivative of the residuals by a rotation of the camera about x (0) or y (1) that follows a wave [px].

    ``wave`` is a Warp array of its values at the ends of pairs, shape (2 · padded pairs,) or (2, padded pairs).
    """
    pairs = cost.brightness.pairs
    at = cost.at(best)
    middle_us = cost.brightness.middle_us
    x, y = np.eye(2)[axis] * (SLOPE_PX / cost.space.camera.fx)
    up = {**at, "camera_rotation": CameraRotation((x, y, 0.0), middle_us=middle_us)}
    down = {**at, "camera_rotation": CameraRotation((-x, -y, 0.0), middle_us=middle_us)}
    given = pairs.arrays.time
    try:
        # a rotation is linear in time: with the wave as the time, it follows the wave
        pairs.arrays.time = wave
        return cost.brightness.find_slope(up, down, 2.0 * SLOPE_PX)
    finally:
        pairs.arrays.time = given


def by_wave_of_angle(cost: Cost, best: Vector, wave: Vector) -> Any:
    """Return the derivative of the residuals by a change of all angles, with its values at the ends of pairs [rad].

    ``wave`` has the shape (2, pairs).
    """
    pairs = cost.brightness.pairs
    shift = np.zeros((2, pairs.arrays.stride), np.float32)
    shift[:, : len(pairs)] = wave
    return shifted(cost, best, wp.array(shift, dtype=float, device=cost.brightness.device))


def by_cause(cost: Cost, best: Vector, cause: Cause) -> dict[str, Any]:
    """Return the derivatives of the residuals by the parameters of a cause, by name."""
    space = cost.space
    values = space.to_values(best)
    try:
        if cause == SIDE:
            other = place_arguments(other_side(space), turned(space, values))
            here = place_arguments(space, values)
            return {FLAT_SIDE: cost.column(FLAT_SIDE, partial(cost.brightness.find_slope, other, here, 1.0))}
        wide, v = with_cause(space, cause, values)
    except AmiwarpError:
        return {}  # it moves no event
    return slopes(cost, wide, v, cause.names)
