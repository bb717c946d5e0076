"""Reader of the messages ``sensor_msgs/Imu`` and ``sensor_msgs/Image`` in ROS bags. Runs in the reading process.

Their units are rad/s and m/s^2. Their times are from the messages' headers, the clock of events in arrays.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.ros.bags import ARRAYS, deserialised, messages_of, opened_bag

IMU = "sensor_msgs/msg/Imu"
"""Type of the messages of an IMU."""

IMAGE = "sensor_msgs/msg/Image"
"""Type of the messages of images."""

DEPTHS = {"mono8": 1, "8UC1": 1, "mono16": 2, "16UC1": 2}
"""Bytes per pixel of the encodings of grey images."""


def read_imu(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of each message of the IMU."""
    for message in _sensor_messages(path, topic, IMU):
        values = [
            _time(message),
            *_vector(message.angular_velocity, message.angular_velocity_covariance),
            *_vector(message.linear_acceleration, message.linear_acceleration_covariance),
        ]
        yield tuple(np.array([value]) for value in values)


def _vector(vector: Any, covariance: Any) -> list[float]:
    """Return a vector of an IMU, NaN if it is not measured."""
    # By the definition of the message, -1 marks a quantity that is not measured.
    if covariance[0] == -1:
        return [np.nan] * 3
    return [vector.x, vector.y, vector.z]


def read_heads(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each image."""
    for message in _sensor_messages(path, topic, IMAGE):
        depth = DEPTHS.get(message.encoding)
        if depth is None:
            known = ", ".join(DEPTHS)
            raise AmiwarpError(
                f"the images have the encoding '{message.encoding[:40]}', not one of {known}",
                ErrorCode.FORMAT_UNKNOWN,
            )
        is_row_short = message.step < message.width * depth
        if is_row_short or message.data.size < message.height * message.step:
            raise AmiwarpError(
                "an image has fewer bytes than its size needs; the bag is damaged",
                ErrorCode.FILE_DAMAGED,
            )
        values = (_time(message), message.width, message.height, depth)
        yield tuple(np.array([int(value)]) for value in values)


def read_images(notes: dict[str, int], path: str, topic: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each image, without padding, in this computer's byte order."""
    for message in _sensor_messages(path, topic, IMAGE):
        depth = DEPTHS[message.encoding]
        whole = message.data[: message.height * message.step]
        padded_rows = whole.reshape(message.height, message.step)
        rows = padded_rows[:, : message.width * depth]
        stored = np.ascontiguousarray(rows).reshape(-1)
        order = ">" if message.is_bigendian else "<"
        pixels = stored.view(f"{order}u{depth}").astype(f"=u{depth}")
        yield (pixels.view(np.uint8),)


def _sensor_messages(path: str, topic: str, kind: str) -> Iterator[Any]:
    """Yield the messages of the one topic with messages of a type, or of the topic next to the events' topic."""
    with opened_bag(path) as (bag, ros1):
        of_events = next(connection for connection in bag.connections if connection.topic == topic)
        if of_events.msgtype not in ARRAYS:
            raise AmiwarpError(
                "the events have the time of their sensor, which these messages do not have"
            )
        chosen = _topic_near(bag, topic, kind)
        connections = [connection for connection in bag.connections if connection.topic == chosen]
        for message in messages_of(bag, connections, ros1=ros1):
            yield deserialised(message.connection, message.raw, ros1=ros1)


def _topic_near(bag: Any, topic: str, kind: str) -> str:
    """Return the one topic with messages of a type, or the one that lies next to ``topic``."""
    topics = set()
    for connection in bag.connections:
        if connection.msgtype == kind and connection.msgcount:
            topics.add(connection.topic)
    namespace, _, _ = topic.rpartition("/")
    near = {name for name in topics if name.rpartition("/")[0] == namespace}
    chosen = near if len(near) == 1 else topics
    if len(chosen) != 1:
        ros1_kind = kind.replace("/msg", "")
        listed = ", ".join(sorted(topics)[:10]) or "none"
        raise AmiwarpError(
            f"expected one topic of {ros1_kind}; the topics are {listed}",
            ErrorCode.AMBIGUOUS,
        )
    return next(iter(chosen))


def _time(message: Any) -> int:
    """Return the time in a message's header [us]."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000
