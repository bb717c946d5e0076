"""Built-in world ``desk``: a screen, a keyboard, printed pages, books, pens and a mug, seen from the chair."""

import numpy as np

from amiwarp.simulation.worlds.bodies import Body
from amiwarp.simulation.worlds.lights import Lamp
from amiwarp.simulation.worlds.named import parts, shapes, textures
from amiwarp.simulation.worlds.named.camera_paths import Viewpoint
from amiwarp.simulation.worlds.world import World

VIEW = Viewpoint((0.05, -0.62, 0.52), (0.0, 0.16, 0.1))
"""Camera pose: at the head of a person who sits at the desk. The top of the desk is at z = 0."""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world. No body moves, so ``duration_s`` has no effect."""
    top = shapes.box((1.7, 0.9, 0.03), (0.0, 0.12, -0.015), tile_m=0.6)
    wall = shapes.panel((-2.0, 0.75, -0.8), (4.0, 0.0, 0.0), (0.0, 0.0, 2.6), tile_m=1.2)
    floor = shapes.panel((-2.0, -1.5, -0.76), (4.0, 0, 0), (0, 2.3, 0), tile_m=1.5)
    bodies = [
        parts.solid("desk", top, textures.wood(rng, mean=0.4, boards=8, size=768), "desk"),
        parts.solid("wall", wall, textures.plaster(rng, 0.5, 0.4), "wall"),
        parts.solid("floor", floor, textures.tiles(rng), "floor"),
        *_screen(rng),
        *_keyboard(rng),
        *_papers(rng),
        *_books(rng),
        *_other_things(rng),
        *_gauges(),
    ]
    lamps = (Lamp((-0.6, 0.1, 0.75), 0.45, shadows=True), Lamp((1.0, -1.2, 1.4), 0.9))
    return World("desk", tuple(bodies), ambient=0.3, lamps=lamps)


def _screen(rng: np.random.Generator) -> list[Body]:
    """Return a screen on a stand, which shows a page of text."""
    case = shapes.box((0.56, 0.03, 0.34), (0.0, 0.5, 0.31), tile_m=0.3)
    stand = shapes.standing_box((0.05, 0.03, 0.16), (0.0, 0.52, 0.0), tile_m=0.3)
    disc = shapes.cylinder(0.1, 0.012, sides=32, tile_m=0.3)
    foot = shapes.moved(disc, (0.0, 0.5, 0.0))
    frame = shapes.merged([case, stand, foot])
    picture = shapes.panel((-0.265, 0.484, 0.155), (0.53, 0, 0), (0, 0, 0.31))

    page = textures.text_page(rng, width=768, height=448, letter=20)
    plastic = textures.plaster(rng, 0.08, 0.4, size=256)
    return [
        parts.solid("screen frame", frame, plastic, "screen", instance="screen"),
        parts.solid("screen", picture, page, "screen"),
    ]


def _keyboard(rng: np.random.Generator) -> list[Body]:
    """Return a keyboard with separate keys."""
    place = (-0.06, -0.02, 0.0)
    base = shapes.standing_box((0.44, 0.13, 0.016), tile_m=0.2)
    base = shapes.moved(base, place)

    key_widths = [0.022, 0.022, 0.022, 0.034]
    keys = []
    for row in range(5):
        y = 0.022 * row - 0.045
        left = -0.2
        while left < 0.19:
            is_space_bar = row == 0 and -0.1 < left < 0.0
            width = 0.12 if is_space_bar else float(rng.choice(key_widths))
            foot = (left + width / 2.0, y, 0.016)
            keys.append(shapes.standing_box((width - 0.004, 0.018, 0.008), foot))
            left += width
    all_keys = shapes.moved(shapes.merged(keys), place)

    # Each key bears a letter F.
    letter = np.full((32, 32), 0.12)
    letter[8:24, 12:15] = 0.85
    letter[8:11, 12:22] = 0.85
    letter[15:18, 12:20] = 0.85

    plastic = textures.plaster(rng, 0.5, 0.3, size=256)
    return [
        parts.solid("keyboard", base, plastic, "keyboard"),
        parts.solid("keys", all_keys, textures.clipped(letter), "keyboard", instance="keyboard"),
    ]


def _papers(rng: np.random.Generator) -> list[Body]:
    """Return three printed pages on the desk."""
    # x and y [m], and rotation [deg]
    places = ((0.36, -0.06, -12.0), (0.44, 0.1, 18.0), (-0.43, -0.08, 8.0))
    bodies = []
    for k, (x, y, turn) in enumerate(places):
        corner = (-0.105, -0.148, 0.001 + 0.001 * k)
        sheet = shapes.panel(corner, (0.21, 0, 0), (0, 0.297, 0))
        sheet = shapes.moved(sheet, (x, y, 0), turn_deg=turn)
        page = textures.text_page(rng, width=512, height=724, letter=18)
        bodies.append(parts.solid(f"page {k + 1}", sheet, page, "page"))
    return bodies


def _books(rng: np.random.Generator) -> list[Body]:
    """Return a stack of books and a row of upright books."""
    bodies = []
    z = 0.0
    for k in range(4):
        thickness = float(rng.uniform(0.018, 0.04))
        turn = float(rng.uniform(-15, 15))
        book = shapes.standing_box((0.2, 0.15, thickness))
        book = shapes.moved(book, (-0.52, 0.22, z), turn_deg=turn)
        cover = textures.poster(rng, size=192)
        bodies.append(parts.solid(f"book {k + 1}", book, cover, "book"))
        z += thickness

    upright = []
    for k in range(9):
        height = float(rng.uniform(0.2, 0.26))
        upright.append(shapes.standing_box((0.03, 0.16, height), (0.42 + 0.033 * k, 0.48, 0)))
    spines = textures.book_spines(rng, books=4, size=256)
    bodies.append(parts.solid("row of books", shapes.merged(upright), spines, "book"))
    return bodies


def _other_things(rng: np.random.Generator) -> list[Body]:
    """Return a mug with pens, a bowl, a ball and a lamp."""
    mug = [
        (0.0, 0.0),
        (0.035, 0.0),
        (0.041, 0.02),
        (0.041, 0.1),
        (0.036, 0.1),
        (0.035, 0.02),
        (0.0, 0.015),
    ]
    bowl = [(0.0, 0.0), (0.04, 0.0), (0.085, 0.05), (0.08, 0.05), (0.035, 0.01), (0.0, 0.008)]
    pen = shapes.cylinder(0.004, 0.16, sides=12, tile_m=0.03)
    pens = []
    for k in range(4):
        place = (0.24 + 0.012 * k, 0.3, 0.02)
        pens.append(shapes.moved(pen, place, turn_deg=9.0 * (k - 1.5), axis=(0.5, 1, 0)))

    thick_pen = shapes.cylinder(0.0045, 0.14, sides=12, tile_m=0.03)
    lying = []
    for y in (-0.13, -0.1):
        lying.append(shapes.moved(thick_pen, (0.2, y, 0.005), turn_deg=90, axis=(0.3, 1, 0)))

    ball = shapes.ellipsoid((0.035, 0.035, 0.035), sides=28, rings=16)
    ball = shapes.moved(ball, (0.26, 0.13, 0.035))

    foot = shapes.cylinder(0.07, 0.015, sides=32, tile_m=0.2)
    foot = shapes.moved(foot, (-0.72, 0.38, 0))
    rod = shapes.cylinder(0.009, 0.4, sides=16, tile_m=0.1)
    rod = shapes.moved(rod, (-0.72, 0.38, 0))
    shade = shapes.lathe([(0.09, 0.0), (0.07, 0.08), (0.03, 0.12)], sides=32, tile_m=0.15)
    shade = shapes.moved(shade, (-0.69, 0.36, 0.4), turn_deg=-20, axis=(1, 1, 0))
    lamp = shapes.merged([foot, rod, shade])
    return [
        parts.vessel("mug", mug, (0.26, 0.3, 0.0), textures.plaid(rng), tile_m=0.12),
        parts.solid("pens", shapes.merged(pens), textures.checkerboard(4, size=64), "pen"),
        parts.solid("lying pens", shapes.merged(lying), textures.checkerboard(2, size=64), "pen"),
        parts.vessel("bowl", bowl, (-0.27, 0.25, 0.0), textures.bricks(rng, size=256), tile_m=0.15),
        parts.solid("ball", ball, textures.checkerboard(12), "ball"),
        parts.solid("desk lamp", lamp, textures.plaster(rng, 0.2, 0.6, size=256), "lamp"),
    ]


def _gauges() -> list[Body]:
    """Return gratings, a Siemens star, a checkerboard card, a cube and a ruler."""
    right = (1.0, 0, 0)
    gratings = parts.grating_strip(
        "grating", (-0.62, 0.74, 0.012), right, count=8, side=0.12, cycles=6.0
    )

    cube = shapes.standing_box((0.07, 0.07, 0.07))
    cube = shapes.moved(cube, (-0.36, 0.33, 0.0), turn_deg=30)
    ruler = shapes.standing_box((0.3, 0.025, 0.003), tile_m=0.025)
    ruler = shapes.moved(ruler, (0.02, -0.15, 0.0), turn_deg=4)
    card = shapes.panel((-0.06, -0.06, 0.003), (0.12, 0, 0), (0, 0.12, 0))
    card = shapes.moved(card, (-0.2, -0.18, 0), turn_deg=-20)

    # A piece of the ruler: lines at equal distances, and a longer one at its beginning
    ticks = np.full((64, 64), 0.75)
    ticks[:36, ::8] = 0.05
    ticks[:50, :2] = 0.05
    return [
        *gratings,
        *parts.picture("star", (0.55, 0.75, 0.42), right, textures.star(), 0.28, 0.28),
        parts.solid("cube", cube, textures.checkerboard(4, size=128), "cube"),
        parts.solid("ruler", ruler, textures.clipped(ticks), "ruler"),
        parts.solid("card", card, textures.checkerboard(8), "card"),
    ]
