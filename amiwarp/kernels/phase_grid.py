"""Tiles of an image of sums in phase: where they lie, and how they are joined again."""

import warp as wp

wp.set_module_options({"enable_backward": False})

SIDE = 128
"""Side of a tile [px]. The orbit of a wedge prism varies by 7 % within a tile of 60 deg over 640 px."""
TILE = wp.constant(SIDE)


@wp.struct
class TileGrid:
    """Rows and columns of tiles that overlap. The first begins an overlap before the image."""

    rows: int
    columns: int
    step_y: int
    """Distance of the rows of tiles [px]."""
    step_x: int
    overlap_y: int
    """Overlap of the rows of tiles [px]."""
    overlap_x: int


@wp.kernel
def join_tiles(
    tiles: wp.array3d(dtype=wp.vec2),
    window: wp.array2d(dtype=float),
    grid: TileGrid,
    start: int,
    image: wp.array2d(dtype=float),
):
    """Write one pixel of the image: the weighted real parts of the tiles that cover it, in the order of the tiles.

    ``tiles`` come from a Fourier transform that was not divided by its number of elements.
    """
    i = wp.tid() + start
    y = i / image.shape[1]
    x = i % image.shape[1]
    total = float(0.0)
    for row in range(
        first_tile(y, grid.step_y, grid.overlap_y),
        wp.min((y + grid.overlap_y) / grid.step_y + 1, grid.rows),
    ):
        line = y + grid.overlap_y - row * grid.step_y
        for column in range(
            first_tile(x, grid.step_x, grid.overlap_x),
            wp.min((x + grid.overlap_x) / grid.step_x + 1, grid.columns),
        ):
            place = x + grid.overlap_x - column * grid.step_x
            part = tiles[row * grid.columns + column, line, place][0]
            total += window[line, place] * (part / float(TILE * TILE))
    image[y, x] = total


@wp.func
def first_tile(place: int, step: int, overlap: int) -> int:
    """Return the first row or column of tiles that covers a place [px]."""
    # The last pixel of tile k lies at step k - overlap + TILE - 1
    return wp.max(0, (place + overlap - TILE + step) / step)
