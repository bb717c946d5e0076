"""Derivatives of the residuals at the photometric stage's answer: by parameters, and by what is not free.

They are on the device, and found once for each solution of the map.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.photometric.causes import (
    FLAT_SIDE,
    SIDE,
    SuspectedError,
    other_side,
    values_with_other_side,
    with_cause,
)
from amiwarp.calib.photometric.cost import place_arguments
from amiwarp.errors import AmiwarpError
from amiwarp.kernels.launch import launch
from amiwarp.kernels.residual_slopes import by_shift, multiply
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.parameters import DRIFTS, RATES, ParameterSpace, orbit_names

if TYPE_CHECKING:
    from amiwarp.calib.photometric.cost import Cost

    Vector = NDArray[np.float64]

SHAKE = ("shake x cos", "shake x sin", "shake y cos", "shake y sin")
"""Names of the unknown amplitudes of a rotation of the camera about x and y that repeats every turn [px]."""
SLOPE_PX = 0.02
"""Step of the finite differences that give the derivatives of the residuals [px]."""


def orbit_of(space: ParameterSpace) -> list[str]:
    """Return the names of the free ones of size and phase, of each prism."""
    of_orbits = orbit_names(MODELS[space.model])
    return [name for name in space.names if name in of_orbits]


def path_of(space: ParameterSpace) -> list[str]:
    """Return the names of the free parameters that shape the path of the image: size and phase for glass."""
    kind = MODELS[space.model]
    if kind.PRISM:
        return orbit_of(space)
    return [name for name in space.names if name in kind.FREE]


def masked(column: Any, factor: Any) -> Any:
    """Return a derivative times a factor for each pair, all on the device."""
    out = wp.empty_like(column)
    launch(multiply, len(column), [column, factor], [out], device=column.device)
    return out


def slopes(
    cost: Cost,
    space: ParameterSpace,
    v: Vector,
    names: Iterable[str],
) -> dict[str, Any]:
    """Return the derivatives of the residuals by parameters of ``space`` at its search vector ``v``, by name.

    They are on the device. The map must be solved at ``v``.
    """
    columns = {}
    for name in names:
        column = cost.known_column(name)
        if column is None:
            step = np.zeros(len(v))
            step[space.names.index(name)] = SLOPE_PX
            up = place_arguments(space, space.to_values(v + step))
            down = place_arguments(space, space.to_values(v - step))
            slope = cost.brightness.find_slope(up, down, 2.0 * SLOPE_PX)
            column = cost.keep_column(name, slope)
        columns[name] = column
    return columns


def shifted(
    cost: Cost,
    v: Vector,
    shift: Any,
    angle: int | None = None,
) -> Any:
    """Return the derivative of the residuals by a factor of ``shift``, changes of the angle at the ends of pairs.

    ``angle`` is the number of the only angle that changes; None for a drift of all.

    ``shift`` is a Warp array of shape (2 · padded pairs,), or (2, padded pairs). The map must be solved at ``v``.
    """
    first, second = cost.by_angle(v, angle)
    column = wp.empty_like(first)
    launch(
        by_shift,
        len(first),
        [first, second, shift.flatten()],
        [column],
        device=first.device,
    )
    return column


def by_parts_of_pairs(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by the free parameters, and of some pairs only by size and phase.

    ``long …`` are the derivatives of pairs with long gaps only; ``late …`` grow with the time of the pair.
    """
    space = cost.space
    columns = slopes(cost, space, best, space.names)
    late, long = cost.brightness.pairs.split_by_time()
    for name in path_of(space):
        columns[f"long {name}"] = masked(columns[name], long)
    # A free drift or a moving camera changes size and phase over time anyway.
    drifts = not set(DRIFTS).isdisjoint(space.names)
    if not drifts and not space.moving:
        for name in orbit_of(space):
            columns[f"late {name}"] = masked(columns[name], late)
    return columns


def by_rotation(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by a slow rotation of the camera about each axis, if it is not free."""
    space = cost.space
    if space.moving:
        return {}
    at = cost.at(best)
    times = cost.brightness.pairs.some_times
    half_s = max(0.5 * float(np.ptp(times)), 1e-6)
    rate = SLOPE_PX / space.camera.fx / half_s  # moves the middle by the step in half the time
    columns = {}
    for name, axis in zip(RATES, np.eye(3), strict=True):
        column = cost.known_column(name)
        if column is None:
            # One-sided differences: a camera at rest is faster to compute, and only the gain counts.
            x, y, z = axis * rate
            turning = {**at, "camera_rotation": CameraRotation((x, y, z))}
            slope = cost.brightness.find_slope(turning, at, SLOPE_PX)
            column = cost.keep_column(name, slope)
        columns[name] = column
    return columns


def by_shake(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by rotations of the camera that repeat every turn, for a still camera.

    They are rotations about x and about y by the cosine and by the sine of the encoder's angle [px at the centre].
    """
    kind = MODELS[cost.space.model]
    if cost.space.moving or not orbit_of(cost.space):
        return {}
    if kind.ANGLES > 1 or not kind.PRISM:
        return {}
    patterns = cost.brightness.pairs.angle_patterns((0.0, 0.0))
    cos = patterns[0].flatten()
    sin = patterns[1].flatten()
    columns = [
        by_swing(cost, best, cos, axis=0),
        by_swing(cost, best, sin, axis=0),
        by_swing(cost, best, cos, axis=1),
        by_swing(cost, best, sin, axis=1),
    ]
    return dict(zip(SHAKE, columns, strict=True))


def by_swing(cost: Cost, best: Vector, wave: Any, axis: int) -> Any:
    """Return the derivative of the residuals by a rotation of the camera about x (0) or y (1) that follows a wave [px].

    ``wave`` is a Warp array of its values at the ends of pairs, shape (2 · padded pairs,) or (2, padded pairs).
    """
    # A rotation is linear in time. With the wave as the time, it follows the wave.
    waving = cost.brightness.pairs.with_columns(time=wave)
    at = {**cost.at(best), "arrays": waving}
    middle_us = cost.brightness.middle_us
    rate = SLOPE_PX / cost.space.camera.fx
    x, y = np.eye(2)[axis] * rate
    there = CameraRotation((x, y, 0.0), middle_us=middle_us)
    back = CameraRotation((-x, -y, 0.0), middle_us=middle_us)
    return cost.brightness.find_slope(
        {**at, "camera_rotation": there},
        {**at, "camera_rotation": back},
        2.0 * SLOPE_PX,
    )


def by_wave_of_angle(cost: Cost, best: Vector, wave: Vector) -> Any:
    """Return the derivative of the residuals by a change of all angles, with its values at the ends of pairs [rad].

    ``wave`` has the shape (2, pairs).
    """
    pairs = cost.brightness.pairs
    padded = np.zeros((2, pairs.arrays.stride), np.float32)
    padded[:, : len(pairs)] = wave
    shift = wp.array(padded, dtype=float, device=cost.brightness.device)
    return shifted(cost, best, shift)


def by_cause(cost: Cost, best: Vector, cause: SuspectedError) -> dict[str, Any]:
    """Return the derivatives of the residuals by the parameters of a cause, by name."""
    space = cost.space
    values = space.to_values(best)
    try:
        if cause == SIDE:
            column = cost.known_column(FLAT_SIDE)
            if column is None:
                other = place_arguments(other_side(space), values_with_other_side(space, values))
                here = place_arguments(space, values)
                slope = cost.brightness.find_slope(other, here, 1.0)
                column = cost.keep_column(FLAT_SIDE, slope)
            return {FLAT_SIDE: column}
        wide, v = with_cause(space, cause, values)
    except AmiwarpError:
        return {}  # it moves no event
    return slopes(cost, wide, v, cause.names)
