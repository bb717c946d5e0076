"""Projection of a board by a lens, its derivatives, and the parameters of the lens by name."""

from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.lens.board import Board, Corners, opencv
from amiwarp.optics.camera import Camera
from amiwarp.optics.distortion import Fisheye, RadialTangential, coefficients

Vector = NDArray[np.float64]
INTRINSICS = ("fx", "fy", "cx", "cy")
"""Names of the intrinsics, in the order of a fit's vector, which the distortion's coefficients follow."""
RATIONAL_COEFFICIENTS = 8
"""Number of coefficients of OpenCV's rational model, with which it returns the derivatives by all of them."""


def lens_values(camera: Camera, names: Iterable[str]) -> dict[str, float]:
    """Return intrinsics and coefficients of a camera by name, in the order of ``names``."""
    values = {}
    for name in names:
        owner = camera if name in INTRINSICS else camera.distortion
        values[name] = getattr(owner, name)
    return values


def parameter_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of all parameters of a camera that has a distortion, in the order of :class:`Projection`."""
    bends = fields(type(camera.distortion))  # type: ignore[arg-type]
    return *INTRINSICS, *(bend.name for bend in bends)


def with_lens_values(camera: Camera, values: Mapping[str, float]) -> Camera:
    """Return the camera, which has a distortion, with other intrinsics and coefficients."""
    intrinsics = {}
    bends = {}
    for name, value in values.items():
        if name in INTRINSICS:
            intrinsics[name] = value
        else:
            bends[name] = value
    distortion = replace(camera.distortion, **bends)  # type: ignore[type-var]
    return replace(camera, **intrinsics, distortion=distortion)  # type: ignore[arg-type]


class Projection:
    """Projection of points of a board by a lens, with its derivatives: OpenCV's formulas."""

    def __init__(self, camera: Camera) -> None:
        self._matrix = camera.to_opencv()[0]
        self._fisheye = isinstance(camera.distortion, Fisheye)
        distortion = camera.distortion or RadialTangential()
        given = list(coefficients(distortion).values())
        if not self._fisheye:
            given += [0.0] * (RATIONAL_COEFFICIENTS - len(given))
        self._coefficients = np.array(given)

    def of(self, pose: Vector, points: Vector) -> tuple[Vector, Vector]:
        """Return the pixels of points, shape (n, 2), and their derivatives, shape (n, 2, 4 + coefficients + 6).

        ``pose``: rotation vector and translation [m]; ``points``: places in the board's frame [m], shape (n, 3). The
        derivatives are taken by the intrinsics, the coefficients in the lens's order, and the pose.
        """
        cv2 = opencv()
        turn = pose[:3].reshape(3, 1)
        shift = pose[3:].reshape(3, 1)
        if self._fisheye:
            places = points.reshape(-1, 1, 3)
            xy, by = cv2.fisheye.projectPoints(
                places, turn, shift, self._matrix, self._coefficients
            )
            by = by[:, :14]  # without the skew
        else:
            xy, by = cv2.projectPoints(points, turn, shift, self._matrix, self._coefficients)
            by = np.roll(by, -6, axis=1)  # OpenCV puts the pose first
        pixels = xy.reshape(-1, 2)
        derivatives = np.asarray(by).reshape(len(points), 2, -1)
        return pixels, derivatives


def first_pose(camera: Camera, board: Board, corners: Corners) -> Vector:
    """Return the pose of a board from its corners and a known camera: rotation vector and translation [m]."""
    cv2 = opencv()
    points = board.points[corners.ids]
    rays = np.asarray(camera.pixels_to_rays(corners.xy), np.float64)
    depth = np.maximum(rays[:, 2:], 1e-3)
    # The rays as pixels of a camera without a lens.
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        points,
        rays[:, :2] / depth,
        np.eye(3),
        None,
        flags=cv2.SOLVEPNP_IPPE,
    )
    lens = Projection(camera)

    def error(pose: Vector) -> float:
        xy, _ = lens.of(pose, points)
        off = xy - corners.xy
        return float((off**2).sum())

    # A plane has two poses that look nearly alike.
    poses = []
    for turn, shift in zip(turns, shifts, strict=True):
        poses.append(np.concatenate([turn.ravel(), shift.ravel()]))
    return min(poses, key=error)


def tilt_of(pose: Vector) -> float:
    """Return the angle between a board's normal and the optical axis [rad]."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(pose[:3])
    normal: Any = rotation.apply([0.0, 0.0, 1.0])
    cosine = np.clip(abs(normal[2]), 0.0, 1.0)
    return float(np.arccos(cosine))
