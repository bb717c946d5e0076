"""Reader of ROS bags, with rosbags: ROS 1 bags, and the SQLite and MCAP files of ROS 2.

Everything that touches the file runs in the reading process. The event times are the sensor's. The messages are
decoded in :mod:`amiwarp.io.ros.messages`, :mod:`amiwarp.io.ros.reading` and, for other sensors,
:mod:`amiwarp.io.ros.sensors`. Bags are written by :mod:`amiwarp.io.ros.ros1_writer` and
:mod:`amiwarp.io.ros.ros2_writer`.
"""

import contextlib
import itertools
import os
import struct
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Recording
from amiwarp.io.event_packets import Columns, Packet
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.file_sensors import sensors_of
from amiwarp.io.inputs import errors_name
from amiwarp.io.reading_process import packets, run
from amiwarp.io.reading_server import Reply
from amiwarp.io.ros.bags import (
    ARRAYS,
    choose,
    deserialised,
    messages_of,
    note_unread,
    opened_bag,
    typestore,
)
from amiwarp.io.ros.events import edge_packets, event_packets, stamp_packets
from amiwarp.io.ros.messages import decode_array, decode_packet, truncated_bytes
from amiwarp.io.ros.order import Placed, in_order, note_largest_gap, with_number
from amiwarp.io.ros.packed import unpacked
from amiwarp.io.ros.words import EVT, Layout, layout_of

SENSORS = "amiwarp.io.ros.sensors"
"""Name of the module that reads the messages of other sensors, in the reading process."""

OTHER = {
    "sensor_msgs/msg/Image": "frames",
    "sensor_msgs/msg/CompressedImage": "frames",
    "sensor_msgs/msg/Imu": "imu_samples",
}
"""Types of messages that are counted, and the names of the counts."""


@dataclass(frozen=True, eq=False)
class EventTopic:
    """Topic of events in a bag."""

    path: Path
    """The bag, or a copy that is not compressed."""
    name: str
    """Name of the topic."""
    layout: Layout | None
    """Layout of the words in the messages; None if they hold none of Prophesee's sensors."""

    def events(self, notes: dict[str, int]) -> Iterator[Packet]:
        """Yield the events."""
        if self.layout is None:
            return packets(read_packets, self.path, self.name, False, notes)
        return event_packets(self.path, self.name, self.layout, notes)

    def edges(self) -> Iterator[Packet]:
        """Yield the edges of the triggers."""
        if self.layout is None:
            return packets(read_packets, self.path, self.name, True, {})
        return edge_packets(self.path, self.name, self.layout)

    def stamps(self) -> Iterator[tuple[NDArray[np.int64], ...]]:
        """Yield for each message with events: the times of its first event [us], its recording and its header [ns]."""
        if self.layout is None:
            return packets(read_stamps, self.path, self.name, {})
        return stamp_packets(self.path, self.name, self.layout)

    def sensors(self, function: str) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield what a function of :data:`SENSORS` reads next to the events."""
        return packets(f"{SENSORS}:{function}", self.path, self.name, {})


def open_rosbag(path: Path, topic: str | None = None) -> Recording:
    """Open the events of a topic of a bag: a file, or the folder of a ROS 2 bag."""
    with contextlib.ExitStack() as copy:
        with errors_name(path, lambda: "opening the bag"):
            found, about = event_topic(copy.enter_context(unpacked(path)), topic)
        size = tuple(about["size"]) if min(about["size"]) else None
        events = FileEvents(path, found.events, size=size)
        imu, frames, notes = sensors_of(path, about["counts"], found.sensors)
        # Events and frames are read from the copy as long as they are used.
        weakref.finalize(found, _end_copy, copy.pop_all(), os.getpid())
    metadata = {
        "format": about["format"],
        "topic": found.name,
        **about["counts"],
        **events.metadata,
        **notes,
    }
    if about["word_order"] is not None:
        metadata["word_order"] = about["word_order"]
    plain = path.with_suffix("") if path.suffix in (".zst", ".zstd") else path
    return Recording(
        events=events,
        metadata=metadata,
        name=plain.stem,
        imu=imu,
        frames=frames,
    )


_of_others: list[contextlib.ExitStack] = []
"""Copies of the process that this one was forked from, which would end with these objects."""


def _end_copy(copy: contextlib.ExitStack, owner: int) -> None:
    """Remove the copy of a bag, in the process that made it."""
    if os.getpid() == owner:
        copy.close()
    else:
        _of_others.append(copy)


def trigger_packets(path: Path, topic: str | None = None) -> Iterator[Packet]:
    """Yield the trigger edges of the packets of a topic."""
    with unpacked(path) as source:
        found, _ = event_topic(source, topic)
        yield from found.edges()


def event_topic(path: Path, topic: str | None) -> tuple[EventTopic, dict[str, Any]]:
    """Return a topic of a bag, and what :func:`read_head` says of it."""
    about = run(read_head, path, topic)
    layout = None
    if about["encoding"] in EVT:
        layout = Layout(about["encoding"], about["swapped"])
    return EventTopic(path, about["topic"], layout), about


def read_head(path: str, topic: str | None) -> Reply:
    """Return the format, topic, sensor size, encoding and counts of other messages of a bag. Runs in the reading
    process.
    """
    with opened_bag(path) as (bag, ros1):
        connection = choose(bag, topic, 1 if ros1 else 2)
        about = {
            "format": "rosbag1" if ros1 else "rosbag2",
            "topic": connection.topic,
            "size": (0, 0),
            "encoding": "",
            "swapped": False,
            "word_order": None,
            "counts": _counts_of_others(bag, connection.topic),
        }
        stored = messages_of(bag, [connection], ros1=ros1)
        if connection.msgtype in ARRAYS:
            first_array = next(stored, None)
            if first_array is not None:
                width, height, _ = decode_array(first_array.raw, ros1=ros1)
                about["size"] = width, height
            return about, []
        messages = (deserialised(connection, message.raw, ros1=ros1) for message in stored)
        first = next(messages, None)
        if first is not None:
            about["size"] = int(first.width), int(first.height)
            about["encoding"] = first.encoding
            if first.encoding in EVT:
                # The order of the words may show only in later messages.
                all_messages = itertools.chain([first], messages)
                layout, about["word_order"] = layout_of(first.encoding, all_messages)
                about["swapped"] = layout.swapped
        return about, []


def _counts_of_others(bag: Any, topic: str) -> dict[str, int]:
    """Return the number of other topics than ``topic``, and of messages of the types :data:`OTHER`."""
    counts: dict[str, int] = {}
    topics = {connection.topic for connection in bag.connections}
    others = topics - {topic}
    if others:
        counts["other_topics"] = len(others)
    for connection in bag.connections:
        if connection.msgtype in OTHER:
            name = OTHER[connection.msgtype]
            counts[name] = counts.get(name, 0) + connection.msgcount
    return counts


def read_packets(
    notes: dict[str, int],
    path: str,
    topic: str,
    triggers: bool,
) -> Iterator[Columns]:
    """Yield the events, or the triggers, of each message of a topic without EVT words. Runs in the reading process."""
    latest_us = 0
    for placed, ros1 in _topic_messages(notes, path, topic):
        events, edges = _decoded(placed, ros1=ros1)
        note_largest_gap(notes, placed.missing, latest_us)
        if placed.message is not None:
            truncated = truncated_bytes(placed.message)
            notes["truncated_bytes"] = notes.get("truncated_bytes", 0) + truncated
        _, _, t, _ = events
        if len(t):
            # The events of a late message are earlier.
            latest_us = max(latest_us, int(t[-1]))
        notes["read"] = notes.get("read", 0) + 1
        notes["triggers"] = notes.get("triggers", 0) + len(edges[0])
        yield edges if triggers else events
    note_unread(notes)


def _topic_messages(
    notes: dict[str, int],
    path: str,
    topic: str,
) -> Iterator[tuple[Placed, bool]]:
    """Yield the messages of a topic, and whether the bag is of ROS 1. Note their number."""
    with opened_bag(path) as (bag, ros1):
        connections = [found for found in bag.connections if found.topic == topic]
        notes["total"] = max(sum(found.msgcount for found in connections), 1)
        read = (
            with_number(stored, ros1=ros1) for stored in messages_of(bag, connections, ros1=ros1)
        )
        for placed in in_order(read, notes):
            yield placed, ros1


def _decoded(placed: Placed, *, ros1: bool) -> tuple[Columns, Columns]:
    """Return the events of a message, and its triggers."""
    if placed.message is not None:
        return decode_packet(placed.message)
    typestore(placed.stored.connection, ros1=ros1)
    _, _, events = decode_array(placed.stored.raw, ros1=ros1)
    x, y, t, p = (column[:0] for column in events)
    return events, (x, y, t, p)


def read_stamps(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Any, ...]]:
    """Yield for each message of a topic that holds events, but no EVT words: the times of its first event [us], of its
    recording and of its header [ns]. Runs in the reading process.
    """
    for placed, ros1 in _topic_messages(notes, path, topic):
        (_, _, t, _), _ = _decoded(placed, ros1=ros1)
        if len(t):
            # All types of messages with events begin so, in ROS 1 after a number, in ROS 2 after the encapsulation.
            form = "<II" if ros1 else "<iI"
            seconds, nanoseconds = struct.unpack_from(form, placed.stored.raw, 4)
            stamp = seconds * 10**9 + nanoseconds
            times = (t[0], placed.stored.recorded, stamp)
            yield tuple(np.array([time], np.int64) for time in times)


def read_topics(path: str, topic: str) -> Reply:
    """Return the other topics of a bag, with what a writer needs to know of them. Runs in the reading process."""
    with opened_bag(path) as (bag, ros1):
        details = _ros1_details if ros1 else _ros2_details
        topics = []
        for connection in bag.connections:
            if connection.topic == topic:
                continue
            about = {
                "topic": connection.topic,
                "type": connection.msgtype,
                "definition": connection.msgdef.data,
                "digest": connection.digest,
            }
            topics.append(about | details(connection.ext))
        return topics, []


def _ros1_details(about: Any) -> dict[str, Any]:
    return {"callerid": about.callerid, "latching": about.latching}


def _ros2_details(about: Any) -> dict[str, Any]:
    """Return what a ROS 2 writer needs to know of a topic."""
    profiles = []
    for profile in about.offered_qos_profiles:
        profiles.append([getattr(value, "value", value) for value in profile])
    return {"serialization": about.serialization_format, "qos": profiles}


def read_others(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Any, ...]]:
    """Yield the other messages of a bag: bytes, length, time of recording [ns], and the index of the topic in what
    :func:`read_topics` returns. Runs in the reading process.
    """
    with opened_bag(path) as (bag, _):
        others = [connection for connection in bag.connections if connection.topic != topic]
        if not others:
            return
        index_of = {connection.id: index for index, connection in enumerate(others)}
        for message in messages_of(bag, others, ros1=False):
            index = index_of[message.connection.id]
            yield (
                np.frombuffer(message.raw, np.uint8),
                np.array([len(message.raw)], np.int64),
                np.array([message.recorded], np.int64),
                np.array([index], np.int64),
            )
