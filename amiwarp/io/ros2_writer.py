"""Writer of ROS 2 bags, with rosbags: packets of event_camera_msgs in EVT 3.0, as drivers of Prophesee cameras record.

event_camera_msgs is part of the ROS 2 distributions. A bag is a single file, MCAP or SQLite, which holds the definition
of its messages. The stamp of a packet is the time of its first event.

Events of a ROS 2 bag keep their topic and the clocks of their messages: the packets are recorded and stamped as the
messages were that held their events. The messages of all other topics are copied.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
from collections.abc import Generator, Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events, regroup
from amiwarp.io.atomic_output import scratch_folder
from amiwarp.io.evt3_writer import Evt3Encoder, origin_of
from amiwarp.io.output_formats import Bag, Outline
from amiwarp.io.reading_process import packets, run
from amiwarp.io.ros_messages import PACKET_DEFINITION

TOPIC = "/event_camera/events"
"""Topic of the events, as the drivers call it."""

MESSAGE = "event_camera_msgs/msg/EventPacket"
"""Type of the messages."""

PACKET_US = 10_000
"""Longest packet [us]."""


def write_ros2(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events. The extension of the file decides between MCAP and SQLite."""
    kind = about.path.suffix.lower()
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise AmiwarpError(f"{about.path}: ROS bags need rosbags; install it by: pip install 'amiwarp[ros]'") from error
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(PACKET_DEFINITION, MESSAGE))
    storage = StoragePlugin.MCAP if kind == ".mcap" else StoragePlugin.SQLITE3
    with scratch_folder(part.parent) as folder:
        bag = folder / "bag"
        # Older programs read version 8 too, the earliest that rosbags writes.
        with Writer(bag, version=8, storage_plugin=storage) as writer, contextlib.ExitStack() as opened:
            connection = writer.add_connection(about.bag.topic if about.bag else TOPIC, MESSAGE, typestore=store)
            found = (
                (recorded, connection, store.serialize_cdr(message, MESSAGE))
                for recorded, message in _messages(store.types, blocks, about)
            )
            streams = [opened.enter_context(contextlib.closing(found))]
            if about.bag is not None:
                copied = _others(writer, about.bag)
                streams.append(opened.enter_context(contextlib.closing(copied)))
            for recorded, to, data in heapq.merge(*streams, key=itemgetter(0)):
                writer.write(to, recorded, data)
        os.replace(bag / f"bag{kind}", part)


def _messages(types: Any, blocks: Iterable[Events], about: Outline) -> Iterator[tuple[int, Any]]:
    """Yield packets, and the time of the recording of each [ns]."""
    encoder, clock = Evt3Encoder(origin_of(about)), _Clock(about.bag)
    for number, events in enumerate(packet for block in blocks for packet in clock.packets(block)):
        recorded, stamp = clock.times(int(events.t[0]))
        words = encoder.encode(events, self_contained=True).astype("<u2")
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        yield (
            recorded,
            types[MESSAGE](
                header=types["std_msgs/msg/Header"](stamp=time, frame_id="event_camera"),
                height=about.height,
                width=about.width,
                seq=number,
                time_base=0,
                encoding="evt3",
                is_bigendian=False,
                events=words.view(np.uint8),
            ),
        )


class _Clock:
    """Times of messages from the times of their events.

    Without a bag they are equal. Otherwise they follow those of the messages that held the events.
    """

    def __init__(self, bag: Bag | None) -> None:
        """Read the times of the messages of a bag."""
        parts = [(np.zeros(1, np.int64),) * 3]
        if bag is not None:
            parts = list(packets("amiwarp.io.rosbag:read_stamps", bag.path, bag.topic, {}))
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
    topics = [_add_topic(writer, about) for about in run("amiwarp.io.rosbag:read_topics", path, bag.topic)]
    source = packets("amiwarp.io.rosbag:read_others", path, bag.topic, {})
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
