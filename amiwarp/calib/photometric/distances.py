"""How far the models of two answers are apart, and how far events move per angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.comparison import predicted_error
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.models.several import compensate_by_each
from amiwarp.results.parameters import ParameterSpace

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

ROWS = 7
COLUMNS = 9
TURN = 12
"""Numbers of rows and columns of pixels, and of angles of a turn, on which displacements are compared."""
FOLLOW_PX = 0.05
"""Step of the parameters for this comparison [px]."""
MOST_TURNS = 12
"""Turns of the first of two angles in which the largest speed is looked for."""
STEPS_PER_TURN = 96
"""Number of steps of a turn in which it is looked for."""


def over_a_turn(models: Sequence[Model], xy: NDArray[Any]) -> Vector:
    """Return where each of several models of one image moves pixels, shape (n, 2), over a turn [px].

    The result has the shape (models, n, TURN, 2).
    """
    pixels = len(xy)
    theta = np.linspace(0.0, math.tau, TURN, endpoint=False)
    angles = np.tile(theta, pixels)
    points = np.repeat(xy, TURN, axis=0).astype(np.float32)
    moved = compensate_by_each(models, points, angles)
    by_pixel = moved.reshape(len(models), pixels, TURN, 2)
    return np.asarray(by_pixel)


def displacements(
    models: Sequence[Model],
    xy: NDArray[Any] | None = None,
) -> Vector:
    """Return the displacements of pixels over a turn by each of several models of one image [px].

    The pixels ``xy`` have the shape (n, 2); without them a grid is used. The result has one row per model, without the
    mean of each pixel: this moves the pixel's picture, not its events against each other.
    """
    if xy is None:
        xy = _grid(models[0].camera)
    away = over_a_turn(models, xy) - xy[:, None]
    mean = away.mean(axis=2, keepdims=True)
    moving = away - mean
    rows = moving.reshape(len(models), -1)
    return np.asarray(rows)


def _grid(camera: Camera) -> Vector:
    """Return a grid of pixels over the image, shape (n, 2)."""
    columns = np.linspace(0, camera.width - 1, COLUMNS)
    rows = np.linspace(0, camera.height - 1, ROWS)
    x, y = np.meshgrid(columns, rows)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def stated_px(
    space: ParameterSpace,
    v: Vector,
    covariance: Vector,
) -> float:
    """Return the error of the model at ``v`` that its covariance states, constant lag removed [px rms]."""
    here = space.build(space.to_values(v))
    variances, axes = np.linalg.eigh(covariance)
    errors: list[float] = []
    for variance, axis in zip(variances, axes.T, strict=True):
        deviation = math.sqrt(max(0.0, variance))
        values = space.to_values(v + deviation * axis)
        there = space.build(values)
        errors.append(distance(there, here))
    return math.hypot(*errors)


def distance(model: Model, other: Model) -> float:
    """Return the distance of two models over the image and a turn, constant lag removed [px rms]."""
    error = predicted_error(model, other, remove_lag=True, grid=8)
    return error.rms


def px_per_rad(
    space: ParameterSpace,
    best: Vector,
    angle: int = 0,
) -> float:
    """Return how far events move per angle of the model, the one with the number ``angle`` [px rms/rad]."""
    size, phase = MODELS[space.model].ORBITS[angle]
    if size in space.names:
        first = space.names.index(size)
        if first in space.orbits:
            orbit = best[first : first + 2]
            return float(np.linalg.norm(orbit))
    return space.pixels.get(phase, 0.0)


def fastest_px_per_rad(space: ParameterSpace, v: Vector) -> float:
    """Return the largest motion of the image's middle per angle, the first of two, at a search vector [px/rad]."""
    camera = space.camera
    middle_x = 0.5 * (camera.width - 1)
    middle_y = 0.5 * (camera.height - 1)
    turns = MOST_TURNS if MODELS[space.model].ANGLES > 1 else 1
    samples = STEPS_PER_TURN * turns + 1
    theta = np.linspace(0.0, math.tau * turns, samples)
    middle = np.tile([[middle_x, middle_y]], (samples, 1))

    model = space.build(space.to_values(v))
    path = model.compensate_points(middle, theta)
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    return float(lengths.max()) * STEPS_PER_TURN / math.tau
