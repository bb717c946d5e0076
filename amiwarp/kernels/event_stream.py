"""Decoder of the bytes of Event Stream files: one thread reads all, since where an event begins depends on all before.

A byte adds to the time, or begins an event of five bytes: time and kind, column, row. The format is described at
https://github.com/neuromorphic-paris/event_stream.
"""

import warp as wp

from amiwarp.kernels.event_arrays import EventArrays, store_event

wp.set_module_options({"enable_backward": False})

EVENT_BYTES = wp.constant(5)
"""Size of an event."""


@wp.struct
class Progress:
    """What was read of the bytes."""

    used: int
    """Number of bytes. The rest is an event that is not complete."""
    events: int
    """Number of events."""
    now: wp.int64
    """Time of the last event [us]."""


@wp.kernel
def decode_stream(
    data: wp.array(dtype=wp.uint8),
    atis: int,
    height: int,
    before: wp.int64,
    events: EventArrays,
    progress: wp.array(dtype=Progress),
):
    """Decode events of a DVS, or the change detections of an ATIS, from the time ``before`` [us] on.

    Rows count from the bottom. One that lies outside becomes a large number.
    """
    # The lowest bits of the first byte tell the kind: ON of a DVS; exposure and ON of an ATIS. The others are the time.
    bits = wp.where(atis != 0, 2, 1)
    longest = (256 >> bits) - 1
    now = before
    at = int(0)
    event = int(0)
    waiting = int(0)
    while at < data.shape[0] and waiting == 0:
        first = int(data[at])
        time = first >> bits
        kind = first & ((1 << bits) - 1)
        if time == longest:
            # Of an ATIS, the other bits tell how often the longest time passes. Of a DVS, 0 marks a reset, 1 this.
            now += wp.int64(longest * kind)
            at += 1
        elif at + EVENT_BYTES > data.shape[0]:
            waiting = int(1)
        else:
            now += wp.int64(time)
            if atis == 0 or (kind & 1) == 0:
                column = int(data[at + 1]) | (int(data[at + 2]) << 8)
                row = int(data[at + 3]) | (int(data[at + 4]) << 8)
                polarity = wp.uint8(kind >> (bits - 1))
                store_event(
                    events, event, wp.uint16(column), wp.uint16(height - 1 - row), now, polarity
                )
                event += 1
            at += EVENT_BYTES
    result = Progress()
    result.used = at
    result.events = event
    result.now = now
    progress[0] = result
