"""Sums of each pixel's events in phase with the optic, in integers, so that they are the same on every device.

A turn is divided into bins. A table has a row for each polarity and bin: what an event there adds to the integers of
its pixel, which are the numbers of OFF and ON events, then cosine and sine of each harmonic in units of 1/UNIT. Where
the polarity changes, the brightness had an extreme between the two events, on average half a threshold beyond each of
them. For it both add a further row.

The events are ordered by blocks of pixels, in a block by time. A block is some lines, whose integers fit into a core's
cache. :mod:`amiwarp.kernels.phase_pixels` sums on GPUs.
"""

import warp as wp

from amiwarp.kernels.events_with_angles import EventsWithAngles
from amiwarp.kernels.native_code import load_uint8, load_uint16, store_int

wp.set_module_options({"enable_backward": False})

UNIT = 1 << 12
"""Value of cosine and sine in the table for 1. The sums of a pixel have room for 2^31 / UNIT events."""
COUNTS = wp.constant(2)
"""Number of integers of each pixel before its sums: the numbers of its OFF events and of its ON events."""
NOTES = wp.constant(3)
"""Number of integers of each pixel after its sums, while they are made."""
ROW_BITS = wp.constant(11)
"""Number of bits of a word that hold the row of the table; the others hold the pixel."""


@wp.func
def table_row(polarity: wp.uint8, turn: wp.uint16, bins: int) -> int:
    """Return the row of the table for an event at an angle [1/65536 turn]."""
    return int(polarity) * bins + ((int(turn) * bins) >> 16)


@wp.kernel
def count_blocks(
    y: wp.array(dtype=wp.uint16),
    lines: int,
    parts: int,
    count: int,
    start: int,
    counts: wp.array2d(dtype=int),
):
    """Count the events of one of ``parts`` ranges of events in each block of ``lines`` lines.

    ``counts`` has shape (parts, blocks).
    """
    part = wp.tid() + start
    for i in range(first_of(part, parts, count), first_of(part + 1, parts, count)):
        counts[part, int(load_uint16(y, i)) / lines] += 1


@wp.kernel
def order_by_blocks(
    events: EventsWithAngles,
    width: int,
    lines: int,
    parts: int,
    count: int,
    bins: int,
    start: int,
    places: wp.array2d(dtype=int),
    words: wp.array(dtype=int),
):
    """Write the events of one of ``parts`` ranges as words, block after block: pixel in its block, row of the table.

    ``places`` are where the first word of each range and block goes, shape (parts, blocks).
    """
    part = wp.tid() + start
    for i in range(first_of(part, parts, count), first_of(part + 1, parts, count)):
        line = int(load_uint16(events.y, i))
        block = line / lines
        pixel = (line - block * lines) * width + int(load_uint16(events.x, i))
        row = table_row(load_uint8(events.layer, i), load_uint16(events.turn, i), bins)
        place = places[part, block]
        places[part, block] = place + 1
        store_int(words, place, (pixel << ROW_BITS) | row)


@wp.func
def first_of(part: int, parts: int, count: int) -> int:
    """Return the first of ``count`` elements that belongs to one of ``parts`` equal ranges."""
    return int((wp.int64(count) * wp.int64(part)) / wp.int64(parts))


# For each pixel of a block, NOTES integers follow its sums: row of the first event, row of the last, and number of
# changes of polarity.
@wp.func_native("""
    const int32_t* __restrict__ rows = (const int32_t*)table.data;
    const int32_t* __restrict__ word = (const int32_t*)words.data;
    int32_t* __restrict__ sum = (int32_t*)sums.data + at * (columns + notes);
    for (int i = first; i < stop; ++i) {
        const int pixel = word[i] >> bits;
        const int row = word[i] & ((1 << bits) - 1);
        int32_t* __restrict__ to = sum + (int64_t)pixel * (columns + notes);
        int32_t* __restrict__ note = to + columns;
        const int32_t* __restrict__ from = rows + row * columns;
        for (int k = 0; k < columns; ++k)
            to[k] += from[k];
        const int before = note[1];
        note[1] = row;
        if (before < 0) {
            note[0] = row;
        } else if ((before < bins) != (row < bins)) {
            note[2] += 1;
            const int32_t* __restrict__ one = rows + (2 * bins + before) * columns;
            const int32_t* __restrict__ other = rows + (2 * bins + row) * columns;
            for (int k = 0; k < columns; ++k)
                to[k] += one[k] + other[k];
        }
    }
""")
def add_rows(
    sums: wp.array2d(dtype=int),
    at: wp.int64,
    table: wp.array2d(dtype=int),
    words: wp.array(dtype=int),
    first: int,
    stop: int,
    columns: int,
    notes: int,
    bins: int,
    bits: int,
):
    """Add the rows of the words from ``first`` to before ``stop`` to the integers of their pixels, of which ``at`` is
    the first."""


@wp.func_native("""
    for (int pixel = 0; pixel < count; ++pixel) {
        int32_t* sum = (int32_t*)sums.data + (at + pixel) * (columns + notes);
        for (int k = 0; k < columns; ++k)
            sum[k] = 0;
        sum[columns] = -1;
        sum[columns + 1] = -1;
        sum[columns + 2] = 0;
    }
""")
def clear_block(sums: wp.array2d(dtype=int), at: wp.int64, count: int, columns: int, notes: int):
    """Begin with ``count`` pixels without events, of which ``at`` is the first."""


@wp.kernel
def sum_blocks(
    words: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    shares: wp.array(dtype=int),
    table: wp.array2d(dtype=int),
    scales: wp.array(dtype=float),
    block_pixels: int,
    start: int,
    sums: wp.array2d(dtype=int),
    counts: wp.array2d(dtype=int),
    values: wp.array2d(dtype=wp.vec2),
):
    """Sum the events of a share of the blocks, and write numbers and complex sums of their pixels.

    ``starts`` are the first words of the blocks and their end, ``shares`` the first blocks of the shares and their end.
    ``table`` has a row for each polarity and bin, and then for each its further row. ``sums`` has room for the
    pixels of one block for each share, shape (shares * block_pixels, columns + NOTES). ``counts`` has shape (3,
    pixels): OFF events, ON events, changes of polarity.
    """
    share = wp.tid() + start
    columns = table.shape[1]
    bins = table.shape[0] / 4
    pixels = counts.shape[1]
    at = wp.int64(share) * wp.int64(block_pixels)
    for block in range(shares[share], shares[share + 1]):
        first = block * block_pixels
        here = wp.min(block_pixels, pixels - first)
        clear_block(sums, at, here, columns, NOTES)
        add_rows(
            sums,
            at,
            table,
            words,
            starts[block],
            starts[block + 1],
            columns,
            NOTES,
            bins,
            ROW_BITS,
        )
        for pixel in range(here):
            row = share * block_pixels + pixel
            close_turn(sums, table, row, bins)
            counts[0, first + pixel] = sums[row, 0]
            counts[1, first + pixel] = sums[row, 1]
            counts[2, first + pixel] = sums[row, columns + 2]
            for k in range(values.shape[0]):
                cosine = sums[row, COUNTS + 2 * k]
                sine = sums[row, COUNTS + 2 * k + 1]
                values[k, first + pixel] = complex_sum(cosine, sine, scales[k])


@wp.func
def close_turn(sums: wp.array2d(dtype=int), table: wp.array2d(dtype=int), pixel: int, bins: int):
    """Add what lies between the last event of a pixel and the first, which follows it in the next turn."""
    columns = table.shape[1]
    first = sums[pixel, columns]
    last = sums[pixel, columns + 1]
    if first >= 0 and (first < bins) != (last < bins):
        sums[pixel, columns + 2] += 1
        for k in range(columns):
            sums[pixel, k] += table[2 * bins + first, k] + table[2 * bins + last, k]


@wp.func
def complex_sum(cosine: int, sine: int, scale: float) -> wp.vec2:
    """Return a sum in phase from its integers: cosines less i times sines."""
    return wp.vec2(scale * float(cosine), -scale * float(sine))


@wp.kernel
def complex_sums(
    sums: wp.array2d(dtype=int),
    scales: wp.array(dtype=float),
    start: int,
    values: wp.array2d(dtype=wp.vec2),
):
    """Write the sums of a pixel, shape (harmonics, pixels), from its cosines and sines, shape (pixels, 2 harmonics)."""
    pixel = wp.tid() + start
    for k in range(values.shape[0]):
        values[k, pixel] = complex_sum(sums[pixel, 2 * k], sums[pixel, 2 * k + 1], scales[k])
