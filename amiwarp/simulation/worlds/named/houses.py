"""Buildings of the world ``street``: houses with windows, sills, cornices and roofs, and a town hall with a tower."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.named import parts, shapes, textures
from amiwarp.simulation.worlds.scene import Body, Mesh

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
    walls = shapes.standing_box((width, depth, height), middle)
    roof_foot = (middle[0], middle[1], 0.1 + height)
    if rng.uniform() < 0.6:
        roof = shapes.gable_roof((width, depth + 0.8, float(rng.uniform(2.0, 3.6))), roof_foot, tile_m=3.0)
    else:
        roof = shapes.standing_box((width, depth, 0.5), roof_foot, tile_m=3.0)
    chimney = shapes.standing_box(
        (0.6, 0.6, 4.4), (middle[0] + width * float(rng.uniform(-0.3, 0.3)), middle[1], 0.1 + height), tile_m=2.0
    )
    trim = shapes.merged(_trim(place[0], place[1], away, width, storeys))
    surfaces = {
        "": (walls, front(rng, width, storeys)),
        " roof": (
            shapes.merged([roof, chimney]),
            textures.bricks(rng, mean=float(rng.uniform(0.12, 0.3)), joint=0.06, size=256),
        ),
        " trim": (trim, textures.plaster(rng, 0.6, 0.3, size=128)),
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
                meshes.append(shapes.box((WINDOW[0] + 0.3, 0.3, 0.1), (centre, y, base + 0.85), tile_m=0.8))
            meshes.append(
                shapes.box((WINDOW[0] + 0.3, 0.2, 0.18), (centre, y, base + 0.95 + WINDOW[1] + 0.05), tile_m=0.8)
            )
        meshes.append(shapes.box((width, 0.24, 0.14), (x, y, base + STOREY - 0.05), tile_m=0.8))
    meshes.append(shapes.box((width, 0.6, 0.25), (x, y, 0.1 + STOREY * storeys + 0.3), tile_m=0.8))
    meshes.append(
        shapes.standing_box(
            (1.6, 0.7, 0.18), (x - width / 2.0 + window_columns(width)[0], y - away * 0.3, 0.1), tile_m=0.8
        )
    )
    return meshes


def front(rng: np.random.Generator, width: float, storeys: int) -> textures.Texture:
    """Return the texture of a façade: windows in each storey, and a door at the left of the ground floor.

    ``width``: width of the façade [m].
    """
    rows, columns = round((STOREY * storeys + 0.4) * TEXELS), round(width * TEXELS)
    wall = float(rng.uniform(0.2, 0.7))
    if rng.uniform() < 0.5:
        masonry = textures.bricks(rng, mean=wall, joint=min(0.9, 1.6 * wall), size=256)
        values = np.tile(masonry, (rows // 256 + 1, columns // 256 + 1))[:rows, :columns].astype(np.float64)
    else:
        values = wall * np.exp(0.3 * textures.fractal(rng, rows, columns))
    for storey in range(storeys):
        foot = rows - round(STOREY * storey * TEXELS)
        for k, at in enumerate(window_columns(width)):
            left = round((at - WINDOW[0] / 2.0) * TEXELS)
            if storey == 0 and k == 0:
                _door(rng, values, foot, left)
            else:
                _window(rng, values, foot - round(0.9 * TEXELS), left)
    values[rows - round(0.5 * TEXELS) :] *= 0.45
    return textures.weathered(rng, values, 0.12)


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
    hall = shapes.standing_box((12.0, wide, high), (x + 6.0, 0.0, 0.0))
    tower = shapes.standing_box((5.0, 5.0, 24.0), (x, 0.0, 0.0))
    spire = shapes.moved(shapes.lathe([(3.9, 0.0), (0.4, 7.0), (0.0, 11.0)], sides=16, tile_m=2.0), (x, 0.0, 24.0))
    shafts = [
        shapes.moved(shapes.cylinder(0.45, 9.0, sides=20, tile_m=1.5), (x - 1.2, y, 0.0))
        for y in np.linspace(-12, 12, 9)
        if abs(y) > 2.0
    ]
    clock = shapes.panel((x - 2.52, 1.6, 18.0), (0.0, -3.2, 0.0), (0.0, 0.0, 3.2))
    roof = shapes.moved(shapes.gable_roof((wide, 13.0, 5.0), tile_m=3.0), (x + 6.0, 0.0, high), turn_deg=90.0)
    surfaces = {
        "": (hall, front(rng, wide, 4)),
        " tower": (tower, front(rng, 6.0, 7)),
        " spire": (spire, textures.bricks(rng, mean=0.15, joint=0.05, size=256)),
        " columns": (shapes.merged(shafts), textures.plaster(rng, 0.6, 0.35, size=256)),
        " clock": (clock, textures.star(12)),
        " roof": (roof, textures.bricks(rng, mean=0.2, joint=0.06, size=256)),
    }
    return [
        parts.solid(f"town hall{part}", mesh, skin, "house", instance="town hall")
        for part, (mesh, skin) in surfaces.items()
    ]
