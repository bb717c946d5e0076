"""Decoder of the records of Prophesee's DAT files: a word with the time, and one with column, row and polarity."""

import warp as wp

from amiwarp.kernels.evt import EventArrays, store_event
from amiwarp.kernels.native_code import load_uint32

wp.set_module_options({"enable_backward": False})

HALF = wp.constant(wp.int64(1 << 31))
"""Half the range of the time. A larger step is a wrap."""


@wp.struct
class Layout:
    """Bits of a record's second word."""

    x_mask: int
    """Mask of the column."""
    y_mask: int
    """Mask of the row, once it is shifted."""
    y_shift: int
    """Position of the row's lowest bit."""
    p_shift: int
    """Position of the bit of the polarity."""


@wp.kernel
def decode_dat(
    words: wp.array(dtype=wp.uint32),
    length: int,
    layout: Layout,
    before: wp.int64,
    start: int,
    events: EventArrays,
    wrapped: wp.array(dtype=int),
):
    """Write the events of each block of ``length`` records, as if no time wrapped after the time ``before`` [us].

    ``wrapped``: 1 for a block in which a time wraps.
    """
    block = wp.tid() + start
    first = block * length
    turns = (before >> wp.int64(32)) << wp.int64(32)
    last = before - turns
    if first > 0:
        last = wp.int64(load_uint32(words, 2 * first - 2))
    found = int(0)
    for i in range(first, wp.min(first + length, words.shape[0] // 2)):
        now = wp.int64(load_uint32(words, 2 * i))
        rest = int(load_uint32(words, 2 * i + 1))
        if now - last > HALF or last - now > HALF:
            found = 1
        last = now
        column = wp.uint16(rest & layout.x_mask)
        row = wp.uint16((rest >> layout.y_shift) & layout.y_mask)
        store_event(events, i, column, row, turns + now, wp.uint8((rest >> layout.p_shift) & 1))
    wrapped[block] = found
