"""Decoder of the records of Prophesee's DAT files: a word with the time, and one with column, row and polarity."""

import warp as wp

from amiwarp.kernels.event_arrays import EventArrays, store_event
from amiwarp.kernels.native_code import load_uint32
from amiwarp.kernels.raw_numbers import wrap_between

wp.set_module_options({"enable_backward": False})


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
    turns: wp.array(dtype=int),
    start: int,
    events: EventArrays,
    wraps: wp.array(dtype=int),
):
    """Write the events of each block of ``length`` records, and count how often the time wraps in it.

    ``before``: time of the record before all, as stored [us], or -1 if there is none. ``turns``: how often the time has
    wrapped before each block.
    """
    block = wp.tid() + start
    first = block * length
    last = before
    if first > 0:
        last = wp.int64(load_uint32(words, 2 * first - 2))
    elif before < wp.int64(0):
        last = wp.int64(load_uint32(words, 0))
    turn = turns[block]
    for i in range(first, wp.min(first + length, words.shape[0] // 2)):
        stored = wp.int64(load_uint32(words, 2 * i))
        rest = int(load_uint32(words, 2 * i + 1))
        turn += wrap_between(last, stored)
        last = stored
        now = stored + (wp.int64(turn) << wp.int64(32))
        column = wp.uint16(rest & layout.x_mask)
        row = wp.uint16((rest >> layout.y_shift) & layout.y_mask)
        store_event(events, i, column, row, now, wp.uint8((rest >> layout.p_shift) & 1))
    wraps[block] = turn - turns[block]
