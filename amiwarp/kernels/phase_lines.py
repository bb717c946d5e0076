"""Fourier transforms of tiles by the blocks of a GPU: of their lines, and then of their columns.

A block transforms 16 lines in its shared memory. They are read and written in the order of memory, of columns 128
bytes at a time. With 128 = 16 · 8 places, n = 8 a + b and k = a' + 16 b', a line has a transform of 16 over a, a turn
of each number, and a transform of 8 over b. On a CPU a block is one thread, which does all tasks one after another.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.phase_grid import SIDE, TileGrid
from amiwarp.kernels.shared_memory import wait_for_block

THREADS = SIDE
"""Threads of a block."""
LINES = 16
"""Lines of a block."""
ROOM = LINES * 153
"""Numbers of a block's lines. A line takes 153 places, of which each eight are followed by one that is idle: so the
threads of a warp use different banks of the shared memory."""
wp.set_module_options({"enable_backward": False, "block_dim": THREADS})


def turns_of_places() -> NDArray[np.complex128]:
    """Return the numbers exp(-2πi n / SIDE) that the kernels take."""
    return np.exp(-2j * np.pi / SIDE * np.arange(SIDE))


@wp.kernel
def cut_lines(
    values: wp.array3d(dtype=wp.vec2),
    window: wp.array2d(dtype=float),
    grid: TileGrid,
    turns: wp.array(dtype=wp.vec2),
    room: wp.array(dtype=wp.vec2),
    planes: wp.array3d(dtype=wp.vec2),
):
    """Cut tiles out of images, weight them, and write the transforms of their lines.

    ``values`` have the shape (harmonics, height, width), and are 0 outside. ``planes`` have the shape (tiles harmonics,
    SIDE, SIDE). ``turns`` are the numbers exp(-2πi n / SIDE); ``room`` is a block's memory on a CPU.
    """
    plane, group, first = wp.tid()
    lines = lines_of_block()
    tile = plane / values.shape[0]
    k = plane % values.shape[0]
    top = tile / grid.columns * grid.step_y - grid.overlap_y
    left = tile % grid.columns * grid.step_x - grid.overlap_x
    for thread in range(first, THREADS, wp.block_dim()):
        x = left + thread
        within_x = wp.clamp(x, 0, values.shape[2] - 1)
        # Not a constant, so not unrolled: the addresses of all lines at once would take too many registers
        count = window.shape[0] * LINES / SIDE
        for line in range(count):
            row = group * LINES + line
            y = top + row
            within_y = wp.clamp(y, 0, values.shape[1] - 1)
            weight = window[row, thread]
            if x != within_x or y != within_y:
                weight = 0.0
            value = weight * values[k, within_y, within_x]
            put(lines, room, line, thread / 8, thread % 8, value)
    transform_block(lines, room, turns, first)
    for thread in range(first, THREADS, wp.block_dim()):
        for line in range(LINES):
            wave = take(lines, room, line, thread % 16, thread / 16)
            planes[plane, group * LINES + line, thread] = wave


@wp.kernel
def transform_lines(
    planes: wp.array3d(dtype=wp.vec2),
    turns: wp.array(dtype=wp.vec2),
    room: wp.array(dtype=wp.vec2),
    sign: float,
):
    """Transform the lines of planes in place, shape (planes, SIDE, SIDE).

    With a ``sign`` of -1 the transform is inverse, not divided by the number of elements.
    """
    plane, group, first = wp.tid()
    lines = lines_of_block()
    for thread in range(first, THREADS, wp.block_dim()):
        for line in range(LINES):
            value = planes[plane, group * LINES + line, thread]
            put(lines, room, line, thread / 8, thread % 8, wp.vec2(value[0], sign * value[1]))
    transform_block(lines, room, turns, first)
    for thread in range(first, THREADS, wp.block_dim()):
        for line in range(LINES):
            wave = take(lines, room, line, thread % 16, thread / 16)
            planes[plane, group * LINES + line, thread] = wp.vec2(wave[0], sign * wave[1])


@wp.kernel
def transform_columns(
    planes: wp.array3d(dtype=wp.vec2),
    turns: wp.array(dtype=wp.vec2),
    room: wp.array(dtype=wp.vec2),
    sign: float,
):
    """Transform columns as :func:`transform_lines` does lines."""
    plane, group, first = wp.tid()
    lines = lines_of_block()
    for thread in range(first, THREADS, wp.block_dim()):
        line = thread % LINES
        within = thread / LINES
        for part in range(16):
            value = planes[plane, 8 * part + within, group * LINES + line]
            put(lines, room, line, part, within, wp.vec2(value[0], sign * value[1]))
    transform_block(lines, room, turns, first)
    for thread in range(first, THREADS, wp.block_dim()):
        line = thread % LINES
        within = thread / LINES
        for part in range(16):
            wave = 8 * part + within
            value = take(lines, room, line, wave % 16, wave / 16)
            planes[plane, wave, group * LINES + line] = wp.vec2(value[0], sign * value[1])


@wp.func
def transform_block(
    lines: int, room: wp.array(dtype=wp.vec2), turns: wp.array(dtype=wp.vec2), first: int
):
    """Transform the lines of a block, by all of its threads. They wait for each other before and after."""
    wait_for_block()
    for thread in range(first, THREADS, wp.block_dim()):
        transform_sixteen(lines, room, turns, thread % LINES, thread / LINES)
    wait_for_block()
    for thread in range(first, THREADS, wp.block_dim()):
        for half in range(2):
            transform_eight(lines, room, turns, thread % LINES, thread / LINES + 8 * half)
    wait_for_block()


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ float2 numbers[{ROOM}];
    return (int)(unsigned)__cvta_generic_to_shared(numbers);
#endif
    return 0;
""")
def lines_of_block() -> int:
    """Return the address of the block's lines in shared memory; 0 on a CPU."""


# Numbers of a line lie at 9 a + b: place 8 a + b before the transforms, wave a + 16 b after them.
POINTER = """
#if defined(__CUDA_ARCH__)
    float2* numbers = (float2*)__cvta_shared_to_generic((size_t)(unsigned)lines) + 153 * line;
#else
    struct float2 { float x, y; };
    float2* numbers = (float2*)room.data + 153 * line;
#endif
"""
TURN = """
    const wp::vec2* turn = (const wp::vec2*)turns.data;
    auto turned = [turn](float2 a, int n) {
        const float2 by = {turn[n][0], turn[n][1]};
        return float2{a.x * by.x - a.y * by.y, a.x * by.y + a.y * by.x};
    };
    auto transform_four = [](float2& a, float2& b, float2& c, float2& d) {
        const float2 even = {a.x + c.x, a.y + c.y};
        const float2 differs = {a.x - c.x, a.y - c.y};
        const float2 odd = {b.x + d.x, b.y + d.y};
        const float2 back = {b.y - d.y, d.x - b.x};  // -i (b - d)
        a = {even.x + odd.x, even.y + odd.y};
        b = {differs.x + back.x, differs.y + back.y};
        c = {even.x - odd.x, even.y - odd.y};
        d = {differs.x - back.x, differs.y - back.y};
    };
"""


@wp.func_native(f"""{POINTER}
    numbers[9 * a + b] = {{value[0], value[1]}};
""")
def put(lines: int, room: wp.array(dtype=wp.vec2), line: int, a: int, b: int, value: wp.vec2):
    """Set a number of a line of the block."""


@wp.func_native(f"""{POINTER}
    const float2 found = numbers[9 * a + b];
    return wp::vec2(found.x, found.y);
""")
def take(lines: int, room: wp.array(dtype=wp.vec2), line: int, a: int, b: int) -> wp.vec2:
    """Return a number of a line of the block."""


@wp.func_native(f"""{POINTER}{TURN}
    float2 x[16];
#pragma unroll
    for (int k = 0; k < 16; ++k)
        x[k] = numbers[9 * k + b];
#pragma unroll
    for (int k = 0; k < 4; ++k) {{
        transform_four(x[k], x[4 + k], x[8 + k], x[12 + k]);
#pragma unroll
        for (int wave = 1; wave < 4; ++wave)
            x[4 * wave + k] = turned(x[4 * wave + k], 8 * wave * k);
    }}
#pragma unroll
    for (int wave = 0; wave < 4; ++wave) {{
        float2* own = x + 4 * wave;
        transform_four(own[0], own[1], own[2], own[3]);
#pragma unroll
        for (int k = 0; k < 4; ++k)
            numbers[9 * (wave + 4 * k) + b] = turned(own[k], (wave + 4 * k) * b);
    }}
""")
def transform_sixteen(
    lines: int, room: wp.array(dtype=wp.vec2), turns: wp.array(dtype=wp.vec2), line: int, b: int
):
    """Transform the 16 numbers of a line with one ``b`` over a, and turn them."""


@wp.func_native(f"""{POINTER}{TURN}
    float2 even[4];
    float2 odd[4];
#pragma unroll
    for (int k = 0; k < 4; ++k) {{
        const float2 one = numbers[9 * a + k];
        const float2 other = numbers[9 * a + 4 + k];
        even[k] = {{one.x + other.x, one.y + other.y}};
        odd[k] = turned({{one.x - other.x, one.y - other.y}}, 16 * k);
    }}
    transform_four(even[0], even[1], even[2], even[3]);
    transform_four(odd[0], odd[1], odd[2], odd[3]);
#pragma unroll
    for (int k = 0; k < 4; ++k) {{
        numbers[9 * a + 2 * k] = even[k];
        numbers[9 * a + 2 * k + 1] = odd[k];
    }}
""")
def transform_eight(
    lines: int, room: wp.array(dtype=wp.vec2), turns: wp.array(dtype=wp.vec2), line: int, a: int
):
    """Transform the 8 numbers of a line with one ``a`` over b."""
