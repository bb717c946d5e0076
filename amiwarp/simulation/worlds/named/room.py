"""Built-in world ``room``: gratings in all directions, pictures, printed pages, a table, shelves and a sofa."""

import numpy as np

from amiwarp.simulation.worlds.bodies import Body, Mesh
from amiwarp.simulation.worlds.lights import Lamp
from amiwarp.simulation.worlds.named import parts, shapes, textures
from amiwarp.simulation.worlds.named.camera_paths import Viewpoint
from amiwarp.simulation.worlds.world import World

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
    bodies = parts.hall(
        SIZE,
        walls,
        textures.wood(rng, mean=0.28),
        textures.tiles(rng, mean=0.7, joint=0.3, count=4),
    )
    return [
        *bodies,
        *_gratings_and_pictures(rng),
        *_shelves(rng),
        *_table(rng),
        *_sofa(rng),
        *_other_things(rng),
    ]


def _gratings_and_pictures(rng: np.random.Generator) -> list[Body]:
    """Return gratings and pictures on two walls."""
    north = (1.0, 0.0, 0.0)
    east = (0.0, -1.0, 0.0)
    x = SIZE[0] / 2.0
    y = SIZE[1] / 2.0
    return [
        *parts.grating_strip("grating", (-1.95, y, 2.12), north, count=8, side=0.34, cycles=7.0),
        *parts.picture("poster", (-1.55, y, 1.5), north, textures.poster(rng), 0.8, 0.8),
        *parts.picture("page", (-0.55, y, 1.5), north, textures.text_page(rng), 0.7, 0.95),
        *parts.picture("star", (0.45, y, 1.55), north, textures.star(), 0.75, 0.75),
        *parts.picture("checkerboard", (x, -0.55, 1.55), east, textures.checkerboard(8), 0.8, 0.8),
        *parts.picture(
            "second page", (x, -1.5, 1.6), east, textures.text_page(rng, letter=26), 0.6, 0.8
        ),
    ]


def _shelves(rng: np.random.Generator) -> list[Body]:
    """Return a bookcase with books against the eastern wall."""
    depth = 0.32
    width = 1.3
    height = 2.1
    x = SIZE[0] / 2.0 - depth / 2.0 - 0.03
    y = 0.95

    boards = []
    for side in (-1, 1):
        end = (x, y + side * width / 2.0, 0)
        boards.append(shapes.standing_box((depth, 0.03, height), end, tile_m=0.8))
    levels = np.linspace(0.06, height - 0.03, 6)
    for z in levels:
        boards.append(shapes.standing_box((depth, width, 0.03), (x, y, z), tile_m=0.8))
    back = (x + depth / 2.0, y, 0)
    boards.append(shapes.standing_box((0.02, width, height), back, tile_m=0.8))
    wood = textures.wood(rng, mean=0.4, boards=4)
    bodies = [parts.solid("bookcase", shapes.merged(boards), wood, "bookcase")]

    for k, z in enumerate(levels[:-1]):
        books = _shelf_books(rng, (x, y, z + 0.03), width)
        spines = textures.poster(rng)
        bodies.append(parts.solid(f"books {k + 1}", books, spines, "book"))
    return bodies


def _shelf_books(
    rng: np.random.Generator, middle: tuple[float, float, float], width: float
) -> Mesh:
    """Return a row of books along y. Each book shows a different part of the texture.

    ``middle``: middle of the row on the shelf [m]; ``width``: length of the row [m].
    """
    x, y, z = middle
    books = []
    left = -width / 2.0 + 0.03
    while left < width / 2.0 - 0.1:
        thickness = rng.uniform(0.02, 0.06)
        height = rng.uniform(0.2, 0.33)
        depth = rng.uniform(0.18, 0.24)
        foot = (x, y + left + thickness / 2.0, z)
        book = shapes.standing_box((depth, thickness, height), foot, tile_m=0.4)
        part_of_texture = rng.uniform(0.0, 1.0, 2)
        books.append(Mesh(book.vertices, book.faces, np.asarray(book.uv) + part_of_texture))
        gap = 0.002 if rng.uniform() < 0.9 else 0.08
        left += thickness + gap
    return shapes.merged(books)


def _table(rng: np.random.Generator) -> list[Body]:
    """Return a table with vessels, books and a globe, and two chairs."""
    x = 1.15
    y = 0.35
    z = 0.74
    cup = [
        (0.0, 0.0),
        (0.03, 0.0),
        (0.042, 0.03),
        (0.04, 0.09),
        (0.036, 0.09),
        (0.03, 0.02),
        (0.0, 0.015),
    ]
    vase = [
        (0.0, 0.0),
        (0.06, 0.0),
        (0.11, 0.12),
        (0.05, 0.26),
        (0.07, 0.33),
        (0.06, 0.33),
        (0.03, 0.25),
    ]
    book = shapes.standing_box((0.24, 0.17, 0.035), tile_m=0.3)
    stack = []
    for k in range(4):
        place = (x + 0.02, y + 0.15, z + 0.035 * k)
        turn = float(rng.uniform(-20, 20))
        stack.append(shapes.moved(book, place, turn_deg=turn))

    globe = shapes.ellipsoid((0.14, 0.14, 0.14), sides=32, rings=20)
    globe = shapes.moved(globe, (x + 0.35, y - 0.05, z + 0.19))
    globe_foot = shapes.cylinder(0.08, 0.05, tile_m=0.2)
    globe_foot = shapes.moved(globe_foot, (x + 0.35, y - 0.05, z))

    chequered = textures.checkerboard(8, size=128)
    table_wood = textures.wood(rng, mean=0.45, boards=6)
    plaid = textures.plaid(rng)
    poster = textures.poster(rng)
    map_of_globe = textures.weathered(rng, textures.checkerboard(16), 0.3)
    foot_wood = textures.wood(rng, size=128)
    dark_wood = textures.wood(rng, mean=0.2, boards=4, size=256)
    light_wood = textures.wood(rng, mean=0.55, boards=4, size=256)
    return [
        parts.table("table", (1.3, 0.8, z), (x, y, 0), table_wood, turn_deg=-8.0),
        parts.vessel("vase", vase, (x - 0.42, y + 0.2, z), chequered),
        parts.vessel("cup", cup, (x - 0.2, y - 0.2, z), plaid, tile_m=0.1),
        parts.solid("stack", shapes.merged(stack), poster, "book"),
        parts.solid("globe", globe, map_of_globe, "globe"),
        parts.solid("globe foot", globe_foot, foot_wood, "globe", instance="globe"),
        parts.chair("chair", (x - 0.75, y - 0.1, 0), dark_wood, turn_deg=10.0),
        parts.chair("second chair", (x + 0.1, y - 0.75, 0), light_wood, turn_deg=80.0),
    ]


def _sofa(rng: np.random.Generator) -> list[Body]:
    """Return a sofa with cushions against the northern wall."""
    x = -0.35
    y = SIZE[1] / 2.0 - 0.45
    base = shapes.standing_box((1.7, 0.8, 0.25), (x, y, 0.1), tile_m=0.5)
    back = shapes.standing_box((1.7, 0.2, 0.5), (x, y + 0.32, 0.3), tile_m=0.5)
    arms = []
    seats = []
    for side in (-1, 1):
        arm_foot = (x + side * 0.86, y, 0.1)
        arms.append(shapes.standing_box((0.18, 0.8, 0.5), arm_foot, tile_m=0.5))
        seat_foot = (x + side * 0.38, y - 0.08, 0.35)
        seats.append(shapes.standing_box((0.74, 0.6, 0.12), seat_foot, tile_m=0.5))
    sofa = shapes.merged([base, back, *arms, *seats])

    cushion = shapes.ellipsoid((0.22, 0.09, 0.2), tile_m=0.5)
    cushions = []
    for aside in (-0.55, 0.5):
        place = (x + aside, y + 0.12, 0.66)
        cushions.append(shapes.moved(cushion, place, turn_deg=25 * aside, axis=(1, 0, 1)))
    chequered = textures.checkerboard(6, size=128)
    return [
        parts.solid("sofa", sofa, textures.plaid(rng, stripes=14), "sofa"),
        parts.solid("cushions", shapes.merged(cushions), chequered, "cushion"),
    ]


def _other_things(rng: np.random.Generator) -> list[Body]:
    """Return a rug, a floor lamp, a plant and a toy box."""
    rug = shapes.standing_box((1.9, 1.3, 0.012), (-0.45, 0.2, 0))
    shade = shapes.lathe([(0.22, 0.0), (0.13, 0.3)], sides=32, tile_m=0.3)
    shade = shapes.moved(shade, (0.95, 1.85, 1.45))
    stand = shapes.merged([shapes.cylinder(0.14, 0.03), shapes.cylinder(0.014, 1.55, sides=12)])
    stand = shapes.moved(stand, (0.95, 1.85, 0))
    box = shapes.standing_box((0.4, 0.3, 0.3))
    box = shapes.moved(box, (-1.5, 0.2, 0), turn_deg=-30)

    # A plant: leaves that all begin in one point of the pot, at random angles to the floor
    pot = [(0.0, 0.0), (0.12, 0.0), (0.17, 0.3), (0.15, 0.3), (0.14, 0.25), (0.0, 0.25)]
    leaf = shapes.ellipsoid((0.3, 0.05, 0.012), sides=16, rings=8, tile_m=0.2)
    leaf = shapes.moved(leaf, (0.3, 0, 0))
    leaves = []
    for k, angle in enumerate(rng.uniform(30, 80, 14)):
        rising = shapes.moved(leaf, (0, 0, 0), turn_deg=-float(angle), axis=(0, 1, 0))
        leaves.append(shapes.moved(rising, (2.25, -0.15, 0.28), turn_deg=26.0 * k))
    crown = shapes.merged(leaves)

    rug_cloth = textures.plaid(rng, size=512, stripes=24)
    shade_cloth = textures.plaid(rng)
    black = textures.plaster(rng, 0.1, size=64)
    clay = textures.bricks(rng)
    green = textures.plaster(rng, 0.25, 0.5, size=128)
    return [
        parts.solid("rug", rug, rug_cloth, "rug"),
        parts.solid("lamp shade", shade, shade_cloth, "lamp", instance="lamp", emission=0.15),
        parts.solid("lamp stand", stand, black, "lamp", instance="lamp"),
        parts.vessel("pot", pot, (2.25, -0.15, 0), clay, tile_m=0.4),
        parts.solid("leaves", crown, green, "plant", instance="pot"),
        parts.solid("toy box", box, textures.checkerboard(6), "box"),
    ]
