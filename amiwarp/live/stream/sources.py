"""Where live events come from: a file at its own pace, a stream of packets, a camera; :func:`open_source` by name."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events
from amiwarp.io import open_recording
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.packets import (
    EncoderSamples,
    End,
    Hello,
    Message,
    Packet,
    PacketDecoder,
    Triggers,
    make_packet,
)
from amiwarp.live.stream.sockets import Unreachable, accept, connect, ready

IDLE_S = 0.05
"""Longest time without a packet, empty or not."""
LAST_US, LARGEST_RAD = 1 << 60, 1e12
"""Largest time [us] and angle [rad] of a stream, either sign: differences stay exact; thirty thousand years, turns."""
HELLO_S = 10.0
"""How long a sender may take to say what it sends."""


def open_stream(spec: str) -> StreamSource:
    """Connect to, or wait for, the sender of the stream at ``tcp:``, ``unix:``, ``tcp-listen:`` or ``unix-listen:``."""
    kind = spec.partition(":")[0]
    connection = accept(spec.replace("-listen", "", 1)) if kind.endswith("-listen") else connect(spec)
    return open_connection(spec, connection)


def open_connection(spec: str, connection: socket.socket, *, hello_s: float | None = None) -> StreamSource:
    """Read the stream that comes over a connection, which the source closes."""
    with connection:
        connection.settimeout(None)
        return StreamSource(spec, connection.makefile("rb", buffering=0), hello_s=hello_s)


class FileSource:
    """A recording as if it happened now: packets of ``packet_us``, each when its time is over.

    Packets without events are left out, but for an empty one each 50 ms of waiting. Encoder samples come up to the
    packet's end and one more. ``clock`` [us] and ``sleep`` [s] are the host's unless a test has others.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        pace: float | None = 1.0,
        packet_us: int = 1000,
        clock: Callable[[], int] = monotonic_us,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if pace is not None and not 0.0 < pace < float("inf"):
            raise AmiwarpError(f"pace = {pace}; give a positive number, or None for as fast as can be")
        if packet_us < 1:
            raise AmiwarpError(f"packet_us = {packet_us}; give 1 or more")
        self.name = str(path)
        recording = open_recording(path)
        self._events, encoder = recording.events, recording.encoder
        if len(self._events) and self._events.slice(0, 1).x.dtype != np.uint16:
            raise AmiwarpError(f"{path}: is compensated already; give the recording of a sensor")
        self.size, self.camera, self.prism = self._events.size, recording.camera, recording.prism
        self.has_encoder = encoder is not None
        self._encoder_t, self._encoder_angle = np.zeros(0, np.int64), np.zeros(0)
        self.clock_offset_us = 0.0 if encoder is None else encoder.clock_offset_us
        """By which the samples were moved to be on the events' clock."""
        if encoder is not None:
            # whole microseconds: at 3000 rpm half of one is less than 0.01 deg
            self._encoder_t, self._encoder_angle = encoder.t - round(encoder.clock_offset_us), encoder.angle
        self._pace, self._packet_us, self._clock, self._sleep = pace, packet_us, clock, sleep
        self._sampled = 0

    def packets(self) -> Iterator[Packet]:
        """See :meth:`Source.packets`."""
        began = self._clock()
        self._sampled = 0
        if len(self._events):
            first = self._events.t_first
            for block in self._events.blocks(duration_us=self._packet_us):
                window = (int(block.t[0]) - first) // self._packet_us + 1
                due = self._clock()
                if self._pace is not None:
                    due = began + round(window * self._packet_us / self._pace)
                    yield from self._wait(due)
                yield self._packet(due, block, first + window * self._packet_us)
        if self._sampled < len(self._encoder_t):
            yield self._packet(self._clock(), Events.empty(), int(self._encoder_t[-1]))

    def close(self) -> None:
        """See :meth:`Source.close`; the file is closed when nothing refers to it any more."""

    def _wait(self, due: int) -> Iterator[Packet]:
        while (left := (due - self._clock()) * 1e-6) > 0.0:
            self._sleep(min(left, IDLE_S))
            if left > IDLE_S:
                yield make_packet(self._clock())

    def _packet(self, arrived_us: int, events: Events, end_us: int) -> Packet:
        start = self._sampled
        self._sampled = max(start, min(int(np.searchsorted(self._encoder_t, end_us)) + 1, len(self._encoder_t)))
        which = slice(start, self._sampled)
        return make_packet(arrived_us, events, encoder_t=self._encoder_t[which], encoder_angle=self._encoder_angle[which])


class StreamSource:
    """A stream of packets from a file without a buffer: a pipe, or a socket's ``makefile("rb", buffering=0)``.

    Raises :class:`AmiwarpError` for a stream that is none, or does not begin with a hello within :data:`HELLO_S`.
    """

    def __init__(self, name: str, file: Any, *, hello_s: float | None = None) -> None:
        self.name, self._file = name, file
        self._hello_s = HELLO_S if hello_s is None else hello_s
        self._decoder = PacketDecoder(name)
        self._ended = False
        self.problem: str | None = None
        """How the stream ended, where it did not end as it should: one line."""
        try:
            self._said = hello = self._hello()
        except BaseException:
            self.close()
            raise
        self.size, self.camera, self.prism = (hello.width, hello.height), hello.camera, hello.prism
        self.has_encoder = True

    def packets(self) -> Iterator[Packet]:
        """See :meth:`Source.packets`."""
        given = time.monotonic()
        while not self._ended:
            message = self._next(IDLE_S)
            if isinstance(message, Hello) and message != self._said:
                raise AmiwarpError(f"{self.name}: a second hello says another camera; correct its sender")
            if message is not None and not isinstance(message, (Hello, End)):
                yield self._packet(message)
                given = time.monotonic()
            elif time.monotonic() - given >= IDLE_S:
                yield make_packet(monotonic_us())
                given = time.monotonic()

    def close(self) -> None:
        """See :meth:`Source.close`."""
        self._file.close()

    def _hello(self) -> Hello:
        until = time.monotonic() + self._hello_s
        while time.monotonic() < until and not self._ended:
            message = self._next(IDLE_S)
            if isinstance(message, Hello):
                return message
            if message is not None:
                raise AmiwarpError(f"{self.name}: begins without a hello; see docs/stream-format.md")
        raise Unreachable(f"{self.name}: {self.problem or 'sent no hello'}; see docs/stream-format.md")

    def _next(self, timeout_s: float) -> Message | None:
        """The next message; None where it is not complete in time, or the stream has ended."""
        if not ready(self._file, timeout_s):
            return None
        try:
            count = self._file.readinto(self._decoder.free_buffer())
        except OSError as error:
            self._end(f"ended after an error: {error.strerror or error}")
            return None
        if not count:
            offset = self._decoder.unfinished_at
            self._end("ended without an end packet" if offset is None else f"ended within the packet at byte {offset}")
            return None
        message = self._decoder.commit(count)
        self._ended |= isinstance(message, End)
        return message

    def _end(self, problem: str) -> None:
        self._ended, self.problem = True, problem

    def _packet(self, message: Events | Compensated | Triggers | EncoderSamples) -> Packet:
        now = monotonic_us()
        if isinstance(message, Compensated):
            raise AmiwarpError(f"{self.name}: sends compensated events; give the stream of a sensor")
        if len(message.t) and not (message.t.min() >= -LAST_US and message.t.max() <= LAST_US):
            given = f"times of {message.t.min()} .. {message.t.max()} us, not in +-{LAST_US}"
            raise AmiwarpError(f"{self.name}: {given}; correct its sender")
        if isinstance(message, Triggers):
            return make_packet(now, triggers=message.t)
        if isinstance(message, EncoderSamples):
            if not (np.abs(message.angle) <= LARGEST_RAD).all():
                what = f"an encoder sample is not finite or beyond {LARGEST_RAD:g} rad"
                raise AmiwarpError(f"{self.name}: {what}; correct its sender")
            return make_packet(now, encoder_t=message.t, encoder_angle=message.angle)
        width, height = self.size
        if len(message) and (message.x.max() >= width or message.y.max() >= height or message.p.max() > 1):
            what = f"an event outside the {width}x{height} frame, or of a polarity that is neither 0 nor 1"
            raise AmiwarpError(f"{self.name}: {what}; correct its sender")
        return make_packet(now, message)
