"""Device side of what is made of residuals: slopes by the parameters, costs, and sums of products."""

import warp as wp

from amiwarp.kernels.descent import add_fixed, leave
from amiwarp.kernels.photometric import Atlas, Geometry, Pairs, difference

wp.set_module_options({"enable_backward": False})


@wp.kernel
def slope_between(
    pairs: Pairs,
    atlas: Atlas,
    plus: Geometry,
    minus: Geometry,
    image: wp.array(dtype=float),
    width: float,
    start: int,
    slope: wp.array(dtype=float),
):
    """Of the residuals, by differences over ``width`` between two placings; 0 where a pair is off the map in one."""
    i = start + wp.tid()
    change = difference(image, atlas, pairs, minus, i) - difference(image, atlas, pairs, plus, i)
    slope[i] = wp.where(plus.cell[i] >= 0 and minus.cell[i] >= 0, change / width, 0.0)


@wp.func
def finite(value: float, otherwise: float) -> float:
    return wp.where(value == value, value, otherwise)


@wp.kernel
def sum_costs(
    residual: wp.array(dtype=float), on: wp.array(dtype=wp.uint8), mask: int, count: int, scale: float, missing: float,
    width: int, start: int, partial: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Partial sums of Cauchy's cost over the pairs that have the bits of ``mask``, and their number.

    ``missing``: the residual of a pair off the map; NaN leaves it out.
    """
    thread = start + wp.tid()
    total = wp.float64(0.0)
    number = wp.float64(0.0)
    product = wp.float64(1.0)  # of several terms, for one logarithm
    for i in range(thread * width, wp.min((thread + 1) * width, count)):
        r = finite(residual[i], missing) / scale
        if r == r and (int(on[i]) & mask) == mask:
            product *= wp.float64(1.0) + wp.float64(r) * wp.float64(r)
            number += wp.float64(1.0)
            if product > wp.float64(1.0e100):
                total += wp.log(product)
                product = wp.float64(1.0)
    leave(partial[0], thread, total + wp.log(product))
    leave(partial[1], thread, number)


@wp.kernel
def sum_products(
    a: wp.array(dtype=float), b: wp.array(dtype=float), weight: wp.array(dtype=float), count: int, width: int,
    start: int, partial: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Partial sums of a b weight, NaN counting as 0."""
    thread = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, count)):
        total += wp.float64(finite(a[i] * b[i] * weight[i], 0.0))
    leave(partial, thread, total)


@wp.func
def cluster_of(pairs: Pairs, tiles: int, i: int) -> int:
    """Pairs near each other: of one tile, or where there is but one, of 64 x 64 pixels (1024 a row)."""
    if tiles > 1:
        return pairs.tile[i]
    return int(pairs.x[i]) / 64 + int(pairs.y[i]) / 64 * 1024


@wp.kernel
def add_clusters(
    pairs: Pairs, tiles: int, slope: wp.array(dtype=float), weight: wp.array(dtype=float),
    residual: wp.array(dtype=float), start: int, sums: wp.array2d(dtype=wp.int64),
):  # fmt: skip
    """Per cluster of pairs: the sum of slope x weight x residual, in fixed point, and the number of pairs."""
    i = start + wp.tid()
    cluster = cluster_of(pairs, tiles, i)
    add_fixed(sums[0], cluster, finite(slope[i] * weight[i] * residual[i], 0.0))
    wp.atomic_add(sums[1], cluster, wp.int64(1))


@wp.kernel
def magnitudes(values: wp.array(dtype=float), start: int, out: wp.array(dtype=float), number: wp.array(dtype=int)):
    """Absolute values, infinite for NaN; how many are not NaN."""
    i = start + wp.tid()
    known = values[i] == values[i]
    out[i] = wp.where(known, wp.abs(values[i]), wp.inf)
    if known:
        wp.atomic_add(number, 0, 1)


@wp.kernel
def clear_missing(values: wp.array(dtype=float), start: int, out: wp.array(dtype=float)):
    i = start + wp.tid()
    out[i] = finite(values[i], 0.0)
