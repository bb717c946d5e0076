"""Event representations of the latest events at each pixel, and the event spike tensor.

A thread takes ``length`` events: one on a GPU, a block of one window on a CPU, where a single thread runs all blocks of
a window. So additions and maxima on a CPU have one thread at a time.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.native_code import load_int64, store_float
from amiwarp.kernels.tensors import (
    BLOCK,
    EARLIEST,
    SPAN,
    START,
    STOP,
    T_START,
    WHOLE,
    Grid,
    event_of,
    interval_of,
    is_pixel,
    nearest,
    time_at,
    window_of,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def window_place(grid: Grid, window: int, images: int, image: int, x: int, y: int) -> int:
    """Return the number of a pixel in one of the ``images`` of a window."""
    return ((window * images + image) * grid.height + y) * grid.width + x


@wp.kernel
def keep_recent(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    length: int,
    faults: wp.array(dtype=int),
    recent: wp.array(dtype=wp.int64),
):
    """Keep the latest times of each polarity at the nearest pixels: ``grid.steps`` images for OFF, then for ON.

    Each image takes the maximum, and the smaller of both times goes on to the next image. So the first image has the
    latest time, the second one the latest of the others, in whatever order events come.
    """
    first = wp.tid() * length
    window = window_of(windows, first / BLOCK)
    for thread in range(first, first + length):
        i = event_of(grid, windows, x, y, t, faults, window, thread)
        if i >= 0:
            col, row = nearest(x[i]), nearest(y[i])
            if is_pixel(grid, col, row) == 1:
                time = t[i]
                of_polarity = wp.where(p[i] != wp.uint8(0), grid.steps, 0)
                for k in range(grid.steps):
                    place = window_place(grid, window, 2 * grid.steps, of_polarity + k, col, row)
                    time = wp.min(time, wp.atomic_max(recent, place, time))


@wp.func
def log_age(age: wp.float64, shortest: wp.float64, longest: wp.float64) -> float:
    """Return the logarithm of an age, limited to ``shortest`` and ``longest``."""
    one = wp.float64(1.0)
    return float(wp.log((wp.clamp(age, shortest, longest) + one) / (shortest + one)))


@wp.kernel
def read_recent(
    recent: wp.array(dtype=wp.int64),
    t_end: wp.array(dtype=wp.int64),
    size: int,
    shortest: wp.float64,
    longest: wp.float64,
    length: int,
    start: int,
    out: wp.array(dtype=float),
):
    """Compute the logarithms of the ages of the latest events, ``length`` per thread. ``size``: numbers of a window."""
    first = (start + wp.tid()) * length
    # Most pixels have no events: one logarithm for all of them
    without_event = log_age(longest, shortest, longest)
    for i in range(first, first + length):
        value = without_event
        if load_int64(recent, i) >= EARLIEST:
            age = wp.float64(t_end[i / size] - load_int64(recent, i))
            value = log_age(age, shortest, longest)
        store_float(out, i, value)


@wp.kernel
def keep_last(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    length: int,
    faults: wp.array(dtype=int),
    last: wp.array(dtype=wp.int64),
):
    """Keep the number of the last event at each nearest pixel, from 1 in its window, doubled, plus 1 if it is ON."""
    first = wp.tid() * length
    window = window_of(windows, first / BLOCK)
    for thread in range(first, first + length):
        i = event_of(grid, windows, x, y, t, faults, window, thread)
        if i >= 0:
            col, row = nearest(x[i]), nearest(y[i])
            if is_pixel(grid, col, row) == 1:
                number = wp.int64(i) - windows[window, START] + wp.int64(1)
                is_on = wp.where(p[i] != wp.uint8(0), wp.int64(1), wp.int64(0))
                place = window_place(grid, window, 1, 0, col, row)
                wp.atomic_max(last, place, wp.int64(2) * number + is_on)


@wp.kernel
def read_stack(
    last: wp.array(dtype=wp.int64),
    windows: wp.array2d(dtype=wp.int64),
    size: int,
    stacks: int,
    start: int,
    out: wp.array(dtype=wp.int8),
):
    """Compute the polarity of the last event at each pixel in each stack, 0 without one."""
    pixel = start + wp.tid()
    window = pixel / size
    half = windows[window, STOP] - windows[window, START]
    dropped = wp.int64(0)
    sign = wp.where(last[pixel] % wp.int64(2) == wp.int64(1), 1, -1)
    for k in range(stacks):
        is_there = last[pixel] / wp.int64(2) > dropped
        out[(window * stacks + k) * size + pixel % size] = wp.int8(wp.where(is_there, sign, 0))
        half /= wp.int64(2)
        dropped += half


@wp.kernel
def add_spikes(
    x: wp.array(dtype=Any),
    y: wp.array(dtype=Any),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    windows: wp.array2d(dtype=wp.int64),
    grid: Grid,
    length: int,
    faults: wp.array(dtype=int),
    sums: wp.array(dtype=wp.int64),
):
    """Add each event's time in its window, from 0 to 1, shared linearly between the bins around it.

    There are ``grid.steps + 1`` bins for OFF, then for ON. Shares are integers in units of 2**-30.
    """
    first = wp.tid() * length
    window = window_of(windows, first / BLOCK)
    bins = grid.rate + 1
    for thread in range(first, first + length):
        i = event_of(grid, windows, x, y, t, faults, window, thread)
        if i >= 0:
            col, row = nearest(x[i]), nearest(y[i])
            if is_pixel(grid, col, row) == 1:
                t_start, span = windows[window, T_START], windows[window, SPAN]
                elapsed = wp.clamp(t[i] - t_start, wp.int64(0), span)
                measured = wp.float64(elapsed) / wp.float64(span) * wp.float64(WHOLE)
                time = time_at(grid, t_start, span, t[i])
                interval = interval_of(grid, time)
                later = time - wp.float64(interval)
                half = wp.float64(0.5)
                end = wp.int64(measured * later + half)
                begin = wp.int64(measured * (wp.float64(1.0) - later) + half)
                image = wp.where(p[i] != wp.uint8(0), bins, 0) + interval
                wp.atomic_add(sums, window_place(grid, window, 2 * bins, image, col, row), begin)
                if interval < grid.rate:
                    place = window_place(grid, window, 2 * bins, image + 1, col, row)
                    wp.atomic_add(sums, place, end)


@wp.kernel
def read_spikes(
    sums: wp.array(dtype=wp.int64), length: int, start: int, out: wp.array(dtype=float)
):
    """Compute the event spike tensor from its sums, ``length`` elements per thread."""
    first = (start + wp.tid()) * length
    for i in range(first, first + length):
        store_float(out, i, float(wp.float64(load_int64(sums, i)) / wp.float64(WHOLE)))


for _coordinate in (wp.uint16, wp.float32):
    for _kernel in (keep_recent, keep_last, add_spikes):
        wp.overload(_kernel, {"x": wp.array(dtype=_coordinate), "y": wp.array(dtype=_coordinate)})
