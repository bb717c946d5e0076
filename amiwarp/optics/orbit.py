"""Motion of points over a turn of an optic: as an orbit, which is a mean and two rotations, or as any closed path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model

ANGLES = 32
"""Number of angles of a turn at which the motion is computed. Its harmonics up to the 16th do not disturb the first."""

GRID_PX = 32
"""Distance of the points of :func:`grid_of_image` [px]."""


@dataclass(frozen=True)
class LockedAngles:
    """How the second angle of an optic follows the first one, so that the motion repeats.

    Examples
    --------
    >>> amiwarp.LockedAngles(turns=2, second_turns=-3, second_at_zero=0.5)
    LockedAngles(turns=2, second_turns=-3, second_at_zero=0.5)
    """

    turns: int
    """Number of turns of the first angle after which both angles are as before, at least 1."""
    second_turns: int
    """Number of turns of the second angle meanwhile; negative if it turns the other way."""
    second_at_zero: float
    """Second angle where the first one is 0 [rad]."""


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


def grid_of_image(camera: Camera) -> tuple[int, int]:
    """Return the numbers of columns and rows of a grid that shows how the motion varies over an image."""
    columns = max(2, 1 + math.ceil((camera.width - 1) / GRID_PX))
    rows = max(2, 1 + math.ceil((camera.height - 1) / GRID_PX))
    return columns, rows


def spread_over(camera: Camera, values: NDArray[Any], columns: int, rows: int) -> NDArray[Any]:
    """Return values at the points of :func:`image_grid`, interpolated linearly at all pixels, shape (height, width)."""
    grid = values.reshape(rows, columns)
    lines = _interpolated(grid, np.linspace(0.0, rows - 1.0, camera.height))
    return _interpolated(lines.T, np.linspace(0.0, columns - 1.0, camera.width)).T


def _interpolated(rows: NDArray[Any], places: NDArray[np.float64]) -> NDArray[Any]:
    """Return the rows of an array at places between them, interpolated linearly."""
    below = np.minimum(places.astype(np.intp), len(rows) - 2)
    share = (places - below)[:, None]
    return rows[below] + share * (rows[below + 1] - rows[below])


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


def paths_of(
    model: Model, points: NDArray[np.float64], angles: int, locked: LockedAngles | None
) -> NDArray[np.complex128]:
    """Return the motion of points over a period of an optic [px], shape (n, angles), at even steps of the angle.

    Real parts are along x, imaginary parts along y. The period is a turn; with two angles, which ``locked`` ties
    together, it is some turns of the first one. Raises :class:`AmiwarpError` if a model with two angles has none that
    ties them, or a point moves to no finite place.
    """
    if model.ANGLES == 2 and locked is None:
        raise AmiwarpError(
            f"the {model.NAME} model has two angles, and the sums do not say how the second one follows the first; "
            "take the sums of a PhaseReconstruction, or use the method 'solver'"
        )
    first = np.arange(angles) * (math.tau / angles)
    seen = first
    if locked is not None and model.ANGLES == 2:
        second = locked.second_turns * first + locked.second_at_zero
        seen = np.stack([locked.turns * first, second], axis=1)
    repeated = np.repeat(points, angles, axis=0)
    moved = model.compensate_points(repeated, np.concatenate([seen] * len(points))) - repeated
    if not np.isfinite(moved).all():
        raise AmiwarpError(
            "the model moves a pixel to no finite place; give the calibration of this recording"
        )
    return np.asarray(moved[:, 0] + 1j * moved[:, 1]).reshape(len(points), angles)
