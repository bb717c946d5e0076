"""What travels over the serial port: frames, messages and their check; ``docs/link-protocol.md`` says it for firmware.

A frame is a packet in COBS, closed by a zero. A packet is version, type, sequence number, payload and CRC-32, all
numbers little endian. A controller that cannot do that may send lines ``t_us,count``.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from typing import ClassVar

VERSION = 1
LONGEST = 512
"""Bytes of a frame, zero included: more without one is garbage."""
MOST_SAMPLES = 32
STATES = ("stopped", "at speed", "on the way to its speed", "fault")
"""What :attr:`Status.state` counts."""
FAULTS = ("stall", "over-current", "encoder lost", "index missed", "host lost")
"""The bits of :attr:`Status.faults`, from the lowest."""
REFUSALS = ("accepted", "unknown to it", "out of its range", "not possible now")
"""What :attr:`Answer.refused` counts."""
_HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
_SAMPLE = struct.Struct("<Ii")
_LINE = re.compile(rb"(\d{1,10}),(-?\d{1,10})\r?")


@dataclass(frozen=True, slots=True)
class Samples:
    """Encoder counts at times of the controller's clock."""

    KIND: ClassVar[int] = 0x01
    t_us: tuple[int, ...]
    """Wraps at 2**32."""
    count: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Index:
    """The index pulse, once a turn."""

    KIND: ClassVar[int] = 0x02
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Ii")
    t_us: int
    count: int


@dataclass(frozen=True, slots=True)
class Sync:
    """A pulse that the camera records as a trigger event too."""

    KIND: ClassVar[int] = 0x03
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<II")
    t_us: int
    number: int
    """Counts from 0."""


@dataclass(frozen=True, slots=True)
class Status:
    """State of the motor, at least once a second."""

    KIND: ClassVar[int] = 0x04
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IBHffI")
    t_us: int
    state: int
    """Of :data:`STATES`."""
    faults: int
    """Bits of :data:`FAULTS`."""
    rpm: float
    target_rpm: float
    counts_per_turn: int


@dataclass(frozen=True, slots=True)
class Pong:
    """The answer to a :class:`Ping`."""

    KIND: ClassVar[int] = 0x05
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<II")
    number: int
    t_us: int


@dataclass(frozen=True, slots=True)
class Answer:
    """Whether a command was accepted."""

    KIND: ClassVar[int] = 0x06
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<HB")
    sequence: int
    """Of the command."""
    refused: int
    """Of :data:`REFUSALS`: 0 is accepted."""


@dataclass(frozen=True, slots=True)
class SetSpeed:
    """Turn at a speed, negative backwards."""

    KIND: ClassVar[int] = 0x81
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<ff")
    rpm: float
    ramp: float
    """[rpm/s]"""


@dataclass(frozen=True, slots=True)
class Stop:
    """Come to rest."""

    KIND: ClassVar[int] = 0x82
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<")


@dataclass(frozen=True, slots=True)
class SetCounts:
    """Counts of the encoder in a turn."""

    KIND: ClassVar[int] = 0x83
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<I")
    per_turn: int


@dataclass(frozen=True, slots=True)
class Ping:
    """Asks for a :class:`Pong`."""

    KIND: ClassVar[int] = 0x84
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<I")
    number: int


Plain = Index | Sync | Status | Pong | Answer | SetSpeed | Stop | SetCounts | Ping
Message = Samples | Plain
_PLAIN: dict[int, type[Plain]] = {
    m.KIND: m for m in (Index, Sync, Status, Pong, Answer, SetSpeed, Stop, SetCounts, Ping)
}


def encode(message: Message, sequence: int) -> bytes:
    """A message as a frame. Raises ValueError for numbers that do not fit, or more than :data:`MOST_SAMPLES`."""
    from cobs import cobs

    if isinstance(message, Samples):
        if not 0 < len(message.t_us) == len(message.count) <= MOST_SAMPLES:
            raise ValueError(f"{len(message.t_us)} times and {len(message.count)} counts; send 1 to {MOST_SAMPLES}")
        fields = zip(message.t_us, message.count, strict=True)
    try:
        if isinstance(message, Samples):
            payload = b"".join(_SAMPLE.pack(*pair) for pair in fields)
        else:
            payload = message.LAYOUT.pack(*astuple(message))
        packet = _HEADER.pack(VERSION, message.KIND, sequence & 0xFFFF) + payload
    except struct.error as error:
        raise ValueError(f"{message}: {error}") from error
    return bytes(cobs.encode(packet + _CRC.pack(zlib.crc32(packet)))) + b"\0"


@dataclass(slots=True)
class Received:
    """What a decoder has met."""

    frames: int = 0
    """Whole, with the right check."""
    damaged: int = 0
    """No COBS, too short or long, or the wrong check."""
    unknown: int = 0
    """Of another version or type, or a payload that does not fit it."""
    lost: int = 0
    """Frames whose numbers are missing."""
    restarts: int = 0
    """Numbers that went backwards: the controller was reset."""
    lines: int = 0
    """Of text that were samples."""


class Decoder:
    """Bytes as they come to messages: frames, or lines of text where the first whole line is one.

    Never raises for bytes of any kind, holds :data:`LONGEST` of them at most, and finds the next frame after garbage.
    """

    def __init__(self) -> None:
        self.received = Received()
        self._held = bytearray()
        self._next: int | None = None
        self._text: bool | None = None
        self._whole = False  # what came before the first end of a line may be its rest

    def feed(self, data: bytes) -> list[tuple[int | None, Message]]:
        """Messages that ``data`` completes, each with its sequence number; None for a line of text."""
        out: list[tuple[int | None, Message]] = []
        for byte in data:
            if byte == 0 and self._text is not True:
                out += self._frame()
            elif byte == 0x0A and self._text is not False:
                out += self._line(byte)
            else:
                self._hold(byte)
        return out

    def _hold(self, byte: int) -> None:
        self._held.append(byte)
        if len(self._held) > LONGEST:
            self.received.damaged += 1
            self._held.clear()

    def _frame(self) -> Iterator[tuple[int, Message]]:
        held = bytes(self._held)
        self._held.clear()
        if not held:
            return  # a second zero is no frame
        packet = _checked(held)
        if packet is None:
            self.received.damaged += 1
            return
        version, kind, sequence = _HEADER.unpack_from(packet)
        message = _message(kind, packet[_HEADER.size :]) if version == VERSION else None
        self._text = False
        gap = 0 if self._next is None else (sequence - self._next) & 0xFFFF
        self.received.restarts += gap >= 1 << 15
        self.received.lost += gap if gap < 1 << 15 else 0
        self._next = (sequence + 1) & 0xFFFF
        if message is None:
            self.received.unknown += 1
            return
        self.received.frames += 1
        yield sequence, message

    def _line(self, byte: int) -> Iterator[tuple[None, Message]]:
        match = _LINE.fullmatch(bytes(self._held).lstrip(b"\n")) if self._whole or self._text else None
        t, count = (int(match[1]), int(match[2])) if match else (1 << 32, 0)
        if t < 1 << 32 and -(1 << 31) <= count < 1 << 31:
            self._text = True
            self._held.clear()
            self.received.lines += 1
            yield None, Samples((t,), (count,))
        elif self._text:
            self.received.damaged += 1
            self._held.clear()
        elif self._held and all(32 <= b < 127 or b in b"\r\n\t" for b in self._held):
            self._held.clear()  # a heading, or the rest of a first line
            self._whole = True
        else:
            self._hold(byte)  # inside a frame, or its first byte


def _checked(held: bytes) -> bytes | None:
    """The packet without its check, or None."""
    from cobs import cobs

    try:
        packet = bytes(cobs.decode(held))
    except cobs.DecodeError:
        return None
    body, check = packet[: -_CRC.size], packet[-_CRC.size :]
    if len(body) < _HEADER.size or len(check) < _CRC.size or zlib.crc32(body) != _CRC.unpack(check)[0]:
        return None
    return body


def _message(kind: int, payload: bytes) -> Message | None:
    """None for a kind that is unknown, and for a payload of another length."""
    if kind == Samples.KIND:
        if not payload or len(payload) % _SAMPLE.size or len(payload) > MOST_SAMPLES * _SAMPLE.size:
            return None
        pairs = list(_SAMPLE.iter_unpack(payload))
        return Samples(tuple(t for t, _ in pairs), tuple(c for _, c in pairs))
    found = _PLAIN.get(kind)
    if found is None or len(payload) != found.LAYOUT.size:
        return None
    return found(*found.LAYOUT.unpack(payload))
