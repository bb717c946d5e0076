"""Images of other programs as log intensity: colours to luminance, and the logarithm."""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import NAN

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Weights of linear red, green and blue in the luminance (ITU-R BT.709)
RED = wp.constant(0.2126)
GREEN = wp.constant(0.7152)
BLUE = wp.constant(0.0722)


@wp.func
def log_of(light: float, dark: float) -> float:
    """Return the log intensity of a luminance with the intensity ``dark`` added; NaN for a negative luminance."""
    return wp.log(wp.where(light >= 0.0, light, NAN) + dark)


@wp.func
def coded_light(
    values: wp.array2d(dtype=wp.uint8), i: int, more: int, table: wp.array(dtype=float)
) -> float:
    """Return the luminance of an 8-bit pixel whose values are raised by ``more``."""
    first = table[wp.min(int(values[i, 0]) + more, 255)]
    if values.shape[1] < 3:
        return first
    green = table[wp.min(int(values[i, 1]) + more, 255)]
    blue = table[wp.min(int(values[i, 2]) + more, 255)]
    return RED * first + GREEN * green + BLUE * blue


@wp.kernel
def log_of_linear(
    values: wp.array2d(dtype=Any), dark: float, start: int, levels: wp.array(dtype=float)
):
    """Compute the log intensity of linear values; axes: pixel, channel (luminance, or red, green and blue)."""
    i = start + wp.tid()
    light = float(values[i, 0])
    if values.shape[1] >= 3:
        light = RED * light + GREEN * float(values[i, 1]) + BLUE * float(values[i, 2])
    levels[i] = log_of(light, dark)


for _dtype in (wp.float16, wp.float32, wp.float64):
    wp.overload(log_of_linear, {"values": wp.array2d(dtype=_dtype)})


@wp.kernel
def log_of_coded(
    values: wp.array2d(dtype=wp.uint8),
    table: wp.array(dtype=float),
    dark: float,
    start: int,
    levels: wp.array(dtype=float),
):
    """Compute the log intensity of 8-bit values. ``table``: linear intensity of each value."""
    i = start + wp.tid()
    levels[i] = log_of(coded_light(values, i, 0, table), dark)


@wp.kernel
def find_highest_stair(
    values: wp.array2d(dtype=wp.uint8),
    table: wp.array(dtype=float),
    dark: float,
    start: int,
    highest: wp.array(dtype=float),
):
    """Find the largest change of log intensity that one more in all channels of a pixel makes."""
    i = start + wp.tid()
    here = log_of(coded_light(values, i, 0, table), dark)
    wp.atomic_max(highest, 0, log_of(coded_light(values, i, 1, table), dark) - here)


@wp.kernel
def count_large_changes(
    before: wp.array(dtype=float),
    after: wp.array(dtype=float),
    least: float,
    start: int,
    count: wp.array(dtype=int),
):
    """Count the pixels whose log intensity changes by more than ``least``."""
    i = start + wp.tid()
    if wp.abs(after[i] - before[i]) > least:
        wp.atomic_add(count, 0, 1)
