"""Decoders of the polarity packets of AEDAT 3.1 files: events of a word with the place and one with the time.

An event whose lowest bit is not set is invalid and left out. One thread reads one block: a packet, or a part of a large
one. The first pass counts the valid events of each block, the second writes them.
"""

import warp as wp

from amiwarp.kernels.evt import EventArrays, store_event
from amiwarp.kernels.native_code import load_uint32

wp.set_module_options({"enable_backward": False})


@wp.struct
class Block:
    """Part of a packet of events."""

    start: int
    """Index of its first word."""
    events: int
    """Number of events, with invalid ones."""
    base: wp.int64
    """Time that is added to those of the events [us]: the packet's overflow."""


@wp.kernel
def count_valid(
    words: wp.array(dtype=wp.uint32), blocks: wp.array(dtype=Block), start: int, counts: wp.array(dtype=int)
):
    """Count the valid events of each block."""
    index = wp.tid() + start
    block = blocks[index]
    count = int(0)
    for k in range(block.events):
        count += int(load_uint32(words, block.start + 2 * k) & wp.uint32(1))
    counts[index] = count


@wp.kernel
def decode_polarity(
    words: wp.array(dtype=wp.uint32),
    blocks: wp.array(dtype=Block),
    places: wp.array(dtype=int),
    start: int,
    events: EventArrays,
):
    """Write the valid events of each block, from a place on."""
    index = wp.tid() + start
    block = blocks[index]
    event = places[index]
    for k in range(block.events):
        word = load_uint32(words, block.start + 2 * k)
        if (word & wp.uint32(1)) != wp.uint32(0):
            now = block.base + wp.int64(wp.int32(load_uint32(words, block.start + 2 * k + 1)))
            column = wp.uint16((word >> wp.uint32(17)) & wp.uint32(0x7FFF))
            row = wp.uint16((word >> wp.uint32(2)) & wp.uint32(0x7FFF))
            store_event(events, event, column, row, now, wp.uint8((word >> wp.uint32(1)) & wp.uint32(1)))
            event += 1
