"""Directions of the edges in an image: sums over its squared gradients."""

import warp as wp

from amiwarp.kernels.iwe import OPTIONS, Frame

wp.set_module_options(OPTIONS)


SEGMENT = wp.constant(32)  # number of pixels of a row that one thread processes


@wp.func
def segments_of(frame: Frame, inset: int) -> int:
    """Return the number of segments of a row. Pixels within ``inset`` of the image's border are left out."""
    return (frame.columns - 2 * inset + SEGMENT - 1) / SEGMENT


@wp.func
def first_column(frame: Frame, inset: int, thread: int) -> int:
    """Return the column at which the segment of a thread begins."""
    return inset + (thread % segments_of(frame, inset)) * SEGMENT


@wp.func
def gradient(image: wp.array(dtype=float), frame: Frame, layers: int, at: int) -> wp.vec2:
    """Return twice the gradient of the sum of all layers, by central differences."""
    total = wp.vec2(0.0, 0.0)
    for layer in range(layers):
        i = at + layer * frame.layer
        total += wp.vec2(
            image[i + 1] - image[i - 1], image[i + frame.stride] - image[i - frame.stride]
        )
    return total


@wp.kernel
def find_largest(
    image: wp.array(dtype=float),
    frame: Frame,
    layers: int,
    inset: int,
    start: int,
    largest: wp.array(dtype=float),
):
    """Find the largest squared gradient of each segment of a row."""
    thread = start + wp.tid()
    row = frame.first + (inset + thread / segments_of(frame, inset)) * frame.stride
    first = first_column(frame, inset, thread)
    found = float(0.0)
    for column in range(first, wp.min(first + SEGMENT, frame.columns - inset)):
        found = wp.max(found, wp.length_sq(gradient(image, frame, layers, row + column)))
    largest[thread] = found


@wp.kernel
def sum_directions(
    image: wp.array(dtype=float),
    frame: Frame,
    layers: int,
    inset: int,
    limit: float,
    start: int,
    sums: wp.array(dtype=wp.vec3d),
):
    """Sum g², g² cos 2φ and g² sin 2φ over each segment of a row, for gradients (g, φ) with g² above ``limit``."""
    thread = start + wp.tid()
    row = frame.first + (inset + thread / segments_of(frame, inset)) * frame.stride
    first = first_column(frame, inset, thread)
    total = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    for column in range(first, wp.min(first + SEGMENT, frame.columns - inset)):
        g = gradient(image, frame, layers, row + column)
        if wp.length_sq(g) > limit:
            x, y = wp.float64(g[0]), wp.float64(g[1])
            total += wp.vec3d(x * x + y * y, x * x - y * y, wp.float64(2.0) * x * y)
    sums[thread] = total
