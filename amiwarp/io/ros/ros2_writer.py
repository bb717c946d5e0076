"""Writer of ROS 2 bags, with rosbags: packets of event_camera_msgs in EVT 3.0.

Drivers of Prophesee cameras record such packets, and event_camera_msgs is part of the ROS 2 distributions. A bag is a
single file, MCAP or SQLite, which holds the definition of its messages.
"""

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import optional_module
from amiwarp.events.recording import Events
from amiwarp.io.output_formats import Outline, origin_of
from amiwarp.io.prophesee.evt3_encoder import Evt3Encoder
from amiwarp.io.ros.bags import PACKET_DEFINITION
from amiwarp.io.ros.writing import MessageClock, plain_bag, write_messages
from amiwarp.io.unfinished import scratch_folder

TOPIC = "/event_camera/events"
"""Topic of the events, as the drivers call it."""

MESSAGE = "event_camera_msgs/msg/EventPacket"
"""Type of the messages."""


class PacketEncoder:
    """Encoder of events, in order of time, to serialised messages of the type :data:`MESSAGE` in EVT 3.0."""

    def __init__(self, about: Outline, frame_id: str = "event_camera") -> None:
        """Load rosbags. Raises :class:`AmiwarpError` if it is missing. ``frame_id``: name of the camera's frame."""
        types = optional_module("rosbags.typesys", "ros", f"{about.path}: ROS bags need rosbags")
        self.store = types.get_typestore(types.Stores.ROS2_HUMBLE)
        """Definitions of the message and of its parts."""
        self.store.register(types.get_types_from_msg(PACKET_DEFINITION, MESSAGE))
        self._about = about
        self._clock = MessageClock(about.bag)
        self._count = 0
        self._frame_id = frame_id
        self._encoder = Evt3Encoder(origin_of(about))

    def __call__(self, block: Events) -> Iterator[tuple[int, Any]]:
        """Yield the packets of a block: the time of the recording of each [ns], and the serialised message."""
        types = self.store.types
        about = self._about
        for events in self._clock.packets(block):
            recorded, stamp = self._clock.times(int(events.t[0]))
            words = self._encoder.encode(events, self_contained=True).astype("<u2")
            seconds, nanoseconds = divmod(stamp, 10**9)
            time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
            message = types[MESSAGE](
                header=types["std_msgs/msg/Header"](stamp=time, frame_id=self._frame_id),
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
    with plain_bag(about) as about:
        encoder = PacketEncoder(about)
        with ros2_file(part, about.path.suffix.lower()) as writer:
            topic = about.bag.topic if about.bag else TOPIC
            connection = writer.add_connection(topic, MESSAGE, typestore=encoder.store)
            write_messages(writer, connection, encoder, blocks, about.bag, _add_topic)


@contextlib.contextmanager
def ros2_file(part: Path, kind: str) -> Iterator[Any]:
    """Yield the library's writer of a bag that is a single file, with the extension ``kind``: ``.mcap`` or ``.db3``."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    storage = StoragePlugin.MCAP if kind == ".mcap" else StoragePlugin.SQLITE3
    with scratch_folder(part.parent) as folder:
        bag = folder / "bag"
        # Older programs read version 8 too, the earliest that rosbags writes.
        with Writer(bag, version=8, storage_plugin=storage) as writer:
            yield writer
        os.replace(bag / f"bag{kind}", part)


def _add_topic(writer: Any, about: dict[str, Any]) -> Any:
    """Add a topic of another bag to a ROS 2 writer, and return it. Topics with several publishers are one."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )
    from rosbags.typesys import Stores, get_typestore

    for known in writer.connections:
        if (known.topic, known.msgtype) == (about["topic"], about["type"]):
            return known
    profiles = []
    for profile in about["qos"]:
        history, depth, reliability, durability, deadline, lifespan, liveliness, lease, plain = (
            profile
        )
        profiles.append(
            Qos(
                QosHistory(history),
                depth,
                QosReliability(reliability),
                QosDurability(durability),
                QosTime(*deadline),
                QosTime(*lifespan),
                QosLiveliness(liveliness),
                QosTime(*lease),
                plain,
            )
        )
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition = about["definition"]
    if not definition and about["type"] in store.fielddefs:
        # Bags of older versions hold no definitions.
        definition, _ = store.generate_msgdef(about["type"], ros_version=2)
    types = _types_of(definition, about["type"])
    store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
    return writer.add_connection(
        about["topic"],
        about["type"],
        msgdef=definition,
        rihs01=about["digest"] or store.hash_rihs01(about["type"]),
        serialization_format=about["serialization"],
        offered_qos_profiles=profiles,
    )


def _types_of(definition: str, name: str) -> dict[str, Any]:
    """Return the types in the definition of a message: a text of ROS, or files of the interface definition language."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    rule = "=" * 80 + "\n"
    if not definition.startswith(f"{rule}IDL: "):
        return dict(get_types_from_msg(definition, name))
    files = [part.partition("\n")[2] for part in definition.split(rule)[1:]]
    return {name: fields for text in files for name, fields in get_types_from_idl(text).items()}
