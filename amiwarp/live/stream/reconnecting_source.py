"""Stream over a socket that continues when a lost sender returns."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from amiwarp.errors import AmiwarpError
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.connections import Unreachable, iter_accepted, iter_connected
from amiwarp.live.stream.packets import make_packet
from amiwarp.live.stream.sources import HELLO_S, StreamSource, open_connection, open_stream

if TYPE_CHECKING:
    from amiwarp.live.stream.packets import Packet

LATE_US = 10_000
"""Largest step backwards of the event time when a sender returns [us]: events are sorted across a smaller step."""
CLOCK_US = 2_000_000
"""After a reconnection, the length of the gap by the camera's clock is compared with that by the host's clock. A larger
difference than this warns the user [us]."""


SOCKETS = ("tcp", "unix", "tcp-listen", "unix-listen")
"""Kinds of sources whose sender can return."""


class ReturningSource:
    """Source for a stream that is opened again after a break, if its sender returns within ``wait_s`` [s].

    The sender must be the same camera, and its clock must have continued. Otherwise events of the two parts could not
    be ordered, and :class:`AmiwarpError` is raised. ``say`` is called with a message when the stream breaks off, when
    it returns, and when the durations of the gap on the camera's and the host's clock disagree. Raises
    :class:`AmiwarpError` for a source other than a socket, or if no sender is there at first.
    """

    def __init__(self, spec: str, wait_s: float, say: Callable[[str], None]) -> None:
        kind = spec.partition(":")[0]
        if kind not in SOCKETS:
            what = "give tcp:, unix:, tcp-listen: or unix-listen:, or omit the option"
            raise AmiwarpError(
                f"{spec}: --wait-for-source applies to sockets only, because a file or pipe cannot be reopened; {what}"
            )
        self._wait_s, self._say, self._listens = wait_s, say, kind.endswith("-listen")
        source = self._source = open_stream(spec)
        self.name, self.size, self.camera, self.prism = spec, source.size, source.camera, source.prism
        self.has_encoder = source.has_encoder
        self.problem: str | None = None
        """How the stream ended, in one line; None if it ended with its end message."""
        self.returns = 0
        """Number of times that the sender returned."""
        self._events = 0
        self._last: tuple[int, int] | None = None  # latest event time, and the host's time of its arrival [us]

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`."""
        while True:
            yield from self._part()
            self.problem = self._source.problem
            if self.problem is None:
                return
            self._say(
                f"{self.name}: the stream broke off after {self._events:,} events ({self.problem}); "
                f"waiting up to {self._wait_s:g} s for its sender"
            )
            began = time.monotonic()
            before = self.returns
            yield from self._wait(began + self._wait_s)
            if self.returns == before:
                self.problem = f"{self.problem}, and its sender was not back in {time.monotonic() - began:.1f} s"
                return
            self._say(f"{self.name}: the stream is back after {time.monotonic() - began:.1f} s")

    def close(self) -> None:
        """Close the connection, see :meth:`Source.close`."""
        self._source.close()

    def _part(self) -> Iterator[Packet]:
        """Yield packets of one connection until the stream ends or breaks off."""
        fresh = unchecked = self.returns > 0
        for packet in self._source.packets():
            if len(packet.events):
                if unchecked:
                    self._check_clock(packet)
                    unchecked = False
                self._events += len(packet.events)
                newest = int(packet.events.t.max())
                self._last = max(newest, self._last[0] if self._last else newest), packet.arrived_us
            yield replace(packet, returned=True) if fresh else packet
            fresh = False

    def _check_clock(self, packet: Packet) -> None:
        if self._last is None:
            return
        (last, then), first = self._last, int(packet.events.t.min())
        if first < last - LATE_US:
            what = f"its clock restarted ({first:,} us, the last event before was at {last:,} us)"
            raise AmiwarpError(f"{self.name}: is back, but {what}; record the new events to another file")
        gap, passed = first - last, packet.arrived_us - then
        if abs(gap - passed) > CLOCK_US:
            what = f"{gap * 1e-6:.1f} s passed on the camera's clock, {passed * 1e-6:.1f} s on the host's"
            self._say(f"{self.name}: {what}: its clock may have restarted, times across the gap may be wrong")

    def _wait(self, until: float) -> Iterator[Packet]:
        """Yield empty packets until the sender returns or the time ``until`` is over.

        :attr:`problem` is None if the sender returned.
        """
        address = self.name.replace("-listen", "", 1)
        attempts = (iter_accepted if self._listens else iter_connected)(address)
        try:
            for connection in attempts:
                if connection is not None:
                    try:
                        left = max(until - time.monotonic(), 1.0)
                        self._continue_with(open_connection(self.name, connection, hello_s=min(HELLO_S, left)))
                        return
                    except Unreachable:  # the sender left before its hello message: wait for its next connection
                        pass
                if time.monotonic() >= until:
                    return
                yield make_packet(monotonic_us())
        finally:
            attempts.close()

    def _continue_with(self, source: StreamSource) -> None:
        """Continue with a new connection, if it comes from the same camera."""
        if source.size != self.size:
            source.close()
            sizes = f"{source.size[0]}x{source.size[1]} pixels, before it had {self.size[0]}x{self.size[1]}"
            raise AmiwarpError(f"{self.name}: is back with a camera of {sizes}; record this camera to another file")
        if (source.camera, source.prism) != (self.camera, self.prism):
            source.close()
            raise AmiwarpError(f"{self.name}: is back with another camera or prism; record this camera to another file")
        self._source.close()
        self._source, self.problem = source, None
        self.returns += 1
