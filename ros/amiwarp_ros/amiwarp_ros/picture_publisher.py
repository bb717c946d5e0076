"""Publisher of grey pictures of the scene, from sums in phase."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from sensor_msgs.msg import Image

from amiwarp import LivePicture, PhaseCamera
from amiwarp.choices import Tone
from amiwarp.live.stream import PictureStream
from amiwarp.live.stream.encoder_feed import event_encoder
from amiwarp.reconstruction.picture_files import SteadyLevels, limits, tones
from amiwarp_ros.message_source import MessageSource


class PicturePublisher:
    """Makes pictures of the events of a node's session, and publishes them on ``picture``."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._publisher = node.create_publisher(Image, "picture", 10)
        self._levels = SteadyLevels()
        self._stream: PictureStream | None = None
        self._source: MessageSource | None = None
        self._frame_id = ""

    def start(self, source: MessageSource, frame_id: str, rate_hz: float) -> PictureStream:
        """Return the stream of pictures, which takes the session's packets as they came."""
        values = self._node.values
        self._source = source
        self._frame_id = frame_id
        camera = PhaseCamera(
            self._node.calibration.model,
            event_encoder(source, self._node.calibration, self._node.link),
            rate_hz=rate_hz,
            wait_us=round(1000.0 * values["wait_ms"]),
            device=values["device"],
        )
        self._stream = PictureStream(camera, self._publish, newest=True)
        return self._stream

    def close(self) -> None:
        """Make the last pictures."""
        if self._stream is not None:
            self._stream.close()

    def figures(self) -> dict[str, str]:
        """Return the numbers of pictures."""
        if self._stream is None:
            return {"pictures": "0"}
        return {
            "pictures": str(self._stream.made),
            "pictures left out": str(self._stream.skipped),
        }

    def _publish(self, found: LivePicture) -> None:
        assert self._source is not None
        between = self._levels.follow(*limits(found.picture))
        grey = np.rint(255.0 * tones(found.picture, Tone.MAPPED, between=between)).astype(np.uint8)
        height, width = grey.shape
        message = Image(height=height, width=width, encoding="mono8", is_bigendian=0, step=width)
        message.data = array.array("B", grey.tobytes())
        message.header.frame_id = self._frame_id
        end_us = int(found.end_us) + (self._source.clock.offset_us or 0)
        message.header.stamp.sec, rest_us = divmod(end_us, 1_000_000)
        message.header.stamp.nanosec = 1000 * rest_us
        self._publisher.publish(message)
