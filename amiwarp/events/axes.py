"""Rotations between the axes of an inertial unit and the axes of a camera: as matrices, and in words."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.validation import shown

Matrix = NDArray[np.float64]

SAME_RAD = math.radians(1.0)
"""Angle below which axes are said to lie along others."""


def orientations() -> list[Matrix]:
    """Return the 24 rotations that map axes to axes, as matrices."""
    matrices = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0.0:
                matrices.append(matrix)
    return matrices


def angle_between(a: Matrix, b: Matrix) -> float:
    """Return the angle of the rotation between two rotation matrices [rad]."""
    trace = float(np.trace(a.T @ b))
    cosine = 0.5 * (trace - 1.0)
    return math.acos(min(1.0, max(-1.0, cosine)))


def axes_in_words(to_camera: Matrix) -> str:
    """Return the axes of the inertial unit that are nearest the camera's x, y and z, such as ``-x, y, -z``.

    Axes that do not lie along the camera's are followed by the angle between them.
    """
    nearest = min(orientations(), key=lambda orientation: angle_between(orientation, to_camera))
    names = []
    for row in nearest:
        k = int(np.argmax(np.abs(row)))
        sign = "-" if row[k] < 0.0 else ""
        names.append(sign + "xyz"[k])
    off = angle_between(nearest, to_camera)
    beside = f", {math.degrees(off):.0f} deg beside them" if off >= SAME_RAD else ""
    return ", ".join(names) + beside


def read_axes(text: str) -> Matrix:
    """Return the rotation matrix that a text names: three axes such as ``-x,y,-z``, or nine numbers, row by row.

    Each axis, or row, is one of the camera's x, y and z axes in the frame of the inertial unit. Raises
    :class:`AmiwarpError` for other texts, and for axes that are not right-handed.
    """
    words = [word.strip().lower() for word in text.split(",")]
    named = {}
    for name, axis in zip("xyz", np.eye(3), strict=True):
        named[name] = axis
        named[f"+{name}"] = axis
        named[f"-{name}"] = -1.0 * axis
    matrix = None
    if len(words) == 3 and all(word in named for word in words):
        matrix = np.stack([named[word] for word in words])
    elif len(words) == 9:
        try:
            matrix = np.array([float(word) for word in words]).reshape(3, 3)
        except ValueError:
            matrix = None
    if matrix is None:
        raise AmiwarpError(
            f"{shown(text)} names no axes; give the camera's x, y, z in the frame of the inertial unit, such as "
            "-x,y,-z, or nine numbers of a rotation matrix, row by row"
        )
    return matrix
