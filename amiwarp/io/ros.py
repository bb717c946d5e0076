"""Reader of ROS bags, with rosbags: ROS 1 bags, and the SQLite and MCAP files of ROS 2.

Everything that touches the file runs in the reading process. The event times are the sensor's. The messages are
decoded in :mod:`amiwarp.io.ros_messages` and :mod:`amiwarp.io.ros_words`, those of other sensors in
:mod:`amiwarp.io.ros_sensors`. Bags are written by :mod:`amiwarp.io.ros_writer`.
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
from amiwarp.io.file_scan import FileEvents, Packet, sensors_of
from amiwarp.io.files import errors_name
from amiwarp.io.reading_process import Reply, packets, run
from amiwarp.io.ros_bags import (
    ARRAYS,
    choose,
    deserialised,
    messages_of,
    note_unread,
    opened_bag,
    typestore,
)
from amiwarp.io.ros_events import edge_packets, event_packets, stamp_packets
from amiwarp.io.ros_messages import Columns, decode_array, decode_packet, truncated_bytes
from amiwarp.io.ros_order import Placed, in_order, note_largest_gap, numbered
from amiwarp.io.ros_packed import unpacked
from amiwarp.io.ros_words import EVT, Layout, layout_of

SENSORS = "amiwarp.io.ros_sensors"
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
        events = FileEvents(path, found.events, size=tuple(about["size"]) if min(about["size"]) else None)
        imu, frames, notes = sensors_of(path, about["counts"], found.sensors)
        # Events and frames are read from the copy as long as they are used.
        weakref.finalize(found, _end_copy, copy.pop_all(), os.getpid())
    metadata = {"format": about["format"], "topic": found.name, **about["counts"], **events.metadata, **notes}
    if about["word_order"] is not None:
        metadata["word_order"] = about["word_order"]
    plain = path.with_suffix("") if path.suffix in (".zst", ".zstd") else path
    return Recording(events=events, metadata=metadata, name=plain.stem, imu=imu, frames=frames)


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
        yield from event_topic(source, topic)[0].edges()


def event_topic(path: Path, topic: str | None) -> tuple[EventTopic, dict[str, Any]]:
    """Return a topic of a bag, and what :func:`read_head` says of it."""
    about = run(read_head, path, topic)
    layout = Layout(about["encoding"], about["swapped"]) if about["encoding"] in EVT else None
    return EventTopic(path, about["topic"], layout), about


def read_head(path: str, topic: str | None) -> Reply:
    """Return the format, topic, sensor size, encoding and counts of other messages of a bag. Runs in the reading
    process.
    """
    with opened_bag(path) as (bag, ros1):
        connection = choose(bag, topic, 1 if ros1 else 2)
        counts: dict[str, int] = {}
        others = len({other.topic for other in bag.connections} - {connection.topic})
        if others:
            counts["other_topics"] = others
        for other in bag.connections:
            if other.msgtype in OTHER:
                name = OTHER[other.msgtype]
                counts[name] = counts.get(name, 0) + other.msgcount
        about = {
            "format": "rosbag1" if ros1 else "rosbag2",
            "topic": connection.topic,
            "size": (0, 0),
            "encoding": "",
            "swapped": False,
            "word_order": None,
            "counts": counts,
        }
        found = messages_of(bag, [connection], ros1=ros1)
        if connection.msgtype in ARRAYS:
            for one in itertools.islice(found, 1):
                about["size"] = decode_array(one.raw, ros1=ros1)[:2]
            return about, []
        read = (deserialised(connection, one.raw, ros1=ros1) for one in found)
        for first in itertools.islice(read, 1):
            about["size"] = int(first.width), int(first.height)
            about["encoding"] = first.encoding
            if first.encoding in EVT:
                layout, about["word_order"] = layout_of(first.encoding, itertools.chain([first], read))
                about["swapped"] = layout.swapped
        return about, []


def read_packets(notes: dict[str, int], path: str, topic: str, triggers: bool) -> Iterator[Columns]:
    """Yield the events, or the triggers, of each message of a topic without EVT words. Runs in the reading process."""
    latest = 0
    for each, ros1 in _topic_messages(notes, path, topic):
        events, edges = _decoded(each, ros1=ros1)
        note_largest_gap(notes, each.missing, latest)
        if each.message is not None:
            notes["truncated_bytes"] = notes.get("truncated_bytes", 0) + truncated_bytes(each.message)
        if len(events[2]):
            latest = max(latest, int(events[2][-1]))  # the events of a late message are earlier
        notes["read"] = notes.get("read", 0) + 1
        notes["triggers"] = notes.get("triggers", 0) + len(edges[0])
        yield edges if triggers else events
    note_unread(notes)


def _topic_messages(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Placed, bool]]:
    """Yield the messages of a topic, and whether the bag is of ROS 1. Note their number."""
    with opened_bag(path) as (bag, ros1):
        connections = [found for found in bag.connections if found.topic == topic]
        notes["total"] = max(sum(found.msgcount for found in connections), 1)
        read = (numbered(one, ros1=ros1) for one in messages_of(bag, connections, ros1=ros1))
        for each in in_order(read, notes):
            yield each, ros1


def _decoded(each: Placed, *, ros1: bool) -> tuple[Columns, Columns]:
    """Return the events of a message, and its triggers."""
    if each.message is not None:
        return decode_packet(each.message)
    typestore(each.one.connection, ros1=ros1)
    x, y, t, p = decode_array(each.one.raw, ros1=ros1)[2]
    return (x, y, t, p), (x[:0], y[:0], t[:0], p[:0])


def read_stamps(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Any, ...]]:
    """Yield for each message of a topic that holds events, but no EVT words: the times of its first event [us], of its
    recording and of its header [ns]. Runs in the reading process.
    """
    for each, ros1 in _topic_messages(notes, path, topic):
        t = _decoded(each, ros1=ros1)[0][2]
        if len(t):
            # All types of messages with events begin so, in ROS 1 after a number, in ROS 2 after the encapsulation.
            seconds, rest = struct.unpack_from("<II" if ros1 else "<iI", each.one.raw, 4)
            yield tuple(np.array([value], np.int64) for value in (t[0], each.one.recorded, seconds * 10**9 + rest))


def read_topics(path: str, topic: str) -> Reply:
    """Return the other topics of a bag, with what a writer needs to know of them. Runs in the reading process."""
    with opened_bag(path) as (bag, ros1):
        return [
            {
                "topic": one.topic,
                "type": one.msgtype,
                "definition": one.msgdef.data,
                "digest": one.digest,
                **(_ros1_details(one.ext) if ros1 else _ros2_details(one.ext)),
            }
            for one in bag.connections
            if one.topic != topic
        ], []


def _ros1_details(about: Any) -> dict[str, Any]:
    return {"callerid": about.callerid, "latching": about.latching}


def _ros2_details(about: Any) -> dict[str, Any]:
    return {
        "serialization": about.serialization_format,
        "qos": [[getattr(value, "value", value) for value in qos] for qos in about.offered_qos_profiles],
    }


def read_others(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Any, ...]]:
    """Yield the other messages of a bag: bytes, length, time of recording [ns], and the index of the topic among
    those of :func:`read_topics`. Runs in the reading process.
    """
    with opened_bag(path) as (bag, _):
        others = [one for one in bag.connections if one.topic != topic]
        places = {one.id: at for at, one in enumerate(others)}
        for one in messages_of(bag, others, ros1=False) if others else ():
            numbers = (len(one.raw), one.recorded, places[one.connection.id])
            yield np.frombuffer(one.raw, np.uint8), *(np.array([value], np.int64) for value in numbers)
