"""Decoders of Prophesee's ECF codec, with which Metavision compresses the events in its HDF5 files.

A chunk holds the times, rows, columns and polarities of its events one after the other, as runs of equal values or
packed. Where one part begins depends on the whole part before it. So the first pass walks over the runs of each chunk,
without writing events, to find where its parts begin, and damage. The second pass writes the events. One thread reads
one chunk. The codec is described by https://github.com/prophesee-ai/hdf5_ecf.
"""

import warp as wp

from amiwarp.kernels.ecf_words import (
    events_of,
    long_word_at,
    numbers_of,
    packed_bytes,
    polarity_run,
    row_run,
    time_run,
    word_at,
)
from amiwarp.kernels.event_arrays import EventArrays
from amiwarp.kernels.native_code import store_uint8, store_uint16

wp.set_module_options({"enable_backward": False})

PACKED = wp.constant(2)
"""Bit of the packing: rows, columns and polarities stand in one number of 24 bits."""
ROWS = wp.constant(1)
"""Bit of the packing: columns and polarities stand in one number of 12 bits, behind the runs of the rows."""

LONGEST_GAP = wp.constant(15)
"""Largest number of bytes, of four bits each, that store a gap of time [us]."""

# What a chunk holds other than events.
TIMES = wp.constant(1)
RUNS = wp.constant(2)
COLUMNS = wp.constant(3)
NUMBERS = wp.constant(4)


@wp.struct
class Chunk:
    """A chunk, as its head states it."""

    start: int
    """Position behind the head."""
    stop: int
    """Position behind the chunk."""
    count: int
    """Number of events."""
    packing: int
    origin: wp.int64
    """Time before the first event [us]."""
    place: int
    """Index of its first event in the output."""


@wp.struct
class Parts:
    """Where the parts of a chunk begin."""

    rows: int
    """Position behind the times."""
    columns: int
    polarities: int
    damage: int
    """What it holds other than events, or 0."""


@wp.kernel
def survey_ecf(
    data: wp.array(dtype=wp.uint8),
    chunks: wp.array(dtype=Chunk),
    start: int,
    parts: wp.array(dtype=Parts),
):
    """Find where the parts of each chunk begin, and damage."""
    index = wp.tid() + start
    chunk = chunks[index]
    stop = chunk.stop
    found = Parts()
    at = chunk.start
    left = chunk.count
    gap = int(0)
    while left > 0 and found.damage == 0:
        if at >= stop:
            found.damage = TIMES
        else:
            run = time_run(data, at, stop)
            at = run.next
            if run.value < 0:
                gap += 1
                if gap > LONGEST_GAP:
                    found.damage = TIMES
            else:
                gap = int(0)
                left -= run.length
                if left < 0:
                    found.damage = TIMES
    at = wp.min(at, stop)
    found.rows = at

    if (chunk.packing & PACKED) != 0:
        if found.damage == 0 and stop - at < packed_bytes(chunk.count, 24):
            found.damage = NUMBERS
    else:
        left = chunk.count
        while left > 0 and found.damage == 0:
            if at + 1 >= stop:
                found.damage = RUNS
            else:
                run = row_run(data, at, stop)
                at = run.next
                left -= run.length
                if left < 0:
                    found.damage = RUNS
        at = wp.min(at, stop)
        found.columns = at

        if (chunk.packing & ROWS) != 0:
            if found.damage == 0 and stop - at < packed_bytes(chunk.count, 12):
                found.damage = NUMBERS
        else:
            left = chunk.count
            while left > 0 and found.damage == 0:
                if at + 1 >= stop:
                    found.damage = COLUMNS
                else:
                    left -= events_of(word_at(data, at, stop))
                    at += 2
            found.polarities = at
            left = chunk.count
            while left > 0 and found.damage == 0:
                if at >= stop:
                    found.damage = RUNS
                else:
                    run = polarity_run(data, at, stop)
                    at = run.next
                    left -= run.length
                    if left < 0:
                        found.damage = RUNS
    parts[index] = found


@wp.func_native("for (int k = first; k < stop; ++k) ((int64_t*)values.data)[k] = value;")
def fill_times(values: wp.array(dtype=wp.int64), first: int, stop: int, value: wp.int64):
    """Set the elements from ``first`` to before ``stop``."""


@wp.func_native("for (int k = first; k < stop; ++k) ((uint16_t*)values.data)[k] = (uint16_t)value;")
def fill_coordinates(values: wp.array(dtype=wp.uint16), first: int, stop: int, value: int):
    """Set the elements from ``first`` to before ``stop``."""


@wp.func_native("for (int k = first; k < stop; ++k) ((uint8_t*)values.data)[k] = (uint8_t)value;")
def fill_polarities(values: wp.array(dtype=wp.uint8), first: int, stop: int, value: int):
    """Set the elements from ``first`` to before ``stop``."""


@wp.func
def write_times(data: wp.array(dtype=wp.uint8), chunk: Chunk, t: wp.array(dtype=wp.int64)):
    """Write the times of a chunk. A gap is stored in groups of four bits, the lowest first."""
    at = chunk.start
    event = chunk.place
    stop = chunk.place + chunk.count
    now = chunk.origin
    shift = wp.int64(0)
    while event < stop:
        run = time_run(data, at, chunk.stop)
        at = run.next
        if run.value < 0:
            now += wp.int64(run.length) << shift
            shift += wp.int64(4)
        else:
            now += wp.int64(run.value)
            shift = wp.int64(0)
            fill_times(t, event, event + run.length, now)
            event += run.length


@wp.func
def write_packed(data: wp.array(dtype=wp.uint8), chunk: Chunk, at: int, events: EventArrays):
    """Write columns, rows and polarities that stand in one number each."""
    for group in range((chunk.count + 3) // 4):
        place = at + 12 * group
        first = long_word_at(data, place, chunk.stop)
        second = long_word_at(data, place + 4, chunk.stop)
        third = long_word_at(data, place + 8, chunk.stop)
        numbers = numbers_of(first, second, third, wp.uint32(8))
        for k in range(wp.min(chunk.count - 4 * group, 4)):
            event = chunk.place + 4 * group + k
            store_uint16(events.x, event, (numbers[k] >> 1) & 0x7FF)
            store_uint16(events.y, event, (numbers[k] >> 12) & 0x7FF)
            store_uint8(events.p, event, numbers[k] & 1)


@wp.func
def write_packed_columns(
    data: wp.array(dtype=wp.uint8), chunk: Chunk, at: int, events: EventArrays
):
    """Write columns and polarities that stand in one number each."""
    for group in range((chunk.count + 3) // 4):
        place = at + 6 * group
        first = wp.uint32(word_at(data, place, chunk.stop))
        second = wp.uint32(word_at(data, place + 2, chunk.stop))
        third = wp.uint32(word_at(data, place + 4, chunk.stop))
        numbers = numbers_of(first, second, third, wp.uint32(4))
        for k in range(wp.min(chunk.count - 4 * group, 4)):
            event = chunk.place + 4 * group + k
            store_uint16(events.x, event, numbers[k] >> 1)
            store_uint8(events.p, event, numbers[k] & 1)


@wp.func
def write_rows(
    data: wp.array(dtype=wp.uint8), chunk: Chunk, begin: int, y: wp.array(dtype=wp.uint16)
):
    """Write the rows of a chunk."""
    at = begin
    event = chunk.place
    stop = chunk.place + chunk.count
    while event < stop:
        run = row_run(data, at, chunk.stop)
        at = run.next
        fill_coordinates(y, event, event + run.length, run.value)
        event += run.length


@wp.func
def write_polarities(
    data: wp.array(dtype=wp.uint8), chunk: Chunk, begin: int, p: wp.array(dtype=wp.uint8)
):
    """Write the polarities of a chunk."""
    at = begin
    event = chunk.place
    stop = chunk.place + chunk.count
    while event < stop:
        run = polarity_run(data, at, chunk.stop)
        at = run.next
        fill_polarities(p, event, event + run.length, run.value)
        event += run.length


@wp.func
def write_columns(
    data: wp.array(dtype=wp.uint8), chunk: Chunk, begin: int, x: wp.array(dtype=wp.uint16)
):
    """Write the columns of a chunk. A word holds one, and a bit for each of the five next ones, the nearest first.

    The last word may tell of columns behind the last event, which the encoder does not clear.
    """
    at = begin
    event = chunk.place
    stop = chunk.place + chunk.count
    while event < stop:
        word = word_at(data, at, chunk.stop)
        at += 2
        store_uint16(x, event, word >> 5)
        event += 1
        for k in range(1, 6):
            if ((word >> (5 - k)) & 1) != 0 and event < stop:
                store_uint16(x, event, (word >> 5) + k)
                event += 1


@wp.kernel
def decode_ecf(
    data: wp.array(dtype=wp.uint8),
    chunks: wp.array(dtype=Chunk),
    parts: wp.array(dtype=Parts),
    start: int,
    events: EventArrays,
):
    """Write the events of each chunk. None is damaged."""
    index = wp.tid() + start
    chunk = chunks[index]
    part = parts[index]
    write_times(data, chunk, events.t)
    if (chunk.packing & PACKED) != 0:
        write_packed(data, chunk, part.rows, events)
    else:
        write_rows(data, chunk, part.rows, events.y)
        if (chunk.packing & ROWS) != 0:
            write_packed_columns(data, chunk, part.columns, events)
        else:
            write_columns(data, chunk, part.columns, events.x)
            write_polarities(data, chunk, part.polarities, events.p)
