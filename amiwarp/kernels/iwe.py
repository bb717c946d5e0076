"""Smoothing of the image of warped events (IWE), and sums over it."""

import warp as wp

wp.set_module_options({"enable_backward": False})

SEGMENT = wp.constant(64)  # pixels that one thread sums
VARIANCE = wp.constant(0)
GRADIENT = wp.constant(1)
LAPLACIAN = wp.constant(2)
PAPER_J = wp.constant(3)
ENTROPY = wp.constant(4)


# every thread writes a place of its own, so the bits do not depend on the schedule


@wp.kernel
def smooth_along_x(
    image: wp.array(dtype=float), weights: wp.array(dtype=float), width: int, start: int, out: wp.array(dtype=float)
):
    """The image smoothed along x with a symmetric kernel (centre first)."""
    i = start + wp.tid()
    col = i % width
    radius = weights.shape[0] - 1
    total = float(0.0)
    for k in range(wp.max(-radius, -col), wp.min(radius, width - 1 - col) + 1):
        total += weights[wp.abs(k)] * image[i + k]
    out[i] = total


@wp.kernel
def smooth_along_y(
    image: wp.array(dtype=float),
    weights: wp.array(dtype=float),
    width: int,
    height: int,
    start: int,
    out: wp.array(dtype=float),
):
    i = start + wp.tid()
    row = (i / width) % height
    radius = weights.shape[0] - 1
    total = float(0.0)
    for k in range(wp.max(-radius, -row), wp.min(radius, height - 1 - row) + 1):
        total += weights[wp.abs(k)] * image[i + k * width]
    out[i] = total


@wp.func
def neighbour(image: wp.array(dtype=float), i: int, step: int, exists: bool) -> float:
    """The pixel ``step`` on, zero past the border (the padding holds no events)."""
    if exists:
        return image[i + step]
    return 0.0


@wp.func
def gradient2(image: wp.array(dtype=float), i: int, width: int, height: int) -> float:
    """Squared central-difference gradient."""
    col = i % width
    row = (i / width) % height
    dx = neighbour(image, i, 1, col + 1 < width) - neighbour(image, i, -1, col > 0)
    dy = neighbour(image, i, width, row + 1 < height) - neighbour(image, i, -width, row > 0)
    return 0.25 * (dx * dx + dy * dy)


@wp.func
def laplacian2(image: wp.array(dtype=float), i: int, width: int, height: int) -> float:
    """Squared five-point Laplacian."""
    col = i % width
    row = (i / width) % height
    total = neighbour(image, i, 1, col + 1 < width) + neighbour(image, i, -1, col > 0)
    total += neighbour(image, i, width, row + 1 < height) + neighbour(image, i, -width, row > 0)
    value = total - 4.0 * image[i]
    return value * value


@wp.func
def pixel_term(kind: int, image: wp.array(dtype=float), i: int, width: int, height: int, eta: float) -> float:
    h = image[i]
    if kind == GRADIENT:
        return gradient2(image, i, width, height)
    if kind == LAPLACIAN:
        return laplacian2(image, i, width, height)
    if kind == PAPER_J:
        return wp.where(h > 0.0, 1.0 / (1.0 + wp.exp(wp.min(h / eta, 80.0))), 0.0)
    if kind == ENTROPY:
        return wp.where(h > 0.0, h * wp.log(wp.max(h, 1.0e-30)), 0.0)
    return h * h


@wp.kernel
def sum_terms(
    kind: int,
    image: wp.array(dtype=float),
    width: int,
    height: int,
    eta: float,
    start: int,
    sums: wp.array(dtype=wp.vec2d),
):
    """Per segment of SEGMENT pixels: the sum of the image and the sum of the sharpness' terms."""
    segment = start + wp.tid()
    total = wp.float64(0.0)
    terms = wp.float64(0.0)
    for i in range(segment * SEGMENT, wp.min((segment + 1) * SEGMENT, image.shape[0])):
        total += wp.float64(image[i])
        terms += wp.float64(pixel_term(kind, image, i, width, height, eta))
    sums[segment] = wp.vec2d(total, terms)

