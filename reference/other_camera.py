"""Independent float64 oracle of two cameras: projection matrices, epipolar lines and analytic rectangles.

Nothing here shares a formula with the package. A camera is a matrix P = K [R' | -R' p] of homogeneous coordinates, the
epipolar line is P+ and the epipole by their textbook form, and a rectangle hides a point if the segment from the camera
to the point crosses its plane inside.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from amiwarp import Camera

Array = NDArray[np.float64]


def projection(camera: Camera, rotation: Array, position: Array) -> Array:
    """Return the 3x4 matrix of a pinhole camera, from its orientation (3, 3) and position (3,) [m] in the world."""
    intrinsics = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0, 0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = position
    return np.asarray(intrinsics @ np.linalg.inv(pose)[:3])


def pixel(matrix: Array, place: Array) -> Array:
    """Return the pixel [px] of a point in the world [m]."""
    x, y, w = matrix @ np.append(place, 1.0)
    return np.array([x / w, y / w])


def epipolar_distance(of_first: Array, of_second: Array, first: Array, second: Array) -> float:
    """Return the distance [px] of a pixel of the second camera from the epipolar line of a pixel of the first one.

    ``of_first``, ``of_second``: the cameras' matrices.
    """
    _, _, rows = np.linalg.svd(of_first)
    epipole = of_second @ rows[-1]
    ray = of_second @ np.linalg.pinv(of_first) @ np.append(first, 1.0)
    line = np.cross(epipole, ray)
    return float(abs(line @ np.append(second, 1.0)) / np.hypot(line[0], line[1]))


def seen_through(matrix: Array, xy: Array, y: float) -> Array:
    """Return the point of the plane with the coordinate ``y`` [m] that a pixel sees, from three linear equations."""
    u, v = xy
    rows = np.array([matrix[0] - u * matrix[2], matrix[1] - v * matrix[2], [0.0, 1.0, 0.0, -y]])
    return np.linalg.solve(rows[:, :3], -rows[:, 3])


def hides(centre: Array, side: float, eye: Array, place: Array) -> bool:
    """Return whether an upright square across the y axis, of a half ``side`` [m], lies between an eye and a point."""
    share = (centre[1] - eye[1]) / (place[1] - eye[1])
    crossing = eye + share * (place - eye)
    inside = np.abs(crossing - centre)[[0, 2]] < side
    return bool(0.0 < share < 1.0 - 1e-3 and inside.all())
