"""Building blocks of the built-in worlds: shapes, textures, furniture, and trajectories of the camera."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from amiwarp.simulation.worlds.bodies import Body, Material, Mesh
from amiwarp.simulation.worlds.named.colours import colour_of
from amiwarp.simulation.worlds.named.shapes import (
    box,
    cylinder,
    lathe,
    legs,
    merged,
    moved,
    panel,
    standing_box,
)
from amiwarp.simulation.worlds.named.textures import Texture, clipped, grating
from amiwarp.simulation.worlds.trajectory import Trajectory


def solid(
    name: str,
    mesh: Mesh,
    texture: Texture | None,
    category: str,
    *,
    instance: str | None = None,
    trajectory: Trajectory | None = None,
    emission: float = 0.0,
) -> Body:
    """Return a body whose reflectance is given by a texture. Without a texture the reflectance is 0.5."""
    reflectance = 0.5 if texture is None else 1.0
    colour = colour_of(name, category, texture)
    material = Material(reflectance, texture, emission, colour)
    return Body(name, mesh, material, trajectory, category, instance)


def hall(
    size: Sequence[float], walls: Sequence[Texture], floor: Texture, ceiling: Texture
) -> list[Body]:
    """Return the floor, ceiling, four walls and skirting board of a hall of ``size`` (x, y, z) [m].

    The hall is centred on the z axis and stands on z = 0.
    """
    length, width, height = size
    x = length / 2.0
    y = width / 2.0
    ground = panel((-x, -y, 0), (length, 0, 0), (0, width, 0), tile_m=2.0)
    cover = panel((-x, y, height), (length, 0, 0), (0, -width, 0), tile_m=2.4)
    bodies = [
        solid("floor", ground, floor, "floor"),
        solid("ceiling", cover, ceiling, "ceiling"),
    ]

    # Lower left corner of each wall, and its lower edge
    edges = {
        "north": ((-x, y, 0), (length, 0, 0)),
        "east": ((x, y, 0), (0, -width, 0)),
        "south": ((x, -y, 0), (-length, 0, 0)),
        "west": ((-x, -y, 0), (0, width, 0)),
    }
    boards = []
    for k, (name, (corner, along)) in enumerate(edges.items()):
        mesh = panel(corner, along, (0, 0, height), tile_m=2.0)
        bodies.append(solid(f"{name} wall", mesh, walls[k % len(walls)], "wall"))

        board_size = (length, 0.02, 0.1) if along[0] else (0.02, width, 0.1)
        middle = np.array(corner) + np.array(along) / 2.0
        boards.append(standing_box(board_size, middle, tile_m=1.0))
    white = clipped(0.8 * np.ones((2, 2)))
    bodies.append(solid("skirting", merged(boards), white, "wall"))
    return bodies


def picture(
    name: str,
    centre: Sequence[float],
    right: Sequence[float],
    texture: Texture,
    width: float,
    height: float,
) -> list[Body]:
    """Return a picture of ``width`` x ``height`` [m] on a wall, and its frame.

    ``centre``: centre of the picture [m]; ``right``: unit vector along the wall, to the right as seen by a viewer.
    """
    rightward = np.asarray(right, np.float64)
    out = np.cross(rightward, (0.0, 0.0, 1.0))
    middle = np.asarray(centre, np.float64)
    half_height = np.array((0, 0, height / 2.0))
    corner = middle + 0.012 * out - rightward * width / 2.0 - half_height
    sheet = panel(corner, rightward * width, (0, 0, height))

    bars = []
    for side in (-1.0, 1.0):
        beside = middle + side * (width / 2.0 + 0.015) * rightward
        above = middle + np.array((0, 0, side * (height / 2.0 + 0.015)))
        bars.append(_bar(rightward, out, (0.03, 0.03, height + 0.06), beside))
        bars.append(_bar(rightward, out, (width, 0.03, 0.03), above))
    black = clipped(0.12 * np.ones((2, 2)))
    return [
        solid(name, sheet, texture, "picture"),
        solid(f"{name} frame", merged(bars), black, "picture", instance=name),
    ]


def _bar(right: Any, out: Any, size: Sequence[float], centre: Any) -> Mesh:
    """Return a bar of a picture frame: a box whose x axis lies along ``right`` and whose y axis lies along ``out``."""
    mesh = box(size)
    axes = np.stack([right, out, np.array((0.0, 0.0, 1.0))])
    vertices = np.asarray(mesh.vertices) @ axes + centre + 0.015 * out
    return Mesh(vertices, mesh.faces, mesh.uv)


def table(
    name: str,
    size: Sequence[float],
    position: Sequence[float],
    texture: Texture,
    *,
    turn_deg: float = 0.0,
) -> Body:
    """Return a table of ``size`` (x, y, height) [m], rotated about the vertical axis by ``turn_deg`` [deg]."""
    length, width, height = size
    top = standing_box((length, width, 0.04), (0, 0, height - 0.04), tile_m=0.8)
    apron = standing_box((length - 0.1, width - 0.1, 0.08), (0, 0, height - 0.12), tile_m=0.8)
    four_legs = legs((length, width), height - 0.04, 0.03)
    mesh = merged([top, apron, four_legs])
    return solid(name, moved(mesh, position, turn_deg=turn_deg), texture, "table")


def chair(name: str, position: Sequence[float], texture: Texture, *, turn_deg: float = 0.0) -> Body:
    """Return a chair that faces +x before it is rotated about the vertical axis by ``turn_deg`` [deg]."""
    seat = standing_box((0.42, 0.42, 0.04), (0, 0, 0.42), tile_m=0.5)
    post = cylinder(0.018, 0.5, sides=12, tile_m=0.3)
    posts = [moved(post, (-0.19, y, 0.45)) for y in (-0.18, 0.18)]
    heights = (0.58, 0.71, 0.84)
    slats = [standing_box((0.02, 0.36, 0.07), (-0.19, 0, z), tile_m=0.5) for z in heights]
    four_legs = legs((0.44, 0.44), 0.42, 0.02)
    mesh = merged([seat, *posts, *slats, four_legs])
    return solid(name, moved(mesh, position, turn_deg=turn_deg), texture, "chair")


def vessel(
    name: str,
    profile: Sequence[tuple[float, float]],
    position: Sequence[float],
    texture: Texture,
    *,
    tile_m: float = 0.25,
) -> Body:
    """Return a vessel: a surface of revolution whose profile (radius, height) [m] is smoothed by a spline.

    ``position``: centre of the foot [m]; ``tile_m``: width and height of the texture on the surface [m].
    """
    from scipy.interpolate import PchipInterpolator

    points = np.asarray(profile, np.float64)
    knots = np.arange(len(points))
    spline = PchipInterpolator(knots, points)
    fine = np.linspace(0.0, knots[-1], 6 * len(points))
    line = spline(fine)
    mesh = lathe(line.clip(0.0), sides=32, tile_m=tile_m)
    return solid(name, moved(mesh, position), texture, "vessel")


def grating_strip(
    name: str,
    corner: Sequence[float],
    right: Sequence[float],
    *,
    count: int,
    side: float,
    cycles: float,
) -> list[Body]:
    """Return a row of ``count`` square gratings along a wall, with evenly spaced directions.

    ``corner``: lower left corner of the row [m]; ``right``: unit vector along the wall; ``side``: side of a square [m];
    ``cycles``: number of stripe pairs per square.
    """
    rightward = np.asarray(right, np.float64)
    # The gratings lie in front of the wall.
    out = 0.01 * np.cross(rightward, (0.0, 0.0, 1.0))
    bodies = []
    for k in range(count):
        angle_deg = 180.0 * k / count
        start = np.asarray(corner, np.float64) + out + 1.1 * k * side * rightward
        mesh = panel(start, side * rightward, (0.0, 0.0, side))
        label = f"{name} {round(angle_deg)} deg"
        bodies.append(solid(label, mesh, grating(angle_deg, cycles), "grating"))
    return bodies
