"""Counts of each pixel's events in the bins of the last turns, and their weighted sums; on CPUs.

A plane holds the events of one bin: for each pixel the number of ON events times 256 plus the number of OFF events.
Events come in the order of the angle, so the plane to which they are added stays in the cache.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BLOCK = 128
"""Number of pixels whose sums a thread keeps in the cache."""
TOGETHER = 6
"""Number of columns of the table that are taken at a time, in a processor's registers."""


@wp.func_native("""
    const uint16_t* __restrict__ at_x = (const uint16_t*)x;
    const uint16_t* __restrict__ at_y = (const uint16_t*)y;
    const uint8_t* __restrict__ on = (const uint8_t*)p;
    uint16_t* __restrict__ counts = (uint16_t*)plane;
    for (int i = 0; i < count; ++i) {
        uint16_t* word = counts + (int)at_y[i] * width + (int)at_x[i];
        const int before = *word;
        // a count that is full stays full; no branch, since polarities cannot be predicted
        const int shift = on[i] ? 8 : 0;
        *word = (uint16_t)(before + ((int)(((before >> shift) & 0xff) != 0xff) << shift));
    }
""")
def add_to_counts(
    x: wp.uint64, y: wp.uint64, p: wp.uint64, count: int, width: int, plane: wp.uint64
):
    """Add events to the counts of a plane."""


@wp.kernel
def add_to_plane(
    x: wp.uint64,
    y: wp.uint64,
    p: wp.uint64,
    count: int,
    width: int,
    plane: wp.uint64,
    start: int,
):
    """Add events to the counts of a plane, in one thread.

    Columns of events and the plane are given by their addresses: to make an array of each takes longer than to add some
    thousand events.
    """
    if wp.tid() + start == 0:
        add_to_counts(x, y, p, count, width, plane)


# With extremes, a bin with both polarities begins as the bin before ended: so the polarity changes as seldom as it can.
@wp.func_native("""
    const uint16_t* __restrict__ words = (const uint16_t*)planes.data;
    const float* __restrict__ factors = (const float*)table.data;
    const int32_t* __restrict__ which = (const int32_t*)chosen.data;
    const float* __restrict__ before = (const float*)expected.data;
    float* __restrict__ to = (float*)out.data;
    int32_t* __restrict__ to_counts = (int32_t*)counts.data;
    float* __restrict__ to_changed = (float*)changed.data;
    const int first = block * 128;
    const int count = pixels - first < 128 ? pixels - first : 128;
    float weights[64 * 128];
    float sums[66 * 128];
    float change[128] = {};
    float size[128] = {};
    int32_t ons[128] = {};
    int32_t offs[128] = {};
    int32_t changes[128] = {};
    int32_t polarity[128] = {};
    int8_t firsts[64 * 128];
    int8_t lasts[64 * 128];
    for (int i = 0; i < 128 * columns; ++i) sums[i] = 0.0f;
    if (count < 128)
        for (int i = 0; i < 64 * 128; ++i) weights[i] = 0.0f;
    // finds the polarity of each pixel's last event in planes
    auto follow = [&](int plane, int number) {
        for (int r = 0; r < number; ++r) {
            const uint16_t* __restrict__ from = words + (int64_t)which[plane + r] * pixels + first;
            for (int i = 0; i < count; ++i) {
                const int32_t one = from[i] > 0xff;
                const int32_t other = (from[i] & 0xff) != 0;
                const int32_t both = polarity[i] ? -polarity[i] : -1;
                polarity[i] = one & other ? both : (one | other ? one - other : polarity[i]);
            }
        }
    };
    // adds to the weights of planes what an extreme adds to the events before and after it
    auto add_extremes = [&](int plane, int number, bool closed) {
        const float of_on = extreme;
        const float of_off = -extreme * off_ratio;
        if (closed) follow(plane, number);
        for (int r = 0; r < number; ++r) {
            const uint16_t* __restrict__ from = words + (int64_t)which[plane + r] * pixels + first;
            float* __restrict__ weight = weights + r * 128;
            int8_t* __restrict__ to_first = firsts + r * 128;
            int8_t* __restrict__ to_last = lasts + r * 128;
            for (int i = 0; i < count; ++i) {
                const int32_t one = from[i] > 0xff;
                const int32_t other = (from[i] & 0xff) != 0;
                const int32_t both = one & other;
                const int32_t begins = both ? (polarity[i] ? polarity[i] : 1) : one - other;
                const int32_t ends = both ? -begins : begins;
                const int32_t turned = begins * polarity[i] < 0;
                changes[i] += turned + both;
                weight[i] += (turned ? (begins > 0 ? of_on : of_off) : 0.0f) + (both ? of_on + of_off : 0.0f);
                to_first[i] = (int8_t)begins;
                to_last[i] = (int8_t)ends;
                polarity[i] = ends ? ends : polarity[i];
            }
        }
        int32_t next[128] = {};
        if (closed)
            for (int r = number - 1; r >= 0; --r)
                for (int i = 0; i < count; ++i)
                    next[i] = firsts[r * 128 + i] ? firsts[r * 128 + i] : next[i];
        for (int r = number - 1; r >= 0; --r) {
            float* __restrict__ weight = weights + r * 128;
            for (int i = 0; i < count; ++i) {
                const int32_t ends = lasts[r * 128 + i];
                weight[i] += ends * next[i] < 0 ? (ends > 0 ? of_on : of_off) : 0.0f;
                next[i] = ends ? firsts[r * 128 + i] : next[i];
            }
        }
    };
    // adds rows of weights to the sums, by the factors from a row of the table on
    auto add_rows = [&](int row, int rows) {
#if !defined(__CUDA_ARCH__)
#pragma clang fp contract(fast)
        typedef float Eight __attribute__((vector_size(32), aligned(4), may_alias));
        for (int c = 0; c < columns; c += 6)
            for (int i = 0; i < count; i += 16) {
                Eight sum[6][2];
#pragma unroll
                for (int k = 0; k < 6; ++k) {
                    sum[k][0] = *(const Eight*)(sums + (c + k) * 128 + i);
                    sum[k][1] = *(const Eight*)(sums + (c + k) * 128 + i + 8);
                }
                for (int r = 0; r < rows; ++r) {
                    const Eight one = *(const Eight*)(weights + r * 128 + i);
                    const Eight other = *(const Eight*)(weights + r * 128 + i + 8);
                    const float* factor = factors + (row + r) * columns + c;
#pragma unroll
                    for (int k = 0; k < 6; ++k) {
                        sum[k][0] += factor[k] * one;
                        sum[k][1] += factor[k] * other;
                    }
                }
#pragma unroll
                for (int k = 0; k < 6; ++k) {
                    *(Eight*)(sums + (c + k) * 128 + i) = sum[k][0];
                    *(Eight*)(sums + (c + k) * 128 + i + 8) = sum[k][1];
                }
            }
#endif
    };
    if (extreme > 0.0f) follow(0, earlier);
    for (int row = 0; row < used; row += 64) {
        const int rows = used - row < 64 ? used - row : 64;
        for (int r = 0; r < rows; ++r) {
            const uint16_t* __restrict__ from = words + (int64_t)which[earlier + row + r] * pixels + first;
            float* __restrict__ weight = weights + r * 128;
            for (int i = 0; i < count; ++i) {
                const int32_t ones = from[i] >> 8;
                const int32_t others = from[i] & 0xff;
                ons[i] += ones;
                offs[i] += others;
                weight[i] = (float)ones - off_ratio * (float)others;
            }
        }
        if (extreme > 0.0f) add_extremes(earlier + row, rows, rows == 64);
        add_rows(row, rows);
    }
    if (parts) {  // the sums of the planes alone, then what is expected
        for (int c = 0; c < parts; ++c)
            for (int i = 0; i < count; ++i)
                size[i] += sums[c * 128 + i] * sums[c * 128 + i];
        for (int m = 0; m < parts / 2; ++m) {
            const float* __restrict__ from = before + 2 * ((int64_t)m * pixels + first);
            float* __restrict__ real = weights + 2 * m * 128;
            float* __restrict__ imaginary = real + 128;
            for (int i = 0; i < count; ++i) { real[i] = from[2 * i]; imaginary[i] = from[2 * i + 1]; }
        }
        add_rows(used, parts);
        for (int c = 0; c < parts; ++c)
            for (int i = 0; i < count; ++i) {
                const float differs = sums[c * 128 + i] - weights[c * 128 + i];
                change[i] += differs * differs;
            }
    }
    for (int m = 0; m < harmonics; ++m) {
        float* __restrict__ pair = to + 2 * ((int64_t)m * pixels + first);
        const float* __restrict__ real = sums + 2 * m * 128;
        const float* __restrict__ imaginary = real + 128;
        for (int i = 0; i < count; ++i) { pair[2 * i] = real[i]; pair[2 * i + 1] = imaginary[i]; }
    }
    for (int i = 0; i < count; ++i) {
        to_counts[first + i] = ons[i];
        to_counts[pixels + first + i] = offs[i];
        to_counts[2 * pixels + first + i] = changes[i];
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
    extreme: float,
    expected: wp.array2d(dtype=wp.vec2),
    pixels: int,
    earlier: int,
    used: int,
    parts: int,
    columns: int,
    harmonics: int,
    out: wp.array2d(dtype=wp.vec2),
    counts: wp.array2d(dtype=int),
    changed: wp.array2d(dtype=float),
):
    """Write the sums and counts of a block of pixels."""


@wp.kernel
def sum_planes(
    planes: wp.array2d(dtype=wp.uint16),
    chosen: wp.array(dtype=int),
    table: wp.array2d(dtype=float),
    off_ratio: float,
    extreme: float,
    expected: wp.array2d(dtype=wp.vec2),
    start: int,
    out: wp.array2d(dtype=wp.vec2),
    counts: wp.array2d(dtype=int),
    changed: wp.array2d(dtype=float),
):
    """Write the weighted sums over planes for a block of pixels, and the numbers of their events.

    ``chosen`` are the planes, in the order of time. ``table`` has rows for the last of them, then rows for real and
    imaginary part of each of the sums ``expected``: the planes before these only tell the polarity of the event before.
    Its columns are real and imaginary part of what an ON event adds to each sum, and of what the expected sums add,
    filled up to a multiple of :data:`TOGETHER`. An OFF event adds ``off_ratio`` times the negative. An event beside an
    extreme counts ``extreme`` more. Whole turns of 64 planes are closed: their first event follows their last one.
    ``counts`` are the numbers of ON events, OFF events and changes of polarity, shape (3, pixels). ``changed`` has two
    rows: the squares of the sums less the expected ones, and the squares of what the planes alone add.
    """
    size = planes.shape[1]
    parts = 2 * expected.shape[0]
    used = table.shape[0] - parts
    block = wp.tid() + start
    sum_block(
        block,
        planes,
        chosen,
        table,
        off_ratio,
        extreme,
        expected,
        size,
        chosen.shape[0] - used,
        used,
        parts,
        table.shape[1],
        out.shape[0],
        out,
        counts,
        changed,
    )
