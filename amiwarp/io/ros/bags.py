"""ROS bags and their messages, with rosbags: ROS 1 bags, and the SQLite and MCAP files of ROS 2, also compressed.

Everything that touches a bag runs in the reading process.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from amiwarp.errors import AmiwarpError, ErrorCode, optional_module
from amiwarp.io.ros.packed import ZSTANDARD, unpacked_message

ARRAYS = (
    "dvs_msgs/msg/EventArray",
    "prophesee_event_msgs/msg/EventArray",
    "dv_ros_msgs/msg/EventArray",
    "dv_ros2_msgs/msg/EventArray",
)
"""Types of messages that hold an array of events."""

PACKETS = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
"""Types of messages that hold the words of a sensor."""

ARRAY_FIELDS = ("header", "height", "width", "events")
"""Order of the fields of an array in all packages of :data:`ARRAYS`. Other orders are refused."""

EVENT_FIELDS = ("x", "y", "ts", "polarity")
"""Order of the fields of an event in these packages."""

PACKET_DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""
"""Definition of :data:`PACKETS`, for bags that store none."""

# First bytes of the files of bags.
ROS1 = b"#ROSBAG V2.0\n"
SQLITE = b"SQLite format 3\0"
MCAP = b"\x89MCAP0\r\n"


@contextlib.contextmanager
def opened_bag(path: str) -> Iterator[tuple[Any, bool]]:
    """Open a bag by its content, not its ending. Return the library's reader, and whether the bag is of ROS 1."""
    optional_module("rosbags", "ros", "needs rosbags")
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2.reader import DirectoryReader
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    head = b""
    if not os.path.isdir(path):
        with open(path, "rb") as file:
            head = file.read(16)
    ros1 = head.startswith(ROS1)
    reader: Any = DirectoryReader
    readers = ((ROS1, Reader1), (SQLITE, Sqlite3Reader), (MCAP, McapReader))
    for first_bytes, reader_of_files in readers:
        if head.startswith(first_bytes):
            reader = reader_of_files
    bag = reader(Path(path))
    if ros1:
        _open_ros1(bag, path)
    else:
        bag.open()
    try:
        yield bag, ros1
    finally:
        bag.close()


def _open_ros1(bag: Any, path: str) -> None:
    """Open a ROS 1 bag. Raises :class:`AmiwarpError` if it is cut off, or lacks the index at its end."""
    from rosbags.rosbag1.reader import Header, ReaderError

    try:
        bag.open()
    except ReaderError as error:
        remedy = "copy the whole file again, or run rosbag reindex"
        if str(error).startswith("Header could not be read"):
            raise AmiwarpError(
                "is cut off within its header; copy the whole file again", ErrorCode.FILE_DAMAGED
            ) from error
        if str(error).startswith("Bag is not indexed"):
            raise AmiwarpError(
                "has no index, because its recording was not ended; run rosbag reindex",
                ErrorCode.FILE_DAMAGED,
            ) from error
        if not str(error).startswith("Bag index looks damaged"):
            raise
        with open(path, "rb") as file:
            file.readline()
            place = Header.read(file).get_uint64("index_pos")
        size = os.path.getsize(path)
        if place >= size:
            raise AmiwarpError(
                f"is cut off: it ends after {size:,} bytes, and its index is at byte {place:,}; {remedy}",
                ErrorCode.FILE_DAMAGED,
            ) from error
        raise AmiwarpError(
            f"is cut off within its index, or the index is damaged; {remedy}",
            ErrorCode.FILE_DAMAGED,
        ) from error


class Message(NamedTuple):
    """Message of a bag."""

    connection: Any
    """Connection of rosbags: topic, type and publisher."""
    recorded: int
    """Time of its recording [ns]."""
    raw: Any
    """Its bytes."""


def messages_of(bag: Any, connections: list[Any], *, ros1: bool) -> Iterator[Message]:
    """Yield the messages of some connections of a bag.

    A file from a folder whose messages are compressed one by one does not say so: only ``metadata.yaml`` does.
    """
    for connection, recorded, raw in bag.messages(connections=connections):
        # Messages of ROS 2 begin with the encapsulation of CDR, whose first byte is 0.
        if not ros1 and raw[:4] == ZSTANDARD:
            raw = unpacked_message(raw)
        yield Message(connection, recorded, raw)


def note_unread(notes: dict[str, int]) -> None:
    """Note how many messages of a topic the bag's index lists, but the bag does not hold, after all were read."""
    found = notes.get("read", 0) + notes.get("repeated_packets", 0)
    notes["unread_messages"] = max(notes["total"] - found, 0)


def choose(bag: Any, topic: str | None, version: int) -> Any:
    """Return the connection of the topic with events. Raises :class:`AmiwarpError` if there are several or none."""
    of_events = [
        connection for connection in bag.connections if connection.msgtype in (*ARRAYS, *PACKETS)
    ]
    found = {connection.topic: connection for connection in of_events if connection.msgcount}
    if topic in found:
        return found[topic]
    if topic is None and len(found) == 1:
        return next(iter(found.values()))
    if found:
        counts = [
            f"{name} ({connection.msgcount} messages)"
            for name, connection in sorted(found.items())[:20]
        ]
        listed = ", ".join(counts)
        if topic is None:
            raise AmiwarpError(
                f"is a ROS {version} bag with events in several topics: {listed}; "
                "choose one with amiwarp convert --topic, in Python with topic=",
                ErrorCode.AMBIGUOUS,
            )
        raise AmiwarpError(
            f"has no events in the topic '{topic}'; the topics with events are {listed}",
            ErrorCode.CONTENT_MISSING,
        )
    empty = [connection.topic for connection in of_events if topic in (None, connection.topic)]
    if empty:
        raise AmiwarpError(
            f"holds no events: its topic {empty[0]} has no messages; give another recording",
            ErrorCode.CONTENT_MISSING,
        )
    others = sorted(
        {
            f"{connection.topic} ({connection.msgtype.replace('/msg/', '/')})"
            for connection in bag.connections
        }
    )
    shown = ", ".join(others[:20]) or "none"
    raise AmiwarpError(
        f"is a ROS {version} bag without event topics; its topics are {shown}; give a bag with events",
        ErrorCode.CONTENT_MISSING,
    )


_stores: dict[tuple[Any, ...], Any] = {}
"""Type stores by message type and definition. Making one takes 10 ms."""


def deserialised(connection: Any, raw: bytes, *, ros1: bool) -> Any:
    """Return a message as an object with its fields."""
    store = typestore(connection, ros1=ros1)
    deserialise = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    return deserialise(raw, connection.msgtype)


def typestore(connection: Any, *, ros1: bool) -> Any:
    """Return a type store with the message type, as the bag defines it if it does."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    key = (connection.msgtype, connection.msgdef.data, ros1)
    if key in _stores:
        return _stores[key]
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    is_stored = connection.msgdef.format == MessageDefinitionFormat.MSG
    if is_stored or connection.msgtype in PACKETS:
        definition = connection.msgdef.data if is_stored else PACKET_DEFINITION
        types = get_types_from_msg(definition, connection.msgtype)
        unknown = {name: fields for name, fields in types.items() if name not in store.fielddefs}
        store.register(unknown)
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
            raise AmiwarpError(
                f"defines {name} with the fields {shown}; expected {', '.join(expected)}",
                ErrorCode.FORMAT_UNKNOWN,
            )
