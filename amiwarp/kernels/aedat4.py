"""Decoders of the packets of events in AEDAT 4 files, once their compression is undone: FlatBuffers at any address.

An event has 16 bytes: a time, a column, a row, a polarity and three bytes between. The first pass finds the events of
each packet. A position in a damaged packet may point anywhere, so each is checked before it is read. The second pass
writes the events and notes what they are. One thread reads one packet, or a part of a large one.
"""

import warp as wp

from amiwarp.kernels.event_arrays import EventArrays
from amiwarp.kernels.event_survey import Survey, count_decreases, largest_coordinate, latest_time
from amiwarp.kernels.native_code import load_int64
from amiwarp.kernels.raw_numbers import OUTSIDE, Span, number_at, span_of

wp.set_module_options({"enable_backward": False})

EVENT_BYTES = wp.constant(wp.int64(16))
"""Size of an event."""
EVENTS = wp.constant(0x53545645)
"""The letters EVTS, with which a packet of events begins behind its size and the position of its table."""


@wp.struct
class Found:
    """The events of a packet."""

    start: wp.int64
    """Position of the first one in the packet."""
    count: int
    """Number of events, or -1 if the packet is damaged."""


@wp.struct
class Block:
    """Events that one thread reads, at least one."""

    address: wp.uint64
    count: int
    place: int
    """Index of the first one in the output."""


@wp.func
def list_of(packet: Span) -> Found:
    """Return the events in the first field of a packet's table. A table without the field has none."""
    damaged = Found()
    damaged.count = -1
    root = number_at(packet, wp.int64(4), 4, 0)
    if root == OUTSIDE:
        return damaged
    table = wp.int64(4) + root
    back = number_at(packet, table, 4, 1)
    if back == OUTSIDE:
        return damaged
    layout = table - back
    length = number_at(packet, layout, 2, 0)
    if length == OUTSIDE:
        return damaged
    if length < wp.int64(6):
        return Found()
    offset = number_at(packet, layout + wp.int64(4), 2, 0)
    if offset == OUTSIDE:
        return damaged
    if offset == wp.int64(0):
        return Found()
    ahead = number_at(packet, table + offset, 4, 0)
    if ahead == OUTSIDE:
        return damaged
    start = table + offset + ahead
    count = number_at(packet, start, 4, 0)
    if count == OUTSIDE or start + wp.int64(4) + EVENT_BYTES * count > packet.size:
        return damaged
    found = Found()
    found.start = start + wp.int64(4)
    found.count = int(count)
    return found


@wp.kernel
def find_events(packets: wp.array(dtype=Span), start: int, found: wp.array(dtype=Found)):
    """Find the events of each packet."""
    index = wp.tid() + start
    found[index] = list_of(packets[index])


@wp.func_native("""
    const char* row = (const char*)block.address;
    uint16_t* __restrict__ x = (uint16_t*)events.x.data + block.place;
    uint16_t* __restrict__ y = (uint16_t*)events.y.data + block.place;
    int64_t* __restrict__ t = (int64_t*)events.t.data + block.place;
    uint8_t* __restrict__ p = (uint8_t*)events.p.data + block.place;
    for (int i = 0; i < block.count; ++i, row += 16) {
        uint64_t time = 0, rest = 0;
#ifdef __CUDA_ARCH__
        // A GPU reads no number across its borders, and its compiler takes memcpy() for one such read.
        if (((uint64_t)row & 7) == 0) {
            time = *(const uint64_t*)row;
            rest = *(const uint64_t*)(row + 8);
        } else {
            for (int k = 0; k < 8; ++k) {
                time |= (uint64_t)(uint8_t)row[k] << (8 * k);
                rest |= (uint64_t)(uint8_t)row[k + 8] << (8 * k);
            }
        }
#else
        memcpy(&time, row, 8);
        memcpy(&rest, row + 8, 8);
#endif
        x[i] = (uint16_t)rest;
        y[i] = (uint16_t)(rest >> 16);
        t[i] = (int64_t)time;
        p[i] = (rest >> 32 & 0xFF) != 0;
    }
""")
def unpack(block: Block, events: EventArrays):
    """Write the events of a block. Negative coordinates become large ones, which lie outside the frame."""


@wp.func_native("""
    const int64_t* time = (const int64_t*)t.data;
    int64_t least = time[start];
    for (int i = start + 1; i < stop; ++i) least = time[i] < least ? time[i] : least;
    return least;
""")
def earliest_time(t: wp.array(dtype=wp.int64), start: int, stop: int) -> wp.int64:
    """Return the least time from ``start`` to before ``stop``, of which there is at least one."""


@wp.kernel
def unpack_events(
    blocks: wp.array(dtype=Block),
    start: int,
    events: EventArrays,
    surveys: wp.array(dtype=Survey),
    earliest: wp.array(dtype=wp.int64),
):
    """Write the events of each block, and note what it holds while it is in the cache."""
    index = wp.tid() + start
    block = blocks[index]
    unpack(block, events)
    first = block.place
    stop = block.place + block.count
    survey = Survey()
    survey.first = load_int64(events.t, first)
    survey.latest = latest_time(events.t, first, stop)
    survey.decreases = count_decreases(events.t, first, stop)
    survey.right = largest_coordinate(events.x, first, stop)
    survey.bottom = largest_coordinate(events.y, first, stop)
    surveys[index] = survey
    earliest[index] = earliest_time(events.t, first, stop)


@wp.kernel
def list_packets(
    data: wp.array(dtype=wp.uint8),
    most: int,
    packets: wp.array(dtype=Span),
    result: wp.array(dtype=int),
):
    """List the packets that follow one another, at most ``most``. One thread, since each one's size leads to the next.

    ``result``: number of packets; position of the first one that is cut off or holds no events, or -1.
    """
    whole = span_of(data)
    at = wp.int64(0)
    count = int(0)
    wrong = int(-1)
    while at < whole.size and wrong < 0:
        size = number_at(whole, at, 4, 0)
        stop = at + wp.int64(4) + size
        kind = number_at(whole, at + wp.int64(8), 4, 0)
        if size == OUTSIDE or stop > whole.size or kind != wp.int64(EVENTS):
            wrong = int(at)
        else:
            if count < most:
                packet = Span()
                packet.address = whole.address + wp.uint64(at)
                packet.size = stop - at
                packets[count] = packet
            count += 1
            at = stop
    result[0] = count
    result[1] = wrong
