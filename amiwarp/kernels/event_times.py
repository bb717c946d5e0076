"""Times of events on a device, and coordinates beyond a limit."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def take_times(
    t: wp.array(dtype=wp.int64),
    indices: wp.array(dtype=wp.int64),
    start: int,
    out: wp.array(dtype=wp.int64),
):
    """Take the times at indices."""
    i = start + wp.tid()
    out[i] = t[int(indices[i])]


@wp.func
def first_at(t: wp.array(dtype=wp.int64), time: wp.int64) -> int:
    """Return the index of the first event at or after a time, by bisection."""
    low = int(0)
    high = int(t.shape[0])
    while low < high:
        middle = low + (high - low) / 2
        if t[middle] < time:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def find_times(
    t: wp.array(dtype=wp.int64),
    times: wp.array(dtype=wp.int64),
    start: int,
    out: wp.array(dtype=wp.int64),
):
    """Find the index of the first event at or after each time, by bisection."""
    i = start + wp.tid()
    out[i] = wp.int64(first_at(t, times[i]))


@wp.kernel
def find_ranges(
    t: wp.array(dtype=wp.int64),
    windows: wp.array(dtype=wp.int64),
    start: int,
    out: wp.array(dtype=wp.int64),
):
    """Find the events of a window, from its start to before its end.

    ``windows`` have four numbers each, of which the first two are start and end. They are replaced by the index of the
    first event, the number of events, and the times of the first event and the last one, 0 without events.
    """
    i = 4 * (wp.tid() + start)
    first = first_at(t, windows[i])
    stop = first_at(t, windows[i + 1])
    out[i] = wp.int64(first)
    out[i + 1] = wp.int64(stop - first)
    first_us = wp.int64(0)
    last_us = wp.int64(0)
    if first < stop:
        first_us = t[first]
        last_us = t[stop - 1]
    out[i + 2] = first_us
    out[i + 3] = last_us


@wp.kernel
def find_beyond(values: wp.array(dtype=float), most: float, step: int, bad: wp.array(dtype=int)):
    """Find the first value that is NaN or not within ``most`` of 0. Thread k looks at every ``step``-th value."""
    for i in range(wp.tid(), values.shape[0], step):
        if not wp.abs(values[i]) <= most:
            wp.atomic_min(bad, 0, i)
