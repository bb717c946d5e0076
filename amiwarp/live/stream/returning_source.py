"""Stream over a socket, or of a camera, that continues when the lost sender or camera returns."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.camera_source import CameraSource
from amiwarp.live.stream.cameras import CAMERAS, open_camera_source
from amiwarp.live.stream.packets import IDLE_S, Packet, make_packet
from amiwarp.live.stream.sockets import Unreachable, iter_accepted, iter_connected
from amiwarp.live.stream.stream_source import (
    HELLO_S,
    RECEIVERS,
    PacketSource,
    StreamSource,
    open_connection,
    open_stream,
)

LATE_US = 10_000
"""Largest step backwards of the event time when a sender returns [us]: events are sorted across a smaller step."""
CLOCK_US = 2_000_000
"""After a reconnection, the length of the gap by the camera's clock is compared with that by the host's clock. A larger
difference than this warns the user [us]."""
REOPEN_S = 1.0
"""Interval between attempts to open a camera that is gone, and longest wait for the hello of a sender that returns [s].
"""
SENDERS = ("tcp", "unix", "tcp-listen", "unix-listen", *RECEIVERS)
"""Kinds of sources whose sender can return. Cameras can return, too."""


def can_return(spec: str) -> bool:
    """Return whether a source with this name can be opened again after its stream broke off."""
    return spec.partition(":")[0] in (*SENDERS, *CAMERAS)


class ReturningSource:
    """Source for a stream that is opened again after a break, if its sender or camera returns within ``wait_s`` [s].

    It must be the same camera. The clock of a sender must have continued: otherwise events of the two parts could not
    be ordered, and :class:`AmiwarpError` is raised. The clock of a camera begins anew: its later times are shifted, so
    that the gap is as long as on the host's clock. It is opened with the same settings. ``say`` is called with a
    message when the stream breaks off, when it returns, and when the durations of the gap on the sender's and the
    host's clock disagree. Raises :class:`AmiwarpError` for a source other than a socket or a camera, or if no sender is
    there at first.
    """

    def __init__(
        self, spec: str, wait_s: float, say: Callable[[str], None], *, packet_us: int = 1000
    ) -> None:
        if not can_return(spec):
            what = "give camera:, dv, prophesee, tcp:, unix:, tcp-listen:, unix-listen:, shm:, udp:, or omit the option"
            raise AmiwarpError(
                f"{spec}: --wait-for-source applies to streams and cameras only, because other sources cannot be "
                f"reopened; {what}",
                ErrorCode.OPTIONS,
            )
        self._wait_s = wait_s
        self._say = say
        self._restarts = spec.partition(":")[0] in CAMERAS
        self._source: StreamSource | CameraSource = (
            open_camera_source(spec, say, packet_us=packet_us)
            if self._restarts
            else open_stream(spec)
        )
        source = self._source
        self.name = source.name
        self.size = source.size
        self.camera = source.camera
        self.prism = source.prism
        self.encoders = source.encoders
        self.metadata = getattr(source, "metadata", {})
        self.lost: int | None = getattr(source, "lost", 0)
        """Number of USB packets that were lost, see :attr:`CameraSource.lost`; 0 for sockets."""
        self.problem: str | None = None
        """How the stream ended, in one line; None if it ended with its end message."""
        self.returns = 0
        """Number of times that the sender returned."""
        self._lost_packets = 0
        self._events = 0
        self._last: tuple[int, int] | None = None
        """Latest event time, and the host's time of its arrival [us]; None before the first event."""
        self._shift_us = 0
        """What is added to the times of a camera whose clock began anew [us]."""

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`."""
        while True:
            yield from self._part()
            self.problem = self._source.problem
            if self.problem is None:
                return
            self._say(
                f"{self.name}: the stream broke off after {self._events:,} events ({self.problem}); "
                f"waiting up to {self._wait_s:g} s for {self._awaited}"
            )
            self._source.close()  # or the library holds the camera
            began = time.monotonic()
            before = self.returns
            yield from self._wait(began + self._wait_s)
            if self.returns == before:
                self.problem = f"{self.problem}, and {self._awaited} was not back in {time.monotonic() - began:.1f} s"
                return
            same = ", the camera with the same settings" if self._restarts else ""
            self._say(
                f"{self.name}: the stream is back after {time.monotonic() - began:.1f} s{same}"
            )

    @property
    def lost_packets(self) -> int:
        """Number of packets that were lost between the sender and this program, over all returns."""
        return self._lost_packets + getattr(self._source, "lost_packets", 0)

    def close(self) -> None:
        """Close the connection, see :meth:`Source.close`."""
        self._source.close()

    def _part(self) -> Iterator[Packet]:
        """Yield packets of one connection until the stream ends or breaks off."""
        fresh = self.returns > 0
        unchecked = fresh
        lost_before = self.lost
        for packet in self._source.packets():
            if isinstance(self._source, CameraSource):
                lost = self._source.lost
                self.lost = None if lost is None or lost_before is None else lost_before + lost
            if self._restarts:
                packet = self._shifted(packet, unchecked)
                unchecked = unchecked and packet.empty
            if len(packet.events):
                if unchecked:
                    self._check_clock(packet)
                    unchecked = False
                self._events += len(packet.events)
                newest_us = int(packet.events.t.max())
                if self._last is not None:
                    newest_us = max(newest_us, self._last[0])
                self._last = newest_us, packet.arrived_us
            yield replace(packet, returned=True) if fresh else packet
            fresh = False

    @property
    def _awaited(self) -> str:
        return "the camera" if self._restarts else "its sender"

    def _shifted(self, packet: Packet, first: bool) -> Packet:
        """Return the packet on the clock of the packets before the break. ``first``: none came since the return."""
        times = np.concatenate([packet.events.t, packet.triggers])
        if first and times.size and self._last is not None:
            last_us, arrived_us = self._last
            by_host_us = last_us + packet.arrived_us - arrived_us - int(times.max())
            self._shift_us = max(by_host_us, last_us + 1 - int(times.min()))
        if not (self._shift_us and times.size):
            return packet
        events = Events(
            packet.events.x, packet.events.y, packet.events.t + self._shift_us, packet.events.p
        )
        return replace(
            packet,
            events=events,
            triggers=packet.triggers + self._shift_us,
            encoder_t=packet.encoder_t + self._shift_us,
        )

    def _check_clock(self, packet: Packet) -> None:
        """Compare the first events after a break with the last ones before it.

        Raises :class:`AmiwarpError` if the sender's clock restarted; warns if the gap has another length on its clock.
        """
        if self._last is None:
            return
        last_us, arrived_us = self._last
        first_us = int(packet.events.t.min())
        if first_us < last_us - LATE_US:
            what = f"its clock restarted ({first_us:,} us, the last event before was at {last_us:,} us)"
            raise AmiwarpError(
                f"{self.name}: is back, but {what}; record the new events to another file"
            )
        gap_us = first_us - last_us
        passed_us = packet.arrived_us - arrived_us
        if abs(gap_us - passed_us) > CLOCK_US:
            what = f"{gap_us * 1e-6:.1f} s passed on the camera's clock, {passed_us * 1e-6:.1f} s on the host's"
            self._say(
                f"{self.name}: {what}: its clock may have restarted, times across the gap may be wrong"
            )

    def _wait(self, until: float) -> Iterator[Packet]:
        """Yield empty packets until the sender returns or the time ``until`` is over.

        :attr:`problem` is None if the sender returned.
        """
        lost = self._source
        again = (
            _camera_attempts(lost) if isinstance(lost, CameraSource) else sender_attempts(self.name)
        )
        with contextlib.closing(again) as attempts:
            for reopen in attempts:
                if reopen is not None:
                    # A sender may leave before its hello message: then wait for its next connection.
                    with contextlib.suppress(Unreachable):
                        left_s = max(until - time.monotonic(), 1.0)
                        self._continue_with(reopen(hello_s=min(HELLO_S, left_s)))
                        return
                if time.monotonic() >= until:
                    return
                yield make_packet(monotonic_us())

    def _continue_with(self, source: StreamSource | CameraSource) -> None:
        """Continue with a new connection, if it comes from the same camera."""
        if source.size != self.size:
            source.close()
            sizes = f"{source.size[0]}x{source.size[1]} pixels, before it had {self.size[0]}x{self.size[1]}"
            raise AmiwarpError(
                f"{self.name}: is back with a camera of {sizes}; record this camera to another file"
            )
        if (source.camera, source.prism, source.encoders) != (
            self.camera,
            self.prism,
            self.encoders,
        ):
            source.close()
            raise AmiwarpError(
                f"{self.name}: is back with another camera, prism or number of encoders; record this camera to another "
                "file"
            )
        self._lost_packets = self.lost_packets
        self._source = source
        self.problem = None
        self.returns += 1


def sender_attempts(spec: str) -> Generator[Callable[..., StreamSource] | None, None, None]:
    """Yield functions of ``hello_s`` that open the stream of a sender again; None at least every few seconds."""
    kind, _, place = spec.partition(":")
    while kind in RECEIVERS:
        try:
            receiver = RECEIVERS[kind](spec)
        except Unreachable:
            yield None
            time.sleep(IDLE_S)
        else:
            yield partial(PacketSource, spec, receiver)
    iterate = iter_accepted if kind.endswith("-listen") else iter_connected
    for connection in iterate(f"{kind.removesuffix('-listen')}:{place}"):
        yield None if connection is None else partial(open_connection, spec, connection)


def _camera_attempts(
    lost: CameraSource,
) -> Generator[Callable[..., CameraSource] | None, None, None]:
    """Yield functions that open a camera again that was lost, every :data:`REOPEN_S`; None in between."""
    while True:
        for _ in range(round(REOPEN_S / IDLE_S)):
            yield None
            time.sleep(IDLE_S)
        yield lambda hello_s: lost.reopened()
