"""Events added to the images of windows on a CPU: one block per thread.

Loops of constant length without branches become vector code, so each block is copied to local arrays of 64 elements.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.native_code import (
    add_squares,
    add_words,
    copy_bytes,
    copy_floats,
    copy_int64s,
    count_places,
    descends,
    largest_of,
    load_float,
    load_int,
    load_int64,
    load_uint8,
    load_uint16,
    prefetch_events,
    prefetch_words,
    store_int,
    store_int64,
)
from amiwarp.kernels.tensors import (
    AHEAD,
    BLOCK,
    DESCENDING,
    LONGEST,
    OUTSIDE,
    RUN,
    SPAN,
    START,
    STOP,
    T_START,
    WHOLE,
    Grid,
    Part,
    add_event_word,
    count_event,
    end_share,
    first_event,
    group_of,
    in_intervals,
    interval_of,
    is_near,
    is_pixel,
    nearest,
    part_of,
    place_of,
    time_at,
    weight_of,
    window_of,
    word_of,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# The shapes of local arrays are literals, which Warp wants: 64 is BLOCK; of 128 places, two halves take turns; 512 is
# eight shares of each event.
assert int(BLOCK) == 64, "the local arrays of this module hold 64 events"


@wp.func
def replaced_group_of(
    grid: Grid, windows: wp.array2d(dtype=wp.int64), t: wp.array(dtype=wp.int64), part: Part
) -> int:
    """Return the group that a part's spare group replaces, or -1."""
    if part.spare < 0:
        return -1
    window = window_of(windows, part.block)
    return group_of(grid, windows, window, t[first_event(windows, window, part.block)])


@wp.kernel
def find_replaced_group(
    t: wp.array(dtype=wp.int64),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    part: Part,
    replaced: wp.array(dtype=int),
):
    """Find the group that a part's spare group replaces."""
    replaced[0] = replaced_group_of(grid, windows, t, part)


@wp.func
def load_nearest(values: wp.array(dtype=wp.uint16), i: int) -> int:
    """Return the coordinate of an event's pixel."""
    return int(load_uint16(values, i))


@wp.func
def load_nearest(values: wp.array(dtype=float), i: int) -> int:
    """Return the coordinate of the pixel that is nearest to an event."""
    return nearest(load_float(values, i))


@wp.func
def copy_positions(out: wp.array(dtype=float), values: wp.array(dtype=float), first: int, n: int):
    """Copy the coordinates of a block."""
    copy_floats(out, values, first, n)


@wp.func
def copy_positions(
    out: wp.array(dtype=float), values: wp.array(dtype=wp.uint16), first: int, n: int
):
    """Copy the coordinates of the pixels of a block."""
    for k in range(n):
        out[k] = float(values[first + k])


@wp.func
def check_pixels(
    grid: Grid,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    first: int,
    stop: int,
    faults: wp.array(dtype=int),
):
    """Check that the pixels of a sensor's events lie in the image."""
    if is_pixel(grid, largest_of(x, first, stop), largest_of(y, first, stop)) == 0:
        faults[OUTSIDE] = 1


@wp.func
def check_pixels(
    grid: Grid,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    first: int,
    stop: int,
    faults: wp.array(dtype=int),
):
    """Do nothing: compensated events may lie outside the image."""
    return


@wp.func
def start_block(
    grid: Grid,
    windows: wp.array2d(dtype=wp.int64),
    block: int,
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    faults: wp.array(dtype=int),
):
    """Return the window of a block, its first event and the number of its events.

    Check that no event is earlier than the one before in the window, and that a sensor's events lie in the image.
    """
    window = window_of(windows, block)
    first = first_event(windows, window, block)
    n = wp.min(BLOCK, int(windows[window, STOP]) - first)
    if descends(t, wp.max(first, int(windows[window, START]) + 1), first + n):
        faults[DESCENDING] = 1
    check_pixels(grid, x, y, first, first + n, faults)
    return window, first, n


@wp.func
def time_block(
    grid: Grid,
    part: Part,
    replaced: int,
    windows: wp.array2d(dtype=wp.int64),
    window: int,
    t: wp.array(dtype=wp.int64),
    groups: wp.array(dtype=int),
    ends: wp.array(dtype=int),
):
    """Compute the group of images of each event of a block, and its share of the end of its interval."""
    t_start = windows[window, T_START]
    span = windows[window, SPAN]
    first_group = window * grid.steps
    for k in range(BLOCK):
        time = time_at(grid, t_start, span, load_int64(t, k))
        interval = interval_of(grid, time)
        store_int(
            groups,
            k,
            wp.where(first_group + interval == replaced, part.spare, first_group + interval),
        )
        store_int(ends, k, end_share(time, interval))


@wp.func
def place_or_trash(grid: Grid, part: Part, group: int, p: wp.uint8, x: int, y: int) -> int:
    """Return the number of a pixel in the images of a group, or the number of the part's trash."""
    return wp.where(is_pixel(grid, x, y) == 1, place_of(grid, group, p, x, y), part.trash)


# The types of the places are stated, because a generic function would take the types of its first call for all calls.


@wp.func
def place_interval(
    grid: Grid,
    part: Part,
    group: int,
    first: int,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    p: wp.array(dtype=wp.uint8),
    places: wp.array(dtype=int),
    at: int,
):
    """Compute the pixel of each event of a whole block in one time interval, from ``places[at]`` on."""
    for k in range(BLOCK):
        col, row = load_nearest(x, first + k), load_nearest(y, first + k)
        store_int(
            places, at + k, place_or_trash(grid, part, group, load_uint8(p, first + k), col, row)
        )


@wp.func
def place_interval(
    grid: Grid,
    part: Part,
    group: int,
    first: int,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    p: wp.array(dtype=wp.uint8),
    places: wp.array(dtype=int),
    at: int,
):
    """Compute the nearest pixel of each event of a whole block in one time interval, from ``places[at]`` on."""
    for k in range(BLOCK):
        col, row = load_nearest(x, first + k), load_nearest(y, first + k)
        store_int(
            places, at + k, place_or_trash(grid, part, group, load_uint8(p, first + k), col, row)
        )


@wp.func
def store_parts(shares: wp.array(dtype=wp.int64), k: int, weight: int, part: wp.float64, end: int):
    """Store the parts of an event's two shares that belong to a pixel."""
    store_int64(shares, k, wp.int64(weight * part_of(WHOLE - end, part)))
    store_int64(shares, k + 1, wp.int64(weight * part_of(end, part)))


@wp.func
def position_block(
    grid: Grid,
    part: Part,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    p: wp.array(dtype=wp.uint8),
    groups: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    places: wp.array(dtype=int),
    shares: wp.array(dtype=wp.int64),
):
    """Compute the eight shares of each event of a block, and the place of the first two."""
    for k in range(BLOCK):
        inside = is_near(grid, load_float(x, k), load_float(y, k))
        u = wp.where(inside == 1, load_float(x, k), 0.0)
        v = wp.where(inside == 1, load_float(y, k), 0.0)
        col, row = wp.floor(u), wp.floor(v)
        right, below = wp.float64(u - col), wp.float64(v - row)
        left, above = wp.float64(1.0) - right, wp.float64(1.0) - below
        weight = inside * weight_of(grid, load_uint8(p, k))
        end = load_int(ends, k)
        place = 2 * place_of(grid, load_int(groups, k), load_uint8(p, k), int(col), int(row))
        store_int(places, k, wp.where(inside == 1, place, 2 * part.trash))
        store_parts(shares, 8 * k, weight, left * above, end)
        store_parts(shares, 8 * k + 2, weight, right * above, end)
        store_parts(shares, 8 * k + 4, weight, left * below, end)
        store_parts(shares, 8 * k + 6, weight, right * below, end)


@wp.kernel
def count_event_blocks(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    part: Part,
    faults: wp.array(dtype=int),
    counts: wp.array(dtype=int),
):
    """Count the events of each thread's block at their nearest pixels."""
    window, first, n = start_block(grid, windows, part.block + wp.tid(), x, y, t, faults)
    replaced = replaced_group_of(grid, windows, t, part)
    group = group_of(grid, windows, window, t[first])
    if n == BLOCK and group == group_of(grid, windows, window, t[first + n - 1]):
        places = wp.zeros(shape=(64,), dtype=int)
        written_group = wp.where(group == replaced, part.spare, group)
        place_interval(grid, part, written_group, first, x, y, p, places, 0)
        count_places(counts, places, n)
    else:
        for k in range(n):
            count_event(grid, part, replaced, windows, window, first + k, x, y, t, p, counts)


@wp.kernel
def keep_latest_blocks(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    part: Part,
    faults: wp.array(dtype=int),
    latest: wp.array(dtype=wp.int64),
):
    """Keep the latest times of the events of each thread's block at their nearest pixels."""
    window, first, n = start_block(grid, windows, part.block + wp.tid(), x, y, t, faults)
    replaced = replaced_group_of(grid, windows, t, part)
    # Images of latest times have one interval, so that a window has one group.
    group = window * grid.steps
    written_group = wp.where(group == replaced, part.spare, group)
    for k in range(first, first + n):
        col, row = nearest(x[k]), nearest(y[k])
        if is_pixel(grid, col, row) == 1:
            wp.atomic_max(latest, place_of(grid, written_group, p[k], col, row), t[k])


@wp.func
def store_interval_words(
    grid: Grid,
    part: Part,
    replaced: int,
    windows: wp.array2d(dtype=wp.int64),
    window: int,
    group: int,
    first: int,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    places: wp.array(dtype=int),
    words: wp.array(dtype=wp.int64),
    at: int,
):
    """Store the places and words of a whole block's events in one group, as most are. Times are from the first event.

    The sums and products are whole numbers below 2**53, so that a share is the same as from :func:`time_at`.
    """
    prefetch_events(x, y, t, p, first + AHEAD)
    written_group = wp.where(group == replaced, part.spare, group)
    # Warp divides whole numbers as C does.
    interval = group / grid.parts - window * grid.steps
    t_first = t[first]
    start = wp.float64((t_first - windows[window, T_START]) * wp.int64(grid.rate))
    span = windows[window, SPAN]
    place_interval(grid, part, written_group, first, x, y, p, places, at)
    for k in range(BLOCK):
        elapsed = wp.float64(int(load_int64(t, first + k) - t_first)) * wp.float64(grid.rate)
        end = end_share(in_intervals(grid, start + elapsed, wp.float64(span)), interval)
        store_int64(words, at + k, word_of(grid, weight_of(grid, load_uint8(p, first + k)), end))


@wp.kernel
def add_event_word_blocks(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    part: Part,
    faults: wp.array(dtype=int),
    words: wp.array(dtype=wp.int64),
):
    """Add the words of the events of each thread's blocks. A block's words are added after the next one's are known.

    Meanwhile, the pixels are fetched from memory: an image is larger than a core's cache.
    """
    places = wp.zeros(shape=(128,), dtype=int)
    waiting = wp.zeros(shape=(128,), dtype=wp.int64)
    replaced = replaced_group_of(grid, windows, t, part)
    # Of the 128 places, one half is filled for this block, while the words of the other half are added, whose pixels
    # are fetched by now.
    half = int(0)
    waiting_events = int(0)
    first_block = part.block + wp.tid() * RUN
    for block in range(first_block, wp.min(first_block + RUN, part.stop)):
        window, first, n = start_block(grid, windows, block, x, y, t, faults)
        group = group_of(grid, windows, window, t[first])
        t_last = t[first + n - 1]
        if (
            n == BLOCK
            and group == group_of(grid, windows, window, t_last)
            and t_last - t[first] < LONGEST
        ):
            store_interval_words(
                grid,
                part,
                replaced,
                windows,
                window,
                group,
                first,
                x,
                y,
                t,
                p,
                places,
                waiting,
                half,
            )
            prefetch_words(words, places, half, BLOCK)
            half = BLOCK - half
            add_words(words, places, waiting, half, waiting_events)
            waiting_events = BLOCK
        else:
            for k in range(n):
                add_event_word(grid, part, replaced, windows, window, first + k, x, y, t, p, words)
    add_words(words, places, waiting, BLOCK - half, waiting_events)


@wp.kernel
def share_event_blocks(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    part: Part,
    faults: wp.array(dtype=int),
    sums: wp.array(dtype=wp.int64),
):
    """Share the events of each thread's block among the four nearest pixels and the ends of their time intervals."""
    times = wp.zeros(shape=(64,), dtype=wp.int64)
    signs = wp.zeros(shape=(64,), dtype=wp.uint8)
    us = wp.zeros(shape=(64,), dtype=float)
    vs = wp.zeros(shape=(64,), dtype=float)
    groups = wp.zeros(shape=(64,), dtype=int)
    ends = wp.zeros(shape=(64,), dtype=int)
    places = wp.zeros(shape=(64,), dtype=int)
    shares = wp.zeros(shape=(512,), dtype=wp.int64)
    window, first, n = start_block(grid, windows, part.block + wp.tid(), x, y, t, faults)
    copy_int64s(times, t, first, n)
    copy_bytes(signs, p, first, n)
    replaced = replaced_group_of(grid, windows, t, part)
    copy_positions(us, x, first, n)
    copy_positions(vs, y, first, n)
    time_block(grid, part, replaced, windows, window, times, groups, ends)
    position_block(grid, part, us, vs, signs, groups, ends, places, shares)
    add_squares(sums, places, shares, 2 * (grid.width + 2 * grid.border), n)


for _coordinate in (wp.uint16, wp.float32):
    for _kernel in (count_event_blocks, keep_latest_blocks, share_event_blocks):
        wp.overload(_kernel, {"x": wp.array(dtype=_coordinate), "y": wp.array(dtype=_coordinate)})
