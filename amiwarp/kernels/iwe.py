"""Image of warped events (IWE) from votes.

Kernels come in two widths: a CPU thread processes 64 pixels of a row in vectorised loops, a GPU thread one pixel. No
two threads write to the same element, so that results do not depend on the schedule.
"""

import warp as wp

from amiwarp.kernels.native_code import load_int, load_word, store_float, store_int
from amiwarp.kernels.votes import Canvas, events_of
from amiwarp.kernels.word_votes import Cells

OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(OPTIONS)


CPU_WIDTH = wp.constant(64)  # number of pixels per CPU thread


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
    return (
        frame.first
        + (line / lines) * frame.layer
        + row * frame.stride
        + block_column(frame, block, width)
    )


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
    total = (
        256 * word_field(a, 54, 1023)
        - word_field(a, 0, mask)
        - word_field(a, 18, mask)
        + word_field(a, 36, mask)
    )
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
    canvas: Canvas,
    cells: Cells,
    slot: int,
    counts: wp.array2d(dtype=wp.int64),
    fullest: wp.array(dtype=int),
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
def add_totals(
    more: wp.array(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
    totals: wp.array(dtype=wp.int64),
):
    """Add ``more`` to the totals; clear ``more`` and the counts of the batches."""
    i = wp.tid()
    if i < totals.shape[0]:
        totals[i] = totals[i] + more[i]
        more[i] = wp.int64(0)
    if i < counts.shape[0]:
        counts[i] = wp.int64(0)


@wp.kernel(module="unique", module_options=OPTIONS)
def read_votes(
    cells: Cells, canvas: Canvas, frame: Frame, start: int, image: wp.array(dtype=float)
):
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
        store_float(
            image, at + k, wp.where(column + k < frame.columns, float(votes[k]) / 256.0, 0.0)
        )
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
