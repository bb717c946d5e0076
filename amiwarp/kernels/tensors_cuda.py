"""Events added to the images of windows on a GPU: one event per thread."""

from typing import Any

import warp as wp

from amiwarp.kernels.tensors import (
    BLOCK,
    SPAN,
    T_START,
    WHOLE,
    Grid,
    Part,
    add_event_word,
    count_event,
    end_share,
    event_of,
    interval_of,
    is_near,
    is_pixel,
    nearest,
    part_of,
    place_of,
    time_at,
    weight_of,
    window_of,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def count_events(
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
    """Count the event of each thread at its nearest pixel."""
    window = window_of(windows, wp.tid() / BLOCK)
    i = event_of(grid, windows, x, y, t, faults, window, wp.tid())
    if i >= 0:
        count_event(grid, part, -1, windows, window, i, x, y, t, p, counts)


@wp.kernel
def keep_latest(
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
    """Keep the time of each thread's event at its nearest pixel, if it is the latest."""
    window = window_of(windows, wp.tid() / BLOCK)
    i = event_of(grid, windows, x, y, t, faults, window, wp.tid())
    if i >= 0:
        col, row = nearest(x[i]), nearest(y[i])
        if is_pixel(grid, col, row) == 1:
            wp.atomic_max(latest, place_of(grid, window * grid.steps, p[i], col, row), t[i])


@wp.kernel
def add_event_words(
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
    """Add the word of each thread's event."""
    window = window_of(windows, wp.tid() / BLOCK)
    i = event_of(grid, windows, x, y, t, faults, window, wp.tid())
    if i >= 0:
        add_event_word(grid, part, -1, windows, window, i, x, y, t, p, words)


@wp.func
def add_parts(sums: wp.array(dtype=wp.int64), place: int, weight: int, part: wp.float64, end: int):
    """Add the parts of an event's two shares that belong to a pixel."""
    first = part_of(WHOLE - end, part)
    second = part_of(end, part)
    if first != 0:
        wp.atomic_add(sums, place, wp.int64(weight * first))
    if second != 0:
        wp.atomic_add(sums, place + 1, wp.int64(weight * second))


@wp.kernel
def share_events(
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
    """Share the event of each thread among the four nearest pixels and the two ends of its time interval."""
    window = window_of(windows, wp.tid() / BLOCK)
    i = event_of(grid, windows, x, y, t, faults, window, wp.tid())
    if i >= 0:
        u, v = float(x[i]), float(y[i])
        if is_near(grid, u, v) == 1:
            time = time_at(grid, windows[window, T_START], windows[window, SPAN], t[i])
            interval = interval_of(grid, time)
            end = end_share(time, interval)
            weight = weight_of(grid, p[i])
            col, row = wp.floor(u), wp.floor(v)
            right, below = wp.float64(u - col), wp.float64(v - row)
            left, above = wp.float64(1.0) - right, wp.float64(1.0) - below
            place = 2 * place_of(grid, window * grid.steps + interval, p[i], int(col), int(row))
            under = place + 2 * (grid.width + 2 * grid.border)
            add_parts(sums, place, weight, left * above, end)
            add_parts(sums, place + 2, weight, right * above, end)
            add_parts(sums, under, weight, left * below, end)
            add_parts(sums, under + 2, weight, right * below, end)


for _coordinate in (wp.uint16, wp.float32):
    for _kernel in (count_events, keep_latest, share_events):
        wp.overload(_kernel, {"x": wp.array(dtype=_coordinate), "y": wp.array(dtype=_coordinate)})
