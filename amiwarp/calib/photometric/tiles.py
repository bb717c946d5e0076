"""Parts of the scene that the photometric stage maps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.solver import Tiles
from amiwarp.imaging.iwe import Image
from amiwarp.kernels.iwe import sum_segments
from amiwarp.kernels.launch import launch

TILE = 32
"""Side of a tile of the scene [px]."""
FEW_SEGMENTS = 2048
"""Smallest number of segments of rows for which a second CPU thread counts events."""
GRID = (4, 3)
"""Number of columns and rows into which the image is divided. The tile with most events is chosen from each part."""


def choose_tiles(image: Image, pad: int, density: float, margin: int) -> tuple[NDArray[np.int32], Tiles]:
    """Choose the tile with most events from each part of the scene.

    ``image`` is the IWE at the answer of the sharpness stage, with a border of ``pad`` px outside the sensor;
    ``density`` gives map nodes per pixel, and ``margin`` the border of a tile's map [px]. Return the tile number of
    each of the sensor's pixels, or -1, and the tiles.
    """
    layers = image.shape[0]
    height = image.shape[1] - 2 * pad
    width = image.shape[2] - 2 * pad
    columns = max(1, width // TILE)
    rows = max(1, height // TILE)
    used = rows * min(TILE, height)
    sums: Any = wp.empty((used, columns), dtype=wp.float64, device=image.device)
    inputs = [image.pixels, image.frame, layers, pad, min(TILE, width)]
    launch(sum_segments, sums.size, inputs, [sums], device=image.device, smallest=FEW_SEGMENTS)
    counts = sums.numpy().reshape(rows, -1, columns).sum(axis=1)
    tile_of = np.full((height, width), -1, dtype=np.int32)
    corners: list[tuple[int, int]] = []
    for part_rows in np.array_split(np.arange(rows), min(GRID[1], rows)):
        for part_columns in np.array_split(np.arange(columns), min(GRID[0], columns)):
            part = counts[np.ix_(part_rows, part_columns)]
            row, column = np.unravel_index(int(part.argmax()), part.shape)
            x = int(part_columns[column]) * TILE
            y = int(part_rows[row]) * TILE
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
    down = int((tiles.rows - 2) / tiles.density) - 2 * margin
    across = int((tiles.columns - 2) / tiles.density) - 2 * margin
    for left, top in (tiles.origin.astype(int) + margin).tolist():
        near[max(0, top - far) : top + down + far, max(0, left - far) : left + across + far] = 0
    return near


def one_tile(width: int, height: int, density: float, margin: int) -> tuple[NDArray[np.int32], Tiles]:
    """Return the whole image as one tile, for recordings with few events; see :func:`choose_tiles`."""
    origin = np.array([[-margin, -margin]], dtype=np.float32)
    rows = math.ceil((height + 2 * margin) * density) + 2
    columns = math.ceil((width + 2 * margin) * density) + 2
    return np.zeros((height, width), dtype=np.int32), Tiles(origin, rows, columns, density)
