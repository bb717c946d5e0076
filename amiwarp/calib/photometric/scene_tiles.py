"""Choice of the parts of the scene that the photometric stage maps."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.brightness.tiles import Tiles

if TYPE_CHECKING:
    from numpy.typing import NDArray

TILE = 32
"""Side of a tile of the scene [px]."""
GRID = (4, 3)
"""Number of columns and rows into which the image is divided. The tile with most events is chosen from each part."""


def choose_tiles(image: NDArray[np.float32], density: float, margin: int) -> tuple[NDArray[np.int32], Tiles]:
    """Choose the tile with most events from each part of the scene.

    ``image`` is the IWE at the answer of the sharpness stage, shape (height, width); ``density`` gives map nodes per
    pixel, and ``margin`` the border of a tile's map [px]. Return the tile number of each pixel, or -1, and the tiles.
    """
    height, width = image.shape
    columns, rows = max(1, width // TILE), max(1, height // TILE)
    cells = image[: rows * TILE, : columns * TILE]
    counts = cells.reshape(rows, cells.shape[0] // rows, columns, cells.shape[1] // columns).sum(axis=(1, 3))
    tile_of = np.full((height, width), -1, dtype=np.int32)
    corners: list[tuple[int, int]] = []
    for part_rows in np.array_split(np.arange(rows), min(GRID[1], rows)):
        for part_columns in np.array_split(np.arange(columns), min(GRID[0], columns)):
            part = counts[np.ix_(part_rows, part_columns)]
            row, column = np.unravel_index(int(part.argmax()), part.shape)
            x, y = int(part_columns[column]) * TILE, int(part_rows[row]) * TILE
            tile_of[y : y + TILE, x : x + TILE] = len(corners)
            corners.append((x - margin, y - margin))
    side = math.ceil((TILE + 2 * margin) * density) + 2
    return tile_of, Tiles(np.array(corners, dtype=np.float32), side, side, density)


def near_tiles(tiles: Tiles, margin: int, far: int, shape: tuple[int, ...]) -> NDArray[np.int32]:
    """Return 0 for the pixels that are at most ``far`` pixels from a tile, along each axis, else -1.

    ``margin`` is that of the tiles, ``shape`` the image's (height, width). With few nodes per pixel, tiles count as
    larger than they are, by up to the distance of two nodes.
    """
    near = np.full(shape, -1, dtype=np.int32)
    down, across = (int((n - 2) / tiles.density) - 2 * margin for n in (tiles.rows, tiles.columns))
    for left, top in (tiles.origin.astype(int) + margin).tolist():
        near[max(0, top - far) : top + down + far, max(0, left - far) : left + across + far] = 0
    return near


def one_tile(width: int, height: int, density: float, margin: int) -> tuple[NDArray[np.int32], Tiles]:
    """Return the whole image as one tile, for recordings with few events; see :func:`choose_tiles`."""
    origin = np.array([[-margin, -margin]], dtype=np.float32)
    rows, columns = (math.ceil((n + 2 * margin) * density) + 2 for n in (height, width))
    return np.zeros((height, width), dtype=np.int32), Tiles(origin, rows, columns, density)
