"""Encoder samples of a session: from the source, the link or both, on the clock of the events."""

import math
import time
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder_stream import EncoderStream
from amiwarp.live.link.camera_clock import CameraClock, ClockSource
from amiwarp.live.link.clocks import ClockMap
from amiwarp.live.link.link import Link
from amiwarp.live.link.updates import LinkUpdate
from amiwarp.live.stream.packets import NO_TIMES, Packet, Source
from amiwarp.results.calibration import Calibration, check_made_with_encoder

WAITING_S = 1.5
"""Time without a relation between the clocks after which the user is told [s]."""
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
        give: Callable[[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], bool], None],
        say: Callable[[str], None],
    ) -> None:
        """Set up the feed.

        ``give`` is called with samples and index pulses on the events' clock and with whether they belong to the
        second encoder, ``say`` with messages.
        """
        self.clock: ClockMap | None = None
        """Map from the controller's clock to the camera's; None while it is unknown."""
        self.clock_source: ClockSource | None = None if link is None else ClockSource.UNKNOWN
        """How this map is known; None without a link."""
        self._link = link
        self._encoder = encoder
        self._give = give
        self._say = say
        self._camera_clock = CameraClock()
        self._unknown_since = time.monotonic()
        self._has_related = False
        self._relation = 0
        self._shortest_us: int | None = None
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
            self._has_related = False
            self._clear()
        for _number, t_us, host_us in update.sync:
            self._camera_clock.sync(t_us, host_us)
        if _size(update):
            self._waiting.append(update)
            self._waiting_samples += _size(update)
        clock = self._camera_clock.clock(self._link.clock())
        self._follow_clock(clock, self._camera_clock.source)
        if clock is None:
            self._drop_oldest()
            return
        for waiting in self._waiting:
            self._append(clock(waiting.t_us), waiting.angle, clock(waiting.index_t_us))
        self._clear()

    def settle(self) -> None:
        """Wait for no more pulses, because the stream has ended."""
        self._camera_clock.settle()

    def host_time(self, event_us: int) -> float:
        """Return the host's time of an event [us]: by the clocks, else the earliest that its arrival allows."""
        host = None if self._link is None else self._link.clock()
        if host is not None and self.clock is not None and self._encoder.sure:
            return host.inverse(self.clock.inverse(event_us))
        return float(event_us + (self._shortest_us or 0))

    def _follow_clock(self, clock: ClockMap | None, source: ClockSource) -> None:
        """Take the relation between the clocks, and say how it is known if that has changed."""
        before = self.clock_source
        self.clock = clock
        self.clock_source = source
        now = time.monotonic()
        if source is ClockSource.UNKNOWN:
            if before is not source:
                self._unknown_since = now
            elif now - self._unknown_since > WAITING_S:
                self._unknown_since = math.inf
                self._say(
                    "the clocks of controller and camera are not known yet: events wait for sync pulses at the "
                    "camera's trigger input, and those that wait too long have no angle (flag 4)"
                )
            return
        if clock is None:
            return
        self._encoder.sure = source.sure
        relation = self._camera_clock.relation
        if (
            self._has_related and relation != self._relation
        ):  # the samples so far may be at wrong times
            self._encoder.clear()
        self._has_related = True
        self._relation = relation
        if source is before:
            return
        known = {
            ClockSource.PULSES: f"by {clock.pairs} pulses, within {max(clock.offset_std_us, 0.1):.1f} µs",
            ClockSource.OLD: "by pulses that were seen long ago, and may have drifted apart since: all angles count as "
            "guessed (flag 2) until the camera sees sync pulses again",
            ClockSource.REGULAR: "by pulses at regular intervals, as an older controller sends them: arrival times "
            f"chose among shifts of {clock.offset_std_us * 1e-3:.0f} ms, so all angles count as guessed (flag 2); "
            "install newer firmware",
            ClockSource.ARRIVAL: f"by arrival times, within {clock.offset_std_us * 1e-3:.2g} ms at best, without sync "
            "pulses at the camera's trigger input: all angles count as guessed (flag 2)",
        }
        self._say(f"the clocks of controller and camera are related {known[source]}")

    def take(self, packet: Packet) -> None:
        """Process a source's packet: its arrival time and triggers with a link, else its own encoder samples."""
        if packet.returned:
            self._camera_clock.returned()
            if self._link is None:
                self._encoder.restart()
            else:  # its samples are on the clock that the camera had before, and may be later than the new events
                self._encoder.clear()
            self._has_related = False
            self._shortest_us = None
        if len(packet.events):
            last_us = int(packet.events.t[-1])
            self._camera_clock.packet(last_us, packet.arrived_us)
            delay_us = packet.arrived_us - last_us
            self._shortest_us = (
                delay_us if self._shortest_us is None else min(self._shortest_us, delay_us)
            )
        if self._link is not None:
            self._camera_clock.triggers(packet.triggers, packet.arrived_us)
            return
        if len(packet.encoder_t):
            self._append(packet.encoder_t, packet.encoder_angle, NO_TIMES)
        second = self._encoder.second
        if len(packet.second_t) and isinstance(second, EncoderStream):
            self._give(*second.append(packet.second_t, packet.second_angle), NO_TIMES, True)

    def _append(
        self, t: NDArray[np.int64], angle: NDArray[np.float64], index_t: NDArray[np.int64]
    ) -> None:
        t, angle = self._encoder.append(t, angle)
        self._give(t, angle, index_t, False)
        if isinstance(self._encoder.second, float):
            self._give(t, self._encoder.second * angle, NO_TIMES, True)

    def _drop_oldest(self) -> None:
        """Drop the oldest waiting samples if there are too many; warn the user once."""
        if self._waiting_samples > MOST_WAITING and not self._warned:
            self._warned = True
            self._say(
                "the camera's clock is not known yet: dropping the oldest encoder samples that wait for it"
            )
        while self._waiting_samples > MOST_WAITING:
            self._waiting_samples -= _size(self._waiting.popleft())

    def _clear(self) -> None:
        self._waiting.clear()
        self._waiting_samples = 0


def _size(update: LinkUpdate) -> int:
    return len(update.t_us) + len(update.index_t_us)


def encoder_count(source: Source, link: Link | None) -> int:
    """Return the number of encoders that a session takes samples from: the link's, or the source's."""
    return source.encoders if link is None else 1


def clock_offset(source: Source, link: Link | None) -> float:
    """Return the clock offset of a file's own encoder [us], which a new recording of it shall keep; 0 with a link."""
    return 0.0 if link is not None else float(getattr(source, "clock_offset_us", 0.0))


def event_encoder(
    source: Source,
    calibration: Calibration | None,
    link: Link | None,
    second_ratio: float | None = None,
) -> EncoderStream:
    """Return the encoder of a session, without samples: with the clock offset and the correction of a calibration.

    ``second_ratio``: speed of the second prism relative to the first, if only the first has an encoder. Raises
    :class:`AmiwarpError` for a calibration without an encoder.
    """
    # A source's own samples are already shifted by its file's clock offset; the calibrated offset is more accurate.
    own_offset = clock_offset(source, link)
    if calibration is not None:
        check_made_with_encoder(calibration)
    known = {} if calibration is None else calibration.parameters
    harmonics = None if calibration is None else calibration.harmonics
    offset = known.get("clock_offset", own_offset) - own_offset
    second: EncoderStream | float | None = second_ratio
    if second is None and encoder_count(source, link) == 2:
        second = EncoderStream(offset)
    return EncoderStream(offset, second=second, harmonics=harmonics)
