"""Packets that a source of live events delivers, and what a source is."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events, held_bytes
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """Data that a source delivers in one step. Any part may be empty."""

    events: Events
    """Events with uint16 pixels, on the camera's clock."""
    triggers: NDArray[np.int64]
    """Rising edges at the camera's trigger input, on the camera's clock [us], shape ``(n,)``."""
    encoder_t: NDArray[np.int64]
    """Times of encoder samples that came in a file or stream, on the events' clock [us], shape ``(m,)``."""
    encoder_angle: NDArray[np.float64]
    """Unwrapped prism angles of the encoder samples [rad], shape ``(m,)``."""
    second_t: NDArray[np.int64]
    """The same times of the second encoder, of the second prism of a pair or the second tilt of a mirror [us]."""
    second_angle: NDArray[np.float64]
    """The angles of these samples [rad]."""
    arrived_us: int
    """Time at which the packet arrived, on the host's monotonic clock [us]."""
    returned: bool = False
    """Whether this is the first packet after a lost sender returned, see :class:`ReturningSource`."""

    @property
    def held_bytes(self) -> int:
        """Memory of the packet [bytes], see :func:`~amiwarp.events.recording.held_bytes`."""
        samples = (
            self.triggers,
            self.encoder_t,
            self.encoder_angle,
            self.second_t,
            self.second_angle,
        )
        return held_bytes(self.events) + sum(column.nbytes for column in samples)

    @property
    def empty(self) -> bool:
        """Whether the packet carries no events, triggers or samples."""
        samples = self.triggers.size or self.encoder_t.size or self.second_t.size
        return not (len(self.events) or samples or self.returned)


IDLE_S = 0.05
"""Longest time without a packet from a source [s]. After this time, it delivers an empty packet."""
NO_TIMES = np.zeros(0, np.int64)
"""Empty array of times, for packets without triggers or encoder samples."""
NO_ANGLES = np.zeros(0)
"""Empty array of angles, for packets without encoder samples."""


def make_packet(
    arrived_us: int,
    events: Events | None = None,
    triggers: NDArray[np.int64] = NO_TIMES,
    encoder_t: NDArray[np.int64] = NO_TIMES,
    encoder_angle: NDArray[np.float64] = NO_ANGLES,
    second_t: NDArray[np.int64] = NO_TIMES,
    second_angle: NDArray[np.float64] = NO_ANGLES,
) -> Packet:
    """Build a packet from the given parts; parts that are not given are empty."""
    events = Events.empty() if events is None else events
    return Packet(events, triggers, encoder_t, encoder_angle, second_t, second_angle, arrived_us)


class Source(Protocol):
    """Source of live events (protocol)."""

    size: tuple[int, int]
    """Width and height of the sensor [px]."""
    camera: Camera | None
    """Camera intrinsics; None if the source does not know them."""
    prism: NominalPrism | None
    """Prism of the camera; None if the source does not know it."""
    encoders: int
    """Number of encoders whose samples the source may deliver: 0, 1, or 2 for a pair of prisms and for a mirror."""
    name: str
    """Name of the source in messages."""

    def packets(self) -> Iterator[Packet]:
        """Yield packets until the stream ends; while nothing arrives, an empty packet at least every 50 ms."""

    def close(self) -> None:
        """Release the device, file or connection."""
