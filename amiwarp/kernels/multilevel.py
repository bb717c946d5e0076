"""Preconditioner of large brightness maps: the sum of corrections on ever coarser grids.

Source: Bramble, Pasciak and Xu, "Parallel multilevel preconditioners", Math. Comp. 1990. The equations relate nodes
near each other, so that brightness would propagate across the map only slowly with single-node corrections.
"""

import warp as wp

from amiwarp.kernels.conjugate_gradients import add_fixed
from amiwarp.kernels.map_prior import Prior
from amiwarp.kernels.photometric import Atlas, Geometry, bilinear, fraction, fractions_of

wp.set_module_options({"enable_backward": False})

HAT = wp.constant(8.0 / 3.0)  # energy of a bilinear hat function of any width under links of weight 1


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
    b = coarse_coordinates(atlas, geometry.cell[geometry.stride + i], fractions_of(geometry, 1, i), spacing)
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


@wp.kernel
def divide(diagonal: wp.array(dtype=float), residual: wp.array(dtype=float), start: int, out: wp.array(dtype=float)):
    """Compute the correction on the finest grid: the residual divided by the diagonal."""
    i = start + wp.tid()
    if i < out.shape[0]:
        out[i] = residual[i] / diagonal[i]


@wp.kernel
def restrict(
    fine: wp.array(dtype=float),
    fine_rows: int,
    fine_columns: int,
    columns: int,
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
    row = 2 * (i / columns)
    column = 2 * (i % columns)
    total = float(0.0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            y = row + dy
            x = column + dx
            if y >= 0 and y < fine_rows and x >= 0 and x < fine_columns:
                total += fine[y * fine_columns + x] / float((1 + wp.abs(dy)) * (1 + wp.abs(dx)))
    coarse[i] = total
    correction[i] = total / (diagonal[i] + prior.smooth[0] * HAT + prior.damping[0] * four)


@wp.kernel
def prolong(
    coarse: wp.array(dtype=float),
    columns: int,
    fine_rows: int,
    fine_columns: int,
    start: int,
    fine: wp.array(dtype=float),
):
    """Interpolate the coarser grid's correction and add it to the finer grid's."""
    i = start + wp.tid()
    row = i / fine_columns
    column = i % fine_columns
    if row >= fine_rows:
        return
    at = (row / 2) * columns + column / 2
    right = column % 2
    down = (row % 2) * columns
    fine[i] = fine[i] + 0.25 * (coarse[at] + coarse[at + right] + coarse[at + down] + coarse[at + right + down])
