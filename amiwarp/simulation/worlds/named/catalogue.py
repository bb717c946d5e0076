"""The built-in worlds by name: room, desk, corridor and ball. Street and person are built in their own files."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.named import bodies as parts
from amiwarp.simulation.worlds.named import person, street
from amiwarp.simulation.worlds.named.bodies import TRAJECTORIES, Viewpoint, camera_trajectory
from amiwarp.simulation.worlds.world import Body, Lamp, Mesh, Trajectory, World
from amiwarp.validation import guarded, one_of, real, whole

# Built-in world ``room``: gratings in all directions, pictures, printed pages, a table, shelves and a sofa.

ROOM_SIZE = (5.2, 4.4, 2.6)
"""Length (x), width (y) and height (z) of the room [m]."""
ROOM_VIEW = Viewpoint((-2.1, -1.55, 1.5), (1.0, 1.0, 0.95))
"""Camera pose: in one corner, looking towards the opposite corner."""
ROOM_LAMPS = (Lamp((-0.3, 0.2, 2.35), 2.0, shadows=True), Lamp((-1.9, -1.7, 2.2), 0.9))
"""Two lamps: one near the ceiling, which casts shadows, and a weaker lamp behind the camera."""


def build_room(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world. No body moves, so ``duration_s`` has no effect."""
    return World("room", tuple(furniture(rng)), ambient=0.3, lamps=ROOM_LAMPS)


def furniture(rng: np.random.Generator) -> list[Body]:
    """Return the bodies of the room.

    A path on the floor from (-1.8, 1.5) to (1.5, -1.8) [m] is free for the ball of the world ``ball``.
    """
    walls = [parts.plaster(rng, mean, 0.45) for mean in (0.45, 0.55, 0.4, 0.5)]
    bodies = parts.hall(ROOM_SIZE, walls, parts.wood(rng, mean=0.28), parts.tiles(rng, mean=0.7, joint=0.3, count=4))
    return [*bodies, *_pictures(rng), *_shelves(rng), *_table(rng), *_sofa(rng), *_room_things(rng)]


def _pictures(rng: np.random.Generator) -> list[Body]:
    """Return gratings and pictures on two walls."""
    north, east = (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)
    x, y = ROOM_SIZE[0] / 2.0, ROOM_SIZE[1] / 2.0
    return [
        *parts.grating_strip("grating", (-1.95, y, 2.12), north, count=8, side=0.34, cycles=7.0),
        *parts.picture("poster", (-1.55, y, 1.5), north, parts.poster(rng), 0.8, 0.8),
        *parts.picture("page", (-0.55, y, 1.5), north, parts.text_page(rng), 0.7, 0.95),
        *parts.picture("star", (0.45, y, 1.55), north, parts.star(), 0.75, 0.75),
        *parts.picture("checkerboard", (x, -0.55, 1.55), east, parts.checkerboard(8), 0.8, 0.8),
        *parts.picture("second page", (x, -1.5, 1.6), east, parts.text_page(rng, letter=26), 0.6, 0.8),
    ]


def _shelves(rng: np.random.Generator) -> list[Body]:
    """Return a bookcase with books against the eastern wall."""
    depth, width, height = 0.32, 1.3, 2.1
    x, y = ROOM_SIZE[0] / 2.0 - depth / 2.0 - 0.03, 0.95
    boards = [parts.standing_box((depth, 0.03, height), (x, y + a * width / 2.0, 0), tile_m=0.8) for a in (-1, 1)]
    levels = np.linspace(0.06, height - 0.03, 6)
    boards += [parts.standing_box((depth, width, 0.03), (x, y, z), tile_m=0.8) for z in levels]
    boards.append(parts.standing_box((0.02, width, height), (x + depth / 2.0, y, 0), tile_m=0.8))
    bodies = [parts.solid("bookcase", parts.merged(boards), parts.wood(rng, mean=0.4, boards=4), "bookcase")]
    for k, z in enumerate(levels[:-1]):
        bodies.append(
            parts.solid(f"books {k + 1}", _shelf_books(rng, (x, y, z + 0.03), width), parts.poster(rng), "book")
        )
    return bodies


def _shelf_books(rng: np.random.Generator, middle: tuple[float, float, float], width: float) -> Mesh:
    """Return a row of books along y. Each book shows a different part of the texture.

    ``middle``: middle of the row on the shelf [m]; ``width``: length of the row [m].
    """
    books, at = [], -width / 2.0 + 0.03
    while at < width / 2.0 - 0.1:
        thick, tall, deep = rng.uniform(0.02, 0.06), rng.uniform(0.2, 0.33), rng.uniform(0.18, 0.24)
        book = parts.standing_box((deep, thick, tall), (middle[0], middle[1] + at + thick / 2.0, middle[2]), tile_m=0.4)
        books.append(Mesh(book.vertices, book.faces, np.asarray(book.uv) + rng.uniform(0.0, 1.0, 2)))
        at += thick + (0.002 if rng.uniform() < 0.9 else 0.08)
    return parts.merged(books)


def _table(rng: np.random.Generator) -> list[Body]:
    """Return a table with vessels, books and a globe, and two chairs."""
    x, y, z = 1.15, 0.35, 0.74
    cup = [(0.0, 0.0), (0.03, 0.0), (0.042, 0.03), (0.04, 0.09), (0.036, 0.09), (0.03, 0.02), (0.0, 0.015)]
    vase = [(0.0, 0.0), (0.06, 0.0), (0.11, 0.12), (0.05, 0.26), (0.07, 0.33), (0.06, 0.33), (0.03, 0.25)]
    stack = [parts.moved(parts.standing_box((0.24, 0.17, 0.035), tile_m=0.3), (x + 0.02, y + 0.15, z + 0.035 * k),
                          turn_deg=float(rng.uniform(-20, 20))) for k in range(4)]  # fmt: skip
    globe = parts.moved(parts.ellipsoid((0.14, 0.14, 0.14), sides=32, rings=20), (x + 0.35, y - 0.05, z + 0.19))
    return [
        parts.table("table", (1.3, 0.8, z), (x, y, 0), parts.wood(rng, mean=0.45, boards=6), turn_deg=-8.0),
        parts.vessel("vase", vase, (x - 0.42, y + 0.2, z), parts.checkerboard(8, size=128)),
        parts.vessel("cup", cup, (x - 0.2, y - 0.2, z), parts.plaid(rng), tile_m=0.1),
        parts.solid("stack", parts.merged(stack), parts.poster(rng), "book"),
        parts.solid("globe", globe, parts.weathered(rng, parts.checkerboard(16), 0.3), "globe"),
        parts.solid(
            "globe foot",
            parts.moved(parts.cylinder(0.08, 0.05, tile_m=0.2), (x + 0.35, y - 0.05, z)),
            parts.wood(rng, size=128),
            "globe",
            instance="globe",
        ),
        parts.chair("chair", (x - 0.75, y - 0.1, 0), parts.wood(rng, mean=0.2, boards=4, size=256), turn_deg=10.0),
        parts.chair(
            "second chair", (x + 0.1, y - 0.75, 0), parts.wood(rng, mean=0.55, boards=4, size=256), turn_deg=80.0
        ),
    ]


def _sofa(rng: np.random.Generator) -> list[Body]:
    """Return a sofa with cushions against the northern wall."""
    x, y = -0.35, ROOM_SIZE[1] / 2.0 - 0.45
    frame = [
        parts.standing_box((1.7, 0.8, 0.25), (x, y, 0.1), tile_m=0.5),
        parts.standing_box((1.7, 0.2, 0.5), (x, y + 0.32, 0.3), tile_m=0.5),
        *(parts.standing_box((0.18, 0.8, 0.5), (x + side * 0.86, y, 0.1), tile_m=0.5) for side in (-1, 1)),
        *(parts.standing_box((0.74, 0.6, 0.12), (x + side * 0.38, y - 0.08, 0.35), tile_m=0.5) for side in (-1, 1)),
    ]
    cushion = parts.ellipsoid((0.22, 0.09, 0.2), tile_m=0.5)
    cushions = [parts.moved(cushion, (x + at, y + 0.12, 0.66), turn_deg=25 * at, axis=(1, 0, 1)) for at in (-0.55, 0.5)]
    return [
        parts.solid("sofa", parts.merged(frame), parts.plaid(rng, stripes=14), "sofa"),
        parts.solid("cushions", parts.merged(cushions), parts.checkerboard(6, size=128), "cushion"),
    ]


def _room_things(rng: np.random.Generator) -> list[Body]:
    """Return a rug, a floor lamp, a plant and a toy box."""
    shade = parts.moved(parts.lathe([(0.22, 0.0), (0.13, 0.3)], sides=32, tile_m=0.3), (0.95, 1.85, 1.45))
    stand = parts.merged([parts.cylinder(0.14, 0.03), parts.cylinder(0.014, 1.55, sides=12)])
    pot = [(0.0, 0.0), (0.12, 0.0), (0.17, 0.3), (0.15, 0.3), (0.14, 0.25), (0.0, 0.25)]
    leaf = parts.moved(parts.ellipsoid((0.3, 0.05, 0.012), sides=16, rings=8, tile_m=0.2), (0.3, 0, 0))
    steep = [parts.moved(leaf, (0, 0, 0), turn_deg=-float(angle), axis=(0, 1, 0)) for angle in rng.uniform(30, 80, 14)]
    crown = [parts.moved(one, (2.25, -0.15, 0.28), turn_deg=26.0 * k) for k, one in enumerate(steep)]
    return [
        parts.solid(
            "rug",
            parts.standing_box((1.9, 1.3, 0.012), (-0.45, 0.2, 0)),
            parts.plaid(rng, size=512, stripes=24),
            "rug",
        ),
        parts.solid("lamp shade", shade, parts.plaid(rng), "lamp", instance="lamp", emission=0.15),
        parts.solid(
            "lamp stand",
            parts.moved(stand, (0.95, 1.85, 0)),
            parts.plaster(rng, 0.1, size=64),
            "lamp",
            instance="lamp",
        ),
        parts.vessel("pot", pot, (2.25, -0.15, 0), parts.bricks(rng), tile_m=0.4),
        parts.solid("leaves", parts.merged(crown), parts.plaster(rng, 0.25, 0.5, size=128), "plant", instance="pot"),
        parts.solid(
            "toy box",
            parts.moved(parts.standing_box((0.4, 0.3, 0.3)), (-1.5, 0.2, 0), turn_deg=-30),
            parts.checkerboard(6),
            "box",
        ),
    ]


# Built-in world ``desk``: a screen, a keyboard, printed pages, books, pens and a mug, seen from the chair.

DESK_VIEW = Viewpoint((0.05, -0.62, 0.52), (0.0, 0.16, 0.1))
"""Camera pose: at the head of a person who sits at the desk. The top of the desk is at z = 0."""


def build_desk(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world. No body moves, so ``duration_s`` has no effect."""
    top = parts.box((1.7, 0.9, 0.03), (0.0, 0.12, -0.015), tile_m=0.6)
    wall = parts.panel((-2.0, 0.75, -0.8), (4.0, 0.0, 0.0), (0.0, 0.0, 2.6), tile_m=1.2)
    floor = parts.panel((-2.0, -1.5, -0.76), (4.0, 0, 0), (0, 2.3, 0), tile_m=1.5)
    bodies = [
        parts.solid("desk", top, parts.wood(rng, mean=0.4, boards=8, size=768), "desk"),
        parts.solid("wall", wall, parts.plaster(rng, 0.5, 0.4), "wall"),
        parts.solid("floor", floor, parts.tiles(rng), "floor"),
        *_screen(rng), *_keyboard(rng), *_papers(rng), *_desk_books(rng), *_desk_things(rng), *_gauges(),
    ]  # fmt: skip
    lamps = (Lamp((-0.6, 0.1, 0.75), 0.45, shadows=True), Lamp((1.0, -1.2, 1.4), 0.9))
    return World("desk", tuple(bodies), ambient=0.3, lamps=lamps)


def _screen(rng: np.random.Generator) -> list[Body]:
    """Return a screen on a stand, which shows a page of text."""
    frame = parts.merged([
        parts.box((0.56, 0.03, 0.34), (0.0, 0.5, 0.31), tile_m=0.3),
        parts.standing_box((0.05, 0.03, 0.16), (0.0, 0.52, 0.0), tile_m=0.3),
        parts.moved(parts.cylinder(0.1, 0.012, sides=32, tile_m=0.3), (0.0, 0.5, 0.0)),
    ])  # fmt: skip
    picture = parts.panel((-0.265, 0.484, 0.155), (0.53, 0, 0), (0, 0, 0.31))
    page = parts.text_page(rng, width=768, height=448, letter=20)
    return [
        parts.solid("screen frame", frame, parts.plaster(rng, 0.08, 0.4, size=256), "screen", instance="screen"),
        parts.solid("screen", picture, page, "screen"),
    ]


def _keyboard(rng: np.random.Generator) -> list[Body]:
    """Return a keyboard with separate keys."""
    keys = []
    for row in range(5):
        at = -0.2
        while at < 0.19:
            wide = 0.12 if row == 0 and -0.1 < at < 0.0 else float(rng.choice([0.022, 0.022, 0.022, 0.034]))
            key = parts.standing_box((wide - 0.004, 0.018, 0.008), (at + wide / 2.0, 0.022 * row - 0.045, 0.016))
            keys.append(key)
            at += wide
    place = (-0.06, -0.02, 0.0)
    face = np.full((32, 32), 0.12)
    face[8:24, 12:15] = face[8:11, 12:22] = face[15:18, 12:20] = 0.85
    base = parts.standing_box((0.44, 0.13, 0.016), tile_m=0.2)
    return [
        parts.solid("keyboard", parts.moved(base, place), parts.plaster(rng, 0.5, 0.3, size=256), "keyboard"),
        parts.solid(
            "keys", parts.moved(parts.merged(keys), place), parts.clipped(face), "keyboard", instance="keyboard"
        ),
    ]


def _papers(rng: np.random.Generator) -> list[Body]:
    """Return three printed pages on the desk."""
    bodies = []
    for k, (x, y, turn) in enumerate(((0.36, -0.06, -12.0), (0.44, 0.1, 18.0), (-0.43, -0.08, 8.0))):
        sheet = parts.panel((-0.105, -0.148, 0.001 + 0.001 * k), (0.21, 0, 0), (0, 0.297, 0))
        page = parts.text_page(rng, width=512, height=724, letter=18)
        bodies.append(parts.solid(f"page {k + 1}", parts.moved(sheet, (x, y, 0), turn_deg=turn), page, "page"))
    return bodies


def _desk_books(rng: np.random.Generator) -> list[Body]:
    """Return a stack of books and a row of upright books."""
    bodies, z = [], 0.0
    for k in range(4):
        thick = float(rng.uniform(0.018, 0.04))
        book = parts.standing_box((0.2, 0.15, thick))
        place = (-0.52, 0.22, z)
        bodies.append(
            parts.solid(
                f"book {k + 1}",
                parts.moved(book, place, turn_deg=float(rng.uniform(-15, 15))),
                parts.poster(rng, size=192),
                "book",
            )
        )
        z += thick
    row = [
        parts.standing_box((0.03, 0.16, float(rng.uniform(0.2, 0.26))), (0.42 + 0.033 * k, 0.48, 0)) for k in range(9)
    ]
    bodies.append(parts.solid("row of books", parts.merged(row), parts.book_spines(rng, books=4, size=256), "book"))
    return bodies


def _desk_things(rng: np.random.Generator) -> list[Body]:
    """Return a mug with pens, a bowl, a ball and a lamp."""
    mug = [(0.0, 0.0), (0.035, 0.0), (0.041, 0.02), (0.041, 0.1), (0.036, 0.1), (0.035, 0.02), (0.0, 0.015)]
    bowl = [(0.0, 0.0), (0.04, 0.0), (0.085, 0.05), (0.08, 0.05), (0.035, 0.01), (0.0, 0.008)]
    pen = parts.cylinder(0.004, 0.16, sides=12, tile_m=0.03)
    pens = [
        parts.moved(pen, (0.24 + 0.012 * k, 0.3, 0.02), turn_deg=9.0 * (k - 1.5), axis=(0.5, 1, 0)) for k in range(4)
    ]
    lying = [
        parts.moved(parts.cylinder(0.0045, 0.14, sides=12, tile_m=0.03), (0.2, y, 0.005), turn_deg=90, axis=(0.3, 1, 0))
        for y in (-0.13, -0.1)
    ]
    ball = parts.moved(parts.ellipsoid((0.035,) * 3, sides=28, rings=16), (0.26, 0.13, 0.035))
    shade = parts.lathe([(0.09, 0.0), (0.07, 0.08), (0.03, 0.12)], sides=32, tile_m=0.15)
    lamp = parts.merged([
        parts.moved(parts.cylinder(0.07, 0.015, sides=32, tile_m=0.2), (-0.72, 0.38, 0)),
        parts.moved(parts.cylinder(0.009, 0.4, sides=16, tile_m=0.1), (-0.72, 0.38, 0)),
        parts.moved(shade, (-0.69, 0.36, 0.4), turn_deg=-20, axis=(1, 1, 0)),
    ])  # fmt: skip
    return [
        parts.vessel("mug", mug, (0.26, 0.3, 0.0), parts.plaid(rng), tile_m=0.12),
        parts.solid("pens", parts.merged(pens), parts.checkerboard(4, size=64), "pen"),
        parts.solid("lying pens", parts.merged(lying), parts.checkerboard(2, size=64), "pen"),
        parts.vessel("bowl", bowl, (-0.27, 0.25, 0.0), parts.bricks(rng, size=256), tile_m=0.15),
        parts.solid("ball", ball, parts.checkerboard(12), "ball"),
        parts.solid("desk lamp", lamp, parts.plaster(rng, 0.2, 0.6, size=256), "lamp"),
    ]


def _gauges() -> list[Body]:
    """Return gratings, a Siemens star, a checkerboard card, a cube and a ruler."""
    cube = parts.moved(parts.standing_box((0.07, 0.07, 0.07)), (-0.36, 0.33, 0.0), turn_deg=30)
    ruler = parts.moved(parts.standing_box((0.3, 0.025, 0.003), tile_m=0.025), (0.02, -0.15, 0.0), turn_deg=4)
    ticks = np.full((64, 64), 0.75)
    ticks[:36, ::8], ticks[:50, :2] = 0.05, 0.05
    card = parts.moved(parts.panel((-0.06, -0.06, 0.003), (0.12, 0, 0), (0, 0.12, 0)), (-0.2, -0.18, 0), turn_deg=-20)
    return [
        *parts.grating_strip("grating", (-0.62, 0.74, 0.012), (1.0, 0, 0), count=8, side=0.12, cycles=6.0),
        *parts.picture("star", (0.55, 0.75, 0.42), (1.0, 0, 0), parts.star(), 0.28, 0.28),
        parts.solid("cube", cube, parts.checkerboard(4, size=128), "cube"),
        parts.solid("ruler", ruler, parts.clipped(ticks), "ruler"),
        parts.solid("card", card, parts.checkerboard(8), "card"),
    ]


# Built-in world ``corridor``: doors, notices, pillars, pipes and lights that repeat into the distance.

CORRIDOR_SIZE = (36.0, 2.6, 2.7)
"""Length, width and height of the corridor [m], which lies along the x axis."""
BAY = 4.0
"""Length of one section of the corridor [m]."""
BAYS = tuple(float(x) for x in np.arange(-14.0, 15.0, BAY))
"""Centres of the sections along x [m]."""
CORRIDOR_VIEW = Viewpoint((-6.0, -0.1, 1.55), (4.0, 0.15, 1.3), walk_m=(7.0, 0.0, 0.0))
"""Camera pose: in the middle of the corridor. The camera walks along the corridor."""


def build_corridor(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world. No body moves, so ``duration_s`` has no effect."""
    walls = [
        parts.bricks(rng, mean=0.42, joint=0.65),
        parts.checkerboard(8),
        parts.bricks(rng, mean=0.35),
        parts.plaster(rng),
    ]
    bodies = parts.hall(
        CORRIDOR_SIZE,
        walls,
        parts.tiles(rng, mean=0.45, joint=0.1, count=4),
        parts.tiles(rng, mean=0.7, joint=0.25, count=4),
    )
    doors = [parts.wood(rng, mean=mean, boards=6) for mean in (0.3, 0.55)]
    for k, x in enumerate(BAYS):
        bodies += [*_bay(rng, k, x), *_door(doors[k % 2], k, x)]
    bodies += [*_pipes(rng), *_corridor_things(rng)]
    lamps = tuple(Lamp((x, 0.0, 1.95), 0.9) for x in BAYS)
    return World("corridor", tuple(bodies), ambient=0.28, lamps=lamps)


def _bay(rng: np.random.Generator, k: int, x: float) -> list[Body]:
    """Return the light, pillars and pictures of section ``k``, whose centre is at ``x`` [m]."""
    y, z = CORRIDOR_SIZE[1] / 2.0, CORRIDOR_SIZE[2]
    light = parts.box((1.2, 0.3, 0.05), (x, 0.0, z - 0.026))
    north, south = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
    pillars = []
    for side in (-1, 1):
        shaft = parts.lathe(
            [(0.13, 0), (0.13, 0.1), (0.1, 0.14), (0.1, z - 0.14), (0.13, z - 0.1), (0.13, z)], sides=24, tile_m=0.6
        )
        pillars.append(parts.moved(shaft, (x + BAY / 2.0, side * (y - 0.1), 0.0)))
    art = (parts.poster(rng), parts.text_page(rng, letter=24), parts.star(), parts.checkerboard(8))[k % 4]
    bodies = [
        parts.solid(f"light {k}", light, parts.tiles(rng, mean=0.8, joint=0.3, size=128), "light", emission=0.7),
        parts.solid(f"pillars {k}", parts.merged(pillars), parts.plaster(rng, 0.55, 0.4, size=256), "pillar"),
        *parts.picture(f"picture {k}", (x + 1.1, y, 1.5), north, art, 0.7, 0.8),
        *parts.picture(f"notice {k}", (x + 0.6, -y, 1.5), south, parts.text_page(rng), 0.5, 0.68),
    ]
    if k % 2 == 0:  # odd sections have a door in this place
        bodies += parts.grating_strip(f"grating {k}", (x + 0.1, -y, 1.35), south, count=6, side=0.28, cycles=5.0)
    return bodies


def _door(leaf: parts.Texture, k: int, x: float) -> list[Body]:
    """Return the door of section ``k`` with its frame and handle. Doors alternate between the two walls."""
    side = 1.0 if k % 2 == 0 else -1.0
    at, y = x - 0.75 if side > 0 else x - 1.3, side * CORRIDOR_SIZE[1] / 2.0
    bars = [parts.standing_box((0.09, 0.12, 2.15), (at + a * 0.52, y, 0.0), tile_m=0.7) for a in (-1, 1)]
    bars.append(parts.standing_box((1.13, 0.12, 0.1), (at, y, 2.1), tile_m=0.7))
    knob = parts.moved(parts.ellipsoid((0.035,) * 3, sides=16, rings=8), (at + 0.38, y - side * 0.08, 1.05))
    dark = parts.clipped(np.full((2, 2), 0.08))
    return [
        parts.solid(f"door {k}", parts.box((0.95, 0.05, 2.1), (at, y, 1.05), tile_m=1.2), leaf, "door"),
        parts.solid(
            f"door frame {k}",
            parts.merged(bars),
            parts.clipped(np.full((2, 2), 0.75)),
            "door",
            instance=f"door {k}",
        ),
        parts.solid(f"handle {k}", knob, dark, "door", instance=f"door {k}"),
    ]


def _pipes(rng: np.random.Generator) -> list[Body]:
    """Return pipes with joints under the ceiling, and handrails."""
    bodies = []
    for k, (y, z, radius) in enumerate(((1.1, 2.5, 0.06), (0.94, 2.56, 0.04), (-1.12, 2.45, 0.08))):
        pipe = [parts.cylinder(radius, CORRIDOR_SIZE[0], sides=16, tile_m=0.4)]
        pipe += [
            parts.moved(parts.cylinder(1.3 * radius, 0.1, sides=16, tile_m=0.4), (0, 0, s))
            for s in np.arange(1.0, CORRIDOR_SIZE[0], 2.0)
        ]
        mesh = parts.moved(parts.merged(pipe), (-CORRIDOR_SIZE[0] / 2.0, y, z), turn_deg=90.0, axis=(0, 1, 0))
        bodies.append(parts.solid(f"pipe {k}", mesh, parts.plaster(rng, 0.3 + 0.15 * k, 0.5, size=256), "pipe"))
    bar = parts.moved(
        parts.cylinder(0.025, 3.4, sides=12, tile_m=0.3), (-1.7, -1.22, 0.9), turn_deg=90.0, axis=(0, 1, 0)
    )
    rail = parts.merged(parts.moved(bar, (x, 0.0, 0.0)) for x in BAYS[::2])
    return [*bodies, parts.solid("rail", rail, parts.wood(rng, size=256), "rail")]


def _corridor_things(rng: np.random.Generator) -> list[Body]:
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
                    parts.wood(rng, mean=0.3, boards=4, size=256),
                )
            )
        elif k % 3 == 1:
            bodies.append(
                parts.vessel(f"bin {k}", bin_profile, (x + 0.9, side * 1.05, 0), parts.plaid(rng), tile_m=0.3)
            )
        else:
            crates = [
                parts.moved(
                    parts.standing_box((0.4, 0.34, 0.3)),
                    (x + 1.0 + 0.03 * n, side * 1.08, 0.3 * n),
                    turn_deg=float(rng.uniform(-9, 9)),
                )
                for n in range(3)
            ]
            bodies.append(parts.solid(f"crates {k}", parts.merged(crates), parts.poster(rng), "box"))
        mesh = parts.moved(parts.lathe(bottle, sides=20), (x + BAY / 2.0 - 0.4, side * 1.2, 0.7))
        bodies.append(
            parts.solid(
                f"extinguisher {k}", mesh, parts.text_page(rng, width=128, height=128, letter=14), "extinguisher"
            )
        )
    return bodies


# Built-in world ``ball``: a ball thrown across a room that bounces off the floor and at both ends of its path.

BALL_VIEW = ROOM_VIEW
"""Camera pose, the same as in the world ``room``."""
BALL_RADIUS = 0.12
"""Radius of the ball [m]."""
GRAVITY = 9.81
"""Acceleration of free fall [m/s²]."""
THROW_START = (-1.25, 1.0)
"""Position at the start of the throw: distance along the path from its middle, and height [m]."""
THROW_VELOCITY = (2.6, 3.9)
"""Initial velocity of the ball along the path and upwards [m/s]."""
PATH_HALF_LENGTH = 1.55
"""Half the length of the path on the floor [m]; the ball bounces at both ends."""
PATH_MIDDLE, PATH_DIRECTION = (-0.15, -0.15), (math.sqrt(0.5), -math.sqrt(0.5))
"""Middle of the path on the floor (x, y) [m], and its direction (unit vector)."""
BOUNCE = 0.8
"""Fraction of the speed that remains after a bounce."""
FLIGHT_STEP_S = 0.002
"""Longest time between two poses of the ball's trajectory [s]."""
BALL_SPIN = 5.0
"""Angular velocity of the ball about the direction of the path [rad/s].

The angular velocity about the vertical axis is 0.6 times as large.
"""


def build_ball(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world: the room and the ball. ``duration_s``: length of the ball's trajectory [s]."""
    ball = parts.solid(
        "ball",
        parts.ellipsoid((BALL_RADIUS,) * 3, sides=40, rings=20),
        parts.weathered(rng, parts.checkerboard(12), 0.2),
        "ball",
        trajectory=thrown(duration_s),
    )
    return World("ball", (*furniture(rng), ball), ambient=0.3, lamps=ROOM_LAMPS)


def thrown(duration_s: float) -> Trajectory:
    """Return the trajectory of the ball over ``duration_s`` [s]."""
    from scipy.spatial.transform import Rotation

    t, along, height = flight(duration_s)
    position = np.column_stack(
        [PATH_MIDDLE[0] + along * PATH_DIRECTION[0], PATH_MIDDLE[1] + along * PATH_DIRECTION[1], height]
    )
    turn = np.outer(t, (BALL_SPIN * PATH_DIRECTION[0], BALL_SPIN * PATH_DIRECTION[1], 0.6 * BALL_SPIN))
    return Trajectory(t, position, Rotation.from_rotvec(turn).as_quat())


def flight(duration_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the ball's flight: times [s], distances along the path from its middle [m], and heights [m].

    Between two bounces the flight is a parabola.
    """
    t = np.linspace(0.0, duration_s, max(4, math.ceil(duration_s / FLIGHT_STEP_S) + 1))
    step = float(t[1])
    s, z = THROW_START
    v, w = THROW_VELOCITY
    path = []
    for _ in t:
        path.append((s, z))
        s, z, w = s + v * step, z + w * step - 0.5 * GRAVITY * step**2, w - GRAVITY * step
        if abs(s) > PATH_HALF_LENGTH and s * v > 0.0:
            v = -BOUNCE * v
        if z < BALL_RADIUS and w < 0.0:
            z, v, w = BALL_RADIUS, 0.98 * v, -BOUNCE * w
            if w < GRAVITY * FLIGHT_STEP_S * 4.0:
                v, w = 0.99 * v, 0.0
    along, height = np.array(path).T
    return t, along, height


# Catalogue of the built-in worlds, and the function that builds one by name.

LONGEST_S = 3600.0
"""Longest duration of a built-in world [s]."""


@dataclass(frozen=True)
class NamedWorld:
    """Builder and mean camera pose of a built-in world."""

    build: Callable[[np.random.Generator, float], World]
    """Function that returns the world for a random generator and a duration [s]."""
    view: Viewpoint
    """Mean position and viewing direction of the camera."""


NAMED = {
    "room": NamedWorld(build_room, ROOM_VIEW),
    "desk": NamedWorld(build_desk, DESK_VIEW),
    "corridor": NamedWorld(build_corridor, CORRIDOR_VIEW),
    "street": NamedWorld(street.build, street.VIEW),
    "ball": NamedWorld(build_ball, BALL_VIEW),
    "person": NamedWorld(person.build, person.VIEW),
}
"""Built-in worlds by name."""
WORLDS = tuple(NAMED)
"""Names of the built-in worlds."""


@guarded
def named_world(
    name: str, trajectory: str = "handheld", *, seed: int = 0, duration_s: float = 1.0
) -> tuple[World, Trajectory]:
    """Return a built-in world and a camera trajectory through it.

    The worlds are generated from a seed and need no files.

    Parameters
    ----------
    name : str
        ``room`` (furniture, pictures, gratings in all directions), ``desk``, ``corridor``, ``street`` (a small town),
        ``ball`` (a ball thrown across the room) or ``person`` (a walking figure, whose joints are ``World.joints``).
    trajectory : str
        Camera motion: ``still``, ``handheld`` (smooth random motion below 3 Hz, about 1.5 cm and 1.5 deg in amplitude;
        in the corridor and the street the camera also walks forward) or ``fast`` (about ten times the speed).
    seed : int
        Seed of textures, shapes and camera motion. The same seed gives the same world with every trajectory.
    duration_s : float
        Length of the trajectories [s]. Nothing moves after this time.

    Returns
    -------
    world : World
        The world: bodies, lights and sky, with 2,000 to 100,000 triangles.
    trajectory : Trajectory
        Camera poses. The camera never passes through a body.

    Raises
    ------
    AmiwarpError
        If the name of the world or of the trajectory is unknown, or the seed or the duration is out of range.

    Examples
    --------
    >>> world, trajectory = amiwarp.named_world("person", "still", seed=1, duration_s=0.1)
    >>> [body.name for body in world.moving][:3]
    ['pelvis', 'torso', 'neck']
    >>> rotation, position = trajectory.poses([0.0])
    >>> position.tolist()
    [[0.3, -3.4, 1.35]]
    """
    one_of(name, WORLDS, "world")
    one_of(trajectory, TRAJECTORIES, "trajectory")
    seed = whole(seed, "seed", 0, 2**63 - 1)
    duration_s = real(duration_s, "duration_s", 1e-3, LONGEST_S, " s")
    made = NAMED[name]
    world = made.build(np.random.default_rng([seed, WORLDS.index(name)]), duration_s)
    camera = camera_trajectory(made.view, trajectory, duration_s, np.random.default_rng([seed, len(WORLDS)]))
    return world, camera
