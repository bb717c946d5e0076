"""Order of the messages of a ROS bag by the numbers of their publishers: missing, late and repeated messages.

A number that falls mostly belongs to a late or a repeated message, and seldom shows a new start of the driver. These
differ in the stamps: a late message has an earlier one than the message before it. Runs in the reading process.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from amiwarp.io.ros.bags import ARRAYS, Message, deserialised

RESTART = -1
"""Stands for a number that does not continue the one before, as after a new start of the driver."""

LATE = -2
"""Stands for the number of a message that came too late to be put in its place."""

LARGEST_GAP = 1 << 32
"""Largest number of missing messages. A larger step is another count."""

AHEAD = 16
"""Number of messages that are read ahead. A message may come late by at most this number, and is put in its place."""

AHEAD_BYTES = 1 << 26
"""Size of the messages above which fewer are read ahead [bytes]."""

FIRST_NUMBERS = 100
"""Numbers up to which a driver counts soon after its start, and the largest fall that is too small for a new start."""

NEW_START_NS = 500_000_000
"""Shortest time in which a driver starts again [ns]."""

LATEST_NS = 10_000_000_000
"""Largest step back of the stamps at a late message [ns]. At a larger one the clock of the computer was set."""

REMEMBERED = 1000
"""Number of messages among which a repeated one is found."""

TAIL_BYTES = 64
"""Number of bytes at the end of a message that are compared: the last words, which hold a time."""


class Numbered(NamedTuple):
    """Message and its number."""

    stored: Message
    """The message in the bag."""
    message: Any
    """The message as an object; None for arrays, which are decoded without."""
    number: int | None
    """Its number, or None if its type has none."""
    stamp: int
    """Time in its header [ns]."""


def with_number(stored: Message, *, ros1: bool) -> Numbered:
    """Return a message with its number. Arrays have their header's number, which only ROS 1 counts."""
    if stored.connection.msgtype not in ARRAYS:
        message = deserialised(stored.connection, stored.raw, ros1=ros1)
        stamp = message.header.stamp
        stamp_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec)
        return Numbered(stored, message, number_of(message), stamp_ns)
    if not ros1:
        return Numbered(stored, None, None, 0)
    number, seconds, nanoseconds = struct.unpack_from("<III", stored.raw)
    return Numbered(stored, None, number, seconds * 10**9 + nanoseconds)


def number_of(message: Any) -> int:
    """Return the number of a message, or of its header, which only ROS 1 counts; 0 if it has none."""
    number = getattr(message, "seq", None)
    return int(getattr(message.header, "seq", 0) if number is None else number)


class Placed(NamedTuple):
    """Message in its place."""

    stored: Message
    """The message in the bag."""
    message: Any
    """The message as an object; None for arrays."""
    stamp: int
    """Time in its header [ns]."""
    missing: int
    """How many messages are missing before it, or :data:`RESTART` or :data:`LATE`."""
    follows: bool
    """Whether it continues the words of the message before it."""


def in_order(messages: Iterable[Numbered], notes: dict[str, int]) -> Iterator[Placed]:
    """Yield messages in the order of their numbers, without repeated ones, and count what is missing, late or repeated.

    A message that is late by more than :data:`AHEAD` others stays where it is.
    """
    numbers = MessageNumbers(notes)
    waiting: list[Numbered] = []
    size = 0
    for numbered in messages:
        waiting.append(numbered)
        size += len(numbered.stored.raw)
        while len(waiting) > AHEAD or size > AHEAD_BYTES:
            first = waiting.pop(numbers.earliest(waiting))
            size -= len(first.stored.raw)
            yield from numbers.place(first)
    while waiting:
        yield from numbers.place(waiting.pop(numbers.earliest(waiting)))


@dataclass(slots=True)
class Publisher:
    """What is known of a publisher's messages since its start."""

    latest: Numbered
    """Message with the largest number."""
    before: int
    """Number of the message before the next one."""
    late_in_a_row: int = 0
    """Number of the last messages that were late."""
    seen: dict[int, tuple[int, int, bytes]] = field(default_factory=dict)
    """What tells each of the last messages from others, by number."""

    def note(self, numbered: Numbered, number: int) -> None:
        """Note a message that is in its place."""
        self.before = number
        self.seen[number] = _mark(numbered)
        if len(self.seen) > REMEMBERED:
            del self.seen[next(iter(self.seen))]


def _mark(numbered: Numbered) -> tuple[int, int, bytes]:
    """Return what a message has in common only with one that repeats it."""
    raw = numbered.stored.raw
    return numbered.stamp, len(raw), bytes(raw[-TAIL_BYTES:])


class MessageNumbers:
    """Numbers of the messages of a topic, which its publishers count."""

    def __init__(self, notes: dict[str, int]) -> None:
        """Take the dictionary of counts, which gets the messages that are missing, late or repeated."""
        self._notes = notes
        self._publishers: dict[int, Publisher] = {}

    def earliest(self, waiting: list[Numbered]) -> int:
        """Return the index of the message that is next: the first one, or a late one that belongs before it."""
        head = waiting[0]
        publisher = self._publishers.get(head.stored.connection.id)
        last = -1 if publisher is None else _number(publisher.latest)
        if head.number is None or head.number <= last:
            return 0
        earliest_index = 0
        lowest = head.number
        for index, numbered in enumerate(waiting):
            # This comes first, because it leaves out nearly all.
            if numbered.number is None or not last < numbered.number < lowest:
                continue
            if numbered.stored.connection.id == head.stored.connection.id and _is_late(
                numbered, head
            ):
                earliest_index = index
                lowest = numbered.number
        if earliest_index:
            self._count("late_packets")
        return earliest_index

    def place(self, numbered: Numbered) -> Iterator[Placed]:
        """Yield a message with what its number tells, unless it is repeated."""
        if numbered.number is None:
            yield Placed(numbered.stored, numbered.message, numbered.stamp, 0, True)
            return
        publisher = self._publishers.setdefault(
            numbered.stored.connection.id, Publisher(numbered, numbered.number)
        )
        if publisher.seen.get(numbered.number) == _mark(numbered):
            self._count("repeated_packets")
            return
        # Publishers that do not count give all messages the same number.
        follows = numbered.number - publisher.before in (0, 1)
        missing = self._missing(publisher, numbered, numbered.number)
        publisher.note(numbered, numbered.number)
        yield Placed(
            numbered.stored,
            numbered.message,
            numbered.stamp,
            missing,
            follows and missing != RESTART,
        )

    def _missing(self, publisher: Publisher, numbered: Numbered, number: int) -> int:
        """Return how many messages are missing before the one with a number, or :data:`RESTART` or :data:`LATE`."""
        # More late messages in a row than a driver counts soon after its start: the largest number was wrong.
        if _is_late(numbered, publisher.latest) and publisher.late_in_a_row < FIRST_NUMBERS:
            publisher.late_in_a_row += 1
            self._count("late_packets")
            return LATE
        step = number - _number(publisher.latest)
        publisher.latest = numbered
        publisher.late_in_a_row = 0
        if step in (0, 1):
            return 0
        if not 0 < step <= LARGEST_GAP:
            return RESTART
        self._count("missing_packets", step - 1)
        self._count("packet_gaps")
        return step - 1

    def _count(self, name: str, count: int = 1) -> None:
        self._notes[name] = self._notes.get(name, 0) + count


def _number(numbered: Numbered) -> int:
    """Return the number of a message that has one."""
    assert numbered.number is not None
    return numbered.number


def _is_late(numbered: Numbered, before: Numbered) -> bool:
    """Return whether a message belongs before another one of its publisher that came before it.

    Otherwise a smaller number is the first of a new start. This takes a while, in which the stamps go on. If the stamps
    tell nothing, because they stand still or were set back, the number falls far, and to one of the first.
    """
    fall = _number(before) - _number(numbered)
    step = numbered.stamp - before.stamp
    if fall <= 0 or step >= NEW_START_NS:
        return False
    return -LATEST_NS < step < 0 or fall <= FIRST_NUMBERS or _number(numbered) > FIRST_NUMBERS


def note_largest_gap(notes: dict[str, int], missing: int, t: int) -> None:
    """Note a gap if it is the largest so far, with the time of the last event before it [us]."""
    if missing > notes.get("largest_packet_gap", 0):
        notes["largest_packet_gap"] = missing
        notes["largest_packet_gap_us"] = t
