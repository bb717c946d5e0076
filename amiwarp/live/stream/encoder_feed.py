"""Encoder samples of a session: from the controller by way of the camera's clock, or from the source itself."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from amiwarp.live.stream.camera_clock import CameraClock
from amiwarp.live.stream.packets import NO_TIMES

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from amiwarp.events.encoder_stream import EncoderStream
    from amiwarp.live.link.clocks import ClockMap
    from amiwarp.live.link.link import Link
    from amiwarp.live.link.updates import LinkUpdate
    from amiwarp.live.stream.packets import Packet

MOST_WAITING = 1 << 20
"""Largest number of samples and index pulses that wait until the camera's clock is known. Beyond it, the oldest are
dropped."""


class EncoderFeed:
    """Appends encoder samples to an encoder, and gives them to the session's consumers.

    With a link, the controller's samples are used, on the camera's clock; else the source's own samples.
    """

    def __init__(
        self,
        link: Link | None,
        encoder: EncoderStream,
        give: Callable[[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]], None],
        say: Callable[[str], None],
    ) -> None:
        """Set up the feed.

        ``give`` is called with samples and index pulses on the events' clock, ``say`` with messages.
        """
        self.clock: ClockMap | None = None
        """Map from the controller's clock to the camera's; None while it is unknown."""
        self._link, self._encoder, self._give, self._say = link, encoder, give, say
        self._camera_clock = CameraClock()
        self._waiting: deque[LinkUpdate] = deque()
        self._waiting_samples = 0
        self._warned = False

    def poll(self) -> None:
        """Process the data that the controller has sent since the last call."""
        if self._link is None:
            return
        update = self._link.poll()
        for message in update.messages:
            self._say(message)
        if update.restarted:
            self._camera_clock.restart()
            self._encoder.restart()
            self._clear()
        for _number, t_us, host_us in update.sync:
            self._camera_clock.sync(t_us, host_us)
        if _size(update):
            self._waiting.append(update)
            self._waiting_samples += _size(update)
        clock = self.clock = self._camera_clock.clock(self._link.clock())
        if clock is None:
            self._drop_oldest()
            return
        for waiting in self._waiting:
            self._append(clock(waiting.t_us), waiting.angle, clock(waiting.index_t_us))
        self._clear()

    def take(self, packet: Packet) -> None:
        """Process a source's packet: its arrival time and triggers with a link, else its own encoder samples."""
        if packet.returned:
            self._camera_clock.returned()
            self._encoder.restart()
        if len(packet.events):
            self._camera_clock.packet(int(packet.events.t[-1]), packet.arrived_us)
        if self._link is not None:
            self._camera_clock.triggers(packet.triggers, packet.arrived_us)
        elif len(packet.encoder_t):
            self._append(packet.encoder_t, packet.encoder_angle, NO_TIMES)

    def _append(self, t: NDArray[np.int64], angle: NDArray[np.float64], index_t: NDArray[np.int64]) -> None:
        t, angle = self._encoder.append(t, angle)
        self._give(t, angle, index_t)

    def _drop_oldest(self) -> None:
        """Drop the oldest waiting samples if there are too many; warn the user once."""
        if self._waiting_samples > MOST_WAITING and not self._warned:
            self._warned = True
            self._say("the camera's clock is not known yet: dropping the oldest encoder samples that wait for it")
        while self._waiting_samples > MOST_WAITING:
            self._waiting_samples -= _size(self._waiting.popleft())

    def _clear(self) -> None:
        self._waiting.clear()
        self._waiting_samples = 0


def _size(update: LinkUpdate) -> int:
    return len(update.t_us) + len(update.index_t_us)
