"""Reading of packets of Prophesee's EVT words in ROS bags, in the reading process.

It finds what the packets do not tell a decoder of words: where packets are missing, so that the row and the time of
the next events are unknown; where a pause was longer than the sensor's clock counts; and where this clock starts
again. :mod:`amiwarp.io.ros.events` decodes the words.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.evt_types import (
    ROW,
    SINGLE,
    TIME_HIGH,
    TIME_LOW,
    TRIGGER,
    VECTOR_8,
    VECTOR_12,
    VECTOR_BASE,
)
from amiwarp.io.file_pieces import unwrapped
from amiwarp.io.ros.bags import messages_of, note_unread, opened_bag
from amiwarp.io.ros.order import RESTART, in_order, with_number
from amiwarp.io.ros.words import Layout, checked_words

NO_EVENT = {"3.0": 0xF000, "2.0": 0xF0000000, "2.1": 0xF0000000_F0000000}
"""Word that decoders pass over, by version."""

PAUSE_ERROR_US = 1_000_000
"""Largest difference between the lengths of a pause by the stamps and by the sensor's clock [us]. The computer stamps
packets late, by up to this time."""

LONGEST_PAUSE_US = 100_000_000_000
"""Longest pause [us], 28 h. A larger step of the stamps is a clock of the computer that was set."""

FIRST_WORDS = 64
"""Number of words among which the first event of a message is searched for, before all are."""


@dataclass(slots=True)
class Unknown:
    """What the words so far do not determine: after lost packets, or at the beginning.

    Events that need it are taken out. Words of the time, of rows and of columns stay.
    """

    layout: Layout
    kinds: tuple[int, ...] = ()
    """Types of the words that must come first, TIME_HIGH before TIME_LOW."""

    def start(self) -> None:
        """Forget all that earlier words have determined."""
        self.kinds = (TIME_HIGH,)
        if self.layout.version == "3.0":
            self.kinds = (TIME_HIGH, TIME_LOW, ROW, VECTOR_BASE)

    def without_events(self, words: NDArray[Any]) -> tuple[NDArray[Any], int]:
        """Return words without the events whose time or place is unknown, and how many events and edges that are."""
        kind = self.layout.heads(words) >> self.layout.bits
        has_vectors = ((kind >= VECTOR_BASE) & (kind <= VECTOR_8)).any()
        if self.kinds == (VECTOR_BASE,) and not has_vectors:
            # Some sensors send no vectors, and never a base.
            return words, 0

        # For each word, whether the words so far determine the time, the row and the base of vectors.
        always = np.ones(kind.size, np.bool_)
        known = dict.fromkeys((TIME_HIGH, TIME_LOW, ROW, VECTOR_BASE), always)
        for word_kind in self.kinds:
            found = kind == word_kind
            if word_kind == TIME_LOW:
                # A TIME_LOW before the TIME_HIGH may belong to another TIME_HIGH.
                found &= known[TIME_HIGH]
            known[word_kind] = np.logical_or.accumulate(found)
        self.kinds = tuple(word_kind for word_kind in self.kinds if not known[word_kind][-1:].any())

        is_vector = np.zeros(kind.size, np.bool_)
        is_single = kind <= 1
        if self.layout.version == "3.0":
            is_vector = (kind == VECTOR_12) | (kind == VECTOR_8)
            is_single = kind == SINGLE
        is_timed = known[TIME_HIGH] & known[TIME_LOW]
        is_placed = known[ROW] & (known[VECTOR_BASE] | ~is_vector)
        lost = (is_single | is_vector) & ~(is_timed & is_placed)
        lost_edges = (kind == TRIGGER) & ~is_timed
        events_of_words = self.layout.counts(words[lost])
        lost_events = int(events_of_words.sum(dtype=np.int64))

        kept = words.copy()
        kept[(lost & is_single) | lost_edges] = NO_EVENT[self.layout.version]
        # A vector without pixels still moves the next one.
        kept[lost & is_vector] &= 0xF000
        return kept, lost_events + int(np.count_nonzero(lost_edges))


@dataclass(slots=True)
class SensorClock:
    """Clock of the sensor, which wraps around, next to the stamps of the computer, which are late."""

    layout: Layout
    notes: dict[str, int]
    """Counts, which get the long pauses and the restarts of the clock."""
    high: int | None = None
    """Last TIME_HIGH without its wraps, or None."""
    time: int | None = None
    """Time of the first event of an earlier message [us], or None."""
    stamp: int = 0
    """Stamp of that message [ns]."""
    restarted: bool = False
    """Whether the numbers of messages have started again since then."""

    def shift(self, words: NDArray[Any], stamp: int, following: int, *, restarted: bool) -> int:
        """Return what is added to the times from a message on [us].

        ``following``: stamp of the next message [ns]. A stamp that is later than it is in error, and is not used.
        """
        self.restarted |= restarted
        time = self._first_time(words)
        if time is None or following - stamp < -1000 * PAUSE_ERROR_US:
            return 0
        time_before = self.time
        elapsed_us = (stamp - self.stamp) // 1000
        was_restarted = self.restarted
        self.time = time
        self.stamp = stamp
        self.restarted = False
        if time_before is None:
            return 0

        # In a pause, the sensor's clock lacks whole turns against the stamps.
        period_us = self.layout.unit_us << self.layout.bits
        missing_us = elapsed_us - (time - time_before)
        wraps = (missing_us + period_us // 2) // period_us
        is_pause = (
            0 <= elapsed_us <= LONGEST_PAUSE_US
            and wraps >= 0
            and abs(missing_us - wraps * period_us) <= PAUSE_ERROR_US
        )
        if was_restarted and not is_pause:
            self.notes["clock_restarts"] = self.notes.get("clock_restarts", 0) + 1
            return missing_us
        if not is_pause or wraps == 0:
            return 0
        self.notes["long_pauses"] = self.notes.get("long_pauses", 0) + 1
        return wraps * period_us

    def _first_time(self, words: NDArray[Any]) -> int | None:
        """Return the time of the first event of the next words, without the lower bits [us].

        Before the first TIME_HIGH, it is the time of the TIME_HIGH; without events, the time of the end. None: no
        TIME_HIGH.
        """
        heads = self.layout.heads(words)
        kind = heads >> self.layout.bits
        places = np.flatnonzero(kind == TIME_HIGH)
        mask = (1 << self.layout.bits) - 1
        values = (heads[places] & mask).astype(np.int64)
        highs = unwrapped(values, self.layout.bits, self.high)
        if not highs.size:
            return None
        self.high = int(highs[-1])
        count = int(np.searchsorted(places, self._first_event(words)))
        return int(highs[max(count - 1, 0)]) * self.layout.unit_us

    def _first_event(self, words: NDArray[Any]) -> int:
        """Return the index of the first word with an event, or the number of words. It is one of the first, mostly."""
        for head in (words[:FIRST_WORDS], words):
            is_event = self.layout.counts(head) > 0
            if is_event.any():
                return int(is_event.argmax())
        return words.size


def read_words(
    notes: dict[str, int],
    path: str,
    topic: str,
    encoding: str,
    swapped: bool,
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield for each message of a topic: its words, their number, what is added to the times from there on [us], how
    many messages are missing before it (or RESTART or LATE), and the times of its recording and of its header [ns].
    """
    layout = Layout(encoding, swapped)
    clock = SensorClock(layout, notes)
    unknown = Unknown(layout)
    unknown.start()
    is_whole = True
    with opened_bag(path) as (bag, ros1):
        connections = [found for found in bag.connections if found.topic == topic]
        notes["total"] = max(sum(found.msgcount for found in connections), 1)
        read = (
            with_number(stored, ros1=ros1) for stored in messages_of(bag, connections, ros1=ros1)
        )
        for placed, following in _with_next(in_order(read, notes)):
            words = checked_words(placed.message, encoding)
            next_stamp = placed.stamp if following is None else following.stamp
            is_restart = placed.missing == RESTART
            shift = clock.shift(words, placed.stamp, next_stamp, restarted=is_restart)

            # After a message that ends within a word, words are lost.
            if not (placed.follows and is_whole):
                unknown.start()
            rest = len(placed.message.events) % words.itemsize
            is_whole = rest == 0
            notes["truncated_bytes"] = notes.get("truncated_bytes", 0) + rest
            if unknown.kinds:
                words, dropped = unknown.without_events(words)
                notes["dropped_unplaced_events"] = notes.get("dropped_unplaced_events", 0) + dropped
            notes["read"] = notes.get("read", 0) + 1
            numbers = [
                len(words),
                shift,
                placed.missing,
                placed.stored.recorded,
                placed.stamp,
            ]
            yield words, *(np.array([number], np.int64) for number in numbers)
        note_unread(notes)


def _with_next(values: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
    """Yield each value with the next one; the last with None."""
    return itertools.pairwise(itertools.chain(values, (None,)))
