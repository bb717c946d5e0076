"""Built-in world ``person``: a figure of capsules and ellipsoids that walks in a circle in a hall."""

import numpy as np

from amiwarp.simulation.worlds.bodies import Body
from amiwarp.simulation.worlds.lights import Lamp
from amiwarp.simulation.worlds.named import parts, shapes, textures
from amiwarp.simulation.worlds.named.camera_paths import Viewpoint
from amiwarp.simulation.worlds.named.gait import JOINTS, limbs, walk
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World

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
    bodies = parts.hall(
        SIZE,
        walls,
        textures.wood(rng, mean=0.35),
        textures.tiles(rng, mean=0.6, joint=0.2, count=4),
    )
    poses = walk(duration_s)
    return World(
        "person",
        (*bodies, *_hall(rng), *_figure(rng, poses)),
        ambient=0.3,
        lamps=LAMPS,
        joints={name: poses[name] for name in JOINTS},
    )


def _hall(rng: np.random.Generator) -> list[Body]:
    """Return the pictures and furniture of the hall, which leave the figure's path free."""
    north = (1.0, 0.0, 0.0)
    y = SIZE[1] / 2.0
    column = shapes.cylinder(0.18, SIZE[2], sides=32, tile_m=0.6)
    columns = shapes.merged(shapes.moved(column, (x, 3.3, 0)) for x in (-3.3, -1.1, 1.1, 3.3))
    crate = shapes.standing_box((0.6, 0.6, 0.6))
    crate = shapes.moved(crate, (3.0, -1.6, 0), turn_deg=20)
    carpet = shapes.standing_box((4.6, 4.2, 0.01), (0, 0.8, -0.002))
    bench_size = (1.6, 0.4, 0.45)

    poster = textures.poster(rng)
    page = textures.text_page(rng, letter=26)
    column_skin = textures.plaid(rng, stripes=8)
    bench_wood = textures.wood(rng, boards=4)
    second_wood = textures.wood(rng, boards=4)
    crate_skin = textures.poster(rng)
    carpet_cloth = textures.plaid(rng, size=512, stripes=30)
    return [
        *parts.grating_strip("grating", (-2.0, y, 2.2), north, count=8, side=0.45, cycles=6.0),
        *parts.picture("star", (-2.2, y, 1.3), north, textures.star(), 1.2, 1.2),
        *parts.picture("poster", (0.0, y, 1.3), north, poster, 1.3, 1.2),
        *parts.picture("page", (2.2, y, 1.3), north, page, 0.95, 1.25),
        parts.solid("columns", columns, column_skin, "column"),
        parts.table("bench", bench_size, (-3.6, 1.6, 0), bench_wood, turn_deg=90.0),
        parts.table("second bench", bench_size, (3.6, 1.2, 0), second_wood, turn_deg=80.0),
        parts.solid("crate", crate, crate_skin, "box"),
        parts.solid("carpet", carpet, carpet_cloth, "carpet"),
    ]


def _figure(rng: np.random.Generator, poses: dict[str, Trajectory]) -> list[Body]:
    """Return the limbs of the figure. Each limb has the trajectory of its upper joint."""
    skin = textures.plaster(rng, 0.42, 0.25, size=256)
    trousers = textures.plaster(rng, 0.16, 0.45, size=256)
    shirt = textures.plaid(rng, stripes=12)
    shoe = textures.plaster(rng, 0.07, 0.4, size=128)
    cloth = {
        "head": skin,
        "neck": skin,
        "forearm": skin,
        "hand": skin,
        "torso": shirt,
        "upper arm": shirt,
        "pelvis": trousers,
        "thigh": trousers,
        "shin": trousers,
        "foot": shoe,
    }
    bodies = []
    for name, mesh in limbs().items():
        kind = name.removeprefix("left ").removeprefix("right ")
        body = parts.solid(
            name, mesh, cloth[kind], "person", instance="person", trajectory=poses[name]
        )
        bodies.append(body)
    return bodies
