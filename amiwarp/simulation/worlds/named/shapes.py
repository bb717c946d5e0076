"""Meshes of simple shapes for the built-in worlds: panels, boxes and surfaces of revolution."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.simulation.worlds.bodies import Mesh

BOX_SIDES = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
)
"""Sides of a box: outward normal, and directions to the right and up as seen from outside."""


def panel(
    corner: ArrayLike, right: ArrayLike, up: ArrayLike, *, tile_m: float | None = None
) -> Mesh:
    """Return a parallelogram, given its lower left corner and two sides [m]. Its normal is ``right`` x ``up``.

    ``tile_m``: width and height of the texture on the panel [m]; None to show the whole texture once.
    """
    origin = np.asarray(corner, np.float64)
    across = np.asarray(right, np.float64)
    upward = np.asarray(up, np.float64)
    vertices = np.array([origin, origin + across, origin + across + upward, origin + upward])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    if tile_m is not None:
        repeats_across = np.linalg.norm(across) / tile_m
        repeats_up = np.linalg.norm(upward) / tile_m
        uv = uv * (repeats_across, repeats_up)
    return Mesh(vertices, faces, uv)


def box(
    size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None
) -> Mesh:
    """Return a box of ``size`` (x, y, z) [m] about ``centre`` [m]. Each side is a :func:`panel`."""
    lengths = np.asarray(size, np.float64)
    sides = []
    for normal, right, up in BOX_SIDES:
        through = np.array(normal) * lengths
        across = np.array(right) * lengths
        upward = np.array(up) * lengths
        corner = np.asarray(centre) + (through - across - upward) / 2.0
        sides.append(panel(corner, across, upward, tile_m=tile_m))
    return merged(sides)


def standing_box(
    size: ArrayLike, foot: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None
) -> Mesh:
    """Return a box of ``size`` (x, y, z) [m] whose lower side has the centre ``foot`` [m]."""
    centre = np.asarray(foot, np.float64) + np.asarray(size) * (0.0, 0.0, 0.5)
    return box(size, centre, tile_m=tile_m)


def lathe(profile: ArrayLike, *, sides: int = 24, tile_m: float | None = None) -> Mesh:
    """Return the surface of revolution about z of a polyline (radius, height) [m], from bottom to top.

    ``tile_m``: width and height of the texture [m]. The width is rounded so that the texture closes around the shape.
    None: show the texture once around.
    """
    line = np.asarray(profile, np.float64)
    radius = line[:, 0]
    height = line[:, 1]
    rows = len(line)
    columns = sides + 1  # the last column lies on the first, at the other end of the texture

    angle = np.linspace(0.0, 2.0 * np.pi, columns)
    points = np.empty((rows, columns, 3))
    points[:, :, 0] = radius[:, None] * np.cos(angle)
    points[:, :, 1] = radius[:, None] * np.sin(angle)
    points[:, :, 2] = height[:, None]

    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    if tile_m:
        girth = 2.0 * np.pi * radius.max()
        repeats = max(1, round(girth / tile_m))
        v = along / tile_m
    else:
        repeats = 1
        v = along / max(along[-1], 1e-9)
    u = repeats * np.linspace(0.0, 1.0, columns)
    uv = np.stack(np.meshgrid(u, v), axis=-1)

    faces = _grid_faces(rows, columns)
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2))


def _grid_faces(rows: int, columns: int) -> NDArray[np.int32]:
    """Return the triangles between the points of a grid, which are numbered row by row."""
    number = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    # The corners of each cell of the grid, counter-clockwise
    lower_left = number[:-1, :-1].ravel()
    lower_right = number[:-1, 1:].ravel()
    upper_right = number[1:, 1:].ravel()
    upper_left = number[1:, :-1].ravel()
    right_halves = np.column_stack([lower_left, lower_right, upper_right])
    left_halves = np.column_stack([lower_left, upper_right, upper_left])
    return np.concatenate([right_halves, left_halves])


def cylinder(radius: float, height: float, *, sides: int = 20, tile_m: float | None = None) -> Mesh:
    """Return a closed cylinder about the z axis that stands on z = 0; lengths in metres."""
    profile = [(0, 0), (radius, 0), (radius, height), (0, height)]
    return lathe(profile, sides=sides, tile_m=tile_m)


def ellipsoid(
    radii: ArrayLike, *, sides: int = 24, rings: int = 12, tile_m: float | None = None
) -> Mesh:
    """Return an ellipsoid about the origin with radii along x, y and z [m]."""
    scale = np.asarray(radii, np.float64)
    largest = scale.max()

    # A ball with the largest radius is squeezed along the other axes.
    latitude = np.linspace(-np.pi / 2.0, np.pi / 2.0, rings + 1)
    half_circle = np.column_stack([np.cos(latitude).clip(0.0), np.sin(latitude)])
    ball = lathe(largest * half_circle, sides=sides, tile_m=tile_m)
    vertices = np.asarray(ball.vertices) * scale / largest
    return Mesh(vertices, ball.faces, ball.uv)


def capsule(
    radius: float, length: float, *, sides: int = 20, rings: int = 6, tile_m: float | None = None
) -> Mesh:
    """Return a cylinder with round ends from the origin down to z = ``-length`` [m]."""
    southern = np.linspace(-np.pi / 2.0, 0.0, rings)
    northern = np.linspace(0.0, np.pi / 2.0, rings)
    lower_end = _sphere_profile(southern, radius, centre_z=-length)
    upper_end = _sphere_profile(northern, radius, centre_z=0.0)
    return lathe(np.concatenate([lower_end, upper_end]), sides=sides, tile_m=tile_m)


def _sphere_profile(
    latitude: NDArray[np.float64], radius: float, centre_z: float
) -> NDArray[np.float64]:
    """Return the profile (radius, height) [m] of a sphere at latitudes [rad]. ``centre_z``: height of its centre."""
    from_axis = radius * np.cos(latitude).clip(0.0)
    height = radius * np.sin(latitude) + centre_z
    return np.column_stack([from_axis, height])


def gable_roof(
    size: ArrayLike, foot: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None
) -> Mesh:
    """Return a gable roof of ``size`` (x, y, height) [m] with its ridge along x.

    ``foot``: centre of its lower side [m].
    """
    length, width, height = np.asarray(size, np.float64)
    end_x = length / 2.0
    eaves_y = width / 2.0
    slopes = [
        panel((-end_x, -eaves_y, 0), (length, 0, 0), (0, eaves_y, height), tile_m=tile_m),
        panel((end_x, eaves_y, 0), (-length, 0, 0), (0, -eaves_y, height), tile_m=tile_m),
    ]

    scale = tile_m or width
    gables = []
    for side in (1.0, -1.0):
        x = side * end_x
        left = (x, -side * eaves_y, 0)
        right = (x, side * eaves_y, 0)
        top = (x, 0, height)
        corners = np.array([left, right, top])
        uv = corners[:, 1:] * (side, 1.0) / scale
        gables.append(Mesh(corners, [[0, 1, 2]], uv))
    return moved(merged([*slopes, *gables]), foot)


def merged(meshes: Iterable[Mesh]) -> Mesh:
    """Return one mesh that consists of several meshes."""
    vertices = []
    faces = []
    uv = []
    count = 0
    for mesh in meshes:
        points = np.asarray(mesh.vertices)
        vertices.append(points)
        faces.append(np.asarray(mesh.faces) + count)
        uv.append(np.asarray(mesh.uv))
        count += len(points)
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv))


def moved(
    mesh: Mesh, position: ArrayLike, *, turn_deg: float = 0.0, axis: ArrayLike = (0.0, 0.0, 1.0)
) -> Mesh:
    """Return a mesh rotated by ``turn_deg`` [deg] about an axis through the origin, then moved by ``position`` [m]."""
    from scipy.spatial.transform import Rotation

    turn = np.radians(turn_deg) * np.asarray(axis, np.float64)
    rotation: Any = Rotation.from_rotvec(turn)
    vertices = rotation.apply(np.asarray(mesh.vertices)) + np.asarray(position, np.float64)
    return Mesh(vertices, mesh.faces, mesh.uv)


def legs(size: Sequence[float], height: float, radius: float) -> Mesh:
    """Return four round legs at the corners of a rectangle of ``size`` (x, y) [m] about the origin."""
    x = size[0] / 2.0 - 2.0 * radius
    y = size[1] / 2.0 - 2.0 * radius
    leg = cylinder(radius, height, sides=12, tile_m=0.3)
    feet = [(-x, -y, 0.0), (-x, y, 0.0), (x, -y, 0.0), (x, y, 0.0)]
    return merged(moved(leg, foot) for foot in feet)


def tapered(mesh: Mesh, share: float) -> Mesh:
    """Return a mesh whose horizontal size shrinks linearly with height, to the fraction ``share`` at the top."""
    points = np.array(mesh.vertices, np.float64)
    horizontal = points[:, :2]
    height = points[:, 2:]
    low = height.min()
    high = height.max()
    middle = (horizontal.min(axis=0) + horizontal.max(axis=0)) / 2.0
    factor = 1.0 - (1.0 - share) * (height - low) / (high - low)
    points[:, :2] = middle + factor * (horizontal - middle)
    return Mesh(points, mesh.faces, mesh.uv)
