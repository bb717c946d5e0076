"""How far the models of two answers are apart, and how far events move per angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.parameters import ParameterSpace
from amiwarp.optics.models import MODELS, Model, compensate_by_each, predicted_error

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

ROWS, COLUMNS, TURN = 7, 9, 12
"""Numbers of rows and columns of pixels, and of angles of a turn, on which displacements are compared."""
FOLLOW_PX = 0.05
"""Step of the parameters for that comparison [px]."""
MOST_TURNS = 12
"""Turns of the first of two angles in which the largest speed is looked for."""
STEPS_PER_TURN = 96
"""Number of steps of a turn for that."""


def over_a_turn(models: Sequence[Model], xy: NDArray[Any]) -> Vector:
    """Return where each of several models of one image moves pixels, shape (n, 2), over a turn [px].

    The result has the shape (models, n, TURN, 2).
    """
    theta = np.linspace(0.0, math.tau, TURN, endpoint=False)
    points = np.repeat(xy, TURN, axis=0).astype(np.float32)
    angles = np.tile(theta, len(xy))
    moved = compensate_by_each(models, points, angles)
    return np.asarray(moved.reshape(len(models), len(xy), TURN, 2))


def displacements(models: Sequence[Model], xy: NDArray[Any] | None = None) -> Vector:
    """Return the displacements of pixels over a turn by each of several models of one image [px].

    The pixels ``xy`` have the shape (n, 2); without them a grid is used. The result has one row per model, without the
    mean of each pixel: this moves the pixel's picture, not its events against each other.
    """
    if xy is None:
        camera = models[0].camera
        columns = np.linspace(0, camera.width - 1, COLUMNS)
        rows = np.linspace(0, camera.height - 1, ROWS)
        x, y = np.meshgrid(columns, rows)
        xy = np.stack([x.ravel(), y.ravel()], axis=1)
    away = over_a_turn(models, xy) - xy[:, None]
    mean = away.mean(axis=2, keepdims=True)
    return np.asarray((away - mean).reshape(len(models), -1))


def stated_px(space: ParameterSpace, v: Vector, covariance: Vector) -> float:
    """Return the error of the model at ``v`` that its covariance states, constant lag removed [px rms]."""
    variances, axes = np.linalg.eigh(covariance)
    here = space.build(space.to_values(v))
    errors: list[float] = []
    for variance, axis in zip(variances, axes.T, strict=True):
        end = v + math.sqrt(max(0.0, variance)) * axis
        there = space.build(space.to_values(end))
        errors.append(distance(there, here))
    return math.hypot(*errors)


def distance(model: Model, other: Model) -> float:
    """Return the distance of two models over the image and a turn, constant lag removed [px rms]."""
    return predicted_error(model, other, remove_lag=True, grid=8).rms


def px_per_rad(space: ParameterSpace, best: Vector, angle: int = 0) -> float:
    """Return how far events move per angle of the model, the one with the number ``angle`` [px rms/rad]."""
    size, phase = MODELS[space.model].ORBITS[angle]
    if size in space.names:
        first = space.names.index(size)
        if first in space.orbits:
            return float(np.linalg.norm(best[first : first + 2]))
    return space.pixels.get(phase, 0.0)


def fastest_px_per_rad(space: ParameterSpace, v: Vector) -> float:
    """Return the largest motion of the image's middle per angle, the first of two, at a search vector [px/rad]."""
    camera = space.camera
    middle = np.array([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]])
    turns = MOST_TURNS if MODELS[space.model].ANGLES > 1 else 1
    theta = np.linspace(0.0, math.tau * turns, STEPS_PER_TURN * turns + 1)
    model = space.build(space.to_values(v))
    path = model.compensate_points(np.repeat(middle, len(theta), axis=0), theta)
    longest = float(np.linalg.norm(np.diff(path, axis=0), axis=1).max())
    return longest * STEPS_PER_TURN / math.tau
