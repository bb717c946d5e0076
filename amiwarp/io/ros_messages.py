"""Decoders of the ROS messages that hold events: arrays of events, and packets of a sensor's own words.

The messages are those of the packages dvs_msgs, prophesee_event_msgs, dv_ros_msgs, dv_ros2_msgs, event_camera_msgs and,
its former name, event_array_msgs. Arrays of events are decoded with NumPy, because a Python object per event would be
slow. Words of Prophesee's sensors are in :mod:`amiwarp.io.ros_words`.
"""

import struct
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.ros_words import EVT, check_byte_order

Columns: TypeAlias = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
"""Arrays x, y [px], t [us], p of events; or channel, 0, t [us] and 1 for a rising edge, of triggers."""

WORD_BYTES = {"mono": 8, "trigger": 8, "libcaer": 8, "libcaer_cmp": 2}
"""Encodings without EVT words, and the bytes of an event, or of a word of the compressed one."""

NOTHING: Columns = (np.zeros(0, np.int64),) * 4
"""No events."""


def decode_packet(message: Any) -> tuple[Columns, Columns]:
    """Return the events and the triggers of a message without EVT words. Times are the sensor's, not the computer's."""
    check_byte_order(message)
    base = int(message.time_base)
    data = np.ascontiguousarray(message.events, np.uint8)
    if message.encoding == "mono":
        return _mono(base, data), NOTHING
    if message.encoding == "trigger":
        x, _, t, p = _mono(base, data)
        return NOTHING, (np.zeros_like(x), np.zeros_like(x), t, p)
    if message.encoding == "libcaer":
        return _libcaer(base, data), NOTHING
    if message.encoding == "libcaer_cmp":
        return _libcaer_cmp(base, data), NOTHING
    known = ", ".join((*EVT, *WORD_BYTES))
    raise AmiwarpError(
        f"has packets with the encoding '{message.encoding[:40]}'; expected one of {known}, in the whole topic"
    )


def truncated_bytes(message: Any) -> int:
    """Return the number of bytes at the end of a message that are no whole word."""
    return len(message.events) % WORD_BYTES[message.encoding]


def _mono(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return events of 64 bits: time after ``base`` [ns], x, y, polarity."""
    words = np.frombuffer(data, "<u8", len(data) // 8)
    t = (base + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)) // 1000
    rest = (words >> np.uint64(32)).astype(np.int64)
    return rest & 0xFFFF, rest >> 16 & 0x7FFF, t, rest >> 31


def _libcaer(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return events as libcaer stores them: a word with x, y, polarity, and the time [us] after ``base`` [ns]."""
    words = np.frombuffer(data, "<i4", len(data) // 8 * 2).reshape(-1, 2).astype(np.int64)
    word = words[:, 0]
    low = words[:, 1]
    # The time has 31 bits. A large step back is a wrap.
    wraps = np.cumsum(np.diff(low, prepend=low[:1]) < -(1 << 30))
    t = base // 1000 + low + (wraps << 31)
    return word >> 17 & 0x7FFF, word >> 2 & 0x7FFF, t, word >> 1 & 1


# Types of libcaer's compressed words, in their upper four bits.
TIME_HIGH = 0
TIME_LOW = 1
COLUMN = 2
SINGLE = 3
"""Row and polarity of one event."""
FIRST_ROW = 4
"""First row of the next vectors, and their polarity."""
VECTOR = 5
"""One bit for each of eight rows."""


def _libcaer_cmp(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return the events of libcaer's compressed words, 16 bits each, whose state starts anew in each message."""
    words = np.frombuffer(data, "<u2", len(data) // 2)
    kind = words >> 12
    load = (words & 0xFFF).astype(np.int64)

    def latest(code: int, values: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return for each word the value of the last word of a type so far, or 0, and its index, or -1."""
        at = np.maximum.accumulate(np.where(kind == code, np.arange(kind.size), -1))
        return np.concatenate([values, [0]])[at], at

    high, _ = latest(TIME_HIGH, load)
    low, _ = latest(TIME_LOW, load)
    t = (high << 12 | low) + base // 1000
    x, _ = latest(COLUMN, load & 0x7FF)
    row, at = latest(FIRST_ROW, load)
    # Each vector covers eight rows, and the next one continues behind it.
    vectors = np.cumsum(kind == VECTOR)
    earlier = vectors - 1 - np.concatenate([vectors, [0]])[at]
    first = (row & 0x7FF) + 8 * earlier
    # One row per word, one column per bit: a single event is a vector with the first bit set.
    bits = np.where(kind == SINGLE, 1, (load & 0xFF) * (kind == VECTOR))
    which, bit = np.nonzero((bits[:, None] >> np.arange(8)) & 1)
    single = kind[which] == SINGLE
    y = np.where(single, load[which] & 0x7FF, first[which] + bit)
    p = np.where(single, load[which], row[which]) >> 11
    return x[which], y, t[which], p


def decode_array(raw: bytes | memoryview, *, ros1: bool) -> tuple[int, int, Columns]:
    """Return width, height and the events of a message of the types :data:`ARRAYS`."""
    if not ros1:
        if bytes(raw[:2]) != b"\0\1":
            raise AmiwarpError(f"has messages of the encapsulation {bytes(raw[:2]).hex()}; expected little-endian CDR")
        raw = raw[4:]
    # The header: in ROS 1 a sequence number, then in both the time and a string.
    at = 12 if ros1 else 8
    (length,) = struct.unpack_from("<I", raw, at)
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


ALIGNMENT = 4
"""Number of bytes to a multiple of which a message of ROS 2 may be padded."""


def _check_length(raw: bytes | memoryview, end: int, count: int, padding: int) -> None:
    """Raise :class:`AmiwarpError` if a message does not end behind its events, or up to ``padding`` bytes later."""
    if not end <= len(raw) <= end + padding:
        raise AmiwarpError(
            f"has a message that declares {count} events, but has {len(raw)} bytes instead of {end}; the bag is damaged"
        )


def _packed(raw: bytes | memoryview, start: int, count: int) -> Columns:
    _check_length(raw, start + count * PACKED.itemsize, count, 0)
    return _columns(np.frombuffer(raw, PACKED, count, start))


def _aligned(raw: bytes | memoryview, start: int, count: int) -> Columns:
    """Return the events of a ROS 2 message, whose times lie at multiples of 4 bytes."""
    # The first event begins at a multiple of 4: 13 bytes, and one for the alignment of the next event to 2.
    size = 0 if count == 0 else 13 + max(count - 1, 0) * 16
    _check_length(raw, start + size, count, ALIGNMENT - 1)
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
