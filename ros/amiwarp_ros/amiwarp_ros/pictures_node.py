"""Node ``pictures``: grey pictures of the scene, without compensated events."""

from __future__ import annotations

from amiwarp import Policy
from amiwarp.live.stream import Session
from amiwarp_ros.live_node import LiveNode
from amiwarp_ros.message_source import MessageSource
from amiwarp_ros.parameters import Parameter
from amiwarp_ros.picture_publisher import PicturePublisher
from amiwarp_ros.running import run


class PicturesNode(LiveNode):
    """Subscribes to ``events``, and publishes pictures on ``picture``."""

    def __init__(self) -> None:
        rate = Parameter("rate_hz", 15.0, "Pictures per second of the stream (Hz)", (0.1, 1000.0))
        super().__init__("pictures", (rate,))
        self._pictures = PicturePublisher(self)

    def make_session(self, source: MessageSource, frame_id: str) -> Session:
        """Return the session that makes pictures."""
        stream = self._pictures.start(source, frame_id, self.values["rate_hz"])
        return Session(
            source, link=self.link, raw=(stream,), policy=Policy.DROP_OLDEST, say=self.say
        )

    def finish(self) -> None:
        """Make the last pictures."""
        self._pictures.close()

    def figures(self) -> dict[str, str]:
        """Return the numbers of pictures."""
        return self._pictures.figures()


def main(args: list[str] | None = None) -> None:
    """Run the node until it is interrupted."""
    run(PicturesNode, args)
