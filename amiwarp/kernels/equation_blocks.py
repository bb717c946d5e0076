"""All equations of a brightness map together, on a CPU: a thread processes a block of pairs in vectorised loops.

:mod:`amiwarp.kernels.normal_equations` and :mod:`amiwarp.kernels.pair_ends` do the same on CUDA. So each device
compiles only what it runs.
"""

import warp as wp

from amiwarp.kernels.camera import NAN
from amiwarp.kernels.pair_chains import (
    BLOCK,
    Chains,
    add_differences,
    add_weights,
    find_levels,
    move_to_ends,
    pair_differences,
    weighted_differences,
)
from amiwarp.kernels.photometric import (
    Atlas,
    Geometry,
    Pairs,
    add_extra,
    add_extra_diagonal,
    residual_of,
    sensor_terms,
    weight_of,
)
from amiwarp.kernels.vector_code import load_float, load_int, store_float

wp.set_module_options({"enable_backward": False})


@wp.kernel
def apply_normal(
    pairs: Pairs,
    atlas: Atlas,
    chains: Chains,
    weight: wp.array(dtype=float),
    vector: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += Aᵀ W A vector for equations A with weights W."""
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
    chains: Chains,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += Aᵀ W residual for equations A with weights W."""
    block = start + wp.tid()
    products = wp.zeros(shape=(64,), dtype=float)
    values = wp.zeros(shape=(144,), dtype=float)
    for k in range(BLOCK):
        w = load_float(weight, BLOCK * block + k)
        product = w * load_float(residual, BLOCK * block + k)
        store_float(products, k, wp.where(w > 0.0, product, 0.0))  # the residual of a pair off the map is NaN
    move_to_ends(values, 0, products, 0, chains, block)
    if atlas.with_leak > 0.0 or atlas.with_off != 0:
        for k in range(BLOCK):
            add_extra(sums, atlas, pairs, BLOCK * block + k, products[k])
    add_differences(sums, values, chains, atlas.columns, block)


@wp.kernel
def subtract(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    chains: Chains,
    vector: wp.array(dtype=float),
    start: int,
    residual: wp.array(dtype=float),
):
    """Compute residual -= A vector for equations A; the residual is 0 for a pair off the map."""
    block = start + wp.tid()
    levels = wp.zeros(shape=(144,), dtype=float)
    values = wp.zeros(shape=(64,), dtype=float)
    find_levels(levels, chains, vector, atlas.columns, block)
    pair_differences(values, levels, chains, block)
    for k in range(BLOCK):
        store_float(values, k, load_float(values, k) + sensor_terms(vector, atlas, pairs, BLOCK * block + k))
    for k in range(BLOCK):
        i = BLOCK * block + k
        rest = load_float(residual, i) - load_float(values, k)
        store_float(residual, i, wp.where(load_int(geometry.cell, i) >= 0, rest, 0.0))


@wp.kernel
def add_diagonal(
    pairs: Pairs,
    atlas: Atlas,
    chains: Chains,
    weight: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """Compute sums += diag(Aᵀ W A), the preconditioner, as if the two positions of a pair shared no node."""
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
    chains: Chains,
    image: wp.array(dtype=float),
    scale: wp.array(dtype=float),
    start: int,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
):
    """Compute the residual of each equation and its Cauchy weight; NaN and 0 for a pair off the map."""
    block = start + wp.tid()
    levels = wp.zeros(shape=(144,), dtype=float)
    values = wp.zeros(shape=(64,), dtype=float)
    weights = wp.zeros(shape=(64,), dtype=float)
    find_levels(levels, chains, image, atlas.columns, block)
    pair_differences(values, levels, chains, block)
    for k in range(BLOCK):
        i = BLOCK * block + k
        r = residual_of(pairs, load_float(values, k) + sensor_terms(image, atlas, pairs, i), i)
        store_float(values, k, r)
        store_float(weights, k, weight_of(pairs, r, scale[0], i))
    for k in range(BLOCK):
        i = BLOCK * block + k
        on_map = wp.where(load_int(geometry.cell, i) >= 0, wp.where(i < pairs.count, 1, 0), 0)
        store_float(residual, i, wp.where(on_map == 1, load_float(values, k), NAN))
        store_float(weight, i, wp.where(on_map == 1, load_float(weights, k), 0.0))
