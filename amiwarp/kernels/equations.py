"""Event pairs as equations in a log-brightness map: residuals, their derivatives, and sums over squares of pixels."""

import warp as wp

from amiwarp.kernels.conjugate_gradients import EXTRA, add_fixed, add_from_warp, store_partial_sum
from amiwarp.kernels.native_code import load_float, load_int, load_uint8, store_float

# Event pairs as equations in a log-brightness map.
#
# The map is a set of rectangular tiles of equal shape, stored one after the other, followed by two more unknowns: the
# leak, and the excess of the OFF threshold over the ON threshold. Sums are in fixed point, as votes are, so that they
# do not depend on the order of threads.

wp.set_module_options({"enable_backward": False})

# Bits of a pair's ``on``: bit 0 is the polarity; bit 1, no event at the second time; bit 2, no event at the first time;
# bit 3, held out, with weight 0.
ON = wp.constant(wp.uint8(1))
QUIET = wp.constant(wp.uint8(2))
HELD = wp.constant(wp.uint8(8))


@wp.struct
class Pairs:
    """Pairs of consecutive events of a pixel: the first sets the reference level, the second is triggered by it.

    All arrays are flat. ``azimuth`` holds four parts: the cosines of the encoder's angle at the first events, the
    sines, and both at the second events. For two prisms it holds the angles of the first prism, and of the second
    [rad]. ``time`` [s] counts from the middle of the window; ``slope`` is the derivative of the angle by the
    drifting parameter, or empty. Both hold the first events, then the second events. ``lag`` and ``offset``
    describe slow pixels (:mod:`amiwarp.kernels.slow_pixels`), or are empty. ``path`` tells how the scene of each
    tile moves in the image, or is empty.
    """

    count: int
    stride: int  # length of each part of ``azimuth``, ``time`` and ``slope``
    weak: float  # weight of pairs without two events
    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    tile: wp.array(dtype=wp.int32)
    on: wp.array(dtype=wp.uint8)  # polarity of the second event, and flags; see ON, QUIET and HELD
    azimuth: wp.array(dtype=float)
    slope: wp.array(dtype=float)
    time: wp.array(dtype=float)
    lag: wp.array(dtype=float)  # rotation and contraction of the orbit at each event, in parts as ``azimuth``
    offset: wp.array(dtype=float)  # what the equation's left side lacks [thresholds]
    path: wp.array(dtype=float)  # for each tile, the factors of t, t², … in its motion along x, then along y [px]


@wp.struct
class Atlas:
    """Tiles of the brightness map.

    ``origin`` (x, y, x, …) is the pixel of each tile's first node. Nodes are ``1 / density`` px apart.
    """

    origin: wp.array(dtype=float)
    rows: int
    columns: int
    density: float
    with_leak: float  # 1 if the leak is solved for, else 0
    with_off: int  # 1 if the OFF threshold is solved for, else 0


@wp.struct
class Geometry:
    """Position of both events of a pair on the map: index of the upper left node, and the fraction to the next node."""

    stride: int
    cell: wp.array(dtype=int)  # nodes of first, then of second events; -1 if either event is outside its tile
    part: wp.array(dtype=float)  # fractions in the cells: x of first events, y of first, x of second, y of second


# -- one equation


@wp.func
def fractions_of(g: Geometry, k: int, i: int) -> wp.vec2:
    """Return the fractions (x, y) between map nodes of the first (k = 0) or second event of pair ``i``."""
    return wp.vec2(load_float(g.part, 2 * k * g.stride + i), load_float(g.part, (2 * k + 1) * g.stride + i))


@wp.func
def fraction(node: wp.vec2) -> wp.vec2:
    """Return the fractional part of each node coordinate."""
    return wp.vec2(node[0] - wp.floor(node[0]), node[1] - wp.floor(node[1]))


@wp.func
def bilinear(f: wp.vec2) -> wp.vec4:
    """Return the bilinear weights of four nodes: upper left, upper right, lower left, lower right."""
    return wp.vec4((1.0 - f[0]) * (1.0 - f[1]), f[0] * (1.0 - f[1]), (1.0 - f[0]) * f[1], f[0] * f[1])


@wp.func
def interpolated(image: wp.array(dtype=float), columns: int, cell: int, fx: float, fy: float) -> float:
    """Return the brightness between four nodes, of which ``cell`` is the upper left one."""
    upper = load_float(image, cell) * (1.0 - fx) + load_float(image, cell + 1) * fx
    lower = load_float(image, cell + columns) * (1.0 - fx) + load_float(image, cell + columns + 1) * fx
    return upper * (1.0 - fy) + lower * fy


@wp.func
def brightness_at(image: wp.array(dtype=float), g: Geometry, columns: int, k: int, i: int) -> float:
    """Return the brightness at the first (k = 0) or second event of a pair, or at node 0 for a pair off the map."""
    cell = wp.max(load_int(g.cell, k * g.stride + i), 0)
    fx = load_float(g.part, 2 * k * g.stride + i)
    fy = load_float(g.part, (2 * k + 1) * g.stride + i)
    return interpolated(image, columns, cell, fx, fy)


@wp.func
def is_off(pairs: Pairs, i: int) -> float:
    """Return 1 if the second event of the pair is an OFF event, else 0."""
    return wp.where((int(load_uint8(pairs.on, i)) & 3) == 0, 1.0, 0.0)


@wp.func
def sensor_terms(image: wp.array(dtype=float), atlas: Atlas, pairs: Pairs, i: int) -> float:
    """Return the terms of a pair's equation that do not depend on the map: [OFF] s + leak (t2 - t1)."""
    extra = image.shape[0] - EXTRA
    value = is_off(pairs, i) * load_float(image, extra + 1)
    if atlas.with_leak > 0.0:
        elapsed = load_float(pairs.time, pairs.stride + i) - load_float(pairs.time, i)
        value += load_float(image, extra) * elapsed
    return value


@wp.func
def difference(image: wp.array(dtype=float), atlas: Atlas, pairs: Pairs, g: Geometry, i: int) -> float:
    """Return the left side of a pair's equation: L(second) - L(first) + [OFF] s + leak (t2 - t1)."""
    value = brightness_at(image, g, atlas.columns, 1, i) - brightness_at(image, g, atlas.columns, 0, i)
    return value + sensor_terms(image, atlas, pairs, i)


@wp.func
def right_side(pairs: Pairs, i: int) -> float:
    """Return the right side in units of the ON threshold: +1 for ON, -1 for OFF, 0 for a quiet pixel."""
    on = int(load_uint8(pairs.on, i))
    return wp.where((on & 2) != 0, 0.0, wp.where((on & 1) != 0, 1.0, -1.0))


@wp.func
def add_extra(sums: wp.array(dtype=wp.int64), atlas: Atlas, pairs: Pairs, i: int, value: float):
    """Add a value to the sums of the leak and the OFF threshold. On CUDA all threads of a warp must call it."""
    extra = sums.shape[0] - EXTRA
    if atlas.with_leak > 0.0:
        add_from_warp(sums, extra, value * (pairs.time[pairs.stride + i] - pairs.time[i]))
    if atlas.with_off != 0:
        add_from_warp(sums, extra + 1, is_off(pairs, i) * value)


@wp.func
def add_extra_diagonal(sums: wp.array(dtype=wp.int64), atlas: Atlas, pairs: Pairs, i: int, weight: float):
    """Add the squared coefficients of the leak and the OFF threshold times a weight to their sums; see
    :func:`add_extra`."""
    extra = sums.shape[0] - EXTRA
    if atlas.with_leak > 0.0:
        gap = pairs.time[pairs.stride + i] - pairs.time[i]
        add_from_warp(sums, extra, weight * gap * gap)
    if atlas.with_off != 0:
        add_from_warp(sums, extra + 1, is_off(pairs, i) * weight)


@wp.func
def residual_of(pairs: Pairs, difference: float, i: int) -> float:
    """Return the residual of an equation whose left side is ``difference``."""
    r = right_side(pairs, i) - difference
    if pairs.offset.shape[0] > 0:
        r -= pairs.offset[i]
    return r


@wp.func
def weight_of(pairs: Pairs, r: float, scale: float, i: int) -> float:
    """Return the Cauchy weight of an equation with residual ``r``."""
    cauchy = 1.0 / (1.0 + (r / scale) * (r / scale))
    on = load_uint8(pairs.on, i)
    # the scale of the residuals of quiet pairs is one threshold, the accuracy of such pairs
    cauchy = wp.where(on > ON, pairs.weak / (1.0 + r * r), cauchy)
    return wp.where((on & HELD) != wp.uint8(0), 0.0, cauchy)


# Quantities computed from the residuals of event pairs: derivatives by the parameters, costs, and sums of products.


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
    """Compute the derivative of the residuals, by a difference over ``width`` between two geometries.

    It is 0 for a pair that is off the map in either geometry.
    """
    i = start + wp.tid()
    change = difference(image, atlas, pairs, minus, i) - difference(image, atlas, pairs, plus, i)
    slope[i] = wp.where(plus.cell[i] >= 0 and minus.cell[i] >= 0, change / width, 0.0)


@wp.kernel
def slope_of_changes(
    plus: wp.array(dtype=float), minus: wp.array(dtype=float), width: float, start: int, slope: wp.array(dtype=float)
):
    """Compute the derivative of the residuals from two changes of brightness, over ``width``; 0 if either is NaN."""
    i = start + wp.tid()
    change = load_float(minus, i) - load_float(plus, i)
    store_float(slope, i, wp.where(change == change, change / width, 0.0))


@wp.func
def replace_nan(value: float, otherwise: float) -> float:
    """Return ``value``, or ``otherwise`` if it is NaN."""
    return wp.where(value == value, value, otherwise)


@wp.kernel
def sum_costs(
    residual: wp.array(dtype=float), on: wp.array(dtype=wp.uint8), mask: int, count: int, scale: float, missing: float,
    width: int, start: int, partial: wp.array2d(dtype=wp.float64),
):  # fmt: skip
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
    a: wp.array(dtype=float), b: wp.array(dtype=float), weight: wp.array(dtype=float), count: int, width: int,
    start: int, partial: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Compute partial sums of a · b · weight; NaN counts as 0."""
    thread = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, count)):
        total += wp.float64(replace_nan(a[i] * b[i] * weight[i], 0.0))
    store_partial_sum(partial, thread, total)


@wp.func
def cluster_of(pairs: Pairs, tiles: int, i: int) -> int:
    """Return the cluster of a pair: its tile.

    On a map of one tile, it is the square of 64 x 64 pixels that holds the pixel (1024 squares per row).
    """
    if tiles > 1:
        return pairs.tile[i]
    return int(pairs.x[i]) / 64 + int(pairs.y[i]) / 64 * 1024


@wp.kernel
def add_clusters(
    pairs: Pairs, tiles: int, copies: int, slope: wp.array(dtype=float), weight: wp.array(dtype=float),
    residual: wp.array(dtype=float), start: int, sums: wp.array2d(dtype=wp.int64),
):  # fmt: skip
    """Add slope · weight · residual in fixed point, and the number of pairs, to the cluster of each pair.

    Each sum has ``copies`` that are added up later.
    """
    i = start + wp.tid()
    cluster = cluster_of(pairs, tiles, i) * copies + i % copies
    add_fixed(sums[0], cluster, replace_nan(slope[i] * weight[i] * residual[i], 0.0))
    wp.atomic_add(sums[1], cluster, wp.int64(1))


@wp.kernel
def magnitudes(values: wp.array(dtype=float), start: int, out: wp.array(dtype=float), number: wp.array(dtype=int)):
    """Compute absolute values, infinite for NaN, and count the values that are not NaN."""
    i = start + wp.tid()
    known = values[i] == values[i]
    out[i] = wp.where(known, wp.abs(values[i]), wp.inf)
    if known:
        wp.atomic_add(number, 0, 1)


# Sums of products of derivatives and residuals over the pairs of each square of pixels, and factors of them.


@wp.kernel
def multiply(a: wp.array(dtype=float), b: wp.array(dtype=float), start: int, out: wp.array(dtype=float)):
    """Multiply two arrays element by element."""
    i = start + wp.tid()
    out[i] = a[i] * b[i]


@wp.kernel
def by_shift(
    first: wp.array(dtype=float), second: wp.array(dtype=float), shift: wp.array(dtype=float), start: int,
    out: wp.array(dtype=float),
):  # fmt: skip
    """Compute derivatives by a factor of ``shift``, changes of the angles at the ends of pairs, like ``Pairs.slope``.

    ``first`` and ``second`` are the derivatives by the angle at either end.
    """
    i = start + wp.tid()
    out[i] = first[i] * shift[i] + second[i] * shift[first.shape[0] + i]


@wp.kernel
def split_by_time(
    pairs: Pairs, middle: float, spread: float, gap: float, start: int, late: wp.array(dtype=float),
    is_long: wp.array(dtype=float),
):  # fmt: skip
    """Compute how far the mean time of each pair is from ``middle``, in units of ``spread``.

    ``is_long`` is 1 for pairs with a longer gap than ``gap``, else 0. Times are in seconds.
    """
    i = start + wp.tid()
    first = pairs.time[i]
    second = pairs.time[pairs.stride + i]
    late[i] = (0.5 * (first + second) - middle) / spread
    is_long[i] = wp.where(second - first > gap, 1.0, 0.0)


@wp.kernel
def angle_patterns(pairs: Pairs, cx: float, cy: float, start: int, out: wp.array2d(dtype=float)):
    """Compute patterns of errors of the prism's angle, at both events of each pair.

    The six rows of ``out`` are cosine and sine of the encoder's angle and of twice the angle, and the pixel's distance
    from the image's middle along x and along y [px]. Each has the form of ``Pairs.slope``.
    """
    i = start + wp.tid()
    for k in range(2):
        at = k * pairs.stride + i
        c = pairs.azimuth[2 * k * pairs.stride + i]
        s = pairs.azimuth[(2 * k + 1) * pairs.stride + i]
        out[0, at] = c
        out[1, at] = s
        out[2, at] = c * c - s * s
        out[3, at] = 2.0 * c * s
        out[4, at] = float(pairs.x[i]) - cx
        out[5, at] = float(pairs.y[i]) - cy


@wp.kernel
def find_squares(
    pairs: Pairs,
    rows: wp.array2d(dtype=float),
    side: int,
    columns: int,
    squares: int,
    start: int,
    square: wp.array(dtype=int),
    order: wp.array(dtype=int),
):
    """Compute the number of the square of pixels that holds each pair.

    It is ``squares`` for a pair with a NaN in ``rows``.
    """
    i = start + wp.tid()
    number = int(pairs.y[i]) / side * columns + int(pairs.x[i]) / side
    for k in range(rows.shape[0]):
        if rows[k, i] != rows[k, i]:
            number = squares
    square[i] = number
    order[i] = i


@wp.kernel
def find_starts(square: wp.array(dtype=int), count: int, start: int, starts: wp.array(dtype=int)):
    """Find the first pair of each square in the sorted ``square``. The last thread finds the number of pairs."""
    here = start + wp.tid()
    starts[here] = wp.lower_bound(square, 0, count, here)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(0xffffffffu, value, step);
#endif
    return value;
""")
def sum_of_lanes(value: wp.float64) -> wp.float64:
    """Return the sum of a value over the 32 threads of a warp, added in fixed order; on a CPU the value itself."""


@wp.kernel
def sum_square_products(
    rows: wp.array2d(dtype=float), weight: wp.array(dtype=float), order: wp.array(dtype=int),
    starts: wp.array(dtype=int), first: wp.array(dtype=int), second: wp.array(dtype=int), lanes: int, start: int,
    sums: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Compute the sum of rows[a] · rows[b] · weight over the pairs of a square, for each (a, b) of first and second.

    ``lanes`` threads compute one sum: 32, a warp of CUDA, or 1 on a CPU. The pairs of square k are those numbered
    ``order[starts[k]:starts[k + 1]]``.
    """
    thread = start + wp.tid()
    lane = thread % lanes
    k = (thread / lanes) % first.shape[0]
    here = thread / lanes / first.shape[0]
    total = wp.float64(0.0)
    for at in range(starts[here] + lane, starts[here + 1], lanes):
        i = order[at]
        total += wp.float64(rows[first[k], i]) * wp.float64(rows[second[k], i]) * wp.float64(weight[i])
    total = sum_of_lanes(total)
    if lane == 0:
        sums[here, k] = total


MOST_ROWS = 32  # largest number of rows for :func:`sum_squares`


@wp.func_native("""
#if defined(__clang__)
    const int m = rows.shape[0], wide = (m + 7) & ~7;
    const size_t stride = rows.strides[0] / sizeof(float);
    const float* row = (const float*)rows.data;
    const int* pair = (const int*)order.data;
    double total[32 * 32] = {0}, value[32] = {0};
    for (int at = begin; at < end; ++at) {
        const int i = pair[at];
        const double weight = ((const float*)weights.data)[i];
        for (int k = 0; k < m; ++k) value[k] = row[k * stride + i];
        for (int k = 0; k < m; ++k) {
            const double factor = weight * value[k];
            for (int j = k & ~7; j < wide; ++j) total[32 * k + j] += factor * value[j];
        }
    }
    double* out = (double*)((char*)sums.data + (size_t)sums.strides[0] * square);
    for (int k = 0; k < m; ++k)
        for (int j = k; j < m; ++j) *out++ = total[32 * k + j];
#endif
""")
def add_square(
    rows: wp.array2d(dtype=float), weights: wp.array(dtype=float), order: wp.array(dtype=int), begin: int, end: int,
    square: int, sums: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Compute the sums of one square over the pairs ``order[begin:end]``, for each row and those from it on."""


@wp.kernel
def sum_squares(
    rows: wp.array2d(dtype=float), weight: wp.array(dtype=float), order: wp.array(dtype=int),
    starts: wp.array(dtype=int), start: int, sums: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Compute the sums of :func:`sum_square_products`, one square per thread. For CPUs, and few rows."""
    here = start + wp.tid()
    add_square(rows, weight, order, starts[here], starts[here + 1], here, sums)
