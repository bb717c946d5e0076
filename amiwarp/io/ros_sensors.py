"""Reader of the messages ``sensor_msgs/Imu`` and ``sensor_msgs/Image`` in ROS bags. Runs in the reading process.

Their units are rad/s and m/s^2. Their times are from the messages' headers, the clock of events in arrays.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.ros_bags import ARRAYS, deserialised, messages_of, opened_bag

IMU = "sensor_msgs/msg/Imu"
IMAGE = "sensor_msgs/msg/Image"
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
