"""Encoder of events in Prophesee's EVT 3.0.

EVT 3.0 consists of 16-bit words that set the state of the decoder: upper and lower 12 bits of the time, row, and
column with polarity. The last one is an event. A word is written if its value changes. The format is described at
https://docs.prophesee.ai/stable/data/encoding_formats/evt3.html. faery's encoder is not used, because it loses gaps
of more than 16.8 s, the range of the 24 bits of the time.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp import evt_types
from amiwarp.events.recording import Events

Words = NDArray[np.uint16]

ROW_WORD = evt_types.ROW << 12
SINGLE_WORD = evt_types.SINGLE << 12
TIME_LOW_WORD = evt_types.TIME_LOW << 12
TIME_HIGH_WORD = evt_types.TIME_HIGH << 12

LOW_BITS = 12
"""Bits of the time in each of the two words."""
LOW_MASK = (1 << LOW_BITS) - 1

STOPS = (0x000, 0x7FF, 0xFFF)
"""Values that the upper bits of the time never skip. Decoders take other large steps for a step back or for a wrap."""


class Evt3Encoder:
    """Encoder of events that follow one another in time, from ``origin`` [us] on."""

    def __init__(self, origin: int) -> None:
        self._origin = origin
        self._last: tuple[int, int, int] | None = None
        """Upper bits of the time, time and row of the last event."""

    def encode(self, events: Events, *, self_contained: bool = False) -> Words:
        """Return the words of some events, at least one. Self-contained words begin with time and row."""
        t = events.t - self._origin
        high = t >> LOW_BITS
        y = events.y
        begins = self_contained or self._last is None
        last_high, last_t, last_y = self._last or (0, 0, 0)

        # A word is used if its value differs from the event before. The word of the column is always used.
        used = np.ones((len(events), 4), np.bool_)
        used[:, 0] = _differs_from_before(high, last_high)
        used[:, 1] = _differs_from_before(t, last_t)
        used[:, 2] = _differs_from_before(y, last_y)
        if begins:
            used[0] = True

        words = np.empty((len(events), 4), np.uint16)
        polarity = events.p.astype(np.uint16)
        words[:, 0] = TIME_HIGH_WORD | (high & LOW_MASK)
        words[:, 1] = TIME_LOW_WORD | (t & LOW_MASK)
        words[:, 2] = ROW_WORD | y
        words[:, 3] = SINGLE_WORD | (polarity << 11) | events.x

        self._last = int(high[-1]), int(t[-1]), int(y[-1])
        high_with_last = np.concatenate([[last_high], high])
        return _with_stops(words[used], used, high_with_last)


def _differs_from_before(values: NDArray[Any], last: int) -> NDArray[np.bool_]:
    """Return which values differ from the value before them; ``last`` is before the first."""
    differs = np.empty(len(values), np.bool_)
    differs[0] = values[0] != last
    np.not_equal(values[1:], values[:-1], out=differs[1:])
    return differs


def _with_stops(
    words: Words,
    used: NDArray[np.bool_],
    high: NDArray[np.int64],
) -> Words:
    """Insert words for the stops that the upper bits of the time skip before an event.

    ``used``: which of its four words each event has, shape (n, 4). ``high``: upper bits of the time of the event
    before the first one, and of each event, shape (n + 1,).
    """
    may_skip = np.flatnonzero(np.diff(high) > 1)
    if not may_skip.size:
        return words
    words_before = np.zeros(len(used) + 1, np.int64)
    np.cumsum(used.sum(axis=1), out=words_before[1:])

    places: list[NDArray[np.int64]] = []
    inserted: list[NDArray[Any]] = []
    for event in may_skip.tolist():
        stops = _stops_between(int(high[event]), int(high[event + 1]))
        if stops.size:
            places.append(np.full(stops.size, words_before[event]))
            inserted.append(TIME_HIGH_WORD | stops)
    if not inserted:
        return words
    return np.insert(words, np.concatenate(places), np.concatenate(inserted))


def _stops_between(low: int, high: int) -> Words:
    """Return the stops above ``low`` and below ``high``, in order, modulo 4096."""
    first_turn = low >> LOW_BITS
    last_turn = high >> LOW_BITS
    turns = np.arange(first_turn, last_turn + 1) << LOW_BITS
    stops = (turns[:, None] + np.array(STOPS)).ravel()
    between = (stops > low) & (stops < high)
    return (stops[between] & LOW_MASK).astype(np.uint16)
