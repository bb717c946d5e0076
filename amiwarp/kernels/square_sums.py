"""Sums of products of derivatives and residuals over the pairs of each square of pixels."""

import warp as wp

from amiwarp.kernels.equations import Pairs

wp.set_module_options({"enable_backward": False})


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
    rows: wp.array2d(dtype=float),
    weight: wp.array(dtype=float),
    order: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    first: wp.array(dtype=int),
    second: wp.array(dtype=int),
    lanes: int,
    start: int,
    sums: wp.array2d(dtype=wp.float64),
):
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
        total += (
            wp.float64(rows[first[k], i]) * wp.float64(rows[second[k], i]) * wp.float64(weight[i])
        )
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
    rows: wp.array2d(dtype=float),
    weights: wp.array(dtype=float),
    order: wp.array(dtype=int),
    begin: int,
    end: int,
    square: int,
    sums: wp.array2d(dtype=wp.float64),
):
    """Compute the sums of one square over the pairs ``order[begin:end]``, for each row and those from it on."""


@wp.kernel
def sum_squares(
    rows: wp.array2d(dtype=float),
    weight: wp.array(dtype=float),
    order: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    start: int,
    sums: wp.array2d(dtype=wp.float64),
):
    """Compute the sums of :func:`sum_square_products`, one square per thread. For CPUs, and few rows."""
    here = start + wp.tid()
    add_square(rows, weight, order, starts[here], starts[here + 1], here, sums)
