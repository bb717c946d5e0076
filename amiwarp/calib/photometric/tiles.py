"""Parts of the scene that the photometric stage maps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.tiles import Tiles
from amiwarp.imaging.canvas import Image
from amiwarp.kernels.launch import launch
from amiwarp.kernels.smoothing import sum_segments

TILE = 32
"""Side of a tile of the scene [px]."""
FEW_SEGMENTS = 2048
"""Smallest number of segments of rows for which a second CPU thread counts events."""
GRID = (4, 3)
"""Number of columns and rows into which the image is divided. The tile with most events is chosen from each part."""


def choose_tiles(
    image: Image,
    pad: int,
    density: float,
    margin: int,
) -> tuple[NDArray[np.int32], Tiles]:
    """Choose the tile with most events from each part of the scene.

    ``image`` is the IWE at the answer of the sharpness stage, with a border of ``pad`` px outside the sensor;
    ``density`` gives map nodes per pixel, and ``margin`` the border of a tile's map [px]. Return the tile number of
    each of the sensor's pixels, or -1, and the tiles.
    """
    height = image.shape[1] - 2 * pad
    width = image.shape[2] - 2 * pad
    tile_of = np.full((height, width), -1, dtype=np.int32)
    corners: list[tuple[int, int]] = []
    for row, column in _fullest_tiles(_count_by_tile(image, pad)):
        x = column * TILE
        y = row * TILE
        tile_of[y : y + TILE, x : x + TILE] = len(corners)
        corners.append((x - margin, y - margin))

    origin = np.array(corners, dtype=np.float32)
    side = _nodes_along(TILE, density, margin)
    return tile_of, Tiles(origin, side, side, density)


def _fullest_tiles(counts: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return row and column of the tile with most events of each part of the :data:`GRID`."""
    rows, columns = counts.shape
    columns_of_parts = np.array_split(np.arange(columns), min(GRID[0], columns))
    rows_of_parts = np.array_split(np.arange(rows), min(GRID[1], rows))
    found = []
    for part_rows in rows_of_parts:
        for part_columns in columns_of_parts:
            part = counts[np.ix_(part_rows, part_columns)]
            row, column = np.unravel_index(int(part.argmax()), part.shape)
            found.append((int(part_rows[row]), int(part_columns[column])))
    return found


def _count_by_tile(image: Image, pad: int) -> NDArray[np.float64]:
    """Return the events in each tile of an image with a border of ``pad`` px, shape (rows, columns) of tiles."""
    layers, padded_height, padded_width = image.shape
    height = padded_height - 2 * pad
    width = padded_width - 2 * pad
    columns = max(1, width // TILE)
    rows = max(1, height // TILE)

    # The kernel counts the segments of the image's rows that lie in each column of tiles.
    image_rows = rows * min(TILE, height)
    segment = min(TILE, width)
    sums: Any = wp.empty((image_rows, columns), dtype=wp.float64, device=image.device)
    launch(
        sum_segments,
        sums.size,
        [image.pixels, image.frame, layers, pad, segment],
        [sums],
        device=image.device,
        smallest=FEW_SEGMENTS,
    )
    by_tile = sums.numpy().reshape(rows, -1, columns)
    return np.asarray(by_tile.sum(axis=1))


def _nodes_along(length: int, density: float, margin: int) -> int:
    """Return the number of nodes of a map along a side of ``length`` px with a border on both ends [px]."""
    with_border = length + 2 * margin
    return math.ceil(with_border * density) + 2


def near_tiles(
    tiles: Tiles,
    margin: int,
    far: int,
    shape: tuple[int, ...],
) -> NDArray[np.int32]:
    """Return 0 for the pixels that are at most ``far`` pixels from a tile, along each axis, else -1.

    ``margin`` is the margin of the tiles, ``shape`` the image's (height, width). With few nodes per pixel, tiles count
    as larger than they are, by up to the distance of two nodes.
    """
    near = np.full(shape, -1, dtype=np.int32)
    height = int((tiles.rows - 2) / tiles.density) - 2 * margin
    width = int((tiles.columns - 2) / tiles.density) - 2 * margin
    corners = tiles.origin.astype(int) + margin
    for left, top in corners.tolist():
        bottom = top + height
        right = left + width
        near_rows = slice(max(0, top - far), bottom + far)
        near_columns = slice(max(0, left - far), right + far)
        near[near_rows, near_columns] = 0
    return near


def one_tile(
    width: int,
    height: int,
    density: float,
    margin: int,
) -> tuple[NDArray[np.int32], Tiles]:
    """Return the whole image as one tile, for recordings with few events; see :func:`choose_tiles`."""
    tile_of = np.zeros((height, width), dtype=np.int32)
    origin = np.array([[-margin, -margin]], dtype=np.float32)
    rows = _nodes_along(height, density, margin)
    columns = _nodes_along(width, density, margin)
    return tile_of, Tiles(origin, rows, columns, density)
