"""Writer of ROS 1 bags, with rosbags: arrays of dvs_msgs, as rpg_dvs_ros records them.

The time of an array in the bag is its stamp, unless it follows another ROS 1 bag.
"""

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import optional_module
from amiwarp.events.recording import Events
from amiwarp.io.output_formats import Outline
from amiwarp.io.ros.messages import PACKED
from amiwarp.io.ros.writing import MessageClock, plain_bag, write_messages

ARRAY_TOPIC = "/dvs/events"
"""Topic of the events, as rpg_dvs_ros calls it."""

ARRAY = "dvs_msgs/msg/EventArray"
"""Type of the messages."""

EVENT_DEFINITION = """uint16 x
uint16 y
time ts
bool polarity
"""
"""Definition of dvs_msgs/Event in ROS 1."""

ARRAY_DEFINITION = """Header header
uint32 height
uint32 width
Event[] events
"""
"""Definition of dvs_msgs/EventArray in ROS 1."""

EARLIEST_NS = 1
"""Earliest time in a bag [ns]. ROS itself does not write or play messages at 0."""


class ArrayEncoder:
    """Encoder of events, in order of time, to serialised messages of the type :data:`ARRAY` of ROS 1."""

    def __init__(self, about: Outline, frame_id: str = "event_camera") -> None:
        """Load rosbags. Raises :class:`AmiwarpError` if it is missing. ``frame_id``: name of the camera's frame."""
        types = optional_module("rosbags.typesys", "ros", f"{about.path}: ROS bags need rosbags")
        self.store = types.get_typestore(types.Stores.ROS1_NOETIC)
        """Definitions of the message and of its parts."""
        self.store.register(types.get_types_from_msg(EVENT_DEFINITION, "dvs_msgs/msg/Event"))
        self.store.register(types.get_types_from_msg(ARRAY_DEFINITION, ARRAY))
        self._about = about
        self._clock = MessageClock(about.bag)
        self._count = 0
        self._frame_id = frame_id.encode()

    def __call__(self, block: Events) -> Iterator[tuple[int, bytes]]:
        """Yield the arrays of a block: the time of the recording of each [ns], and the serialised message."""
        about = self._about
        frame = self._frame_id
        for events in self._clock.packets(block):
            recorded, stamp = self._clock.times(int(events.t[0]))
            seconds, nanoseconds = divmod(stamp, 10**9)
            number = self._count % 2**32
            header = struct.pack("<IIII", number, seconds, nanoseconds, len(frame)) + frame
            size = struct.pack("<III", about.height, about.width, len(events))
            rows = np.empty(len(events), PACKED)
            rows["x"] = events.x
            rows["y"] = events.y
            rows["sec"], microseconds = np.divmod(events.t, 1_000_000)
            rows["nsec"] = 1000 * microseconds
            rows["p"] = events.p
            self._count += 1
            yield max(recorded, EARLIEST_NS), header + size + rows.tobytes()


def write_ros1(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events."""
    with plain_bag(about) as about:
        encoder = ArrayEncoder(about)
        from rosbags.rosbag1 import Writer

        with Writer(part) as writer:
            topic = about.bag.topic if about.bag else ARRAY_TOPIC
            connection = writer.add_connection(topic, ARRAY, typestore=encoder.store)
            write_messages(writer, connection, encoder, blocks, about.bag, _add_ros1_topic)


def _add_ros1_topic(writer: Any, about: dict[str, Any]) -> Any:
    """Add a topic of another bag to a ROS 1 writer, and return it. Publishers that do not differ are one."""
    names = (about["topic"], about["type"], about["digest"], about["callerid"], about["latching"])
    for known in writer.connections:
        if (known.topic, known.msgtype, known.digest, *known.ext) == names:
            return known
    return writer.add_connection(
        about["topic"],
        about["type"],
        msgdef=about["definition"],
        md5sum=about["digest"],
        callerid=about["callerid"],
        latching=about["latching"],
    )
