"""How far an optic moves the image while its angle changes: the length of its path per radian."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.models.base import Model
from amiwarp.optics.models.plate import NOMINAL_INVERSE_DEPTH, PlateModel

PLACES = 7
"""Number of rows and of columns of pixels at which the displacement is computed."""
ANGLES = 48
"""Number of angles of a turn at which it is computed."""
STEP = 1e-2
"""Change of the angle between two places of a pixel's path [rad]."""


def optic_speed(optic: Model) -> NDArray[np.float64]:
    """Return the largest speed of the image by each angle of the optic [px/rad], shape (angles,).

    What a plate moves depends on depth: at least on that at which a search starts.
    """
    if isinstance(optic, PlateModel):
        depth = max(optic.inverse_depth, NOMINAL_INVERSE_DEPTH)
        optic = replace(optic, inverse_depth=depth)
    camera = optic.camera
    columns = np.linspace(0.0, camera.width - 1.0, PLACES)
    rows = np.linspace(0.0, camera.height - 1.0, PLACES)
    x, y = np.meshgrid(columns, rows)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    turn = np.arange(ANGLES) * (math.tau / ANGLES)
    xy = np.repeat(pixels, ANGLES, axis=0)
    theta = np.tile(turn, len(pixels))
    both = theta if optic.ANGLES == 1 else np.stack([theta, theta], axis=1)
    here = optic.compensate_points(xy, both)
    speeds = []
    for k in range(optic.ANGLES):
        later = both + STEP * np.eye(optic.ANGLES)[k] if optic.ANGLES > 1 else both + STEP
        there = optic.compensate_points(xy, later)
        moved = np.linalg.norm(there - here, axis=1)
        speeds.append(float(np.nanmax(moved, initial=0.0)) / STEP)
    return np.array(speeds)
