"""Equations of a brightness map on a CPU, which processes chains of event pairs in vectorised loops.

Most pairs of a pixel begin where the pair before them ends. Successive pairs with a common position form a chain. A
block of pairs stores the positions of its chains one after the other, so that each is loaded once, and added to once. A
thread processes a block.

:mod:`amiwarp.kernels.equations_cuda` does the same on CUDA, so that each device compiles only what it runs.
"""

import warp as wp

from amiwarp.kernels.camera import NAN
from amiwarp.kernels.equations import (
    Atlas,
    Geometry,
    Pairs,
    add_extra,
    add_extra_diagonal,
    residual_of,
    sensor_terms,
    weight_of,
)
from amiwarp.kernels.native_code import load_float, load_int, store_float

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(64)  # number of pairs per CPU thread; arrays are padded to whole blocks


@wp.struct
class Chains:
    """Positions on the map, 128 places per block of pairs; empty on CUDA.

    A pair's difference belongs to its second position, which follows the first. Pairs off the map get node 0, weight 0.
    """

    cell: wp.array(dtype=int)  # index of the map node up and left of each position
    x: wp.array(dtype=float)  # fractions to the next node
    y: wp.array(dtype=float)
    # Weight of the pair that ends at each position; 0 at the start of a chain
    weight: wp.array(dtype=float)
    count: wp.array(dtype=int)  # number of positions in each block
    end: wp.array(dtype=wp.uint8)  # place of each pair's second position in its block


@wp.func_native("""
    const int* from = (const int*)cells.data;
    const float* part = (const float*)parts.data;
    int* cell = (int*)chains.cell.data + 128 * block;
    float* x = (float*)chains.x.data + 128 * block;
    float* y = (float*)chains.y.data + 128 * block;
    int n = 0;
    for (int k = 0; k < 64; ++k) {
        const int i = 64 * block + k;
        for (int end = 0; end < 2; ++end) {
            const int at = from[end * stride + i] < 0 ? 0 : from[end * stride + i];
            const float fx = part[2 * end * stride + i], fy = part[(2 * end + 1) * stride + i];
            if (end == 0 && n > 0 && at == cell[n - 1] && fx == x[n - 1] && fy == y[n - 1]) continue;
            cell[n] = at;
            x[n] = fx;
            y[n++] = fy;
        }
        ((uint8_t*)chains.end.data)[i] = (uint8_t)(n - 1);
    }
    ((int*)chains.count.data)[block] = n;
    for (; n % 8 > 0; ++n) cell[n] = 0, x[n] = 0.0f, y[n] = 0.0f;
""")
def join_pairs(
    cells: wp.array(dtype=int),
    parts: wp.array(dtype=float),
    stride: int,
    chains: Chains,
    block: int,
):
    """Store the positions of a block of pairs without those that a pair shares with the one before."""


@wp.kernel
def make_chains(
    cells: wp.array(dtype=int),
    parts: wp.array(dtype=float),
    stride: int,
    start: int,
    chains: Chains,
):
    """Store the positions of one block of pairs per thread, from the arrays of ``Geometry``."""
    join_pairs(cells, parts, stride, chains, start + wp.tid())


@wp.func_native("""
    const float* from = (const float*)values.data + first;
    const uint8_t* end = (const uint8_t*)chains.end.data + 64 * block;
    float* to = (float*)ends.data + place;
    for (int j = 0; j < 128; ++j) to[j] = 0.0f;
    for (int k = 0; k < 64; ++k) to[end[k]] = from[k];
""")
def move_to_ends(
    ends: wp.array(dtype=float),
    place: int,
    values: wp.array(dtype=float),
    first: int,
    chains: Chains,
    block: int,
):
    """Store the values of a block of pairs at the places of their second positions; the other places become 0.

    The values are the 64 elements from ``first`` on. The places are the 128 elements of ``ends`` from ``place`` on.
    """


@wp.kernel
def weigh_chains(weight: wp.array(dtype=float), start: int, chains: Chains):
    """Copy the weights of one block of pairs per thread to the positions at which the pairs end."""
    block = start + wp.tid()
    move_to_ends(chains.weight, 2 * BLOCK * block, weight, BLOCK * block, chains, block)


@wp.func_native("""
#if defined(__clang__)
    typedef uint64_t Eight __attribute__((vector_size(64)));
    const float* map = (const float*)vector.data;
    const int* cell = (const int*)cells.data + first;
    const float* fx = (const float*)x.data + first;
    const float* fy = (const float*)y.data + first;
    alignas(64) float upper[256], lower[256];
    for (int j = 0; j < n; j += 8) {
        uint64_t a[8], b[8];
        for (int i = 0; i < 8; ++i) {
            memcpy(a + i, map + cell[j + i], 8);
            memcpy(b + i, map + cell[j + i] + columns, 8);
        }
        const Eight above = {a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7]};
        const Eight below = {b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]};
        memcpy(upper + 2 * j, &above, 64);
        memcpy(lower + 2 * j, &below, 64);
    }
    float* at = (float*)levels.data + 16;
    for (int j = 0; j < n; ++j) {
        const float u = upper[2 * j] + (upper[2 * j + 1] - upper[2 * j]) * fx[j];
        const float v = lower[2 * j] + (lower[2 * j + 1] - lower[2 * j]) * fx[j];
        at[j] = u + (v - u) * fy[j];
    }
#endif
""")
def interpolate(
    levels: wp.array(dtype=float),
    vector: wp.array(dtype=float),
    columns: int,
    cells: wp.array(dtype=int),
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    first: int,
    n: int,
):
    """Compute the brightness at ``n`` positions, a multiple of 8 of at most 128, from element 16 of ``levels`` on.

    The positions are the elements of ``cells``, ``x`` and ``y`` from ``first`` on, as in :class:`Chains`.
    """


@wp.func
def find_levels(
    levels: wp.array(dtype=float),
    chains: Chains,
    vector: wp.array(dtype=float),
    columns: int,
    block: int,
):
    """Compute the brightness at the positions of a block, from element 16 of ``levels`` (144 elements) on.

    The difference of a pair is the level at its second position minus the element before. Element 15 is 0.
    """
    n = (chains.count[block] + 7) / 8 * 8
    interpolate(levels, vector, columns, chains.cell, chains.x, chains.y, 2 * BLOCK * block, n)


@wp.func_native("""
    const int n = (((const int*)chains.count.data)[block] + 7) & ~7;
    const float* weight = (const float*)chains.weight.data + 128 * block;
    const float* at = (const float*)levels.data + 16;
    float* out = (float*)values.data;
    for (int j = 0; j < n; ++j) out[j] = weight[j] * (at[j] - at[j - 1]);
""")
def weighted_differences(
    values: wp.array(dtype=float), levels: wp.array(dtype=float), chains: Chains, block: int
):
    """Compute weight · (L(second) - L(first)) of each pair in a block, at the place of its second position."""


@wp.func_native("""
    const float* at = (const float*)levels.data + 16;
    const uint8_t* end = (const uint8_t*)chains.end.data + 64 * block;
    float* out = (float*)values.data;
    for (int k = 0; k < 64; ++k) out[k] = at[end[k]] - at[end[k] - 1];
""")
def pair_differences(
    values: wp.array(dtype=float), levels: wp.array(dtype=float), chains: Chains, block: int
):
    """Compute L(second) - L(first) of the 64 pairs in a block, in their order."""


POSITIONS = """
    const int n = ((const int*)chains.count.data)[block], padded = (n + 7) & ~7;
    const int* cell = (const int*)chains.cell.data + 128 * block;
    const float* x = (const float*)chains.x.data + 128 * block;
    const float* y = (const float*)chains.y.data + 128 * block;
    alignas(64) float share[512];
"""
"""Declares the positions of a block, in C++, and an array for the share of each position in the four nodes around."""
ADD_SHARES = """
    typedef long long Two __attribute__((vector_size(16), aligned(8)));
    typedef long long Four __attribute__((vector_size(32)));
    typedef double Real __attribute__((vector_size(32)));
    typedef float Shares __attribute__((vector_size(16)));
    const Real origin = {1572864.0, 1572864.0, 1572864.0, 1572864.0};
    for (int first = 0; first < 4; ++first)
#pragma clang loop unroll(disable)
        for (int j = first; j < n; j += 4) {
            Shares four;
            memcpy(&four, share + 4 * j, 16);
            const Real moved = __builtin_convertvector(four, Real) + origin;
            const Four fixed = (Four)moved - (Four)origin;
            int64_t* to = (int64_t*)sums.data + cell[j];
            *(Two*)to += Two{fixed[0], fixed[1]};
            *(Two*)(to + columns) += Two{fixed[2], fixed[3]};
        }
"""
"""Adds the shares to the sums, in C++, if no other thread writes to them.

The bits of a double between 2**20 and 2**21 are a number in units of 2**-32, as
:func:`amiwarp.kernels.conjugate_gradients.to_fixed` returns. So shares must be below 2**19. Neighbouring positions are
not added one right after the other, because a vector load waits for a store that overlaps it in part. The loop is not
unrolled, see :func:`amiwarp.kernels.native_code.add_word_pairs`.
"""


@wp.func_native(f"""
#if defined(__clang__)
    {POSITIONS}
    const float* value = (const float*)values.data;
    for (int j = 0; j < padded; ++j) {{
        const float s = value[j] - value[j + 1], below = s * y[j], above = s - below;
        share[4 * j + 1] = above * x[j];
        share[4 * j + 3] = below * x[j];
        share[4 * j] = above - share[4 * j + 1];
        share[4 * j + 2] = below - share[4 * j + 3];
    }}
    {ADD_SHARES}
#endif
""")
def add_differences(
    sums: wp.array(dtype=wp.int64),
    values: wp.array(dtype=float),
    chains: Chains,
    columns: int,
    block: int,
):
    """Add the transpose of the differences of a block times their values to the sums; see :data:`ADD_SHARES`.

    The element of ``values`` after the last one must be 0.
    """


@wp.func_native(f"""
#if defined(__clang__)
    {POSITIONS}
    const float* weight = (const float*)chains.weight.data + 128 * block;
    for (int j = 0; j < padded; ++j) {{
        const float both = weight[j] + (j < 127 ? weight[j + 1] : 0.0f);
        const float right = x[j] * x[j], left = (1.0f - x[j]) * (1.0f - x[j]);
        const float below = both * (y[j] * y[j]), above = both * ((1.0f - y[j]) * (1.0f - y[j]));
        share[4 * j] = above * left;
        share[4 * j + 1] = above * right;
        share[4 * j + 2] = below * left;
        share[4 * j + 3] = below * right;
    }}
    {ADD_SHARES}
#endif
""")
def add_weights(sums: wp.array(dtype=wp.int64), chains: Chains, columns: int, block: int):
    """Add the squares of the bilinear weights of a block's positions, times the weights of the pairs that they end or
    begin, to the sums; see :data:`ADD_SHARES`."""


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
        # The residual of a pair off the map is NaN
        store_float(products, k, wp.where(w > 0.0, product, 0.0))
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
        store_float(
            values, k, load_float(values, k) + sensor_terms(vector, atlas, pairs, BLOCK * block + k)
        )
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
