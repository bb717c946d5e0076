"""Built-in world ``street``, a small town: blocks of houses, pavements, parked cars, trees and a town hall."""

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.bodies import Body, Mesh
from amiwarp.simulation.worlds.colours import relative_colour
from amiwarp.simulation.worlds.lights import Sky, Sun
from amiwarp.simulation.worlds.named import parts, shapes, textures
from amiwarp.simulation.worlds.named.camera_paths import Viewpoint
from amiwarp.simulation.worlds.named.colours import SKY
from amiwarp.simulation.worlds.named.houses import house, town_hall
from amiwarp.simulation.worlds.world import World

ROAD = 3.6
PAVEMENT = 6.4
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
    bodies = [
        *_ground(rng),
        *_blocks(rng),
        *town_hall(rng, 76.0),
        *_cars(rng),
        *_trees(rng),
        *_posts(rng),
    ]
    sky = Sky(1.0, textures.sky(rng), relative_colour(SKY, "colour of the sky"))
    return World("street", tuple(bodies), ambient=0.38, sun=Sun((-0.8, -0.3, 0.62), 0.7), sky=sky)


def _ground(rng: np.random.Generator) -> list[Body]:
    """Return the road, the pavements of the blocks, and the road markings."""
    road = shapes.panel((-150, -150, 0), (300, 0, 0), (0, 300, 0), tile_m=5.0)
    pavements = []
    for start, end in BLOCKS:
        size = (end - start + 4.0, 56.0, 0.14)
        for side in (-1, 1):
            foot = ((start + end) / 2.0, side * (ROAD + 28.0), 0.0)
            pavements.append(shapes.standing_box(size, foot, tile_m=3.0))

    dashes = [shapes.box((2.0, 0.14, 0.01), (x, 0.0, 0.0)) for x in np.arange(-78.0, 66.0, 4.5)]
    bars = []
    for crossing_x in (-15.0, 17.0, 31.0):
        for y in np.arange(-3.0, 3.1, 1.0):
            bars.append(shapes.box((2.6, 0.45, 0.01), (crossing_x, y, 0.0)))

    asphalt = textures.plaster(rng, 0.2, 0.5)
    paint = textures.weathered(rng, np.full((128, 128), 0.75), 0.3)
    slabs = textures.tiles(rng, mean=0.42, joint=0.15)
    return [
        parts.solid("road", road, asphalt, "road"),
        parts.solid("pavement", shapes.merged(pavements), slabs, "pavement"),
        parts.solid("lane markings", shapes.merged(dashes), paint, "marking"),
        parts.solid("crossings", shapes.merged(bars), paint, "marking"),
    ]


def _blocks(rng: np.random.Generator) -> list[Body]:
    """Return two rows of adjoining houses for each block, on both sides of the street."""
    bodies: list[Body] = []
    count = 0
    for start, end in BLOCKS:
        for side in (-1.0, 1.0):
            for front, depth, range_of_storeys in ROWS:
                x = start
                while x < end - 6.0:
                    name = f"house {count}"
                    width = float(min(rng.uniform(6.5, 11.0), end - x))
                    place = (x + width / 2.0, side * front)
                    storeys = int(rng.integers(*range_of_storeys))
                    bodies += house(rng, name, place, width, depth, storeys)
                    x = x + width + 0.02
                    count += 1
    return bodies


def _cars(rng: np.random.Generator) -> list[Body]:
    """Return cars parked along the kerbs on both sides of the street."""
    bodies: list[Body] = []
    for start, end in BLOCKS:
        for side in (-1.0, 1.0):
            x = start + 4.0
            while x < end - 4.0:
                if rng.uniform() < 0.65:
                    number = len(bodies) // 3  # a car consists of three bodies
                    bodies += _car(rng, f"car {number}", (x, side * (ROAD - 1.05)))
                x += float(rng.uniform(5.6, 7.0))
    return bodies


def _car(rng: np.random.Generator, name: str, place: tuple[float, float]) -> list[Body]:
    """Return a car of body, cabin and wheels at ``place`` (x, y) [m]."""
    chassis = shapes.standing_box((4.2, 1.7, 0.55), (0, 0, 0.28))
    bumpers = shapes.standing_box((4.35, 1.6, 0.2), (0, 0, 0.3))
    is_van = rng.uniform() < 0.2
    if is_van:
        cabin = shapes.tapered(shapes.standing_box((3.4, 1.62, 1.0), (0.35, 0, 0.82)), 0.88)
    else:
        cabin = shapes.tapered(shapes.standing_box((2.3, 1.6, 0.58), (-0.25, 0, 0.82)), 0.68)
    wheels = _wheels()

    shade = float(np.exp(rng.uniform(np.log(0.05), np.log(0.85))))
    paint = textures.weathered(rng, _car_paint(shade), 0.15)
    glass = textures.weathered(rng, _car_glass(shade), 0.2)
    rim = np.repeat([[0.04], [0.04], [0.5], [0.04], [0.04], [0.5]], 16, axis=1)
    surfaces = {
        "": (shapes.merged([chassis, bumpers]), paint),
        " cabin": (cabin, glass),
        " wheels": (wheels, textures.clipped(rim)),
    }
    # Traffic keeps to the right.
    turn = 0.0 if place[1] < 0 else 180.0
    bodies = []
    for part, (mesh, texture) in surfaces.items():
        standing = shapes.moved(mesh, (*place, 0.0), turn_deg=turn)
        bodies.append(parts.solid(name + part, standing, texture, "car", instance=name))
    return bodies


def _wheels() -> Mesh:
    """Return the four wheels of a car."""
    profile = [(0.0, -0.1), (0.18, -0.1), (0.31, -0.08), (0.31, 0.08), (0.18, 0.1), (0.0, 0.1)]
    wheel = shapes.lathe(profile, sides=24)
    wheels = []
    for x in (-1.3, 1.3):
        for y in (-0.75, 0.75):
            wheels.append(shapes.moved(wheel, (x, y, 0.31), turn_deg=90, axis=(1, 0, 0)))
    return shapes.merged(wheels)


def _car_paint(shade: float) -> NDArray[np.float64]:
    """Return the texture of a side of a car: gaps of the doors, sill and lamps."""
    paint = np.full((96, 192), shade)
    gap = 0.3 * shade + 0.02
    paint[:, 60:62] = gap
    paint[:, 120:122] = gap
    paint[70:74] = gap
    lamp = 0.9
    paint[20:34, 4:18] = lamp
    paint[20:34, -18:-4] = lamp
    return paint


def _car_glass(shade: float) -> NDArray[np.float64]:
    """Return the texture of a side of a cabin: two windows with a reflection, between pillars."""
    glass = np.full((64, 128), 0.05)
    glass[:6] = shade
    glass[:, :6] = shade
    glass[:, 60:66] = shade
    glass[:, -6:] = shade
    glass[14:34, 20:40] = 0.35
    return glass


def _trees(rng: np.random.Generator) -> list[Body]:
    """Return trees along the pavements. A crown consists of six ellipsoids."""
    bark = textures.plaster(rng, 0.15, 0.6, size=128)
    leaves = textures.plaster(rng, 0.22, 0.7, size=256)
    places = []
    for start, end in BLOCKS:
        for x in np.arange(start + 5.0, end, 11.0):
            for side in (-1, 1):
                places.append((x + rng.uniform(-1.0, 1.0), side * (ROAD + 0.9), 0.1))

    bodies = []
    for k, place in enumerate(places):
        name = f"tree {k}"
        trunk = shapes.lathe([(0.17, 0.0), (0.12, 0.6), (0.09, 3.0)], sides=12, tile_m=0.6)
        trunk = shapes.moved(trunk, place)
        crown = shapes.moved(_crown(rng), place)
        bodies.append(parts.solid(f"{name} trunk", trunk, bark, "tree", instance=name))
        bodies.append(parts.solid(f"{name} crown", crown, leaves, "tree", instance=name))
    return bodies


def _crown(rng: np.random.Generator) -> Mesh:
    """Return the crown of a tree that stands on the origin."""
    balls = []
    for _ in range(6):
        radii = rng.uniform(0.6, 1.05, 3)
        x, y = rng.uniform(-0.7, 0.7, 2)
        z = rng.uniform(2.7, 4.2)
        ball = shapes.ellipsoid(radii, sides=14, rings=9, tile_m=1.0)
        balls.append(shapes.moved(ball, (x, y, z)))
    return shapes.merged(balls)


def _posts(rng: np.random.Generator) -> list[Body]:
    """Return street lamps, and signs with gratings, stars and checkerboards."""
    iron = textures.plaster(rng, 0.1, 0.4, size=64)
    along = [x for start, end in BLOCKS for x in np.arange(start + 1.0, end, 16.0)]
    bodies = []
    for k, x in enumerate(along):
        side = 1.0 if k % 2 else -1.0
        y = side * (ROAD + 0.5)
        lamp = shapes.moved(_street_lamp(side), (x, y, 0.1))
        bodies.append(parts.solid(f"street lamp {k}", lamp, iron, "street lamp"))

        # A sign stands on the other side of the street.
        name = f"sign {k}"
        plate = shapes.box((0.03, 0.6, 0.6), (x + 4.0, -y, 2.5))
        pole = shapes.cylinder(0.03, 2.3, sides=10, tile_m=0.4)
        pole = shapes.moved(pole, (x + 4.03, -y, 0.1))
        bodies.append(parts.solid(name, plate, _sign(k), "sign", instance=name))
        bodies.append(parts.solid(f"{name} pole", pole, iron, "sign", instance=name))
    return bodies


def _street_lamp(side: float) -> Mesh:
    """Return a street lamp on the origin, on a side of the street: 1 for larger y, -1 for smaller y."""
    profile = [(0.12, 0.0), (0.12, 0.8), (0.06, 0.9), (0.045, 5.2)]
    post = shapes.lathe(profile, sides=16, tile_m=0.5)
    arm = shapes.box((0.06, 1.2, 0.06), (0, -side * 0.6, 5.2), tile_m=0.5)
    head = shapes.ellipsoid((0.16, 0.3, 0.1), sides=16, tile_m=0.5)
    head = shapes.moved(head, (0, -side * 1.2, 5.15))
    return shapes.merged([post, arm, head])


def _sign(k: int) -> textures.Texture:
    """Return the texture of sign ``k``: gratings in several directions, stars and checkerboards in turn."""
    kind = k % 3
    if kind == 0:
        return textures.grating(22.5 * k, 6.0)
    if kind == 1:
        return textures.star(16)
    return textures.checkerboard(4)
