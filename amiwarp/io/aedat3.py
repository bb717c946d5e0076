"""Reader of AEDAT 3.1 files of cAER: packets of one type of event each, little-endian.

Pixels count from the upper left. Packets of events of the first source are read. Other packets are counted or skipped.
"""

import re
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.file_scan import FileEvents, Packet, only_counted
from amiwarp.io.input_files import errors_name, open_input

MAGIC = b"#!AER-DAT3.1"
HEADER_END = b"#!END-HEADER\r\n"
LONGEST_LINE, MOST_LINES = 4096, 1000
"""Limits of the header: characters of a line, and lines."""

PACKET_HEADER = struct.Struct("<hhiiiiii")
"""Header of a packet: type, source, size of an event, offset of its time, overflow of the time, capacity, number, and
number of valid events."""

SPECIAL, POLARITY = 0, 1
COUNTED = {2: "frames", 3: "imu_samples", 4: "imu_samples"}
"""Types of packets. Those of type 3 have six axes, of type 4 nine."""

EDGES = {2: 1, 3: 0, 4: 1}
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
        size, offset = _read_header(path)
    events = FileEvents(path, partial(_packets, path, offset), size=size)
    metadata = {"format": "aedat3", **events.metadata, **only_counted(events.records, "imu_samples", "frames")}
    return Recording(events=events, metadata=metadata, name=path.stem)


def _read_header(path: Path) -> tuple[tuple[int, int] | None, int]:
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
            if kind in COUNTED:
                notes[COUNTED[kind]] = notes.get(COUNTED[kind], 0) + count
            if kind not in (SPECIAL, POLARITY):
                file.seek(length, 1)
            elif width != 8:
                raise AmiwarpError(f"{path}: byte {at}: events of {width} bytes in a packet of type {kind}; expected 8")
            else:
                words = np.frombuffer(file.read(length), "<i4").reshape(-1, 2).astype(np.int64)
                yield kind, source, words[words[:, 0] & 1 == 1], overflow << 31
            notes["read"] = file.tell()


def _packets(path: Path, offset: int, notes: dict[str, int]) -> Iterator[Packet]:
    first, parts, count = None, [], 0
    for kind, source, words, overflow in _contents(path, offset, notes):
        if kind == SPECIAL:
            edges = np.isin(words[:, 0] >> 1 & 0x7F, list(EDGES))
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


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    for kind, _, words, overflow in _contents(path, _read_header(path)[1], {}):
        codes = words[:, 0] >> 1 & 0x7F
        at = np.isin(codes, list(EDGES)) & (kind == SPECIAL)
        rising = (codes[at] != 3).astype(np.int64)
        yield rising * 0, rising * 0, words[at, 1] + overflow, rising
