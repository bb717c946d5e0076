"""All equations of a brightness map together: the operator of the weighted equations, their residuals and weights.

Each operation has two kernels: on CUDA a thread processes one pair, on a CPU a block of :data:`BLOCK` pairs in
vectorised loops.
"""

import warp as wp

from amiwarp.kernels.camera import NAN
from amiwarp.kernels.conjugate_gradients import add_two, to_fixed
from amiwarp.kernels.pair_chains import (
    BLOCK,
    Chains,
    add_differences,
    add_weights,
    find_levels,
    pair_differences,
    weighted_differences,
)
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
    sensor_terms,
    transpose_add,
    weight_of,
)
from amiwarp.kernels.vector_code import load_float, load_int, store_float

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
    """Compute sums += Aᵀ W A vector for equations A with weights W, one pair of events per thread."""
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
def apply_normal_blocks(
    pairs: Pairs,
    atlas: Atlas,
    chains: Chains,
    weight: wp.array(dtype=float),
    vector: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += Aᵀ W A vector for equations A with weights W, one block of pairs per thread. For CPUs."""
    block = start + wp.tid()
    levels = wp.zeros(shape=(144,), dtype=float)
    values = wp.zeros(shape=(144,), dtype=float)
    find_levels(levels, chains, vector, atlas.columns, block)
    weighted_differences(values, levels, chains, block)
    if atlas.with_leak > 0.0 or atlas.with_off != 0:
        for k in range(BLOCK):
            i = BLOCK * block + k
            end = int(chains.end[i])
            values[end] += weight[i] * sensor_terms(vector, atlas, pairs, i)
            add_extra(sums, atlas, pairs, i, values[end])
    add_differences(sums, values, chains, atlas.columns, block)


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
def apply_transpose_blocks(
    pairs: Pairs,
    atlas: Atlas,
    chains: Chains,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += Aᵀ W residual for equations A with weights W, one block of pairs per thread. For CPUs."""
    block = start + wp.tid()
    values = wp.zeros(shape=(144,), dtype=float)
    for k in range(BLOCK):
        i = BLOCK * block + k
        if weight[i] > 0.0:  # the residual of a pair off the map is NaN
            value = weight[i] * residual[i]
            values[int(chains.end[i])] = value
            add_extra(sums, atlas, pairs, i, value)
    add_differences(sums, values, chains, atlas.columns, block)


@wp.kernel
def subtract_blocks(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    chains: Chains,
    vector: wp.array(dtype=float),
    start: int,
    residual: wp.array(dtype=float),
):
    """Compute residual -= A vector as :func:`subtract` does, one block of pairs per thread. For CPUs."""
    block = start + wp.tid()
    levels = wp.zeros(shape=(144,), dtype=float)
    values = wp.zeros(shape=(64,), dtype=float)
    find_levels(levels, chains, vector, atlas.columns, block)
    pair_differences(values, levels, chains, block)
    for k in range(BLOCK):
        i = BLOCK * block + k
        rest = load_float(residual, i) - values[k] - sensor_terms(vector, atlas, pairs, i)
        store_float(residual, i, wp.where(load_int(geometry.cell, i) >= 0, rest, 0.0))


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
def add_diagonal_blocks(
    pairs: Pairs,
    atlas: Atlas,
    chains: Chains,
    weight: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += diag(Aᵀ W A) as :func:`add_diagonal` does, one block of pairs per thread. For CPUs."""
    block = start + wp.tid()
    add_weights(sums, chains, atlas.columns, block)
    if atlas.with_leak > 0.0 or atlas.with_off != 0:
        for k in range(BLOCK):
            i = BLOCK * block + k
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


@wp.kernel
def weigh_blocks(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    chains: Chains,
    image: wp.array(dtype=float),
    scale: wp.array(dtype=float),
    start: int,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
):
    """Compute residuals and weights as :func:`weigh` does, one block of pairs per thread. For CPUs."""
    block = start + wp.tid()
    levels = wp.zeros(shape=(144,), dtype=float)
    values = wp.zeros(shape=(64,), dtype=float)
    find_levels(levels, chains, image, atlas.columns, block)
    pair_differences(values, levels, chains, block)
    for k in range(BLOCK):
        i = BLOCK * block + k
        r = residual_of(pairs, load_float(values, k) + sensor_terms(image, atlas, pairs, i), i)
        on_map = i < pairs.count and load_int(geometry.cell, i) >= 0
        store_float(residual, i, wp.where(on_map, r, NAN))
        store_float(weight, i, wp.where(on_map, weight_of(pairs, r, scale[0], i), 0.0))
