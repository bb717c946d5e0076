"""Image of warped events (IWE): computed from votes, smoothed, and summed for its sharpness.

Kernels come in two widths: a CPU thread processes 64 pixels of a row in vectorised loops, a GPU thread one pixel. No
two threads write to the same element, so that results do not depend on the schedule.
"""

from functools import cache
from typing import Any

import warp as wp

from amiwarp.kernels.conjugate_gradients import block_sum
from amiwarp.kernels.native_code import load_float, load_int, load_word, store_float, store_int
from amiwarp.kernels.votes import Canvas, events_of
from amiwarp.kernels.word_votes import Cells

OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(OPTIONS)

VARIANCE = wp.constant(0)  # numbers of the sharpness measures
GRADIENT = wp.constant(1)
LAPLACIAN = wp.constant(2)
PAPER_J = wp.constant(3)
ENTROPY = wp.constant(4)
STRIP = wp.constant(16)  # number of rows that one thread sums
CPU_WIDTH = wp.constant(64)  # number of pixels per CPU thread
MOST_UNROLLED = 16  # largest number of weights for :func:`smooth_few`


@wp.struct
class Frame:
    """Image in a flat array with zeros around it: right of each row, above, below, and between layers."""

    rows: int
    columns: int
    stride: int  # distance from one row to the next [elements]
    layer: int  # distance from one layer to the next [elements]
    first: int  # index of the first pixel
    blocks: int  # number of blocks per row


@wp.func
def block_column(frame: Frame, block: int, width: int) -> int:
    """Return the image column at which a block of pixels begins."""
    return (block % frame.blocks) * width


@wp.func
def block_start(frame: Frame, block: int, width: int, step: int) -> int:
    """Return the index of the first pixel of a block; a block begins every ``step`` rows."""
    lines = (frame.rows + step - 1) / step
    line = block / frame.blocks
    row = (line % lines) * step
    return frame.first + (line / lines) * frame.layer + row * frame.stride + block_column(frame, block, width)


# -- from votes


@wp.func
def word_field(word: wp.uint64, first: int, mask: int) -> int:
    """Return the field of a 64-bit word that begins at bit ``first``."""
    return int((word >> wp.uint64(first)) & wp.uint64(mask))


@wp.func
def votes_of_pixel(words: wp.array(dtype=wp.uint64), cell: int, width: int) -> int:
    """Return the votes [1/256 event] that the four cells around a pixel hold for it."""
    a = load_word(words, cell)
    b = load_word(words, cell - 1)
    c = load_word(words, cell - width)
    d = load_word(words, cell - width - 1)
    mask = 262143
    total = 256 * word_field(a, 54, 1023) - word_field(a, 0, mask) - word_field(a, 18, mask) + word_field(a, 36, mask)
    return (
        total
        + word_field(b, 0, mask)
        - word_field(b, 36, mask)
        + word_field(c, 18, mask)
        - word_field(c, 36, mask)
        + word_field(d, 36, mask)
    )


@wp.func
def cell_of(canvas: Canvas, frame: Frame, block: int, width: int) -> int:
    """Return the index of the vote cell of a block's first pixel."""
    line = block / frame.blocks
    row = (line / frame.rows) * canvas.rows + line % frame.rows + 1
    return row * canvas.columns + block_column(frame, block, width) + 1


@wp.kernel(module="unique", module_options=OPTIONS)
def empty_words(
    canvas: Canvas, cells: Cells, slot: int, counts: wp.array2d(dtype=wp.int64), fullest: wp.array(dtype=int)
):
    """Add a batch's votes to the totals; count its events, the trash included, and find the fullest word.

    If words overflowed, the count is lower than the number of votes, never higher. The batch is then voted again.
    """
    i = wp.tid()
    count = wp.int64(load_word(cells.words, i) >> wp.uint64(54))
    if count != wp.int64(0):
        wp.atomic_add(counts, slot, i % counts.shape[1], count)
        if int(count) > fullest[0]:
            wp.atomic_max(fullest, 0, int(count))
    if i > canvas.columns and i < cells.totals.shape[0]:
        cells.totals[i] = cells.totals[i] + wp.int64(votes_of_pixel(cells.words, i, canvas.columns))


@wp.kernel(module="unique", module_options=OPTIONS)
def add_totals(more: wp.array(dtype=wp.int64), counts: wp.array(dtype=wp.int64), totals: wp.array(dtype=wp.int64)):
    """Add ``more`` to the totals; clear ``more`` and the counts of the batches."""
    i = wp.tid()
    if i < totals.shape[0]:
        totals[i] = totals[i] + more[i]
        more[i] = wp.int64(0)
    if i < counts.shape[0]:
        counts[i] = wp.int64(0)


@wp.kernel(module="unique", module_options=OPTIONS)
def read_votes(cells: Cells, canvas: Canvas, frame: Frame, start: int, image: wp.array(dtype=float)):
    """Compute one pixel [events] per thread from words and totals, which are kept. For CUDA."""
    block = start + wp.tid()
    cell = cell_of(canvas, frame, block, 1)
    total = cells.totals[cell] + wp.int64(votes_of_pixel(cells.words, cell, canvas.columns))
    image[block_start(frame, block, 1, 1)] = events_of(total)


@wp.kernel
def read_sums(
    sums: wp.array2d(dtype=int),
    totals: wp.array(dtype=wp.int64),
    canvas: Canvas,
    frame: Frame,
    start: int,
    image: wp.array(dtype=float),
):
    """Compute 64 pixels [events] per thread from all slices of sums, which are kept, and totals, if any. For CPUs."""
    block = start + wp.tid()
    cell = cell_of(canvas, frame, block, CPU_WIDTH)
    at = block_start(frame, block, CPU_WIDTH, 1)
    column = block_column(frame, block, CPU_WIDTH)
    votes = wp.zeros(shape=(64,), dtype=int)
    for s in range(sums.shape[0]):
        for k in range(CPU_WIDTH):
            store_int(votes, k, votes[k] + load_int(sums[s], cell + k))
    for k in range(CPU_WIDTH):
        store_float(image, at + k, wp.where(column + k < frame.columns, float(votes[k]) / 256.0, 0.0))
    if totals.shape[0] != 0:
        for k in range(wp.min(CPU_WIDTH, frame.columns - column)):
            total = totals[cell + k] + wp.int64(votes[k])
            image[at + k] = events_of(total)


@wp.kernel(module="unique", module_options=OPTIONS)
def add_sums(sums: wp.array2d(dtype=int), start: int, totals: wp.array(dtype=wp.int64)):
    """Add the sums of all slices to the totals, one pixel per thread."""
    i = start + wp.tid()
    for s in range(sums.shape[0]):
        totals[i] = totals[i] + wp.int64(sums[s, i])


# -- smoothing and sums


@wp.kernel
def sum_segments(
    image: wp.array(dtype=float), frame: Frame, layers: int, border: int, length: int, start: int,
    sums: wp.array2d(dtype=wp.float64),
):  # fmt: skip
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

    @wp.kernel(module="unique", module_options=OPTIONS)  # so that a new one does not compile the others again
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
                both = load_float(image, at + k - tap * step) + load_float(image, at + k + tap * step)
                store_float(total, k, load_float(total, k) + weight * both)
        for k in range(width):
            store_float(out, at + k, wp.where(column + k < frame.columns, load_float(total, k), 0.0))

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
    value = across + load_float(image, i + stride) + load_float(image, i - stride) - 4.0 * load_float(image, i)
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

    @wp.kernel(module="unique", module_options=OPTIONS)  # so that a new one does not compile the others again
    def sum_terms(image: wp.array(dtype=float), frame: Frame, eta: float, start: int, sums: wp.array(dtype=wp.vec2d)):
        block = start + wp.tid()
        at = block_start(frame, block, width, STRIP)
        total = wp.zeros(shape=(width,), dtype=float)
        terms = wp.zeros(shape=(width,), dtype=float)
        for line in range(wp.min(STRIP, frame.rows - strip_row(frame, block))):
            for k in range(width):
                i = at + line * frame.stride + k
                store_float(total, k, load_float(total, k) + load_float(image, i))
                store_float(terms, k, load_float(terms, k) + term(image, i, frame.stride, eta))
        sums[block] = sum_of(total, terms, wp.min(width, frame.columns - block_column(frame, block, width)))

    return sum_terms


@cache
def smooth_and_sum(taps: int) -> Any:
    """Return the kernel for CPUs that smooths an image by ``taps`` weights and sums it and its squares.

    The sums are those of :func:`smooth` and :func:`sum_terms` for the variance, to the last bit. The smoothed image is
    not stored.
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
                    h += weights[tap] * (load_float(image, at + k - tap) + load_float(image, at + k + tap))
                store_float(half, to + k, h)
        total = wp.zeros(shape=(width,), dtype=float)
        terms = wp.zeros(shape=(width,), dtype=float)
        for line in range(rows):
            at = (line + halo) * width
            for k in range(width):
                h = weights[0] * load_float(half, at + k)
                for tap in range(1, taps):
                    both = load_float(half, at + k - tap * width) + load_float(half, at + k + tap * width)
                    h += weights[tap] * both
                store_float(total, k, load_float(total, k) + h)
                store_float(terms, k, load_float(terms, k) + h * h)
        sums[block] = sum_of(total, terms, wp.min(width, frame.columns - block_column(frame, block, width)))

    return smooth_and_sum


# Sharpness of an image of warped events on CUDA: the votes smoothed, and sums over the smoothed image.


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


# Directions of the edges in an image: sums over its squared gradients.

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
        total += wp.vec2(image[i + 1] - image[i - 1], image[i + frame.stride] - image[i - frame.stride])
    return total


@wp.kernel
def find_largest(
    image: wp.array(dtype=float), frame: Frame, layers: int, inset: int, start: int, largest: wp.array(dtype=float)
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
    image: wp.array(dtype=float), frame: Frame, layers: int, inset: int, limit: float, start: int,
    sums: wp.array(dtype=wp.vec3d),
):  # fmt: skip
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
