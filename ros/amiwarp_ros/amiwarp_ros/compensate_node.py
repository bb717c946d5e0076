"""Node ``compensate``: events without the motion of the prism, and pictures of the scene."""

from __future__ import annotations

from amiwarp import Compensated, Policy
from amiwarp.compensation.streams import OUTSIDE
from amiwarp.live.stream import Session
from amiwarp_ros.event_publisher import EventPublisher, whole_pixels
from amiwarp_ros.live_node import LiveNode
from amiwarp_ros.message_source import MessageSource
from amiwarp_ros.parameters import Parameter
from amiwarp_ros.picture_publisher import PicturePublisher
from amiwarp_ros.running import run

WATCH_S = 10.0
"""Interval between checks of the calibrated phase [s]."""
RATE = Parameter(
    "pictures_hz", 0.0, "Pictures of the scene per second (Hz); 0: none", (0.0, 1000.0)
)


class CompensateNode(LiveNode):
    """Subscribes to ``events``, and publishes the compensated ones on ``compensated/events``.

    With ``pictures_hz``, it also publishes ``picture``: two nodes could not share the controller's port.
    """

    def __init__(self) -> None:
        super().__init__("compensate", (RATE,))
        self._pictures = PicturePublisher(self) if self.values["pictures_hz"] else None
        self._publisher: EventPublisher | None = None

    def make_session(self, source: MessageSource, frame_id: str) -> Session:
        """Return the session that compensates."""
        self._publisher = EventPublisher(self, "compensated/events", source.size, frame_id)
        raw = ()
        if self._pictures is not None:
            raw = (self._pictures.start(source, frame_id, self.values["pictures_hz"]),)
        return Session(
            source,
            self.calibration,
            link=self.link,
            raw=raw,
            sinks=(self._publish,),
            watch_s=WATCH_S,
            wait_us=round(1000.0 * self.values["wait_ms"]),
            policy=Policy.DROP_OLDEST,
            device=self.values["device"],
            say=self.say,
        )

    def finish(self) -> None:
        """Make the last pictures."""
        if self._pictures is not None:
            self._pictures.close()

    def figures(self) -> dict[str, str]:
        """Return the numbers of compensated events."""
        status = self.status
        published = 0 if self._publisher is None else self._publisher.published
        return {
            "published events": str(published),
            "events outside the image": str(status.outside),
            "events with an extrapolated angle": str(status.guessed),
            "events without an angle": str(status.unknown),
            "turns/min": "unknown" if status.rpm is None else f"{status.rpm:.1f}",
            **({} if self._pictures is None else self._pictures.figures()),
        }

    def _publish(self, packet: Compensated) -> None:
        assert self._publisher is not None
        assert self.source is not None
        keep = packet.flags & OUTSIDE == 0
        events = whole_pixels(packet.events, keep, self.source.size)
        self._publisher.publish(events, self.source.clock.offset_us or 0)


def main(args: list[str] | None = None) -> None:
    """Run the node until it is interrupted."""
    run(CompensateNode, args)
