"""Counts of each pixel's events in the bins of the last turns, and their weighted sums; on CPUs.

A plane holds the events of one bin: for each pixel the number of ON events times 256 plus the number of OFF events.
Events come in the order of the angle, so the plane to which they are added stays in the cache.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Number of pixels whose sums a thread keeps in the cache."""
TOGETHER = 4
"""Number of planes that are added to the sums at a time."""


@wp.func_native("""
    const uint16_t* __restrict__ at_x = (const uint16_t*)x.data;
    const uint16_t* __restrict__ at_y = (const uint16_t*)y.data;
    const uint8_t* __restrict__ on = (const uint8_t*)p.data;
    uint16_t* __restrict__ counts = (uint16_t*)plane.data;
    for (int i = 0; i < count; ++i) {
        uint16_t* word = counts + (int)at_y[i] * width + (int)at_x[i];
        // a count that is full stays full
        if (on[i])
            *word += *word < 0xff00 ? 0x100 : 0;
        else
            *word += (*word & 0xff) < 0xff;
    }
""")
def add_to_counts(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    p: wp.array(dtype=wp.uint8),
    count: int,
    width: int,
    plane: wp.array(dtype=wp.uint16),
):
    """Add events to the counts of a plane."""


@wp.kernel
def add_to_plane(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    p: wp.array(dtype=wp.uint8),
    count: int,
    width: int,
    start: int,
    plane: wp.array(dtype=wp.uint16),
):
    """Add events to the counts of a plane, in one thread."""
    if wp.tid() + start == 0:
        add_to_counts(x, y, p, count, width, plane)


@wp.func_native("""
    const uint16_t* __restrict__ words = (const uint16_t*)planes.data;
    const float* __restrict__ factors = (const float*)table.data;
    const int32_t* __restrict__ which = (const int32_t*)chosen.data;
    const float* __restrict__ before = (const float*)expected.data;
    float* __restrict__ to = (float*)out.data;
    int32_t* __restrict__ to_on = (int32_t*)on.data;
    int32_t* __restrict__ to_off = (int32_t*)off.data;
    float* __restrict__ to_changed = (float*)changed.data;
    const int first = block * 256;
    const int count = pixels - first < 256 ? pixels - first : 256;
    const int own_rows = (used + 3) / 4 * 4;
    const int rows = own_rows + (parts + 3) / 4 * 4;
    float sums[64 * 256];
    float weights[4 * 256];
    float change[256];
    float size[256];
    int32_t ons[256];
    int32_t offs[256];
    for (int c = 0; c < columns * 256; ++c) sums[c] = 0.0f;
    for (int i = 0; i < 4 * 256; ++i) weights[i] = 0.0f;
    for (int i = 0; i < 256; ++i) { ons[i] = 0; offs[i] = 0; change[i] = 0.0f; size[i] = 0.0f; }
    for (int row = 0; row <= rows; row += 4) {
        if (row == own_rows)  // the sums of the planes alone
            for (int c = 0; c < columns; ++c)
                for (int i = 0; i < 256; ++i)
                    size[i] += sums[c * 256 + i] * sums[c * 256 + i];
        if (row == rows) break;
        for (int k = 0; k < 4; ++k) {
            float* __restrict__ weight = weights + k * 256;
            const int r = row + k;
            const int part = r - own_rows;
            if (part >= 0 && part < parts) {
                const float* __restrict__ from = before + 2 * ((int64_t)(part / 2) * pixels + first) + part % 2;
                for (int i = 0; i < count; ++i) weight[i] = from[2 * i];
            } else if (r < used) {
                const uint16_t* __restrict__ from = words + (int64_t)which[r] * pixels + first;
                for (int i = 0; i < count; ++i) {
                    const int32_t ones = from[i] >> 8;
                    const int32_t others = from[i] & 0xff;
                    ons[i] += ones;
                    offs[i] += others;
                    weight[i] = (float)ones - off_ratio * (float)others;
                }
            } else {
                for (int i = 0; i < count; ++i) weight[i] = 0.0f;
            }
        }
        const float* __restrict__ w0 = weights;
        const float* __restrict__ w1 = weights + 256;
        const float* __restrict__ w2 = weights + 512;
        const float* __restrict__ w3 = weights + 768;
        for (int c = 0; c < columns; ++c) {
            const float f0 = factors[row * columns + c];
            const float f1 = factors[(row + 1) * columns + c];
            const float f2 = factors[(row + 2) * columns + c];
            const float f3 = factors[(row + 3) * columns + c];
            float* __restrict__ sum = sums + c * 256;
            for (int i = 0; i < 256; ++i)
                sum[i] += f0 * w0[i] + f1 * w1[i] + f2 * w2[i] + f3 * w3[i];
        }
    }
    for (int m = 0; m < columns / 2; ++m)
        for (int i = 0; i < count; ++i) {
            float* pair = to + 2 * ((int64_t)m * pixels + first + i);
            pair[0] = sums[2 * m * 256 + i];
            pair[1] = sums[(2 * m + 1) * 256 + i];
        }
    for (int m = 0; m < parts / 2; ++m)
        for (int i = 0; i < count; ++i) {
            const float* old = before + 2 * ((int64_t)m * pixels + first + i);
            const float real = sums[2 * m * 256 + i] - old[0];
            const float imaginary = sums[(2 * m + 1) * 256 + i] - old[1];
            change[i] += real * real + imaginary * imaginary;
        }
    for (int i = 0; i < count; ++i) {
        to_on[first + i] = ons[i];
        to_off[first + i] = offs[i];
        to_changed[first + i] = change[i];
        to_changed[pixels + first + i] = size[i];
    }
""")
def sum_block(
    block: int,
    planes: wp.array2d(dtype=wp.uint16),
    chosen: wp.array(dtype=int),
    table: wp.array2d(dtype=float),
    off_ratio: float,
    expected: wp.array2d(dtype=wp.vec2),
    pixels: int,
    used: int,
    parts: int,
    columns: int,
    out: wp.array2d(dtype=wp.vec2),
    on: wp.array(dtype=int),
    off: wp.array(dtype=int),
    changed: wp.array2d(dtype=float),
):
    """Write the sums and counts of a block of pixels."""


@wp.kernel
def sum_planes(
    planes: wp.array2d(dtype=wp.uint16),
    chosen: wp.array(dtype=int),
    table: wp.array2d(dtype=float),
    off_ratio: float,
    expected: wp.array2d(dtype=wp.vec2),
    start: int,
    out: wp.array2d(dtype=wp.vec2),
    on: wp.array(dtype=int),
    off: wp.array(dtype=int),
    changed: wp.array2d(dtype=float),
):
    """Write the weighted sums over the planes ``chosen`` for a block of pixels, and the number of their events.

    ``table`` has rows for the planes, then rows for real and imaginary part of each of the sums ``expected``, both
    filled up to a multiple of :data:`TOGETHER`: real and imaginary part of what an ON event adds to each sum, and of
    what the expected sums add. An OFF event adds ``off_ratio`` times the negative. ``changed`` has two rows: the
    squares of the sums less the expected ones, and the squares of what the planes alone add.
    """
    used = chosen.shape[0]
    size = planes.shape[1]
    parts = 2 * expected.shape[0]
    columns = table.shape[1]
    block = wp.tid() + start
    sum_block(
        block,
        planes,
        chosen,
        table,
        off_ratio,
        expected,
        size,
        used,
        parts,
        columns,
        out,
        on,
        off,
        changed,
    )
