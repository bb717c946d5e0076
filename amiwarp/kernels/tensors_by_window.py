"""Tensors of windows on a CPU, of which a thread takes one after the other, and touches only the pixels of events.

The images of :mod:`amiwarp.kernels.tensors_cpu` are cleared and read as a whole, which takes longer than adding a few
events. Here, counts and latest times go to the result at once. Sums have two images, for the time interval of the
events and for the one before, which take turns. With words, each event writes the bins at both ends of its interval
anew. With two sums, the events of an interval and those before tell the pixels of the bin between both after it. The
older image is then cleared at its events. The result is 0 at first.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.background_activity import never
from amiwarp.kernels.native_code import (
    add_squares,
    add_to_bins,
    clear_words,
    copy_bytes,
    count_places,
    descends,
    fill_int64s,
    load_int,
    load_int64,
    load_uint8,
    load_uint16,
    prefetch_bins,
    store_float,
    store_int,
    store_int64,
    store_uint8,
)
from amiwarp.kernels.tensor_values import Decay, decayed, pixel_sum
from amiwarp.kernels.tensors import (
    BLOCK,
    DESCENDING,
    EARLIEST,
    OUTSIDE,
    SPAN,
    START,
    STOP,
    T_END,
    T_START,
    WHOLE,
    Grid,
    Part,
    end_share,
    in_intervals,
    interval_of,
    is_near,
    is_pixel,
    nearest,
    place_of,
    weight_of,
    word_of,
)
from amiwarp.kernels.tensors_cpu import check_pixels, copy_positions, position_block

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# The shapes of local arrays are literals: 64 is BLOCK, 512 is eight shares of each event.


@wp.func
def events_of(
    windows: wp.array2d(dtype=wp.int64),
    window: int,
    grid: Grid,
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    faults: wp.array(dtype=int),
):
    """Return the index of a window's first event and the index after its last one; the same if an event has a fault."""
    start, stop = int(windows[window, START]), int(windows[window, STOP])
    if descends(t, start + 1, stop):
        faults[DESCENDING] = 1
    check_pixels(grid, x, y, start, stop, faults)
    return start, wp.where(faults[DESCENDING] + faults[OUTSIDE] == 0, stop, start)


@wp.func
def time_in(
    grid: Grid, windows: wp.array2d(dtype=wp.int64), window: int, t: wp.int64
) -> wp.float64:
    """Return a time in units of a window's intervals."""
    elapsed = (t - windows[window, T_START]) * wp.int64(grid.rate)
    return in_intervals(grid, wp.float64(elapsed), wp.float64(windows[window, SPAN]))


@wp.func
def place_pixels(
    grid: Grid,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    first: int,
    stop: int,
    pixels: wp.array(dtype=int),
) -> int:
    """Compute the numbers of the pixels of up to a block of events; return how many events there are."""
    for k in range(BLOCK):
        i = wp.min(first + k, stop - 1)
        store_int(pixels, k, int(load_uint16(y, i)) * grid.width + int(load_uint16(x, i)))
    return wp.min(BLOCK, stop - first)


@wp.kernel
def count_windows(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    faults: wp.array(dtype=int),
    out: wp.array2d(dtype=int),
):
    """Count the events of each thread's window."""
    places = wp.zeros(shape=(64,), dtype=int)
    window = wp.tid()
    counts = out[window]
    start, stop = events_of(windows, window, grid, x, y, t, faults)
    size = grid.width * grid.height
    for first in range(start, stop, BLOCK):
        n = place_pixels(grid, x, y, first, stop, places)
        for k in range(BLOCK):
            is_on = load_uint8(p, wp.min(first + k, stop - 1)) != wp.uint8(0)
            layer = wp.where(is_on, grid.layers - 1, 0)
            store_int(places, k, load_int(places, k) + layer * size)
        count_places(counts, places, n)


@wp.kernel
def clip_windows(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    limit: int,
    faults: wp.array(dtype=int),
    out: wp.array2d(dtype=wp.uint8),
):
    """Count the events of each thread's window in time intervals: of OFF events, then of ON events, up to a limit."""
    window = wp.tid()
    counts = out[window]
    start, stop = events_of(windows, window, grid, x, y, t, faults)
    for i in range(start, stop):
        col, row = nearest(x[i]), nearest(y[i])
        if is_pixel(grid, col, row) == 1:
            interval = interval_of(grid, time_in(grid, windows, window, t[i]))
            image = wp.where(p[i] != wp.uint8(0), grid.steps + interval, interval)
            place = (image * grid.height + row) * grid.width + col
            store_uint8(counts, place, wp.min(int(load_uint8(counts, place)) + 1, limit))


@wp.kernel
def keep_latest_windows(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    faults: wp.array(dtype=int),
    out: wp.array2d(dtype=wp.int64),
):
    """Keep the latest times of the events of each thread's window, which are in order."""
    window = wp.tid()
    latest = out[window]
    fill_int64s(latest, never())
    start, stop = events_of(windows, window, grid, x, y, t, faults)
    for i in range(start, stop):
        col, row = nearest(x[i]), nearest(y[i])
        if is_pixel(grid, col, row) == 1:
            store_int64(latest, place_of(grid, 0, p[i], col, row), t[i])


@wp.kernel
def decay_windows(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    decay: Decay,
    faults: wp.array(dtype=int),
    latest: wp.array(dtype=wp.int64),
    out: wp.array2d(dtype=float),
):
    """Compute the time surface of each thread's window. ``latest``: zeros, and again zeros afterwards."""
    window = wp.tid()
    surface = out[window]
    start, stop = events_of(windows, window, grid, x, y, t, faults)
    for i in range(start, stop):
        col, row = nearest(x[i]), nearest(y[i])
        if is_pixel(grid, col, row) == 1:
            # Times since EARLIEST are above 0.
            store_int64(latest, place_of(grid, 0, p[i], col, row), t[i] - EARLIEST)
    for i in range(start, stop):
        col, row = nearest(x[i]), nearest(y[i])
        if is_pixel(grid, col, row) == 1:
            place = place_of(grid, 0, p[i], col, row)
            since = load_int64(latest, place)
            if since != wp.int64(0):
                elapsed = windows[window, T_END] - (since + EARLIEST)
                store_float(surface, place, decayed(decay, elapsed))
                store_int64(latest, place, wp.int64(0))


# Voxel grids.


@wp.func
def time_events(
    grid: Grid,
    windows: wp.array2d(dtype=wp.int64),
    window: int,
    interval: int,
    t: wp.array(dtype=wp.int64),
    first: int,
    stop: int,
    ends: wp.array(dtype=int),
) -> int:
    """Compute the shares of a time interval's end for up to a block of events; return how many belong to it."""
    t_start = windows[window, T_START]
    span = wp.float64(windows[window, SPAN])
    number = int(0)
    for k in range(BLOCK):
        elapsed = (load_int64(t, wp.min(first + k, stop - 1)) - t_start) * wp.int64(grid.rate)
        time = in_intervals(grid, wp.float64(elapsed), span)
        number += wp.where(interval_of(grid, time) == interval, 1, 0)
        store_int(ends, k, end_share(time, wp.min(interval, interval_of(grid, time))))
    return wp.min(number, stop - first)


@wp.func
def add_interval(
    grid: Grid,
    windows: wp.array2d(dtype=wp.int64),
    window: int,
    interval: int,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    first: int,
    stop: int,
    words: wp.array(dtype=wp.int64),
    bins: int,
    voxels: wp.array(dtype=float),
) -> int:
    """Add a time interval's events to the bins at both its ends; return the index after its last event."""
    ends = wp.zeros(shape=(64,), dtype=int)
    pixels = wp.zeros(shape=(64,), dtype=int)
    added = wp.zeros(shape=(64,), dtype=wp.int64)
    size = grid.width * grid.height
    to_end = wp.where(interval + 1 < bins, size, 0)
    at = int(first)
    number = int(BLOCK)
    while number == BLOCK and at < stop:
        number = time_events(grid, windows, window, interval, t, at, stop, ends)
        place_pixels(grid, x, y, at, stop, pixels)
        for k in range(number):
            weight = weight_of(grid, load_uint8(p, at + k))
            store_int64(added, k, word_of(grid, weight, load_int(ends, k)))
        prefetch_bins(voxels, interval * size, to_end, words, pixels, 0, number)
        add_to_bins(
            voxels,
            interval * size,
            to_end,
            words,
            grid.low,
            interval % 2,
            pixels,
            added,
            0,
            number,
        )
        at += number
    return at


@wp.kernel
def add_word_windows(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    bins: int,
    faults: wp.array(dtype=int),
    words: wp.array(dtype=wp.int64),
    out: wp.array2d(dtype=float),
):
    """Compute the voxel grid of each thread's window. ``words``: two zeros a pixel, and again zeros afterwards."""
    pixels = wp.zeros(shape=(64,), dtype=int)
    window = wp.tid()
    voxels = out[window]
    start, stop = events_of(windows, window, grid, x, y, t, faults)
    # The events of the interval before: from `before` to `first`; of this one: from `first` to `after`
    before = int(start)
    first = int(start)
    for interval in range(grid.steps + 1):
        after = int(first)
        if interval < grid.steps:
            after = add_interval(
                grid, windows, window, interval, x, y, t, p, first, stop, words, bins, voxels
            )
        for at in range(before, first, BLOCK):
            n = place_pixels(grid, x, y, at, first, pixels)
            clear_words(words, 1 - interval % 2, pixels, n)
        before = int(first)
        first = int(after)


# Positions between pixels. A pixel of the two images has two sums.


@wp.func
def share_interval(
    grid: Grid,
    windows: wp.array2d(dtype=wp.int64),
    window: int,
    interval: int,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    first: int,
    stop: int,
    sums: wp.array(dtype=wp.int64),
) -> int:
    """Add the shares of a time interval's events to one of the two images; return the index after its last event."""
    signs = wp.zeros(shape=(64,), dtype=wp.uint8)
    us = wp.zeros(shape=(64,), dtype=float)
    vs = wp.zeros(shape=(64,), dtype=float)
    images = wp.zeros(shape=(64,), dtype=int)
    ends = wp.zeros(shape=(64,), dtype=int)
    places = wp.zeros(shape=(64,), dtype=int)
    shares = wp.zeros(shape=(512,), dtype=wp.int64)
    part = Part()
    part.trash = 2 * grid.layers * (grid.height + 2) * (grid.width + 2)
    for k in range(BLOCK):
        store_int(images, k, interval % 2)
    at = int(first)
    number = int(BLOCK)
    while number == BLOCK and at < stop:
        number = time_events(grid, windows, window, interval, t, at, stop, ends)
        copy_bytes(signs, p, at, number)
        copy_positions(us, x, at, number)
        copy_positions(vs, y, at, number)
        position_block(grid, part, us, vs, signs, images, ends, places, shares)
        add_squares(sums, places, shares, 2 * (grid.width + 2), number)
        at += number
    return at


@wp.func
def write_sums(
    grid: Grid,
    sums: wp.array(dtype=wp.int64),
    this: int,
    p: wp.uint8,
    x: int,
    y: int,
    out: wp.array(dtype=float),
    bin_of: int,
    bins: int,
):
    """Write a bin at a pixel, if there is such a pixel. ``this``: image of the interval that starts there."""
    if is_pixel(grid, x, y) == 1:
        layer = wp.where(p != wp.uint8(0), grid.layers - 1, 0)
        total = pixel_sum(grid, sums, this, layer, y, x, 0)
        total += pixel_sum(grid, sums, 1 - this, layer, y, x, 1)
        place = ((layer * bins + bin_of) * grid.height + y) * grid.width + x
        store_float(out, place, float(wp.float64(total) / wp.float64(WHOLE)))


@wp.func
def clear_sums(grid: Grid, sums: wp.array(dtype=wp.int64), image: int, p: wp.uint8, x: int, y: int):
    """Clear the sums of a pixel and its right neighbour."""
    place = 2 * place_of(grid, image, p, x, y)
    for k in range(4):
        store_int64(sums, place + k, wp.int64(0))


@wp.kernel
def share_windows(
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    bins: int,
    faults: wp.array(dtype=int),
    sums: wp.array(dtype=wp.int64),
    out: wp.array2d(dtype=float),
):
    """Share the events of each thread's window among pixels and bins. ``sums``: zeros, and again zeros afterwards."""
    window = wp.tid()
    shared = out[window]
    start, stop = events_of(windows, window, grid, x, y, t, faults)
    before = int(start)
    first = int(start)
    for interval in range(grid.steps + 1):
        after = int(first)
        if interval < grid.steps:
            after = share_interval(grid, windows, window, interval, x, y, t, p, first, stop, sums)
        this = interval % 2
        if interval < bins:
            for i in range(before, after):
                if is_near(grid, x[i], y[i]) == 1:
                    col, row = int(wp.floor(x[i])), int(wp.floor(y[i]))
                    write_sums(grid, sums, this, p[i], col, row, shared, interval, bins)
                    write_sums(grid, sums, this, p[i], col + 1, row, shared, interval, bins)
                    write_sums(grid, sums, this, p[i], col, row + 1, shared, interval, bins)
                    write_sums(grid, sums, this, p[i], col + 1, row + 1, shared, interval, bins)
        for i in range(before, first):
            if is_near(grid, x[i], y[i]) == 1:
                col, row = int(wp.floor(x[i])), int(wp.floor(y[i]))
                clear_sums(grid, sums, 1 - this, p[i], col, row)
                clear_sums(grid, sums, 1 - this, p[i], col, row + 1)
        before = int(first)
        first = int(after)


for _coordinate in (wp.uint16, wp.float32):
    for _kernel in (clip_windows, keep_latest_windows, decay_windows):
        wp.overload(_kernel, {"x": wp.array(dtype=_coordinate), "y": wp.array(dtype=_coordinate)})
