"""Sources that are read once: a recording as a source, and a stream of a socket, pipe, shared memory or datagrams."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import LARGEST_ANGLE
from amiwarp.events.recording import Events
from amiwarp.io import open_recording
from amiwarp.io.assumptions import assumed_texts
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.datagrams import DatagramReceiver
from amiwarp.live.stream.packets import IDLE_S, NO_TIMES, Packet, make_packet
from amiwarp.live.stream.shared_ring import RingReceiver
from amiwarp.live.stream.sockets import Unreachable, accept, connect, ready
from amiwarp.live.stream.stream_format import (
    EncoderSamples,
    End,
    Hello,
    Message,
    PacketDecoder,
    Triggers,
)

LARGEST_US = 1 << 60
"""Largest accepted magnitude of a time in a stream [us]: the difference of two fits int64."""
HELLO_S = 10.0
"""Longest wait for the first message (hello) of a sender [s]."""


def open_stream(spec: str) -> StreamSource:
    """Open the stream at an address.

    ``tcp:`` and ``unix:`` connect to the sender; ``tcp-listen:`` and ``unix-listen:`` wait for the sender to connect.
    ``shm:`` and ``udp:`` receive packets, some of which may be lost.
    """
    kind = spec.partition(":")[0]
    if kind in RECEIVERS:
        return PacketSource(spec, RECEIVERS[kind](spec))
    connection = (
        accept(spec.replace("-listen", "", 1)) if kind.endswith("-listen") else connect(spec)
    )
    return open_connection(spec, connection)


def open_connection(
    spec: str, connection: socket.socket, *, hello_s: float | None = None
) -> StreamSource:
    """Open the stream of a connection. The returned source closes the connection."""
    with connection:
        connection.settimeout(None)
        return StreamSource(spec, connection.makefile("rb", buffering=0), hello_s=hello_s)


class FileSource:
    """Replays a recording in real time, in packets of ``packet_us`` [us], each at the end of its period.

    Periods without events give no packet, but waiting gives an empty one every 50 ms. A packet carries the encoder
    samples up to its end and one more. ``clock`` [us] and ``sleep`` [s] are the host's; tests replace them.
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
            raise AmiwarpError(
                f"pace = {pace}; give a positive number (1: the recorded speed), or None for as fast as possible"
            )
        if packet_us < 1:
            raise AmiwarpError(
                f"packet_us = {packet_us}; give the duration of a packet, 1 us or more"
            )
        self.name = str(path)
        try:
            recording = open_recording(path)
        except AmiwarpError as error:
            if error.code is not ErrorCode.AMBIGUOUS:
                raise
            raise AmiwarpError(
                f"{error}: amiwarp convert has the option; play the file that it writes"
            ) from error
        self.assumptions = assumed_texts(recording.metadata)
        """What the file does not state and is assumed, as texts."""
        self._events = recording.events
        encoder = recording.encoder
        if len(self._events) and self._events.slice(0, 1).x.dtype != np.uint16:
            raise AmiwarpError(
                f"{path}: is compensated already, or undistorted; give a recording with the sensor's events",
                ErrorCode.CONTENT_MISSING,
            )
        self.size = self._events.size
        self.camera = recording.camera
        self.prism = recording.prism
        self.clock_offset_us = 0.0 if encoder is None else encoder.clock_offset_us
        """Clock offset subtracted from the times of the file's encoder to put them on the events' clock [us]."""
        both = (encoder, None if encoder is None else encoder.second)
        # A rounding error of half a microsecond is less than 0.01 deg at 3000 rpm.
        self._samples = [
            (e.t - round(self.clock_offset_us), e.angle) for e in both if e is not None
        ]
        self.encoders = len(self._samples)
        self.metadata = {
            name: value for name, value in recording.metadata.items() if name == "optic"
        }
        """Metadata that a recording of this source keeps: the optic, without which two angles are ambiguous."""
        self._pace = pace
        self._packet_us = packet_us
        self._clock = clock
        self._sleep = sleep
        self._sent = [0] * self.encoders

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`."""
        began = self._clock()
        self._sent = [0] * self.encoders
        if len(self._events):
            first = self._events.t_first
            for block in self._events.blocks(duration_us=self._packet_us):
                window = (int(block.t[0]) - first) // self._packet_us + 1
                due = self._clock()
                if self._pace is not None:
                    due = began + round(window * self._packet_us / self._pace)
                    yield from self._wait(due)
                yield self._packet(due, block, first + window * self._packet_us)
        if any(sent < len(t) for sent, (t, _) in zip(self._sent, self._samples, strict=True)):
            yield self._packet(
                self._clock(), Events.empty(), max(int(t[-1]) for t, _ in self._samples)
            )

    def close(self) -> None:
        """Do nothing: the file is closed with the last reference to it."""

    def _wait(self, due: int) -> Iterator[Packet]:
        while (left := (due - self._clock()) * 1e-6) > 0.0:
            self._sleep(min(left, IDLE_S))
            if left > IDLE_S:
                yield make_packet(self._clock())

    def _packet(self, arrived_us: int, events: Events, end_us: int) -> Packet:
        columns: list[NDArray[Any]] = []
        for k, (t, angle) in enumerate(self._samples):
            start = self._sent[k]
            self._sent[k] = max(start, min(int(np.searchsorted(t, end_us)) + 1, len(t)))
            columns += [t[start : self._sent[k]], angle[start : self._sent[k]]]
        return make_packet(arrived_us, events, NO_TIMES, *columns)


class StreamSource:
    """Reads a stream of packets from an unbuffered file: a pipe, or a socket's ``makefile("rb", buffering=0)``.

    Raises :class:`AmiwarpError` for an invalid stream, or one without a hello within :data:`HELLO_S`.
    """

    def __init__(self, name: str, file: Any, *, hello_s: float | None = None) -> None:
        self.name = name
        self._file = file
        self._hello_s = HELLO_S if hello_s is None else hello_s
        self._decoder = PacketDecoder(name)
        self._ended = False
        self.problem: str | None = None
        """How the stream ended, in one line; None if it ended with its end message."""
        try:
            self._first_hello = hello = self._hello()
        except BaseException:
            self.close()
            raise
        self.size = (hello.width, hello.height)
        self.camera = hello.camera
        self.prism = hello.prism
        self.encoders = hello.encoders

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`."""
        yielded_s = time.monotonic()
        while not self._ended:
            message = self._next(IDLE_S)
            if isinstance(message, Hello) and message != self._first_hello:
                raise AmiwarpError(
                    f"{self.name}: a second hello message describes another camera; correct the program that sends the "
                    "stream",
                    ErrorCode.FILE_DAMAGED,
                )
            if message is not None and not isinstance(message, (Hello, End)):
                yield self._packet(message)
                yielded_s = time.monotonic()
            elif time.monotonic() - yielded_s >= IDLE_S:
                yield make_packet(monotonic_us())
                yielded_s = time.monotonic()

    def close(self) -> None:
        """Close the file, see :meth:`Source.close`."""
        self._file.close()

    def _hello(self) -> Hello:
        """Return the first message of the stream, which must be a hello."""
        until = time.monotonic() + self._hello_s
        while time.monotonic() < until and not self._ended:
            message = self._next(IDLE_S)
            if isinstance(message, Hello):
                return message
            if message is not None:
                raise AmiwarpError(
                    f"{self.name}: begins without a hello message; see docs/reference/stream-format.md",
                    ErrorCode.FILE_DAMAGED,
                )
        raise Unreachable(
            f"{self.name}: {self.problem or 'sent no hello'}; see docs/reference/stream-format.md"
        )

    def _next(self, timeout_s: float) -> Message | None:
        """Return the next message; None if it is incomplete after the timeout, or if the stream has ended."""
        if not ready(self._file, timeout_s):
            return None
        try:
            count = self._file.readinto(self._decoder.free_buffer())
        except OSError as error:
            self._break_off(f"ended after an error: {error.strerror or error}")
            return None
        if not count:
            offset = self._decoder.unfinished_at
            self._break_off(
                "ended without an end packet"
                if offset is None
                else f"ended within the packet at byte {offset}"
            )
            return None
        message = self._decoder.commit(count)
        self._ended |= isinstance(message, End)
        return message

    def _break_off(self, problem: str) -> None:
        self._ended = True
        self.problem = problem

    def _packet(self, message: Events | Compensated | Triggers | EncoderSamples) -> Packet:
        """Check a message's values and return it as a packet."""
        now = monotonic_us()
        if isinstance(message, Compensated):
            raise AmiwarpError(
                f"{self.name}: sends compensated or undistorted events; give the stream of a sensor, which amiwarp "
                "live --raw-to passes on, or write these events with its --out",
                ErrorCode.CONTENT_MISSING,
            )
        if len(message.t) and not (
            message.t.min() >= -LARGEST_US and message.t.max() <= LARGEST_US
        ):
            what = f"times of {message.t.min()} .. {message.t.max()} us, not in +-{LARGEST_US}"
            raise AmiwarpError(
                f"{self.name}: {what}; correct the program that sends it", ErrorCode.FILE_DAMAGED
            )
        if isinstance(message, Triggers):
            return make_packet(now, triggers=message.t)
        if isinstance(message, EncoderSamples):
            if not (np.abs(message.angle) <= LARGEST_ANGLE).all():
                what = f"an encoder sample is not finite or beyond {LARGEST_ANGLE:g} rad"
                raise AmiwarpError(
                    f"{self.name}: {what}; correct the program that sends it",
                    ErrorCode.FILE_DAMAGED,
                )
            if not message.second:
                return make_packet(now, encoder_t=message.t, encoder_angle=message.angle)
            if self.encoders < 2:
                what = "samples of a second encoder come without 'encoders': 2 in its hello message"
                raise AmiwarpError(
                    f"{self.name}: {what}; correct the program that sends it",
                    ErrorCode.FILE_DAMAGED,
                )
            return make_packet(now, second_t=message.t, second_angle=message.angle)
        width, height = self.size
        if len(message) and (
            message.x.max() >= width or message.y.max() >= height or message.p.max() > 1
        ):
            what = f"an event outside the {width}x{height} frame, or with a polarity that is neither 0 nor 1"
            raise AmiwarpError(
                f"{self.name}: {what}; correct the program that sends it", ErrorCode.FILE_DAMAGED
            )
        return make_packet(now, message)


class PacketReceiver(Protocol):
    """Receiver of complete packets, some of which may be lost (protocol)."""

    lost: int
    """Number of packets that were lost so far."""
    problem: str | None
    """Why no more packets will come, in one line; None while they may."""

    def receive(self, timeout_s: float) -> bytes | None:
        """Return the next packet, at first the hello; None if there is none within the timeout."""

    def close(self) -> None:
        """Release the memory or the socket."""


class PacketSource(StreamSource):
    """Reads a stream from a receiver of complete packets: of datagrams, or of shared memory.

    Raises :class:`AmiwarpError` for an invalid stream, or one without a hello within :data:`HELLO_S`.
    """

    def __init__(
        self, name: str, receiver: PacketReceiver, *, hello_s: float | None = None
    ) -> None:
        self._receiver = receiver
        super().__init__(name, receiver, hello_s=hello_s)

    @property
    def lost_packets(self) -> int:
        """Number of packets that were lost so far."""
        return self._receiver.lost

    def _next(self, timeout_s: float) -> Message | None:
        packet = self._receiver.receive(timeout_s)
        if packet is None:
            if self._receiver.problem is not None:
                self._break_off(self._receiver.problem)
            return None
        message = next(self._decoder.feed(packet), None)
        self._ended |= isinstance(message, End)
        return message


RECEIVERS: Mapping[str, Callable[[str], PacketReceiver]] = {
    "shm": RingReceiver,
    "udp": DatagramReceiver,
}
"""Receivers of packets by the kind of address."""
