"""Meshes of simple shapes for the built-in worlds: panels, boxes and surfaces of revolution."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.simulation.worlds.scene import Mesh

BOX_SIDES = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
)
"""Sides of a box: outward normal, and directions to the right and up as seen from outside."""


def panel(corner: ArrayLike, right: ArrayLike, up: ArrayLike, *, tile_m: float | None = None) -> Mesh:
    """Return a parallelogram, given its lower left corner and two sides [m]. Its normal is ``right`` x ``up``.

    ``tile_m``: width and height of the texture on the panel [m]; None to show the whole texture once.
    """
    c, r, u = (np.asarray(value, np.float64) for value in (corner, right, up))
    scale = (1.0, 1.0) if tile_m is None else (np.linalg.norm(r) / tile_m, np.linalg.norm(u) / tile_m)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * scale
    return Mesh(np.array([c, c + r, c + r + u, c + u]), np.array([[0, 1, 2], [0, 2, 3]]), uv)


def box(size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None) -> Mesh:
    """Return a box of ``size`` (x, y, z) [m] about ``centre`` [m]. Each side is a :func:`panel`."""
    s = np.asarray(size, np.float64)
    sides = []
    for normal, right, up in BOX_SIDES:
        n, r, u = (np.array(direction) * s for direction in (normal, right, up))
        sides.append(panel(np.asarray(centre) + (n - r - u) / 2.0, r, u, tile_m=tile_m))
    return merged(sides)


def standing_box(size: ArrayLike, foot: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None) -> Mesh:
    """Return a box of ``size`` (x, y, z) [m] whose lower side has the centre ``foot`` [m]."""
    return box(size, np.asarray(foot, np.float64) + np.asarray(size) * (0.0, 0.0, 0.5), tile_m=tile_m)


def lathe(profile: ArrayLike, *, sides: int = 24, tile_m: float | None = None) -> Mesh:
    """Return the surface of revolution about z of a polyline (radius, height) [m], from bottom to top.

    ``tile_m``: width and height of the texture [m]. The width is rounded so that the texture closes around the shape.
    None: show the texture once around.
    """
    line = np.asarray(profile, np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.concatenate(
        [line[:, None, :1] * ring, np.broadcast_to(line[:, None, 1:], (len(line), sides + 1, 1))], axis=2
    )
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    around = max(1, round(2.0 * np.pi * line[:, 0].max() / tile_m)) if tile_m else 1
    v = along / (tile_m or max(along[-1], 1e-9))
    uv = np.stack(np.meshgrid(around * np.linspace(0.0, 1.0, sides + 1), v), axis=-1)
    return Mesh(points.reshape(-1, 3), _grid_faces(len(line), sides + 1), uv.reshape(-1, 2))


def _grid_faces(rows: int, columns: int) -> NDArray[np.int32]:
    """Return the triangles between the points of a grid, which are numbered row by row."""
    at = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def cylinder(radius: float, height: float, *, sides: int = 20, tile_m: float | None = None) -> Mesh:
    """Return a closed cylinder about the z axis that stands on z = 0; lengths in metres."""
    return lathe([(0, 0), (radius, 0), (radius, height), (0, height)], sides=sides, tile_m=tile_m)


def ellipsoid(radii: ArrayLike, *, sides: int = 24, rings: int = 12, tile_m: float | None = None) -> Mesh:
    """Return an ellipsoid about the origin with radii along x, y and z [m]."""
    polar = np.linspace(-np.pi / 2.0, np.pi / 2.0, rings + 1)
    scale = np.asarray(radii, np.float64)
    line = np.column_stack([np.cos(polar).clip(0.0), np.sin(polar)]) * scale.max()
    ball = lathe(line, sides=sides, tile_m=tile_m)
    return Mesh(np.asarray(ball.vertices) * scale / scale.max(), ball.faces, ball.uv)


def capsule(radius: float, length: float, *, sides: int = 20, rings: int = 6, tile_m: float | None = None) -> Mesh:
    """Return a cylinder with round ends from the origin down to z = ``-length`` [m]."""
    low, high = np.linspace(-np.pi / 2.0, 0.0, rings), np.linspace(0.0, np.pi / 2.0, rings)
    ends = [
        np.column_stack([radius * np.cos(a).clip(0.0), radius * np.sin(a) + z]) for a, z in ((low, -length), (high, 0))
    ]
    return lathe(np.concatenate(ends), sides=sides, tile_m=tile_m)


def gable_roof(size: ArrayLike, foot: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None) -> Mesh:
    """Return a gable roof of ``size`` (x, y, height) [m] with its ridge along x.

    ``foot``: centre of its lower side [m].
    """
    x, y, z = np.asarray(size, np.float64) / (2.0, 2.0, 1.0)
    slopes = [
        panel((-x, -y, 0), (2 * x, 0, 0), (0, y, z), tile_m=tile_m),
        panel((x, y, 0), (-2 * x, 0, 0), (0, -y, z), tile_m=tile_m),
    ]
    scale = tile_m or 2 * y
    ends = []
    for side in (1.0, -1.0):
        corners = np.array([(side * x, -side * y, 0), (side * x, side * y, 0), (side * x, 0, z)])
        ends.append(Mesh(corners, [[0, 1, 2]], corners[:, 1:] * (side, 1.0) / scale))
    return moved(merged([*slopes, *ends]), foot)


def merged(meshes: Iterable[Mesh]) -> Mesh:
    """Return one mesh that consists of several meshes."""
    parts = list(meshes)
    starts = np.cumsum([0, *(len(np.asarray(part.vertices)) for part in parts)])
    return Mesh(
        np.concatenate([np.asarray(part.vertices) for part in parts]),
        np.concatenate([np.asarray(part.faces) + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate([np.asarray(part.uv) for part in parts]),
    )


def moved(mesh: Mesh, position: ArrayLike, *, turn_deg: float = 0.0, axis: ArrayLike = (0.0, 0.0, 1.0)) -> Mesh:
    """Return a mesh rotated by ``turn_deg`` [deg] about an axis through the origin, then moved by ``position`` [m]."""
    from scipy.spatial.transform import Rotation

    rotation: Any = Rotation.from_rotvec(np.radians(turn_deg) * np.asarray(axis, np.float64))
    return Mesh(rotation.apply(np.asarray(mesh.vertices)) + np.asarray(position, np.float64), mesh.faces, mesh.uv)


def legs(size: Sequence[float], height: float, radius: float) -> Mesh:
    """Return four round legs at the corners of a rectangle of ``size`` (x, y) [m] about the origin."""
    x, y = size[0] / 2.0 - 2.0 * radius, size[1] / 2.0 - 2.0 * radius
    leg = cylinder(radius, height, sides=12, tile_m=0.3)
    return merged(moved(leg, (a * x, b * y, 0.0)) for a in (-1, 1) for b in (-1, 1))


def tapered(mesh: Mesh, share: float) -> Mesh:
    """Return a mesh whose horizontal size shrinks linearly with height, to the fraction ``share`` at the top."""
    points = np.array(mesh.vertices, np.float64)
    low, high = points[:, 2].min(), points[:, 2].max()
    middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2.0
    factor = 1.0 - (1.0 - share) * (points[:, 2:] - low) / (high - low)
    points[:, :2] = middle + factor * (points[:, :2] - middle)
    return Mesh(points, mesh.faces, mesh.uv)
