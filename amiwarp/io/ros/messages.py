"""Decoders of the ROS messages that hold events: arrays of events, and packets of a sensor's own words.

The messages are of the packages dvs_msgs, prophesee_event_msgs, dv_ros_msgs, dv_ros2_msgs, event_camera_msgs and, its
former name, event_array_msgs. Arrays of events are decoded with NumPy, because a Python object per event would be
slow. Words of Prophesee's sensors are in :mod:`amiwarp.io.ros.words`.
"""

import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.event_packets import Columns
from amiwarp.io.ros.words import EVT, check_byte_order

WORD_BYTES = {"mono": 8, "trigger": 8, "libcaer": 8, "libcaer_cmp": 2}
"""Encodings without EVT words, and the bytes of an event, or of a word of the compressed one."""

NOTHING: Columns = (np.zeros(0, np.int64),) * 4
"""No events."""


# Types of libcaer's compressed words, in their upper four bits.
TIME_HIGH = 0
"""Upper 12 bits of the time."""
TIME_LOW = 1
"""Lower 12 bits of the time."""
COLUMN = 2
"""Column of the events that follow."""
SINGLE = 3
"""Row and polarity of one event."""
FIRST_ROW = 4
"""First row of the next vectors, and their polarity."""
VECTOR = 5
"""One bit for each of eight rows."""

PACKED = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")])
"""Event of ROS 1, without padding."""

ALIGNED = np.dtype(
    {
        "names": ["x", "y", "sec", "nsec", "p"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
"""Event of ROS 2 that begins 2 bytes after a multiple of 4, as all do except a first one at a multiple of 4: the first
begins at 0 and has its times at 4, the second begins at 14 and has them at 20."""

ALIGNMENT = 4
"""Number of bytes to a multiple of which a message of ROS 2 may be padded."""


def decode_packet(message: Any) -> tuple[Columns, Columns]:
    """Return the events and the triggers of a message without EVT words. Times are the sensor's, not the computer's."""
    check_byte_order(message)
    base = int(message.time_base)
    data = np.ascontiguousarray(message.events, np.uint8)
    if message.encoding == "mono":
        return _mono(base, data), NOTHING
    if message.encoding == "trigger":
        x, _, t, p = _mono(base, data)
        channel = np.zeros_like(x)
        return NOTHING, (channel, np.zeros_like(x), t, p)
    if message.encoding == "libcaer":
        return _libcaer(base, data), NOTHING
    if message.encoding == "libcaer_cmp":
        return _libcaer_cmp(base, data), NOTHING
    if message.encoding in EVT:
        raise AmiwarpError(
            f"has packets of several encodings, now '{message.encoding}'; record the topic again with one encoding",
            ErrorCode.FORMAT_UNKNOWN,
        )
    known = ", ".join((*EVT, *WORD_BYTES))
    raise AmiwarpError(
        f"has packets with the encoding '{message.encoding[:40]}'; expected one of {known}",
        ErrorCode.FORMAT_UNKNOWN,
    )


def truncated_bytes(message: Any) -> int:
    """Return the number of bytes at the end of a message that are no whole word, after :func:`decode_packet`."""
    return len(message.events) % WORD_BYTES[message.encoding]


def _mono(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return events of 64 bits: time after ``base`` [ns], x, y, polarity."""
    words = np.frombuffer(data, "<u8", len(data) // 8)
    time_ns = (words & np.uint64(0xFFFFFFFF)).astype(np.int64)
    rest = (words >> np.uint64(32)).astype(np.int64)
    t = (base + time_ns) // 1000
    x = rest & 0xFFFF
    y = rest >> 16 & 0x7FFF
    p = rest >> 31
    return x, y, t, p


def _libcaer(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return events as libcaer stores them: a word with x, y, polarity, and the time [us] after ``base`` [ns]."""
    events = len(data) // 8
    halves = np.frombuffer(data, "<i4", events * 2).reshape(-1, 2).astype(np.int64)
    word = halves[:, 0]
    low = halves[:, 1]
    # The stored time has 31 bits. A large step back is a wrap.
    steps = np.diff(low, prepend=low[:1])
    wraps = np.cumsum(steps < -(1 << 30))
    t = base // 1000 + low + (wraps << 31)
    x = word >> 17 & 0x7FFF
    y = word >> 2 & 0x7FFF
    p = word >> 1 & 1
    return x, y, t, p


def _libcaer_cmp(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return the events of libcaer's compressed words, 16 bits each, whose state starts anew in each message."""
    words = np.frombuffer(data, "<u2", len(data) // 2)
    kind = words >> 12
    value = (words & 0xFFF).astype(np.int64)

    def index_of_latest(code: int) -> NDArray[np.int64]:
        """Return for each word the index of the last word of a type so far, or -1."""
        index = np.where(kind == code, np.arange(kind.size), -1)
        return np.maximum.accumulate(index)

    # The state before the first word of a type is 0, which index -1 finds.
    values = np.concatenate([value, [0]])
    high = values[index_of_latest(TIME_HIGH)]
    low = values[index_of_latest(TIME_LOW)]
    t = (high << 12 | low) + base // 1000
    x = values[index_of_latest(COLUMN)] & 0x7FF

    # Each vector covers eight rows, and the next one continues behind it.
    latest_row = index_of_latest(FIRST_ROW)
    row = values[latest_row]
    vectors = np.cumsum(kind == VECTOR)
    vectors_before_row = np.concatenate([vectors, [0]])[latest_row]
    earlier_vectors = vectors - 1 - vectors_before_row
    first_row = (row & 0x7FF) + 8 * earlier_vectors

    # One row per word, one column per bit: a single event is a vector with the first bit set.
    bits_of_vector = np.where(kind == VECTOR, value & 0xFF, 0)
    bits = np.where(kind == SINGLE, 1, bits_of_vector)
    is_set = (bits[:, None] >> np.arange(8)) & 1
    word, bit = np.nonzero(is_set)

    # A single event has its own row and polarity, a vector the row and polarity of the last first row.
    is_single = kind[word] == SINGLE
    y = np.where(is_single, value[word] & 0x7FF, first_row[word] + bit)
    p = np.where(is_single, value[word], row[word]) >> 11
    return x[word], y, t[word], p


def decode_array(raw: bytes | memoryview, *, ros1: bool) -> tuple[int, int, Columns]:
    """Return width, height and the events of a message of the types :data:`amiwarp.io.ros.bags.ARRAYS`."""
    if not ros1:
        encapsulation = bytes(raw[:2])
        if encapsulation != b"\0\1":
            raise AmiwarpError(
                f"has messages of the encapsulation {encapsulation.hex()}; expected little-endian CDR; convert the bag "
                "with ros2 bag convert",
                ErrorCode.FORMAT_UNKNOWN,
            )
        raw = raw[4:]
    # The header: in ROS 1 a sequence number, then in both the time and a string. In ROS 2, numbers are aligned.
    offset = 12 if ros1 else 8
    _need(raw, offset + 4)
    (length,) = struct.unpack_from("<I", raw, offset)
    offset += 4 + length
    if not ros1:
        offset = math.ceil(offset / ALIGNMENT) * ALIGNMENT
    start = offset + 12
    _need(raw, start)
    height, width, count = struct.unpack_from("<III", raw, offset)
    if ros1:
        return width, height, _packed(raw, start, count)
    return width, height, _aligned(raw, start, count)


def _need(raw: bytes | memoryview, stop: int) -> None:
    """Raise :class:`AmiwarpError` if a message ends before byte ``stop`` of its header."""
    if len(raw) < stop:
        raise AmiwarpError(
            f"has a message of {len(raw)} bytes, whose header alone needs {stop}; the bag is damaged, copy it again",
            ErrorCode.FILE_DAMAGED,
        )


def _check_length(raw: bytes | memoryview, end: int, count: int, padding: int) -> None:
    """Raise :class:`AmiwarpError` if a message does not end behind its events, or up to ``padding`` bytes later."""
    if not end <= len(raw) <= end + padding:
        raise AmiwarpError(
            f"has a message that declares {count} events, but has {len(raw)} bytes; expected {end}; the bag is "
            "damaged, copy it again",
            ErrorCode.FILE_DAMAGED,
        )


def _packed(raw: bytes | memoryview, start: int, count: int) -> Columns:
    """Return the events of a ROS 1 message."""
    end = start + count * PACKED.itemsize
    _check_length(raw, end, count, 0)
    return _columns(np.frombuffer(raw, PACKED, count, start))


def _aligned(raw: bytes | memoryview, start: int, count: int) -> Columns:
    """Return the events of a ROS 2 message, whose times lie at multiples of 4 bytes."""
    # The first event begins at a multiple of 4: 13 bytes, and one for the alignment of the next event to 2.
    size = 0 if count == 0 else 13 + (count - 1) * 16
    _check_length(raw, start + size, count, ALIGNMENT - 1)
    if not count:
        return NOTHING
    first = _columns(np.frombuffer(raw, PACKED, 1, start))
    rest = bytes(raw[start + 14 :])
    padded = rest.ljust(16 * (count - 1), b"\0")
    others = _columns(np.frombuffer(padded, ALIGNED, count - 1))
    x, y, t, p = (np.concatenate(pair) for pair in zip(first, others, strict=True))
    return x, y, t, p


def _columns(events: NDArray[Any]) -> Columns:
    """Return the columns of events."""
    # Times are in seconds and nanoseconds; amiwarp's are whole microseconds.
    seconds = events["sec"].astype(np.int64)
    nanoseconds = events["nsec"].astype(np.int64)
    t = seconds * 1_000_000 + nanoseconds // 1000
    return events["x"], events["y"], t, events["p"]
