"""Publisher of events as ``event_camera_msgs/EventPacket`` in the encoding ``mono``."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from event_camera_msgs.msg import EventPacket

from amiwarp import Events
from amiwarp_ros.event_packets import mono_packets

DEPTH = 100
"""Number of messages that may wait for a subscriber."""


class EventPublisher:
    """Publishes events with whole pixels on a topic. ``seq`` counts from 0."""

    def __init__(self, node: Any, topic: str, size: tuple[int, int], frame_id: str) -> None:
        self.published = 0
        """Number of events that were published."""
        self._publisher = node.create_publisher(EventPacket, topic, DEPTH)
        self._size = size
        self._frame_id = frame_id
        self._number = 0

    def publish(self, events: Events, offset_us: int) -> None:
        """Publish events; ``offset_us``: time of ROS minus the sensor's time [us]."""
        width, height = self._size
        for base_ns, data in mono_packets(events):
            message = EventPacket(
                width=width, height=height, seq=self._number, time_base=base_ns, encoding="mono"
            )
            message.events = array.array("B", data.tobytes())
            message.header.frame_id = self._frame_id
            seconds, rest_us = divmod(base_ns // 1000 + offset_us, 1_000_000)
            message.header.stamp.sec = seconds
            message.header.stamp.nanosec = 1000 * rest_us
            self._publisher.publish(message)
            self._number += 1
        self.published += len(events)


def whole_pixels(events: Events, keep: Any, size: tuple[int, int]) -> Events:
    """Return the events of ``keep`` at their nearest pixels, without those outside the image or without a position."""
    width, height = size
    x = np.rint(events.x[keep])
    y = np.rint(events.y[keep])
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return Events(
        x[inside].astype(np.uint16),
        y[inside].astype(np.uint16),
        events.t[keep][inside],
        events.p[keep][inside],
    )
