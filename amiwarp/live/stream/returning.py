"""A stream over a socket whose sender may go away and come back."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from amiwarp.errors import AmiwarpError
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.packets import packet
from amiwarp.live.stream.sockets import Unreachable, accepting, connecting
from amiwarp.live.stream.sources import HELLO_S, StreamSource, from_connection, open_stream

if TYPE_CHECKING:
    from amiwarp.live.stream.packets import Packet

LATE_US = 10_000
"""By which a returning sender's first event may be before the last one: as much as is put in order."""
CLOCK_US = 2_000_000
"""Difference between the camera's and the host's time over a gap from which on it is said."""


SOCKETS = ("tcp", "unix", "tcp-listen", "unix-listen")
"""Kinds of sources whose sender can return."""


class ReturningSource:
    """A stream that is opened again when it broke off, for as long as its sender is back within ``wait_s`` [s].

    The sender must be the same camera, and its clock must have gone on: events that begin before the last one raise
    :class:`AmiwarpError`, because no order of the two parts would be true. ``say`` gets a sentence when the stream
    breaks off, when it is back, and when the camera's clock does not fit the host's over the gap.
    Raises :class:`AmiwarpError` for a source other than a socket, or a sender that is not there at first.
    """

    def __init__(self, spec: str, wait_s: float, say: Callable[[str], None]) -> None:
        kind = spec.partition(":")[0]
        if kind not in SOCKETS:
            what = "give tcp:, unix:, tcp-listen: or unix-listen:, or leave it out"
            raise AmiwarpError(
                f"{spec}: --wait-for-source applies to sockets only, a file or pipe does not return; {what}"
            )
        self._wait_s, self._say, self._listens = wait_s, say, kind.endswith("-listen")
        source = self._source = open_stream(spec)
        self.name, self.size, self.camera, self.prism = spec, source.size, source.camera, source.prism
        self.has_encoder = source.has_encoder
        self.problem: str | None = None
        """How the stream ended, if it did not end as it should: one line."""
        self.returns = 0
        """Times that the sender came back."""
        self._events = 0
        self._last: tuple[int, int] | None = None  # time of the last event, and when it arrived

    def packets(self) -> Iterator[Packet]:
        """See :meth:`Source.packets`."""
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
        """See :meth:`Source.close`."""
        self._source.close()

    def _part(self) -> Iterator[Packet]:
        """Packets until the stream ends or breaks off."""
        fresh = unchecked = self.returns > 0
        for given in self._source.packets():
            if len(given.events):
                if unchecked:
                    self._check_clock(given)
                    unchecked = False
                self._events += len(given.events)
                newest = int(given.events.t.max())
                self._last = max(newest, self._last[0] if self._last else newest), given.arrived_us
            yield replace(given, returned=True) if fresh else given
            fresh = False

    def _check_clock(self, given: Packet) -> None:
        if self._last is None:
            return
        (last, then), first = self._last, int(given.events.t.min())
        if first < last - LATE_US:
            what = f"its clock began anew ({first:,} us, the last event before was at {last:,} us)"
            raise AmiwarpError(f"{self.name}: is back, but {what}; record what follows into another file")
        gap, passed = first - last, given.arrived_us - then
        if abs(gap - passed) > CLOCK_US:
            what = f"{gap * 1e-6:.1f} s went by on the camera's clock, {passed * 1e-6:.1f} s here"
            self._say(f"{self.name}: {what}: its clock may have begun anew, times across the gap may be wrong")

    def _wait(self, until: float) -> Iterator[Packet]:
        """Empty packets while the sender is away; :attr:`problem` is None once it is back."""
        place = self.name.replace("-listen", "", 1)
        attempts = (accepting if self._listens else connecting)(place)
        try:
            for connection in attempts:
                if connection is not None:
                    try:
                        left = max(until - time.monotonic(), 1.0)
                        self._take(from_connection(self.name, connection, hello_s=min(HELLO_S, left)))
                        return
                    except Unreachable:  # it left before its hello
                        pass
                if time.monotonic() >= until:
                    return
                yield packet(monotonic_us())
        finally:
            attempts.close()

    def _take(self, source: StreamSource) -> None:
        """Go on with a new connection of the same camera."""
        if source.size != self.size:
            source.close()
            sizes = f"{source.size[0]}x{source.size[1]} pixels, before it had {self.size[0]}x{self.size[1]}"
            raise AmiwarpError(f"{self.name}: is back with a camera of {sizes}; record it into another file")
        if (source.camera, source.prism) != (self.camera, self.prism):
            source.close()
            raise AmiwarpError(f"{self.name}: is back with another camera or prism; record it into another file")
        self._source.close()
        self._source, self.problem = source, None
        self.returns += 1
