"""Packets of a live stream: in memory, and encoded as in ``docs/reference/stream-format.md``."""

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, held_bytes
from amiwarp.io.native_format import camera_attributes, prism_attributes, read_camera, read_prism
from amiwarp.optics.camera import LARGEST_SIZE, Camera
from amiwarp.optics.prism import NominalPrism

# Validation of the JSON of a hello message, the first message of a stream.
#
# Its sender is not trusted, so every field is checked.

LARGEST = 1e9
"""Largest accepted absolute value of all numbers other than sizes."""
MOST_COEFFICIENTS = 8
"""Largest accepted number of distortion coefficients."""
SHOWN = 60
"""Largest number of characters of a wrong value that are shown in a message."""


def read_fields(payload: bytes | bytearray) -> dict[str, Any]:
    """Return the fields of a hello message; the known fields are checked for type and range.

    Raises :class:`AmiwarpError` for text that is not JSON or too deeply nested, and for missing or wrong fields.
    """
    try:
        fields = json.loads(payload, parse_constant=_refuse)
    except RecursionError as error:
        raise AmiwarpError(
            "its hello message is nested too deeply; send one JSON object with 'camera' and 'prism' in it"
        ) from error
    except ValueError as error:
        raise AmiwarpError(f"its hello message is not JSON: {error}; send one JSON object") from error
    _check_object("its hello", fields)
    _check_size("its hello", fields)
    for name in ("camera", "prism", "encoders"):
        if fields.get(name) is None:
            fields.pop(name, None)
    if fields.get("encoders", 1) not in (1, 2) or isinstance(fields.get("encoders"), bool | float):
        _raise_wrong("its hello", "encoders", fields["encoders"], "1 or 2, the number of encoders")
    if "camera" in fields:
        _check_camera("its hello's camera", fields["camera"])
    if "prism" in fields:
        _check_prism("its hello's prism", fields["prism"])
    return fields


def _check_camera(where: str, fields: Any) -> None:
    _check_object(where, fields)
    _check_size(where, fields)
    _check_numbers(where, fields, "fx", "fy", "cx", "cy")
    _check_words(where, fields, "distortion_model")
    given = fields.get("distortion", [])
    if not isinstance(given, list) or len(given) > MOST_COEFFICIENTS or not all(map(_is_number, given)):
        _raise_wrong(where, "distortion", given, f"a list of up to {MOST_COEFFICIENTS} numbers")


def _check_prism(where: str, fields: Any) -> None:
    _check_object(where, fields)
    sizes = ("thickness", "tilt") if "thickness" in fields else ("apex",)
    seconds = ("second_apex", "second_index") if "second_apex" in fields else ()
    _check_numbers(where, fields, *sizes, "index", *seconds)
    _check_words(where, fields, "flat_side", "second_flat_side")


def _check_object(where: str, fields: Any) -> None:
    if not isinstance(fields, dict):
        raise AmiwarpError(f"{where} is {_shown(fields)}; expected an object of attributes")


def _check_size(where: str, fields: dict[str, Any]) -> None:
    for name in ("width", "height"):
        value = fields.get(name)
        if isinstance(value, bool) or not isinstance(value, int):
            _raise_wrong(where, name, value, f"a whole number of pixels, 1 .. {LARGEST_SIZE}")
    width, height = fields["width"], fields["height"]
    if not (1 <= width <= LARGEST_SIZE and 1 <= height <= LARGEST_SIZE):
        size = f"{_shown(width)}x{_shown(height)}"
        raise AmiwarpError(f"{where} has a size of {size}; expected 1 .. {LARGEST_SIZE} pixels each way")


def _check_numbers(where: str, fields: dict[str, Any], *names: str) -> None:
    for name in names:
        if not _is_number(fields.get(name)):
            _raise_wrong(where, name, fields.get(name), f"a number up to {LARGEST:g}")


def _check_words(where: str, fields: dict[str, Any], *names: str) -> None:
    for name in names:
        value = fields.get(name, "")
        if not isinstance(value, str) or len(value) > SHOWN or not value.isprintable():
            _raise_wrong(where, name, value, "a word")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a JSON number")


def _raise_wrong(where: str, name: str, value: Any, expected: str) -> NoReturn:
    if value is None:
        raise AmiwarpError(f"{where} has no attribute '{name}'; add this attribute: {expected}")
    raise AmiwarpError(f"{where} attribute '{name}' is {_shown(value)}; expected {expected}")


def _shown(value: Any) -> str:
    """Return the value as JSON text, shortened if it is long."""
    try:
        text = json.dumps(value)
    except RecursionError:
        return "nested too deeply"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


MAGIC = b"AMIS"
VERSION = 1
MOST = 1 << 18
"""Largest number of rows (events, triggers or samples) in an encoded packet."""
LONGEST_HELLO = 1 << 16
"""Largest payload of a hello packet [bytes]."""
HEADER = struct.Struct("<4sBBHIII")
"""Header of an encoded packet: magic, version, kind, 0, number of rows, payload size [bytes], CRC-32 of the payload."""
HELLO, EVENTS, COMPENSATED, TRIGGERS, ENCODER, END, SECOND_ENCODER = range(1, 8)
"""Kinds of encoded packets, as numbers in the header."""
COLUMNS: Mapping[int, tuple[str, ...]] = {
    EVENTS: ("<i8", "<u2", "<u2", "u1"),
    COMPENSATED: ("<i8", "<f4", "<f4", "u1", "u1"),
    TRIGGERS: ("<i8",),
    ENCODER: ("<i8", "<f8"),
    SECOND_ENCODER: ("<i8", "<f8"),
}
"""Data types of the columns of an encoded packet, by the packet's kind."""


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """Data that a source delivers in one step. Any part may be empty."""

    events: Events
    """Events with uint16 pixels, on the camera's clock."""
    triggers: NDArray[np.int64]
    """Rising edges at the camera's trigger input, on the camera's clock [us], shape ``(n,)``."""
    encoder_t: NDArray[np.int64]
    """Times of encoder samples that came in a file or stream, on the events' clock [us], shape ``(m,)``."""
    encoder_angle: NDArray[np.float64]
    """Unwrapped prism angles of the encoder samples [rad], shape ``(m,)``."""
    second_t: NDArray[np.int64]
    """The same times of the second encoder, of the second prism of a pair or the second tilt of a mirror [us]."""
    second_angle: NDArray[np.float64]
    """The angles of these samples [rad]."""
    arrived_us: int
    """Time at which the packet arrived, on the host's monotonic clock [us]."""
    returned: bool = False
    """Whether this is the first packet after a lost sender returned, see :class:`ReturningSource`."""

    @property
    def held_bytes(self) -> int:
        """Memory of the packet [bytes], see :func:`~amiwarp.events.recording.held_bytes`."""
        samples = (self.triggers, self.encoder_t, self.encoder_angle, self.second_t, self.second_angle)
        return held_bytes(self.events) + sum(column.nbytes for column in samples)

    @property
    def empty(self) -> bool:
        """Whether the packet carries no events, triggers or samples."""
        samples = self.triggers.size or self.encoder_t.size or self.second_t.size
        return not (len(self.events) or samples or self.returned)


IDLE_S = 0.05
"""Longest time without a packet from a source [s]. After this time, it delivers an empty packet."""
NO_TIMES = np.zeros(0, np.int64)
"""Empty array of times, for packets without triggers or encoder samples."""
NO_ANGLES = np.zeros(0)
"""Empty array of angles, for packets without encoder samples."""


def make_packet(
    arrived_us: int,
    events: Events | None = None,
    triggers: NDArray[np.int64] = NO_TIMES,
    encoder_t: NDArray[np.int64] = NO_TIMES,
    encoder_angle: NDArray[np.float64] = NO_ANGLES,
    second_t: NDArray[np.int64] = NO_TIMES,
    second_angle: NDArray[np.float64] = NO_ANGLES,
) -> Packet:
    """Build a packet from the given parts; parts that are not given are empty."""
    events = Events.empty() if events is None else events
    return Packet(events, triggers, encoder_t, encoder_angle, second_t, second_angle, arrived_us)


class Source(Protocol):
    """Source of live events (protocol)."""

    size: tuple[int, int]
    """Width and height of the sensor [px]."""
    camera: Camera | None
    """Camera intrinsics; None if the source does not know them."""
    prism: NominalPrism | None
    """Prism of the camera; None if the source does not know it."""
    encoders: int
    """Number of encoders whose samples the source may deliver: 0, 1, or 2 for a pair of prisms and for a mirror."""
    name: str
    """Name of the source in messages."""

    def packets(self) -> Iterator[Packet]:
        """Yield packets until the stream ends; while nothing arrives, an empty packet at least every 50 ms."""

    def close(self) -> None:
        """Release the device, file or connection."""


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
    """Whether the samples are those of the second encoder."""


@dataclass(frozen=True, slots=True)
class End:
    """Message: end of a complete stream."""


Message: TypeAlias = Hello | Events | Compensated | Triggers | EncoderSamples | End


def encode_hello(
    width: int, height: int, camera: Camera | None = None, prism: NominalPrism | None = None, encoders: int = 1
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


def encode_encoder(t_us: NDArray[np.int64], angle: NDArray[np.float64], *, second: bool = False) -> bytes:
    """Encode samples of the first or second encoder: times on the events' clock [us], unwrapped angles [rad]."""
    return _pack_columns(SECOND_ENCODER if second else ENCODER, t_us, angle)


def encode_end() -> bytes:
    """Encode the last packet of a stream."""
    return _pack(END, 0, b"")


def _pack_columns(kind: int, *columns: NDArray[Any]) -> bytes:
    out = []
    for start in range(0, columns[0].size, MOST):
        parts = (column[start : start + MOST] for column in columns)
        payload = b"".join(part.astype(dtype, "C").tobytes() for part, dtype in zip(parts, COLUMNS[kind], strict=True))
        out.append(_pack(kind, min(MOST, columns[0].size - start), payload))
    return b"".join(out)


def _pack(kind: int, count: int, payload: bytes) -> bytes:
    return HEADER.pack(MAGIC, VERSION, kind, 0, count, len(payload), zlib.crc32(payload)) + payload


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
        buffer, self._filled = self._buffer, 0
        if self._header is None:
            self._header = self._read_header(buffer)
            self._buffer = bytearray(self._header[1])
            if self._header[1]:
                return None
            buffer = self._buffer
        kind, length, check = self._header
        self._header, self._buffer = None, bytearray(HEADER.size)
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
        row = sum(np.dtype(column).itemsize for column in COLUMNS.get(kind, ()))
        longest = LONGEST_HELLO if kind in (HELLO, END) else MOST * row if row else MOST * 19
        if length > longest or (row and length != count * row):
            raise self._error(f"it has {count} rows in {length} bytes; expected up to {longest} bytes, {row} per row")
        return kind, length, check

    def _message(self, kind: int, buffer: bytearray) -> Message | None:
        if kind == HELLO:
            return self._hello(buffer)
        if kind == END:
            return End()
        if kind not in COLUMNS:
            return None
        count, start, columns = len(buffer) // sum(np.dtype(c).itemsize for c in COLUMNS[kind]), 0, []
        for column in COLUMNS[kind]:
            columns.append(np.frombuffer(buffer, column, count, start))
            start += columns[-1].nbytes
        t = columns[0].astype(np.int64, copy=False)
        if kind == TRIGGERS:
            return Triggers(t)
        if kind in (ENCODER, SECOND_ENCODER):
            return EncoderSamples(t, columns[1].astype(np.float64, copy=False), kind == SECOND_ENCODER)
        _, x, y, p, *flags = columns
        pixel_type = np.float32 if flags else np.uint16
        events = Events(x.astype(pixel_type, copy=False), y.astype(pixel_type, copy=False), t, p)
        return Compensated(events, flags[0]) if flags else events

    def _hello(self, buffer: bytearray) -> Hello:
        try:
            fields = read_fields(buffer)
            width, height = fields["width"], fields["height"]
            camera = read_camera(fields["camera"], "its hello's camera") if fields.get("camera") else None
            prism = read_prism(fields["prism"], "its hello's prism") if fields.get("prism") else None
        except AmiwarpError as error:
            raise self._error(f"{error}") from error
        if camera is not None and (camera.width, camera.height) != (width, height):
            raise self._error(f"its hello has a camera of {camera.width}x{camera.height} for {width}x{height} pixels")
        return Hello(width, height, camera, prism, fields.get("encoders", 1))

    def _error(self, what: str) -> AmiwarpError:
        return AmiwarpError(
            f"{self._where}: packet at byte {self._offset}: {what}; see docs/reference/stream-format.md"
        )
