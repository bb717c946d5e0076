"""Kernels of the conjugate-gradient method for the unknowns of a brightness map.

Sums are in fixed point, so they do not depend on the order of threads. A thread processes ``width`` unknowns in order:
many on a CPU, one on CUDA, where each block adds up its threads. Dot products are stored as partial sums; each block of
the next kernel adds them up itself. Nothing is copied to the host, and the results are bit-identical on every run.
"""

import warp as wp

from amiwarp.kernels.warp_sums import ends_run, sum_run

wp.set_module_options({"enable_backward": False})


EXTRA = wp.constant(2)  # number of unknowns that follow the map nodes: leak and OFF threshold


@wp.struct
class Prior:
    """Prior cost of a map x: damping x² plus the sum of weight (xᵢ - xⱼ)² over all links. No link leaves a tile."""

    damping: wp.array(dtype=float)  # one element
    linked: int  # 1 if there are links, else 0
    columns: int
    held: int  # index of the first fixed unknown; all later ones are fixed, too
    smooth: wp.array(dtype=float)  # one element: weight of a link between equal neighbours
    right: wp.array(dtype=float)  # weight of the link to the next node; 0 in a tile's last column
    down: wp.array(dtype=float)  # weight of the link to the node below; 0 in a tile's last row


@wp.func
def prior_product(prior: Prior, vector: wp.array(dtype=float), i: int) -> float:
    """Return element ``i`` of the prior's operator times a vector."""
    total = prior.damping[0] * vector[i]
    if prior.linked == 0:
        return total
    if prior.right[i] > 0.0:
        total += prior.right[i] * (vector[i] - vector[i + 1])
    if prior.down[i] > 0.0:
        total += prior.down[i] * (vector[i] - vector[i + prior.columns])
    if i > 0 and prior.right[i - 1] > 0.0:
        total += prior.right[i - 1] * (vector[i] - vector[i - 1])
    if i >= prior.columns and prior.down[i - prior.columns] > 0.0:
        total += prior.down[i - prior.columns] * (vector[i] - vector[i - prior.columns])
    return total


@wp.func
def prior_diagonal(prior: Prior, i: int) -> float:
    """Return element ``i`` of the diagonal of the prior's operator.

    For a fixed unknown it is so large that the preconditioner suppresses every step.
    """
    if i >= prior.held:
        return 1.0e30
    total = prior.damping[0]
    if prior.linked == 0:
        return total
    total += prior.right[i] + prior.down[i]
    if i > 0:
        total += prior.right[i - 1]
    if i >= prior.columns:
        total += prior.down[i - prior.columns]
    return total


@wp.func
def link_weight(difference: float, smooth: float, edge: float) -> float:
    """Return Charbonnier's weight of a link, which decreases if neighbours differ by more than ``edge`` [thresholds].

    An ``edge`` of 0 gives all links equal weight.
    """
    if edge <= 0.0:
        return smooth
    return smooth / wp.sqrt(1.0 + (difference / edge) * (difference / edge))


@wp.kernel
def link(
    image: wp.array(dtype=float),
    rows: int,
    edge: float,
    prior: Prior,
    start: int,
    right: wp.array(dtype=float),
    down: wp.array(dtype=float),
):
    """Compute the weights of the links from each node of the map."""
    i = start + wp.tid()
    if i >= right.shape[0]:
        return
    right[i] = 0.0
    down[i] = 0.0
    columns = prior.columns
    row = i / columns
    if i < image.shape[0] - EXTRA:
        if i % columns < columns - 1:
            right[i] = link_weight(image[i + 1] - image[i], prior.smooth[0], edge)
        if row % rows < rows - 1:
            down[i] = link_weight(image[i + columns] - image[i], prior.smooth[0], edge)


FIXED = wp.constant(wp.float64(4294967296.0))  # 2**32: fixed-point units per 1 in the sums
# Initial value of the previous r·z, so that the first search direction is z
NO_PREVIOUS = wp.constant(wp.float64(1.0e300))
CPU_WIDTH = 4096  # number of unknowns per CPU thread


@wp.struct
class Unknowns:
    """Vectors of the conjugate-gradient method, with one element per unknown that is solved for."""

    diagonal: wp.array(dtype=float)  # diagonal of the operator, prior included
    residual: wp.array(dtype=float)  # r, the residual of the normal equations
    direction: wp.array(dtype=float)  # p, the search direction
    product: wp.array(dtype=float)  # q, the product of the operator and p


@wp.struct
class Dots:
    """Dot products of the conjugate-gradient method on the device."""

    scalars: wp.array(dtype=wp.float64)  # r·z of the present search direction, and of the next
    pq: wp.array(dtype=wp.float64)  # partial sums of p·q
    rz: wp.array(dtype=wp.float64)


@wp.func
def to_fixed(value: float) -> wp.int64:
    """Convert a value to fixed point (units of 2**-32)."""
    return wp.int64(wp.float64(value) * FIXED)


@wp.func
def add_fixed(sums: wp.array(dtype=wp.int64), i: int, value: float):
    """Add a value to element ``i`` of fixed-point sums, atomically."""
    wp.atomic_add(sums, i, to_fixed(value))


@wp.func
def add_from_warp(sums: wp.array(dtype=wp.int64), i: int, value: float):
    """Add a value of each thread to element ``i``. On CUDA all threads of a warp must call it; one of them adds."""
    total = sum_run(value, 1)
    if ends_run(0):
        add_fixed(sums, i, total)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned long long* at = (unsigned long long*)sums.data + i;
    atomicAdd(at, (unsigned long long)a);
    atomicAdd(at + 1, (unsigned long long)b);
#elif defined(__clang__)
    typedef long long Two __attribute__((vector_size(16), aligned(8)));
    *(Two*)((int64_t*)sums.data + i) += Two{(long long)a, (long long)b};
#endif
""")
def add_two(sums: wp.array(dtype=wp.int64), i: int, a: wp.int64, b: wp.int64):
    """Add two values to neighbouring elements: atomically on CUDA; on a CPU both at once, if no other thread writes."""


@wp.func
def take_total(sums: wp.array2d(dtype=wp.int64), i: int) -> float:
    """Return the total of an element over the slices of sums, and clear the element for the next pass."""
    total = wp.int64(0)
    for k in range(sums.shape[0]):
        total += sums[k, i]
        sums[k, i] = wp.int64(0)
    return float(wp.float64(total) / FIXED)


@wp.kernel
def add_multiple(
    vector: wp.array(dtype=float), factor: float, start: int, out: wp.array(dtype=float)
):
    """Add a vector times a factor."""
    i = start + wp.tid()
    out[i] = out[i] + factor * vector[i]


@wp.kernel
def gather(sums: wp.array2d(dtype=wp.int64), start: int, out: wp.array(dtype=float)):
    """Compute the total of each element over the slices of sums, and clear the slices."""
    i = start + wp.tid()
    if i < out.shape[0]:
        out[i] = take_total(sums, i)


@wp.kernel
def gather_diagonal(
    sums: wp.array2d(dtype=wp.int64), prior: Prior, start: int, out: wp.array(dtype=float)
):
    """Compute the diagonal of the operator from the equations' sums and the prior, and clear the sums."""
    i = start + wp.tid()
    if i < out.shape[0]:
        out[i] = take_total(sums, i) + prior_diagonal(prior, i)


# On a CPU, a thread's range of unknowns is processed by the vectorised loops below, eight at a time. Their dot products
# are eight partial sums, so they depend on the range only.


@wp.func_native("""
#if defined(__clang__)
    const int n = last - first;
    int64_t fixed[512];
    for (int at = 0; at < n; at += 512) {
        const int m = n - at < 512 ? n - at : 512;
        for (int i = 0; i < m; ++i) fixed[i] = 0;
        for (int k = 0; k < sums.shape[0]; ++k) {
            int64_t* from = (int64_t*)((char*)sums.data + (size_t)sums.strides[0] * k) + first + at;
            for (int i = 0; i < m; ++i) {
                fixed[i] += from[i];
                from[i] = 0;
            }
        }
        float* to = (float*)out.data + first + at;
        for (int i = 0; i < m; ++i)
            to[i] = (float)((double)(int32_t)(fixed[i] >> 32) + (double)(uint32_t)fixed[i] * (1.0 / 4294967296.0));
    }
#endif
""")
def take_totals(
    sums: wp.array2d(dtype=wp.int64), first: int, last: int, out: wp.array(dtype=float)
):
    """Store :func:`take_total` of the elements from ``first`` to ``last`` in ``out``. For CPUs."""


@wp.func_native("""
#if defined(__clang__)
    const float* p = (const float*)u.direction.data;
    float* q = (float*)u.product.data;
    const int n = u.direction.shape[0], columns = prior.columns;
    const float damping = *(const float*)prior.damping.data;
    if (prior.linked) {
        const float* right = (const float*)prior.right.data;
        const float* down = (const float*)prior.down.data;
        const int low = first > columns ? first : columns, high = last < n - columns ? last : n - columns;
        for (int i = low; i < high; ++i) {
            const float across = right[i] * (p[i] - p[i + 1]) + right[i - 1] * (p[i] - p[i - 1]);
            q[i] += across + down[i] * (p[i] - p[i + columns]) + down[i - columns] * (p[i] - p[i - columns]);
        }
        for (int i = first; i < last; ++i) {
            if (i >= low && i < high) continue;
            if (i + 1 < n) q[i] += right[i] * (p[i] - p[i + 1]);
            if (i > 0) q[i] += right[i - 1] * (p[i] - p[i - 1]);
            if (i + columns < n) q[i] += down[i] * (p[i] - p[i + columns]);
            if (i >= columns) q[i] += down[i - columns] * (p[i] - p[i - columns]);
        }
    }
    for (int i = first; i < last; ++i) q[i] += damping * p[i];
#endif
""")
def add_prior_product(u: Unknowns, prior: Prior, first: int, last: int):
    """Compute q += prior p from ``first`` to ``last``, see :func:`prior_product`. For CPUs."""


@wp.func_native("""
#if defined(__clang__)
    const float* x = (const float*)a.data;
    const float* y = (const float*)b.data;
    double part[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    int i = first;
    for (; i + 8 <= last; i += 8)
        for (int k = 0; k < 8; ++k) part[k] += (double)x[i + k] * (double)y[i + k];
    for (; i < last; ++i) part[i & 7] += (double)x[i] * (double)y[i];
    return ((part[0] + part[4]) + (part[1] + part[5])) + ((part[2] + part[6]) + (part[3] + part[7]));
#else
    return 0.0;
#endif
""")
def dot_range(
    a: wp.array(dtype=float), b: wp.array(dtype=float), first: int, last: int
) -> wp.float64:
    """Return the part of a·b from ``first`` to ``last``. For CPUs."""


@wp.func_native("""
#if defined(__clang__)
    float* x = (float*)image.data;
    const float* p = (const float*)u.direction.data;
    const float* q = (const float*)u.product.data;
    const float* diagonal = (const float*)u.diagonal.data;
    float* r = (float*)u.residual.data;
    double part[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    int i = first;
    for (; i + 8 <= last; i += 8)
        for (int k = 0; k < 8; ++k) {
            x[i + k] += step * p[i + k];
            r[i + k] -= step * q[i + k];
            part[k] += (double)r[i + k] * (double)(r[i + k] / diagonal[i + k]);
        }
    for (; i < last; ++i) {
        x[i] += step * p[i];
        r[i] -= step * q[i];
        part[i & 7] += (double)r[i] * (double)(r[i] / diagonal[i]);
    }
    return ((part[0] + part[4]) + (part[1] + part[5])) + ((part[2] + part[6]) + (part[3] + part[7]));
#else
    return 0.0;
#endif
""")
def descend_range(
    image: wp.array(dtype=float), u: Unknowns, step: float, first: int, last: int
) -> wp.float64:
    """Compute :func:`descend` from ``first`` to ``last``, and return the part of r·z. For CPUs."""


@wp.func_native("""
    float* p = (float*)u.direction.data;
    const float* towards = (const float*)z.data;
    for (int i = first; i < last; ++i) p[i] = towards[i] + ratio * p[i];
""")
def update_range_with(z: wp.array(dtype=float), u: Unknowns, ratio: float, first: int, last: int):
    """Compute :func:`update_search_direction_with` from ``first`` to ``last``."""


@wp.func_native("""
#if defined(__clang__)
    float* p = (float*)u.direction.data;
    const float* r = (const float*)u.residual.data;
    const float* diagonal = (const float*)u.diagonal.data;
    for (int i = first; i < last; ++i) p[i] = r[i] / diagonal[i] + ratio * p[i];
#endif
""")
def update_range(u: Unknowns, ratio: float, first: int, last: int):
    """Compute :func:`update_search_direction` from ``first`` to ``last``. For CPUs."""


@wp.func
def block_sum(value: wp.float64) -> wp.float64:
    """Return the sum of a value over the threads of a block to every thread, added in fixed order."""
    total = wp.tile_sum(wp.tile(value))
    return total[0]


@wp.func
def total_of(partial: wp.array(dtype=wp.float64), thread: int) -> wp.float64:
    """Return the total of partial sums to every thread of the block."""
    total = wp.float64(0.0)
    for i in range(thread % wp.block_dim(), partial.shape[0], wp.block_dim()):
        total += partial[i]
    return block_sum(total)


@wp.func
def store_partial_sum(partial: wp.array(dtype=wp.float64), thread: int, total: wp.float64):
    """Store the block's part of a dot product."""
    both = block_sum(total)
    if thread % wp.block_dim() == 0:
        partial[thread / wp.block_dim()] = both


@wp.kernel
def start_descent(
    sums: wp.array2d(dtype=wp.int64),
    prior: Prior,
    image: wp.array(dtype=float),
    width: int,
    start: int,
    u: Unknowns,
    dots: Dots,
):
    """Compute r = Aᵀ W (b - A x) - prior x, and partial sums of r·z, where z = r / diagonal."""
    thread = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, image.shape[0])):
        r = take_total(sums, i) - prior_product(prior, image, i)
        u.residual[i] = r
        u.direction[i] = 0.0
        total += wp.float64(r) * wp.float64(r / u.diagonal[i])
    store_partial_sum(dots.rz, thread, total)
    if thread == 0:
        dots.scalars[0] = NO_PREVIOUS


@wp.func
def next_ratio(dots: Dots, thread: int) -> float:
    """Return b = new r·z / old r·z.

    The new value is stored separately, because other blocks may not have read the old value yet.
    """
    new = total_of(dots.rz, thread)
    if thread == 0:
        dots.scalars[1] = new
    return float(new / wp.max(dots.scalars[0], wp.float64(1.0e-30)))


@wp.kernel
def update_search_direction(width: int, start: int, u: Unknowns, dots: Dots):
    """Compute the search direction p = z + b p, where z = r / diagonal and b is :func:`next_ratio`."""
    thread = start + wp.tid()
    ratio = next_ratio(dots, thread)
    first = thread * width
    last = wp.min(first + width, u.residual.shape[0])
    if width > 1:
        update_range(u, ratio, first, last)
        return
    for i in range(first, last):
        z = u.residual[i] / u.diagonal[i]
        u.direction[i] = z + ratio * u.direction[i]


@wp.kernel
def update_search_direction_with(
    z: wp.array(dtype=float), width: int, start: int, u: Unknowns, dots: Dots
):
    """Compute the search direction p = z + b p for a given z, where b is :func:`next_ratio`."""
    thread = start + wp.tid()
    ratio = next_ratio(dots, thread)
    update_range_with(z, u, ratio, thread * width, wp.min((thread + 1) * width, z.shape[0]))


@wp.kernel
def finish_product(
    sums: wp.array2d(dtype=wp.int64), prior: Prior, width: int, start: int, u: Unknowns, dots: Dots
):
    """Compute q = (Aᵀ W A + prior) p from the sums, and partial sums of p·q."""
    thread = start + wp.tid()
    total = wp.float64(0.0)
    first = thread * width
    last = wp.min(first + width, u.direction.shape[0])
    if width > 1:
        take_totals(sums, first, last, u.product)
        add_prior_product(u, prior, first, last)
        total = dot_range(u.direction, u.product, first, last)
    else:
        for i in range(first, last):
            q = take_total(sums, i) + prior_product(prior, u.direction, i)
            u.product[i] = q
            total += wp.float64(u.direction[i]) * wp.float64(q)
    store_partial_sum(dots.pq, thread, total)
    if thread == 0:
        dots.scalars[0] = dots.scalars[1]


@wp.kernel
def descend(width: int, start: int, image: wp.array(dtype=float), u: Unknowns, dots: Dots):
    """Compute x += a p and r -= a q with a = (r·z)/(p·q), and partial sums of the new r·z."""
    thread = start + wp.tid()
    step = float(dots.scalars[0] / wp.max(total_of(dots.pq, thread), wp.float64(1.0e-30)))
    total = wp.float64(0.0)
    first = thread * width
    last = wp.min(first + width, image.shape[0])
    if width > 1:
        total = descend_range(image, u, step, first, last)
    else:
        for i in range(first, last):
            image[i] = image[i] + step * u.direction[i]
            r = u.residual[i] - step * u.product[i]
            u.residual[i] = r
            total += wp.float64(r) * wp.float64(r / u.diagonal[i])
    store_partial_sum(dots.rz, thread, total)


@wp.kernel
def sum_seen(
    image: wp.array(dtype=float), width: int, start: int, partial: wp.array2d(dtype=wp.float64)
):
    """Compute partial sums of the squares of a map, and of the number of its nodes that are not 0."""
    thread = start + wp.tid()
    squares = wp.float64(0.0)
    number = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, image.shape[0])):
        squares += wp.float64(image[i]) * wp.float64(image[i])
        number += wp.where(image[i] != 0.0, wp.float64(1.0), wp.float64(0.0))
    store_partial_sum(partial[0], thread, squares)
    store_partial_sum(partial[1], thread, number)


@wp.kernel
def dot(
    a: wp.array(dtype=float),
    b: wp.array(dtype=float),
    width: int,
    start: int,
    partial: wp.array(dtype=wp.float64),
):
    """Compute partial sums of a·b."""
    thread = start + wp.tid()
    total = wp.float64(0.0)
    first = thread * width
    last = wp.min(first + width, a.shape[0])
    if width > 1:
        total = dot_range(a, b, first, last)
    else:
        for i in range(first, last):
            total += wp.float64(a[i]) * wp.float64(b[i])
    store_partial_sum(partial, thread, total)
