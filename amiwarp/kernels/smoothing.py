"""Images of warped events smoothed, and the sums over them that measure their sharpness.

Kernels that a CPU runs in blocks come in two widths, as in :mod:`amiwarp.kernels.iwe`.
"""

from functools import cache
from typing import Any

import warp as wp

from amiwarp.kernels.conjugate_gradients import block_sum
from amiwarp.kernels.iwe import CPU_WIDTH, OPTIONS, Frame, block_column, block_start
from amiwarp.kernels.native_code import load_float, store_float
from amiwarp.kernels.votes import events_of

wp.set_module_options(OPTIONS)


VARIANCE = wp.constant(0)  # numbers of the sharpness measures
GRADIENT = wp.constant(1)
LAPLACIAN = wp.constant(2)
PAPER_J = wp.constant(3)
ENTROPY = wp.constant(4)
STRIP = wp.constant(16)  # number of rows that one thread sums
MOST_UNROLLED = 16  # largest number of weights for :func:`smooth_few`


@wp.kernel
def sum_segments(
    image: wp.array(dtype=float),
    frame: Frame,
    layers: int,
    border: int,
    length: int,
    start: int,
    sums: wp.array2d(dtype=wp.float64),
):
    """Sum the pixels of all layers over segments of rows that begin ``border`` px inside: ``sums[row, segment]``."""
    row, column = (start + wp.tid()) / sums.shape[1], (start + wp.tid()) % sums.shape[1]
    at = frame.first + (border + row) * frame.stride + border + column * length
    total = wp.float64(0.0)
    for layer in range(layers):
        for x in range(length):
            total += wp.float64(image[at + layer * frame.layer + x])
    sums[row, column] = total


@cache
def smooth(width: int) -> Any:
    """Return the kernel that smooths ``width`` pixels per thread along one axis; the weights begin at the centre."""

    @wp.kernel(
        module="unique", module_options=OPTIONS
    )  # so that a new one does not compile the others again
    def smooth(
        image: wp.array(dtype=float),
        weights: wp.array(dtype=float),
        step: int,
        frame: Frame,
        start: int,
        out: wp.array(dtype=float),
    ):
        block = start + wp.tid()
        at = block_start(frame, block, width, 1)
        column = block_column(frame, block, width)
        total = wp.zeros(shape=(width,), dtype=float)
        for k in range(width):
            store_float(total, k, weights[0] * load_float(image, at + k))
        for tap in range(1, weights.shape[0]):
            weight = weights[tap]
            for k in range(width):
                both = load_float(image, at + k - tap * step) + load_float(
                    image, at + k + tap * step
                )
                store_float(total, k, load_float(total, k) + weight * both)
        for k in range(width):
            store_float(
                out, at + k, wp.where(column + k < frame.columns, load_float(total, k), 0.0)
            )

    return smooth


@cache
def smooth_few(taps: int) -> Any:
    """Return :func:`smooth` for one pixel per thread. The loop over ``taps`` weights is unrolled, so loads overlap."""

    @wp.kernel(module="unique", module_options=OPTIONS)
    def smooth_few(
        image: wp.array(dtype=float),
        weights: wp.array(dtype=float),
        step: int,
        frame: Frame,
        start: int,
        out: wp.array(dtype=float),
    ):
        at = block_start(frame, start + wp.tid(), 1, 1)
        total = weights[0] * image[at]
        for tap in range(1, wp.static(taps)):
            total = total + weights[tap] * (image[at - tap * step] + image[at + tap * step])
        out[at] = total

    return smooth_few


@wp.func
def gradient2(image: wp.array(dtype=float), i: int, stride: int) -> float:
    """Return the squared central-difference gradient at pixel ``i``."""
    dx = load_float(image, i + 1) - load_float(image, i - 1)
    dy = load_float(image, i + stride) - load_float(image, i - stride)
    return 0.25 * (dx * dx + dy * dy)


@wp.func
def laplacian2(image: wp.array(dtype=float), i: int, stride: int) -> float:
    """Return the squared five-point Laplacian at pixel ``i``."""
    across = load_float(image, i + 1) + load_float(image, i - 1)
    value = (
        across
        + load_float(image, i + stride)
        + load_float(image, i - stride)
        - 4.0 * load_float(image, i)
    )
    return value * value


@wp.func
def other_term(kind: int, h: float, eta: float) -> float:
    """Return a pixel's term in the sharpness measures J (the paper's) and entropy."""
    if kind == PAPER_J:
        return wp.where(h > 0.0, 1.0 / (1.0 + wp.exp(wp.min(h / eta, 80.0))), 0.0)
    return wp.where(h > 0.0, h * wp.log(wp.max(h, 1.0e-30)), 0.0)


@wp.func
def strip_row(frame: Frame, block: int) -> int:
    """Return the first row of a block of a strip, in its layer."""
    return ((block / frame.blocks) % ((frame.rows + STRIP - 1) / STRIP)) * STRIP


@wp.func
def sum_of(total: wp.array(dtype=float), terms: wp.array(dtype=float), columns: int) -> wp.vec2d:
    """Return the sums of the first ``columns`` elements of both arrays."""
    both = wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    for k in range(columns):
        both += wp.vec2d(wp.float64(total[k]), wp.float64(terms[k]))
    return both


@cache
def sum_terms(width: int, kind: int) -> Any:
    """Return the kernel that sums the image and its sharpness terms over ``width`` columns of a strip of rows."""

    @wp.func
    def term(image: wp.array(dtype=float), i: int, stride: int, eta: float) -> float:
        h = load_float(image, i)
        if wp.static(kind == int(VARIANCE)):
            return h * h
        if wp.static(kind == int(GRADIENT)):
            return gradient2(image, i, stride)
        if wp.static(kind == int(LAPLACIAN)):
            return laplacian2(image, i, stride)
        return other_term(kind, h, eta)

    @wp.kernel(
        module="unique", module_options=OPTIONS
    )  # so that a new one does not compile the others again
    def sum_terms(
        image: wp.array(dtype=float),
        frame: Frame,
        eta: float,
        start: int,
        sums: wp.array(dtype=wp.vec2d),
    ):
        block = start + wp.tid()
        at = block_start(frame, block, width, STRIP)
        total = wp.zeros(shape=(width,), dtype=float)
        terms = wp.zeros(shape=(width,), dtype=float)
        for line in range(wp.min(STRIP, frame.rows - strip_row(frame, block))):
            for k in range(width):
                i = at + line * frame.stride + k
                store_float(total, k, load_float(total, k) + load_float(image, i))
                store_float(terms, k, load_float(terms, k) + term(image, i, frame.stride, eta))
        sums[block] = sum_of(
            total, terms, wp.min(width, frame.columns - block_column(frame, block, width))
        )

    return sum_terms


@cache
def smooth_and_sum(taps: int) -> Any:
    """Return the kernel for CPUs that smooths an image by ``taps`` weights and sums it and its squares.

    The sums equal the sums of :func:`smooth` and :func:`sum_terms` for the variance, to the last bit. The smoothed
    image is not stored.
    """
    width, halo = int(CPU_WIDTH), taps - 1

    @wp.kernel(module="unique", module_options=OPTIONS)
    def smooth_and_sum(
        image: wp.array(dtype=float),
        weights: wp.array(dtype=float),
        frame: Frame,
        start: int,
        sums: wp.array(dtype=wp.vec2d),
    ):
        block = start + wp.tid()
        rows = wp.min(STRIP, frame.rows - strip_row(frame, block))
        first = block_start(frame, block, width, STRIP) - halo * frame.stride
        half = wp.zeros(shape=(wp.static(width * (int(STRIP) + 2 * halo)),), dtype=float)
        for line in range(rows + 2 * halo):
            at = first + line * frame.stride
            to = line * width
            for k in range(width):
                h = weights[0] * load_float(image, at + k)
                for tap in range(1, taps):
                    h += weights[tap] * (
                        load_float(image, at + k - tap) + load_float(image, at + k + tap)
                    )
                store_float(half, to + k, h)
        total = wp.zeros(shape=(width,), dtype=float)
        terms = wp.zeros(shape=(width,), dtype=float)
        for line in range(rows):
            at = (line + halo) * width
            for k in range(width):
                h = weights[0] * load_float(half, at + k)
                for tap in range(1, taps):
                    both = load_float(half, at + k - tap * width) + load_float(
                        half, at + k + tap * width
                    )
                    h += weights[tap] * both
                store_float(total, k, load_float(total, k) + h)
                store_float(terms, k, load_float(terms, k) + h * h)
        sums[block] = sum_of(
            total, terms, wp.min(width, frame.columns - block_column(frame, block, width))
        )

    return smooth_and_sum


# On CUDA alone: the votes are smoothed without an image between.


@cache
def smooth_votes(taps: int) -> Any:
    """Return the kernel that smooths an image of votes along its rows, one pixel per thread.

    Its pixels [events] equal the pixels of :func:`amiwarp.kernels.smoothing.smooth_few` for the image that the votes
    make.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def smooth_votes(
        votes: wp.array(dtype=wp.int64),
        weights: wp.array(dtype=float),
        frame: Frame,
        start: int,
        out: wp.array(dtype=float),
    ):
        at = block_start(frame, start + wp.tid(), 1, 1)
        total = weights[0] * events_of(votes[at])
        for tap in range(1, wp.static(taps)):
            total = total + weights[tap] * (events_of(votes[at - tap]) + events_of(votes[at + tap]))
        out[at] = total

    return smooth_votes


@cache
def smooth_and_add(taps: int) -> Any:
    """Return the kernel that smooths an image along its columns and sums it and its squares, one pixel per thread.

    A layer has ``threads`` threads, a whole number of blocks. Each block gives one sum. The smoothed image is not
    stored.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def smooth_and_add(
        image: wp.array(dtype=float),
        weights: wp.array(dtype=float),
        frame: Frame,
        threads: int,
        start: int,
        sums: wp.array(dtype=wp.vec2d),
    ):
        thread = start + wp.tid()
        pixel = thread % threads
        h = float(0.0)
        if pixel < frame.rows * frame.columns:
            row = thread / threads * frame.layer + pixel / frame.columns * frame.stride
            at = frame.first + row + pixel % frame.columns
            h = weights[0] * image[at]
            for tap in range(1, wp.static(taps)):
                h = h + weights[tap] * (
                    image[at - tap * frame.stride] + image[at + tap * frame.stride]
                )
        value = wp.float64(h)
        both = wp.vec2d(block_sum(value), block_sum(value * value))
        if thread % wp.block_dim() == 0:
            sums[thread / wp.block_dim()] = both

    return smooth_and_add


@wp.kernel(module="unique", module_options=OPTIONS)
def gather_sums(sums: wp.array2d(dtype=wp.vec2d), out: wp.array(dtype=wp.vec2d)):
    """Add up the partial sums in each row, one block of threads per row."""
    row = wp.tid() / wp.block_dim()
    first = wp.tid() % wp.block_dim()
    total = wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    for k in range(first, sums.shape[1], wp.block_dim()):
        total += sums[row, k]
    both = wp.vec2d(block_sum(total[0]), block_sum(total[1]))
    if first == 0:
        out[row] = both
