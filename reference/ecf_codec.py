"""Decoder of Prophesee's ECF codec with NumPy: what the kernels are compared with.

A chunk holds the number of its events, then their times, rows, columns and polarities one after the other, as runs of
equal values or packed. The codec is described by https://github.com/prophesee-ai/hdf5_ecf.
"""

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

MOST_EVENTS = 65535
"""Largest number of events in a chunk."""
MOST_BYTES = 32 * MOST_EVENTS
"""Largest chunk that is read [bytes]. The codec writes at most nine bytes per event, and more only for gaps of time."""
HEAD = struct.Struct("<Iq")
"""Start of a chunk: number of events, with two bits that tell how they are packed; first time [us]."""
LONGEST_GAP = 15
"""Largest number of bytes, of four bits each, that store a gap of time [us]."""


class EventColumns(NamedTuple):
    """Events, arrays of shape ``(n,)``."""

    x: NDArray[np.uint16]
    """Column [px]."""
    y: NDArray[np.uint16]
    """Row [px]."""
    t: NDArray[np.int64]
    """Time [us]."""
    p: NDArray[np.uint8]
    """Polarity: 1 is ON, 0 is OFF."""


def decode_chunk(data: bytes) -> EventColumns:
    """Return the events in a chunk. Raises :class:`AmiwarpError` if it is damaged."""
    if len(data) < HEAD.size:
        raise AmiwarpError(
            f"a chunk of the ECF codec has {len(data)} bytes; expected {HEAD.size} of its head or more; the file is "
            "damaged, copy it again"
        )
    head, origin = HEAD.unpack_from(data)
    count = head >> 2
    if count > MOST_EVENTS or len(data) > MOST_BYTES:
        raise AmiwarpError(
            f"a chunk of the ECF codec has {count} events in {len(data)} bytes; expected at most {MOST_EVENTS} in "
            f"{MOST_BYTES}; the file is damaged, copy it again"
        )
    rest = np.frombuffer(data, np.uint8)[HEAD.size :]
    t, rest = _times(rest, origin, count)
    if head & 2:
        values, _ = _packed(rest, count, 24)
        x, y, p = values >> 1 & 0x7FF, values >> 12 & 0x7FF, values & 1
    else:
        y, rest = _runs(rest, count, "<u2", 5, 1)
        if head & 1:
            values, _ = _packed(rest, count, 12)
            x, p = values >> 1, values & 1
        else:
            x, rest = _masked(rest, count)
            p, _ = _runs(rest, count, "u1", 7, 2)
    return EventColumns(x.astype(np.uint16), y.astype(np.uint16), t, p.astype(np.uint8))


def _damaged(what: str) -> AmiwarpError:
    return AmiwarpError(
        f"the {what} of a chunk of the ECF codec, number 1 of 1, are damaged; copy the file again"
    )


def _without_lengths(
    words: NDArray[np.int64], long: NDArray[np.bool_], width: int
) -> NDArray[np.int64]:
    """Return the indices of the words that begin a run.

    Behind a ``long`` one, ``width`` words hold the length of the run. These can have any value, so one is followed at a
    time.
    """
    begins = np.ones(words.size, np.bool_)
    free = 0
    for at in np.flatnonzero(long).tolist():
        if at >= free:
            free = at + 1 + width
            begins[at + 1 : free] = False
    return np.flatnonzero(begins)


def _lengths(
    words: NDArray[np.int64],
    places: NDArray[np.int64],
    short: NDArray[np.int64],
    longest: int,
    width: int,
) -> NDArray[np.int64]:
    """Return the lengths of the runs: ``short``, or what the next ``width`` words hold if it is ``longest``."""
    padded = np.concatenate([words, np.zeros(2, np.int64)])
    long = padded[places + 1] | (padded[places + 2] << 8 if width == 2 else 0)
    return np.where(short == longest, long, short)


def _until(lengths: NDArray[np.int64], count: int, what: str) -> int:
    """Return the number of runs that hold ``count`` events together."""
    used = int(np.searchsorted(np.cumsum(lengths), count)) + 1 if count else 0
    if used > lengths.size or int(lengths[:used].sum()) != count:
        raise _damaged(what)
    return used


def _times(
    data: NDArray[np.uint8], origin: int, count: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the times of ``count`` events [us], and the bytes behind them.

    A byte holds a step of the time and the number of events at this time, four bits each. A step of 15 marks a byte
    with four bits of a longer gap, the lowest first.
    """
    words = data.astype(np.int64)
    gap = words >> 4 == 15
    places = _without_lengths(words, ~gap & (words & 15 == 15), 2)
    values, gap = words[places], gap[places]
    low = values & 15
    lengths = np.where(gap, 0, _lengths(words, places, low, 15, 2))
    used = _until(lengths, count, "times")
    values, gap, low, lengths = values[:used], gap[:used], low[:used], lengths[:used]
    # How many bytes of the same gap stand before each.
    order = np.arange(used)
    digit = order - np.maximum.accumulate(np.where(gap, -1, order)) - 1
    if used and bool((digit[gap] >= LONGEST_GAP).any()):
        raise _damaged("times")
    steps = np.where(gap, low << (4 * np.where(gap, digit, 0)), values >> 4)
    t = np.repeat(origin + np.cumsum(steps), lengths)
    end = 0
    if used:
        end = int(places[used - 1]) + (3 if low[-1] == 15 else 1)
    return t, data[end:]


def _runs(
    data: NDArray[np.uint8], count: int, dtype: str, bits: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the values of ``count`` events, and the bytes behind them.

    The lowest ``bits`` of a word hold the number of events with a value. If all are set, the next ``width`` words do.
    """
    size = np.dtype(dtype).itemsize
    words = np.frombuffer(data, dtype, data.size // size).astype(np.int64)
    longest = (1 << bits) - 1
    places = _without_lengths(words, words & longest == longest, width)
    values = words[places]
    lengths = _lengths(words, places, values & longest, longest, width)
    used = _until(lengths, count, "runs")
    end = 0
    if used:
        end = int(places[used - 1]) + (1 + width if values[used - 1] & longest == longest else 1)
    return np.repeat(values[:used] >> bits, lengths[:used]), data[size * end :]


def _masked(data: NDArray[np.uint8], count: int) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the columns of ``count`` events, and the bytes behind them.

    A word holds a column, and a bit for each of the five next ones, the highest for the nearest.
    """
    words = np.frombuffer(data, "<u2", data.size // 2).astype(np.int64)
    has = np.concatenate(
        [np.ones((words.size, 1), np.int64), words[:, None] >> np.array([4, 3, 2, 1, 0]) & 1],
        axis=1,
    )
    stops = np.cumsum(has.sum(axis=1))
    used = int(np.searchsorted(stops, count)) + 1 if count else 0
    if used > words.size:
        raise _damaged("columns")
    # The last word may tell of columns behind the last event, which the encoder does not clear.
    columns = (words[:used, None] >> 5) + np.arange(6)
    return columns[has[:used] == 1][:count], data[2 * used :]


def _packed(
    data: NDArray[np.uint8], count: int, bits: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the numbers of ``bits`` bits, 12 or 24, of ``count`` events, and the bytes behind them.

    Four numbers stand in three words of 16 or 32 bits, the upper bits first, except that the second and the third are
    cut: their lowest bits end the word before.
    """
    groups = -(-count // 4)
    width = bits * 4 // 3 // 8
    size = 3 * width * groups
    if data.size < size:
        raise _damaged("packed numbers")
    words = np.frombuffer(data[:size].tobytes(), f"<u{width}").astype(np.int64).reshape(groups, 3)
    part = bits // 3
    first, second, third = words.T
    numbers = np.empty((groups, 4), np.int64)
    numbers[:, 0] = first >> part
    numbers[:, 1] = first & ((1 << part) - 1) | (second >> (2 * part)) << part
    numbers[:, 2] = second & ((1 << 2 * part) - 1) | (third >> (3 * part)) << (2 * part)
    numbers[:, 3] = third & ((1 << 3 * part) - 1)
    return numbers.reshape(-1)[:count], data[size:]
