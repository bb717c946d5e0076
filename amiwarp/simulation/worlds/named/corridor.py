"""Built-in world ``corridor``: doors, notices, pillars, pipes and lights that repeat into the distance."""

import numpy as np

from amiwarp.simulation.worlds.bodies import Body, Mesh
from amiwarp.simulation.worlds.lights import Lamp
from amiwarp.simulation.worlds.named import parts, shapes, textures
from amiwarp.simulation.worlds.named.camera_paths import Viewpoint
from amiwarp.simulation.worlds.world import World

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
    bodies += [*_pipes(rng), *_other_things(rng)]
    lamps = tuple(Lamp((x, 0.0, 1.95), 0.9) for x in BAYS)
    return World("corridor", tuple(bodies), ambient=0.28, lamps=lamps)


def _bay(rng: np.random.Generator, k: int, x: float) -> list[Body]:
    """Return the light, pillars and pictures of section ``k``, whose centre is at ``x`` [m]."""
    wall_y = SIZE[1] / 2.0
    top = SIZE[2]
    north = (1.0, 0.0, 0.0)
    south = (-1.0, 0.0, 0.0)
    light = shapes.box((1.2, 0.3, 0.05), (x, 0.0, top - 0.026))

    base_profile = [(0.13, 0), (0.13, 0.1), (0.1, 0.14)]
    capital_profile = [(0.1, top - 0.14), (0.13, top - 0.1), (0.13, top)]
    pillar = shapes.lathe([*base_profile, *capital_profile], sides=24, tile_m=0.6)
    pillars = []
    for side in (-1, 1):
        foot = (x + BAY / 2.0, side * (wall_y - 0.1), 0.0)
        pillars.append(shapes.moved(pillar, foot))

    # All are drawn, whichever is shown, so that the random numbers that follow do not depend on it.
    pictures = (
        textures.poster(rng),
        textures.text_page(rng, letter=24),
        textures.star(),
        textures.checkerboard(8),
    )
    art = pictures[k % len(pictures)]
    glow = textures.tiles(rng, mean=0.8, joint=0.3, size=128)
    stone = textures.plaster(rng, 0.55, 0.4, size=256)
    text = textures.text_page(rng)
    bodies = [
        parts.solid(f"light {k}", light, glow, "light", emission=0.7),
        parts.solid(f"pillars {k}", shapes.merged(pillars), stone, "pillar"),
        *parts.picture(f"picture {k}", (x + 1.1, wall_y, 1.5), north, art, 0.7, 0.8),
        *parts.picture(f"notice {k}", (x + 0.6, -wall_y, 1.5), south, text, 0.5, 0.68),
    ]
    if k % 2 == 0:  # odd sections have a door in this place
        corner = (x + 0.1, -wall_y, 1.35)
        bodies += parts.grating_strip(f"grating {k}", corner, south, count=6, side=0.28, cycles=5.0)
    return bodies


def _door(leaf: textures.Texture, k: int, x: float) -> list[Body]:
    """Return the door of section ``k`` with its frame and handle. Doors alternate between the two walls."""
    name = f"door {k}"
    side = 1.0 if k % 2 == 0 else -1.0
    middle = x - 0.75 if side > 0 else x - 1.3
    y = side * SIZE[1] / 2.0
    door = shapes.box((0.95, 0.05, 2.1), (middle, y, 1.05), tile_m=1.2)

    bars = []
    for end in (-1, 1):
        foot = (middle + end * 0.52, y, 0.0)
        bars.append(shapes.standing_box((0.09, 0.12, 2.15), foot, tile_m=0.7))
    bars.append(shapes.standing_box((1.13, 0.12, 0.1), (middle, y, 2.1), tile_m=0.7))
    knob = shapes.ellipsoid((0.035, 0.035, 0.035), sides=16, rings=8)
    knob = shapes.moved(knob, (middle + 0.38, y - side * 0.08, 1.05))

    white = textures.clipped(np.full((2, 2), 0.75))
    black = textures.clipped(np.full((2, 2), 0.08))
    return [
        parts.solid(name, door, leaf, "door"),
        parts.solid(f"door frame {k}", shapes.merged(bars), white, "door", instance=name),
        parts.solid(f"handle {k}", knob, black, "door", instance=name),
    ]


def _pipes(rng: np.random.Generator) -> list[Body]:
    """Return pipes with joints under the ceiling, and handrails."""
    length = SIZE[0]
    # y, z and radius [m]
    pipes = ((1.1, 2.5, 0.06), (0.94, 2.56, 0.04), (-1.12, 2.45, 0.08))
    bodies = []
    for k, (y, z, radius) in enumerate(pipes):
        pieces = [shapes.cylinder(radius, length, sides=16, tile_m=0.4)]
        joint = shapes.cylinder(1.3 * radius, 0.1, sides=16, tile_m=0.4)
        for along in np.arange(1.0, length, 2.0):
            pieces.append(shapes.moved(joint, (0, 0, along)))
        start = (-length / 2.0, y, z)
        pipe = shapes.moved(shapes.merged(pieces), start, turn_deg=90.0, axis=(0, 1, 0))
        metal = textures.plaster(rng, 0.3 + 0.15 * k, 0.5, size=256)
        bodies.append(parts.solid(f"pipe {k}", pipe, metal, "pipe"))

    bar = shapes.cylinder(0.025, 3.4, sides=12, tile_m=0.3)
    bar = shapes.moved(bar, (-1.7, -1.22, 0.9), turn_deg=90.0, axis=(0, 1, 0))
    rail = shapes.merged(shapes.moved(bar, (x, 0.0, 0.0)) for x in BAYS[::2])
    return [*bodies, parts.solid("rail", rail, textures.wood(rng, size=256), "rail")]


def _other_things(rng: np.random.Generator) -> list[Body]:
    """Return benches, bins, boxes and fire extinguishers along the walls."""
    bodies = []
    bin_profile = [(0.0, 0.0), (0.14, 0.0), (0.18, 0.5), (0.17, 0.5), (0.13, 0.03), (0.0, 0.03)]
    bottle = [
        (0.0, 0.0),
        (0.08, 0.0),
        (0.08, 0.38),
        (0.05, 0.45),
        (0.02, 0.48),
        (0.02, 0.54),
        (0.0, 0.54),
    ]
    for k, x in enumerate(BAYS):
        side = 1.0 if k % 2 == 0 else -1.0
        kind = k % 3
        if kind == 0:
            wood = textures.wood(rng, mean=0.3, boards=4, size=256)
            place = (x + 1.0, side * 1.08, 0.0)
            bodies.append(parts.table(f"bench {k}", (1.3, 0.36, 0.46), place, wood))
        elif kind == 1:
            plaid = textures.plaid(rng)
            place = (x + 0.9, side * 1.05, 0.0)
            bodies.append(parts.vessel(f"bin {k}", bin_profile, place, plaid, tile_m=0.3))
        else:
            crates = _stack_of_crates(rng, x + 1.0, side * 1.08)
            bodies.append(parts.solid(f"crates {k}", crates, textures.poster(rng), "box"))

        place = (x + BAY / 2.0 - 0.4, side * 1.2, 0.7)
        extinguisher = shapes.moved(shapes.lathe(bottle, sides=20), place)
        label = textures.text_page(rng, width=128, height=128, letter=14)
        bodies.append(parts.solid(f"extinguisher {k}", extinguisher, label, "extinguisher"))
    return bodies


def _stack_of_crates(rng: np.random.Generator, x: float, y: float) -> Mesh:
    """Return three crates on each other, not quite in line."""
    crate = shapes.standing_box((0.4, 0.34, 0.3))
    crates = []
    for k in range(3):
        turn = float(rng.uniform(-9, 9))
        crates.append(shapes.moved(crate, (x + 0.03 * k, y, 0.3 * k), turn_deg=turn))
    return shapes.merged(crates)
