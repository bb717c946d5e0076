"""Sums over the equations of each pixel, for :mod:`amiwarp.brightness.pixel_costs`."""

import warp as wp

from amiwarp.kernels.equations import Pairs

wp.set_module_options({"enable_backward": False})

# Sums are integers in this fraction, so that the order of the terms does not matter
UNIT = wp.constant(1 << 24)
LARGEST = wp.constant(1.0e6)  # largest magnitude of a term


@wp.func
def add_to_pixel(pairs: Pairs, i: int, value: float, width: int, sums: wp.array(dtype=wp.int64)):
    """Add a value to the pixel of a pair; nothing if it is NaN."""
    if not wp.isnan(value):
        pixel = int(pairs.y[i]) * width + int(pairs.x[i])
        wp.atomic_add(sums, pixel, wp.int64(wp.clamp(value, -LARGEST, LARGEST) * float(UNIT)))


@wp.kernel
def add_costs(
    pairs: Pairs,
    residual: wp.array(dtype=float),
    scale: float,
    width: int,
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Add log(1 + (r / scale)²) of each pair's residual r to its pixel; a pair off the map has a residual of 1."""
    i = start + wp.tid()
    r = wp.where(wp.isnan(residual[i]), 1.0, residual[i]) / scale
    add_to_pixel(pairs, i, wp.log(1.0 + r * r), width, sums)


@wp.kernel
def add_products(
    pairs: Pairs,
    a: wp.array(dtype=float),
    b: wp.array(dtype=float),
    weight: wp.array(dtype=float),
    width: int,
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Add a · b · weight of each pair to its pixel; nothing for a pair off the map."""
    i = start + wp.tid()
    add_to_pixel(pairs, i, a[i] * b[i] * weight[i], width, sums)
