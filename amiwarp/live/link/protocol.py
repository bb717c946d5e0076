"""Serial protocol of the controller: messages, frames and their checksum, see ``docs/reference/link-protocol.md``.

A frame is a COBS-encoded packet, closed by a zero byte. A packet is version, type, sequence number, payload and CRC-32,
in little-endian byte order. A simple controller may send text lines ``t_us,count`` instead.
"""

import re
import struct
import typing
import zlib
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from typing import ClassVar

VERSION = 1
LONGEST = 512
"""Longest frame, including the zero byte [bytes]. A longer run of bytes without a zero is discarded as garbage."""
MOST_SAMPLES = 32
"""Largest number of encoder samples in one message."""
PULSE_INTERVAL_MS = 70, 130
"""Shortest and longest interval between two sync pulses [ms]. It is drawn anew for each, so that only one shift between
the clocks fits the pulses that a camera has seen."""
STATES = ("stopped", "at speed", "on the way to its speed", "fault")
"""Meaning of each value of :attr:`ControllerStatus.state`."""
FAULTS = (
    "stall",
    "over-current",
    "encoder lost",
    "index missed",
    "host lost",
    "over-speed",
    "supply lost",
    "magnet lost",
    "undervoltage",
    "overvoltage",
    "stopped for lost host",
)
"""Meaning of each bit of :attr:`ControllerStatus.faults`, lowest bit first."""
REFUSALS = ("accepted", "unknown command", "out of range", "not possible now")
"""Meaning of each value of :attr:`Answer.refused`."""
UNKNOWN_MV = 0xFFFF
"""Value of :attr:`Condition.supply_mv` that means that the controller does not know its supply."""
BOARD_BYTES = 16
"""Size of :attr:`Identity.board` [bytes]."""
STORED = (
    "as built",
    "saved",
    "as built: those saved belong to another build",
    "as built: those saved are damaged",
)
"""Meaning of each value of :attr:`Condition.stored`."""


@dataclass(frozen=True, slots=True)
class SettingRange:
    """Setting of a controller: its name, unit and range."""

    name: str
    """Name, as the command line takes it."""
    unit: str
    """Unit of the value; empty for a pure number."""
    least: int
    """Smallest value."""
    most: int
    """Largest value."""
    off: bool = False
    """Whether 0 is allowed too, and switches the function off."""

    def contains(self, value: int) -> bool:
        """Return whether a value is allowed."""
        return self.least <= value <= self.most or (self.off and value == 0)


SETTINGS = (
    SettingRange("counts-per-turn", "counts", 1, (1 << 24) - 1),
    SettingRange("most-rpm", "rpm", 1, 13_000),
    SettingRange("most-ramp", "rpm/s", 1, 30_000),
    SettingRange("stop-ramp", "rpm/s", 1, 30_000),
    SettingRange("kp", "duty/rpm/256", 0, 1_000_000),
    SettingRange("ki", "duty/rpm/s/256", 0, 1_000_000),
    SettingRange("friction", "duty", 0, 32_767),
    SettingRange("no-load-rpm", "rpm", 1, 30_000),
    SettingRange("rise-ms", "ms", 0, 10_000),
    SettingRange("host-timeout", "s", 1, 3600, off=True),
    SettingRange("undervoltage", "mV", 1000, 60_000, off=True),
    SettingRange("overvoltage", "mV", 1000, 60_000, off=True),
)
"""Settings of a controller; the place of one is its key in the messages."""
_HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
_SAMPLE = struct.Struct("<Ii")
_LINE = re.compile(rb"(\d{1,10}),(-?\d{1,10})\r?")


@dataclass(frozen=True, slots=True)
class Samples:
    """Message: encoder counts with the times at which they were latched."""

    KIND: ClassVar[int] = 0x01
    t_us: tuple[int, ...]
    """Times of the counts on the controller's clock [us], modulo 2**32."""
    count: tuple[int, ...]
    """Encoder counts, wrapped to 32 bits, signed."""


@dataclass(frozen=True, slots=True)
class Index:
    """Message: index pulse of the encoder, which comes once per turn."""

    KIND: ClassVar[int] = 0x02
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Ii")
    t_us: int
    """Time of the pulse on the controller's clock [us], modulo 2**32."""
    count: int
    """Encoder count at the index pulse."""


@dataclass(frozen=True, slots=True)
class Sync:
    """Message: sync pulse that the controller sent to the camera, which records it as a trigger event."""

    KIND: ClassVar[int] = 0x03
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<II")
    t_us: int
    """Time of the pulse on the controller's clock [us], modulo 2**32."""
    number: int
    """Sequence number of the pulse, starting at 0."""


@dataclass(frozen=True, slots=True)
class ControllerStatus:
    """Message: state of the motor. The controller sends it at least once per second."""

    KIND: ClassVar[int] = 0x04
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IBHffI")
    t_us: int
    """Time of the status on the controller's clock [us], modulo 2**32."""
    state: int
    """State of the motor, as an index into :data:`STATES`."""
    faults: int
    """Faults as a bit field; :data:`FAULTS` gives the meaning of the bits."""
    rpm: float
    """Measured speed [turns/min], negative backwards."""
    target_rpm: float
    """Commanded speed [turns/min], negative backwards."""
    counts_per_turn: int
    """Encoder counts per turn; 0 if the controller does not know them."""


@dataclass(frozen=True, slots=True)
class Pong:
    """Message: answer to a :class:`Ping`."""

    KIND: ClassVar[int] = 0x05
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<II")
    number: int
    """Number of the ping that is answered."""
    t_us: int
    """Time of the answer on the controller's clock [us], modulo 2**32."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Message: answer to a command, which the controller accepted or refused."""

    KIND: ClassVar[int] = 0x06
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<HB")
    sequence: int
    """Sequence number of the command that is answered."""
    refused: int
    """Reason for a refusal, as an index into :data:`REFUSALS`; 0 if the command was accepted."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Message: firmware and board, as the answer to an :class:`Ask`."""

    KIND: ClassVar[int] = 0x07
    LAYOUT: ClassVar[struct.Struct] = struct.Struct(f"<BBB{BOARD_BYTES}s")
    major: int
    """First number of the firmware's version."""
    minor: int
    """Second number of the firmware's version."""
    patch: int
    """Third number of the firmware's version."""
    board: bytes
    """Name of the board in ASCII, filled with zeros to :data:`BOARD_BYTES`."""

    @property
    def version(self) -> str:
        """Version of the firmware as text."""
        return f"{self.major}.{self.minor}.{self.patch}"

    @property
    def board_name(self) -> str:
        """Name of the board as text; bytes that are not printable ASCII become '?'."""
        name = self.board.partition(b"\0")[0]
        return "".join(chr(byte) if 32 <= byte < 127 else "?" for byte in name)


@dataclass(frozen=True, slots=True)
class Condition:
    """Message: supply and other values that change, as the answer to an :class:`Ask`."""

    KIND: ClassVar[int] = 0x08
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IHHHB")
    t_us: int
    """Time of the values on the controller's clock [us], modulo 2**32."""
    supply_mv: int
    """Voltage of the motor's supply [mV]; :data:`UNKNOWN_MV` if the controller does not sense it."""
    host_timeout_s: int
    """Silence of the host after which the controller stops the motor [s]; 0: it goes on."""
    host_stops: int
    """Number of times that it stopped the motor for a silent host since its start, 65,535 at most."""
    stored: int
    """Where the settings are from, as an index into :data:`STORED`."""

    @property
    def supply_v(self) -> float | None:
        """Voltage of the motor's supply [V]; None if it is unknown."""
        return None if self.supply_mv == UNKNOWN_MV else self.supply_mv / 1000.0


@dataclass(frozen=True, slots=True)
class Setting:
    """Message: value of a setting, as the answer to an :class:`Ask`."""

    KIND: ClassVar[int] = 0x09
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Bi")
    key: int
    """Which setting, as an index into :data:`SETTINGS`."""
    value: int
    """Its present value, in its unit."""


@dataclass(frozen=True, slots=True)
class SetSpeed:
    """Command to change the motor's speed at a constant rate."""

    KIND: ClassVar[int] = 0x81
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<ff")
    rpm: float
    """Target speed of the motor [turns/min], negative backwards."""
    ramp: float
    """Rate of change of the speed [rpm/s]."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Command to stop the prism's motor."""

    KIND: ClassVar[int] = 0x82
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<")


@dataclass(frozen=True, slots=True)
class SetCounts:
    """Command to set the encoder's counts per turn."""

    KIND: ClassVar[int] = 0x83
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<I")
    per_turn: int
    """Counts of the encoder per turn."""


@dataclass(frozen=True, slots=True)
class Ping:
    """Request for a :class:`Pong`, which relates the controller's clock to the host's."""

    KIND: ClassVar[int] = 0x84
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<I")
    number: int
    """Number of the ping, which the pong repeats."""


@dataclass(frozen=True, slots=True)
class Ask:
    """Request for an :class:`Identity`, a :class:`Condition` or a :class:`Setting`, which comes before its answer."""

    KIND: ClassVar[int] = 0x85
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BB")
    kind: int
    """Type of the message that is wanted."""
    key: int = 0
    """For a setting: which, as an index into :data:`SETTINGS`."""


@dataclass(frozen=True, slots=True)
class SetSetting:
    """Command to change a setting until the next reset, while the prism rests."""

    KIND: ClassVar[int] = 0x86
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Bi")
    key: int
    """Which setting, as an index into :data:`SETTINGS`."""
    value: int
    """Its new value, in its unit."""


@dataclass(frozen=True, slots=True)
class SaveSettings:
    """Command to save the settings where they outlive a reset. It is answered once they are written and read back."""

    KIND: ClassVar[int] = 0x87
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<")


@dataclass(frozen=True, slots=True)
class RestoreSettings:
    """Command to change all settings back to the build's, until the next reset."""

    KIND: ClassVar[int] = 0x88
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<")


Sent = Index | Sync | ControllerStatus | Pong | Answer | Identity | Condition | Setting
Commands = SetSpeed | Stop | SetCounts | Ping | Ask | SetSetting | SaveSettings | RestoreSettings
Plain = Sent | Commands
Message = Samples | Plain
PLAIN: tuple[type[Plain], ...] = (*typing.get_args(Sent), *typing.get_args(Commands))
"""Types of all messages that have a fixed layout, in the order of their numbers."""
_PLAIN: dict[int, type[Plain]] = {m.KIND: m for m in PLAIN}


def encode(message: Message, sequence: int) -> bytes:
    """Encode a message as the bytes of a frame.

    Raises ValueError for numbers outside a field's range, or for other than 1 to :data:`MOST_SAMPLES` samples.
    """
    if isinstance(message, Samples):
        if not 0 < len(message.t_us) == len(message.count) <= MOST_SAMPLES:
            raise ValueError(
                f"{len(message.t_us)} times and {len(message.count)} counts; send 1 to {MOST_SAMPLES} of both"
            )
        fields = zip(message.t_us, message.count, strict=True)
    try:
        if isinstance(message, Samples):
            payload = b"".join(_SAMPLE.pack(*pair) for pair in fields)
        else:
            payload = message.LAYOUT.pack(*astuple(message))
        packet = _HEADER.pack(VERSION, message.KIND, sequence & 0xFFFF) + payload
    except (struct.error, OverflowError) as error:
        raise ValueError(f"{message}: {error}") from error
    return framed(packet)


def framed(packet: bytes) -> bytes:
    """Return the bytes of a frame: the packet with its CRC, encoded without zeros, and a zero."""
    from cobs import cobs

    return bytes(cobs.encode(packet + _CRC.pack(zlib.crc32(packet)))) + b"\0"


@dataclass(slots=True)
class FrameCounters:
    """Statistics of the frames and lines that a :class:`FrameDecoder` received."""

    frames: int = 0
    """Number of complete frames with a valid checksum and a known message."""
    damaged: int = 0
    """Number of frames or lines that were too short, too long, not COBS, or had a wrong checksum."""
    unknown: int = 0
    """Number of frames of another version or an unknown type, or with a payload of the wrong size."""
    lost: int = 0
    """Number of lost frames, from gaps in the sequence numbers."""
    restarts: int = 0
    """Number of sequence numbers that went backwards, which means that the controller was reset."""
    lines: int = 0
    """Number of text lines that contain a sample."""


class FrameDecoder:
    """Decodes bytes into messages: from frames, or from text lines if the first complete unit is a line.

    Accepts any bytes without raising, buffers at most :data:`LONGEST` bytes, and resynchronises at the next frame after
    garbage. ``lines``: whether text lines are understood; a controller does not.
    """

    def __init__(self, *, lines: bool = True) -> None:
        self.received = FrameCounters()
        self._held = bytearray()
        self._too_long = False  # bytes are dropped until the next zero or line end
        self._next: int | None = None
        self._text: bool | None = None if lines else False
        self._whole = False  # the bytes before the first line end may be the rest of a line

    def feed(self, data: bytes) -> list[tuple[int | None, Message]]:
        """Return the messages completed by ``data``, each as a pair of sequence number and message.

        The number is None for a message from a text line.
        """
        return [
            (sequence, message) for sequence, message in self.units(data) if message is not None
        ]

    def units(self, data: bytes) -> list[tuple[int | None, Message | None]]:
        """Return the messages like :meth:`feed`, and None for each frame of an unknown type or of a wrong size."""
        out: list[tuple[int | None, Message | None]] = []
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
        if len(self._held) >= LONGEST:
            self.received.damaged += 1
            self._held.clear()
            self._too_long = True

    def _take_held(self) -> bytes:
        """Return the bytes since the last end of a frame or line, none if they were too many; and begin anew."""
        held = b"" if self._too_long else bytes(self._held)
        self._held.clear()
        self._too_long = False
        return held

    def _frame(self) -> Iterator[tuple[int, Message | None]]:
        held = self._take_held()
        if not held:
            return  # two zero bytes in a row enclose no frame
        packet = _checked(held)
        if packet is None:
            self.received.damaged += 1
            return
        version, kind, sequence = _HEADER.unpack_from(packet)
        known = version == VERSION
        message = _message(kind, packet[_HEADER.size :]) if known else None
        self._text = False
        gap = 0 if self._next is None else (sequence - self._next) & 0xFFFF
        self.received.restarts += gap >= 1 << 15
        self.received.lost += gap if gap < 1 << 15 else 0
        self._next = (sequence + 1) & 0xFFFF
        if message is None:
            self.received.unknown += 1
        else:
            self.received.frames += 1
        if known:
            yield sequence, message

    def _line(self, byte: int) -> Iterator[tuple[None, Message]]:
        if self._too_long:
            self._take_held()
            self._whole = True
            return
        match = (
            _LINE.fullmatch(bytes(self._held).lstrip(b"\n")) if self._whole or self._text else None
        )
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
            self._held.clear()  # a header line, or the rest of a first line
            self._whole = True
        else:
            self._hold(byte)  # a line feed at the start of a frame or inside it


def _checked(held: bytes) -> bytes | None:
    """Decode a COBS frame and verify its checksum; return the packet without the checksum, or None if it is damaged."""
    from cobs import cobs

    try:
        packet = bytes(cobs.decode(held))
    except cobs.DecodeError:
        return None
    body = packet[: -_CRC.size]
    check = packet[-_CRC.size :]
    if len(body) < _HEADER.size or len(check) < _CRC.size:
        return None
    (checksum,) = _CRC.unpack(check)
    return body if zlib.crc32(body) == checksum else None


def _message(kind: int, payload: bytes) -> Message | None:
    """Decode the payload of a message of type ``kind``; return None for an unknown type or a wrong payload size."""
    if kind == Samples.KIND:
        if not payload or len(payload) % _SAMPLE.size or len(payload) > MOST_SAMPLES * _SAMPLE.size:
            return None
        pairs = list(_SAMPLE.iter_unpack(payload))
        return Samples(tuple(t for t, _ in pairs), tuple(c for _, c in pairs))
    message = _PLAIN.get(kind)
    if message is None or len(payload) != message.LAYOUT.size:
        return None
    return message(*message.LAYOUT.unpack(payload))
