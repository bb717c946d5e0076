"""Buildings of the world ``street``: houses with windows, sills, cornices and roofs, and a town hall with a tower."""

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.bodies import Body, Mesh
from amiwarp.simulation.worlds.named import parts, shapes, textures

STOREY = 3.1
"""Height of a storey [m]."""
TEXELS = 24
"""Resolution of the texture of a façade [texels/m]."""
PAVEMENT_Z = 0.1
"""Height on which the houses stand [m]."""
WINDOW = (1.1, 1.6)
"""Width and height of a window [m]."""
SPACING = 2.1
"""Smallest distance between the centres of two windows of a storey [m]."""


def house(
    rng: np.random.Generator,
    name: str,
    place: tuple[float, float],
    width: float,
    depth: float,
    storeys: int,
) -> list[Body]:
    """Return a house whose front faces the street, which lies along y = 0.

    ``place``: middle of the front (x, y) [m]; ``width``, ``depth``: size of the house along x and y [m].
    """
    x, front_y = place
    away = 1.0 if front_y > 0 else -1.0
    middle_y = front_y + away * depth / 2.0
    height = STOREY * storeys + 0.4
    top_z = PAVEMENT_Z + height

    walls = shapes.standing_box((width, depth, height), (x, middle_y, PAVEMENT_Z))
    roof_foot = (x, middle_y, top_z)
    if rng.uniform() < 0.6:
        rise = float(rng.uniform(2.0, 3.6))
        roof = shapes.gable_roof((width, depth + 0.8, rise), roof_foot, tile_m=3.0)
    else:
        roof = shapes.standing_box((width, depth, 0.5), roof_foot, tile_m=3.0)
    chimney_x = x + width * float(rng.uniform(-0.3, 0.3))
    chimney = shapes.standing_box((0.6, 0.6, 4.4), (chimney_x, middle_y, top_z), tile_m=2.0)
    top = shapes.merged([roof, chimney])
    trim = shapes.merged(_trim(x, front_y, away, width, storeys))

    facade = front(rng, width, storeys)
    roof_shade = float(rng.uniform(0.12, 0.3))
    roof_tiles = textures.bricks(rng, mean=roof_shade, joint=0.06, size=256)
    stucco = textures.plaster(rng, 0.6, 0.3, size=128)
    return [
        parts.solid(name, walls, facade, "house", instance=name),
        parts.solid(f"{name} roof", top, roof_tiles, "house", instance=name),
        parts.solid(f"{name} trim", trim, stucco, "house", instance=name),
    ]


def window_columns(width: float) -> NDArray[np.float64]:
    """Return the distances of the window centres from the left end of a façade [m]."""
    count = max(2, int(width / SPACING))
    return (np.arange(count) + 0.5) * width / count


def _trim(x: float, y: float, away: float, width: float, storeys: int) -> list[Mesh]:
    """Return the window sills, lintels, cornices and the doorstep of a house.

    ``x``, ``y``: middle of the front [m]; ``away``: 1 if the house lies at larger y than its front, else -1.
    """
    left = x - width / 2.0
    windows = window_columns(width)
    sill_size = (WINDOW[0] + 0.3, 0.3, 0.1)
    lintel_size = (WINDOW[0] + 0.3, 0.2, 0.18)
    cornice_size = (width, 0.24, 0.14)
    meshes = []
    for storey in range(storeys):
        floor_z = PAVEMENT_Z + STOREY * storey
        sill_z = floor_z + 0.85
        lintel_z = floor_z + 0.95 + WINDOW[1] + 0.05
        cornice_z = floor_z + STOREY - 0.05
        for window in windows:
            centre = left + window
            # On the ground floor, the place of a sill may be the door.
            if storey > 0:
                meshes.append(shapes.box(sill_size, (centre, y, sill_z), tile_m=0.8))
            meshes.append(shapes.box(lintel_size, (centre, y, lintel_z), tile_m=0.8))
        meshes.append(shapes.box(cornice_size, (x, y, cornice_z), tile_m=0.8))

    top_z = PAVEMENT_Z + STOREY * storeys + 0.3
    meshes.append(shapes.box((width, 0.6, 0.25), (x, y, top_z), tile_m=0.8))

    doorstep = (left + windows[0], y - away * 0.3, PAVEMENT_Z)
    meshes.append(shapes.standing_box((1.6, 0.7, 0.18), doorstep, tile_m=0.8))
    return meshes


def front(rng: np.random.Generator, width: float, storeys: int) -> textures.Texture:
    """Return the texture of a façade: windows in each storey, and a door at the left of the ground floor.

    ``width``: width of the façade [m].
    """
    rows = round((STOREY * storeys + 0.4) * TEXELS)
    columns = round(width * TEXELS)
    shade = float(rng.uniform(0.2, 0.7))
    if rng.uniform() < 0.5:
        bricks = textures.bricks(rng, mean=shade, joint=min(0.9, 1.6 * shade), size=256)
        repeated = np.tile(bricks, (rows // 256 + 1, columns // 256 + 1))
        values = repeated[:rows, :columns].astype(np.float64)
    else:
        values = shade * np.exp(0.3 * textures.fractal(rng, rows, columns))

    breast = round(0.9 * TEXELS)
    for storey in range(storeys):
        foot = rows - round(STOREY * storey * TEXELS)
        for k, centre in enumerate(window_columns(width)):
            left = round((centre - WINDOW[0] / 2.0) * TEXELS)
            if storey == 0 and k == 0:
                _door(rng, values, foot, left)
            else:
                _window(rng, values, foot - breast, left)

    plinth = values[rows - round(0.5 * TEXELS) :]
    plinth *= 0.45
    return textures.weathered(rng, values, 0.12)


def _window(rng: np.random.Generator, values: NDArray[np.float64], foot: int, left: int) -> None:
    """Draw a window into the texture ``values``: frame, panes with a reflection, and sometimes curtains or a lit room.

    ``foot``, ``left``: row of the lower edge and column of the left edge [texels].
    """
    wide = round(WINDOW[0] * TEXELS)
    high = round(WINDOW[1] * TEXELS)
    pane = values[foot - high : foot, left : left + wide]
    glass = float(rng.choice([0.04, 0.06, 0.1, 0.55], p=[0.35, 0.3, 0.2, 0.15]))
    pane[:] = glass
    diagonal = np.arange(high)[:, None] + np.arange(wide)
    reflection = diagonal % high < high // 4
    pane[reflection] = min(0.9, 3.0 * glass)
    if rng.uniform() < 0.4:
        curtain = wide // 4
        folds = 0.5 + 0.2 * (np.arange(curtain) % 4 < 2)
        pane[:, :curtain] = folds
        pane[:, -curtain:] = folds

    frame = 0.85
    pane[:2] = frame
    pane[-2:] = frame
    pane[:, :2] = frame
    pane[:, -2:] = frame
    mullion = wide // 2 - 1
    pane[:, mullion : mullion + 2] = frame
    transom = high // 3
    pane[transom : transom + 2] = frame


def _door(rng: np.random.Generator, values: NDArray[np.float64], foot: int, left: int) -> None:
    """Draw a door with four panels into the texture ``values``.

    ``foot``, ``left``: row of the lower edge and column of the left edge [texels].
    """
    wide = round(WINDOW[0] * TEXELS)
    high = round(2.4 * TEXELS)
    leaf = values[foot - high : foot, left : left + wide]
    shade = float(rng.uniform(0.05, 0.5))
    leaf[:] = shade
    middle = wide // 2
    for top in (0.1, 0.55):
        two_panels = leaf[round(top * high) : round((top + 0.35) * high)]
        two_panels[:, 4 : middle - 2] = 0.4 * shade
        two_panels[:, middle + 2 : -4] = 0.4 * shade
    frame = 0.8
    leaf[:2] = frame
    leaf[:, :2] = frame
    leaf[:, -2:] = frame


def town_hall(rng: np.random.Generator, x: float) -> list[Body]:
    """Return a town hall with tower, clock and spire, which stands across the end of the street at ``x`` [m]."""
    wide = 26.0
    high = 13.0
    hall = shapes.standing_box((12.0, wide, high), (x + 6.0, 0.0, 0.0))
    gable = shapes.gable_roof((wide, 13.0, 5.0), tile_m=3.0)
    roof = shapes.moved(gable, (x + 6.0, 0.0, high), turn_deg=90.0)

    tower = shapes.standing_box((5.0, 5.0, 24.0), (x, 0.0, 0.0))
    cone = shapes.lathe([(3.9, 0.0), (0.4, 7.0), (0.0, 11.0)], sides=16, tile_m=2.0)
    spire = shapes.moved(cone, (x, 0.0, 24.0))
    clock = shapes.panel((x - 2.52, 1.6, 18.0), (0.0, -3.2, 0.0), (0.0, 0.0, 3.2))

    column = shapes.cylinder(0.45, 9.0, sides=20, tile_m=1.5)
    beside_the_tower = [y for y in np.linspace(-12, 12, 9) if abs(y) > 2.0]
    columns = shapes.merged(shapes.moved(column, (x - 1.2, y, 0.0)) for y in beside_the_tower)

    surfaces = {
        "": (hall, front(rng, wide, 4)),
        " tower": (tower, front(rng, 6.0, 7)),
        " spire": (spire, textures.bricks(rng, mean=0.15, joint=0.05, size=256)),
        " columns": (columns, textures.plaster(rng, 0.6, 0.35, size=256)),
        " clock": (clock, textures.star(12)),
        " roof": (roof, textures.bricks(rng, mean=0.2, joint=0.06, size=256)),
    }
    bodies = []
    for part, (mesh, texture) in surfaces.items():
        name = f"town hall{part}"
        bodies.append(parts.solid(name, mesh, texture, "house", instance="town hall"))
    return bodies
