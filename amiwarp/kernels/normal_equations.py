"""All equations of a brightness map together: the operator of the weighted equations, their residuals and weights.

A thread processes one pair. These kernels are for CUDA; :mod:`amiwarp.kernels.equation_blocks` has them for CPUs.
"""

import warp as wp

from amiwarp.kernels.camera import NAN
from amiwarp.kernels.conjugate_gradients import add_two, to_fixed
from amiwarp.kernels.photometric import (
    Atlas,
    Geometry,
    Pairs,
    add_extra,
    add_extra_diagonal,
    add_to_nodes,
    bilinear,
    continues_previous,
    difference,
    fractions_of,
    residual_of,
    transpose_add,
    weight_of,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def apply_normal(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    vector: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += Aᵀ W A vector for equations A with weights W."""
    i = start + wp.tid()
    if geometry.cell[i] < 0:
        return
    value = weight[i] * difference(vector, atlas, pairs, geometry, i)
    add_extra(sums, atlas, pairs, i, value)
    if i == 0 or not continues_previous(geometry, i):
        add_to_nodes(sums, geometry.cell[i], atlas.columns, fractions_of(geometry, 0, i), -value)
    if i + 1 < pairs.count and continues_previous(geometry, i + 1):
        value -= weight[i + 1] * difference(vector, atlas, pairs, geometry, i + 1)
    add_to_nodes(sums, geometry.cell[geometry.stride + i], atlas.columns, fractions_of(geometry, 1, i), value)


@wp.kernel
def apply_transpose(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += Aᵀ W residual for equations A with weights W."""
    i = start + wp.tid()
    transpose_add(sums, atlas, pairs, geometry, i, weight[i] * residual[i])


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
def add_diagonal(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += diag(Aᵀ W A), the preconditioner, as if the two positions of a pair shared no node."""
    i = start + wp.tid()
    if geometry.cell[i] < 0:
        return
    for k in range(2):
        w = bilinear(fractions_of(geometry, k, i))
        w = wp.cw_mul(w, w) * weight[i]
        cell = geometry.cell[k * geometry.stride + i]
        add_two(sums, cell, to_fixed(w[0]), to_fixed(w[1]))
        add_two(sums, cell + atlas.columns, to_fixed(w[2]), to_fixed(w[3]))
    add_extra_diagonal(sums, atlas, pairs, i, weight[i])


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
