"""Kernels on event arrays: checks and conversions, and background activity."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

BEYOND = wp.constant(1 << 16)  # stands for an infinite coordinate among the largest coordinates
TIME_LIMIT = wp.constant(wp.float64(2.0**62))  # amiwarp.events.recording.TIME_LIMIT [us]


@wp.func
def pixel_or_beyond(value: wp.uint16) -> int:
    """Return a sensor's coordinate [px]."""
    return int(value)


@wp.func
def pixel_or_beyond(value: float) -> int:
    """Return BEYOND for an infinite coordinate, else 0: compensated coordinates may be any number, also NaN."""
    return wp.where(wp.isinf(value), BEYOND, 0)


@wp.kernel
def find_limits(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    step: int,
    limits: wp.array(dtype=wp.int64),
):
    """Find first and last time, largest x, y and p, and whether times decrease. Thread k takes every ``step``-th."""
    first = t[wp.tid()]
    last = first
    right, bottom, polarity, decreases = int(0), int(0), int(0), int(0)
    for i in range(wp.tid(), t.shape[0], step):
        first, last = wp.min(first, t[i]), wp.max(last, t[i])
        right = wp.max(right, pixel_or_beyond(x[i]))
        bottom = wp.max(bottom, pixel_or_beyond(y[i]))
        polarity = wp.max(polarity, int(p[i]))
        if t[i] < t[wp.max(i - 1, 0)]:
            decreases = 1
    wp.atomic_min(limits, 0, first)
    wp.atomic_max(limits, 1, last)
    wp.atomic_max(limits, 2, wp.int64(right))
    wp.atomic_max(limits, 3, wp.int64(bottom))
    wp.atomic_max(limits, 4, wp.int64(polarity))
    wp.atomic_max(limits, 5, wp.int64(decreases))


@wp.kernel
def narrow_integers(values: wp.array(dtype=wp.int64), out: wp.array(dtype=wp.uint16), bad: wp.array(dtype=int)):
    """Convert whole coordinates [px], and set ``bad`` if one does not fit."""
    i = wp.tid()
    if values[i] < wp.int64(0) or values[i] > wp.int64(65535):
        bad[0] = 1
    out[i] = wp.uint16(values[i])


@wp.kernel
def narrow_floats(values: wp.array(dtype=wp.float64), out: wp.array(dtype=float), bad: wp.array(dtype=int)):
    """Convert coordinates [px], and set ``bad`` if one becomes infinite."""
    i = wp.tid()
    out[i] = float(values[i])
    if wp.isinf(out[i]):
        bad[0] = 1


@wp.kernel
def round_times(
    values: wp.array(dtype=wp.float64),
    scale: wp.float64,
    latest: wp.float64,
    out: wp.array(dtype=wp.int64),
    bad: wp.array(dtype=int),
):
    """Scale times to microseconds and round them, half to even as NumPy does.

    ``bad`` becomes 3 if a time is not finite or beyond the limit, else 2 if times of scale 1 are not whole, else 1 if
    one is beyond ``latest`` [us].
    """
    i = wp.tid()
    time = values[i] * scale
    rounded = wp.rint(time)
    if not wp.abs(time) < TIME_LIMIT:
        wp.atomic_max(bad, 0, 3)
    else:
        out[i] = wp.int64(rounded)
        if scale == wp.float64(1.0) and rounded != time:
            wp.atomic_max(bad, 0, 2)
        elif wp.abs(time) > latest:
            wp.atomic_max(bad, 0, 1)


@wp.kernel
def narrow_times(values: wp.array(dtype=wp.uint64), out: wp.array(dtype=wp.int64), bad: wp.array(dtype=int)):
    """Convert unsigned times [us], and set ``bad`` if int64 does not hold one."""
    i = wp.tid()
    out[i] = wp.int64(values[i])
    if out[i] < wp.int64(0):
        bad[0] = 1


@wp.kernel
def narrow_polarities(values: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.uint8), first: wp.array(dtype=int)):
    """Convert polarities to 1 if they are 1, else 0, and find where others than 0 and 1 occur.

    ``first``: lowest index of -1, of 0, and of any other number than these and 1; not changed for none.
    """
    i = wp.tid()
    value = values[i]
    out[i] = wp.uint8(wp.where(value == wp.float64(1.0), 1, 0))
    if value == wp.float64(-1.0):
        wp.atomic_min(first, 0, i)
    elif value == wp.float64(0.0):
        wp.atomic_min(first, 1, i)
    elif value != wp.float64(1.0):
        wp.atomic_min(first, 2, i)


@wp.kernel
def flag_events(
    inside: wp.array(dtype=wp.uint8),
    extrapolated: wp.array(dtype=wp.uint8),
    unknown: int,
    flags: wp.array(dtype=wp.uint8),
):
    """Set the flags of amiwarp.compensation.streams. The first ``unknown`` events have no prism angle.

    ``extrapolated``: 1 for each event whose angle is extrapolated; empty for none.
    """
    i = wp.tid()
    flag = 1 - int(inside[i])
    if extrapolated.shape[0] > 0:
        flag += 2 * int(extrapolated[i])
    flags[i] = wp.uint8(wp.where(i < unknown, 5, flag))


@wp.kernel
def join_columns(x: wp.array(dtype=float), y: wp.array(dtype=float), start: int, xy: wp.array2d(dtype=float)):
    """Write coordinates as the rows of one array."""
    i = start + wp.tid()
    xy[i, 0] = x[i]
    xy[i, 1] = y[i]


for _coordinate in (wp.uint16, wp.float32):
    wp.overload(find_limits, {"x": wp.array(dtype=_coordinate), "y": wp.array(dtype=_coordinate)})


# Search for background activity: events without an earlier event at a neighbouring pixel.

NEVER = wp.constant(wp.int64(-(2**63)))  # time of a pixel without events


@wp.func
def latest_nearby(latest: wp.array(dtype=wp.int64), pixel: int, stride: int) -> wp.int64:
    """Return the latest time of the eight neighbours of a pixel [us]."""
    side = wp.max(latest[pixel - 1], latest[pixel + 1])
    above, below = pixel - stride, pixel + stride
    row = wp.max(wp.max(latest[above - 1], latest[above]), latest[above + 1])
    return wp.max(wp.max(side, row), wp.max(wp.max(latest[below - 1], latest[below]), latest[below + 1]))


@wp.kernel
def mark_background(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    window_us: wp.int64,
    stride: int,
    latest: wp.array(dtype=wp.int64),
    background: wp.array(dtype=wp.bool),
):
    """Pass over all events in their order, in one thread. The surface of times has a border of one pixel."""
    for i in range(t.shape[0]):
        pixel = (int(y[i]) + 1) * stride + int(x[i]) + 1
        near = latest_nearby(latest, pixel, stride)
        background[i] = near == NEVER or t[i] - near > window_us
        latest[pixel] = t[i]


@wp.kernel
def mark_refractory(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    period_us: wp.int64,
    columns: int,
    latest: wp.array(dtype=wp.int64),
    early: wp.array(dtype=wp.bool),
):
    """Mark events within a period of the last unmarked one of their pixel. One thread passes over all, in order."""
    for i in range(t.shape[0]):
        pixel = int(y[i]) * columns + int(x[i])
        early[i] = latest[pixel] != NEVER and t[i] - latest[pixel] < period_us
        if not early[i]:
            latest[pixel] = t[i]


@wp.kernel
def mark_hot_pixels(count: wp.array2d(dtype=int), start: int, hot: wp.array(dtype=wp.bool)):
    """Mark pixels that fire far more than the second busiest of the other pixels of the 5 x 5 around them.

    The end of a line has two busy pixels next to it, and two hot pixels side by side have one each.
    """
    i = start + wp.tid()
    row = i / count.shape[1]
    column = i % count.shape[1]
    most = int(0)
    second = int(0)
    for other_row in range(wp.max(row - 2, 0), wp.min(row + 3, count.shape[0])):
        for other_column in range(wp.max(column - 2, 0), wp.min(column + 3, count.shape[1])):
            if other_row != row or other_column != column:
                n = count[other_row, other_column]
                second = wp.max(second, wp.min(most, n))
                most = wp.max(most, n)
    near = float(second)
    hot[i] = float(count[row, column]) > 3.0 * near + 5.0 * wp.sqrt(near) + 8.0


@wp.kernel
def mark_over_rate(
    t: wp.array(dtype=wp.int64),
    rate_per_us: wp.float64,
    most: wp.float64,
    credit: wp.array(dtype=wp.float64),
    last_t: wp.array(dtype=wp.int64),
    over: wp.array(dtype=wp.bool),
):
    """Mark the events that exceed a rate. One thread passes over all, in order.

    Each unmarked event costs a credit of 1, which grows with time up to ``most``.
    """
    for i in range(t.shape[0]):
        if last_t[0] != NEVER:
            credit[0] = wp.min(most, credit[0] + rate_per_us * wp.float64(t[i] - last_t[0]))
        last_t[0] = t[i]
        over[i] = credit[0] < wp.float64(1.0)
        if not over[i]:
            credit[0] -= wp.float64(1.0)


# Times of events on a device.


@wp.kernel
def take_times(
    t: wp.array(dtype=wp.int64), indices: wp.array(dtype=wp.int64), start: int, out: wp.array(dtype=wp.int64)
):
    """Take the times at indices."""
    i = start + wp.tid()
    out[i] = t[int(indices[i])]


@wp.kernel
def find_times(t: wp.array(dtype=wp.int64), times: wp.array(dtype=wp.int64), start: int, out: wp.array(dtype=wp.int64)):
    """Find the index of the first event at or after each time, by bisection."""
    i = start + wp.tid()
    time = times[i]  # may lie in the host's memory
    low = int(0)
    high = int(t.shape[0])
    while low < high:
        middle = low + (high - low) / 2
        if t[middle] < time:
            low = middle + 1
        else:
            high = middle
    out[i] = wp.int64(low)


@wp.kernel
def find_beyond(values: wp.array(dtype=float), most: float, step: int, bad: wp.array(dtype=int)):
    """Find the first value that is NaN or not within ``most`` of 0. Thread k looks at every ``step``-th value."""
    for i in range(wp.tid(), values.shape[0], step):
        if not wp.abs(values[i]) <= most:
            wp.atomic_min(bad, 0, i)
