"""Kernels that check and convert the columns of events."""

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
    right = int(0)
    bottom = int(0)
    polarity = int(0)
    decreases = int(0)
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
def narrow_integers(
    values: wp.array(dtype=wp.int64), out: wp.array(dtype=wp.uint16), bad: wp.array(dtype=int)
):
    """Convert whole coordinates [px], and set ``bad`` if one does not fit."""
    i = wp.tid()
    if values[i] < wp.int64(0) or values[i] > wp.int64(65535):
        bad[0] = 1
    out[i] = wp.uint16(values[i])


@wp.kernel
def narrow_floats(
    values: wp.array(dtype=wp.float64), out: wp.array(dtype=float), bad: wp.array(dtype=int)
):
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
def narrow_times(
    values: wp.array(dtype=wp.uint64), out: wp.array(dtype=wp.int64), bad: wp.array(dtype=int)
):
    """Convert unsigned times [us], and set ``bad`` if int64 does not hold one."""
    i = wp.tid()
    out[i] = wp.int64(values[i])
    if out[i] < wp.int64(0):
        bad[0] = 1


@wp.kernel
def narrow_polarities(
    values: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.uint8), first: wp.array(dtype=int)
):
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
def join_columns(
    x: wp.array(dtype=float), y: wp.array(dtype=float), start: int, xy: wp.array2d(dtype=float)
):
    """Write coordinates as the rows of one array."""
    i = start + wp.tid()
    xy[i, 0] = x[i]
    xy[i, 1] = y[i]


for _coordinate in (wp.uint16, wp.float32):
    wp.overload(find_limits, {"x": wp.array(dtype=_coordinate), "y": wp.array(dtype=_coordinate)})
