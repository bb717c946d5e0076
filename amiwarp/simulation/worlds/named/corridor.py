"""Built-in world ``corridor``: doors, notices, pillars, pipes and lights that repeat into the distance."""

import numpy as np

from amiwarp.simulation.worlds.named import bodies as parts
from amiwarp.simulation.worlds.named import bodies as shapes
from amiwarp.simulation.worlds.named import bodies as textures
from amiwarp.simulation.worlds.named.bodies import Viewpoint
from amiwarp.simulation.worlds.world import Body, Lamp, World

SIZE = (36.0, 2.6, 2.7)
"""Length, width and height of the corridor [m], which lies along the x axis."""
BAY = 4.0
"""Length of one section of the corridor [m]."""
BAYS = tuple(float(x) for x in np.arange(-14.0, 15.0, BAY))
"""Centres of the sections along x [m]."""
VIEW = Viewpoint((-6.0, -0.1, 1.55), (4.0, 0.15, 1.3), walk_m=(7.0, 0.0, 0.0))
"""Camera pose: in the middle of the corridor. The camera walks along the corridor."""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world. No body moves, so ``duration_s`` has no effect."""
    walls = [
        textures.bricks(rng, mean=0.42, joint=0.65),
        textures.checkerboard(8),
        textures.bricks(rng, mean=0.35),
        textures.plaster(rng),
    ]
    bodies = parts.hall(
        SIZE,
        walls,
        textures.tiles(rng, mean=0.45, joint=0.1, count=4),
        textures.tiles(rng, mean=0.7, joint=0.25, count=4),
    )
    doors = [textures.wood(rng, mean=mean, boards=6) for mean in (0.3, 0.55)]
    for k, x in enumerate(BAYS):
        bodies += [*_bay(rng, k, x), *_door(doors[k % 2], k, x)]
    bodies += [*_pipes(rng), *_things(rng)]
    lamps = tuple(Lamp((x, 0.0, 1.95), 0.9) for x in BAYS)
    return World("corridor", tuple(bodies), ambient=0.28, lamps=lamps)


def _bay(rng: np.random.Generator, k: int, x: float) -> list[Body]:
    """Return the light, pillars and pictures of section ``k``, whose centre is at ``x`` [m]."""
    y, z = SIZE[1] / 2.0, SIZE[2]
    light = shapes.box((1.2, 0.3, 0.05), (x, 0.0, z - 0.026))
    north, south = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
    pillars = []
    for side in (-1, 1):
        shaft = shapes.lathe(
            [(0.13, 0), (0.13, 0.1), (0.1, 0.14), (0.1, z - 0.14), (0.13, z - 0.1), (0.13, z)], sides=24, tile_m=0.6
        )
        pillars.append(shapes.moved(shaft, (x + BAY / 2.0, side * (y - 0.1), 0.0)))
    art = (textures.poster(rng), textures.text_page(rng, letter=24), textures.star(), textures.checkerboard(8))[k % 4]
    bodies = [
        parts.solid(f"light {k}", light, textures.tiles(rng, mean=0.8, joint=0.3, size=128), "light", emission=0.7),
        parts.solid(f"pillars {k}", shapes.merged(pillars), textures.plaster(rng, 0.55, 0.4, size=256), "pillar"),
        *parts.picture(f"picture {k}", (x + 1.1, y, 1.5), north, art, 0.7, 0.8),
        *parts.picture(f"notice {k}", (x + 0.6, -y, 1.5), south, textures.text_page(rng), 0.5, 0.68),
    ]
    if k % 2 == 0:  # odd sections have a door in this place
        bodies += parts.grating_strip(f"grating {k}", (x + 0.1, -y, 1.35), south, count=6, side=0.28, cycles=5.0)
    return bodies


def _door(leaf: textures.Texture, k: int, x: float) -> list[Body]:
    """Return the door of section ``k`` with its frame and handle. Doors alternate between the two walls."""
    side = 1.0 if k % 2 == 0 else -1.0
    at, y = x - 0.75 if side > 0 else x - 1.3, side * SIZE[1] / 2.0
    bars = [shapes.standing_box((0.09, 0.12, 2.15), (at + a * 0.52, y, 0.0), tile_m=0.7) for a in (-1, 1)]
    bars.append(shapes.standing_box((1.13, 0.12, 0.1), (at, y, 2.1), tile_m=0.7))
    knob = shapes.moved(shapes.ellipsoid((0.035,) * 3, sides=16, rings=8), (at + 0.38, y - side * 0.08, 1.05))
    dark = textures.clipped(np.full((2, 2), 0.08))
    return [
        parts.solid(f"door {k}", shapes.box((0.95, 0.05, 2.1), (at, y, 1.05), tile_m=1.2), leaf, "door"),
        parts.solid(
            f"door frame {k}",
            shapes.merged(bars),
            textures.clipped(np.full((2, 2), 0.75)),
            "door",
            instance=f"door {k}",
        ),
        parts.solid(f"handle {k}", knob, dark, "door", instance=f"door {k}"),
    ]


def _pipes(rng: np.random.Generator) -> list[Body]:
    """Return pipes with joints under the ceiling, and handrails."""
    bodies = []
    for k, (y, z, radius) in enumerate(((1.1, 2.5, 0.06), (0.94, 2.56, 0.04), (-1.12, 2.45, 0.08))):
        pipe = [shapes.cylinder(radius, SIZE[0], sides=16, tile_m=0.4)]
        pipe += [
            shapes.moved(shapes.cylinder(1.3 * radius, 0.1, sides=16, tile_m=0.4), (0, 0, s))
            for s in np.arange(1.0, SIZE[0], 2.0)
        ]
        mesh = shapes.moved(shapes.merged(pipe), (-SIZE[0] / 2.0, y, z), turn_deg=90.0, axis=(0, 1, 0))
        bodies.append(parts.solid(f"pipe {k}", mesh, textures.plaster(rng, 0.3 + 0.15 * k, 0.5, size=256), "pipe"))
    bar = shapes.moved(
        shapes.cylinder(0.025, 3.4, sides=12, tile_m=0.3), (-1.7, -1.22, 0.9), turn_deg=90.0, axis=(0, 1, 0)
    )
    rail = shapes.merged(shapes.moved(bar, (x, 0.0, 0.0)) for x in BAYS[::2])
    return [*bodies, parts.solid("rail", rail, textures.wood(rng, size=256), "rail")]


def _things(rng: np.random.Generator) -> list[Body]:
    """Return benches, bins, boxes and fire extinguishers along the walls."""
    bodies = []
    bin_profile = [(0.0, 0.0), (0.14, 0.0), (0.18, 0.5), (0.17, 0.5), (0.13, 0.03), (0.0, 0.03)]
    bottle = [(0.0, 0.0), (0.08, 0.0), (0.08, 0.38), (0.05, 0.45), (0.02, 0.48), (0.02, 0.54), (0.0, 0.54)]
    for k, x in enumerate(BAYS):
        side = 1.0 if k % 2 == 0 else -1.0
        if k % 3 == 0:
            bodies.append(
                parts.table(
                    f"bench {k}",
                    (1.3, 0.36, 0.46),
                    (x + 1.0, side * 1.08, 0),
                    textures.wood(rng, mean=0.3, boards=4, size=256),
                )
            )
        elif k % 3 == 1:
            bodies.append(
                parts.vessel(f"bin {k}", bin_profile, (x + 0.9, side * 1.05, 0), textures.plaid(rng), tile_m=0.3)
            )
        else:
            crates = [
                shapes.moved(
                    shapes.standing_box((0.4, 0.34, 0.3)),
                    (x + 1.0 + 0.03 * n, side * 1.08, 0.3 * n),
                    turn_deg=float(rng.uniform(-9, 9)),
                )
                for n in range(3)
            ]
            bodies.append(parts.solid(f"crates {k}", shapes.merged(crates), textures.poster(rng), "box"))
        mesh = shapes.moved(shapes.lathe(bottle, sides=20), (x + BAY / 2.0 - 0.4, side * 1.2, 0.7))
        bodies.append(
            parts.solid(
                f"extinguisher {k}", mesh, textures.text_page(rng, width=128, height=128, letter=14), "extinguisher"
            )
        )
    return bodies
