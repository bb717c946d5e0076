"""Filter of a stream of events: one pass finds for each event the first part of the filter that removes it."""

import warp as wp

from amiwarp.kernels.background_activity import never
from amiwarp.kernels.event_arrays import EventArrays, store_event
from amiwarp.kernels.native_code import (
    load_int,
    load_int64,
    load_one_int,
    load_uint8,
    load_uint16,
    prefetch_int,
    store_int,
    store_int64,
    store_uint8,
)

wp.set_module_options({"enable_backward": False})

# The parts in the order in which they are applied. An event that is kept has the number 0
WINDOW = wp.constant(1)
REGION = wp.constant(2)
POLARITY = wp.constant(3)
HOT_PIXELS = wp.constant(4)
REFRACTORY = wp.constant(5)
BACKGROUND = wp.constant(6)
RATE = wp.constant(7)
EVERY = wp.constant(8)

AHEAD = wp.constant(16)
"""Number of events after which the times of a pixel that are fetched now are needed."""
LONGEST_US = 1_000_000_000
"""Longest refractory period, and longest time of the background [us]."""
LONG_AGO = wp.constant(-1_100_000_000)
"""Time of a pixel without events, or whose last one matters no longer, from the base [us]."""
MOST_AFTER_BASE = wp.constant(wp.int64(1_000_000_000))
"""Longest time from the base before it is moved [us]. The difference of two times then fits into 32 bits."""


@wp.struct
class FilterParts:
    """Values of the parts of a filter."""

    columns: int  # width of the sensor [px]
    start: wp.int64  # kept time [us], end exclusive
    end: wp.int64
    left: int  # kept region [px], right and bottom exclusive
    top: int
    right: int
    bottom: int
    polarity: int  # -1: both
    hot: wp.array(dtype=wp.uint8)  # a bit for each pixel, row by row; empty: none
    refractory_us: int  # 0: none
    background_us: int  # 0: none
    rate_per_us: wp.float64  # 0: no limit
    most_credit: wp.float64
    every: int


@wp.struct
class FilterState:
    """What a filter remembers of the events before."""

    passed_t: wp.array(dtype=int)
    """Time of the last event of each pixel that all parts before the background passed [us], after `base_t`.

    With a border of a pixel, at `across[column + 1] + down[row + 1]`: in tiles, of which each fills a line of a core's
    cache, so that a pixel and its neighbours lie in few lines."""
    base_t: wp.array(dtype=wp.int64)
    across: wp.array(dtype=int)
    down: wp.array(dtype=int)
    removed: wp.array(dtype=wp.int64)  # number of events that each part removed, at its number
    hot_counts: wp.array(dtype=wp.int64)  # number of removed events of each hot pixel
    credit: wp.array(dtype=wp.float64)  # number of events that the rate allows at once
    rate_t: wp.array(dtype=wp.int64)  # time of the last event at which the credit grew [us]
    reached: wp.array(dtype=wp.int64)  # number of events that reached the last part


@wp.func
def is_over_rate(parts: FilterParts, state: FilterState, t: wp.int64) -> bool:
    """Return whether an event exceeds the rate. Each other one costs a credit of 1, which grows with time."""
    last = state.rate_t[0]
    if last != never():
        grown = state.credit[0] + parts.rate_per_us * wp.float64(t - last)
        state.credit[0] = wp.min(parts.most_credit, grown)
    state.rate_t[0] = t
    if state.credit[0] < wp.float64(1.0):
        return True
    state.credit[0] = state.credit[0] - wp.float64(1.0)
    return False


@wp.func
def is_left_out(parts: FilterParts, state: FilterState) -> bool:
    """Return whether an event is not one of every n-th of those that are left."""
    number = state.reached[0]
    state.reached[0] = number + wp.int64(1)
    return number % wp.int64(parts.every) != wp.int64(0)


@wp.func
def is_hot(parts: FilterParts, pixel: int) -> bool:
    """Return whether a pixel is hot."""
    eight = int(load_uint8(parts.hot, pixel >> 3))
    return ((eight >> (pixel & 7)) & 1) != 0


@wp.func
def removed_before_times(parts: FilterParts, x: int, y: int, t: wp.int64, p: int) -> int:
    """Return the number of the first part that removes an event, of those without a memory; 0 for none."""
    if t < parts.start or t >= parts.end:
        return WINDOW
    if x < parts.left or x >= parts.right or y < parts.top or y >= parts.bottom:
        return REGION
    if parts.polarity >= 0 and p != parts.polarity:
        return POLARITY
    if parts.hot.shape[0] > 0 and is_hot(parts, y * parts.columns + x):
        return HOT_PIXELS
    return 0


@wp.func
def latest_of_two(latest: wp.array(dtype=int), first: int, second: int) -> int:
    """Return the later one of the times at two places [us]."""
    return wp.max(load_one_int(latest, first), load_one_int(latest, second))


@wp.func
def removed_by_times(parts: FilterParts, state: FilterState, x: int, y: int, t: int) -> int:
    """Return whether the refractory period or the background removes an event, as the number of the part; 0: none.

    ``t`` counts from the base. Without branches, which would often be mispredicted.
    """
    middle = load_int(state.across, x + 1)
    row = load_int(state.down, y + 1)
    last = load_int(state.passed_t, row + middle)
    is_early = t - last < parts.refractory_us
    number = wp.where(is_early, REFRACTORY, 0)
    if parts.background_us > 0:
        left = load_int(state.across, x)
        right = load_int(state.across, x + 2)
        above = load_int(state.down, y)
        below = load_int(state.down, y + 2)
        at_left = latest_of_two(state.passed_t, above + left, below + left)
        at_middle = latest_of_two(state.passed_t, above + middle, below + middle)
        at_right = latest_of_two(state.passed_t, above + right, below + right)
        beside = latest_of_two(state.passed_t, row + left, row + right)
        near = wp.max(wp.max(at_left, at_middle), wp.max(at_right, beside))
        is_alone = t - near > parts.background_us
        number = wp.where(is_early, REFRACTORY, wp.where(is_alone, BACKGROUND, 0))
    store_int(state.passed_t, row + middle, wp.where(is_early, last, t))
    return number


@wp.func
def removed_by(
    parts: FilterParts, state: FilterState, x: int, y: int, t: wp.int64, p: int, base_t: wp.int64
) -> int:
    """Return the number of the first part that removes an event, 0 for none."""
    first = removed_before_times(parts, x, y, t, p)
    if first > 0:
        if first == HOT_PIXELS:
            pixel = y * parts.columns + x
            state.hot_counts[pixel] = state.hot_counts[pixel] + wp.int64(1)
        return first
    number = int(0)
    if state.passed_t.shape[0] > 0:
        number = removed_by_times(parts, state, x, y, int(t - base_t))
    if parts.rate_per_us > wp.float64(0.0):
        if number == 0 and is_over_rate(parts, state, t):
            number = RATE
    if parts.every > 1:
        if number == 0 and is_left_out(parts, state):
            number = EVERY
    return number


@wp.func
def prefetch_pixel(parts: FilterParts, state: FilterState, x: int, y: int):
    """Fetch the times that an event of a pixel will need: a large sensor's do not fit into a core's cache."""
    if state.passed_t.shape[0] > 0:
        middle = load_int(state.across, x + 1)
        row = load_int(state.down, y + 1)
        prefetch_int(state.passed_t, row + middle)
    if parts.background_us > 0:
        left = load_int(state.across, x)
        right = load_int(state.across, x + 2)
        above = load_int(state.down, y)
        below = load_int(state.down, y + 2)
        prefetch_int(state.passed_t, above + left)
        prefetch_int(state.passed_t, below + right)


@wp.func
def move_base(parts: FilterParts, state: FilterState, t: wp.int64):
    """Count the times of all pixels from the time ``t`` on. Times that matter no longer become `LONG_AGO`."""
    longest = wp.max(parts.refractory_us, parts.background_us)
    passed = t - state.base_t[0]
    for i in range(state.passed_t.shape[0]):
        age = passed - wp.int64(state.passed_t[i])
        state.passed_t[i] = wp.where(age > wp.int64(longest), LONG_AGO, -int(age))
    state.base_t[0] = t


@wp.kernel
def filter_events(
    parts: FilterParts,
    state: FilterState,
    given: EventArrays,
    kept: EventArrays,
    kept_count: wp.array(dtype=int),
    removing: wp.array(dtype=wp.uint8),
    count: int,
):
    """Find the part that removes each of the first events, and copy the kept ones one after the other.

    One thread passes over them, in their order.
    """
    i = int(0)  # a while loop takes fewer instructions than a range
    end = int(0)
    base_t = state.base_t[0]
    while i < count:
        later = wp.min(i + AHEAD, count - 1)
        prefetch_pixel(
            parts, state, int(load_uint16(given.x, later)), int(load_uint16(given.y, later))
        )
        column = int(load_uint16(given.x, i))
        row = int(load_uint16(given.y, i))
        t = load_int64(given.t, i)
        polarity = int(load_uint8(given.p, i))
        if t - base_t > MOST_AFTER_BASE:
            move_base(parts, state, t)
            base_t = t
        number = removed_by(parts, state, column, row, t, polarity, base_t)
        store_int64(state.removed, number, load_int64(state.removed, number) + wp.int64(1))
        store_uint8(removing, i, number)
        # Always stored, and overwritten by the next event if this one is removed: a branch would often be mispredicted
        store_event(kept, end, wp.uint16(column), wp.uint16(row), t, wp.uint8(polarity))
        end += int(number == 0)
        i += 1
    kept_count[0] = end
