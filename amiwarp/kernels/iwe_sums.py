"""Sharpness of an image of warped events on CUDA: the votes smoothed, and sums over the smoothed image."""

from functools import cache
from typing import Any

import warp as wp

from amiwarp.kernels.conjugate_gradients import block_sum
from amiwarp.kernels.iwe import OPTIONS, Frame, block_start
from amiwarp.kernels.votes import events_of


@cache
def smooth_votes(taps: int) -> Any:
    """Return the kernel that smooths an image of votes along its rows, one pixel per thread.

    Its pixels [events] are those of :func:`amiwarp.kernels.iwe.smooth_few` for the image that the votes make.
    """

    @wp.kernel(module="unique", module_options=OPTIONS)
    def smooth_votes(
        votes: wp.array(dtype=wp.int64), weights: wp.array(dtype=float), frame: Frame, start: int,
        out: wp.array(dtype=float),
    ):  # fmt: skip
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
        image: wp.array(dtype=float), weights: wp.array(dtype=float), frame: Frame, threads: int, start: int,
        sums: wp.array(dtype=wp.vec2d),
    ):  # fmt: skip
        thread = start + wp.tid()
        pixel = thread % threads
        h = float(0.0)
        if pixel < frame.rows * frame.columns:
            row = thread / threads * frame.layer + pixel / frame.columns * frame.stride
            at = frame.first + row + pixel % frame.columns
            h = weights[0] * image[at]
            for tap in range(1, wp.static(taps)):
                h = h + weights[tap] * (image[at - tap * frame.stride] + image[at + tap * frame.stride])
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
