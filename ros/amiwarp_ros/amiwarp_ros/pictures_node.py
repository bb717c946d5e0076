"""Node ``pictures``: grey pictures of the scene, from sums in phase."""

from __future__ import annotations

import array

import numpy as np
from sensor_msgs.msg import Image

from amiwarp import LivePicture, PhaseCamera, Policy
from amiwarp.choices import Tone
from amiwarp.live.stream import PictureStream, Session
from amiwarp.live.stream.encoder_feed import event_encoder
from amiwarp.reconstruction.picture_files import SteadyLevels, limits, tones
from amiwarp_ros.live_node import LiveNode
from amiwarp_ros.message_source import MessageSource
from amiwarp_ros.parameters import Parameter
from amiwarp_ros.running import run


class PicturesNode(LiveNode):
    """Subscribes to ``events``, and publishes pictures on ``picture``."""

    def __init__(self) -> None:
        rate = Parameter("rate_hz", 15.0, "Pictures per second of the stream (Hz)", (0.1, 1000.0))
        super().__init__("pictures", (rate,))
        self._publisher = self.create_publisher(Image, "picture", 10)
        self._levels = SteadyLevels()
        self._pictures: PictureStream | None = None
        self._frame_id = ""

    def make_session(self, source: MessageSource, frame_id: str) -> Session:
        """Return the session that makes pictures."""
        self._frame_id = frame_id
        camera = PhaseCamera(
            self.calibration.model,
            event_encoder(source, self.calibration, self.link),
            rate_hz=self.values["rate_hz"],
            wait_us=round(1000.0 * self.values["wait_ms"]),
            device=self.values["device"],
        )
        self._pictures = PictureStream(camera, self._publish, newest=True)
        return Session(
            source, link=self.link, raw=(self._pictures,), policy=Policy.DROP_OLDEST, say=self.say
        )

    def finish(self) -> None:
        """Make the last pictures."""
        if self._pictures is not None:
            self._pictures.close()

    def figures(self) -> dict[str, str]:
        """Return the numbers of pictures."""
        if self._pictures is None:
            return {"pictures": "0"}
        return {
            "pictures": str(self._pictures.made),
            "pictures left out": str(self._pictures.skipped),
        }

    def _publish(self, found: LivePicture) -> None:
        assert self.source is not None
        between = self._levels.follow(*limits(found.picture))
        grey = np.rint(255.0 * tones(found.picture, Tone.MAPPED, between=between)).astype(np.uint8)
        height, width = grey.shape
        message = Image(height=height, width=width, encoding="mono8", is_bigendian=0, step=width)
        message.data = array.array("B", grey.tobytes())
        message.header.frame_id = self._frame_id
        end_us = found.end_us + (self.source.clock.offset_us or 0)
        message.header.stamp.sec, rest_us = divmod(end_us, 1_000_000)
        message.header.stamp.nanosec = 1000 * rest_us
        self._publisher.publish(message)


def main(args: list[str] | None = None) -> None:
    """Run the node until it is interrupted."""
    run(PicturesNode, args)
