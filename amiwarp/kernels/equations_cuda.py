"""Equations of a brightness map on CUDA, which adds the ends of event pairs in the order of the map.

A thread computes the value of one pair. A pair has two ends: the positions of its two events. Other threads add the
values to the nodes of the map, a thread an end. In the order of the map, neighbouring threads add to the same nodes. A
warp first adds up what its threads have for each cell, so that few of them add to the sums.

On CPUs, :mod:`amiwarp.kernels.equations_cpu` does the same.
"""

import warp as wp

from amiwarp.kernels.camera import NAN
from amiwarp.kernels.conjugate_gradients import EXTRA, add_two, to_fixed
from amiwarp.kernels.equations import (
    Atlas,
    Geometry,
    Pairs,
    add_extra,
    add_extra_diagonal,
    bilinear,
    difference,
    residual_of,
    weight_of,
)
from amiwarp.kernels.warp_sums import ends_run, run_starts, sum_run

wp.set_module_options({"enable_backward": False})


@wp.struct
class Ends:
    """Ends in the order of the map. If a pair begins where the one before it ends, both are stored as one end.

    The number of an end is the index of its pair, plus the stride for a second event, plus twice the stride if the next
    pair begins there.
    """

    order: wp.array(dtype=int)  # number of each end
    # Index of the map node up and left of each end; the number of nodes for unused elements
    cell: wp.array(dtype=int)
    part: wp.array(dtype=wp.vec2)  # fractions (x, y) to the next node


@wp.func
def continues_previous(geometry: Geometry, i: int) -> bool:
    """Return whether pair i begins at the position on the map at which pair i - 1 ends."""
    if i == 0:
        return False
    before = geometry.stride + i - 1
    if geometry.cell[i] < 0 or geometry.cell[i] != geometry.cell[before]:
        return False
    same_x = geometry.part[i] == geometry.part[geometry.stride + before]
    return (
        same_x and geometry.part[geometry.stride + i] == geometry.part[2 * geometry.stride + before]
    )


@wp.kernel
def list_ends(
    geometry: Geometry,
    count: int,
    nodes: int,
    start: int,
    cell: wp.array(dtype=int),
    order: wp.array(dtype=int),
):
    """List the cell and the number of the first and the second end of each of ``count`` pairs."""
    end = start + wp.tid()
    second = end >= geometry.stride
    i = end - wp.where(second, geometry.stride, 0)
    cell[end] = nodes
    order[end] = end
    if i >= count or geometry.cell[end] < 0:
        return
    if not second:
        cell[end] = wp.where(continues_previous(geometry, i), nodes, geometry.cell[end])
    else:
        cell[end] = geometry.cell[end]
        if i + 1 < count and continues_previous(geometry, i + 1):
            order[end] = end + geometry.stride


@wp.kernel
def take_fractions(geometry: Geometry, start: int, ends: Ends):
    """Store the fractions of the ends in their order."""
    end = start + wp.tid()
    number = ends.order[end]
    i = number % geometry.stride
    x = i + wp.where(number >= geometry.stride, 2 * geometry.stride, 0)
    ends.part[end] = wp.vec2(geometry.part[x], geometry.part[x + geometry.stride])


@wp.func
def value_at(values: wp.array(dtype=float), number: int, stride: int, squared: int) -> float:
    """Return the value of the pair that ends here, minus (plus if squared) the value of the pair that begins here."""
    i = number % stride
    sign = wp.where(squared != 0, 1.0, -1.0)
    if number < stride:
        return sign * values[i]
    if number < 2 * stride:
        return values[i]
    return values[i] + sign * values[i + 1]


@wp.kernel
def add_ends(
    ends: Ends,
    stride: int,
    columns: int,
    values: wp.array(dtype=float),
    squared: int,
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Add each pair's value times the bilinear weights of its second end, minus the weights of its first, to the sums.

    With ``squared``, add its value times the squares of the bilinear weights of both ends.
    """
    end = start + wp.tid()
    # No warp has ends and further threads: the stride is 64 n
    cell = ends.cell[wp.min(end, 2 * stride - 1)]
    used = end < 2 * stride and cell < sums.shape[0] - EXTRA
    share = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if used:
        share = bilinear(ends.part[end])
        if squared != 0:
            share = wp.cw_mul(share, share)
        share = share * value_at(values, ends.order[end], stride, squared)
    starts = run_starts(cell)
    last = ends_run(cell)
    upper_left = sum_run(share[0], starts)
    upper_right = sum_run(share[1], starts)
    lower_left = sum_run(share[2], starts)
    lower_right = sum_run(share[3], starts)
    if last and used:
        add_two(sums, cell, to_fixed(upper_left), to_fixed(upper_right))
        add_two(sums, cell + columns, to_fixed(lower_left), to_fixed(lower_right))


@wp.kernel
def find_flows(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    vector: wp.array(dtype=float),
    start: int,
    flow: wp.array(dtype=float),
    sums: wp.array(dtype=wp.int64),
):
    """Compute flow = W A vector for equations A with weights W, and sums += Aᵀ flow for leak and OFF threshold."""
    thread = start + wp.tid()
    i = wp.min(thread, pairs.count - 1)
    value = float(0.0)
    if thread < pairs.count:
        value = weight[i] * difference(vector, atlas, pairs, geometry, i)
        flow[i] = value
    add_extra(sums, atlas, pairs, i, value)


@wp.kernel
def weigh_residuals(
    pairs: Pairs,
    atlas: Atlas,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    flow: wp.array(dtype=float),
    sums: wp.array(dtype=wp.int64),
):
    """Compute flow = W residual for equations A with weights W, and sums += Aᵀ flow for leak and OFF threshold."""
    thread = start + wp.tid()
    i = wp.min(thread, pairs.count - 1)
    value = float(0.0)
    if thread < pairs.count:
        # The residual of a pair off the map is NaN
        value = wp.where(weight[i] > 0.0, weight[i] * residual[i], 0.0)
        flow[i] = value
    add_extra(sums, atlas, pairs, i, value)


@wp.kernel
def subtract(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    vector: wp.array(dtype=float),
    start: int,
    residual: wp.array(dtype=float),
):
    """Compute residual -= A vector for equations A; the residual is 0 for a pair off the map."""
    i = start + wp.tid()
    if i < pairs.count:
        rest = residual[i] - difference(vector, atlas, pairs, geometry, i)
        residual[i] = wp.where(geometry.cell[i] >= 0, rest, 0.0)


@wp.kernel
def add_sensor_diagonal(
    pairs: Pairs,
    atlas: Atlas,
    weight: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += diag(Aᵀ W A) for the leak and the OFF threshold."""
    thread = start + wp.tid()
    i = wp.min(thread, pairs.count - 1)
    add_extra_diagonal(sums, atlas, pairs, i, wp.where(thread < pairs.count, weight[i], 0.0))


@wp.kernel
def weigh(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    image: wp.array(dtype=float),
    scale: wp.array(dtype=float),
    start: int,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
):
    """Compute the residual of each equation and its Cauchy weight; NaN and 0 for a pair off the map."""
    i = start + wp.tid()
    if i >= pairs.count:
        return
    r = residual_of(pairs, difference(image, atlas, pairs, geometry, i), i)
    on_map = geometry.cell[i] >= 0
    residual[i] = wp.where(on_map, r, NAN)
    weight[i] = wp.where(on_map, weight_of(pairs, r, scale[0], i), 0.0)
