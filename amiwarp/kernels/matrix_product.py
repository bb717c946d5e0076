"""Products of matrices by the blocks of a GPU, in float32, each sum in fixed order."""

import warp as wp

THREADS = 128
"""Threads of a block."""
BLOCK = 32
"""Rows and columns of the part of a product that a block computes."""
wp.set_module_options({"enable_backward": False, "block_dim": THREADS})


@wp.kernel
def multiply(
    left: wp.array2d(dtype=float), right: wp.array2d(dtype=float), out: wp.array2d(dtype=float)
):
    """Write a part of the product of two matrices. Beyond their borders they are 0."""
    row, column = wp.tid()
    total = wp.tile_zeros(shape=(BLOCK, BLOCK), dtype=float)
    for k in range((left.shape[1] + BLOCK - 1) / BLOCK):
        lines = wp.tile_load(left, shape=(BLOCK, BLOCK), offset=(row * BLOCK, k * BLOCK))
        columns = wp.tile_load(right, shape=(BLOCK, BLOCK), offset=(k * BLOCK, column * BLOCK))
        wp.tile_matmul(lines, columns, total)
    wp.tile_store(out, total, offset=(row * BLOCK, column * BLOCK))
