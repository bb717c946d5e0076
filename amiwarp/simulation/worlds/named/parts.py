"""Bodies that several built-in worlds contain: walls, tables, chairs, pictures, vessels and gratings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from amiwarp.simulation.worlds.named import shapes, textures
from amiwarp.simulation.worlds.named.textures import Texture
from amiwarp.simulation.worlds.scene import Body, Material, Mesh
from amiwarp.simulation.worlds.trajectory import Trajectory


def solid(
    name: str, mesh: Mesh, texture: Texture | None, category: str, *, instance: str | None = None,
    trajectory: Trajectory | None = None, emission: float = 0.0,
) -> Body:  # fmt: skip
    """Return a body whose reflectance is given by a texture. Without a texture the reflectance is 0.5."""
    material = Material(1.0 if texture is not None else 0.5, texture, emission)
    return Body(name, mesh, material, trajectory, category, instance)


def hall(size: Sequence[float], walls: Sequence[Texture], floor: Texture, ceiling: Texture) -> list[Body]:
    """Return the floor, ceiling, four walls and skirting board of a hall of ``size`` (x, y, z) [m].

    The hall is centred on the z axis and stands on z = 0.
    """
    x, y, z = size[0] / 2.0, size[1] / 2.0, size[2]
    sides = {
        "north": ((-x, y, 0), (2 * x, 0, 0)),
        "east": ((x, y, 0), (0, -2 * y, 0)),
        "south": ((x, -y, 0), (-2 * x, 0, 0)),
        "west": ((-x, -y, 0), (0, 2 * y, 0)),
    }
    bodies = [
        solid("floor", shapes.panel((-x, -y, 0), (2 * x, 0, 0), (0, 2 * y, 0), tile_m=2.0), floor, "floor"),
        solid("ceiling", shapes.panel((-x, y, z), (2 * x, 0, 0), (0, -2 * y, 0), tile_m=2.4), ceiling, "ceiling"),
    ]
    for k, (name, (corner, along)) in enumerate(sides.items()):
        mesh = shapes.panel(corner, along, (0, 0, z), tile_m=2.0)
        bodies.append(solid(f"{name} wall", mesh, walls[k % len(walls)], "wall"))
    boards = []
    for corner, along in sides.values():
        size = (2 * x, 0.02, 0.1) if along[0] else (0.02, 2 * y, 0.1)
        boards.append(shapes.standing_box(size, np.array(corner) + np.array(along) / 2.0, tile_m=1.0))
    skirting = shapes.merged(boards)
    bodies.append(solid("skirting", skirting, textures.clipped(0.8 * np.ones((2, 2))), "wall"))
    return bodies


def picture(
    name: str, centre: Sequence[float], right: Sequence[float], texture: Texture, width: float, height: float
) -> list[Body]:
    """Return a picture of ``width`` x ``height`` [m] on a wall, and its frame.

    ``centre``: centre of the picture [m]; ``right``: unit vector along the wall, to the right as seen by a viewer.
    """
    r = np.asarray(right, np.float64)
    out = np.cross(r, (0.0, 0.0, 1.0))
    middle = np.asarray(centre, np.float64)
    corner = middle + 0.012 * out - r * width / 2.0 - np.array((0, 0, height / 2.0))
    bars = []
    for side in (-1.0, 1.0):
        bars.append(_bar(r, out, (0.03, 0.03, height + 0.06), middle + side * (width / 2.0 + 0.015) * r))
        bars.append(_bar(r, out, (width, 0.03, 0.03), middle + np.array((0, 0, side * (height / 2.0 + 0.015)))))
    frame = textures.clipped(0.12 * np.ones((2, 2)))
    return [
        solid(name, shapes.panel(corner, r * width, (0, 0, height)), texture, "picture"),
        solid(f"{name} frame", shapes.merged(bars), frame, "picture", instance=name),
    ]


def _bar(right: Any, out: Any, size: Sequence[float], centre: Any) -> Mesh:
    """Return a bar of a picture frame: a box whose x axis lies along ``right`` and whose y axis lies along ``out``."""
    mesh = shapes.box(size)
    axes = np.stack([right, out, np.array((0.0, 0.0, 1.0))])
    return Mesh(np.asarray(mesh.vertices) @ axes + centre + 0.015 * out, mesh.faces, mesh.uv)


def table(
    name: str, size: Sequence[float], position: Sequence[float], texture: Texture, *, turn_deg: float = 0.0
) -> Body:
    """Return a table of ``size`` (x, y, height) [m], rotated about the vertical axis by ``turn_deg`` [deg]."""
    top = shapes.standing_box((size[0], size[1], 0.04), (0, 0, size[2] - 0.04), tile_m=0.8)
    apron = shapes.standing_box((size[0] - 0.1, size[1] - 0.1, 0.08), (0, 0, size[2] - 0.12), tile_m=0.8)
    mesh = shapes.merged([top, apron, shapes.legs(size[:2], size[2] - 0.04, 0.03)])
    return solid(name, shapes.moved(mesh, position, turn_deg=turn_deg), texture, "table")


def chair(name: str, position: Sequence[float], texture: Texture, *, turn_deg: float = 0.0) -> Body:
    """Return a chair that faces +x before it is rotated about the vertical axis by ``turn_deg`` [deg]."""
    seat = shapes.standing_box((0.42, 0.42, 0.04), (0, 0, 0.42), tile_m=0.5)
    posts = [shapes.moved(shapes.cylinder(0.018, 0.5, sides=12, tile_m=0.3), (-0.19, y, 0.45)) for y in (-0.18, 0.18)]
    slats = [shapes.standing_box((0.02, 0.36, 0.07), (-0.19, 0, z), tile_m=0.5) for z in (0.58, 0.71, 0.84)]
    mesh = shapes.merged([seat, *posts, *slats, shapes.legs((0.44, 0.44), 0.42, 0.02)])
    return solid(name, shapes.moved(mesh, position, turn_deg=turn_deg), texture, "chair")


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
    line = PchipInterpolator(knots, points)(np.linspace(0.0, knots[-1], 6 * len(points)))
    mesh = shapes.lathe(line.clip(0.0), sides=32, tile_m=tile_m)
    return solid(name, shapes.moved(mesh, position), texture, "vessel")


def grating_strip(
    name: str, corner: Sequence[float], right: Sequence[float], *, count: int, side: float, cycles: float
) -> list[Body]:
    """Return a row of ``count`` square gratings along a wall, with evenly spaced directions.

    ``corner``: lower left corner of the row [m]; ``right``: unit vector along the wall; ``side``: side of a square [m];
    ``cycles``: number of stripe pairs per square.
    """
    r = np.asarray(right, np.float64)
    out = 0.01 * np.cross(r, (0.0, 0.0, 1.0))
    bodies = []
    for k in range(count):
        start = np.asarray(corner, np.float64) + out + 1.1 * k * side * r
        mesh = shapes.panel(start, side * r, (0.0, 0.0, side))
        label = f"{name} {round(180 * k / count)} deg"
        bodies.append(solid(label, mesh, textures.grating(180.0 * k / count, cycles), "grating"))
    return bodies
