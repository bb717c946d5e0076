"""Decoders of the polarity packets of AEDAT 3.1 files: events of a word with the place and one with the time.

An event whose lowest bit is not set is invalid and left out. One thread reads one block: a packet, or a part of a large
one. The first pass counts the valid events of each block, the second writes them.
"""

import warp as wp

from amiwarp.kernels.event_arrays import EventArrays, store_event
from amiwarp.kernels.raw_numbers import load_number, number_at, span_of

wp.set_module_options({"enable_backward": False})

HEADER_BYTES = wp.constant(wp.int64(28))
"""Size of a packet's header."""
EVENT_BYTES = wp.constant(wp.int64(8))
"""Size of an event."""
POLARITY = wp.constant(wp.int64(1))
"""Type of packets of events."""
LARGEST_PACKET = wp.constant(wp.int64(1 << 28))
"""Largest packet that is read [bytes]."""


@wp.struct
class Block:
    """Part of a packet of events."""

    address: wp.uint64
    events: int
    """Number of events, with invalid ones."""
    base: wp.int64
    """Time that is added to the times of the events [us]: the packet's overflow."""


@wp.struct
class Packet:
    """A packet, as its header states it."""

    kind: int
    source: int
    start: int
    """Position of its first event."""
    events: int
    overflow: int
    """Number of times that 2**31 us have passed."""


@wp.kernel
def count_valid(blocks: wp.array(dtype=Block), start: int, counts: wp.array(dtype=int)):
    """Count the valid events of each block."""
    index = wp.tid() + start
    block = blocks[index]
    count = int(0)
    for k in range(block.events):
        count += int(load_number(block.address, EVENT_BYTES * wp.int64(k), 4, 0)) & 1
    counts[index] = count


@wp.kernel
def decode_polarity(
    blocks: wp.array(dtype=Block), places: wp.array(dtype=int), start: int, events: EventArrays
):
    """Write the valid events of each block, from a place on."""
    index = wp.tid() + start
    block = blocks[index]
    event = places[index]
    for k in range(block.events):
        at = EVENT_BYTES * wp.int64(k)
        word = wp.uint32(load_number(block.address, at, 4, 0))
        if (word & wp.uint32(1)) != wp.uint32(0):
            now = block.base + load_number(block.address, at + wp.int64(4), 4, 1)
            column = wp.uint16((word >> wp.uint32(17)) & wp.uint32(0x7FFF))
            row = wp.uint16((word >> wp.uint32(2)) & wp.uint32(0x7FFF))
            store_event(
                events, event, column, row, now, wp.uint8((word >> wp.uint32(1)) & wp.uint32(1))
            )
            event += 1


@wp.kernel
def list_packets(
    data: wp.array(dtype=wp.uint8),
    most: int,
    packets: wp.array(dtype=Packet),
    result: wp.array(dtype=int),
):
    """List the packets that follow one another, at most ``most``. One thread, since each one's size leads to the next.

    ``result``: number of packets; position of the first one that is damaged or cut off, or -1.
    """
    whole = span_of(data)
    at = wp.int64(0)
    count = int(0)
    wrong = int(-1)
    while at < whole.size and wrong < 0:
        kind = number_at(whole, at, 2, 0)
        source = number_at(whole, at + wp.int64(2), 2, 0)
        width = number_at(whole, at + wp.int64(4), 4, 1)
        overflow = number_at(whole, at + wp.int64(12), 4, 1)
        events = number_at(whole, at + wp.int64(20), 4, 1)
        size = width * events
        behind = at + HEADER_BYTES + size
        # Below 0 also for a header that is cut off
        lowest = wp.min(wp.min(width, events), overflow)
        is_header = lowest >= wp.int64(0) and kind <= wp.int64(255) and source <= wp.int64(0x7FFF)
        is_whole = (
            size <= LARGEST_PACKET
            and behind <= whole.size
            and (kind != POLARITY or width == EVENT_BYTES)
        )
        if not (is_header and is_whole):
            wrong = int(at)
        else:
            if count < most:
                packet = Packet()
                packet.kind = int(kind)
                packet.source = int(source)
                packet.start = int(at + HEADER_BYTES)
                packet.events = int(events)
                packet.overflow = int(overflow)
                packets[count] = packet
            count += 1
            at = behind
    result[0] = count
    result[1] = wrong
