"""Readers and writers of ROS bags, with rosbags: ROS 1 bags, and the SQLite and MCAP files of ROS 2."""

import contextlib
import heapq
import itertools
import os
import struct
import weakref
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.events.recording import Events, Recording, regroup
from amiwarp.io.file_scan import FileEvents, Packet, sensors_of
from amiwarp.io.files import errors_name, scratch_folder
from amiwarp.io.formats import Bag, Outline
from amiwarp.io.prophesee import Evt3Encoder, origin_of
from amiwarp.io.reading_process import Reply, packets, run
from amiwarp.io.ros_bags import (
    ARRAYS,
    PACKET_DEFINITION,
    Message,
    MessageNumbers,
    choose,
    deserialised,
    messages_of,
    note_largest_gap,
    number_of,
    opened_bag,
    typestore,
    unpacked,
)
from amiwarp.io.ros_words import (
    EVT,
    Layout,
    check_byte_order,
    edge_packets,
    event_packets,
    layout_of,
    stamp_packets,
)

# Decoders of the ROS messages that hold events: arrays of events, and packets of a sensor's own words.
#
# The messages are those of the packages dvs_msgs, prophesee_event_msgs, dv_ros_msgs, dv_ros2_msgs, event_camera_msgs
# and, its former name, event_array_msgs. Arrays of events are decoded with NumPy, because a Python object per event
# would be slow. Words of Prophesee's sensors are in :mod:`amiwarp.io.ros_words`.

Columns: TypeAlias = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
"""Arrays x, y [px], t [us], p of events; or channel, 0, t [us] and 1 for a rising edge, of triggers."""

EVENT_DEFINITION = """uint16 x
uint16 y
time ts
bool polarity
"""
ARRAY_DEFINITION = """Header header
uint32 height
uint32 width
Event[] events
"""
"""Definitions of dvs_msgs/Event and dvs_msgs/EventArray in ROS 1."""

NOTHING: Columns = (np.zeros(0, np.int64),) * 4
"""No events."""


def decode_packet(message: Any) -> tuple[Columns, Columns]:
    """Return the events and the triggers of a message without EVT words. Times are the sensor's, not the computer's."""
    check_byte_order(message)
    base, data = int(message.time_base), np.ascontiguousarray(message.events, np.uint8)
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
    raise AmiwarpError(
        f"has packets with the encoding '{message.encoding[:40]}'; expected one of {known}, in the whole topic"
    )


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


# Reader of ROS bags.
#
# Everything that touches the file runs in the reading process. The event times are those of the sensor.

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
        """Yield what a function of this module reads next to the events."""
        return packets(f"{__name__}:{function}", self.path, self.name, {})


def open_rosbag(path: Path, topic: str | None = None) -> Recording:
    """Open the events of a topic of a bag: a file, or the folder of a ROS 2 bag."""
    with contextlib.ExitStack() as copy:
        with errors_name(path, lambda: "opening the bag"):
            found, about = _event_topic(copy.enter_context(unpacked(path)), topic)
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
        yield from _event_topic(source, topic)[0].edges()


def _event_topic(path: Path, topic: str | None) -> tuple[EventTopic, dict[str, Any]]:
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
    numbers = MessageNumbers(notes)
    latest = 0
    for one, ros1 in _topic_messages(notes, path, topic):
        number, events, edges = _decoded(one, ros1=ros1)
        if number is not None:
            note_largest_gap(notes, numbers.missing(one.connection.id, number), latest)
        if len(events[2]):
            latest = int(events[2][-1])
        notes["read"] = notes.get("read", 0) + 1
        notes["triggers"] = notes.get("triggers", 0) + len(edges[0])
        yield edges if triggers else events


def _topic_messages(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Message, bool]]:
    """Yield the messages of a topic, and whether the bag is of ROS 1. Note their number."""
    with opened_bag(path) as (bag, ros1):
        connections = [found for found in bag.connections if found.topic == topic]
        notes["total"] = max(sum(found.msgcount for found in connections), 1)
        for one in messages_of(bag, connections, ros1=ros1):
            yield one, ros1


def _decoded(one: Message, *, ros1: bool) -> tuple[int | None, Columns, Columns]:
    """Return the number of a message, or None in arrays of ROS 2, which have none; its events; and its triggers."""
    if one.connection.msgtype not in ARRAYS:
        message = deserialised(one.connection, one.raw, ros1=ros1)
        return number_of(message), *decode_packet(message)
    typestore(one.connection, ros1=ros1)
    x, y, t, p = decode_array(one.raw, ros1=ros1)[2]
    number = struct.unpack_from("<I", one.raw)[0] if ros1 else None
    return number, (x, y, t, p), (x[:0], y[:0], t[:0], p[:0])


def read_stamps(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[Any, ...]]:
    """Yield for each message of a topic that holds events, but no EVT words: the times of its first event [us], of its
    recording and of its header [ns]. Runs in the reading process.
    """
    for one, ros1 in _topic_messages(notes, path, topic):
        t = _decoded(one, ros1=ros1)[1][2]
        if len(t):
            # All types of messages with events begin so, in ROS 1 after a number, in ROS 2 after the encapsulation.
            seconds, rest = struct.unpack_from("<II" if ros1 else "<iI", one.raw, 4)
            yield tuple(np.array([value], np.int64) for value in (t[0], one.recorded, seconds * 10**9 + rest))


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
        for one in messages_of(bag, connections, ros1=ros1):
            yield deserialised(one.connection, one.raw, ros1=ros1)


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
    with scratch_folder(part.parent) as folder, _plain_bag(about) as about:
        encoder = PacketEncoder(about)
        from rosbags.rosbag2 import StoragePlugin, Writer

        storage = StoragePlugin.MCAP if kind == ".mcap" else StoragePlugin.SQLITE3
        bag = folder / "bag"
        # Older programs read version 8 too, the earliest that rosbags writes.
        with Writer(bag, version=8, storage_plugin=storage) as writer:
            topic = about.bag.topic if about.bag else TOPIC
            connection = writer.add_connection(topic, MESSAGE, typestore=encoder.store)
            _write_messages(writer, connection, encoder, blocks, about.bag, _add_topic)
        os.replace(bag / f"bag{kind}", part)


@contextlib.contextmanager
def _plain_bag(about: Outline) -> Iterator[Outline]:
    """Replace a compressed bag by a copy without compression, for the block."""
    if about.bag is None:
        yield about
        return
    with unpacked(about.bag.path) as path:
        yield replace(about, bag=Bag(path, about.bag.topic))


def _write_messages(
    writer: Any,
    connection: Any,
    encode: Callable[[Events], Iterator[tuple[int, Any]]],
    blocks: Iterable[Events],
    bag: Bag | None,
    add_topic: Callable[[Any, dict[str, Any]], Any],
) -> None:
    """Write the messages of all events, and those of the other topics of a bag, in the order of their recording."""
    with contextlib.ExitStack() as opened:
        found = ((recorded, connection, data) for block in blocks for recorded, data in encode(block))
        streams = [opened.enter_context(contextlib.closing(found))]
        if bag is not None:
            copied = _others(writer, bag, add_topic)
            streams.append(opened.enter_context(contextlib.closing(copied)))
        for recorded, to, data in heapq.merge(*streams, key=itemgetter(0)):
            writer.write(to, recorded, data)


class _Clock:
    """Times of messages from the times of their events.

    Without a bag they are equal. Otherwise they follow those of the messages that held the events.
    """

    def __init__(self, bag: Bag | None) -> None:
        """Read the times of the messages of a bag."""
        parts: list[tuple[NDArray[np.int64], ...]] = [(np.zeros(1, np.int64),) * 3]
        if bag is not None:
            parts = list(_event_topic(bag.path, bag.topic)[0].stamps())
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


def _others(
    writer: Any, bag: Bag, add_topic: Callable[[Any, dict[str, Any]], Any]
) -> Generator[tuple[int, Any, Any], None, None]:
    """Add the other topics of a bag to a writer, and yield their messages: time of the recording [ns], topic, bytes."""
    path = bag.path
    topics = [add_topic(writer, about) for about in run(read_topics, path, bag.topic)]
    source = packets(read_others, path, bag.topic, {})
    for data, lengths, recorded, places in source:
        ends = np.cumsum(lengths).tolist()
        for end, length, time, at in zip(ends, lengths.tolist(), recorded.tolist(), places.tolist(), strict=True):
            yield time, topics[at], data[end - length : end].data


def _add_topic(writer: Any, about: dict[str, Any]) -> Any:
    """Add a topic of another bag to a ROS 2 writer, and return it. Topics with several publishers are one."""
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


# Writer of ROS 1 bags, with rosbags: arrays of dvs_msgs, as rpg_dvs_ros records them.
#
# The stamp of an array is the time of its first event, and so is its time in the bag. From a ROS 1 bag, both follow the
# messages that held the events, and the messages of all other topics are copied, as in ROS 2 bags.

ARRAY_TOPIC = "/dvs/events"
"""Topic of the events, as rpg_dvs_ros calls it."""

ARRAY = "dvs_msgs/msg/EventArray"
"""Type of the messages."""

EARLIEST_NS = 1
"""Earliest time in a bag [ns]. ROS itself does not write or play messages at 0."""


class ArrayEncoder:
    """Encoder of events, in order of time, to serialised messages of the type :data:`ARRAY` of ROS 1."""

    def __init__(self, about: Outline) -> None:
        """Load rosbags. Raises :class:`AmiwarpError` if it is missing."""
        types = optional_module("rosbags.typesys", "ros", f"{about.path}: ROS bags need rosbags")
        self.store = types.get_typestore(types.Stores.ROS1_NOETIC)
        """Definitions of the message and of its parts."""
        for definition, name in ((EVENT_DEFINITION, "dvs_msgs/msg/Event"), (ARRAY_DEFINITION, ARRAY)):
            self.store.register(types.get_types_from_msg(definition, name))
        self._about, self._clock, self._count = about, _Clock(about.bag), 0

    def __call__(self, block: Events) -> Iterator[tuple[int, bytes]]:
        """Yield the arrays of a block: the time of the recording of each [ns], and the serialised message."""
        about, frame = self._about, b"event_camera"
        for events in self._clock.packets(block):
            recorded, stamp = self._clock.times(int(events.t[0]))
            head = struct.pack("<IIII", self._count % 2**32, stamp // 10**9, stamp % 10**9, len(frame)) + frame
            head += struct.pack("<III", about.height, about.width, len(events))
            rows = np.empty(len(events), PACKED)
            rows["x"] = events.x
            rows["y"] = events.y
            rows["sec"], microseconds = np.divmod(events.t, 1_000_000)
            rows["nsec"] = 1000 * microseconds
            rows["p"] = events.p
            self._count += 1
            yield max(recorded, EARLIEST_NS), head + rows.tobytes()


def write_ros1(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events."""
    with _plain_bag(about) as about:
        encoder = ArrayEncoder(about)
        from rosbags.rosbag1 import Writer

        with Writer(part) as writer:
            topic = about.bag.topic if about.bag else ARRAY_TOPIC
            connection = writer.add_connection(topic, ARRAY, typestore=encoder.store)
            _write_messages(writer, connection, encoder, blocks, about.bag, _add_ros1_topic)


def _add_ros1_topic(writer: Any, about: dict[str, Any]) -> Any:
    """Add a topic of another bag to a ROS 1 writer, and return it. Publishers that do not differ are one."""
    names = (about["topic"], about["type"], about["digest"], about["callerid"], about["latching"])
    for known in writer.connections:
        if (known.topic, known.msgtype, known.digest, *known.ext) == names:
            return known
    return writer.add_connection(
        about["topic"], about["type"], msgdef=about["definition"], md5sum=about["digest"],
        callerid=about["callerid"], latching=about["latching"],
    )  # fmt: skip
