"""Built-in world ``street``, a small town: blocks of houses, pavements, parked cars, trees and a town hall."""

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.named import bodies as parts
from amiwarp.simulation.worlds.named.bodies import Viewpoint
from amiwarp.simulation.worlds.world import Body, Mesh, Sky, Sun, World

# Buildings of the world ``street``: houses with windows, sills, cornices and roofs, and a town hall with a tower.

STOREY = 3.1
"""Height of a storey [m]."""
TEXELS = 24
"""Resolution of the texture of a façade [texels/m]."""
WINDOW = (1.1, 1.6)
"""Width and height of a window [m]."""
SPACING = 2.1
"""Smallest distance between the centres of two windows of a storey [m]."""


def house(
    rng: np.random.Generator, name: str, place: tuple[float, float], width: float, depth: float, storeys: int
) -> list[Body]:
    """Return a house whose front faces the street, which lies along y = 0.

    ``place``: middle of the front (x, y) [m]; ``width``, ``depth``: size of the house along x and y [m].
    """
    away = 1.0 if place[1] > 0 else -1.0
    height = STOREY * storeys + 0.4
    middle = (place[0], place[1] + away * depth / 2.0, 0.1)
    walls = parts.standing_box((width, depth, height), middle)
    roof_foot = (middle[0], middle[1], 0.1 + height)
    if rng.uniform() < 0.6:
        roof = parts.gable_roof((width, depth + 0.8, float(rng.uniform(2.0, 3.6))), roof_foot, tile_m=3.0)
    else:
        roof = parts.standing_box((width, depth, 0.5), roof_foot, tile_m=3.0)
    chimney = parts.standing_box(
        (0.6, 0.6, 4.4), (middle[0] + width * float(rng.uniform(-0.3, 0.3)), middle[1], 0.1 + height), tile_m=2.0
    )
    trim = parts.merged(_trim(place[0], place[1], away, width, storeys))
    surfaces = {
        "": (walls, front(rng, width, storeys)),
        " roof": (
            parts.merged([roof, chimney]),
            parts.bricks(rng, mean=float(rng.uniform(0.12, 0.3)), joint=0.06, size=256),
        ),
        " trim": (trim, parts.plaster(rng, 0.6, 0.3, size=128)),
    }
    return [parts.solid(name + part, mesh, skin, "house", instance=name) for part, (mesh, skin) in surfaces.items()]


def window_columns(width: float) -> NDArray[np.float64]:
    """Return the distances of the window centres from the left end of a façade [m]."""
    count = max(2, int(width / SPACING))
    return (np.arange(count) + 0.5) * width / count


def _trim(x: float, y: float, away: float, width: float, storeys: int) -> list[Mesh]:
    """Return the window sills, lintels, cornices and the doorstep of a house.

    ``x``, ``y``: middle of the front [m]; ``away``: 1 if the house lies at larger y than its front, else -1.
    """
    meshes = []
    for storey in range(storeys):
        base = 0.1 + STOREY * storey
        for at in window_columns(width):
            centre = x - width / 2.0 + at
            if storey:
                meshes.append(parts.box((WINDOW[0] + 0.3, 0.3, 0.1), (centre, y, base + 0.85), tile_m=0.8))
            meshes.append(
                parts.box((WINDOW[0] + 0.3, 0.2, 0.18), (centre, y, base + 0.95 + WINDOW[1] + 0.05), tile_m=0.8)
            )
        meshes.append(parts.box((width, 0.24, 0.14), (x, y, base + STOREY - 0.05), tile_m=0.8))
    meshes.append(parts.box((width, 0.6, 0.25), (x, y, 0.1 + STOREY * storeys + 0.3), tile_m=0.8))
    meshes.append(
        parts.standing_box(
            (1.6, 0.7, 0.18), (x - width / 2.0 + window_columns(width)[0], y - away * 0.3, 0.1), tile_m=0.8
        )
    )
    return meshes


def front(rng: np.random.Generator, width: float, storeys: int) -> parts.Texture:
    """Return the texture of a façade: windows in each storey, and a door at the left of the ground floor.

    ``width``: width of the façade [m].
    """
    rows, columns = round((STOREY * storeys + 0.4) * TEXELS), round(width * TEXELS)
    wall = float(rng.uniform(0.2, 0.7))
    if rng.uniform() < 0.5:
        masonry = parts.bricks(rng, mean=wall, joint=min(0.9, 1.6 * wall), size=256)
        values = np.tile(masonry, (rows // 256 + 1, columns // 256 + 1))[:rows, :columns].astype(np.float64)
    else:
        values = wall * np.exp(0.3 * parts.fractal(rng, rows, columns))
    for storey in range(storeys):
        foot = rows - round(STOREY * storey * TEXELS)
        for k, at in enumerate(window_columns(width)):
            left = round((at - WINDOW[0] / 2.0) * TEXELS)
            if storey == 0 and k == 0:
                _door(rng, values, foot, left)
            else:
                _window(rng, values, foot - round(0.9 * TEXELS), left)
    values[rows - round(0.5 * TEXELS) :] *= 0.45
    return parts.weathered(rng, values, 0.12)


def _window(rng: np.random.Generator, values: NDArray[np.float64], foot: int, left: int) -> None:
    """Draw a window into the texture ``values``: frame, panes with a reflection, and sometimes curtains or a lit room.

    ``foot``, ``left``: row of the lower edge and column of the left edge [texels].
    """
    wide, high = round(WINDOW[0] * TEXELS), round(WINDOW[1] * TEXELS)
    pane = values[foot - high : foot, left : left + wide]
    glass = float(rng.choice([0.04, 0.06, 0.1, 0.55], p=[0.35, 0.3, 0.2, 0.15]))
    pane[:] = glass
    gleam = (np.arange(high)[:, None] + np.arange(wide)) % high < high // 4
    pane[gleam] = min(0.9, 3.0 * glass)
    if rng.uniform() < 0.4:
        curtain = wide // 4
        pane[:, :curtain] = pane[:, -curtain:] = 0.5 + 0.2 * (np.arange(curtain) % 4 < 2)
    pane[:2] = pane[-2:] = 0.85
    pane[:, :2] = pane[:, -2:] = pane[:, wide // 2 - 1 : wide // 2 + 1] = 0.85
    pane[high // 3 : high // 3 + 2] = 0.85


def _door(rng: np.random.Generator, values: NDArray[np.float64], foot: int, left: int) -> None:
    """Draw a door with four panels into the texture ``values``.

    ``foot``, ``left``: row of the lower edge and column of the left edge [texels].
    """
    wide, high = round(WINDOW[0] * TEXELS), round(2.4 * TEXELS)
    leaf = values[foot - high : foot, left : left + wide]
    shade = float(rng.uniform(0.05, 0.5))
    leaf[:] = shade
    for top in (0.1, 0.55):
        panel = leaf[round(top * high) : round((top + 0.35) * high)]
        panel[:, 4 : wide // 2 - 2] = panel[:, wide // 2 + 2 : -4] = 0.4 * shade
    leaf[:2] = leaf[:, :2] = leaf[:, -2:] = 0.8


def town_hall(rng: np.random.Generator, x: float) -> list[Body]:
    """Return a town hall with tower, clock and spire, which stands across the end of the street at ``x`` [m]."""
    wide, high = 26.0, 13.0
    hall = parts.standing_box((12.0, wide, high), (x + 6.0, 0.0, 0.0))
    tower = parts.standing_box((5.0, 5.0, 24.0), (x, 0.0, 0.0))
    spire = parts.moved(parts.lathe([(3.9, 0.0), (0.4, 7.0), (0.0, 11.0)], sides=16, tile_m=2.0), (x, 0.0, 24.0))
    shafts = [
        parts.moved(parts.cylinder(0.45, 9.0, sides=20, tile_m=1.5), (x - 1.2, y, 0.0))
        for y in np.linspace(-12, 12, 9)
        if abs(y) > 2.0
    ]
    clock = parts.panel((x - 2.52, 1.6, 18.0), (0.0, -3.2, 0.0), (0.0, 0.0, 3.2))
    roof = parts.moved(parts.gable_roof((wide, 13.0, 5.0), tile_m=3.0), (x + 6.0, 0.0, high), turn_deg=90.0)
    surfaces = {
        "": (hall, front(rng, wide, 4)),
        " tower": (tower, front(rng, 6.0, 7)),
        " spire": (spire, parts.bricks(rng, mean=0.15, joint=0.05, size=256)),
        " columns": (parts.merged(shafts), parts.plaster(rng, 0.6, 0.35, size=256)),
        " clock": (clock, parts.star(12)),
        " roof": (roof, parts.bricks(rng, mean=0.2, joint=0.06, size=256)),
    }
    return [
        parts.solid(f"town hall{part}", mesh, skin, "house", instance="town hall")
        for part, (mesh, skin) in surfaces.items()
    ]


ROAD, PAVEMENT = 3.6, 6.4
"""Distances of the kerb and of the house fronts from the middle of the street [m]."""
BLOCKS = ((-62.0, -26.0), (-18.0, 20.0), (28.0, 62.0))
"""Ranges of x that the blocks of houses occupy along the street [m]. Side streets lie between the blocks."""
ROWS = ((PAVEMENT, 10.0, (2, 5)), (30.0, 12.0, (4, 8)))
"""Rows of houses on each side of the street.

Each row gives the distance of the fronts from the middle of the street [m], the depth of the houses [m], and the range
of the number of storeys, upper end excluded.
"""
VIEW = Viewpoint((-15.0, 0.5, 1.7), (10.0, -0.2, 3.1), walk_m=(8.0, 0.0, 0.0), walk_speed=1.4)
"""Camera pose: on the road. The camera walks along the road."""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world. No body moves, so ``duration_s`` has no effect."""
    bodies = [*_ground(rng), *_blocks(rng), *town_hall(rng, 76.0), *_cars(rng), *_trees(rng), *_posts(rng)]
    sky = Sky(1.0, parts.sky(rng))
    return World("street", tuple(bodies), ambient=0.38, sun=Sun((-0.8, -0.3, 0.62), 0.7), sky=sky)


def _ground(rng: np.random.Generator) -> list[Body]:
    """Return the road, the pavements of the blocks, and the road markings."""
    asphalt = parts.plaster(rng, 0.2, 0.5)
    slabs = [
        parts.standing_box(
            (end - start + 4.0, 56.0, 0.14), ((start + end) / 2.0, side * (ROAD + 28.0), 0.0), tile_m=3.0
        )
        for start, end in BLOCKS
        for side in (-1, 1)
    ]
    dashes = [parts.box((2.0, 0.14, 0.01), (x, 0.0, 0.0)) for x in np.arange(-78.0, 66.0, 4.5)]
    bars = [parts.box((2.6, 0.45, 0.01), (x, y, 0.0)) for x in (-15.0, 17.0, 31.0) for y in np.arange(-3.0, 3.1, 1.0)]
    paint = parts.weathered(rng, np.full((128, 128), 0.75), 0.3)
    return [
        parts.solid("road", parts.panel((-150, -150, 0), (300, 0, 0), (0, 300, 0), tile_m=5.0), asphalt, "road"),
        parts.solid("pavement", parts.merged(slabs), parts.tiles(rng, mean=0.42, joint=0.15), "pavement"),
        parts.solid("lane markings", parts.merged(dashes), paint, "marking"),
        parts.solid("crossings", parts.merged(bars), paint, "marking"),
    ]


def _blocks(rng: np.random.Generator) -> list[Body]:
    """Return two rows of adjoining houses for each block, on both sides of the street."""
    bodies: list[Body] = []
    count = 0
    for start, end in BLOCKS:
        for side in (-1.0, 1.0):
            for front, depth, storeys in ROWS:
                x = start
                while x < end - 6.0:
                    width = float(min(rng.uniform(6.5, 11.0), end - x))
                    place = (x + width / 2.0, side * front)
                    bodies += house(rng, f"house {count}", place, width, depth, int(rng.integers(*storeys)))
                    x, count = x + width + 0.02, count + 1
    return bodies


def _cars(rng: np.random.Generator) -> list[Body]:
    """Return cars parked along the kerbs on both sides of the street."""
    bodies: list[Body] = []
    for start, end in BLOCKS:
        for side in (-1.0, 1.0):
            x = start + 4.0
            while x < end - 4.0:
                if rng.uniform() < 0.65:
                    bodies += _car(rng, f"car {len(bodies) // 3}", (x, side * (ROAD - 1.05)))
                x += float(rng.uniform(5.6, 7.0))
    return bodies


def _car(rng: np.random.Generator, name: str, place: tuple[float, float]) -> list[Body]:
    """Return a car of body, cabin and wheels at ``place`` (x, y) [m]."""
    at = (*place, 0.0)
    van = rng.uniform() < 0.2
    cabin = (3.4, 1.62, 1.0) if van else (2.3, 1.6, 0.58)
    shade = float(np.exp(rng.uniform(np.log(0.05), np.log(0.85))))
    paint = np.full((96, 192), shade)
    paint[:, 60:62] = paint[:, 120:122] = paint[70:74] = 0.3 * shade + 0.02
    paint[20:34, 4:18] = paint[20:34, -18:-4] = 0.9
    glass = np.full((64, 128), 0.05)
    glass[:, :6] = glass[:, 60:66] = glass[:, -6:] = glass[:6] = shade
    glass[14:34, 20:40] = 0.35
    wheel = parts.lathe([(0.0, -0.1), (0.18, -0.1), (0.31, -0.08), (0.31, 0.08), (0.18, 0.1), (0.0, 0.1)], sides=24)
    wheels = [parts.moved(wheel, (x, y, 0.31), turn_deg=90, axis=(1, 0, 0)) for x in (-1.3, 1.3) for y in (-0.75, 0.75)]
    rim = parts.clipped(np.repeat([[0.04], [0.04], [0.5], [0.04], [0.04], [0.5]], 16, axis=1))
    body = parts.merged(
        [parts.standing_box((4.2, 1.7, 0.55), (0, 0, 0.28)), parts.standing_box((4.35, 1.6, 0.2), (0, 0, 0.3))]
    )
    top = parts.tapered(parts.standing_box(cabin, (0.35 if van else -0.25, 0, 0.82)), 0.88 if van else 0.68)
    meshes = {
        "": (body, parts.weathered(rng, paint, 0.15)),
        " cabin": (top, parts.weathered(rng, glass, 0.2)),
        " wheels": (parts.merged(wheels), rim),
    }
    turn = 0.0 if place[1] < 0 else 180.0
    return [
        parts.solid(name + part, parts.moved(mesh, at, turn_deg=turn), texture, "car", instance=name)
        for part, (mesh, texture) in meshes.items()
    ]


def _trees(rng: np.random.Generator) -> list[Body]:
    """Return trees along the pavements. A crown consists of six ellipsoids."""
    bark, leaves = parts.plaster(rng, 0.15, 0.6, size=128), parts.plaster(rng, 0.22, 0.7, size=256)
    bodies = []
    spots = [
        (x + rng.uniform(-1.0, 1.0), side * (ROAD + 0.9))
        for start, end in BLOCKS
        for x in np.arange(start + 5.0, end, 11.0)
        for side in (-1, 1)
    ]
    for k, (x, y) in enumerate(spots):
        trunk = parts.lathe([(0.17, 0.0), (0.12, 0.6), (0.09, 3.0)], sides=12, tile_m=0.6)
        balls = [
            parts.moved(
                parts.ellipsoid(rng.uniform(0.6, 1.05, 3), sides=14, rings=9, tile_m=1.0),
                (*rng.uniform(-0.7, 0.7, 2), rng.uniform(2.7, 4.2)),
            )
            for _ in range(6)
        ]
        name = f"tree {k}"
        bodies.append(parts.solid(f"{name} trunk", parts.moved(trunk, (x, y, 0.1)), bark, "tree", instance=name))
        bodies.append(
            parts.solid(f"{name} crown", parts.moved(parts.merged(balls), (x, y, 0.1)), leaves, "tree", instance=name)
        )
    return bodies


def _posts(rng: np.random.Generator) -> list[Body]:
    """Return street lamps, and signs with gratings, stars and checkerboards."""
    iron = parts.plaster(rng, 0.1, 0.4, size=64)
    bodies = []
    xs = [x for start, end in BLOCKS for x in np.arange(start + 1.0, end, 16.0)]
    for k, x in enumerate(xs):
        side = 1.0 if k % 2 else -1.0
        y = side * (ROAD + 0.5)
        head = parts.ellipsoid((0.16, 0.3, 0.1), sides=16, tile_m=0.5)
        post = [
            parts.lathe([(0.12, 0.0), (0.12, 0.8), (0.06, 0.9), (0.045, 5.2)], sides=16, tile_m=0.5),
            parts.box((0.06, 1.2, 0.06), (0, -side * 0.6, 5.2), tile_m=0.5),
            parts.moved(head, (0, -side * 1.2, 5.15)),
        ]
        bodies.append(
            parts.solid(f"street lamp {k}", parts.moved(parts.merged(post), (x, y, 0.1)), iron, "street lamp")
        )
        face = (parts.grating(22.5 * k, 6.0), parts.star(16), parts.checkerboard(4))[k % 3]
        plate = parts.box((0.03, 0.6, 0.6), (x + 4.0, -y, 2.5))
        pole = parts.moved(parts.cylinder(0.03, 2.3, sides=10, tile_m=0.4), (x + 4.03, -y, 0.1))
        bodies.append(parts.solid(f"sign {k}", plate, face, "sign", instance=f"sign {k}"))
        bodies.append(parts.solid(f"sign {k} pole", pole, iron, "sign", instance=f"sign {k}"))
    return bodies
