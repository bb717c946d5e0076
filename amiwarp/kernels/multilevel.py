"""Preconditioner of large brightness maps: the sum of corrections on ever coarser grids.

Source: Bramble, Pasciak and Xu, "Parallel multilevel preconditioners", Math. Comp. 1990. The equations relate nodes
near each other, so that brightness would propagate across the map only slowly with single-node corrections.
"""

import warp as wp

from amiwarp.kernels.conjugate_gradients import Prior, add_fixed
from amiwarp.kernels.equations import Atlas, Geometry, bilinear, fraction, fractions_of
from amiwarp.kernels.shared_memory import wait_for_block

OPTIONS = {"enable_backward": False}
wp.set_module_options(OPTIONS)

# Energy of a bilinear hat function of any width under links of weight 1
HAT = wp.constant(8.0 / 3.0)


@wp.func
def coarse_coordinates(atlas: Atlas, cell: int, f: wp.vec2, spacing: float) -> wp.vec2:
    """Convert node coordinates on the finest grid to the grid whose nodes are ``spacing`` apart."""
    return wp.vec2(float(cell % atlas.columns) + f[0], float(cell / atlas.columns) + f[1]) / spacing


@wp.func
def upper_left(at: wp.vec2, columns: int) -> int:
    """Return the index of the grid node to the upper left of node coordinates."""
    return int(at[1]) * columns + int(at[0])


@wp.func
def node_weight(a: int, wa: wp.vec4, node: int, columns: int) -> float:
    """Return the weight of a node among the four nodes of the cell ``a``; 0 if it is none of them."""
    value = float(0.0)
    for k in range(4):
        if a + (k % 2) + (k / 2) * columns == node:
            value = wa[k]
    return value


@wp.kernel
def add_coarse_diagonal(
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    spacing: float,
    columns: int,
    stride: int,
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += diag(Pᵀ Aᵀ W A P) of the grid of that ``spacing``, from every ``stride``-th pair."""
    i = (start + wp.tid()) * stride
    if geometry.cell[i] < 0:
        return
    a = coarse_coordinates(atlas, geometry.cell[i], fractions_of(geometry, 0, i), spacing)
    b = coarse_coordinates(
        atlas, geometry.cell[geometry.stride + i], fractions_of(geometry, 1, i), spacing
    )
    wa = bilinear(fraction(a))
    wb = bilinear(fraction(b))
    na = upper_left(a, columns)
    nb = upper_left(b, columns)
    scale = weight[i] * float(stride)
    for k in range(4):
        step = (k % 2) + (k / 2) * columns
        difference = wb[k] - node_weight(na, wa, nb + step, columns)
        add_fixed(sums, nb + step, scale * difference * difference)
        if node_weight(nb, wb, na + step, columns) == 0.0:
            add_fixed(sums, na + step, scale * wa[k] * wa[k])


@wp.kernel(module="unique", module_options=OPTIONS)
def divide(
    diagonal: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=float),
):
    """Compute the correction on the finest grid: the residual divided by the diagonal."""
    i = start + wp.tid()
    if i < out.shape[0]:
        out[i] = residual[i] / diagonal[i]


@wp.func
def restricted(fine: wp.array(dtype=float), at: int, rows: int, columns: int, i: int) -> float:
    """Return the residual at node ``i`` of the next coarser grid, from a grid stored from element ``at`` on."""
    row = 2 * (i / (columns / 2 + 1))
    column = 2 * (i % (columns / 2 + 1))
    total = float(0.0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            y = row + dy
            x = column + dx
            if y >= 0 and y < rows and x >= 0 and x < columns:
                total += fine[at + y * columns + x] / float((1 + wp.abs(dy)) * (1 + wp.abs(dx)))
    return total


@wp.func
def prior_part(prior: Prior, four: float) -> float:
    """Return the prior's part of a coarse grid's diagonal; ``four`` is 4 to the power of the grid's level."""
    return prior.smooth[0] * HAT + prior.damping[0] * four


@wp.kernel(module="unique", module_options=OPTIONS)
def restrict(
    fine: wp.array(dtype=float),
    fine_rows: int,
    fine_columns: int,
    diagonal: wp.array(dtype=float),
    prior: Prior,
    four: float,
    start: int,
    coarse: wp.array(dtype=float),
    correction: wp.array(dtype=float),
):
    """Compute the residual and the correction on the next coarser grid; ``four`` is 4 to the power of its level."""
    i = start + wp.tid()
    if i >= coarse.shape[0]:
        return
    total = restricted(fine, 0, fine_rows, fine_columns, i)
    coarse[i] = total
    correction[i] = total / (diagonal[i] + prior_part(prior, four))


@wp.func_native("""
    const int y = 2 * row;
    const float* here = (const float*)fine.data + (size_t)y * fine_columns;
    const float* above = y > 0 ? here - fine_columns : nullptr;
    const float* below = y + 1 < fine_rows ? here + fine_columns : nullptr;
    const float* node = (const float*)diagonal.data + (size_t)row * columns;
    float* to = (float*)coarse.data + (size_t)row * columns;
    float* corrected = (float*)correction.data + (size_t)row * columns;
    float sum[258];
    for (int first = 0; first < columns; first += 128) {
        // sum[k] belongs to the fine column 2 * first - 1 + k
        const int n = columns - first < 128 ? columns - first : 128, left = 2 * first - 1;
        const int low = left < 0 ? 1 : 0, high = fine_columns - left < 2 * n + 1 ? fine_columns - left : 2 * n + 1;
        for (int k = 0; k < 2 * n + 1; ++k) sum[k] = 0.0f;
        if (y < fine_rows) for (int k = low; k < high; ++k) sum[k] = here[left + k];  // the last row may lie below
        if (above) for (int k = low; k < high; ++k) sum[k] += 0.5f * above[left + k];
        if (below) for (int k = low; k < high; ++k) sum[k] += 0.5f * below[left + k];
        for (int k = 0; k < n; ++k) {
            const float total = sum[2 * k + 1] + 0.5f * (sum[2 * k] + sum[2 * k + 2]);
            to[first + k] = total;
            corrected[first + k] = total / (node[first + k] + least);
        }
    }
""")
def restrict_row(
    fine: wp.array(dtype=float),
    fine_rows: int,
    fine_columns: int,
    columns: int,
    diagonal: wp.array(dtype=float),
    least: float,
    row: int,
    coarse: wp.array(dtype=float),
    correction: wp.array(dtype=float),
):
    """Compute :func:`restrict` for one row of the coarser grid. ``least`` is the prior's part of the diagonal."""


@wp.kernel
def restrict_rows(
    fine: wp.array(dtype=float),
    fine_rows: int,
    fine_columns: int,
    diagonal: wp.array(dtype=float),
    prior: Prior,
    four: float,
    start: int,
    coarse: wp.array(dtype=float),
    correction: wp.array(dtype=float),
):
    """Compute residual and correction as :func:`restrict` does, one row of the coarser grid per thread. For CPUs."""
    least = prior_part(prior, four)
    row = start + wp.tid()
    restrict_row(
        fine,
        fine_rows,
        fine_columns,
        fine_columns / 2 + 1,
        diagonal,
        least,
        row,
        coarse,
        correction,
    )


@wp.func
def prolonged(coarse: wp.array(dtype=float), first: int, fine_columns: int, i: int) -> float:
    """Return the correction at node ``i`` of the next finer grid, from a grid stored from element ``first`` on."""
    columns = fine_columns / 2 + 1
    row = i / fine_columns
    column = i % fine_columns
    at = first + (row / 2) * columns + column / 2
    right = column % 2
    down = (row % 2) * columns
    return 0.25 * (coarse[at] + coarse[at + right] + coarse[at + down] + coarse[at + right + down])


@wp.kernel(module="unique", module_options=OPTIONS)
def prolong(
    coarse: wp.array(dtype=float),
    fine_rows: int,
    fine_columns: int,
    start: int,
    fine: wp.array(dtype=float),
):
    """Interpolate the coarser grid's correction and add it to the finer grid's."""
    i = start + wp.tid()
    if i < fine_rows * fine_columns:
        fine[i] = fine[i] + prolonged(coarse, 0, fine_columns, i)


@wp.kernel(module="unique", module_options=OPTIONS)
def prolong_to_finest(
    coarse: wp.array(dtype=float),
    fine_rows: int,
    fine_columns: int,
    diagonal: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=float),
):
    """Compute the correction on the finest grid (:func:`divide`), and add the coarser one, interpolated."""
    i = start + wp.tid()
    if i < out.shape[0]:
        correction = residual[i] / diagonal[i]
        if i < fine_rows * fine_columns:
            correction += prolonged(coarse, 0, fine_columns, i)
        out[i] = correction


@wp.func
def grid_below(rows: int, columns: int, at: int, levels: int):
    """Return rows, columns and first element of the grid that is ``levels`` coarser than the one given by these."""
    r = int(rows)
    c = int(columns)
    first = int(at)
    for _ in range(levels):
        first += r * c
        r = r / 2 + 1
        c = c / 2 + 1
    return r, c, first


@wp.kernel(module="unique", module_options=OPTIONS)
def correct_small(
    rows: int,
    columns: int,
    at: int,
    levels: int,
    diagonal: wp.array(dtype=float),
    prior: Prior,
    four: float,
    start: int,
    residual: wp.array(dtype=float),
    correction: wp.array(dtype=float),
):
    """Compute the sum of the corrections on the ``levels`` grids below one of ``rows`` x ``columns`` nodes, in a block.

    The grids are stored one after the other, the given one from element ``at`` on. ``four`` is 4 to the power of its
    level. The sum is stored on the first grid below.
    """
    thread = start + wp.tid()
    power = float(four)
    for level in range(levels):
        r, c, fine = grid_below(rows, columns, at, level)
        coarse = fine + r * c
        power *= 4.0
        least = prior_part(prior, power)
        for i in range(thread, (r / 2 + 1) * (c / 2 + 1), wp.block_dim()):
            total = restricted(residual, fine, r, c, i)
            residual[coarse + i] = total
            correction[coarse + i] = total / (diagonal[coarse + i] + least)
        wait_for_block()
    for above in range(1, levels):
        r, c, fine = grid_below(rows, columns, at, levels - above)
        for i in range(thread, r * c, wp.block_dim()):
            correction[fine + i] += prolonged(correction, fine + r * c, c, i)
        wait_for_block()


@wp.func_native("""
    const float* above = (const float*)coarse.data + (size_t)(row / 2) * columns;
    const float* below = above + (row % 2) * columns;
    float* to = (float*)fine.data + (size_t)row * fine_columns;
    for (int k = 0; k < fine_columns / 2; ++k) {
        to[2 * k] += 0.5f * (above[k] + below[k]);
        to[2 * k + 1] += 0.25f * (above[k] + above[k + 1] + below[k] + below[k + 1]);
    }
    if (fine_columns % 2) to[fine_columns - 1] += 0.5f * (above[fine_columns / 2] + below[fine_columns / 2]);
""")
def prolong_row(
    coarse: wp.array(dtype=float),
    columns: int,
    fine_columns: int,
    row: int,
    fine: wp.array(dtype=float),
):
    """Compute :func:`prolong` for one row of the finer grid."""


@wp.kernel
def prolong_rows(
    coarse: wp.array(dtype=float),
    columns: int,
    fine_columns: int,
    start: int,
    fine: wp.array(dtype=float),
):
    """Add the correction as :func:`prolong` does, one row of the finer grid per thread. For CPUs."""
    prolong_row(coarse, columns, fine_columns, start + wp.tid(), fine)


@wp.func_native("""
    const float* d = (const float*)diagonal.data;
    const float* r = (const float*)residual.data;
    float* to = (float*)out.data;
    for (int i = first; i < last; ++i) to[i] = r[i] / d[i];
""")
def divide_range(
    diagonal: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    first: int,
    last: int,
    out: wp.array(dtype=float),
):
    """Compute :func:`divide` from ``first`` to ``last``."""


@wp.kernel
def prolong_rows_to_finest(
    coarse: wp.array(dtype=float),
    columns: int,
    fine_rows: int,
    fine_columns: int,
    diagonal: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=float),
):
    """Compute :func:`prolong_to_finest`, one row per thread; the last one also computes what follows the map."""
    row = start + wp.tid()
    last = wp.where(row + 1 < fine_rows, (row + 1) * fine_columns, out.shape[0])
    divide_range(diagonal, residual, row * fine_columns, last, out)
    prolong_row(coarse, columns, fine_columns, row, out)
