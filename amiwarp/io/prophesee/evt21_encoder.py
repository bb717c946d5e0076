"""Encoder of events in Prophesee's EVT 2.1.

EVT 2.1 consists of 64-bit words: the upper 28 bits of the time, or the lower 6 bits with row, column, polarity and
the 32 pixels from that column on, one bit for each with an event. Successive events share a word as long as their
columns rise, because a decoder returns them in the order of the columns: so the order of the events is kept. The
format is described at https://docs.prophesee.ai/stable/data/encoding_formats/evt21.html.
"""

import numpy as np
from numpy.typing import NDArray

from amiwarp import evt_types
from amiwarp.events.recording import Events

VECTOR = 32
"""Pixels of a word."""
IN_VECTOR = np.uint64(VECTOR - 1)
"""Bits of a column that give its place within a word."""
LOW_BITS = np.uint64(6)
"""Number of bits of the time in the words of events."""
LOW_MASK = np.uint64(0x3F)
TIME_WORD = np.uint64(evt_types.TIME_HIGH << 60)

# Lowest bits of the fields of a word.
TYPE_AT = np.uint64(60)
TIME_LOW_AT = np.uint64(54)
COLUMN_AT = np.uint64(43)
ROW_AT = np.uint64(32)
TIME_HIGH_AT = np.uint64(32)


class Evt21Encoder:
    """Encoder of events that follow one another in time, from ``origin`` [us] on."""

    def __init__(self, origin: int) -> None:
        self._origin = origin
        self._high: int | None = None
        """Upper bits of the time of the last event."""

    def encode(self, events: Events) -> NDArray[np.uint64]:
        """Return the words of some events, at least one."""
        t = (events.t - self._origin).astype(np.uint64)
        x = events.x.astype(np.uint64)
        y = events.y.astype(np.uint64)

        # The polarity is the type of the word: 0 for OFF, 1 for ON.
        head = events.p.astype(np.uint64) << TYPE_AT
        head |= (t & LOW_MASK) << TIME_LOW_AT
        head |= (x & ~IN_VECTOR) << COLUMN_AT
        head |= y << ROW_AT

        high = t >> LOW_BITS
        changes = np.empty(len(events), np.bool_)
        changes[0] = self._high != int(high[0])
        np.not_equal(high[1:], high[:-1], out=changes[1:])
        self._high = int(high[-1])

        # A new word begins where the head differs, or where the columns do not rise.
        begins = np.ones(len(events), np.bool_)
        differs = head[1:] != head[:-1]
        falls = x[1:] <= x[:-1]
        begins[1:] = changes[1:] | differs | falls
        starts = np.flatnonzero(begins)
        bit_of_event = np.uint64(1) << (x & IN_VECTOR)
        words = head[starts] | np.bitwise_or.reduceat(bit_of_event, starts)

        # Words of the time come before the events for which its upper bits change.
        timed = np.flatnonzero(changes[starts])
        high_of_timed = high[starts[timed]]
        times = TIME_WORD | (high_of_timed << TIME_HIGH_AT)
        return np.insert(words, timed, times)
