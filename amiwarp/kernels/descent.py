"""Device side of conjugate gradients over a map's unknowns; sums in fixed point do not depend on the order.

A thread takes ``width`` unknowns, in order: many on a CPU, one on CUDA, where blocks add up. Dot products are left as
partial sums, which the next kernel adds up in each of its blocks: nothing is read back, and the bits are the same each
time.
"""

import warp as wp

from amiwarp.kernels.prior import Prior, prior_diagonal, prior_product

wp.set_module_options({"enable_backward": False})

FIXED = wp.constant(wp.float64(4294967296.0))  # 2**32: unit of the sums
NEVER = wp.constant(wp.float64(1.0e300))  # the last r·z, where there was none: the first direction is z
CPU_WIDTH = 4096


@wp.struct
class Unknowns:
    """Vectors of conjugate gradients, as long as the image that moves."""

    diagonal: wp.array(dtype=float)  # of the equations and the prior
    residual: wp.array(dtype=float)  # r, of the normal equations
    direction: wp.array(dtype=float)  # p
    product: wp.array(dtype=float)  # q: the operator's times p


@wp.struct
class Dots:
    """Dot products on the device."""

    scalars: wp.array(dtype=wp.float64)  # r·z of the direction as it is, and the one to come
    pq: wp.array(dtype=wp.float64)  # partial sums
    rz: wp.array(dtype=wp.float64)


@wp.func
def to_fixed(value: float) -> wp.int64:
    return wp.int64(wp.float64(value) * FIXED)


@wp.func
def add_fixed(sums: wp.array(dtype=wp.int64), i: int, value: float):
    wp.atomic_add(sums, i, to_fixed(value))


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
    """Adds to neighbours: atomically on CUDA; on a CPU, where the array is one thread's own, both at once."""


@wp.func
def gathered(sums: wp.array2d(dtype=wp.int64), i: int) -> float:
    """Total over the slices, which are cleared for the next pass."""
    total = wp.int64(0)
    for k in range(sums.shape[0]):
        total += sums[k, i]
        sums[k, i] = wp.int64(0)
    return float(wp.float64(total) / FIXED)


@wp.kernel
def gather(sums: wp.array2d(dtype=wp.int64), start: int, out: wp.array(dtype=float)):
    i = start + wp.tid()
    if i < out.shape[0]:
        out[i] = gathered(sums, i)


@wp.kernel
def gather_diagonal(sums: wp.array2d(dtype=wp.int64), prior: Prior, start: int, out: wp.array(dtype=float)):
    """The equations' diagonal and the prior's."""
    i = start + wp.tid()
    if i < out.shape[0]:
        out[i] = gathered(sums, i) + prior_diagonal(prior, i)


@wp.func
def block_sum(value: wp.float64) -> wp.float64:
    """Over the threads of a block, in fixed order; every thread gets it."""
    total = wp.tile_sum(wp.tile(value))
    return total[0]


@wp.func
def total_of(partial: wp.array(dtype=wp.float64), thread: int) -> wp.float64:
    total = wp.float64(0.0)
    for i in range(thread % wp.block_dim(), partial.shape[0], wp.block_dim()):
        total += partial[i]
    return block_sum(total)


@wp.func
def leave(partial: wp.array(dtype=wp.float64), thread: int, total: wp.float64):
    """A block's part of a dot product."""
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
    """r = Aᵀ W (b - A x) - prior x; partial sums of r·z, z being r over the diagonal."""
    thread = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, image.shape[0])):
        r = gathered(sums, i) - prior_product(prior, image, i)
        u.residual[i] = r
        u.direction[i] = 0.0
        total += wp.float64(r) * wp.float64(r / u.diagonal[i])
    leave(dots.rz, thread, total)
    if thread == 0:
        dots.scalars[0] = NEVER


@wp.func
def next_ratio(dots: Dots, thread: int) -> float:
    """b = new r·z / old r·z; the new one is kept aside, since other blocks may not have read the old one yet."""
    new = total_of(dots.rz, thread)
    if thread == 0:
        dots.scalars[1] = new
    return float(new / wp.max(dots.scalars[0], wp.float64(1.0e-30)))


@wp.kernel
def turn(width: int, start: int, u: Unknowns, dots: Dots):
    """p = z + b p, z being r over the diagonal."""
    thread = start + wp.tid()
    ratio = next_ratio(dots, thread)
    for i in range(thread * width, wp.min((thread + 1) * width, u.residual.shape[0])):
        z = u.residual[i] / u.diagonal[i]
        u.direction[i] = z + ratio * u.direction[i]


@wp.kernel
def turn_to(z: wp.array(dtype=float), width: int, start: int, u: Unknowns, dots: Dots):
    """p = z + b p."""
    thread = start + wp.tid()
    ratio = next_ratio(dots, thread)
    for i in range(thread * width, wp.min((thread + 1) * width, z.shape[0])):
        u.direction[i] = z[i] + ratio * u.direction[i]


@wp.kernel
def finish_product(sums: wp.array2d(dtype=wp.int64), prior: Prior, width: int, start: int, u: Unknowns, dots: Dots):
    """q = (Aᵀ W A + prior) p from the sums; partial sums of p·q."""
    thread = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, u.direction.shape[0])):
        q = gathered(sums, i) + prior_product(prior, u.direction, i)
        u.product[i] = q
        total += wp.float64(u.direction[i]) * wp.float64(q)
    leave(dots.pq, thread, total)
    if thread == 0:
        dots.scalars[0] = dots.scalars[1]


@wp.kernel
def descend(width: int, start: int, image: wp.array(dtype=float), u: Unknowns, dots: Dots):
    """x += a p, r -= a q with a = (r·z)/(p·q); partial sums of the new r·z."""
    thread = start + wp.tid()
    step = float(dots.scalars[0] / wp.max(total_of(dots.pq, thread), wp.float64(1.0e-30)))
    total = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, image.shape[0])):
        image[i] = image[i] + step * u.direction[i]
        r = u.residual[i] - step * u.product[i]
        u.residual[i] = r
        total += wp.float64(r) * wp.float64(r / u.diagonal[i])
    leave(dots.rz, thread, total)


@wp.kernel
def dot(
    a: wp.array(dtype=float), b: wp.array(dtype=float), width: int, start: int, partial: wp.array(dtype=wp.float64)
):
    thread = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(thread * width, wp.min((thread + 1) * width, a.shape[0])):
        total += wp.float64(a[i]) * wp.float64(b[i])
    leave(partial, thread, total)
