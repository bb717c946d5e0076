"""Event representations for networks: voxel grids, histograms, and latest times.

A launch adds the events of many windows. A window has a group of images for each of its time intervals, or for each
part of them: one image, or one for OFF and one for ON events. Sums are integers, so that they depend neither on the
order of events nor on the number of threads.

A voxel grid shares each event between the bins at both ends of its time interval, so a pixel of an image holds two
sums. At whole pixels, one 64-bit word holds both: the sum of the events' signs, and in its lower ``low`` bits the sum
of the shares of the interval's end, in units of 2**(64 - 2 * low) event. The addition is modulo 2**64. No field
overflows if fewer than 2**(63 - low) events are added to an image, so an interval with more events is cut into parts
with an image each. If that is not possible, and at positions between pixels, a pixel has two 64-bit sums in units of
2**-30 event: the shares of the interval's start, and those of its end.

A block is 64 events of one window. A GPU thread processes one event, a CPU thread a block, or a run of blocks for
words. On a CPU, each slice of the blocks adds to groups that no other slice adds to. Times ascend, so a slice can share
only its first group with the slice before. A spare group replaces it, and is added to it later.
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
    read_words,
    store_float,
    store_int,
    store_int64,
    store_uint8,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK = wp.constant(64)  # number of events of a block
RUN = wp.constant(8)  # number of blocks whose words a CPU thread adds
AHEAD = wp.constant(256)  # number of events from a block to those that are fetched from memory meanwhile
WHOLE = wp.constant(1 << 30)  # share of a whole event
EARLIEST = wp.constant(wp.int64(-(2**62)))  # limit of the times of events [us]; without events, a pixel holds less
LONGEST = wp.constant(wp.int64(1 << 31))  # time of a block from which it is not processed at once [us]

# Numbers of the array of faults, of which each becomes 1 if the fault occurs.
DESCENDING = wp.constant(0)  # an event is earlier than the one before in its window
OUTSIDE = wp.constant(1)  # an event of a sensor lies outside the image; compensated events may

# Columns of the array of windows, which has a row for each window.
START = wp.constant(0)  # index of the first event
STOP = wp.constant(1)  # index after the last event
FIRST_BLOCK = wp.constant(2)  # number of the first block
T_START = wp.constant(3)  # start of the time span [us]
SPAN = wp.constant(4)  # length of the time span [us], at least 1


@wp.struct
class Grid:
    """Images of each window."""

    width: int  # [px]
    height: int  # [px]
    border: int  # pixels around an image: 1 if events are shared among pixels, else 0
    steps: int  # number of time intervals
    rate: int  # the same, or 0 if all events lie at the start of the only interval
    layers: int  # images of a time interval: 2 to separate OFF (first) and ON events, else 1
    low: int  # bits of the lower field of a word, 43 to 47
    off: int  # what an OFF event counts: -1 or 1; an ON event counts 1
    parts: int  # groups of a time interval, a power of 2; 1 except for words


@wp.struct
class Part:
    """Part of the blocks that one CPU thread processes, or all of them for a GPU."""

    block: int  # first block
    spare: int  # group that replaces the first one, or -1
    trash: int  # number of a pixel after all images, for the events outside of them
    stop: int  # after the last block


# Window, time interval and pixel of an event.


@wp.func
def window_of(windows: wp.array2d(dtype=wp.int64), block: int) -> int:
    """Return the window of a block."""
    low = int(0)
    high = windows.shape[0] - 1
    while low < high:
        middle = (low + high + 1) / 2
        if windows[middle, FIRST_BLOCK] <= wp.int64(block):
            low = middle
        else:
            high = middle - 1
    return low


@wp.func
def first_event(windows: wp.array2d(dtype=wp.int64), window: int, block: int) -> int:
    """Return the index of the first event of a block."""
    return int(windows[window, START]) + (block - int(windows[window, FIRST_BLOCK])) * BLOCK


@wp.func
def time_at(grid: Grid, t_start: wp.int64, span: wp.int64, t: wp.int64) -> wp.float64:
    """Return a time in units of a window's intervals. Times outside the window move to its ends."""
    return in_intervals(grid, wp.float64((t - t_start) * wp.int64(grid.rate)), wp.float64(span))


@wp.func
def in_intervals(grid: Grid, elapsed: wp.float64, span: wp.float64) -> wp.float64:
    """Return a time in units of a window's intervals from the time since the window's start, multiplied by the rate.

    The division is rounded once, so that the whole part is exact if the product is below 2**53.
    """
    return wp.clamp(elapsed / span, wp.float64(0.0), wp.float64(grid.rate))


@wp.func
def interval_of(grid: Grid, time: wp.float64) -> int:
    """Return the interval of a time. The end of the window belongs to the last one."""
    return wp.min(int(time), grid.steps - 1)


@wp.func
def nearest(value: wp.uint16) -> int:
    """Return the coordinate of a sensor's pixel."""
    return int(value)


@wp.func
def nearest(value: float) -> int:
    """Return the nearest pixel's coordinate, or -1 if it is NaN or far outside the image."""
    found = wp.floor(value + 0.5)
    return wp.where(found >= 0.0, wp.where(found < 65536.0, int(found), -1), -1)


@wp.func
def is_pixel(grid: Grid, x: int, y: int) -> int:
    """Return 1 if there is such a pixel, else 0."""
    across = wp.where(x >= 0, wp.where(x < grid.width, 1, 0), 0)
    return wp.where(y >= 0, wp.where(y < grid.height, across, 0), 0)


@wp.func
def is_near(grid: Grid, x: float, y: float) -> int:
    """Return 1 if a position is less than a pixel from the image, else 0."""
    across = wp.where(x > -1.0, wp.where(x < float(grid.width), 1, 0), 0)
    return wp.where(y > -1.0, wp.where(y < float(grid.height), across, 0), 0)


@wp.func
def place_of(grid: Grid, group: int, p: wp.uint8, x: int, y: int) -> int:
    """Return the number of a pixel in the images of a group, by polarity."""
    layer = wp.where(p != wp.uint8(0), grid.layers - 1, 0)
    row = (group * grid.layers + layer) * (grid.height + 2 * grid.border) + y + grid.border
    return row * (grid.width + 2 * grid.border) + x + grid.border


@wp.func
def weight_of(grid: Grid, p: wp.uint8) -> int:
    """Return what an event counts, by its polarity."""
    return wp.where(p != wp.uint8(0), 1, grid.off)


@wp.func
def end_share(time: wp.float64, interval: int) -> int:
    """Return the share of an event that belongs to the end of its interval, in units of 2**-30."""
    return int((time - wp.float64(interval)) * wp.float64(WHOLE) + wp.float64(0.5))


@wp.func
def part_of(share: int, part: wp.float64) -> int:
    """Return a part of a share, rounded."""
    return int(wp.float64(share) * part + wp.float64(0.5))


# On a GPU: one event per thread.


@wp.func
def check_pixel(grid: Grid, x: wp.uint16, y: wp.uint16, faults: wp.array(dtype=int)):
    """Check that a sensor's pixel lies in the image."""
    if is_pixel(grid, int(x), int(y)) == 0:
        faults[OUTSIDE] = 1


@wp.func
def check_pixel(grid: Grid, x: float, y: float, faults: wp.array(dtype=int)):
    """Do nothing: compensated events may lie outside the image."""
    return


@wp.func
def event_of(
    grid: Grid, windows: wp.array2d(dtype=wp.int64), x: wp.array(dtype=Any), y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64), faults: wp.array(dtype=int), window: int, thread: int,
) -> int:  # fmt: skip
    """Return the event of a thread, or -1 if there is none.

    Check that it is not earlier than the one before, and lies in the image if it is of a sensor.
    """
    i = first_event(windows, window, thread / BLOCK) + thread % BLOCK
    if wp.int64(i) >= windows[window, STOP]:
        return -1
    if wp.int64(i) > windows[window, START]:
        if t[i] < t[i - 1]:
            faults[DESCENDING] = 1
    check_pixel(grid, x[i], y[i], faults)
    return i


@wp.func
def group_of(grid: Grid, windows: wp.array2d(dtype=wp.int64), window: int, t: wp.int64) -> int:
    """Return the number of the group of images for a time."""
    return group_at(grid, window, time_at(grid, windows[window, T_START], windows[window, SPAN], t))


@wp.func
def group_at(grid: Grid, window: int, time: wp.float64) -> int:
    """Return the number of the group of images for a time in units of the window's intervals."""
    interval = interval_of(grid, time)
    part = int((time - wp.float64(interval)) * wp.float64(grid.parts))
    return (window * grid.steps + interval) * grid.parts + wp.min(part, grid.parts - 1)


@wp.func
def count_event(
    grid: Grid, part: Part, own: int, windows: wp.array2d(dtype=wp.int64), window: int, i: int,
    x: wp.array(dtype=Any), y: wp.array(dtype=Any), t: wp.array(dtype=wp.int64), p: wp.array(dtype=wp.uint8),
    counts: wp.array(dtype=int),
):  # fmt: skip
    """Count an event at its nearest pixel. ``own``: group that the part's spare group replaces, or -1."""
    col, row = nearest(x[i]), nearest(y[i])
    if is_pixel(grid, col, row) == 1:
        group = group_of(grid, windows, window, t[i])
        wp.atomic_add(counts, place_of(grid, wp.where(group == own, part.spare, group), p[i], col, row), 1)


@wp.kernel
def count_events(
    x: wp.array(dtype=Any), y: wp.array(dtype=Any), t: wp.array(dtype=wp.int64), p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part, faults: wp.array(dtype=int),
    counts: wp.array(dtype=int),
):  # fmt: skip
    """Count the event of each thread at its nearest pixel."""
    window = window_of(windows, wp.tid() / BLOCK)
    i = event_of(grid, windows, x, y, t, faults, window, wp.tid())
    if i >= 0:
        count_event(grid, part, -1, windows, window, i, x, y, t, p, counts)


@wp.kernel
def keep_latest(
    x: wp.array(dtype=Any), y: wp.array(dtype=Any), t: wp.array(dtype=wp.int64), p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part, faults: wp.array(dtype=int),
    latest: wp.array(dtype=wp.int64),
):  # fmt: skip
    """Keep the time of each thread's event at its nearest pixel, if it is the latest."""
    window = window_of(windows, wp.tid() / BLOCK)
    i = event_of(grid, windows, x, y, t, faults, window, wp.tid())
    if i >= 0:
        col, row = nearest(x[i]), nearest(y[i])
        if is_pixel(grid, col, row) == 1:
            wp.atomic_max(latest, place_of(grid, window * grid.steps, p[i], col, row), t[i])


@wp.func
def word_of(grid: Grid, weight: int, end: int) -> wp.int64:
    """Return the word of an event, by its sign and its share of the interval's end in units of 2**-30."""
    drop = 94 - 2 * grid.low
    share = (end + ((1 << drop) >> 1)) >> drop
    word = (wp.int64(1) << wp.int64(grid.low)) + wp.int64(share)
    return wp.where(weight < 0, -word, word)


@wp.func
def add_event_word(
    grid: Grid, part: Part, own: int, windows: wp.array2d(dtype=wp.int64), window: int, i: int,
    x: wp.array(dtype=wp.uint16), y: wp.array(dtype=wp.uint16), t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8), words: wp.array(dtype=wp.int64),
):  # fmt: skip
    """Add the word of an event. ``own``: group that the part's spare group replaces, or -1."""
    col, row = int(x[i]), int(y[i])
    if is_pixel(grid, col, row) == 1:
        time = time_at(grid, windows[window, T_START], windows[window, SPAN], t[i])
        group = group_at(grid, window, time)
        place = place_of(grid, wp.where(group == own, part.spare, group), p[i], col, row)
        wp.atomic_add(words, place, word_of(grid, weight_of(grid, p[i]), end_share(time, interval_of(grid, time))))


@wp.kernel
def add_event_words(
    x: wp.array(dtype=wp.uint16), y: wp.array(dtype=wp.uint16), t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8), windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part,
    faults: wp.array(dtype=int), words: wp.array(dtype=wp.int64),
):  # fmt: skip
    """Add the word of each thread's event."""
    window = window_of(windows, wp.tid() / BLOCK)
    i = event_of(grid, windows, x, y, t, faults, window, wp.tid())
    if i >= 0:
        add_event_word(grid, part, -1, windows, window, i, x, y, t, p, words)


@wp.func
def add_parts(sums: wp.array(dtype=wp.int64), place: int, weight: int, part: wp.float64, end: int):
    """Add the parts of an event's two shares that belong to a pixel."""
    first, second = part_of(WHOLE - end, part), part_of(end, part)
    if first != 0:
        wp.atomic_add(sums, place, wp.int64(weight * first))
    if second != 0:
        wp.atomic_add(sums, place + 1, wp.int64(weight * second))


@wp.kernel
def share_events(
    x: wp.array(dtype=Any), y: wp.array(dtype=Any), t: wp.array(dtype=wp.int64), p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part, faults: wp.array(dtype=int),
    sums: wp.array(dtype=wp.int64),
):  # fmt: skip
    """Share the event of each thread among the four nearest pixels and the two ends of its time interval."""
    window = window_of(windows, wp.tid() / BLOCK)
    i = event_of(grid, windows, x, y, t, faults, window, wp.tid())
    if i >= 0:
        u, v = float(x[i]), float(y[i])
        if is_near(grid, u, v) == 1:
            time = time_at(grid, windows[window, T_START], windows[window, SPAN], t[i])
            interval = interval_of(grid, time)
            end, weight = end_share(time, interval), weight_of(grid, p[i])
            col, row = wp.floor(u), wp.floor(v)
            right, below = wp.float64(u - col), wp.float64(v - row)
            left, above = wp.float64(1.0) - right, wp.float64(1.0) - below
            place = 2 * place_of(grid, window * grid.steps + interval, p[i], int(col), int(row))
            under = place + 2 * (grid.width + 2 * grid.border)
            add_parts(sums, place, weight, left * above, end)
            add_parts(sums, place + 2, weight, right * above, end)
            add_parts(sums, under, weight, left * below, end)
            add_parts(sums, under + 2, weight, right * below, end)


# On a CPU: one block per thread. Loops of constant length without branches become vector code, so each block is copied
# to local arrays of 64 elements.


@wp.func
def own_group(grid: Grid, windows: wp.array2d(dtype=wp.int64), t: wp.array(dtype=wp.int64), part: Part) -> int:
    """Return the group that a part's spare group replaces, or -1."""
    if part.spare < 0:
        return -1
    window = window_of(windows, part.block)
    return group_of(grid, windows, window, t[first_event(windows, window, part.block)])


@wp.kernel
def find_own(
    t: wp.array(dtype=wp.int64), windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part, own: wp.array(dtype=int)
):
    """Find the group that a part's spare group replaces."""
    own[0] = own_group(grid, windows, t, part)


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
def copy_positions(out: wp.array(dtype=float), values: wp.array(dtype=wp.uint16), first: int, n: int):
    """Copy the coordinates of the pixels of a block."""
    for k in range(n):
        out[k] = float(values[first + k])


@wp.func
def check_pixels(
    grid: Grid, x: wp.array(dtype=wp.uint16), y: wp.array(dtype=wp.uint16), first: int, stop: int,
    faults: wp.array(dtype=int),
):  # fmt: skip
    """Check that the pixels of a sensor's events lie in the image."""
    if is_pixel(grid, largest_of(x, first, stop), largest_of(y, first, stop)) == 0:
        faults[OUTSIDE] = 1


@wp.func
def check_pixels(
    grid: Grid, x: wp.array(dtype=float), y: wp.array(dtype=float), first: int, stop: int,
    faults: wp.array(dtype=int),
):  # fmt: skip
    """Do nothing: compensated events may lie outside the image."""
    return


@wp.func
def start_block(
    grid: Grid, windows: wp.array2d(dtype=wp.int64), block: int, x: wp.array(dtype=Any), y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64), faults: wp.array(dtype=int),
):  # fmt: skip
    """Return the window of a block, its first event and the number of its events.

    Check that no event is earlier than the one before in the window, and that those of a sensor lie in the image.
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
    grid: Grid, part: Part, own: int, windows: wp.array2d(dtype=wp.int64), window: int, t: wp.array(dtype=wp.int64),
    groups: wp.array(dtype=int), ends: wp.array(dtype=int),
):  # fmt: skip
    """Compute the group of images of each event of a block, and its share of the end of its interval."""
    t_start, span, first_group = windows[window, T_START], windows[window, SPAN], window * grid.steps
    for k in range(BLOCK):
        time = time_at(grid, t_start, span, load_int64(t, k))
        interval = interval_of(grid, time)
        store_int(groups, k, wp.where(first_group + interval == own, part.spare, first_group + interval))
        store_int(ends, k, end_share(time, interval))


@wp.func
def place_or_trash(grid: Grid, part: Part, group: int, p: wp.uint8, x: int, y: int) -> int:
    """Return the number of a pixel in the images of a group, or that of the part's trash."""
    return wp.where(is_pixel(grid, x, y) == 1, place_of(grid, group, p, x, y), part.trash)


# The types of the places are stated, because a generic function would take those of its first call for all calls.


@wp.func
def place_interval(
    grid: Grid, part: Part, group: int, first: int, x: wp.array(dtype=wp.uint16), y: wp.array(dtype=wp.uint16),
    p: wp.array(dtype=wp.uint8), places: wp.array(dtype=int), at: int,
):  # fmt: skip
    """Compute the pixel of each event of a whole block in one time interval, from ``places[at]`` on."""
    for k in range(BLOCK):
        col, row = load_nearest(x, first + k), load_nearest(y, first + k)
        store_int(places, at + k, place_or_trash(grid, part, group, load_uint8(p, first + k), col, row))


@wp.func
def place_interval(
    grid: Grid, part: Part, group: int, first: int, x: wp.array(dtype=float), y: wp.array(dtype=float),
    p: wp.array(dtype=wp.uint8), places: wp.array(dtype=int), at: int,
):  # fmt: skip
    """Compute the nearest pixel of each event of a whole block in one time interval, from ``places[at]`` on."""
    for k in range(BLOCK):
        col, row = load_nearest(x, first + k), load_nearest(y, first + k)
        store_int(places, at + k, place_or_trash(grid, part, group, load_uint8(p, first + k), col, row))


@wp.func
def store_parts(shares: wp.array(dtype=wp.int64), k: int, weight: int, part: wp.float64, end: int):
    """Store the parts of an event's two shares that belong to a pixel."""
    store_int64(shares, k, wp.int64(weight * part_of(WHOLE - end, part)))
    store_int64(shares, k + 1, wp.int64(weight * part_of(end, part)))


@wp.func
def position_block(
    grid: Grid, part: Part, x: wp.array(dtype=float), y: wp.array(dtype=float), p: wp.array(dtype=wp.uint8),
    groups: wp.array(dtype=int), ends: wp.array(dtype=int), places: wp.array(dtype=int),
    shares: wp.array(dtype=wp.int64),
):  # fmt: skip
    """Compute the eight shares of each event of a block, and the place of the first two."""
    for k in range(BLOCK):
        inside = is_near(grid, load_float(x, k), load_float(y, k))
        u, v = wp.where(inside == 1, load_float(x, k), 0.0), wp.where(inside == 1, load_float(y, k), 0.0)
        col, row = wp.floor(u), wp.floor(v)
        right, below = wp.float64(u - col), wp.float64(v - row)
        left, above = wp.float64(1.0) - right, wp.float64(1.0) - below
        weight, end = inside * weight_of(grid, load_uint8(p, k)), load_int(ends, k)
        place = 2 * place_of(grid, load_int(groups, k), load_uint8(p, k), int(col), int(row))
        store_int(places, k, wp.where(inside == 1, place, 2 * part.trash))
        store_parts(shares, 8 * k, weight, left * above, end)
        store_parts(shares, 8 * k + 2, weight, right * above, end)
        store_parts(shares, 8 * k + 4, weight, left * below, end)
        store_parts(shares, 8 * k + 6, weight, right * below, end)


@wp.kernel
def count_event_blocks(
    x: wp.array(dtype=Any), y: wp.array(dtype=Any), t: wp.array(dtype=wp.int64), p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part, faults: wp.array(dtype=int),
    counts: wp.array(dtype=int),
):  # fmt: skip
    """Count the events of each thread's block at their nearest pixels."""
    window, first, n = start_block(grid, windows, part.block + wp.tid(), x, y, t, faults)
    own, group = own_group(grid, windows, t, part), group_of(grid, windows, window, t[first])
    if n == BLOCK and group == group_of(grid, windows, window, t[first + n - 1]):
        places = wp.zeros(shape=(64,), dtype=int)
        place_interval(grid, part, wp.where(group == own, part.spare, group), first, x, y, p, places, 0)
        count_places(counts, places, n)
    else:
        for k in range(n):
            count_event(grid, part, own, windows, window, first + k, x, y, t, p, counts)


@wp.kernel
def keep_latest_blocks(
    x: wp.array(dtype=Any), y: wp.array(dtype=Any), t: wp.array(dtype=wp.int64), p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part, faults: wp.array(dtype=int),
    latest: wp.array(dtype=wp.int64),
):  # fmt: skip
    """Keep the latest times of the events of each thread's block at their nearest pixels."""
    window, first, n = start_block(grid, windows, part.block + wp.tid(), x, y, t, faults)
    own, group = own_group(grid, windows, t, part), window * grid.steps
    used = wp.where(group == own, part.spare, group)
    for k in range(first, first + n):
        col, row = nearest(x[k]), nearest(y[k])
        if is_pixel(grid, col, row) == 1:
            wp.atomic_max(latest, place_of(grid, used, p[k], col, row), t[k])


@wp.func
def store_interval_words(
    grid: Grid, part: Part, own: int, windows: wp.array2d(dtype=wp.int64), window: int, group: int, first: int,
    x: wp.array(dtype=wp.uint16), y: wp.array(dtype=wp.uint16), t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8), places: wp.array(dtype=int), words: wp.array(dtype=wp.int64), at: int,
):  # fmt: skip
    """Store the places and words of a whole block's events in one group, as most are. Times are from the first event.

    The sums and products are whole numbers below 2**53, so that a share is the same as from :func:`time_at`.
    """
    prefetch_events(x, y, t, p, first + AHEAD)
    used = wp.where(group == own, part.spare, group)
    interval, t_first = group / grid.parts - window * grid.steps, t[first]
    start, span = wp.float64((t_first - windows[window, T_START]) * wp.int64(grid.rate)), windows[window, SPAN]
    place_interval(grid, part, used, first, x, y, p, places, at)
    for k in range(BLOCK):
        elapsed = wp.float64(int(load_int64(t, first + k) - t_first)) * wp.float64(grid.rate)
        end = end_share(in_intervals(grid, start + elapsed, wp.float64(span)), interval)
        store_int64(words, at + k, word_of(grid, weight_of(grid, load_uint8(p, first + k)), end))


@wp.kernel
def add_event_word_blocks(
    x: wp.array(dtype=wp.uint16), y: wp.array(dtype=wp.uint16), t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8), windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part,
    faults: wp.array(dtype=int), words: wp.array(dtype=wp.int64),
):  # fmt: skip
    """Add the words of the events of each thread's blocks. Those of a block are added after the next one's are known.

    Meanwhile, the pixels are fetched from memory: an image is larger than a core's cache.
    """
    places = wp.zeros(shape=(128,), dtype=int)
    waiting = wp.zeros(shape=(128,), dtype=wp.int64)
    own = own_group(grid, windows, t, part)
    at, before = int(0), int(0)
    first_block = part.block + wp.tid() * RUN
    for block in range(first_block, wp.min(first_block + RUN, part.stop)):
        window, first, n = start_block(grid, windows, block, x, y, t, faults)
        group = group_of(grid, windows, window, t[first])
        t_last = t[first + n - 1]
        if n == BLOCK and group == group_of(grid, windows, window, t_last) and t_last - t[first] < LONGEST:
            store_interval_words(
                grid, part, own, windows, window, group, first, x, y, t, p, places, waiting, at)  # fmt: skip
            prefetch_words(words, places, at, BLOCK)
            at = BLOCK - at
            add_words(words, places, waiting, at, before)
            before = BLOCK
        else:
            for k in range(n):
                add_event_word(grid, part, own, windows, window, first + k, x, y, t, p, words)
    add_words(words, places, waiting, BLOCK - at, before)


@wp.kernel
def share_event_blocks(
    x: wp.array(dtype=Any), y: wp.array(dtype=Any), t: wp.array(dtype=wp.int64), p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64), grid: Grid, part: Part, faults: wp.array(dtype=int),
    sums: wp.array(dtype=wp.int64),
):  # fmt: skip
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
    own = own_group(grid, windows, t, part)
    copy_positions(us, x, first, n)
    copy_positions(vs, y, first, n)
    time_block(grid, part, own, windows, window, times, groups, ends)
    position_block(grid, part, us, vs, signs, groups, ends, places, shares)
    add_squares(sums, places, shares, 2 * (grid.width + 2 * grid.border), n)


for _coordinate in (wp.uint16, wp.float32):
    for _kernel in (
        count_events, keep_latest, share_events, count_event_blocks, keep_latest_blocks, share_event_blocks,
    ):  # fmt: skip
        wp.overload(_kernel, {"x": wp.array(dtype=_coordinate), "y": wp.array(dtype=_coordinate)})


# From sums to tensors. A CPU thread computes a row of an image, a GPU thread a pixel: ``length`` pixels.


@wp.func
def pixel_sum(grid: Grid, sums: wp.array(dtype=wp.int64), group: int, layer: int, y: int, x: int, end: int) -> wp.int64:
    """Return one of the two sums of a pixel: ``end`` is 1 for the share of the interval's end, else 0."""
    row = (group * grid.layers + layer) * (grid.height + 2 * grid.border) + y + grid.border
    return load_int64(sums, 2 * (row * (grid.width + 2 * grid.border) + x + grid.border) + end)


@wp.kernel
def read_shares(
    sums: wp.array(dtype=wp.int64), grid: Grid, bins: int, length: int, start: int, out: wp.array(dtype=float)
):
    """Compute the bins of windows from the sums: those of the interval that starts there, and of the one that ends."""
    first = (start + wp.tid()) * length
    x, y = first % grid.width, (first / grid.width) % grid.height
    channel = first / (grid.width * grid.height)
    bin_of, layer, window = channel % bins, (channel / bins) % grid.layers, channel / bins / grid.layers
    group = window * grid.steps + bin_of
    for k in range(length):
        total = wp.int64(0)
        if bin_of < grid.steps:
            total += pixel_sum(grid, sums, group, layer, y, x + k, 0)
        if bin_of > 0:
            total += pixel_sum(grid, sums, group - 1, layer, y, x + k, 1)
        store_float(out, first + k, float(wp.float64(total) / wp.float64(WHOLE)))


@wp.kernel
def read_bins(
    words: wp.array(dtype=wp.int64), grid: Grid, bins: int, length: int, start: int, out: wp.array(dtype=float)
):
    """Compute all bins of ``length`` pixels of a window from their words, which are cleared on CPUs."""
    first = (start + wp.tid()) * length
    size = grid.width * grid.height
    window, pixel = first / size, first % size
    start_of = window * grid.steps * grid.parts * size + pixel
    read_words(out, window * bins * size + pixel, words, grid.low, start_of, size, grid.steps, grid.parts, bins, length)


@wp.kernel
def clip_counts(
    counts: wp.array(dtype=int), grid: Grid, limit: int, length: int, start: int, out: wp.array(dtype=wp.uint8)
):
    """Compute stacked histograms from the counts: the time bins of OFF events, then those of ON events."""
    first = (start + wp.tid()) * length
    size = grid.width * grid.height
    channel = first / size
    bin_of, layer = channel % grid.steps, (channel / grid.steps) % grid.layers
    image = (channel / grid.steps / grid.layers * grid.steps + bin_of) * grid.layers + layer
    for k in range(length):
        store_uint8(out, first + k, wp.min(load_int(counts, image * size + first % size + k), limit))


@wp.kernel
def carry_latest(
    latest: wp.array(dtype=wp.int64), windows: int, size: int, earlier: wp.array(dtype=wp.int64), start: int
):
    """Carry the latest times of earlier windows over to later ones, one pixel per thread."""
    pixel = start + wp.tid()
    before = earlier[pixel]
    for window in range(windows):
        before = wp.max(before, latest[window * size + pixel])
        latest[window * size + pixel] = before


@wp.kernel
def decay_times(
    latest: wp.array(dtype=wp.int64), t_end: wp.array(dtype=wp.int64), size: int, tau: wp.float64, linear: int,
    start: int, out: wp.array(dtype=float),
):  # fmt: skip
    """Compute the time surface: by exponential or linear decay of the latest times until the window's end."""
    i = start + wp.tid()
    age = wp.float64(wp.max(t_end[i / size] - latest[i], wp.int64(0))) / tau
    value = wp.where(linear == 1, wp.max(wp.float64(1.0) - age, wp.float64(0.0)), wp.exp(-age))
    out[i] = wp.where(latest[i] < EARLIEST, 0.0, float(value))


# Mean and standard deviation of the cells that are not zero.


@wp.func
def moments_of(value: wp.float64) -> wp.vec3d:
    """Return 1, the value and its square, or zeros if it is zero."""
    return wp.vec3d(wp.where(value != wp.float64(0.0), wp.float64(1.0), wp.float64(0.0)), value, value * value)


@wp.kernel
def sum_moments(values: wp.array2d(dtype=float), length: int, sums: wp.array2d(dtype=wp.vec3d)):
    """Sum the moments of ``length`` values of a row per thread, in order."""
    row, part = wp.tid()
    total = wp.vec3d()
    for k in range(part * length, wp.min((part + 1) * length, values.shape[1])):
        total += moments_of(wp.float64(values[row, k]))
    sums[row, part] = total


@wp.kernel
def add_moments(sums: wp.array2d(dtype=wp.vec3d), length: int, out: wp.array2d(dtype=wp.vec3d)):
    """Add up ``length`` sums of a row per thread, in order."""
    row, part = wp.tid()
    total = wp.vec3d()
    for k in range(part * length, wp.min((part + 1) * length, sums.shape[1])):
        total += sums[row, k]
    out[row, part] = total


@wp.kernel
def normalise(moments: wp.array2d(dtype=wp.vec3d), values: wp.array2d(dtype=float)):
    """Shift and scale the values of a row that are not zero to a mean of 0 and a standard deviation of 1.

    The standard deviation has n - 1 degrees of freedom. If it is 0, or there is only one value, only the mean is
    subtracted.
    """
    row, k = wp.tid()
    value = values[row, k]
    if value != 0.0:
        m = moments[row, 0]
        mean = m[1] / m[0]
        variance = wp.max(m[2] - m[1] * mean, wp.float64(0.0)) / wp.max(m[0] - wp.float64(1.0), wp.float64(1.0))
        deviation = wp.where(variance > wp.float64(0.0), wp.sqrt(variance), wp.float64(1.0))
        values[row, k] = float((wp.float64(value) - mean) / deviation)
