"""Device side of conjugate gradients over a map's unknowns; sums in fixed point do not depend on the order."""

import warp as wp

from amiwarp.kernels.prior import Prior, prior_diagonal, prior_product

wp.set_module_options({"enable_backward": False})

FIXED = wp.constant(wp.float64(4294967296.0))  # 2**32: unit of the sums
SEGMENT = wp.constant(256)  # unknowns that one thread sums, in order


@wp.func
def add_fixed(sums: wp.array(dtype=wp.int64), i: int, value: float):
    wp.atomic_add(sums, i, wp.int64(wp.float64(value) * FIXED))


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
    out[i] = gathered(sums, i)


@wp.kernel
def start_descent(
    prior: Prior,
    diagonal: wp.array(dtype=float),
    image: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    direction: wp.array(dtype=float),
    start: int,
    partial: wp.array(dtype=wp.float64),
):
    """r = Aᵀ W (b - A x) - prior x; the first direction is r over the diagonal; partial sums of r·z."""
    segment = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(segment * SEGMENT, wp.min((segment + 1) * SEGMENT, image.shape[0])):
        r = residual[i] - prior_product(prior, image, i)
        z = r / (diagonal[i] + prior_diagonal(prior, i))
        residual[i] = r
        direction[i] = z
        total += wp.float64(r) * wp.float64(z)
    partial[segment] = total


@wp.kernel
def finish_product(
    sums: wp.array2d(dtype=wp.int64),
    prior: Prior,
    direction: wp.array(dtype=float),
    product: wp.array(dtype=float),
    start: int,
    partial: wp.array(dtype=wp.float64),
):
    """q = (Aᵀ W A + prior) p from the sums; partial sums of p·q."""
    segment = start + wp.tid()
    total = wp.float64(0.0)
    for i in range(segment * SEGMENT, wp.min((segment + 1) * SEGMENT, direction.shape[0])):
        q = gathered(sums, i) + prior_product(prior, direction, i)
        product[i] = q
        total += wp.float64(direction[i]) * wp.float64(q)
    partial[segment] = total


@wp.kernel
def descend(
    prior: Prior,
    scalars: wp.array(dtype=wp.float64),
    diagonal: wp.array(dtype=float),
    direction: wp.array(dtype=float),
    product: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    image: wp.array(dtype=float),
    partial: wp.array(dtype=wp.float64),
):
    """x += a p, r -= a q with a = (r·z)/(p·q); partial sums of the new r·z."""
    segment = start + wp.tid()
    step = float(scalars[0] / wp.max(scalars[1], wp.float64(1.0e-30)))
    total = wp.float64(0.0)
    for i in range(segment * SEGMENT, wp.min((segment + 1) * SEGMENT, image.shape[0])):
        image[i] = image[i] + step * direction[i]
        r = residual[i] - step * product[i]
        residual[i] = r
        total += wp.float64(r) * wp.float64(r / (diagonal[i] + prior_diagonal(prior, i)))
    partial[segment] = total


@wp.kernel
def turn(
    prior: Prior,
    scalars: wp.array(dtype=wp.float64),
    diagonal: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    direction: wp.array(dtype=float),
):
    """p = z + b p with b = new r·z / old r·z."""
    i = start + wp.tid()
    ratio = float(scalars[2] / wp.max(scalars[0], wp.float64(1.0e-30)))
    direction[i] = residual[i] / (diagonal[i] + prior_diagonal(prior, i)) + ratio * direction[i]


@wp.kernel
def sum_partial(partial: wp.array(dtype=wp.float64), at: int, scalars: wp.array(dtype=wp.float64)):
    """Total of the partial sums, in order, into ``scalars[at]``; at 0 the last r·z moves up first."""
    total = wp.float64(0.0)
    for i in range(partial.shape[0]):
        total += partial[i]
    scalars[at] = total
