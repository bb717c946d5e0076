"""Search for background activity: events without an earlier event at a neighbouring pixel; and for hot pixels."""

import warp as wp

wp.set_module_options({"enable_backward": False})

NEVER = wp.constant(wp.int64(-(2**63)))  # time of a pixel without events


@wp.func
def latest_nearby(latest: wp.array(dtype=wp.int64), pixel: int, stride: int) -> wp.int64:
    """Return the latest time of the eight neighbours of a pixel [us]."""
    side = wp.max(latest[pixel - 1], latest[pixel + 1])
    above, below = pixel - stride, pixel + stride
    row = wp.max(wp.max(latest[above - 1], latest[above]), latest[above + 1])
    return wp.max(
        wp.max(side, row), wp.max(wp.max(latest[below - 1], latest[below]), latest[below + 1])
    )


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


@wp.func
def hot_threshold(n: float) -> float:
    """Return the number of events that no pixel has next to one with ``n``: chance adds a few of their square roots."""
    return 3.0 * n + 5.0 * wp.sqrt(n) + 8.0


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
    hot[i] = float(count[row, column]) > hot_threshold(float(second))


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
