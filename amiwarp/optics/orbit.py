"""Orbits of an optic: the motion of points over a turn, as a mean and a rotation in each direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model

ANGLES = 32
"""Number of angles of a turn at which the motion is computed. Its harmonics up to the 16th do not disturb the first."""


@dataclass(frozen=True)
class Orbits:
    """Motion of points over a turn: ``mean + forward exp(iθ) + backward exp(-iθ)`` [px].

    Real parts are along x, imaginary parts along y. A circle has only one of the two rotations; both make an ellipse.
    """

    mean: NDArray[np.complex128]
    """Mean displacement, shape ``(n,)``."""
    forward: NDArray[np.complex128]
    """Rotation in the direction of the angle θ, shape ``(n,)``."""
    backward: NDArray[np.complex128]
    """Rotation against the direction of θ, shape ``(n,)``."""
    rest: NDArray[np.float64]
    """What further harmonics add, rms over a turn, shape ``(n,)``."""

    @property
    def radius(self) -> float:
        """Mean radius of the larger rotation over all points [px]."""
        return float(np.maximum(np.abs(self.forward), np.abs(self.backward)).mean())


def image_grid(camera: Camera, columns: int, rows: int) -> NDArray[np.float64]:
    """Return points evenly over an image, row by row, shape (rows * columns, 2) [px]."""
    x = np.linspace(0.0, camera.width - 1.0, columns)
    y = np.linspace(0.0, camera.height - 1.0, rows)
    columns_of_points, rows_of_points = np.meshgrid(x, y)
    return np.stack([columns_of_points.ravel(), rows_of_points.ravel()], axis=1)


def orbits_of(model: Model, points: NDArray[np.float64]) -> Orbits:
    """Return the orbits of points, shape (n, 2) [px], about which the model moves the image.

    Raises :class:`AmiwarpError` if the model has two angles, or does not move a point to a finite place.
    """
    if model.ANGLES != 1:
        raise AmiwarpError(
            f"the {model.NAME} model has {model.ANGLES} angles; sums in phase need an optic with one angle"
        )
    angles = np.arange(ANGLES) * (math.tau / ANGLES)
    repeated = np.repeat(points, ANGLES, axis=0)
    moved = model.compensate_points(repeated, np.tile(angles, len(points))) - repeated
    if not np.isfinite(moved).all():
        raise AmiwarpError(
            "the model moves a pixel to no finite place; give the calibration of this recording"
        )
    motion = (moved[:, 0] + 1j * moved[:, 1]).reshape(len(points), ANGLES)
    harmonics = np.fft.fft(motion, axis=1) / ANGLES
    further = np.abs(harmonics[:, 2:-1]) ** 2
    return Orbits(
        mean=harmonics[:, 0],
        forward=harmonics[:, 1],
        backward=harmonics[:, -1],
        rest=np.sqrt(further.sum(axis=1)),
    )
