"""Built-in world ``person``: a figure of capsules and ellipsoids that walks in a circle in a hall."""

from __future__ import annotations

import numpy as np

from amiwarp.simulation.worlds.named import gait, parts, shapes, textures
from amiwarp.simulation.worlds.named.motion import Viewpoint
from amiwarp.simulation.worlds.scene import Body, Lamp, World
from amiwarp.simulation.worlds.trajectory import Trajectory

SIZE = (9.0, 8.0, 3.2)
"""Length, width and height of the hall [m]."""
VIEW = Viewpoint((0.3, -3.4, 1.35), (0.05, 0.0, 1.0))
"""Camera pose: near a wall. The figure first crosses the view from left to right."""
LAMPS = (Lamp((-1.5, -1.5, 3.0), 4.5, shadows=True), Lamp((2.5, 1.5, 2.9), 3.0))
"""Two lamps near the ceiling; the first casts shadows."""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world: the hall and the figure. All bodies of the figure belong to the instance ``person``."""
    walls = [
        textures.bricks(rng, mean=0.4),
        textures.plaster(rng, 0.5, 0.45),
        textures.plaster(rng),
        textures.plaster(rng, 0.4),
    ]
    bodies = parts.hall(SIZE, walls, textures.wood(rng, mean=0.35), textures.tiles(rng, mean=0.6, joint=0.2, count=4))
    poses = gait.walk(duration_s)
    return World(
        "person",
        (*bodies, *_hall(rng), *_figure(rng, poses)),
        ambient=0.3,
        lamps=LAMPS,
        joints={name: poses[name] for name in gait.JOINTS},
    )


def _hall(rng: np.random.Generator) -> list[Body]:
    """Return the pictures and furniture of the hall, which leave the figure's path free."""
    north, y = (1.0, 0.0, 0.0), SIZE[1] / 2.0
    columns = [
        shapes.moved(shapes.cylinder(0.18, SIZE[2], sides=32, tile_m=0.6), (x, 3.3, 0)) for x in (-3.3, -1.1, 1.1, 3.3)
    ]
    return [
        *parts.grating_strip("grating", (-2.0, y, 2.2), north, count=8, side=0.45, cycles=6.0),
        *parts.picture("star", (-2.2, y, 1.3), north, textures.star(), 1.2, 1.2),
        *parts.picture("poster", (0.0, y, 1.3), north, textures.poster(rng), 1.3, 1.2),
        *parts.picture("page", (2.2, y, 1.3), north, textures.text_page(rng, letter=26), 0.95, 1.25),
        parts.solid("columns", shapes.merged(columns), textures.plaid(rng, stripes=8), "column"),
        parts.table("bench", (1.6, 0.4, 0.45), (-3.6, 1.6, 0), textures.wood(rng, boards=4), turn_deg=90.0),
        parts.table("second bench", (1.6, 0.4, 0.45), (3.6, 1.2, 0), textures.wood(rng, boards=4), turn_deg=80.0),
        parts.solid(
            "crate",
            shapes.moved(shapes.standing_box((0.6, 0.6, 0.6)), (3.0, -1.6, 0), turn_deg=20),
            textures.poster(rng),
            "box",
        ),
        parts.solid(
            "carpet",
            shapes.standing_box((4.6, 4.2, 0.01), (0, 0.8, -0.002)),
            textures.plaid(rng, size=512, stripes=30),
            "carpet",
        ),
    ]


def _figure(rng: np.random.Generator, poses: dict[str, Trajectory]) -> list[Body]:
    """Return the limbs of the figure. Each limb has the trajectory of its upper joint."""
    skin = textures.plaster(rng, 0.42, 0.25, size=256)
    trousers = textures.plaster(rng, 0.16, 0.45, size=256)
    shirt, shoe = textures.plaid(rng, stripes=12), textures.plaster(rng, 0.07, 0.4, size=128)
    cloth = dict.fromkeys(("head", "neck", "forearm", "hand"), skin)
    cloth |= dict.fromkeys(("torso", "upper arm"), shirt)
    cloth |= dict.fromkeys(("pelvis", "thigh", "shin"), trousers) | {"foot": shoe}
    bodies = []
    for name, mesh in gait.limbs().items():
        kind = name.removeprefix("left ").removeprefix("right ")
        bodies.append(parts.solid(name, mesh, cloth[kind], "person", instance="person", trajectory=poses[name]))
    return bodies
