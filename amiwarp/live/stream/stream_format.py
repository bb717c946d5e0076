"""Messages of a live stream, encoded as in ``docs/reference/stream-format.md``."""

import io
import itertools
import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events
from amiwarp.imaging.tensor_stream import StreamTensor
from amiwarp.io.native.attributes import (
    camera_attributes,
    prism_attributes,
    read_camera,
    read_prism,
)
from amiwarp.live.stream.hello_fields import read_fields
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism

MAGIC = b"AMIS"
VERSION = 1
MOST = 1 << 18
"""Largest number of rows (events, triggers or samples) in an encoded packet."""
LONGEST_HELLO = 1 << 16
"""Largest payload of a hello packet [bytes]."""
HEADER = struct.Struct("<4sBBHIII")
"""Header of an encoded packet: magic, version, kind, 0, number of rows, payload size [bytes], CRC-32 of the payload."""
HELLO, EVENTS, COMPENSATED, TRIGGERS, ENCODER, END, SECOND_ENCODER, TENSOR = range(1, 9)
"""Kinds of encoded packets, as numbers in the header."""
COLUMNS: Mapping[int, tuple[str, ...]] = {
    EVENTS: ("<i8", "<u2", "<u2", "u1"),
    COMPENSATED: ("<i8", "<f4", "<f4", "u1", "u1"),
    TRIGGERS: ("<i8",),
    ENCODER: ("<i8", "<f8"),
    SECOND_ENCODER: ("<i8", "<f8"),
}
"""Data types of the columns of an encoded packet, by the packet's kind."""
LONGEST_TENSOR = 1 << 28
"""Largest payload of a packet with a tensor [bytes]."""
TENSOR_TIMES = struct.Struct("<qqQ")
"""Beginning of the payload of a tensor: start and end of its window [us], and number of events. An array as in a file
``.npy`` follows."""
SIZES = {kind: tuple(np.dtype(column).itemsize for column in COLUMNS[kind]) for kind in COLUMNS}
"""Sizes of a row in the columns of an encoded packet [bytes], by the packet's kind."""
LONGEST_ROW = 19
"""Largest size of a row of a packet of an unknown kind [bytes]."""


@dataclass(frozen=True, slots=True)
class Hello:
    """First message of a stream: size of the sensor [px], optionally camera and prism, and the number of encoders."""

    width: int
    height: int
    camera: Camera | None = None
    prism: NominalPrism | None = None
    encoders: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class Triggers:
    """Message: rising edges at the camera's trigger input."""

    t: NDArray[np.int64]
    """Times of the edges on the camera's clock [us], shape ``(n,)``."""


@dataclass(frozen=True, slots=True, eq=False)
class EncoderSamples:
    """Message: encoder samples on the events' clock."""

    t: NDArray[np.int64]
    """Times of the samples [us], shape ``(n,)``."""
    angle: NDArray[np.float64]
    """Unwrapped prism angles [rad], shape ``(n,)``."""
    second: bool = False
    """Whether the second encoder took the samples."""


@dataclass(frozen=True, slots=True)
class End:
    """Message: end of a complete stream."""


Message: TypeAlias = Hello | Events | Compensated | Triggers | EncoderSamples | End


def encode_hello(
    width: int,
    height: int,
    camera: Camera | None = None,
    prism: NominalPrism | None = None,
    encoders: int = 1,
) -> bytes:
    """Encode the first packet of a stream. ``encoders``: number of encoders whose samples the stream carries."""
    fields: dict[str, Any] = {"width": width, "height": height}
    if camera is not None:
        fields["camera"] = camera_attributes(camera)
    if prism is not None:
        fields["prism"] = prism_attributes(prism)
    if encoders == 2:
        fields["encoders"] = 2
    return _pack(HELLO, 0, json.dumps(fields).encode())


def encode_events(events: Events) -> bytes:
    """Encode a sensor's events; more than :data:`MOST` of them as several packets."""
    return _pack_columns(EVENTS, events.t, events.x, events.y, events.p)


def encode_compensated(events: Events, flags: NDArray[np.uint8]) -> bytes:
    """Encode compensated events with their flags, shape ``(n,)``, see :mod:`amiwarp.compensation.streams`."""
    return _pack_columns(COMPENSATED, events.t, events.x, events.y, events.p, flags)


def encode_triggers(t_us: NDArray[np.int64]) -> bytes:
    """Encode rising edges at the camera's trigger input [us]."""
    return _pack_columns(TRIGGERS, t_us)


def encode_encoder(
    t_us: NDArray[np.int64], angle: NDArray[np.float64], *, second: bool = False
) -> bytes:
    """Encode samples of the first or second encoder: times on the events' clock [us], unwrapped angles [rad]."""
    return _pack_columns(SECOND_ENCODER if second else ENCODER, t_us, angle)


def encode_tensor(found: StreamTensor) -> bytes:
    """Encode a tensor of a window. Raises :class:`AmiwarpError` for one of more than :data:`LONGEST_TENSOR` bytes."""
    file = io.BytesIO()
    file.write(TENSOR_TIMES.pack(found.t_start, found.t_end, found.events))
    np.lib.format.write_array(file, np.asarray(found.tensor), allow_pickle=False)
    payload = file.getvalue()
    if len(payload) > LONGEST_TENSOR:
        raise AmiwarpError(
            f"a tensor has {len(payload):,} bytes, more than the {LONGEST_TENSOR:,} of a packet; give fewer bins"
        )
    return _pack(TENSOR, 1, payload)


def encode_end() -> bytes:
    """Encode the last packet of a stream."""
    return _pack(END, 0, b"")


def _pack_columns(kind: int, *columns: NDArray[Any]) -> bytes:
    out = []
    for start in range(0, columns[0].size, MOST):
        parts = (column[start : start + MOST] for column in columns)
        payload = b"".join(
            part.astype(dtype, "C").tobytes()
            for part, dtype in zip(parts, COLUMNS[kind], strict=True)
        )
        out.append(_pack(kind, min(MOST, columns[0].size - start), payload))
    return b"".join(out)


def _pack(kind: int, count: int, payload: bytes) -> bytes:
    return HEADER.pack(MAGIC, VERSION, kind, 0, count, len(payload), zlib.crc32(payload)) + payload


def packet_count(data: bytes) -> int:
    """Return the number of packets in encoded data, which ends with a complete packet."""
    return sum(1 for _ in _packets(data))


def split_packets(data: bytes, most_bytes: int) -> Iterator[bytes | memoryview]:
    """Yield the packets of encoded data, each of at most ``most_bytes``: the rows of a longer one in several packets.

    Raises :class:`AmiwarpError` if the hello packet is longer.
    """
    for kind, count, packet in _packets(data):
        if len(packet) <= most_bytes:
            yield packet
            continue
        if kind not in COLUMNS:
            what = "a tensor" if kind == TENSOR else "the hello packet"
            raise AmiwarpError(
                f"{what} has {len(packet):,} bytes, at most {most_bytes:,} fit; send it over tcp: or unix:"
            )
        columns = _columns(kind, packet)
        rows = (most_bytes - HEADER.size) // _row_bytes(kind)
        for first in range(0, count, rows):
            stop = min(first + rows, count)
            payload = b"".join(
                column[first * size : stop * size]
                for column, size in zip(columns, SIZES[kind], strict=True)
            )
            yield _pack(kind, stop - first, payload)


def join_packets(packets: Iterable[bytes | memoryview]) -> Iterator[bytes]:
    """Yield packets with the same rows as ``packets``: neighbours of the same kind as one, if it has columns."""
    for kind, group in itertools.groupby(packets, kind_of):
        neighbours = list(group)
        if kind not in COLUMNS or len(neighbours) == 1:
            yield from map(bytes, neighbours)
            continue
        columns = [_columns(kind, packet) for packet in neighbours]
        payload = b"".join(itertools.chain.from_iterable(zip(*columns, strict=True)))
        yield _pack(kind, len(payload) // sum(SIZES[kind]), payload)


def _packets(data: bytes) -> Iterator[tuple[int, int, memoryview]]:
    """Yield kind, number of rows and bytes of each packet in encoded data."""
    view = memoryview(data)
    start = 0
    while start < len(view):
        _, _, kind, _, count, payload_bytes, _ = HEADER.unpack_from(view, start)
        stop = start + HEADER.size + payload_bytes
        yield kind, count, view[start:stop]
        start = stop


def _columns(kind: int, packet: bytes | memoryview) -> list[memoryview]:
    """Return the bytes of each column of a packet."""
    view = memoryview(packet)
    count = (len(view) - HEADER.size) // sum(SIZES[kind])
    start = HEADER.size
    columns = []
    for size in SIZES[kind]:
        columns.append(view[start : start + count * size])
        start += count * size
    return columns


def is_packet(data: bytes | memoryview) -> bool:
    """Return whether ``data`` has the length of one packet and begins like one."""
    if len(data) < HEADER.size:
        return False
    magic, version, _, _, _, payload_bytes, _ = HEADER.unpack_from(data)
    return bool((magic, version, len(data)) == (MAGIC, VERSION, HEADER.size + payload_bytes))


def kind_of(packet: bytes | memoryview) -> int:
    """Return the kind in the header of a packet."""
    return int(HEADER.unpack_from(packet)[2])


def checksum_of(packet: bytes | memoryview) -> int:
    """Return the checksum in the header of a packet."""
    return int(HEADER.unpack_from(packet)[-1])


def checksum_fits(packet: bytes, checksum: int) -> bool:
    """Return whether a packet's header has a checksum, and its payload too."""
    return checksum_of(packet) == checksum == zlib.crc32(memoryview(packet)[HEADER.size :])


def _row_bytes(kind: int) -> int:
    """Return the size of a row of a packet [bytes]; 0 for a kind without rows."""
    return sum(SIZES.get(kind, ()))


class PacketDecoder:
    """Decodes the bytes of a stream into messages; buffers at most one packet.

    Packets of unknown kinds are skipped. An invalid packet raises :class:`AmiwarpError` with the stream's name
    ``where`` and the offset of the packet, after all earlier messages were returned.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._offset = 0
        self._header: tuple[int, int, int] | None = None
        self._buffer = bytearray(HEADER.size)
        self._filled = 0

    @property
    def unfinished_at(self) -> int | None:
        """Offset of the packet that is still incomplete [bytes]; None between packets."""
        return self._offset if self._filled or self._header is not None else None

    def free_buffer(self) -> memoryview:
        """Return the memory for the next bytes: not empty, at most to the end of the packet.

        Then call :meth:`commit`.
        """
        return memoryview(self._buffer)[self._filled :]

    def commit(self, count: int) -> Message | None:
        """Process ``count`` bytes that were written to :meth:`free_buffer`; return the message that they complete."""
        self._filled += count
        if self._filled < len(self._buffer):
            return None
        buffer = self._buffer
        self._filled = 0
        if self._header is None:
            self._header = self._read_header(buffer)
            _, length, _ = self._header
            self._buffer = bytearray(length)
            if length:
                return None
            buffer = self._buffer
        kind, length, check = self._header
        self._header = None
        self._buffer = bytearray(HEADER.size)
        if zlib.crc32(buffer) != check:
            raise self._error(f"the checksum of its {length} bytes is wrong")
        message = self._message(kind, buffer)
        self._offset += HEADER.size + length
        return message

    def feed(self, data: bytes) -> Iterator[Message]:
        """Decode the bytes ``data``, and yield the messages that they complete."""
        start = 0
        while start < len(data):
            free_buffer = self.free_buffer()
            count = min(len(free_buffer), len(data) - start)
            free_buffer[:count] = data[start : start + count]
            start += count
            message = self.commit(count)
            if message is not None:
                yield message

    def _read_header(self, buffer: bytearray) -> tuple[int, int, int]:
        """Check a packet's header; return kind, payload size and checksum."""
        magic, version, kind, _, count, length, check = HEADER.unpack(buffer)
        if magic != MAGIC:
            raise self._error(f"it begins with {bytes(magic)!r}, not {MAGIC!r}")
        if version != VERSION:
            raise self._error(f"it is of version {version}, not {VERSION}")
        row = _row_bytes(kind)
        longest = MOST * (row or LONGEST_ROW)
        if kind in (HELLO, END):
            longest = LONGEST_HELLO
        elif kind == TENSOR:
            longest = LONGEST_TENSOR
        if length > longest or (row and length != count * row):
            raise self._error(
                f"it has {count} rows in {length} bytes; expected up to {longest} bytes, {row} per row"
            )
        return kind, length, check

    def _message(self, kind: int, buffer: bytearray) -> Message | None:
        if kind == HELLO:
            return self._hello(buffer)
        if kind == END:
            return End()
        if kind not in COLUMNS:
            return None
        count = len(buffer) // _row_bytes(kind)
        start = 0
        columns = []
        for column in COLUMNS[kind]:
            columns.append(np.frombuffer(buffer, column, count, start))
            start += columns[-1].nbytes
        t = columns[0].astype(np.int64, copy=False)
        if kind == TRIGGERS:
            return Triggers(t)
        if kind in (ENCODER, SECOND_ENCODER):
            angle = columns[1].astype(np.float64, copy=False)
            return EncoderSamples(t, angle, kind == SECOND_ENCODER)
        _, x, y, p, *flags = columns
        pixel_type = np.float32 if flags else np.uint16
        events = Events(x.astype(pixel_type, copy=False), y.astype(pixel_type, copy=False), t, p)
        return Compensated(events, flags[0]) if flags else events

    def _hello(self, buffer: bytearray) -> Hello:
        try:
            fields = read_fields(buffer)
            camera = None
            prism = None
            if fields.get("camera"):
                camera = read_camera(fields["camera"], "its hello's camera")
            if fields.get("prism"):
                prism = read_prism(fields["prism"], "its hello's prism")
        except AmiwarpError as error:
            raise self._error(f"{error}") from error
        width = fields["width"]
        height = fields["height"]
        if camera is not None and (camera.width, camera.height) != (width, height):
            raise self._error(
                f"its hello has a camera of {camera.width}x{camera.height} for {width}x{height} pixels"
            )
        return Hello(width, height, camera, prism, fields.get("encoders", 1))

    def _error(self, what: str) -> AmiwarpError:
        return AmiwarpError(
            f"{self._where}: packet at byte {self._offset}: {what}; see docs/reference/stream-format.md",
            ErrorCode.FILE_DAMAGED,
        )
