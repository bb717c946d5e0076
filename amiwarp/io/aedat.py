"""Readers of AEDAT files of older cameras: 2.0 of jAER, and 3.1 of cAER."""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import DEFAULT_BLOCK, ImuSamples, MetadataValue, Recording
from amiwarp.io import file_scan
from amiwarp.io.file_scan import FileEvents, Packet, only_counted
from amiwarp.io.files import errors_name, open_input

# Reader of AEDAT 2.0 files of jAER: DVS128 and the DAVIS cameras.
#
# After a header of lines that begin with ``#``, each record has a 32-bit address and a 32-bit time [us], both
# big-endian. The address holds an event, a sample of a frame (APS) or of the inertial unit (IMU), or an edge at the
# external input. Pixels count from the bottom right, as jAER decodes them, and are turned into columns from the left,
# rows from the top.

# IMU samples of the DAVIS cameras in AEDAT 2.0 files.
#
# A sample consists of seven records with the numbers 0 to 6: acceleration x, y, z, temperature, angular velocity x, y,
# z. The values are 16-bit numbers of the IMU (InvenSense MPU-6100). Its ranges stand among the settings in the header.

STEPS_PER_G = {2: 16384.0, 4: 8192.0, 8: 4096.0, 16: 2048.0}
"""Steps of the accelerometer per g, by its range [g]; from the data sheet of the MPU-6100."""

STEPS_PER_DEG_S = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}
"""Steps of the gyroscope per degree per second, by its range [deg/s]; from the same data sheet."""

RANGES = 8, 1000
"""Ranges [g] and [deg/s] that jAER sets by default, for files whose header does not state them."""

RECORDS_OF_SAMPLE = 7
"""Number of records of a sample."""

Records = Iterator[tuple[NDArray[Any], NDArray[np.int64]]]
"""Blocks of addresses and times [us]."""


def read_ranges(path: Path, offset: int) -> tuple[int, int] | None:
    """Return the ranges of accelerometer [g] and gyroscope [deg/s] in the header's settings, or None if not there."""
    with open_input(path) as file:
        header = file.read(offset)
    camera = re.search(rb"#\s*AEChip:\s*(\S+)", header)
    short = camera[1].rpartition(b".")[2] if camera else b""
    found = []
    for name, old, value, known in (
        (b"IMU.AccelScale", b"ImuAccelScale", rb"ImuAccelScaleG(\d{1,4})", STEPS_PER_G),
        (b"IMU.GyroScale", b"ImuGyroScale", rb"GyroFullScaleDegPerSec(\d{1,4})", STEPS_PER_DEG_S),
    ):
        # Settings of other cameras may be there too. Those of this camera begin with its name in new versions of jAER.
        keys = (re.escape(short + b"." + name), old)
        texts = (re.search(b'key="' + key + b'" value="' + value + b'"', header) for key in keys)
        stated = next((int(text[1]) for text in texts if text), 0)
        if stated not in known:
            return None
        found.append(stated)
    return found[0], found[1]


def _read_samples(path: Path, records: Records, ranges: tuple[int, int]) -> ImuSamples:
    """Return all complete samples."""
    return file_scan.imu_of(path, _sample_columns(records, STEPS_PER_G[ranges[0]], STEPS_PER_DEG_S[ranges[1]]))


def _sample_columns(records: Records, steps_per_g: float, steps_per_deg_s: float) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of the complete samples."""
    words, t = np.zeros(0, np.int64), np.zeros(0, np.int64)
    for block, times in records:
        at = _are_imu(block)
        words, t = np.concatenate([words, block[at]]), np.concatenate([t, times[at]])
        starts, rest = _complete_samples(words)
        values = (words[starts[:, None] + np.arange(RECORDS_OF_SAMPLE)] >> 12 & 0xFFFF).astype(np.uint16).view(np.int16)
        turning = np.radians(values[:, 4:] / steps_per_deg_s)
        pulling = values[:, :3] / steps_per_g * file_scan.GRAVITY
        yield t[starts], *turning.T, *pulling.T
        words, t = words[rest:], t[rest:]


def _are_imu(words: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which addresses are records of IMU samples."""
    return np.asarray((words >> 31 == 1) & (words >> 10 & 3 == 3))


def _complete_samples(words: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return the indices at which complete samples begin among records of the IMU, and the index after them.

    The records of the last sample may continue in the next block, so that those after this index are needed again.
    """
    starts = _starts(words >> 28 & 7)
    end = int(starts[-1]) + RECORDS_OF_SAMPLE if len(starts) else 0
    return starts, max(0, len(words) - RECORDS_OF_SAMPLE + 1, end)


def _starts(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices at which the numbers 0 to 6 follow each other."""
    if len(numbers) < RECORDS_OF_SAMPLE:
        return np.zeros(0, np.int64)
    windows = np.lib.stride_tricks.sliding_window_view(numbers, RECORDS_OF_SAMPLE)
    return np.flatnonzero((windows == np.arange(RECORDS_OF_SAMPLE)).all(axis=1))


AEDAT2_MAGIC = b"#!AER-DAT2.0"
"""First bytes of a file."""
HEADER_BYTES = 1 << 24
"""Longest header that is read [bytes]. It can hold all settings of the camera."""


HEADER_LAST = b"#end of ascii header"
"""Last line of the header, in lower case; older versions of jAER do not write it."""
LINE = re.compile(rb"(#[^\r\n]*)(\r\n|\n|\r)")
"""Line of the header, and its end."""
CONTROL = re.compile(rb"[\x00-\x08\x0b-\x1f]")
"""Characters that are part of no line of text."""
RECORD_LIKE = re.compile(rb"#.{0,5}|.*[\x7f-\xff].*", re.DOTALL)
"""Lines that can be the start of a record, whose address begins with ``#``."""
RECORD_BYTES = 8
"""Size of a record."""


@dataclass(frozen=True, slots=True)
class Chip:
    """Layout of a camera's addresses."""

    width: int
    height: int
    davis: bool
    """Whether the addresses are those of a DAVIS camera, else those of the DVS128."""


CHIPS = {
    "dvs128": Chip(128, 128, False), "davis128": Chip(128, 128, True), "davis208": Chip(208, 192, True),
    "davis240": Chip(240, 180, True), "davis346": Chip(346, 260, True), "davis640": Chip(640, 480, True),
    "tmpdiff128": Chip(128, 128, False),
}  # fmt: skip
"""Layouts by the name of jAER's class in the header, in lower case and without a suffix."""


def open_aedat2(path: Path, chip: str | None = None) -> Recording:
    """Open the events of an AEDAT 2.0 file.

    ``chip`` is the name of the camera, one of :data:`CHIPS`. By default, it is taken from the header.
    """
    with errors_name(path, lambda: "reading the header"):
        camera, offset, assumed = _read_aedat2_header(path, chip)
    read, last = partial(_aedat2_packets, path, camera, offset), partial(file_scan.last_word, path, offset, ">u4")
    events = FileEvents(path, read, size=(camera.width, camera.height), last_time=last)
    imu, notes = _imu(path, offset, events)
    notes |= file_scan.only_counted(events.records, "frames")
    if assumed is not None:
        name, text = assumed.entry
        notes[name] = text
    metadata = {"format": "aedat2", **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu)


def _imu(path: Path, offset: int, events: FileEvents) -> tuple[ImuSamples | None, dict[str, MetadataValue]]:
    """Return the IMU samples, unless only the head of the file was read, and notes about them."""
    if not events.records.get("imu_samples") or file_scan.head_limit() is not None:
        return None, {}
    ranges = read_ranges(path, offset)
    notes: dict[str, MetadataValue] = {}
    if ranges is None:
        notes["imu_ranges"] = f"assumed: {RANGES[0]} g and {RANGES[1]} deg/s, the defaults of jAER"
    return _read_samples(path, _records(path, offset, {}), ranges or RANGES), notes


def aedat2_triggers(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, all as rising edges of channel 0."""
    chip, offset, _ = _read_aedat2_header(path)
    for words, t in _records(path, offset, {}):
        at = (words >> 31 == 0) & (words >> 10 & 1 == 1) if chip.davis else words >> 15 & 1 == 1
        nothing = np.zeros(np.count_nonzero(at), np.int64)
        yield nothing, nothing, t[at], nothing + 1


def _read_aedat2_header(path: Path, given: str | None = None) -> tuple[Chip, int, file_scan.Assumption | None]:
    """Return the camera, the position of the first record, and what was assumed about the camera, if anything."""
    with open_input(path) as file:
        head = file.read(HEADER_BYTES + 1)
    if not head.startswith(AEDAT2_MAGIC):
        raise AmiwarpError("byte 0: is not the header of an AEDAT 2.0 file; give another file")
    lines, start = _header_lines(head, path.stat().st_size)
    if start > HEADER_BYTES:
        raise AmiwarpError(f"the header is longer than {HEADER_BYTES >> 20} MiB; the file is damaged")
    named = [found[1] for line in lines if (found := re.match(rb"#\s*AEChip:\s*(\S+)", line))]
    name = named[-1].decode("ascii", "replace") if named else ""
    if given is not None:
        if given.lower() not in CHIPS:
            raise AmiwarpError(f"chip is '{given[:60]}'; expected one of {', '.join(CHIPS)}")
        return CHIPS[given.lower()], start, None
    if not name:
        guessed = _guessed_chip(path, start)
        why = "the header names no camera, and this is the smallest that has the largest address"
        return CHIPS[guessed], start, file_scan.Assumption("chip", guessed, why, "--chip")
    short = name.rpartition(".")[2].lower()
    chip = next((chip for key, chip in CHIPS.items() if short.startswith(key)), None)
    if chip is None:
        known = ", ".join(CHIPS)
        raise AmiwarpError(f"the header names camera '{name[:60]}'; expected one of {known}; choose one with --chip")
    return chip, start, None


def _header_lines(head: bytes, file_bytes: int) -> tuple[list[bytes], int]:
    """Return the lines of the header of a file of some size, and the position of the first record.

    Records can begin with ``#``, too. The header ends at a line that says so; without it, at what is no line of text.
    """
    lines: list[bytes] = []
    start = 0
    first = newline = b""
    while found := LINE.match(head, start):
        line, newline = found.groups()
        if CONTROL.search(line):
            break
        first = first or newline
        if first == b"\r":
            newline = first  # the first record begins with what looks like the rest of a newline
        lines.append(line)
        start += len(line) + len(newline)
        if line.strip().lower() == HEADER_LAST:
            return lines, start
    doubtful = len(lines) > 1 and RECORD_LIKE.fullmatch(lines[-1]) is not None
    if doubtful and (file_bytes - start) % RECORD_BYTES:
        before = start - len(lines[-1]) - len(newline)
        # The last line is the start of a record if whole records follow without it.
        if (file_bytes - before) % RECORD_BYTES == 0:
            return lines[:-1], before
    return lines, start


def _guessed_chip(path: Path, offset: int) -> str:
    """Return the name of the smallest camera that has the largest address in a file without the camera's name."""
    largest = right = top = 0
    for words, _ in _records(path, offset, {}):
        largest = max(largest, int(words.max(initial=0)))
        events = words[(words >> 31 == 0) & (words >> 10 & 1 == 0)]
        right = max(right, int((events >> 12 & 0x3FF).max(initial=0)))
        top = max(top, int((events >> 22 & 0x1FF).max(initial=0)))
    if largest < 1 << 16:
        return "dvs128"
    davis = [(name, chip) for name, chip in CHIPS.items() if chip.davis]
    return next((name for name, chip in davis if right < chip.width and top < chip.height), davis[-1][0])


def _records(path: Path, offset: int, notes: dict[str, int]) -> Iterator[tuple[NDArray[Any], NDArray[np.int64]]]:
    """Yield addresses and unwrapped times [us]."""
    last: int | None = None
    for words in file_scan.read_words(path, offset, ">u4", DEFAULT_BLOCK, notes):
        t = file_scan.unwrapped(words[:, 1].astype(np.int64), 32, last)
        last = int(t[-1]) if t.size else last
        yield words[:, 0].astype(np.int64), t


def _aedat2_packets(path: Path, chip: Chip, offset: int, notes: dict[str, int]) -> Iterator[Packet]:
    of_imu = np.zeros(0, np.int64)
    for words, t in _records(path, offset, notes):
        if chip.davis:
            of_imu = np.concatenate([of_imu, words[_are_imu(words)]])
            starts, rest = _complete_samples(of_imu)
            notes["imu_samples"] = notes.get("imu_samples", 0) + len(starts)
            of_imu = of_imu[rest:]
        yield _davis(words, t, chip, notes) if chip.davis else _dvs128(words, t, notes)


def _davis(words: NDArray[np.int64], t: NDArray[np.int64], chip: Chip, notes: dict[str, int]) -> Packet:
    other, external = words >> 31 == 1, words >> 10 & 1 == 1
    kind = words[other] >> 10 & 3
    # A frame has two samples of each pixel: the type is 0 for the reset level, 1 for the signal. One pixel is counted.
    frames = np.count_nonzero((kind == 1) & (words[other] >> 12 & 0x7FFFF == 0))
    for name, count in (("frames", frames), ("triggers", (external & ~other).sum())):
        notes[name] = notes.get(name, 0) + int(count)
    at = ~other & ~external
    kept = words[at]
    return chip.width - 1 - (kept >> 12 & 0x3FF), chip.height - 1 - (kept >> 22 & 0x1FF), t[at], kept >> 11 & 1


def _dvs128(words: NDArray[np.int64], t: NDArray[np.int64], notes: dict[str, int]) -> Packet:
    external = words >> 15 & 1 == 1
    notes["triggers"] = notes.get("triggers", 0) + int(external.sum())
    kept = words[~external]
    # In jAER, bit 0 is 0 for an ON event.
    return 127 - (kept >> 1 & 0x7F), 127 - (kept >> 8 & 0x7F), t[~external], 1 - (kept & 1)


# Reader of AEDAT 3.1 files of cAER: packets of one type of event each, little-endian.
#
# Pixels count from the upper left. Packets of events of the first source are read. Other packets are counted or
# skipped.

HEADER_END = b"#!END-HEADER\r\n"
LONGEST_LINE, MOST_LINES = 4096, 1000
"""Limits of the header: characters of a line, and lines."""

PACKET_HEADER = struct.Struct("<hhiiiiii")
"""Header of a packet: type, source, size of an event, offset of its time, overflow of the time, capacity, number, and
number of valid events."""

SPECIAL, POLARITY = 0, 1
COUNTED_TYPES = {2: "frames", 3: "imu_samples", 4: "imu_samples"}
"""Types of packets. Those of type 3 have six axes, of type 4 nine."""

SPECIAL_EDGES = {2: 1, 3: 0, 4: 1}
"""Types of special events at the external input: rising edge, falling edge, pulse; and whether they count as rising."""

LARGEST_PACKET = 1 << 28
"""Largest packet that is read [bytes]."""

JOINED = 1 << 17
"""Number of events from which on packets are joined and decoded."""

SIZES = {"DVS128": (128, 128), "DAVIS128": (128, 128), "DAVIS208": (208, 192), "DAVIS240": (240, 180),
         "DAVIS346": (346, 260), "DAVIS640": (640, 480), "DVXPLORER": (640, 480)}  # fmt: skip
"""Sensor sizes [px] by the beginning of the source's name in the header."""


def open_aedat3(path: Path) -> Recording:
    """Open the events of an AEDAT 3.1 file."""
    with errors_name(path, lambda: "reading the header"):
        size, offset = _read_aedat3_header(path)
    events = FileEvents(path, partial(_aedat3_packets, path, offset), size=size)
    metadata = {"format": "aedat3", **events.metadata, **only_counted(events.records, "imu_samples", "frames")}
    return Recording(events=events, metadata=metadata, name=path.stem)


def _read_aedat3_header(path: Path) -> tuple[tuple[int, int] | None, int]:
    """Return the sensor size [px], or None if the source is unknown, and the position of the first packet."""
    with open_input(path) as file:
        size = None
        for _ in range(MOST_LINES):
            line = file.readline(LONGEST_LINE)
            if line == HEADER_END:
                return size, file.tell()
            if not line.startswith(b"#"):
                break
            text = line.decode("latin-1").strip()
            if (found := re.match(r"#Format:\s*(\S+)", text)) and found[1] != "RAW":
                raise AmiwarpError(f"the packets have the format '{found[1][:40]}'; export the file again as RAW")
            if size is None and (found := re.match(r"#Source \d+:\s*(\S+)", text)):
                size = next((sizes for name, sizes in SIZES.items() if found[1].upper().startswith(name)), None)
        raise AmiwarpError("the header does not end with #!END-HEADER; the file is damaged")


def _contents(path: Path, offset: int, notes: dict[str, int]) -> Iterator[tuple[int, int, NDArray[Any], int]]:
    """Yield type, source, valid events as rows of 32-bit words, and time overflow [us] of the packets."""
    total = path.stat().st_size
    notes["total"] = total
    with open_input(path) as file:
        file.seek(offset)
        while head := file.read(PACKET_HEADER.size):
            at = file.tell() - len(head)
            if len(head) < PACKET_HEADER.size:
                notes["truncated_bytes"] = len(head)
                return
            kind, source, width, _, overflow, _, count, _ = PACKET_HEADER.unpack(head)
            length = width * count
            if min(width, count, overflow, source) < 0 or length > LARGEST_PACKET or kind not in range(256):
                raise AmiwarpError(f"{path}: byte {at} does not begin the header of a packet; the file is damaged")
            if at + PACKET_HEADER.size + length > total:
                notes["truncated_bytes"] = total - at
                return
            if kind in COUNTED_TYPES:
                notes[COUNTED_TYPES[kind]] = notes.get(COUNTED_TYPES[kind], 0) + count
            if kind not in (SPECIAL, POLARITY):
                if kind not in COUNTED_TYPES:
                    notes["packets_of_other_types"] = notes.get("packets_of_other_types", 0) + 1
                file.seek(length, 1)
            elif width != 8:
                raise AmiwarpError(f"{path}: byte {at}: events of {width} bytes in a packet of type {kind}; expected 8")
            else:
                words = np.frombuffer(file.read(length), "<i4").reshape(-1, 2).astype(np.int64)
                valid = words[:, 0] & 1 == 1
                notes["invalid_events"] = notes.get("invalid_events", 0) + int(np.count_nonzero(~valid))
                yield kind, source, words[valid], overflow << 31
            notes["read"] = file.tell()


def _aedat3_packets(path: Path, offset: int, notes: dict[str, int]) -> Iterator[Packet]:
    first, parts, count = None, [], 0
    for kind, source, words, overflow in _contents(path, offset, notes):
        if kind == SPECIAL:
            edges = np.isin(words[:, 0] >> 1 & 0x7F, list(SPECIAL_EDGES))
            notes["triggers"] = notes.get("triggers", 0) + int(np.count_nonzero(edges))
            continue
        first = source if first is None else first
        if source != first:
            notes["events_of_other_sources"] = notes.get("events_of_other_sources", 0) + len(words)
            continue
        words[:, 1] += overflow
        parts.append(words)
        count += len(words)
        if count >= JOINED:  # packets of the camera are small
            yield _decoded(parts)
            parts, count = [], 0
    if parts:
        yield _decoded(parts)


def _decoded(parts: list[NDArray[Any]]) -> Packet:
    data, t = np.concatenate(parts).T
    return data >> 17 & 0x7FFF, data >> 2 & 0x7FFF, t, data >> 1 & 1


def aedat3_triggers(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    for kind, _, words, overflow in _contents(path, _read_aedat3_header(path)[1], {}):
        codes = words[:, 0] >> 1 & 0x7F
        at = np.isin(codes, list(SPECIAL_EDGES)) & (kind == SPECIAL)
        rising = (codes[at] != 3).astype(np.int64)
        yield rising * 0, rising * 0, words[at, 1] + overflow, rising
