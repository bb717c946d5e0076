"""Reader of ROS bags: ROS 1 bags, and the SQLite and MCAP files of ROS 2, with rosbags.

Everything that touches the file runs in the reading process. The event times are those of the sensor.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.evt_words import Columns
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.input_files import errors_name
from amiwarp.io.reading_process import packets, run
from amiwarp.io.reading_server import Reply
from amiwarp.io.ros_messages import ARRAY_FIELDS, ARRAYS, EVENT_FIELDS, PACKET_DEFINITION, PACKETS, PacketDecoder
from amiwarp.io.ros_messages import decode_array as _decode_array
from amiwarp.io.sensor_streams import read_sensors

ROS1, SQLITE, MCAP = b"#ROSBAG V2.0\n", b"SQLite format 3\0", b"\x89MCAP0\r\n"
"""First bytes of the files of bags."""

OTHER = {
    "sensor_msgs/msg/Image": "frames",
    "sensor_msgs/msg/CompressedImage": "frames",
    "sensor_msgs/msg/Imu": "imu_samples",
}
"""Types of messages that are counted, and the names of the counts."""


def open_rosbag(path: Path, topic: str | None = None) -> Recording:
    """Open the events of a topic of a bag: a file, or the folder of a ROS 2 bag."""
    source = path.absolute()
    with errors_name(path, lambda: "opening the bag"):
        about = run("amiwarp.io.rosbag:read_head", source, topic)
    read = partial(packets, "amiwarp.io.rosbag:read_packets", source, about["topic"], False)
    size = tuple(about["size"]) if min(about["size"]) else None
    events = FileEvents(path, read, size=size)
    imu, frames, notes = read_sensors(path, about["counts"], "ros_sensors", about["topic"])
    metadata = {"format": about["format"], "topic": about["topic"], **about["counts"], **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu, frames=frames)


def trigger_packets(path: Path, topic: str | None = None) -> Iterator[Packet]:
    """Yield the trigger edges of the packets of a topic."""
    source = path.absolute()
    about = run("amiwarp.io.rosbag:read_head", source, topic)
    return packets("amiwarp.io.rosbag:read_packets", source, about["topic"], True, {})


def read_head(path: str, topic: str | None) -> Reply:
    """Return the format, topic, sensor size and counts of other messages of a bag. Runs in the reading process."""
    with opened_bag(path) as (bag, ros1):
        connection = _choose(bag, topic, 1 if ros1 else 2)
        counts: dict[str, int] = {}
        others = len({other.topic for other in bag.connections} - {connection.topic})
        if others:
            counts["other_topics"] = others
        for other in bag.connections:
            if other.msgtype in OTHER:
                name = OTHER[other.msgtype]
                counts[name] = counts.get(name, 0) + other.msgcount
        size = (0, 0)
        for _, _, raw in bag.messages(connections=[connection]):
            size = _size(connection, raw, ros1=ros1)
            break
        return {
            "format": "rosbag1" if ros1 else "rosbag2",
            "topic": connection.topic,
            "size": size,
            "counts": counts,
        }, []


def read_packets(notes: dict[str, int], path: str, topic: str, triggers: bool) -> Iterator[Columns]:
    """Yield the events, or the triggers, of each message of a topic. Runs in the reading process."""
    with opened_bag(path) as (bag, ros1):
        connections = [found for found in bag.connections if found.topic == topic]
        decode = _decoder(connections[0], ros1=ros1)
        notes["total"] = max(sum(found.msgcount for found in connections), 1)
        for _, _, raw in bag.messages(connections=connections):
            events, edges = decode(raw)
            notes["read"] = notes.get("read", 0) + 1
            notes["triggers"] = notes.get("triggers", 0) + len(edges[0])
            yield edges if triggers else events


def read_stamps(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Any, ...]]:
    """Yield for each message of a topic of a ROS 2 bag that holds events: the times of its first event [us], of its
    recording and of its header [ns]. Runs in the reading process.
    """
    with opened_bag(path) as (bag, ros1):
        connections = [found for found in bag.connections if found.topic == topic]
        decode = _decoder(connections[0], ros1=ros1)
        for _, recorded, raw in bag.messages(connections=connections):
            t = decode(raw)[0][2]
            if len(t):
                seconds, rest = struct.unpack_from("<iI", raw, 4)  # all types of messages with events begin so
                yield tuple(np.array([value], np.int64) for value in (t[0], recorded, seconds * 10**9 + rest))


def read_topics(path: str, topic: str) -> Reply:
    """Return the other topics of a ROS 2 bag, with what a writer needs to know of them. Runs in the reading process."""
    with opened_bag(path) as (bag, _):
        return [
            {
                "topic": one.topic,
                "type": one.msgtype,
                "definition": one.msgdef.data,
                "digest": one.digest,
                "serialization": one.ext.serialization_format,
                "qos": [[getattr(value, "value", value) for value in qos] for qos in one.ext.offered_qos_profiles],
            }
            for one in bag.connections
            if one.topic != topic
        ], []


def read_others(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Any, ...]]:
    """Yield the other messages of a ROS 2 bag: bytes, length, time of recording [ns], and the index of the topic among
    those of :func:`read_topics`. Runs in the reading process.
    """
    with opened_bag(path) as (bag, _):
        others = [one for one in bag.connections if one.topic != topic]
        places = {one.id: at for at, one in enumerate(others)}
        for one, recorded, raw in bag.messages(connections=others) if others else ():
            numbers = (np.array([value], np.int64) for value in (len(raw), recorded, places[one.id]))
            yield np.frombuffer(raw, np.uint8), *numbers


@contextlib.contextmanager
def opened_bag(path: str) -> Iterator[tuple[Any, bool]]:
    """Open a bag by its content, not its ending. Return the library's reader, and whether the bag is of ROS 1."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2.reader import DirectoryReader
        from rosbags.rosbag2.storage_mcap import McapReader
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
    except ImportError as error:
        raise AmiwarpError("is a ROS bag; to read it, run: pip install 'amiwarp[ros]'") from error
    head = b""
    if not os.path.isdir(path):
        with open(path, "rb") as file:
            head = file.read(16)
    ros1 = head.startswith(ROS1)
    readers: dict[bytes, Any] = {ROS1: Reader1, SQLITE: Sqlite3Reader, MCAP: McapReader}
    kind = next((reader for magic, reader in readers.items() if head.startswith(magic)), DirectoryReader)
    bag = kind(Path(path))
    bag.open()
    try:
        yield bag, ros1
    finally:
        bag.close()


def _choose(bag: Any, topic: str | None, version: int) -> Any:
    """Return the connection of the topic with events. Raises :class:`AmiwarpError` if there are several or none."""
    found = {one.topic: one for one in bag.connections if one.msgtype in (*ARRAYS, *PACKETS) and one.msgcount}
    if topic is None and len(found) == 1:
        return next(iter(found.values()))
    listed = ", ".join(f"{name} ({one.msgcount} messages)" for name, one in sorted(found.items())[:20])
    if found and topic is None:
        raise AmiwarpError(
            f"is a ROS {version} bag with events in several topics: {listed}; "
            "choose one with amiwarp convert --topic, in Python with topic="
        )
    if found and topic in found:
        return found[topic]
    if found:
        raise AmiwarpError(f"has no events in the topic '{topic}'; the topics with events are {listed}")
    others = sorted({f"{one.topic} ({one.msgtype.replace('/msg/', '/')})" for one in bag.connections})
    shown = ", ".join(others[:20]) or "none"
    raise AmiwarpError(f"is a ROS {version} bag without event topics; its topics are {shown}; give a bag with events")


def _decoder(connection: Any, *, ros1: bool) -> Any:
    """Return a function that decodes a message of a connection to events and triggers."""
    if connection.msgtype in ARRAYS:
        _typestore(connection, ros1=ros1)

        def decode(raw: bytes) -> tuple[Columns, Columns]:
            events = _decode_array(raw, ros1=ros1)[2]
            return events, tuple(column[:0] for column in events)  # type: ignore[return-value]

        return decode
    packet = PacketDecoder()
    return lambda raw: packet.decode(deserialised(connection, raw, ros1=ros1))


def _size(connection: Any, raw: bytes, *, ros1: bool) -> tuple[int, int]:
    """Return the sensor size in a message [px]; 0 if it is not set."""
    if connection.msgtype in ARRAYS:
        return _decode_array(raw, ros1=ros1)[:2]
    message = deserialised(connection, raw, ros1=ros1)
    return int(message.width), int(message.height)


_stores: dict[tuple[Any, ...], Any] = {}
"""Type stores by message type and definition. Making one takes 10 ms."""


def deserialised(connection: Any, raw: bytes, *, ros1: bool) -> Any:
    """Return a message as an object with its fields."""
    store = _typestore(connection, ros1=ros1)
    return (store.deserialize_ros1 if ros1 else store.deserialize_cdr)(raw, connection.msgtype)


def _typestore(connection: Any, *, ros1: bool) -> Any:
    """Return a type store with the message type, as the bag defines it if it does."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    key = (connection.msgtype, connection.msgdef.data, ros1)
    if key in _stores:
        return _stores[key]
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    stored = connection.msgdef.format == MessageDefinitionFormat.MSG
    if stored or connection.msgtype in PACKETS:
        types = get_types_from_msg(connection.msgdef.data if stored else PACKET_DEFINITION, connection.msgtype)
        store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
        if connection.msgtype in ARRAYS:
            _check_order(types, connection.msgtype)
    _stores[key] = store
    return store


def _check_order(types: Any, name: str) -> None:
    """Raise :class:`AmiwarpError` if an array of events is not defined as its package publishes it."""
    event = types.get(name.replace("EventArray", "Event"))
    for fields, expected in ((types[name], ARRAY_FIELDS), (event, EVENT_FIELDS)):
        given = tuple(field[0] for field in fields[1]) if fields is not None else ()
        if given != expected:
            shown = ", ".join(given) or "nothing"
            raise AmiwarpError(f"defines {name} with the fields {shown}; expected {', '.join(expected)}")
