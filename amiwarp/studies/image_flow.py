"""Speed of the image behind moving optics: blur by errors of clock and angle, and events."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.studies.orbits import ACROSS_IMAGE, DOWN_IMAGE, TURN_ANGLES

ANGLE_STEP = 0.2
"""Half of the angle over which derivatives with respect to an angle are difference quotients [rad]. They are exact for
harmonics."""


def flow_of(model: Model, pixels: NDArray[np.float64], turns: int) -> NDArray[np.float64]:
    """Return how fast the image moves with each angle of a model [px/rad], shape (angles, pixels, times, 2).

    The times are :data:`TURN_ANGLES` a turn of the first angle. Pixels without a ray are NaN.
    """
    theta = np.arange(TURN_ANGLES * turns) * (math.tau / TURN_ANGLES)
    # Every pixel at every time
    xy = np.repeat(pixels, len(theta), axis=0)
    angles = model.all_angles(np.tile(theta, len(pixels)))

    def places_at(angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels without the optic at its angles, shape (n, number of angles) [rad]."""
        if model.ANGLES == 1:
            return model.compensate_points(xy, angles[:, 0])
        return model.compensate_points(xy, angles)

    flow = []
    for step in ANGLE_STEP * np.eye(model.ANGLES):
        after = places_at(angles + step)
        before = places_at(angles - step)
        flow.append((after - before) / (2.0 * math.sin(ANGLE_STEP)))
    return np.reshape(flow, (model.ANGLES, len(pixels), len(theta), 2))


def across_edges(error: NDArray[np.float64], flow: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean square of errors across the edges that fire, for edges of all directions, shape (pixels,).

    An edge fires at the rate at which ``flow`` (pixels, times, 2) crosses it, which is c for an edge whose normal has
    the cosine c with it. ⟨c³⟩ / ⟨c⟩ is 2/3 of the part of an ``error`` along the flow, and ⟨c s²⟩ / ⟨c⟩ is 1/3 of the
    part across it.
    """
    speed = np.linalg.norm(flow, axis=2)
    along = np.sum(error * flow, axis=2) / np.maximum(speed, 1e-12)
    # 2/3 of along² and 1/3 of across², where along² + across² = error²
    whole_square = np.sum(error**2, axis=2)
    square = (whole_square + along**2) / 3.0
    # Mean over time: faster images fire more events.
    total_speed = np.sum(speed, axis=1)
    weighted = np.sum(speed * square, axis=1)
    return np.asarray(weighted / np.maximum(total_speed, 1e-12))


def change_of(
    flow: NDArray[np.float64], slopes: tuple[NDArray[Any], NDArray[Any]], camera: Camera
) -> NDArray[np.float64]:
    """Return the distance by which the log intensity of each pixel goes up and down [1/s], shape (height, width).

    ``flow``: velocity of the image on the grid of :func:`image_grid` [px/s], shape (pixels, times, 2); ``slopes``:
    gradient of log intensity along y and x [1/px]. The change is the mean of |∇L · v|. On circles it is 4 r |∇L| a
    turn.
    """
    field = np.nan_to_num(flow).reshape(DOWN_IMAGE, ACROSS_IMAGE, -1, 2)
    rows = _interpolation(camera.height, DOWN_IMAGE)
    columns = _interpolation(camera.width, ACROSS_IMAGE)
    slope_down, slope_across = slopes
    total = np.zeros((camera.height, camera.width))
    for velocity in np.moveaxis(field, 2, 0):
        across = rows @ velocity[..., 0] @ columns.T
        down = rows @ velocity[..., 1] @ columns.T
        total += np.abs(across * slope_across + down * slope_down)
    return total / field.shape[2]


def _interpolation(count: int, nodes: int) -> NDArray[np.float64]:
    """Return the matrix (count, nodes) that interpolates linearly between evenly spaced nodes, first to last pixel."""
    place = np.linspace(0.0, nodes - 1.0, count)
    from_node = np.abs(place[:, None] - np.arange(nodes))
    return np.maximum(0.0, 1.0 - from_node)
