"""Order of an image's elements by tiles, so that threads next to each other cast rays that meet the same surfaces."""

import warp as wp

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(8)  # side of a tile [texels]


@wp.func
def place_in_tile(width: int, height: int, k: int) -> int:
    """Return the index of the element of an image that is number ``k`` in the order of tiles; -1 outside of the image.

    Tiles and the elements of a tile are counted row by row.
    """
    across = (width + TILE - 1) / TILE
    tile = k / (TILE * TILE)
    inner = k % (TILE * TILE)
    row = tile / across * TILE + inner / TILE
    col = tile % across * TILE + inner % TILE
    return wp.where(row < height and col < width, row * width + col, -1)
