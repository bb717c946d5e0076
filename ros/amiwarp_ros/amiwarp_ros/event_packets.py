"""Events of ``event_camera_msgs/EventPacket``, in and out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp import AmiwarpError, Events, EvtDecoder
from amiwarp.io.ros.messages import decode_packet
from amiwarp.io.ros.words import EVT, Layout, checked_words, layout_of

NS_BITS = 32
"""Bits of the time of an event after the packet's ``time_base`` [ns], in the encoding ``mono``."""
LONGEST_US = (1 << NS_BITS) // 1000 - 1
"""Longest time of the events of a packet in the encoding ``mono`` [us]."""
MOST_EVENTS = 1 << 16
"""Largest number of events of a packet that is sent: half a megabyte."""
TIME_HIGH = 8
"""Type of the words with the upper bits of the time, in all versions of EVT."""
ROW = 0
TIME_LOW = 6
"""Types of the words of EVT 3.0 with the row, and with the lower bits of the time."""
LATE_MESSAGES = 10
"""Number of late messages without a new one between after which a topic counts as begun anew."""


class Content(NamedTuple):
    """What is decoded of a message. A message of rclpy takes no NumPy array, so its bytes are put here."""

    encoding: str
    time_base: int
    is_bigendian: bool
    events: NDArray[np.uint8]


class PacketDecoder:
    """Decoder of the messages of one camera. Messages that are missing are counted, by ``seq``."""

    def __init__(self) -> None:
        self.missing = 0
        """Number of messages that are missing so far."""
        self.late = 0
        """Number of messages that came after a later one, or twice. They are dropped."""
        self.note: str | None = None
        """What is assumed of the words, if it is not certain."""
        self._number: int | None = None
        self._late_in_a_row = 0
        self._stamp_us = 0
        self._layout: Layout | None = None
        self._encoding: str | None = None
        self._words: EvtDecoder | None = None
        self._cut = True

    def decode(self, message: Any) -> tuple[Events, NDArray[np.int64]]:
        """Return the events of a message, and the times of the rising edges at the trigger input [us].

        Raises :class:`AmiwarpError` for an encoding that amiwarp does not read, and if the driver or a bag was
        started anew.
        """
        if not self._is_next(int(message.seq), stamp_us(message)):
            return Events.empty(), np.zeros(0, np.int64)
        content = Content(
            encoding=message.encoding,
            time_base=int(message.time_base),
            is_bigendian=bool(message.is_bigendian),
            events=np.frombuffer(bytes(message.events), np.uint8),
        )
        if self._encoding not in (None, message.encoding):
            raise AmiwarpError(
                f"the encoding has changed from {self._encoding} to {message.encoding}; restart this node"
            )
        self._encoding = message.encoding
        if message.encoding not in EVT:
            columns, edges = decode_packet(content)
            x, y, t, p = columns
            _, _, edge_t, rising = edges
            order = np.argsort(t, kind="stable")
            events = Events.from_arrays(x[order], y[order], t[order], p[order])
            return events, np.asarray(edge_t)[np.asarray(rising) == 1].astype(np.int64)
        if self._layout is None:
            self._layout, self.note = layout_of(content.encoding, [content])
        if self._words is None:
            self._words = EvtDecoder(self._layout.version, swapped=self._layout.swapped)
        words = checked_words(content, content.encoding)
        if self._cut:
            words = _after_cut(words, self._layout)
            self._cut = not len(words)
        on_device, triggers = self._words.decode(words)
        rising = np.asarray(triggers.rising) == 1
        return on_device.to_host(), triggers.t[rising].astype(np.int64)

    def _is_next(self, number: int, stamp: int) -> bool:
        """Return whether a message comes after those before it, and count the messages that are missing between."""
        last = self._number
        if last is not None and number <= last:
            if stamp > self._stamp_us:
                raise AmiwarpError(
                    f"the driver was started anew: seq fell from {last} to {number}, and its clock began anew; restart "
                    "this node, for example with respawn in a launch file"
                )
            self.late += 1
            self._late_in_a_row += 1
            if self._late_in_a_row == LATE_MESSAGES:
                raise AmiwarpError(
                    f"{LATE_MESSAGES} messages came a second time: seq {number} after {last}; the bag was played anew; "
                    "restart this node, for example with respawn in a launch file"
                )
            return False
        self._late_in_a_row = 0
        if last is not None and number > last + 1:
            self.missing += number - last - 1
            self._cut = True
        self._number = number
        self._stamp_us = stamp
        return True


def stamp_us(message: Any) -> int:
    """Return the time in a message's header [us]."""
    return int(message.header.stamp.sec) * 1_000_000 + int(message.header.stamp.nanosec) // 1000


def _after_cut(words: NDArray[Any], layout: Layout) -> NDArray[Any]:
    """Return the words whose meaning does not depend on lost ones: from the first time on; in EVT 3.0, from a row."""
    kinds = layout.heads(words) >> layout.bits
    times = np.flatnonzero(kinds == TIME_HIGH)
    if not len(times):
        return words[:0]
    words = words[times[0] :]
    if layout.version != "3.0":
        return words
    kinds = kinds[times[0] :]
    rows = np.flatnonzero(kinds == ROW)
    if not len(rows):
        return words[:0]
    is_time = (kinds == TIME_HIGH) | (kinds == TIME_LOW)
    is_kept = is_time | (np.arange(len(words)) >= rows[0])
    return words[is_kept]


def mono_packets(events: Events) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield the time base [ns] and the bytes of packets in the encoding ``mono``, for events in order of time."""
    start = 0
    while start < len(events):
        first_us = int(events.t[start])
        most = int(np.searchsorted(events.t, first_us + LONGEST_US, side="right"))
        stop = min(most, start + MOST_EVENTS)
        part = events[start:stop]
        after_ns = (part.t - first_us).astype(np.uint64) * np.uint64(1000)
        x = part.x.astype(np.uint64) << np.uint64(32)
        y = part.y.astype(np.uint64) << np.uint64(48)
        p = part.p.astype(np.uint64) << np.uint64(63)
        yield 1000 * first_us, (after_ns | x | y | p).astype("<u8").view(np.uint8)
        start = stop
