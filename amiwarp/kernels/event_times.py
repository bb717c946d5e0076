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


@wp.kernel
def find_times(
    t: wp.array(dtype=wp.int64),
    times: wp.array(dtype=wp.int64),
    start: int,
    out: wp.array(dtype=wp.int64),
):
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
