"""All equations of a brightness map together, on CUDA: residuals, weights, and the value of each pair.

A thread processes one pair. :mod:`amiwarp.kernels.pair_ends` adds the values to the nodes of the map. On CPUs
:mod:`amiwarp.kernels.equation_blocks` does both.
"""

import warp as wp

from amiwarp.kernels.camera import NAN
from amiwarp.kernels.photometric import (
    Atlas,
    Geometry,
    Pairs,
    add_extra,
    add_extra_diagonal,
    difference,
    residual_of,
    weight_of,
)

wp.set_module_options({"enable_backward": False})


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
        value = wp.where(weight[i] > 0.0, weight[i] * residual[i], 0.0)  # the residual of a pair off the map is NaN
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
    pairs: Pairs, atlas: Atlas, weight: wp.array(dtype=float), start: int, sums: wp.array(dtype=wp.int64)
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
