"""Built-in world ``room``: gratings in all directions, pictures, printed pages, a table, shelves and a sofa."""

import numpy as np

from amiwarp.simulation.worlds.named import bodies as parts
from amiwarp.simulation.worlds.named import bodies as shapes
from amiwarp.simulation.worlds.named import bodies as textures
from amiwarp.simulation.worlds.named.bodies import Viewpoint
from amiwarp.simulation.worlds.world import Body, Lamp, Mesh, World

SIZE = (5.2, 4.4, 2.6)
"""Length (x), width (y) and height (z) of the room [m]."""
VIEW = Viewpoint((-2.1, -1.55, 1.5), (1.0, 1.0, 0.95))
"""Camera pose: in one corner, looking towards the opposite corner."""
LAMPS = (Lamp((-0.3, 0.2, 2.35), 2.0, shadows=True), Lamp((-1.9, -1.7, 2.2), 0.9))
"""Two lamps: one near the ceiling, which casts shadows, and a weaker lamp behind the camera."""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world. No body moves, so ``duration_s`` has no effect."""
    return World("room", tuple(furniture(rng)), ambient=0.3, lamps=LAMPS)


def furniture(rng: np.random.Generator) -> list[Body]:
    """Return the bodies of the room.

    A path on the floor from (-1.8, 1.5) to (1.5, -1.8) [m] is free for the ball of the world ``ball``.
    """
    walls = [textures.plaster(rng, mean, 0.45) for mean in (0.45, 0.55, 0.4, 0.5)]
    bodies = parts.hall(SIZE, walls, textures.wood(rng, mean=0.28), textures.tiles(rng, mean=0.7, joint=0.3, count=4))
    return [*bodies, *_pictures(rng), *_shelves(rng), *_table(rng), *_sofa(rng), *_small(rng)]


def _pictures(rng: np.random.Generator) -> list[Body]:
    """Return gratings and pictures on two walls."""
    north, east = (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)
    x, y = SIZE[0] / 2.0, SIZE[1] / 2.0
    return [
        *parts.grating_strip("grating", (-1.95, y, 2.12), north, count=8, side=0.34, cycles=7.0),
        *parts.picture("poster", (-1.55, y, 1.5), north, textures.poster(rng), 0.8, 0.8),
        *parts.picture("page", (-0.55, y, 1.5), north, textures.text_page(rng), 0.7, 0.95),
        *parts.picture("star", (0.45, y, 1.55), north, textures.star(), 0.75, 0.75),
        *parts.picture("checkerboard", (x, -0.55, 1.55), east, textures.checkerboard(8), 0.8, 0.8),
        *parts.picture("second page", (x, -1.5, 1.6), east, textures.text_page(rng, letter=26), 0.6, 0.8),
    ]


def _shelves(rng: np.random.Generator) -> list[Body]:
    """Return a bookcase with books against the eastern wall."""
    depth, width, height = 0.32, 1.3, 2.1
    x, y = SIZE[0] / 2.0 - depth / 2.0 - 0.03, 0.95
    boards = [shapes.standing_box((depth, 0.03, height), (x, y + a * width / 2.0, 0), tile_m=0.8) for a in (-1, 1)]
    levels = np.linspace(0.06, height - 0.03, 6)
    boards += [shapes.standing_box((depth, width, 0.03), (x, y, z), tile_m=0.8) for z in levels]
    boards.append(shapes.standing_box((0.02, width, height), (x + depth / 2.0, y, 0), tile_m=0.8))
    bodies = [parts.solid("bookcase", shapes.merged(boards), textures.wood(rng, mean=0.4, boards=4), "bookcase")]
    for k, z in enumerate(levels[:-1]):
        bodies.append(parts.solid(f"books {k + 1}", _books(rng, (x, y, z + 0.03), width), textures.poster(rng), "book"))
    return bodies


def _books(rng: np.random.Generator, middle: tuple[float, float, float], width: float) -> Mesh:
    """Return a row of books along y. Each book shows a different part of the texture.

    ``middle``: middle of the row on the shelf [m]; ``width``: length of the row [m].
    """
    books, at = [], -width / 2.0 + 0.03
    while at < width / 2.0 - 0.1:
        thick, tall, deep = rng.uniform(0.02, 0.06), rng.uniform(0.2, 0.33), rng.uniform(0.18, 0.24)
        book = shapes.standing_box(
            (deep, thick, tall), (middle[0], middle[1] + at + thick / 2.0, middle[2]), tile_m=0.4
        )
        books.append(Mesh(book.vertices, book.faces, np.asarray(book.uv) + rng.uniform(0.0, 1.0, 2)))
        at += thick + (0.002 if rng.uniform() < 0.9 else 0.08)
    return shapes.merged(books)


def _table(rng: np.random.Generator) -> list[Body]:
    """Return a table with vessels, books and a globe, and two chairs."""
    x, y, z = 1.15, 0.35, 0.74
    cup = [(0.0, 0.0), (0.03, 0.0), (0.042, 0.03), (0.04, 0.09), (0.036, 0.09), (0.03, 0.02), (0.0, 0.015)]
    vase = [(0.0, 0.0), (0.06, 0.0), (0.11, 0.12), (0.05, 0.26), (0.07, 0.33), (0.06, 0.33), (0.03, 0.25)]
    stack = [shapes.moved(shapes.standing_box((0.24, 0.17, 0.035), tile_m=0.3), (x + 0.02, y + 0.15, z + 0.035 * k),
                          turn_deg=float(rng.uniform(-20, 20))) for k in range(4)]  # fmt: skip
    globe = shapes.moved(shapes.ellipsoid((0.14, 0.14, 0.14), sides=32, rings=20), (x + 0.35, y - 0.05, z + 0.19))
    return [
        parts.table("table", (1.3, 0.8, z), (x, y, 0), textures.wood(rng, mean=0.45, boards=6), turn_deg=-8.0),
        parts.vessel("vase", vase, (x - 0.42, y + 0.2, z), textures.checkerboard(8, size=128)),
        parts.vessel("cup", cup, (x - 0.2, y - 0.2, z), textures.plaid(rng), tile_m=0.1),
        parts.solid("stack", shapes.merged(stack), textures.poster(rng), "book"),
        parts.solid("globe", globe, textures.weathered(rng, textures.checkerboard(16), 0.3), "globe"),
        parts.solid(
            "globe foot",
            shapes.moved(shapes.cylinder(0.08, 0.05, tile_m=0.2), (x + 0.35, y - 0.05, z)),
            textures.wood(rng, size=128),
            "globe",
            instance="globe",
        ),
        parts.chair("chair", (x - 0.75, y - 0.1, 0), textures.wood(rng, mean=0.2, boards=4, size=256), turn_deg=10.0),
        parts.chair(
            "second chair", (x + 0.1, y - 0.75, 0), textures.wood(rng, mean=0.55, boards=4, size=256), turn_deg=80.0
        ),
    ]


def _sofa(rng: np.random.Generator) -> list[Body]:
    """Return a sofa with cushions against the northern wall."""
    x, y = -0.35, SIZE[1] / 2.0 - 0.45
    frame = [
        shapes.standing_box((1.7, 0.8, 0.25), (x, y, 0.1), tile_m=0.5),
        shapes.standing_box((1.7, 0.2, 0.5), (x, y + 0.32, 0.3), tile_m=0.5),
        *(shapes.standing_box((0.18, 0.8, 0.5), (x + side * 0.86, y, 0.1), tile_m=0.5) for side in (-1, 1)),
        *(shapes.standing_box((0.74, 0.6, 0.12), (x + side * 0.38, y - 0.08, 0.35), tile_m=0.5) for side in (-1, 1)),
    ]
    cushion = shapes.ellipsoid((0.22, 0.09, 0.2), tile_m=0.5)
    cushions = [
        shapes.moved(cushion, (x + at, y + 0.12, 0.66), turn_deg=25 * at, axis=(1, 0, 1)) for at in (-0.55, 0.5)
    ]
    return [
        parts.solid("sofa", shapes.merged(frame), textures.plaid(rng, stripes=14), "sofa"),
        parts.solid("cushions", shapes.merged(cushions), textures.checkerboard(6, size=128), "cushion"),
    ]


def _small(rng: np.random.Generator) -> list[Body]:
    """Return a rug, a floor lamp, a plant and a toy box."""
    shade = shapes.moved(shapes.lathe([(0.22, 0.0), (0.13, 0.3)], sides=32, tile_m=0.3), (0.95, 1.85, 1.45))
    stand = shapes.merged([shapes.cylinder(0.14, 0.03), shapes.cylinder(0.014, 1.55, sides=12)])
    pot = [(0.0, 0.0), (0.12, 0.0), (0.17, 0.3), (0.15, 0.3), (0.14, 0.25), (0.0, 0.25)]
    leaf = shapes.moved(shapes.ellipsoid((0.3, 0.05, 0.012), sides=16, rings=8, tile_m=0.2), (0.3, 0, 0))
    steep = [shapes.moved(leaf, (0, 0, 0), turn_deg=-float(angle), axis=(0, 1, 0)) for angle in rng.uniform(30, 80, 14)]
    crown = [shapes.moved(one, (2.25, -0.15, 0.28), turn_deg=26.0 * k) for k, one in enumerate(steep)]
    return [
        parts.solid(
            "rug",
            shapes.standing_box((1.9, 1.3, 0.012), (-0.45, 0.2, 0)),
            textures.plaid(rng, size=512, stripes=24),
            "rug",
        ),
        parts.solid("lamp shade", shade, textures.plaid(rng), "lamp", instance="lamp", emission=0.15),
        parts.solid(
            "lamp stand",
            shapes.moved(stand, (0.95, 1.85, 0)),
            textures.plaster(rng, 0.1, size=64),
            "lamp",
            instance="lamp",
        ),
        parts.vessel("pot", pot, (2.25, -0.15, 0), textures.bricks(rng), tile_m=0.4),
        parts.solid(
            "leaves", shapes.merged(crown), textures.plaster(rng, 0.25, 0.5, size=128), "plant", instance="pot"
        ),
        parts.solid(
            "toy box",
            shapes.moved(shapes.standing_box((0.4, 0.3, 0.3)), (-1.5, 0.2, 0), turn_deg=-30),
            textures.checkerboard(6),
            "box",
        ),
    ]
