"""What travels in a live stream: packets in memory, their bytes (``docs/stream-format.md``), and their order."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.streams import Compensated, held_bytes
from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events
from amiwarp.io.attributes import camera_attributes, prism_attributes, read_camera, read_prism
from amiwarp.live.stream.hello import read_fields

if TYPE_CHECKING:
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.prism import NominalPrism

MAGIC = b"AMIS"
VERSION = 1
MOST = 1 << 18
"""Rows of a packet."""
LONGEST_HELLO = 1 << 16
"""Bytes."""
HEADER = struct.Struct("<4sBBHIII")
"""Magic, version, kind, 0, rows, bytes of the payload, their CRC-32."""
HELLO, EVENTS, COMPENSATED, TRIGGERS, ENCODER, END = range(1, 7)
COLUMNS: Mapping[int, tuple[str, ...]] = {
    EVENTS: ("<i8", "<u2", "<u2", "u1"),
    COMPENSATED: ("<i8", "<f4", "<f4", "u1", "u1"),
    TRIGGERS: ("<i8",),
    ENCODER: ("<i8", "<f8"),
}


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """What a source hands out at a time; any part may be empty."""

    events: Events
    """uint16 pixels, the camera's clock."""
    triggers: NDArray[np.int64]
    """Rising edges at the camera's trigger input, the camera's clock [us]."""
    encoder_t: NDArray[np.int64]
    """Encoder samples that came along (files, sockets), on the events' clock [us]."""
    encoder_angle: NDArray[np.float64]
    """Their angles, unwrapped [rad]."""
    arrived_us: int
    """The host's monotonic clock."""
    returned: bool = False
    """Whether it is the first after the source was lost and came back, see :class:`ReturningSource`."""

    @property
    def held_bytes(self) -> int:
        """Memory that it takes while it waits [bytes], see :func:`~amiwarp.compensation.streams.held_bytes`."""
        samples = self.triggers.nbytes + self.encoder_t.nbytes + self.encoder_angle.nbytes
        return held_bytes(self.events) + samples

    @property
    def bare(self) -> bool:
        """Whether it carries nothing at all."""
        return not (len(self.events) or self.triggers.size or self.encoder_t.size or self.returned)


NO_TIMES = np.zeros(0, np.int64)
NO_ANGLES = np.zeros(0)


def packet(
    arrived_us: int,
    events: Events | None = None,
    triggers: NDArray[np.int64] = NO_TIMES,
    encoder_t: NDArray[np.int64] = NO_TIMES,
    encoder_angle: NDArray[np.float64] = NO_ANGLES,
) -> Packet:
    """A packet of what there is."""
    return Packet(Events.empty() if events is None else events, triggers, encoder_t, encoder_angle, arrived_us)


class Source(Protocol):
    """Where events come from as they happen."""

    size: tuple[int, int]
    """Sensor's (width, height) [px]."""
    camera: Camera | None
    prism: NominalPrism | None
    has_encoder: bool
    """Whether encoder samples can come along."""
    name: str
    """For messages."""

    def packets(self) -> Iterator[Packet]:
        """Packets until the stream ends; where nothing comes, empty ones at least every 50 ms."""

    def close(self) -> None:
        """Give the device, file or connection back."""


@dataclass(frozen=True, slots=True)
class Hello:
    """What a stream begins with."""

    width: int
    height: int
    camera: Camera | None = None
    prism: NominalPrism | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Triggers:
    """Rising edges [us]."""

    t: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class EncoderSamples:
    """Encoder samples: times [us], angles unwrapped [rad]."""

    t: NDArray[np.int64]
    angle: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class End:
    """The stream ends as it should."""


Message: TypeAlias = Hello | Events | Compensated | Triggers | EncoderSamples | End


def encode_hello(width: int, height: int, camera: Camera | None = None, prism: NominalPrism | None = None) -> bytes:
    """The first packet of a stream."""
    fields: dict[str, Any] = {"width": width, "height": height}
    if camera is not None:
        fields["camera"] = camera_attributes(camera)
    if prism is not None:
        fields["prism"] = prism_attributes(prism)
    return _packed(HELLO, 0, json.dumps(fields).encode())


def encode_events(events: Events) -> bytes:
    """A sensor's events; more than :data:`MOST` become several packets, here and below."""
    return _in_packets(EVENTS, events.t, events.x, events.y, events.p)


def encode_compensated(events: Events, flags: NDArray[np.uint8]) -> bytes:
    """Compensated events with their flags ``(n,)``, see :mod:`amiwarp.compensation.streams`."""
    return _in_packets(COMPENSATED, events.t, events.x, events.y, events.p, flags)


def encode_triggers(t_us: NDArray[np.int64]) -> bytes:
    """Rising edges at the camera's trigger input [us]."""
    return _in_packets(TRIGGERS, t_us)


def encode_encoder(t_us: NDArray[np.int64], angle: NDArray[np.float64]) -> bytes:
    """Encoder samples on the events' clock [us], angles unwrapped [rad]."""
    return _in_packets(ENCODER, t_us, angle)


def encode_end() -> bytes:
    """The last packet of a stream."""
    return _packed(END, 0, b"")


def _in_packets(kind: int, *columns: NDArray[Any]) -> bytes:
    out = []
    for start in range(0, columns[0].size, MOST):
        parts = (column[start : start + MOST] for column in columns)
        payload = b"".join(part.astype(dtype, "C").tobytes() for part, dtype in zip(parts, COLUMNS[kind], strict=True))
        out.append(_packed(kind, min(MOST, columns[0].size - start), payload))
    return b"".join(out)


def _packed(kind: int, count: int, payload: bytes) -> bytes:
    return HEADER.pack(MAGIC, VERSION, kind, 0, count, len(payload), zlib.crc32(payload)) + payload


class PacketDecoder:
    """Bytes as they come to messages; never holds more than one packet.

    Raises :class:`AmiwarpError`, naming ``where`` and the byte at which the packet begins, for a stream that is none:
    all before it has been handed out. Kinds it does not know are passed over.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._at = 0
        self._header: tuple[int, int, int] | None = None
        self._held = bytearray(HEADER.size)
        self._filled = 0

    @property
    def within(self) -> int | None:
        """The byte at which a packet begins that has not ended yet; None between packets."""
        return self._at if self._filled or self._header is not None else None

    def room(self) -> memoryview:
        """Where the next bytes belong: not empty, never beyond the packet. Then call :meth:`filled`."""
        return memoryview(self._held)[self._filled :]

    def filled(self, count: int) -> Message | None:
        """Take note of ``count`` bytes that were put into :meth:`room`; the message that they complete."""
        self._filled += count
        if self._filled < len(self._held):
            return None
        held, self._filled = self._held, 0
        if self._header is None:
            self._header = self._checked(held)
            self._held = bytearray(self._header[1])
            if self._header[1]:
                return None
            held = self._held
        kind, length, check = self._header
        self._header, self._held = None, bytearray(HEADER.size)
        if zlib.crc32(held) != check:
            raise self._wrong(f"the check of its {length} bytes does not fit")
        message = self._message(kind, held)
        self._at += HEADER.size + length
        return message

    def feed(self, data: bytes) -> Iterator[Message]:
        """Messages that ``data`` completes."""
        start = 0
        while start < len(data):
            room = self.room()
            count = min(len(room), len(data) - start)
            room[:count] = data[start : start + count]
            start += count
            message = self.filled(count)
            if message is not None:
                yield message

    def _checked(self, held: bytearray) -> tuple[int, int, int]:
        magic, version, kind, _, count, length, check = HEADER.unpack(held)
        if magic != MAGIC:
            raise self._wrong(f"it begins with {bytes(magic)!r}, not {MAGIC!r}")
        if version != VERSION:
            raise self._wrong(f"it is of version {version}, not {VERSION}")
        row = sum(np.dtype(column).itemsize for column in COLUMNS.get(kind, ()))
        longest = LONGEST_HELLO if kind in (HELLO, END) else MOST * row if row else MOST * 19
        if length > longest or (row and length != count * row):
            raise self._wrong(f"it has {count} rows in {length} bytes; expected up to {longest}, {row} a row")
        return kind, length, check

    def _message(self, kind: int, held: bytearray) -> Message | None:
        if kind == HELLO:
            return self._hello(held)
        if kind == END:
            return End()
        if kind not in COLUMNS:
            return None
        count, start, columns = len(held) // sum(np.dtype(c).itemsize for c in COLUMNS[kind]), 0, []
        for column in COLUMNS[kind]:
            columns.append(np.frombuffer(held, column, count, start))
            start += columns[-1].nbytes
        t = columns[0].astype(np.int64, copy=False)
        if kind == TRIGGERS:
            return Triggers(t)
        if kind == ENCODER:
            return EncoderSamples(t, columns[1].astype(np.float64, copy=False))
        _, x, y, p, *flags = columns
        place = np.float32 if flags else np.uint16
        events = Events(x.astype(place, copy=False), y.astype(place, copy=False), t, p)
        return Compensated(events, flags[0]) if flags else events

    def _hello(self, held: bytearray) -> Hello:
        try:
            fields = read_fields(held)
            width, height = fields["width"], fields["height"]
            camera = read_camera(fields["camera"], "its hello's camera") if fields.get("camera") else None
            prism = read_prism(fields["prism"], "its hello's prism") if fields.get("prism") else None
        except AmiwarpError as error:
            raise self._wrong(f"{error}") from error
        if camera is not None and (camera.width, camera.height) != (width, height):
            raise self._wrong(f"its hello has a camera of {camera.width}x{camera.height} for {width}x{height} pixels")
        return Hello(width, height, camera, prism)

    def _wrong(self, what: str) -> AmiwarpError:
        return AmiwarpError(f"{self._where}: packet at byte {self._at}: {what}; see docs/stream-format.md")


class EventSorter:
    """Puts events in order across packets: each comes out once, and none is earlier than those that came out before.

    As long as all come in order, they pass at once and untouched. From an event on that is earlier than those of a
    packet before, events are held back for as long as that one was late (at most ``most_us`` of their time, and
    ``most`` of them), until a second of their time has gone by without another. One that is too late even so comes out
    with the next, its time raised to the last that came out, and is counted in :attr:`late`.
    """

    CALM_US = 1_000_000

    def __init__(self, *, most_us: int = 10_000, most: int = 1 << 18) -> None:
        self._most_us, self._most = most_us, most
        self._hold_us = 0
        self._given = self._newest = -(1 << 62)
        self._disorder_at = 0
        self._held: Events | None = None
        self.late = 0
        """Events whose time was raised."""

    def put(self, events: Events) -> Events:
        """Events of a packet, and held ones, whose turn it is."""
        t = events.t
        if not len(events):
            return events
        if not self._hold_us and t[0] >= self._given and not (t[1:] < t[:-1]).any():
            self._given = self._newest = int(t[-1])
            return events
        behind = self._newest - int(t.min())
        self._newest = max(self._newest, int(t.max()))
        if behind > 0:
            self._hold_us, self._disorder_at = max(self._hold_us, min(behind, self._most_us)), self._newest
        elif self._newest - self._disorder_at > self.CALM_US:
            self._hold_us = 0
        return self._out(events, self._newest - self._hold_us)

    def flush(self) -> Events:
        """All that is still held."""
        return self._out(Events.empty(), self._newest)

    def _out(self, events: Events, until: int) -> Events:
        joined = events if self._held is None else Events.concatenate([self._held, events])
        joined = joined[np.argsort(joined.t, kind="stable")]
        late = int(np.searchsorted(joined.t, self._given))
        if late:
            self.late += late
            t = joined.t.copy()
            t[:late] = self._given
            joined = Events(joined.x, joined.y, t, joined.p)
        count = max(int(np.searchsorted(joined.t, until, "right")), len(joined) - self._most)
        out, held = joined[:count], joined[count:]
        self._held = held if len(held) else None
        self._given = int(out.t[-1]) if len(out) else self._given
        return out
