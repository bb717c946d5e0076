"""Fourier transforms of lines of tiles, by the blocks of a GPU; transposed arrays give the other direction.

On CUDA, cuFFTDx transforms a line in the registers of the threads of a block. On a CPU, a block is one thread.
"""

import warp as wp

from amiwarp.kernels.phase_grid import SIDE

THREADS = 32
"""Threads of a block: one warp, with four elements of a line each. cuFFTDx takes at most half as many as elements."""
LINES = 8
"""Lines of a block, one after another."""
# A module that is loaded without a launch would be compiled for 256 threads, which cuFFTDx refuses.
wp.set_module_options({"enable_backward": False, "block_dim": THREADS})


@wp.kernel
def transform_lines(planes: wp.array3d(dtype=wp.vec2)):
    """Transform ``LINES`` lines of a plane in place. ``planes`` have the shape (planes, SIDE, SIDE)."""
    plane, group = wp.tid()
    lines = wp.tile_load(planes, shape=(1, LINES, SIDE), offset=(plane, group * LINES, 0))
    wp.tile_fft(lines)
    wp.tile_store(planes, lines, offset=(plane, group * LINES, 0))


@wp.kernel
def invert_lines(planes: wp.array3d(dtype=wp.vec2)):
    """Transform lines as :func:`transform_lines` does, but back, not divided by their number of elements."""
    plane, group = wp.tid()
    lines = wp.tile_load(planes, shape=(1, LINES, SIDE), offset=(plane, group * LINES, 0))
    wp.tile_ifft(lines)
    wp.tile_store(planes, lines, offset=(plane, group * LINES, 0))
