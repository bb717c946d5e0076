"""Packets of Prophesee's EVT words in ROS bags: lost packets, long pauses and the order of halves.

The reading process reads the messages. It finds what the packets do not tell a decoder of words: where packets are
missing, so that the row and the time of the next events are unknown; where a pause was longer than the sensor's clock
counts; and where this clock starts again. :mod:`amiwarp.io.ros_events` decodes the words.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.evt_types import ROW, SINGLE, TIME_HIGH, TIME_LOW, TRIGGER, VECTOR_8, VECTOR_12, VECTOR_BASE
from amiwarp.io.evt_words import halves_of, words_of
from amiwarp.io.file_scan import unwrapped
from amiwarp.io.ros_bags import messages_of, note_unread, opened_bag
from amiwarp.io.ros_order import RESTART, in_order, numbered

EVT = {"evt3": "3.0", "evt2": "2.0", "evt21": "2.1"}
"""Encodings with Prophesee's words, and their versions."""

NO_EVENT = {"3.0": 0xF000, "2.0": 0xF0000000, "2.1": 0xF0000000_F0000000}
"""Word that decoders pass over, by version."""

PAUSE_ERROR_US = 1_000_000
"""Largest difference between the lengths of a pause by the stamps and by the sensor's clock [us]. The computer stamps
packets late, by up to this time."""

LONGEST_PAUSE_US = 100_000_000_000
"""Longest pause [us], 28 h. A larger step of the stamps is a clock of the computer that was set."""

ORDER_WORDS = 1 << 18
"""Number of words of EVT 2.1 from which the order of their halves is found."""

FIRST_WORDS = 64
"""Number of words among which the first event of a message is searched for, before all are."""

BITS = np.unpackbits(np.arange(1 << 16, dtype="<u2").view(np.uint8).reshape(-1, 2), axis=1).sum(axis=1, dtype=np.uint8)
"""Number of set bits of each number of 16 bits."""


@dataclass(frozen=True, slots=True)
class Layout:
    """How the words of an encoding are laid out."""

    encoding: str
    """Name of the encoding in the messages."""
    swapped: bool = False
    """Whether the 32-bit halves of EVT 2.1 words are swapped."""

    @property
    def version(self) -> str:
        """Version of EVT."""
        return EVT[self.encoding]

    @property
    def bits(self) -> int:
        """Number of bits of a word below its type, and of a TIME_HIGH."""
        return 12 if self.version == "3.0" else 28

    @property
    def unit_us(self) -> int:
        """Unit of TIME_HIGH [us]."""
        return 1 << 12 if self.version == "3.0" else 1 << 6

    def heads(self, words: NDArray[Any]) -> NDArray[Any]:
        """Return what holds the type of each word: the word, or a half of EVT 2.1."""
        return words if self.version != "2.1" else words.view("<u4")[0 if self.swapped else 1 :: 2]

    def counts(self, words: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the number of events of each word."""
        kind = self.heads(words) >> self.bits
        if self.version == "3.0":
            single = (kind == SINGLE).astype(np.uint16)
            pixels = np.where(kind == VECTOR_12, words & 0xFFF, np.where(kind == VECTOR_8, words & 0xFF, single))
            return BITS[pixels]
        is_event = (kind <= 1).astype(np.uint8)
        if self.version == "2.0":
            return is_event
        pixels = words.view("<u4")[1 if self.swapped else 0 :: 2]
        return (BITS[pixels & 0xFFFF] + BITS[pixels >> 16]) * is_event


def layout_of(encoding: str, messages: Iterable[Any]) -> tuple[Layout, str | None]:
    """Return the layout of the words in some messages, and a note if it is not certain.

    Raises :class:`AmiwarpError` if the words fit no layout.
    """
    if encoding != "evt21":
        return Layout(encoding), None
    parts = []
    count = 0
    for message in messages:
        parts.append(checked_words(message, encoding))
        count += len(parts[-1])
        if count >= ORDER_WORDS:
            break
    if not count:
        return Layout(encoding), None
    found = halves_of(np.concatenate(parts))
    if found is None:
        raise AmiwarpError(
            "has EVT 2.1 words without times that rise, in either order of their 32-bit halves; "
            "the bag is damaged, or its encoding is not evt21"
        )
    order = "swapped" if found.swapped else "not swapped"
    note = None if found.certain else f"assumed to be {order}: the words have times that rise in both orders"
    return Layout(encoding, found.swapped), note


# Reading of the messages, in the reading process.


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
        three = self.layout.version == "3.0"
        self.kinds = (TIME_HIGH, TIME_LOW, ROW, VECTOR_BASE) if three else (TIME_HIGH,)

    def without_events(self, words: NDArray[Any]) -> tuple[NDArray[Any], int]:
        """Return words without the events whose time or place is unknown, and how many events and edges that are."""
        kind = self.layout.heads(words) >> self.layout.bits
        if self.kinds == (VECTOR_BASE,) and not ((kind >= VECTOR_BASE) & (kind <= VECTOR_8)).any():
            return words, 0  # some sensors send no vectors, and never a base
        always = np.ones(kind.size, np.bool_)
        known = dict.fromkeys((TIME_HIGH, TIME_LOW, ROW, VECTOR_BASE), always)
        for each in self.kinds:
            found = kind == each
            if each == TIME_LOW:  # one before the TIME_HIGH may belong to another TIME_HIGH
                found &= known[TIME_HIGH]
            known[each] = np.logical_or.accumulate(found)
        self.kinds = tuple(each for each in self.kinds if not known[each][-1:].any())
        timed = known[TIME_HIGH] & known[TIME_LOW]
        vector = np.zeros(kind.size, np.bool_)
        single = kind <= 1
        if self.layout.version == "3.0":
            vector = (kind == VECTOR_12) | (kind == VECTOR_8)
            single = kind == SINGLE
        placed = known[ROW] & (known[VECTOR_BASE] | ~vector)
        lost = (single | vector) & ~(timed & placed)
        edges = (kind == TRIGGER) & ~timed
        count = int(self.layout.counts(words[lost]).sum(dtype=np.int64)) + int(np.count_nonzero(edges))
        kept = words.copy()
        kept[(lost & single) | edges] = NO_EVENT[self.layout.version]
        kept[lost & vector] &= 0xF000  # a vector without pixels still moves the next one
        return kept, count


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
        time, before = self._first_time(words), self.time
        if time is None or following - stamp < -1000 * PAUSE_ERROR_US:
            return 0
        elapsed = (stamp - self.stamp) // 1000
        was_restarted = self.restarted
        self.time, self.stamp, self.restarted = time, stamp, False
        if before is None:
            return 0
        period = self.layout.unit_us << self.layout.bits
        missing = elapsed - (time - before)
        wraps = (missing + period // 2) // period
        is_pause = 0 <= elapsed <= LONGEST_PAUSE_US and wraps >= 0 and abs(missing - wraps * period) <= PAUSE_ERROR_US
        if was_restarted and not is_pause:
            self.notes["clock_restarts"] = self.notes.get("clock_restarts", 0) + 1
            return missing
        if not is_pause or wraps == 0:
            return 0
        self.notes["long_pauses"] = self.notes.get("long_pauses", 0) + 1
        return wraps * period

    def _first_time(self, words: NDArray[Any]) -> int | None:
        """Return the time of the first event of the next words, without the lower bits [us].

        Before the first TIME_HIGH, it is that of the TIME_HIGH; without events, that of the end. None: no TIME_HIGH.
        """
        heads = self.layout.heads(words)
        kind = heads >> self.layout.bits
        places = np.flatnonzero(kind == TIME_HIGH)
        values = (heads[places] & ((1 << self.layout.bits) - 1)).astype(np.int64)
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
    notes: dict[str, int], path: str, topic: str, encoding: str, swapped: bool
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield for each message of a topic: its words, their number, what is added to the times from there on [us], how
    many messages are missing before it (or RESTART or LATE), and the times of its recording and of its header [ns].
    """
    layout = Layout(encoding, swapped)
    clock, unknown = SensorClock(layout, notes), Unknown(layout)
    unknown.start()
    whole = True
    with opened_bag(path) as (bag, ros1):
        connections = [found for found in bag.connections if found.topic == topic]
        notes["total"] = max(sum(found.msgcount for found in connections), 1)
        read = (numbered(one, ros1=ros1) for one in messages_of(bag, connections, ros1=ros1))
        for each, following in _with_next(in_order(read, notes)):
            words = checked_words(each.message, encoding)
            after = each.stamp if following is None else following.stamp
            shift = clock.shift(words, each.stamp, after, restarted=each.missing == RESTART)
            if not (each.follows and whole):
                unknown.start()
            rest = len(each.message.events) % words.itemsize
            whole = rest == 0  # otherwise words are lost, which those of the next message may follow
            notes["truncated_bytes"] = notes.get("truncated_bytes", 0) + rest
            if unknown.kinds:
                words, dropped = unknown.without_events(words)
                notes["dropped_unplaced_events"] = notes.get("dropped_unplaced_events", 0) + dropped
            notes["read"] = notes.get("read", 0) + 1
            numbers_of = (len(words), shift, each.missing, each.one.recorded, each.stamp)
            yield words, *(np.array([value], np.int64) for value in numbers_of)
        note_unread(notes)


def _with_next(values: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
    """Yield each value with the next one; the last with None."""
    return itertools.pairwise(itertools.chain(values, (None,)))


def checked_words(message: Any, encoding: str) -> NDArray[Any]:
    """Return the words of a message. Raises :class:`AmiwarpError` for another encoding."""
    if message.encoding != encoding:
        raise AmiwarpError(
            f"has packets of the encodings '{encoding}' and '{message.encoding[:40]}' in one topic; "
            "filter the bag to one of them"
        )
    check_byte_order(message)
    return words_of(message.events, EVT[encoding])


def check_byte_order(message: Any) -> None:
    """Raise :class:`AmiwarpError` if a big-endian machine wrote the words of a message."""
    if message.is_bigendian:
        raise AmiwarpError("has packets of big-endian words, which are not read; record on a little-endian machine")
