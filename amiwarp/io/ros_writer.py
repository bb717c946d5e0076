"""Writers of ROS bags, with rosbags.

ROS 2 bags hold packets of event_camera_msgs in EVT 3.0, as drivers of Prophesee cameras record. event_camera_msgs is
part of the ROS 2 distributions. A bag is a single file, MCAP or SQLite, which holds the definition of its messages.
ROS 1 bags hold arrays of dvs_msgs, as rpg_dvs_ros records them.

The stamp of a message is the time of its first event. Events of a bag keep their topic and the clocks of their
messages: what is written is recorded and stamped as the messages were that held the events. The messages of all other
topics are copied.
"""

import contextlib
import heapq
import itertools
import os
import struct
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import optional_module
from amiwarp.events.recording import Events, regroup
from amiwarp.io.evt_writers import Evt3Encoder
from amiwarp.io.files import scratch_folder
from amiwarp.io.formats import Bag, Outline, origin_of
from amiwarp.io.reading_process import packets, run
from amiwarp.io.ros import event_topic, read_others, read_topics
from amiwarp.io.ros_bags import PACKET_DEFINITION
from amiwarp.io.ros_messages import PACKED
from amiwarp.io.ros_packed import unpacked

# ROS 2: packets in EVT 3.0.

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
        self._about = about
        self._clock = _Clock(about.bag)
        self._count = 0
        self._encoder = Evt3Encoder(origin_of(about))

    def __call__(self, block: Events) -> Iterator[tuple[int, Any]]:
        """Yield the packets of a block: the time of the recording of each [ns], and the serialised message."""
        types = self.store.types
        about = self._about
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
    """Write the messages of all events, and of the other topics of a bag, in the order of their recording."""
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

    Without a bag they are equal. Otherwise they follow the times of the messages that held the events.
    """

    def __init__(self, bag: Bag | None) -> None:
        """Read the times of the messages of a bag."""
        parts: list[tuple[NDArray[np.int64], ...]] = [(np.zeros(1, np.int64),) * 3]
        if bag is not None:
            parts = list(event_topic(bag.path, bag.topic)[0].stamps())
        t, recorded, self._stamps = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        self._t = np.maximum.accumulate(t)
        # A message that came late was recorded after those behind it. Packets are written in order.
        self._recorded = np.minimum.accumulate(recorded[::-1])[::-1]

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
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition = about["definition"]
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


# ROS 1: arrays of events. The time of an array in the bag is its stamp, unless it follows another ROS 1 bag.

ARRAY_TOPIC = "/dvs/events"
"""Topic of the events, as rpg_dvs_ros calls it."""

ARRAY = "dvs_msgs/msg/EventArray"
"""Type of the messages."""

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
        self._about = about
        self._clock = _Clock(about.bag)
        self._count = 0

    def __call__(self, block: Events) -> Iterator[tuple[int, bytes]]:
        """Yield the arrays of a block: the time of the recording of each [ns], and the serialised message."""
        about = self._about
        frame = b"event_camera"
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
