"""Decoders of the ROS messages that hold events: arrays of events, and packets of a sensor's own words.

The messages are those of the packages dvs_msgs, prophesee_event_msgs, event_camera_msgs and, its former name,
event_array_msgs. Arrays of events are decoded with NumPy, because a Python object per event would be slow.
"""

from __future__ import annotations

import struct
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.evt_words import Columns, Evt2Decoder, Evt3Decoder, swap_halves, words_of

ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
"""Types of messages that hold an array of events."""

PACKETS = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
"""Types of messages that hold the words of a sensor."""

ARRAY_FIELDS = ("header", "height", "width", "events")
EVENT_FIELDS = ("x", "y", "ts", "polarity")
"""Order of the fields in both packages of :data:`ARRAYS`. Other orders are refused."""

PACKET_DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""
"""Definition of :data:`PACKETS`, for bags that store none."""

NOTHING: Columns = (np.zeros(0, np.int64),) * 4
"""No events."""


class Packet(Protocol):
    """Message of one of the types :data:`PACKETS`."""

    height: int
    width: int
    time_base: int
    encoding: str
    is_bigendian: bool
    events: NDArray[np.uint8]


class PacketDecoder:
    """Decoder of the messages of one topic, in their order."""

    def __init__(self) -> None:
        self._decoders: dict[str, Any] = {}

    def decode(self, message: Packet) -> tuple[Columns, Columns]:
        """Return the events and the triggers of a message. Times are the sensor's, not those of the computer."""
        if message.is_bigendian:
            raise AmiwarpError("has packets of big-endian words, which are not read; record on a little-endian machine")
        base, data = int(message.time_base), np.ascontiguousarray(message.events, np.uint8)
        if message.encoding in EVT:
            return self._evt(message.encoding, data)
        if message.encoding == "mono":
            return _mono(base, data), NOTHING
        if message.encoding == "trigger":
            x, _, t, p = _mono(base, data)
            return NOTHING, (np.zeros_like(x), np.zeros_like(x), t, p)
        if message.encoding == "libcaer":
            return _libcaer(base, data), NOTHING
        if message.encoding == "libcaer_cmp":
            return _libcaer_cmp(base, data), NOTHING
        known = ", ".join((*EVT, "mono", "trigger", "libcaer", "libcaer_cmp"))
        raise AmiwarpError(f"has packets with the encoding '{message.encoding[:40]}'; expected one of {known}")

    def _evt(self, encoding: str, data: NDArray[np.uint8]) -> tuple[Columns, Columns]:
        words = words_of(data, EVT[encoding])
        if encoding not in self._decoders:
            self._decoders[encoding] = Evt3Decoder() if encoding == "evt3" else Evt2Decoder(encoding == "evt21")
        decoder = self._decoders[encoding]
        events, edges = decoder.decode(swap_halves(words) if encoding == "evt21" else words)
        return events, edges


EVT = {"evt3": "3", "evt2": "2", "evt21": "2.1"}
"""Encodings with Prophesee's words, and their versions."""


def _mono(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return events of 64 bits: time after ``base`` [ns], x, y, polarity."""
    words = np.frombuffer(data, "<u8", len(data) // 8)
    t = (base + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)) // 1000
    rest = (words >> np.uint64(32)).astype(np.int64)
    return rest & 0xFFFF, rest >> 16 & 0x7FFF, t, rest >> 31


def _libcaer(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return events as libcaer stores them: a word with x, y, polarity, and the time [us] after ``base`` [ns]."""
    words = np.frombuffer(data, "<i4", len(data) // 8 * 2).reshape(-1, 2).astype(np.int64)
    low, word = words[:, 1], words[:, 0]
    wraps = np.cumsum(np.diff(low, prepend=low[:1]) < -(1 << 30))
    return word >> 17 & 0x7FFF, word >> 2 & 0x7FFF, base // 1000 + low + (wraps << 31), word >> 1 & 1


def _libcaer_cmp(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return the events of libcaer's compressed words, 16 bits each, whose state starts anew in each message."""
    words = np.frombuffer(data, "<u2", len(data) // 2)
    kind, load = words >> 12, (words & 0xFFF).astype(np.int64)

    def latest(code: int, values: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        at = np.maximum.accumulate(np.where(kind == code, np.arange(kind.size), -1))
        return np.concatenate([values, [0]])[at], at

    t = (latest(0, load)[0] << 12 | latest(1, load)[0]) + base // 1000
    x = latest(2, load & 0x7FF)[0]
    row, at = latest(4, load)
    # Each vector covers eight rows, and the next one continues behind it.
    vectors = np.cumsum(kind == 5)
    first = (row & 0x7FF) + 8 * (vectors - 1 - np.concatenate([vectors, [0]])[at])
    bits = np.where(kind == 3, 1, (load & 0xFF) * (kind == 5))
    which, bit = np.nonzero((bits[:, None] >> np.arange(8)) & 1)
    single = kind[which] == 3
    y = np.where(single, load[which] & 0x7FF, first[which] + bit)
    return x[which], y, t[which], np.where(single, load[which], row[which]) >> 11


def decode_array(raw: bytes | memoryview, *, ros1: bool) -> tuple[int, int, Columns]:
    """Return width, height and the events of a message of the types :data:`ARRAYS`."""
    order, start = "<", 0
    if not ros1:
        if bytes(raw[:2]) != b"\0\1":
            raise AmiwarpError(f"has messages of the encapsulation {bytes(raw[:2]).hex()}; expected little-endian CDR")
        raw = raw[4:]
    # The header: in ROS 1 a sequence number, then in both the time and a string.
    at = 12 if ros1 else 8
    (length,) = struct.unpack_from(f"{order}I", raw, at)
    at += 4 + length
    at = at if ros1 else -(-at // 4) * 4
    height, width, count = struct.unpack_from("<III", raw, at)
    start = at + 12
    return width, height, _packed(raw, start, count) if ros1 else _aligned(raw, start, count)


PACKED = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")])
"""Event of ROS 1, without padding."""

ALIGNED = np.dtype(
    {"names": ["x", "y", "sec", "nsec", "p"], "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
     "offsets": [0, 2, 6, 10, 14], "itemsize": 16}
)  # fmt: skip
"""Event of ROS 2 that begins 2 bytes after a multiple of 4, as all do except a first one at a multiple of 4."""


def _packed(raw: bytes | memoryview, start: int, count: int) -> Columns:
    if start + count * PACKED.itemsize > len(raw):
        raise AmiwarpError(f"has a message that declares {count} events, which it does not hold; the bag is damaged")
    return _columns(np.frombuffer(raw, PACKED, count, start))


def _aligned(raw: bytes | memoryview, start: int, count: int) -> Columns:
    """Return the events of a ROS 2 message, whose times lie at multiples of 4 bytes."""
    # The first event begins at a multiple of 4: 13 bytes, and one for the alignment of the next event to 2.
    size = 0 if count == 0 else 13 + max(count - 1, 0) * 16
    if start + size > len(raw):
        raise AmiwarpError(f"has a message that declares {count} events, which it does not hold; the bag is damaged")
    if not count:
        return NOTHING
    first = np.frombuffer(raw, PACKED, 1, start)
    whole = bytes(raw[start + 14 :]).ljust(16 * (count - 1), b"\0")
    rest = np.frombuffer(whole, ALIGNED, count - 1)
    x, y, t, p = (np.concatenate(pair) for pair in zip(_columns(first), _columns(rest), strict=True))
    return x, y, t, p


def _columns(events: NDArray[Any]) -> Columns:
    # Times are in seconds and nanoseconds; amiwarp's are whole microseconds.
    t = events["sec"].astype(np.int64) * 1_000_000 + events["nsec"].astype(np.int64) // 1000
    return events["x"], events["y"], t, events["p"]
