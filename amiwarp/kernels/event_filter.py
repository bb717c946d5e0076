"""Filter of a stream of events: one pass finds for each event the first part of the filter that removes it."""

import warp as wp

from amiwarp.kernels.background_activity import latest_nearby, never
from amiwarp.kernels.native_code import (
    load_int64,
    load_uint8,
    load_uint16,
    prefetch_int64,
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
    hot: wp.array(dtype=wp.uint8)  # 1 for each hot pixel, row by row; empty: none
    refractory_us: wp.int64  # 0: none
    background_us: wp.int64  # 0: none
    rate_per_us: wp.float64  # 0: no limit
    most_credit: wp.float64
    every: int


@wp.struct
class FilterState:
    """What a filter remembers of the events before."""

    kept_t: wp.array(dtype=wp.int64)  # time of the last kept event of each pixel [us]
    fired_t: wp.array(
        dtype=wp.int64
    )  # time of the last event of each pixel [us], with a border of one pixel
    hot_counts: wp.array(dtype=wp.int64)  # number of removed events of each hot pixel
    credit: wp.array(dtype=wp.float64)  # number of events that the rate allows at once
    rate_t: wp.array(dtype=wp.int64)  # time of the last event at which the credit grew [us]
    reached: wp.array(dtype=wp.int64)  # number of events that reached the last part


@wp.func
def is_early(parts: FilterParts, state: FilterState, pixel: int, t: wp.int64) -> bool:
    """Return whether an event is within the refractory period of the last kept one of its pixel."""
    last = load_int64(state.kept_t, pixel)
    if last != never() and t - last < parts.refractory_us:
        return True
    store_int64(state.kept_t, pixel, t)
    return False


@wp.func
def is_background(parts: FilterParts, state: FilterState, x: int, y: int, t: wp.int64) -> bool:
    """Return whether no neighbour of an event's pixel fired shortly before."""
    stride = parts.columns + 2
    pixel = (y + 1) * stride + x + 1
    near = latest_nearby(state.fired_t, pixel, stride)
    store_int64(state.fired_t, pixel, t)
    return near == never() or t - near > parts.background_us


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
def is_hot(parts: FilterParts, state: FilterState, pixel: int) -> bool:
    """Return whether a pixel is hot, and count its event."""
    if load_uint8(parts.hot, pixel) == wp.uint8(0):
        return False
    state.hot_counts[pixel] = state.hot_counts[pixel] + wp.int64(1)
    return True


@wp.func
def removed_by(parts: FilterParts, state: FilterState, x: int, y: int, t: wp.int64, p: int) -> int:
    """Return the number of the first part that removes an event, 0 for none."""
    pixel = y * parts.columns + x
    if t < parts.start or t >= parts.end:
        return WINDOW
    if x < parts.left or x >= parts.right or y < parts.top or y >= parts.bottom:
        return REGION
    if parts.polarity >= 0 and p != parts.polarity:
        return POLARITY
    if parts.hot.shape[0] > 0 and is_hot(parts, state, pixel):
        return HOT_PIXELS
    if parts.refractory_us > wp.int64(0) and is_early(parts, state, pixel, t):
        return REFRACTORY
    if parts.background_us > wp.int64(0) and is_background(parts, state, x, y, t):
        return BACKGROUND
    if parts.rate_per_us > wp.float64(0.0) and is_over_rate(parts, state, t):
        return RATE
    if parts.every > 1 and is_left_out(parts, state):
        return EVERY
    return 0


@wp.func
def prefetch_times(parts: FilterParts, state: FilterState, x: int, y: int):
    """Fetch the times that an event of a pixel will need: a large sensor's do not fit into a core's cache."""
    if parts.refractory_us > wp.int64(0):
        prefetch_int64(state.kept_t, y * parts.columns + x)
    if parts.background_us > wp.int64(0):
        stride = parts.columns + 2
        above = y * stride + x + 1
        prefetch_int64(state.fired_t, above)
        prefetch_int64(state.fired_t, above + stride)
        prefetch_int64(state.fired_t, above + 2 * stride)


@wp.kernel
def find_removing_parts(
    parts: FilterParts,
    state: FilterState,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    removing: wp.array(dtype=wp.uint8),
    count: int,
):
    """Find the part that removes each of the first events. One thread passes over them, in their order."""
    for i in range(count):
        later = wp.min(i + AHEAD, count - 1)
        prefetch_times(parts, state, int(load_uint16(x, later)), int(load_uint16(y, later)))
        column = int(load_uint16(x, i))
        row = int(load_uint16(y, i))
        polarity = int(load_uint8(p, i))
        number = removed_by(parts, state, column, row, load_int64(t, i), polarity)
        store_uint8(removing, i, number)
