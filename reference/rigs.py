"""Independent float64 NumPy oracle of a rig: poses, frames and depth of a plane, noise, and epipolar lines.

The world is a wall whose brightness is a sine along x, or a plain wall. Light is a closed form of the place on the
wall; frames integrate it with Gauss-Legendre nodes over each row's exposure, where the package takes the middles of
equal parts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

NODES = 64
"""Number of Gauss-Legendre nodes of an exposure."""


def homogeneous(rotation: Array, position: Array) -> Array:
    """Return the 4x4 matrix of a pose."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = position
    return matrix


def mounted_pose(rig: Array, to_rig: Array) -> Array:
    """Return the 4x4 pose of a camera, from the rig's 4x4 pose and the camera's 3x4 place on it."""
    return rig @ np.vstack([to_rig, [0.0, 0.0, 0.0, 1.0]])


def felt_acceleration(
    pose_at: Callable[[float], Array], t: float, gravity: float, step: float = 1e-3
) -> Array:
    """Return what an accelerometer at a camera's centre feels [m/s^2]: a fourth-order difference of its places."""
    offsets = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    weights = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / (12.0 * step**2)
    places = np.stack([pose_at(t + step * k)[:3, 3] for k in offsets])
    acceleration = weights @ places + (0.0, 0.0, gravity)
    return pose_at(t)[:3, :3].T @ acceleration


def turning(pose_at: Callable[[float], Array], t: float, step: float = 1e-4) -> Array:
    """Return the angular velocity of a camera in its own frame [rad/s], by a central difference."""
    before = Rotation.from_matrix(pose_at(t - step)[:3, :3])
    after = Rotation.from_matrix(pose_at(t + step)[:3, :3])
    return np.asarray((before.inv() * after).as_rotvec() / (2.0 * step))


def sine_frame(
    columns: Array,
    row_begins_s: Array,
    exposure_s: float,
    *,
    speed: float,
    distance: float,
    period: float,
    blur_m: float,
) -> Array:
    """Return the light of a camera that moves along x in front of a wall whose brightness is a sine of x.

    ``columns``: tangents of the columns' rays; ``row_begins_s``: begin of each row's exposure [s]; ``speed``: of the
    camera [m/s]; ``distance`` and ``period`` [m]; ``blur_m``: standard deviation of the blur on the wall [m].
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    t = row_begins_s[:, None, None] + exposure_s * (nodes + 1.0) / 2.0
    x = speed * t + distance * columns[None, :, None]
    amplitude = 0.4 * np.exp(-2.0 * (np.pi * blur_m / period) ** 2)
    light = 0.5 + amplitude * np.sin(2.0 * np.pi * x / period)
    return np.asarray(light @ weights / 2.0)


def plane_depth(rays: Array, pose: Array, normal: Array, offset: float) -> Array:
    """Return the depth along the optical axis [m] at which rays (n, 3) with z = 1 meet a plane: normal . x = offset."""
    towards = rays @ (pose[:3, :3].T @ normal)
    return (offset - normal @ pose[:3, 3]) / towards


def srgb(light: Array) -> Array:
    """Return sRGB values of linear light: the inverse of IEC 61966-2-1's decoding, by bisection."""
    low = np.zeros_like(light)
    high = np.ones_like(light)
    for _ in range(60):
        middle = (low + high) / 2.0
        decoded = np.where(middle <= 0.04045, middle / 12.92, ((middle + 0.055) / 1.055) ** 2.4)
        low = np.where(decoded < light, middle, low)
        high = np.where(decoded < light, high, middle)
    return (low + high) / 2.0


def epipolar_distance(
    left: Array, right: Array, left_to_right: Array, left_lens: Array, right_lens: Array
) -> Array:
    """Return the distances of points of the right image from the epipolar lines of points of the left one [px].

    ``left``, ``right``: pixels, (n, 2); ``left_to_right``: 4x4 matrix of the frames; lenses: 3x3 pinhole matrices.
    """
    tx, ty, tz = left_to_right[:3, 3]
    cross = np.array([[0.0, -tz, ty], [tz, 0.0, -tx], [-ty, tx, 0.0]])
    essential = cross @ left_to_right[:3, :3]
    fundamental = np.linalg.inv(right_lens).T @ essential @ np.linalg.inv(left_lens)
    ones = np.ones((len(left), 1))
    lines = np.hstack([left, ones]) @ fundamental.T
    across = np.sum(lines * np.hstack([right, ones]), axis=1)
    return np.asarray(np.abs(across) / np.hypot(lines[:, 0], lines[:, 1]))
