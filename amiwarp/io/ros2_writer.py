"""Writer of ROS 2 bags, with rosbags: packets of event_camera_msgs in EVT 3.0, as drivers of Prophesee cameras record.

event_camera_msgs is part of the ROS 2 distributions. A bag is a single file, MCAP or SQLite, which holds the definition
of its messages. The stamp of a packet is the time of its first event.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events, regroup
from amiwarp.io.atomic_output import scratch_folder
from amiwarp.io.evt3_writer import Evt3Encoder, origin_of
from amiwarp.io.output_formats import Outline
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
    if kind not in (".mcap", ".db3"):
        raise AmiwarpError(f"{about.path}: a ROS 2 bag has the extension .mcap or .db3; rename the output")
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
        with Writer(bag, version=8, storage_plugin=storage) as writer:
            connection = writer.add_connection(TOPIC, MESSAGE, typestore=store)
            for t, message in _messages(store.types, blocks, about):
                writer.write(connection, t * 1000, store.serialize_cdr(message, MESSAGE))
        os.replace(bag / f"bag{kind}", part)


def _messages(types: Any, blocks: Iterable[Events], about: Outline) -> Iterator[tuple[int, Any]]:
    """Yield packets, and the time of the first event of each [us]."""
    encoder = Evt3Encoder(origin_of(about))
    # Blocks are divided one by one, so that no packet is larger than a block.
    packets = (packet for block in blocks for packet in regroup([block], duration_us=PACKET_US))
    for number, events in enumerate(packets):
        t = int(events.t[0])
        words = encoder.encode(events, self_contained=True).astype("<u2")
        stamp = types["builtin_interfaces/msg/Time"](sec=t // 10**6, nanosec=t % 10**6 * 1000)
        yield (
            t,
            types[MESSAGE](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="event_camera"),
                height=about.height,
                width=about.width,
                seq=number,
                time_base=0,
                encoding="evt3",
                is_bigendian=False,
                events=words.view(np.uint8),
            ),
        )
