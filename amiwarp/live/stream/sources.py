"""Sources of live events: replayed recordings and streams of packets; their names, also of cameras; their returns."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import LARGEST_ANGLE
from amiwarp.events.recording import Events, Recording
from amiwarp.io import open_recording
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.emulator import Controller, Played
from amiwarp.live.queues import BackgroundLoop
from amiwarp.live.stream import packets as wire
from amiwarp.live.stream.camera_source import CameraSource
from amiwarp.live.stream.cameras import CAMERAS, open_camera_source
from amiwarp.live.stream.packets import IDLE_S, Packet, Source, make_packet
from amiwarp.live.stream.sockets import SocketSink, Unreachable, accept, connect, iter_accepted, iter_connected, ready

LARGEST_US = 1 << 60
"""Largest accepted magnitude of a time in a stream [us]: the difference of two fits int64."""
HELLO_S = 10.0
"""Longest wait for the first message (hello) of a sender [s]."""


def open_stream(spec: str) -> StreamSource:
    """Open the stream at an address.

    ``tcp:`` and ``unix:`` connect to the sender; ``tcp-listen:`` and ``unix-listen:`` wait for the sender to connect.
    """
    kind = spec.partition(":")[0]
    connection = accept(spec.replace("-listen", "", 1)) if kind.endswith("-listen") else connect(spec)
    return open_connection(spec, connection)


def open_connection(spec: str, connection: socket.socket, *, hello_s: float | None = None) -> StreamSource:
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
            raise AmiwarpError(f"packet_us = {packet_us}; give the duration of a packet, 1 us or more")
        self.name = str(path)
        recording = open_recording(path)
        self._events, encoder = recording.events, recording.encoder
        if len(self._events) and self._events.slice(0, 1).x.dtype != np.uint16:
            raise AmiwarpError(f"{path}: is compensated already; give a recording with the sensor's events")
        self.size, self.camera, self.prism = self._events.size, recording.camera, recording.prism
        self.clock_offset_us = 0.0 if encoder is None else encoder.clock_offset_us
        """Clock offset subtracted from the times of the file's encoder to put them on the events' clock [us]."""
        both = (encoder, None if encoder is None else encoder.second)
        # A rounding error of half a microsecond is less than 0.01 deg at 3000 rpm.
        self._samples = [(e.t - round(self.clock_offset_us), e.angle) for e in both if e is not None]
        self.encoders = len(self._samples)
        self.metadata = {name: value for name, value in recording.metadata.items() if name == "optic"}
        """Metadata that a recording of this source keeps: the optic, without which two angles are ambiguous."""
        self._pace, self._packet_us, self._clock, self._sleep = pace, packet_us, clock, sleep
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
            yield self._packet(self._clock(), Events.empty(), max(int(t[-1]) for t, _ in self._samples))

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
        return make_packet(arrived_us, events, wire.NO_TIMES, *columns)


class StreamSource:
    """Reads a stream of packets from an unbuffered file: a pipe, or a socket's ``makefile("rb", buffering=0)``.

    Raises :class:`AmiwarpError` for an invalid stream, or one without a hello within :data:`HELLO_S`.
    """

    def __init__(self, name: str, file: Any, *, hello_s: float | None = None) -> None:
        self.name, self._file = name, file
        self._hello_s = HELLO_S if hello_s is None else hello_s
        self._decoder = wire.PacketDecoder(name)
        self._ended = False
        self.problem: str | None = None
        """How the stream ended, in one line; None if it ended with its end message."""
        try:
            self._first_hello = hello = self._hello()
        except BaseException:
            self.close()
            raise
        self.size, self.camera, self.prism = (hello.width, hello.height), hello.camera, hello.prism
        self.encoders = hello.encoders

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`."""
        yielded_s = time.monotonic()
        while not self._ended:
            message = self._next(IDLE_S)
            if isinstance(message, wire.Hello) and message != self._first_hello:
                raise AmiwarpError(
                    f"{self.name}: a second hello message describes another camera; correct the program that sends the "
                    "stream"
                )
            if message is not None and not isinstance(message, (wire.Hello, wire.End)):
                yield self._packet(message)
                yielded_s = time.monotonic()
            elif time.monotonic() - yielded_s >= IDLE_S:
                yield make_packet(monotonic_us())
                yielded_s = time.monotonic()

    def close(self) -> None:
        """Close the file, see :meth:`Source.close`."""
        self._file.close()

    def _hello(self) -> wire.Hello:
        """Return the first message of the stream, which must be a hello."""
        until = time.monotonic() + self._hello_s
        while time.monotonic() < until and not self._ended:
            message = self._next(IDLE_S)
            if isinstance(message, wire.Hello):
                return message
            if message is not None:
                raise AmiwarpError(f"{self.name}: begins without a hello message; see docs/reference/stream-format.md")
        raise Unreachable(f"{self.name}: {self.problem or 'sent no hello'}; see docs/reference/stream-format.md")

    def _next(self, timeout_s: float) -> wire.Message | None:
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
                "ended without an end packet" if offset is None else f"ended within the packet at byte {offset}"
            )
            return None
        message = self._decoder.commit(count)
        self._ended |= isinstance(message, wire.End)
        return message

    def _break_off(self, problem: str) -> None:
        self._ended, self.problem = True, problem

    def _packet(self, message: Events | Compensated | wire.Triggers | wire.EncoderSamples) -> Packet:
        """Check a message's values and return it as a packet."""
        now = monotonic_us()
        if isinstance(message, Compensated):
            raise AmiwarpError(f"{self.name}: sends compensated events; give the stream of a sensor")
        if len(message.t) and not (message.t.min() >= -LARGEST_US and message.t.max() <= LARGEST_US):
            what = f"times of {message.t.min()} .. {message.t.max()} us, not in +-{LARGEST_US}"
            raise AmiwarpError(f"{self.name}: {what}; correct the program that sends it")
        if isinstance(message, wire.Triggers):
            return make_packet(now, triggers=message.t)
        if isinstance(message, wire.EncoderSamples):
            if not (np.abs(message.angle) <= LARGEST_ANGLE).all():
                what = f"an encoder sample is not finite or beyond {LARGEST_ANGLE:g} rad"
                raise AmiwarpError(f"{self.name}: {what}; correct the program that sends it")
            if not message.second:
                return make_packet(now, encoder_t=message.t, encoder_angle=message.angle)
            if self.encoders < 2:
                what = "samples of a second encoder come without 'encoders': 2 in its hello message"
                raise AmiwarpError(f"{self.name}: {what}; correct the program that sends it")
            return make_packet(now, second_t=message.t, second_angle=message.angle)
        width, height = self.size
        if len(message) and (message.x.max() >= width or message.y.max() >= height or message.p.max() > 1):
            what = f"an event outside the {width}x{height} frame, or with a polarity that is neither 0 nor 1"
            raise AmiwarpError(f"{self.name}: {what}; correct the program that sends it")
        return make_packet(now, message)


# Stream over a socket, or of a camera, that continues when the lost sender or camera returns.

LATE_US = 10_000
"""Largest step backwards of the event time when a sender returns [us]: events are sorted across a smaller step."""
CLOCK_US = 2_000_000
"""After a reconnection, the length of the gap by the camera's clock is compared with that by the host's clock. A larger
difference than this warns the user [us]."""


SOCKETS = ("tcp", "unix", "tcp-listen", "unix-listen")
"""Kinds of sources whose sender can return. Cameras can return, too."""


def can_return(spec: str) -> bool:
    """Return whether a source with this name can be opened again after its stream broke off."""
    return spec.partition(":")[0] in (*SOCKETS, *CAMERAS)


class ReturningSource:
    """Source for a stream that is opened again after a break, if its sender or camera returns within ``wait_s`` [s].

    It must be the same camera. The clock of a sender must have continued: otherwise events of the two parts could not
    be ordered, and :class:`AmiwarpError` is raised. The clock of a camera begins anew: its later times are shifted, so
    that the gap is as long as on the host's clock. It is opened with the same settings. ``say`` is called with a
    message when the stream breaks off, when it returns, and when the durations of the gap on the sender's and the
    host's clock disagree. Raises :class:`AmiwarpError` for a source other than a socket or a camera, or if no sender is
    there at first.
    """

    def __init__(self, spec: str, wait_s: float, say: Callable[[str], None], *, packet_us: int = 1000) -> None:
        if not can_return(spec):
            what = "give camera:, dv, prophesee, tcp:, unix:, tcp-listen: or unix-listen:, or omit the option"
            raise AmiwarpError(
                f"{spec}: --wait-for-source applies to sockets and cameras only, because other sources cannot be "
                f"reopened; {what}"
            )
        self._wait_s = wait_s
        self._say = say
        self._restarts = spec.partition(":")[0] in CAMERAS
        self._source: StreamSource | CameraSource = (
            open_camera_source(spec, say, packet_us=packet_us) if self._restarts else open_stream(spec)
        )
        source = self._source
        self.name, self.size, self.camera, self.prism = source.name, source.size, source.camera, source.prism
        self.encoders = source.encoders
        self.metadata = getattr(source, "metadata", {})
        self.lost = 0
        """Number of USB packets that were lost, see :attr:`CameraSource.lost`."""
        self.problem: str | None = None
        """How the stream ended, in one line; None if it ended with its end message."""
        self.returns = 0
        """Number of times that the sender returned."""
        self._events = 0
        self._last: tuple[int, int] | None = None  # latest event time, and the host's time of its arrival [us]
        self._shift_us = 0

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
            self._say(f"{self.name}: the stream is back after {time.monotonic() - began:.1f} s{same}")

    def close(self) -> None:
        """Close the connection, see :meth:`Source.close`."""
        self._source.close()

    def _part(self) -> Iterator[Packet]:
        """Yield packets of one connection until the stream ends or breaks off."""
        fresh = unchecked = self.returns > 0
        lost_before = self.lost
        for packet in self._source.packets():
            self.lost = lost_before + getattr(self._source, "lost", 0)
            if self._restarts:
                packet, unchecked = self._shifted(packet, unchecked), unchecked and packet.empty
            if len(packet.events):
                if unchecked:
                    self._check_clock(packet)
                    unchecked = False
                self._events += len(packet.events)
                newest = int(packet.events.t.max())
                self._last = max(newest, self._last[0] if self._last else newest), packet.arrived_us
            yield replace(packet, returned=True) if fresh else packet
            fresh = False

    @property
    def _awaited(self) -> str:
        return "the camera" if self._restarts else "its sender"

    def _shifted(self, packet: Packet, first: bool) -> Packet:
        """Return the packet on the clock of the packets before the break. ``first``: none came since the return."""
        times = np.concatenate([packet.events.t, packet.triggers])
        if first and times.size and self._last is not None:
            last, then = self._last
            by_host = last + packet.arrived_us - then - int(times.max())
            self._shift_us = max(by_host, last + 1 - int(times.min()))
        if not (self._shift_us and times.size):
            return packet
        events = Events(packet.events.x, packet.events.y, packet.events.t + self._shift_us, packet.events.p)
        return replace(
            packet, events=events, triggers=packet.triggers + self._shift_us,
            encoder_t=packet.encoder_t + self._shift_us,
        )  # fmt: skip

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
        lost = self._source
        again = _camera_attempts(lost) if isinstance(lost, CameraSource) else _attempts(self.name)
        with contextlib.closing(again) as attempts:
            for reopen in attempts:
                if reopen is not None:
                    try:
                        left = max(until - time.monotonic(), 1.0)
                        self._continue_with(reopen(hello_s=min(HELLO_S, left)))
                        return
                    except Unreachable:  # the sender left before its hello message: wait for its next connection
                        pass
                if time.monotonic() >= until:
                    return
                yield make_packet(monotonic_us())

    def _continue_with(self, source: StreamSource | CameraSource) -> None:
        """Continue with a new connection, if it comes from the same camera."""
        if source.size != self.size:
            source.close()
            sizes = f"{source.size[0]}x{source.size[1]} pixels, before it had {self.size[0]}x{self.size[1]}"
            raise AmiwarpError(f"{self.name}: is back with a camera of {sizes}; record this camera to another file")
        if (source.camera, source.prism, source.encoders) != (self.camera, self.prism, self.encoders):
            source.close()
            raise AmiwarpError(
                f"{self.name}: is back with another camera, prism or number of encoders; record this camera to another "
                "file"
            )
        self._source, self.problem = source, None
        self.returns += 1


def _attempts(spec: str) -> Generator[Callable[..., StreamSource] | None, None, None]:
    """Yield functions of ``hello_s`` that open the stream of a socket's sender again; None at least every second."""
    iterate = iter_accepted if spec.partition(":")[0].endswith("-listen") else iter_connected
    for connection in iterate(spec.replace("-listen", "", 1)):
        yield None if connection is None else partial(open_connection, spec, connection)


def _camera_attempts(lost: CameraSource) -> Generator[Callable[..., CameraSource] | None, None, None]:
    """Yield functions that open a camera again that was lost, every :data:`REOPEN_S`; None in between."""
    while True:
        for _ in range(round(REOPEN_S / IDLE_S)):
            yield None
            time.sleep(IDLE_S)
        yield lambda hello_s: lost.reopened()


# Emulated camera for the emulated controller: serves a recording's events, and a trigger for each sync pulse.

STEP_US, RETRY_S = 2000, 2e-4
"""Duration of an event packet [us], and interval between attempts to send while a client is slow [s]."""
LEAD_US = 1_000_000
"""Time from the first client's connection to the first event [us], in which sync pulses relate the clocks."""
NEVER_US = 1 << 60
"""Start time of an emulation that has not begun [us]."""


class EmulatedCamera(BackgroundLoop):
    """Serves a recording's events at their recorded pace, and one trigger for each of the controller's sync pulses.

    Camera and ``rotor`` begin once the first client connects. If reading, sending or a client is slower than the
    recording, events are sent late, but none is lost. ``now_us``: emulation time [us], shared with the controller.
    Raises :class:`AmiwarpError` for a recording without encoder or events, or an address in use.
    """

    def __init__(
        self, recording: Recording, rotor: Played, controller: Controller, address: str, now_us: Callable[[], int]
    ) -> None:
        encoder, events = recording.encoder, recording.events
        if encoder is None or not len(events):
            raise AmiwarpError(
                f"{recording.name}: has no {'events' if encoder else 'encoder'}; give a recording with both"
            )
        self._events, self._rotor, self._controller, self._now_us = events, rotor, controller, now_us
        self._origin = round(int(encoder.t[0]) - encoder.clock_offset_us)
        """Time on the events' clock at which the rotor begins [us]."""
        rotor.begin(NEVER_US)
        self._start, self._pulses_until_us = NEVER_US, -1
        self.late_us = 0
        """Largest delay of sent events so far [us]."""
        self._sink = SocketSink(address, wire.encode_hello(*events.size, recording.camera, recording.prism))
        self.address = self._sink.address
        self.done = threading.Event()
        """Event that is set when all events were sent, or the recording cannot be read further."""
        self._start_thread("amiwarp-camera")

    def _run(self) -> None:
        try:
            self._play()
        except Exception:
            self.done.set()
            raise

    def _play(self) -> None:
        with self._sink:
            while not self._sink.clients:
                if self._ended.wait(STEP_US * 1e-6):
                    return
                self._sink.tick()
            self._start = self._now_us() + LEAD_US
            self._rotor.begin(self._start)
            for block in self._events.blocks(duration_us=STEP_US):
                while (ahead_us := int(block.t[-1]) - self._time(self._now_us())) >= 0 or self._sink.waiting:
                    if self._pause(min(ahead_us, STEP_US) * 1e-6 if ahead_us > 0 else RETRY_S):
                        return
                self.late_us = max(self.late_us, -ahead_us)
                self._sink.send(wire.encode_events(block))
            while self._sink.waiting:
                if self._pause(RETRY_S):
                    return
        self.done.set()

    def _pause(self, seconds: float) -> bool:
        """Wait, then send the new triggers and the waiting packets; return True if the camera was closed meanwhile."""
        if self._ended.wait(seconds):
            return True
        # Select pulses by time, not by number: after a reset the controller numbers them from 0 again.
        pulses = [world for _, world in list(self._controller.pulses) if world > self._pulses_until_us]
        if pulses:
            self._pulses_until_us = pulses[-1]
        self._sink.send(wire.encode_triggers(np.array([self._time(world) for world in pulses], np.int64)))
        return False

    def _time(self, world_us: int) -> int:
        """Return the time on the camera's clock [us] for an emulation time [us]."""
        return world_us - self._start + self._origin


# Opening of live sources by name.

REOPEN_S = 1.0
"""Interval between attempts to open a camera that is gone, and longest wait for the hello of a sender that returns [s].
"""


def open_source(
    spec: str,
    *,
    pace: float | None = 1.0,
    packet_us: int = 1000,
    wait_s: float = 0.0,
    say: Callable[[str], None] = lambda _: None,
) -> Source:
    """Open a source of live events by its name.

    The name of a file replays a recording at ``pace`` times its speed (None: as fast as possible), in packets of
    ``packet_us`` [us]. ``-``, ``tcp:HOST:PORT`` and ``unix:PATH`` read a stream (``docs/reference/stream-format.md``);
    ``tcp-listen:HOST:PORT`` and ``unix-listen:PATH`` wait for its sender to connect. ``camera:``, ``camera:SERIAL`` and
    ``camera:MODEL`` open a camera; ``dv``, ``dv:SERIAL``, ``prophesee`` and ``prophesee:SERIAL`` open one through other
    libraries. Each may go on with settings (:class:`CameraSettings`). ``wait_s``: how long to wait for the sender of a
    socket, or for a camera, to return after its stream broke off [s]; ``say`` gets messages.
    Raises :class:`AmiwarpError` if the source cannot be opened, or if ``wait_s`` is given for another source.
    """
    kind = spec.partition(":")[0]
    if wait_s > 0.0:
        return ReturningSource(spec, wait_s, say, packet_us=packet_us)
    if spec == "-":
        # Read the descriptor directly, without the buffer of sys.stdin, and leave it open at the end.
        return StreamSource("standard input", open(0, "rb", buffering=0, closefd=False))
    if kind in SOCKETS:
        return open_stream(spec)
    if kind in CAMERAS:
        return open_camera_source(spec, say, packet_us=packet_us)
    return FileSource(spec, pace=pace, packet_us=packet_us)


def reopen_source(spec: str, stop: threading.Event) -> Source | None:
    """Open a socket or a camera again as soon as it is there, until ``stop`` is set.

    Returns None for files and pipes, which cannot be opened again, and after ``stop``.
    """
    kind = spec.partition(":")[0]
    if kind in SOCKETS:
        with contextlib.closing(_attempts(spec)) as attempts:
            for reopen in attempts:
                if reopen is not None:
                    with contextlib.suppress(Unreachable):  # the sender left before its hello message
                        return reopen(hello_s=REOPEN_S)
                if stop.is_set():
                    return None
    while kind in CAMERAS and not stop.wait(REOPEN_S):
        with contextlib.suppress(AmiwarpError):
            return open_source(spec)
    return None
