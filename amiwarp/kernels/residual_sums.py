"""Sums over the residuals of event pairs: costs, products, and clusters of pairs for standard deviations."""

import warp as wp

from amiwarp.kernels.conjugate_gradients import add_fixed, store_partial_sum
from amiwarp.kernels.equations import Pairs

wp.set_module_options({"enable_backward": False})


@wp.func
def replace_nan(value: float, otherwise: float) -> float:
    """Return ``value``, or ``otherwise`` if it is NaN."""
    return wp.where(value == value, value, otherwise)


@wp.kernel
def sum_costs(
    residual: wp.array(dtype=float),
    on: wp.array(dtype=wp.uint8),
    mask: int,
    count: int,
    scale: float,
    missing: float,
    width: int,
    start: int,
    partial: wp.array2d(dtype=wp.float64),
):
    """Compute partial sums of Cauchy's cost, and the number of pairs, over pairs that have all bits of ``mask``.

    ``missing`` is the residual that a pair off the map counts with; NaN leaves such pairs out.
    """
    thread = start + wp.tid()
    total = wp.float64(0.0)
    number = wp.float64(0.0)
    product = wp.float64(1.0)  # product of several terms: one logarithm serves them all
    for i in range(thread * width, wp.min((thread + 1) * width, count)):
        r = replace_nan(residual[i], missing) / scale
        if r == r and (int(on[i]) & mask) == mask:
            product *= wp.float64(1.0) + wp.float64(r) * wp.float64(r)
            number += wp.float64(1.0)
            if product > wp.float64(1.0e100):
                total += wp.log(product)
                product = wp.float64(1.0)
    store_partial_sum(partial[0], thread, total + wp.log(product))
    store_partial_sum(partial[1], thread, number)


@wp.kernel
def sum_products(
    a: wp.array(dtype=float),
    b: wp.array(dtype=float),
    weight: wp.array(dtype=float),
    count: int,
    width: int,
    start: int,
    partial: wp.array(dtype=wp.float64),
):
    """Compute partial sums of a · b · weight; NaN counts as 0."""
    thread = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, count)):
        total += wp.float64(replace_nan(a[i] * b[i] * weight[i], 0.0))
    store_partial_sum(partial, thread, total)


CLUSTER_PX = wp.constant(64)
"""Length of the sides of the squares that are clusters of a map of one tile [px]."""


@wp.func
def cluster_of(pairs: Pairs, tiles: int, columns: int, i: int) -> int:
    """Return the cluster of a pair: its tile.

    On a map of one tile, it is the square of pixels that holds the pixel; there are ``columns`` squares in a row.
    """
    if tiles > 1:
        return pairs.tile[i]
    return int(pairs.x[i]) / CLUSTER_PX + int(pairs.y[i]) / CLUSTER_PX * columns


@wp.kernel
def add_clusters(
    pairs: Pairs,
    tiles: int,
    columns: int,
    copies: int,
    slope: wp.array(dtype=float),
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    sums: wp.array2d(dtype=wp.int64),
):
    """Add slope · weight · residual in fixed point, and the number of pairs, to the cluster of each pair.

    Each sum has ``copies`` that are added up later.
    """
    i = start + wp.tid()
    cluster = cluster_of(pairs, tiles, columns, i) * copies + i % copies
    add_fixed(sums[0], cluster, replace_nan(slope[i] * weight[i] * residual[i], 0.0))
    wp.atomic_add(sums[1], cluster, wp.int64(1))


@wp.kernel
def magnitudes(
    values: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=float),
    number: wp.array(dtype=int),
):
    """Compute absolute values, infinite for NaN, and count the values that are not NaN."""
    i = start + wp.tid()
    known = values[i] == values[i]
    out[i] = wp.where(known, wp.abs(values[i]), wp.inf)
    if known:
        wp.atomic_add(number, 0, 1)
