"""Sources of live events: replayed recordings, streams of packets, and cameras; and the emulated camera."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from datetime import timedelta
from functools import partial
from importlib import import_module
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import LARGEST_ANGLE, TWO_PI
from amiwarp.events.recording import Events, Recording
from amiwarp.io import open_recording
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.emulator import Controller, Played
from amiwarp.live.queues import BackgroundLoop
from amiwarp.live.stream import packets as wire
from amiwarp.live.stream.packets import Packet, Source, make_packet
from amiwarp.live.stream.sockets import SocketSink, Unreachable, accept, connect, iter_accepted, iter_connected, ready
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism

IDLE_S = 0.05
"""Longest time without a packet [s]. After this time, an empty packet is delivered."""
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
"""Kinds of sources whose sender can return."""


class ReturningSource:
    """Source for a stream that is opened again after a break, if its sender or camera returns within ``wait_s`` [s].

    It must be the same camera. The clock of a sender must have continued: otherwise events of the two parts could not
    be ordered, and :class:`AmiwarpError` is raised. The clock of ``camera:`` begins anew: its later times are shifted,
    so that the gap is as long as on the host's clock. ``say`` is called with a message when the stream breaks off, when
    it returns, and when the durations of the gap on the sender's and the host's clock disagree. Raises
    :class:`AmiwarpError` for a source other than a socket or ``camera:``, or if no sender is there at first.
    """

    def __init__(self, spec: str, wait_s: float, say: Callable[[str], None]) -> None:
        kind = spec.partition(":")[0]
        if kind not in (*SOCKETS, "camera"):
            what = "give camera:, tcp:, unix:, tcp-listen: or unix-listen:, or omit the option"
            raise AmiwarpError(
                f"{spec}: --wait-for-source applies to sockets and camera: only, because other sources cannot be "
                f"reopened; {what}"
            )
        self._wait_s, self._say, self._restarts = wait_s, say, kind == "camera"
        self._source: StreamSource | CameraSource = CameraSource(spec, say) if self._restarts else open_stream(spec)
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
            self._say(f"{self.name}: the stream is back after {time.monotonic() - began:.1f} s")

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
        with contextlib.closing(_attempts(self.name, self._say)) as attempts:
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


def _attempts(
    spec: str, say: Callable[[str], None]
) -> Generator[Callable[..., StreamSource | CameraSource] | None, None, None]:
    """Yield functions of ``hello_s`` that open a socket's sender or a camera again; None at least every second."""
    if spec.partition(":")[0] == "camera":
        while True:
            for _ in range(round(REOPEN_S / IDLE_S)):
                yield None
                time.sleep(IDLE_S)
            yield lambda hello_s: CameraSource(spec, say)
    iterate = iter_accepted if spec.partition(":")[0].endswith("-listen") else iter_connected
    for connection in iterate(spec.replace("-listen", "", 1)):
        yield None if connection is None else partial(open_connection, spec, connection)


# Cameras: most through neuromorphic-drivers, iniVation's also through dv-processing, Prophesee's also through
# Metavision or OpenEB. These libraries are optional.
#
# Tested with substitutes for these libraries, not yet with cameras.

POLL_S = 0.0005
"""Pause between two requests to the camera's library for events [s]."""


def _library(name: str, camera: str, remedy: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise AmiwarpError(f"{camera}: needs the library {name.partition('.')[0]} ({error}); {remedy}") from error


@contextlib.contextmanager
def _named(camera: str, doing: str, kind: type[AmiwarpError] = AmiwarpError) -> Iterator[None]:
    """Turn any exception of a camera's library into an :class:`AmiwarpError` of one line."""
    try:
        yield
    except (AmiwarpError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        raise kind(f"{camera}: {doing}: {lines[0][:200]}; check cable, power and access rights") from error


class _CameraSource:
    camera: Camera | None = None
    """Camera intrinsics: None, because the device does not store its calibration."""
    prism: NominalPrism | None = None
    encoders = 0
    size: tuple[int, int]
    name: str


RAW_PACKETS = 8
"""Largest number of USB packets, of 128 KiB each, that the camera's driver decodes at once: about a million events."""


def list_cameras() -> list[Any]:
    """Return the cameras that neuromorphic-drivers finds, each with ``name``, ``connection``, ``serial`` and ``error``.

    Raises :class:`AmiwarpError` if the library is missing or cannot list the cameras.
    """
    remedy = "pip install 'amiwarp[camera]', or give dv or prophesee, which use other libraries"
    drivers = _library("neuromorphic_drivers", "camera", remedy)
    with _named("camera", "the cameras cannot be listed", Unreachable):
        return list(drivers.list_devices())


def _find_camera(which: str) -> Any:
    """Return the camera with the serial number ``which``, or the only one whose model's name contains it."""
    cameras = list_cameras()
    found = [each for each in cameras if which == each.serial or _squeezed(which) in _squeezed(each.name.value)]
    name = f"camera:{which}"
    if not cameras:
        raise Unreachable(f"{name}: no camera is connected, or none that neuromorphic-drivers knows; plug it in")
    if len(found) != 1:
        listed = ", ".join(
            f"camera:{each.serial} ({each.name.value})" if each.serial else f"{each.name.value} ({each.error})"
            for each in found or cameras
        )
        raise Unreachable(f"{name}: {len(found)} such cameras are connected; choose one of these: {listed}")
    if found[0].serial is None:
        remedy = "on Linux, 'neuromorphic-drivers-install-udev-rules' gives access rights"
        raise Unreachable(f"{name}: {found[0].name.value} cannot be opened: {found[0].error}; {remedy}")
    return found[0]


def _squeezed(name: str) -> str:
    """Return the letters and digits of a name in lower case."""
    return "".join(filter(str.isalnum, name)).lower()


class CameraSource(_CameraSource):
    """Source of events from a camera by Prophesee, iniVation, CenturyArks or Lucid, read through neuromorphic-drivers.

    ``spec``: ``camera:``, then the serial number or a part of the model's name if several cameras are connected, then
    settings, separated by commas: values of biases, and ``counts_per_turn=N`` if rising edges at the trigger input are
    counts of the prism's encoder, N per turn; negative: backwards. Without it, rising edges become triggers only.
    ``say`` gets a message if USB packets are lost. The library puts the times of a device on one clock of 64 bits.
    Raises :class:`Unreachable` if the camera is not there, and :class:`AmiwarpError` for a missing library and wrong
    settings.
    """

    def __init__(self, spec: str, say: Callable[[str], None] = lambda _: None) -> None:
        which, settings = _settings(spec)
        found = _find_camera(which)
        drivers, model = import_module("neuromorphic_drivers"), found.name.value
        self.name = ",".join([f"camera:{found.serial}", *(f"{key}={value}" for key, value in settings.items())])
        """Name with the serial number, under which the same camera can be opened again."""
        self.metadata = {"camera_name": model}
        """What a recording shall store about the camera."""
        self.problem: str | None = None
        """Why the camera stopped, in one line; None while it runs."""
        self.lost = 0
        """Number of USB packets that were lost, because the computer was too slow."""
        self._say, self._count = say, 0
        self._counts_per_turn = settings.pop("counts_per_turn", 0)
        self.encoders = int(self._counts_per_turn != 0)
        module = getattr(drivers, found.name.name.lower())
        biases = _biases(self.name, model, module.Biases, settings)
        with _named(self.name, "cannot be opened", Unreachable):
            self._device = drivers.open(
                module.Configuration(biases=biases), iterator_timeout=IDLE_S, serial=found.serial,
                iterator_maximum_raw_packets=RAW_PACKETS,
            )  # fmt: skip
        try:
            with _named(self.name, "cannot be opened", Unreachable):
                properties, bounds = self._device.properties(), self._device.biases_bounds()
            self.size = int(properties.width), int(properties.height)
            for bias, value in settings.items():
                limits = getattr(bounds, bias, None)  # those of the device; equal if they are unknown
                if limits is not None and limits.minimum < limits.maximum:
                    _check_limits(self.name, bias, value, limits.minimum, limits.maximum)
        except BaseException:
            self.close()
            raise

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`. Ends when the camera stops; :attr:`problem` then says why."""
        try:
            while True:
                try:
                    with _named(self.name, "the camera stopped"):
                        status, packet = next(self._device)
                except AmiwarpError as error:
                    self.problem = str(error).removeprefix(f"{self.name}: ")
                    return
                self._count_lost(status.ring)
                yield self._packet(packet)
        finally:
            if self.lost:
                self._say(f"{self.name}: {self.lost:,} USB packets with events were lost")

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        with contextlib.suppress(Exception):  # a camera that was unplugged
            self._device.close()

    def _count_lost(self, ring: Any) -> None:
        lost = self.lost if ring is None else int(ring.dropped_packets)
        if lost and not self.lost:
            self._say(f"{self.name}: this computer is too slow: USB packets with events are lost")
        self.lost = lost

    def _packet(self, packet: Any) -> Packet:
        now, rows, edges = monotonic_us(), packet.polarity_events, packet.trigger_events
        events = None if rows is None else _events(rows["x"], rows["y"], rows["t"], rows["on"])
        if edges is None:
            return make_packet(now, events)
        # The polarity of an edge of the DAVIS346 is 0 for a falling edge, 1 for a rising one, and 2 for a pulse.
        rising = edges["rising" if "rising" in edges.dtype.names else "polarity"] > 0
        t = edges["t"][rising].astype(np.int64)
        if not self._counts_per_turn:
            return make_packet(now, events, t)
        angle = np.arange(self._count, self._count + t.size) * (TWO_PI / self._counts_per_turn)
        self._count += t.size
        return make_packet(now, events, t, t, angle)


def _settings(spec: str) -> tuple[str, dict[str, int]]:
    """Return the serial number or model in the name of a camera, and its settings."""
    parts = [part.strip() for part in spec.partition(":")[2].split(",")]
    which = "" if "=" in parts[0] else parts.pop(0)
    settings = {}
    for part in parts:
        name, _, value = part.partition("=")
        try:
            settings[name] = int(value, 0)
        except ValueError as error:
            raise AmiwarpError(f"{spec}: setting {part!r}; write NAME=WHOLE_NUMBER, as in diff_on=20") from error
    if settings.get("counts_per_turn") == 0:
        raise AmiwarpError(f"{spec}: counts_per_turn is 0; give the trigger edges per turn, negative for backwards")
    return which, settings


def _biases(name: str, model: str, kind: Any, values: dict[str, int]) -> Any:
    """Return the biases of a camera model, with ``values`` in place of their defaults."""
    fields: dict[str, Any] = {field.name: field for field in dataclasses.fields(kind)}
    for bias, value in values.items():
        if bias not in fields:
            known = ", ".join(f"{each} ({field.default:d})" for each, field in fields.items())
            raise AmiwarpError(f"{name}: {model} has no bias {bias!r}; its biases, with their defaults, are {known}")
        whole = get_args(fields[bias].type)  # of the type's NumPy and Python names; none for a switch
        low, high = (np.iinfo(whole[0]).min, np.iinfo(whole[0]).max) if whole else (0, 1)
        _check_limits(name, bias, value, low, high)
    return kind(**{bias: type(fields[bias].default)(value) for bias, value in values.items()})


def _check_limits(name: str, bias: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise AmiwarpError(f"{name}: bias {bias} = {value}; expected {low} .. {high}")


class DvSource(_CameraSource):
    """Source of events from an iniVation camera (DVXplorer, DAVIS), read through dv-processing 2.

    A serial number of None means the first camera found. Rising edges at its signal input become triggers. Raises
    :class:`AmiwarpError` if library or camera is missing.
    """

    def __init__(self, serial: str | None = None, *, packet_us: int = 1000) -> None:
        self.name = "dv" if serial is None else f"dv:{serial}"
        dv = _library("dv_processing", self.name, "pip install 'amiwarp[dv]'")
        with _named(self.name, "cannot be opened"):
            found = [str(camera.serialNumber) for camera in dv.io.camera.discover()]
            if serial not in found and (serial is not None or not found):
                raise AmiwarpError(
                    f"{self.name}: no such camera (found: {', '.join(found) or 'none'}); plug the camera in"
                )
            self._camera = dv.io.camera.open(serial or found[0])
            self.size = tuple(int(side) for side in self._camera.getEventResolution())  # type: ignore[assignment]
            self._camera.setTimeInterval(timedelta(microseconds=packet_us))
            if hasattr(self._camera, "setDetectorRunning"):
                self._camera.setDetectorRisingEdges(True)
                self._camera.setDetectorRunning(True)
        self._rising = dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`. Raises :class:`AmiwarpError` when the camera stops."""
        yielded_s = time.monotonic()
        while True:
            with _named(self.name, "stopped"):
                running = self._camera.isRunning()
                store, triggers = self._camera.getNextEventBatch(), self._triggers()
            if store is not None or triggers.size:
                yield make_packet(monotonic_us(), _dv_events(store), triggers)
                yielded_s = time.monotonic()
            elif not running:
                raise AmiwarpError(f"{self.name}: the camera stopped; was it unplugged?")
            elif time.monotonic() - yielded_s >= IDLE_S:
                yield make_packet(monotonic_us())
                yielded_s = time.monotonic()
            else:
                time.sleep(POLL_S)

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        self._camera = None

    def _triggers(self) -> NDArray[np.int64]:
        batch = self._camera.getNextTriggerBatch() or ()
        return np.array([trigger.timestamp for trigger in batch if trigger.type == self._rising], np.int64)


def _dv_events(store: Any) -> Events | None:
    if store is None:
        return None
    events = store.numpy()
    return _events(events["x"], events["y"], events["timestamp"], events["polarity"])


def _events(x: Any, y: Any, t: Any, p: Any) -> Events:
    """Copy the columns of a library's rows into new events, because the library reuses its memory."""
    return Events(x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), (p > 0).astype(np.uint8))


class PropheseeSource(_CameraSource):
    """Source of events from a Prophesee camera, read through Metavision's or OpenEB's Python binding.

    A serial number of None means the first camera found. Rising edges at its main trigger input become triggers. While
    the camera sends nothing at all, the library blocks. Raises :class:`AmiwarpError` if library or camera is missing.
    """

    def __init__(self, serial: str | None = None, *, packet_us: int = 1000) -> None:
        self.name = "prophesee" if serial is None else f"prophesee:{serial}"
        remedy = "install OpenEB or the Metavision SDK (they are not on PyPI)"
        event_io = _library("metavision_core.event_io", self.name, remedy)
        raw_reader = _library("metavision_core.event_io.raw_reader", self.name, remedy)
        hal = _library("metavision_hal", self.name, remedy)
        with _named(self.name, "cannot be opened"):
            device = raw_reader.initiate_device(path=serial or "")
            if device is None:
                raise AmiwarpError(f"{self.name}: no such camera; plug the camera in")
            trigger_in = device.get_i_trigger_in()
            if trigger_in is not None:
                trigger_in.enable(hal.I_TriggerIn.Channel.MAIN)
            self._iterator = event_io.EventsIterator.from_device(device=device, delta_t=packet_us)
            height, width = self._iterator.get_size()
        self.size = (int(width), int(height))

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`. Raises :class:`AmiwarpError` when the camera stops."""
        slices = iter(self._iterator)
        while True:
            with _named(self.name, "stopped"):
                events = next(slices, None)
                triggers = self._triggers()
            if events is None:
                raise AmiwarpError(f"{self.name}: the camera stopped; was it unplugged?")
            now = monotonic_us()
            yield make_packet(now, _events(events["x"], events["y"], events["t"], events["p"]), triggers)

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        self._iterator = None

    def _triggers(self) -> NDArray[np.int64]:
        reader = self._iterator.reader
        edges = reader.get_ext_trigger_events()
        rising = np.array(edges["t"][edges["p"] == 1], np.int64) if len(edges) else np.zeros(0, np.int64)
        reader.clear_ext_trigger_events()
        return rising


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
    ``camera:MODEL`` open a camera, with settings as :class:`CameraSource` takes them; ``dv``, ``dv:SERIAL``,
    ``prophesee`` and ``prophesee:SERIAL`` open one through other libraries. ``wait_s``: how long to wait for the sender
    of a socket, or for a ``camera:``, to return after its stream broke off [s]; ``say`` gets messages.
    Raises :class:`AmiwarpError` if the source cannot be opened, or if ``wait_s`` is given for another source.
    """
    kind, _, rest = spec.partition(":")
    if wait_s > 0.0:
        return ReturningSource(spec, wait_s, say)
    if spec == "-":
        # Read the descriptor directly, without the buffer of sys.stdin, and leave it open at the end.
        return StreamSource("standard input", open(0, "rb", buffering=0, closefd=False))
    if kind in SOCKETS:
        return open_stream(spec)
    if kind == "camera":
        return CameraSource(spec, say)
    if kind == "dv":
        return DvSource(rest or None, packet_us=packet_us)
    if kind == "prophesee":
        return PropheseeSource(rest or None, packet_us=packet_us)
    return FileSource(spec, pace=pace, packet_us=packet_us)


def reopen_source(spec: str, stop: threading.Event) -> Source | None:
    """Open a socket or a camera again as soon as it is there, until ``stop`` is set.

    Returns None for files and pipes, which cannot be opened again, and after ``stop``.
    """
    kind = spec.partition(":")[0]
    if kind in SOCKETS:
        with contextlib.closing(_attempts(spec, lambda _: None)) as attempts:
            for reopen in attempts:
                if reopen is not None:
                    with contextlib.suppress(Unreachable):  # the sender left before its hello message
                        return reopen(hello_s=REOPEN_S)
                if stop.is_set():
                    return None
    while kind in ("camera", "dv", "prophesee") and not stop.wait(REOPEN_S):
        with contextlib.suppress(AmiwarpError):
            return open_source(spec)
    return None
