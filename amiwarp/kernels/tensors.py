"""Event representations for networks: voxel grids, histograms, and latest times.

A launch adds the events of many windows. A window has a group of images for each of its time intervals, or for each
part of them: one image, or one for OFF and one for ON events. Sums are integers, so that they depend neither on the
order of events nor on the number of threads.

A voxel grid shares each event between the bins at both ends of its time interval, so a pixel of an image holds two
sums. At whole pixels, one 64-bit word holds both: the sum of the events' signs, and in its lower ``low`` bits the sum
of the shares of the interval's end, in units of 2**(64 - 2 * low) event. The addition is modulo 2**64. No field
overflows if fewer than 2**(63 - low) events are added to an image, so an interval with more events is cut into parts
with an image each. If that is not possible, and at positions between pixels, a pixel has two 64-bit sums in units of
2**-30 event: the shares of the interval's start, and the shares of its end.

A block is 64 events of one window. A GPU thread processes one event, a CPU thread a block, or a run of blocks for
words. On a CPU, each slice of the blocks adds to groups that no other slice adds to. Times ascend, so a slice can share
only its first group with the slice before. A spare group replaces it, and is added to it later.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


BLOCK = wp.constant(64)  # number of events of a block
RUN = wp.constant(8)  # number of blocks whose words a CPU thread adds

# Number of events from a block to those that are fetched from memory meanwhile
AHEAD = wp.constant(256)
WHOLE = wp.constant(1 << 30)  # share of a whole event

# Limit of the times of events [us]; without events, a pixel holds less
EARLIEST = wp.constant(wp.int64(-(2**62)))

# Time of a block from which it is not processed at once [us]
LONGEST = wp.constant(wp.int64(1 << 31))

# Numbers of the array of faults, of which each becomes 1 if the fault occurs.
DESCENDING = wp.constant(0)  # an event is earlier than the one before in its window
OUTSIDE = wp.constant(1)  # an event of a sensor lies outside the image; compensated events may

# Columns of the array of windows, which has a row for each window.
START = wp.constant(0)  # index of the first event
STOP = wp.constant(1)  # index after the last event
FIRST_BLOCK = wp.constant(2)  # number of the first block
T_START = wp.constant(3)  # start of the time span [us]
SPAN = wp.constant(4)  # length of the time span [us], at least 1
T_END = wp.constant(5)  # end of the time span [us]


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
    grid: Grid,
    windows: wp.array2d(dtype=wp.int64),
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    faults: wp.array(dtype=int),
    window: int,
    thread: int,
) -> int:
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
    grid: Grid,
    part: Part,
    replaced: int,
    windows: wp.array2d(dtype=wp.int64),
    window: int,
    i: int,
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    counts: wp.array(dtype=int),
):
    """Count an event at its nearest pixel. ``replaced``: group that the part's spare group replaces, or -1."""
    col, row = nearest(x[i]), nearest(y[i])
    if is_pixel(grid, col, row) == 1:
        group = group_of(grid, windows, window, t[i])
        written_group = wp.where(group == replaced, part.spare, group)
        wp.atomic_add(counts, place_of(grid, written_group, p[i], col, row), 1)


@wp.func
def word_of(grid: Grid, weight: int, end: int) -> wp.int64:
    """Return the word of an event, by its sign and its share of the interval's end in units of 2**-30."""
    drop = 94 - 2 * grid.low
    share = (end + ((1 << drop) >> 1)) >> drop
    word = (wp.int64(1) << wp.int64(grid.low)) + wp.int64(share)
    return wp.where(weight < 0, -word, word)


@wp.func
def add_event_word(
    grid: Grid,
    part: Part,
    replaced: int,
    windows: wp.array2d(dtype=wp.int64),
    window: int,
    i: int,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    words: wp.array(dtype=wp.int64),
):
    """Add the word of an event. ``replaced``: group that the part's spare group replaces, or -1."""
    col, row = int(x[i]), int(y[i])
    if is_pixel(grid, col, row) == 1:
        time = time_at(grid, windows[window, T_START], windows[window, SPAN], t[i])
        group = group_at(grid, window, time)
        written_group = wp.where(group == replaced, part.spare, group)
        place = place_of(grid, written_group, p[i], col, row)
        wp.atomic_add(
            words,
            place,
            word_of(grid, weight_of(grid, p[i]), end_share(time, interval_of(grid, time))),
        )
