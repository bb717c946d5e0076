"""Readers and writer of ROS bags, with rosbags: ROS 1 bags, and the SQLite and MCAP files of ROS 2."""

import contextlib
import heapq
import itertools
import os
import struct
from collections.abc import Generator, Iterable, Iterator
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.events.recording import Events, Recording, regroup
from amiwarp.io.file_scan import FileEvents, Packet, read_sensors
from amiwarp.io.files import errors_name, scratch_folder
from amiwarp.io.formats import Bag, Outline
from amiwarp.io.prophesee import Columns, Evt2Decoder, Evt3Decoder, Evt3Encoder, origin_of, swap_halves, words_of
from amiwarp.io.reading_process import Reply, packets, run

# Decoders of the ROS messages that hold events: arrays of events, and packets of a sensor's own words.
#
# The messages are those of the packages dvs_msgs, prophesee_event_msgs, event_camera_msgs and, its former name,
# event_array_msgs. Arrays of events are decoded with NumPy, because a Python object per event would be slow.

ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
"""Types of messages that hold an array of events."""

PACKETS = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
"""Types of messages that hold the words of a sensor."""

ARRAY_FIELDS = ("header", "height", "width", "events")
EVENT_FIELDS = ("x", "y", "ts", "polarity")
"""Order of the fields in both packages of :data:`ARRAYS`. Other orders are refused."""

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

NOTHING: Columns = (np.zeros(0, np.int64),) * 4
"""No events."""


class EventPacket(Protocol):
    """Message of one of the types :data:`PACKETS`."""

    height: int
    width: int
    time_base: int
    encoding: str
    is_bigendian: bool
    events: NDArray[np.uint8]


class PacketDecoder:
    """Decoder of the messages of one topic, in their order."""

    def __init__(self) -> None:
        self._decoders: dict[str, Any] = {}

    def decode(self, message: EventPacket) -> tuple[Columns, Columns]:
        """Return the events and the triggers of a message. Times are the sensor's, not those of the computer."""
        if message.is_bigendian:
            raise AmiwarpError("has packets of big-endian words, which are not read; record on a little-endian machine")
        base, data = int(message.time_base), np.ascontiguousarray(message.events, np.uint8)
        if message.encoding in EVT:
            return self._evt(message.encoding, data)
        if message.encoding == "mono":
            return _mono(base, data), NOTHING
        if message.encoding == "trigger":
            x, _, t, p = _mono(base, data)
            return NOTHING, (np.zeros_like(x), np.zeros_like(x), t, p)
        if message.encoding == "libcaer":
            return _libcaer(base, data), NOTHING
        if message.encoding == "libcaer_cmp":
            return _libcaer_cmp(base, data), NOTHING
        known = ", ".join((*EVT, "mono", "trigger", "libcaer", "libcaer_cmp"))
        raise AmiwarpError(f"has packets with the encoding '{message.encoding[:40]}'; expected one of {known}")

    def _evt(self, encoding: str, data: NDArray[np.uint8]) -> tuple[Columns, Columns]:
        words = words_of(data, EVT[encoding])
        if encoding not in self._decoders:
            self._decoders[encoding] = Evt3Decoder() if encoding == "evt3" else Evt2Decoder(encoding == "evt21")
        events, edges = self._decoders[encoding].decode(swap_halves(words) if encoding == "evt21" else words)
        return events, edges


EVT = {"evt3": "3", "evt2": "2", "evt21": "2.1"}
"""Encodings with Prophesee's words, and their versions."""


def _mono(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return events of 64 bits: time after ``base`` [ns], x, y, polarity."""
    words = np.frombuffer(data, "<u8", len(data) // 8)
    t = (base + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)) // 1000
    rest = (words >> np.uint64(32)).astype(np.int64)
    return rest & 0xFFFF, rest >> 16 & 0x7FFF, t, rest >> 31


def _libcaer(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return events as libcaer stores them: a word with x, y, polarity, and the time [us] after ``base`` [ns]."""
    words = np.frombuffer(data, "<i4", len(data) // 8 * 2).reshape(-1, 2).astype(np.int64)
    low, word = words[:, 1], words[:, 0]
    wraps = np.cumsum(np.diff(low, prepend=low[:1]) < -(1 << 30))
    return word >> 17 & 0x7FFF, word >> 2 & 0x7FFF, base // 1000 + low + (wraps << 31), word >> 1 & 1


def _libcaer_cmp(base: int, data: NDArray[np.uint8]) -> Columns:
    """Return the events of libcaer's compressed words, 16 bits each, whose state starts anew in each message."""
    words = np.frombuffer(data, "<u2", len(data) // 2)
    kind, load = words >> 12, (words & 0xFFF).astype(np.int64)

    def latest(code: int, values: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        at = np.maximum.accumulate(np.where(kind == code, np.arange(kind.size), -1))
        return np.concatenate([values, [0]])[at], at

    t = (latest(0, load)[0] << 12 | latest(1, load)[0]) + base // 1000
    x = latest(2, load & 0x7FF)[0]
    row, at = latest(4, load)
    # Each vector covers eight rows, and the next one continues behind it.
    vectors = np.cumsum(kind == 5)
    first = (row & 0x7FF) + 8 * (vectors - 1 - np.concatenate([vectors, [0]])[at])
    bits = np.where(kind == 3, 1, (load & 0xFF) * (kind == 5))
    which, bit = np.nonzero((bits[:, None] >> np.arange(8)) & 1)
    single = kind[which] == 3
    y = np.where(single, load[which] & 0x7FF, first[which] + bit)
    return x[which], y, t[which], np.where(single, load[which], row[which]) >> 11


def decode_array(raw: bytes | memoryview, *, ros1: bool) -> tuple[int, int, Columns]:
    """Return width, height and the events of a message of the types :data:`ARRAYS`."""
    if not ros1:
        if bytes(raw[:2]) != b"\0\1":
            raise AmiwarpError(f"has messages of the encapsulation {bytes(raw[:2]).hex()}; expected little-endian CDR")
        raw = raw[4:]
    # The header: in ROS 1 a sequence number, then in both the time and a string.
    at = 12 if ros1 else 8
    (length,) = struct.unpack_from("<I", raw, at)
    at += 4 + length
    at = at if ros1 else -(-at // 4) * 4
    height, width, count = struct.unpack_from("<III", raw, at)
    start = at + 12
    return width, height, _packed(raw, start, count) if ros1 else _aligned(raw, start, count)


PACKED = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")])
"""Event of ROS 1, without padding."""

ALIGNED = np.dtype(
    {"names": ["x", "y", "sec", "nsec", "p"], "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
     "offsets": [0, 2, 6, 10, 14], "itemsize": 16}
)  # fmt: skip
"""Event of ROS 2 that begins 2 bytes after a multiple of 4, as all do except a first one at a multiple of 4."""


def _packed(raw: bytes | memoryview, start: int, count: int) -> Columns:
    if start + count * PACKED.itemsize > len(raw):
        raise AmiwarpError(f"has a message that declares {count} events, which it does not hold; the bag is damaged")
    return _columns(np.frombuffer(raw, PACKED, count, start))


def _aligned(raw: bytes | memoryview, start: int, count: int) -> Columns:
    """Return the events of a ROS 2 message, whose times lie at multiples of 4 bytes."""
    # The first event begins at a multiple of 4: 13 bytes, and one for the alignment of the next event to 2.
    size = 0 if count == 0 else 13 + max(count - 1, 0) * 16
    if start + size > len(raw):
        raise AmiwarpError(f"has a message that declares {count} events, which it does not hold; the bag is damaged")
    if not count:
        return NOTHING
    first = np.frombuffer(raw, PACKED, 1, start)
    whole = bytes(raw[start + 14 :]).ljust(16 * (count - 1), b"\0")
    rest = np.frombuffer(whole, ALIGNED, count - 1)
    x, y, t, p = (np.concatenate(pair) for pair in zip(_columns(first), _columns(rest), strict=True))
    return x, y, t, p


def _columns(events: NDArray[Any]) -> Columns:
    # Times are in seconds and nanoseconds; amiwarp's are whole microseconds.
    t = events["sec"].astype(np.int64) * 1_000_000 + events["nsec"].astype(np.int64) // 1000
    return events["x"], events["y"], t, events["p"]


# Reader of ROS bags: ROS 1 bags, and the SQLite and MCAP files of ROS 2, with rosbags.
#
# Everything that touches the file runs in the reading process. The event times are those of the sensor.

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
        about = run(read_head, source, topic)
    read = partial(packets, read_packets, source, about["topic"], False)
    size = tuple(about["size"]) if min(about["size"]) else None
    events = FileEvents(path, read, size=size)
    imu, frames, notes = read_sensors(path, about["counts"], __name__, about["topic"])
    metadata = {"format": about["format"], "topic": about["topic"], **about["counts"], **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu, frames=frames)


def trigger_packets(path: Path, topic: str | None = None) -> Iterator[Packet]:
    """Yield the trigger edges of the packets of a topic."""
    source = path.absolute()
    about = run(read_head, source, topic)
    return packets(read_packets, source, about["topic"], True, {})


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
    optional_module("rosbags", "ros", "is a ROS bag, which needs rosbags")
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2.reader import DirectoryReader
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

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
            events = decode_array(raw, ros1=ros1)[2]
            return events, tuple(column[:0] for column in events)  # type: ignore[return-value]

        return decode
    packet = PacketDecoder()
    return lambda raw: packet.decode(deserialised(connection, raw, ros1=ros1))


def _size(connection: Any, raw: bytes, *, ros1: bool) -> tuple[int, int]:
    """Return the sensor size in a message [px]; 0 if it is not set."""
    if connection.msgtype in ARRAYS:
        return decode_array(raw, ros1=ros1)[:2]
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


# Reader of the messages ``sensor_msgs/Imu`` and ``sensor_msgs/Image`` in ROS bags. Runs in the reading process.
#
# Their units are rad/s and m/s^2. Their times are those of the messages' headers, the clock of events in arrays.

IMU, IMAGE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/Image"
"""Types of the messages."""

DEPTHS = {"mono8": 1, "8UC1": 1, "mono16": 2, "16UC1": 2}
"""Bytes per pixel of the encodings of grey images."""


def read_imu(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of each message of the IMU."""
    for message in _sensor_messages(path, topic, IMU):
        values = []
        for name in ("angular_velocity", "linear_acceleration"):
            vector = getattr(message, name)
            # By the definition of the message, -1 marks a quantity that is not measured.
            unknown = getattr(message, f"{name}_covariance")[0] == -1
            values += [np.nan] * 3 if unknown else [vector.x, vector.y, vector.z]
        yield np.array([_time(message)]), *(np.array([value]) for value in values)


def read_heads(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each image."""
    for message in _sensor_messages(path, topic, IMAGE):
        depth = DEPTHS.get(message.encoding)
        if depth is None:
            raise AmiwarpError(
                f"the images have the encoding '{message.encoding[:40]}', not one of {', '.join(DEPTHS)}"
            )
        if message.step < message.width * depth or message.data.size < message.height * message.step:
            raise AmiwarpError("an image has fewer bytes than its size needs; the bag is damaged")
        yield tuple(np.array([int(value)]) for value in (_time(message), message.width, message.height, depth))


def read_images(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each image, without padding, in this computer's byte order."""
    for message in _sensor_messages(path, topic, IMAGE):
        depth = DEPTHS[message.encoding]
        rows = message.data[: message.height * message.step].reshape(message.height, message.step)
        stored = np.ascontiguousarray(rows[:, : message.width * depth]).reshape(-1)
        order = ">" if message.is_bigendian else "<"
        yield (stored.view(f"{order}u{depth}").astype(f"=u{depth}").view(np.uint8),)


def _sensor_messages(path: str, topic: str, kind: str) -> Iterator[Any]:
    """Yield the messages of the one topic with messages of a type, or of that next to the events' topic."""
    with opened_bag(path) as (bag, ros1):
        events = next(one for one in bag.connections if one.topic == topic)
        if events.msgtype not in ARRAYS:
            raise AmiwarpError("the events have the time of their sensor, which these messages do not have")
        found = {one.topic for one in bag.connections if one.msgtype == kind and one.msgcount}
        near = {name for name in found if name.rpartition("/")[0] == topic.rpartition("/")[0]}
        chosen = near if len(near) == 1 else found
        if len(chosen) != 1:
            listed = ", ".join(sorted(found)[:10]) or "none"
            raise AmiwarpError(f"expected one topic of {kind.replace('/msg', '')}; the topics are {listed}")
        connections = [one for one in bag.connections if one.topic in chosen]
        for connection, _, raw in bag.messages(connections=connections):
            yield deserialised(connection, raw, ros1=ros1)


def _time(message: Any) -> int:
    """Return the time in a message's header [us]."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000


# Writer of ROS 2 bags, with rosbags: packets of event_camera_msgs in EVT 3.0, as drivers of Prophesee cameras record.
#
# event_camera_msgs is part of the ROS 2 distributions. A bag is a single file, MCAP or SQLite, which holds the
# definition of its messages. The stamp of a packet is the time of its first event.
#
# Events of a ROS 2 bag keep their topic and the clocks of their messages: the packets are recorded and stamped as the
# messages were that held their events. The messages of all other topics are copied.

TOPIC = "/event_camera/events"
"""Topic of the events, as the drivers call it."""

MESSAGE = "event_camera_msgs/msg/EventPacket"
"""Type of the messages."""

PACKET_US = 10_000
"""Longest packet [us]."""


class PacketEncoder:
    """Encoder of events, in order of time, to serialised messages of the type :data:`MESSAGE` in EVT 3.0."""

    def __init__(self, about: Outline) -> None:
        """Load rosbags. Raises :class:`AmiwarpError` if it is missing."""
        types = optional_module("rosbags.typesys", "ros", f"{about.path}: ROS bags need rosbags")
        self.store = types.get_typestore(types.Stores.ROS2_HUMBLE)
        """Definitions of the message and of its parts."""
        self.store.register(types.get_types_from_msg(PACKET_DEFINITION, MESSAGE))
        self._about, self._clock, self._count = about, _Clock(about.bag), 0
        self._encoder = Evt3Encoder(origin_of(about))

    def __call__(self, block: Events) -> Iterator[tuple[int, Any]]:
        """Yield the packets of a block: the time of the recording of each [ns], and the serialised message."""
        types, about = self.store.types, self._about
        for events in self._clock.packets(block):
            recorded, stamp = self._clock.times(int(events.t[0]))
            words = self._encoder.encode(events, self_contained=True).astype("<u2")
            time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            message = types[MESSAGE](
                header=types["std_msgs/msg/Header"](stamp=time, frame_id="event_camera"),
                height=about.height,
                width=about.width,
                seq=self._count,
                time_base=0,
                encoding="evt3",
                is_bigendian=False,
                events=words.view(np.uint8),
            )
            self._count += 1
            yield recorded, self.store.serialize_cdr(message, MESSAGE)


def write_ros2(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events. The extension of the file decides between MCAP and SQLite."""
    kind = about.path.suffix.lower()
    encoder = PacketEncoder(about)
    from rosbags.rosbag2 import StoragePlugin, Writer

    storage = StoragePlugin.MCAP if kind == ".mcap" else StoragePlugin.SQLITE3
    with scratch_folder(part.parent) as folder:
        bag = folder / "bag"
        # Older programs read version 8 too, the earliest that rosbags writes.
        with Writer(bag, version=8, storage_plugin=storage) as writer, contextlib.ExitStack() as opened:
            topic = about.bag.topic if about.bag else TOPIC
            connection = writer.add_connection(topic, MESSAGE, typestore=encoder.store)
            found = ((recorded, connection, data) for block in blocks for recorded, data in encoder(block))
            streams = [opened.enter_context(contextlib.closing(found))]
            if about.bag is not None:
                copied = _others(writer, about.bag)
                streams.append(opened.enter_context(contextlib.closing(copied)))
            for recorded, to, data in heapq.merge(*streams, key=itemgetter(0)):
                writer.write(to, recorded, data)
        os.replace(bag / f"bag{kind}", part)


class _Clock:
    """Times of messages from the times of their events.

    Without a bag they are equal. Otherwise they follow those of the messages that held the events.
    """

    def __init__(self, bag: Bag | None) -> None:
        """Read the times of the messages of a bag."""
        parts = [(np.zeros(1, np.int64),) * 3]
        if bag is not None:
            parts = list(packets(read_stamps, bag.path, bag.topic, {}))
        t, self._recorded, self._stamps = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        self._t = np.maximum.accumulate(t)

    def packets(self, block: Events) -> Iterator[Events]:
        """Divide a block into packets, none longer than :data:`PACKET_US` or from several messages."""
        for events in regroup([block], duration_us=PACKET_US):
            cuts = np.flatnonzero(np.diff(np.searchsorted(self._t, events.t, "right"))) + 1
            for start, stop in itertools.pairwise([0, *cuts.tolist(), len(events)]):
                yield events[start:stop]

    def times(self, t: int) -> tuple[int, int]:
        """Return the time of the recording and the stamp of a message whose first event is at ``t`` [us], in ns."""
        at = max(int(np.searchsorted(self._t, t, "right")) - 1, 0)
        later = (t - int(self._t[at])) * 1000
        recorded = int(self._recorded[at]) + later
        if at + 1 < len(self._t):  # packets stay in order
            recorded = min(recorded, int(self._recorded[at + 1]))
        return recorded, int(self._stamps[at]) + later


def _others(writer: Any, bag: Bag) -> Generator[tuple[int, Any, Any], None, None]:
    """Add the other topics of a bag to a writer, and yield their messages: time of the recording [ns], topic, bytes."""
    path = bag.path
    topics = [_add_topic(writer, about) for about in run(read_topics, path, bag.topic)]
    source = packets(read_others, path, bag.topic, {})
    for data, lengths, recorded, places in source:
        ends = np.cumsum(lengths).tolist()
        for end, length, time, at in zip(ends, lengths.tolist(), recorded.tolist(), places.tolist(), strict=True):
            yield time, topics[at], data[end - length : end].data


def _add_topic(writer: Any, about: dict[str, Any]) -> Any:
    """Add a topic of another bag to a writer, and return it. Topics with several publishers are one."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.typesys import Stores, get_typestore

    for known in writer.connections:
        if (known.topic, known.msgtype) == (about["topic"], about["type"]):
            return known
    profiles = [
        Qos(
            QosHistory(history), depth, QosReliability(reliability), QosDurability(durability), QosTime(*deadline),
            QosTime(*lifespan), QosLiveliness(liveliness), QosTime(*lease), plain,
        )
        for history, depth, reliability, durability, deadline, lifespan, liveliness, lease, plain in about["qos"]
    ]  # fmt: skip
    store, definition = get_typestore(Stores.ROS2_HUMBLE), about["definition"]
    if not definition and about["type"] in store.fielddefs:  # bags of older versions hold none
        definition = store.generate_msgdef(about["type"], ros_version=2)[0]
    types = _types_of(definition, about["type"])
    store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
    return writer.add_connection(
        about["topic"], about["type"], msgdef=definition, rihs01=about["digest"] or store.hash_rihs01(about["type"]),
        serialization_format=about["serialization"], offered_qos_profiles=profiles,
    )  # fmt: skip


def _types_of(definition: str, name: str) -> dict[str, Any]:
    """Return the types in the definition of a message: a text of ROS, or files of the interface definition language."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    rule = "=" * 80 + "\n"
    if not definition.startswith(f"{rule}IDL: "):
        return dict(get_types_from_msg(definition, name))
    files = [part.partition("\n")[2] for part in definition.split(rule)[1:]]
    return {name: fields for text in files for name, fields in get_types_from_idl(text).items()}
