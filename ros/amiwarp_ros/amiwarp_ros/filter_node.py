"""Node ``filter``: events without noise. It needs neither a prism nor a calibration."""

from __future__ import annotations

from typing import Any

from event_camera_msgs.msg import EventPacket
from rclpy.node import Node

from amiwarp import AmiwarpError, EventFilter
from amiwarp.imaging.filters import NAMES, RunningFilter
from amiwarp.live.event_sorter import EventSorter
from amiwarp_ros.diagnostics import Diagnostics
from amiwarp_ros.event_packets import PacketDecoder, stamp_us
from amiwarp_ros.event_publisher import EventPublisher
from amiwarp_ros.live_node import INPUT_QOS
from amiwarp_ros.parameters import Parameter, declare
from amiwarp_ros.running import run

LONGEST_US = 10_000_000
"""Longest time of a filter [us]."""
PARAMETERS = (
    Parameter(
        "background_us",
        0,
        "Remove events without a neighbour in this time before (us); 0: keep them",
        (0, LONGEST_US),
    ),
    Parameter(
        "refractory_us",
        0,
        "Remove events of a pixel in this time after its last kept one (us); 0: keep them",
        (0, LONGEST_US),
    ),
    Parameter("most_per_s", 0.0, "Largest rate (events/s); 0: any", (0.0, 1e12)),
    Parameter("region", [0, 0, 0, 0], "Left, top, right, bottom of the kept part (px); zeros: all"),
)


class FilterNode(Node):
    """Subscribes to ``events``, and publishes those that are kept on ``filtered/events``."""

    def __init__(self) -> None:
        super().__init__("filter")
        values = declare(self, PARAMETERS)
        region = tuple(values.pop("region"))
        self._chosen = EventFilter(region=region if any(region) else None, **values)
        self._decoder = PacketDecoder()
        self._sorter = EventSorter()
        self._filter: RunningFilter | None = None
        self._publisher: EventPublisher | None = None
        self._events = 0
        self._failure: str | None = None
        self._diagnostics = Diagnostics(self)
        self.create_subscription(EventPacket, "events", self._take, INPUT_QOS)
        self.create_timer(1.0, self._publish_diagnostics)

    def close(self) -> None:
        """Do nothing: the node has no thread."""

    def _take(self, message: Any) -> None:
        if self._failure is not None:
            return
        try:
            self._publish(message)
        except AmiwarpError as error:
            self._failure = str(error)
            self.get_logger().error(self._failure)

    def _publish(self, message: Any) -> None:
        size = (int(message.width), int(message.height))
        if self._filter is None or self._publisher is None:
            self._filter = RunningFilter(self._chosen, size)
            frame_id = message.header.frame_id
            self._publisher = EventPublisher(self, "filtered/events", size, frame_id)
        decoded, _ = self._decoder.decode(message)
        if not len(decoded):
            return
        offset_us = stamp_us(message) - int(decoded.t[0])
        events = self._sorter.put(decoded)
        self._events += len(events)
        self._publisher.publish(events[self._filter.keep(events)], offset_us)

    def _publish_diagnostics(self) -> None:
        counts = {
            "missing messages": self._decoder.missing,
            "late messages": self._decoder.late,
            "late events": self._sorter.late,
        }
        figures = {"events": str(self._events)}
        if self._filter is not None:
            for name, count in self._filter.removed.items():
                figures[f"removed: {NAMES[name]}"] = str(count)
        self._diagnostics.publish(counts, figures, self._failure)


def main(args: list[str] | None = None) -> None:
    """Run the node until it is interrupted."""
    run(FilterNode, args)
