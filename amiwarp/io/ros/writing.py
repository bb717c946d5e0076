"""What the writers of ROS 1 and ROS 2 bags share: clocks of the messages, and the topics of another bag.

The stamp of a message is the time of its first event. Events of a bag keep their topic and the clocks of their
messages: what is written is recorded and stamped as the messages were that held the events. The messages of all other
topics are copied.
"""

import contextlib
import heapq
import itertools
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from operator import itemgetter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events, regroup
from amiwarp.io.output_formats import Bag, Outline
from amiwarp.io.reading_process import packets as read_packets
from amiwarp.io.reading_process import run
from amiwarp.io.ros.packed import unpacked
from amiwarp.io.ros.reader import event_topic, read_others, read_topics

Messages: TypeAlias = Generator[tuple[int, Any, Any], None, None]
"""Messages: time of the recording [ns], connection of the library, which stands for a topic, and bytes."""

AddTopic: TypeAlias = Callable[[Any, dict[str, Any]], Any]
"""Function that adds a topic, described by the second argument, to the writer, the first."""

LONGEST_PACKET_US = 10_000
"""Longest packet [us]."""


@contextlib.contextmanager
def plain_bag(about: Outline) -> Iterator[Outline]:
    """Replace a compressed bag by a copy without compression, for the block."""
    if about.bag is None:
        yield about
        return
    with unpacked(about.bag.path) as path:
        copy = Bag(path, about.bag.topic)
        yield replace(about, bag=copy)


def write_messages(
    writer: Any,
    connection: Any,
    encode: Callable[[Events], Iterator[tuple[int, Any]]],
    blocks: Iterable[Events],
    bag: Bag | None,
    add_topic: AddTopic,
) -> None:
    """Write the messages of all events, and of the other topics of a bag, in the order of their recording."""

    def encoded() -> Messages:
        for block in blocks:
            for recorded, data in encode(block):
                yield recorded, connection, data

    with contextlib.ExitStack() as opened:
        streams = [encoded()]
        if bag is not None:
            streams.append(_others(writer, bag, add_topic))
        for stream in streams:
            opened.enter_context(contextlib.closing(stream))
        for recorded, merged_connection, data in heapq.merge(*streams, key=itemgetter(0)):
            writer.write(merged_connection, recorded, data)


class MessageClock:
    """Times of messages from the times of their events.

    Without a bag they are equal. Otherwise they follow the times of the messages that held the events.
    """

    def __init__(self, bag: Bag | None) -> None:
        """Read the times of the messages of a bag."""
        nothing = np.zeros(1, np.int64)
        parts: list[tuple[NDArray[np.int64], ...]] = [(nothing, nothing, nothing)]
        if bag is not None:
            topic, _ = event_topic(bag.path, bag.topic)
            parts = list(topic.stamps())
        t, recorded, stamps = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        self._t = np.maximum.accumulate(t)
        # A message that came late was recorded after the messages behind it. Packets are written in order.
        backwards = np.minimum.accumulate(recorded[::-1])
        self._recorded = backwards[::-1]
        self._stamps = stamps

    def packets(self, block: Events) -> Iterator[Events]:
        """Divide a block into packets, none longer than :data:`LONGEST_PACKET_US` or from several messages."""
        for events in regroup([block], duration_us=LONGEST_PACKET_US):
            message = np.searchsorted(self._t, events.t, "right")
            cuts = np.flatnonzero(np.diff(message)) + 1
            edges = [0, *cuts.tolist(), len(events)]
            for start, stop in itertools.pairwise(edges):
                yield events[start:stop]

    def times(self, t: int) -> tuple[int, int]:
        """Return the time of the recording and the stamp of a message whose first event is at ``t`` [us], in ns."""
        following = int(np.searchsorted(self._t, t, "right"))
        message = max(following - 1, 0)
        # Negative for events before the first message.
        later_us = t - int(self._t[message])
        later_ns = later_us * 1000
        recorded = int(self._recorded[message]) + later_ns
        if message + 1 < len(self._t):
            # Packets stay in order.
            recorded = min(recorded, int(self._recorded[message + 1]))
        return recorded, int(self._stamps[message]) + later_ns


def _others(writer: Any, bag: Bag, add_topic: AddTopic) -> Messages:
    """Add the other topics of a bag to a writer, and yield their messages."""
    topics = []
    for about in run(read_topics, bag.path, bag.topic):
        topics.append(add_topic(writer, about))
    source = read_packets(read_others, bag.path, bag.topic, {})
    for data, lengths, recorded, places in source:
        ends = np.cumsum(lengths)
        starts = ends - lengths
        columns = [values.tolist() for values in (starts, ends, recorded, places)]
        for start, end, recorded_ns, place in zip(*columns, strict=True):
            yield recorded_ns, topics[place], data[start:end].data
