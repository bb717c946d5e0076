"""Reader of AEDAT 3.1 files of cAER: packets of one type of event each, little-endian.

Pixels count from the upper left. Packets of events of the first source are read. Other packets are counted or skipped.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.decoding import address_of, cut_into_blocks, new_rows, sums_before
from amiwarp.io.file_scan import FileEvents, Packet, only_counted
from amiwarp.io.files import errors_name, open_input

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents

HEADER_END = b"#!END-HEADER\r\n"
LONGEST_LINE = 4096
"""Longest line of the header [characters]."""
MOST_LINES = 1000
"""Largest number of lines of the header."""

PACKET_HEADER = struct.Struct("<hhiiiiii")
"""Header of a packet: type, source, size of an event, offset of its time, overflow of the time, capacity, number, and
number of valid events."""

SPECIAL = 0
"""Type of packets of special events, such as edges at the external input."""
POLARITY = 1
"""Type of packets of events."""
COUNTED_TYPES = {2: "frames", 3: "imu_samples", 4: "imu_samples"}
"""Types of packets that are counted. Samples of type 3 have six axes, of type 4 nine."""
EVENT_BYTES = 8
"""Size of an event of type :data:`SPECIAL` or :data:`POLARITY`."""

SPECIAL_EDGES = {2: 1, 3: 0, 4: 1}
"""Types of special events at the external input: rising edge, falling edge, pulse; and whether they count as rising."""

LARGEST_PACKET = 1 << 28
"""Largest packet that is read [bytes]."""

JOINED = 1 << 17
"""Number of events from which on packets are joined and decoded."""

SIZES = {
    "DVS128": (128, 128),
    "DAVIS128": (128, 128),
    "DAVIS208": (208, 192),
    "DAVIS240": (240, 180),
    "DAVIS346": (346, 260),
    "DAVIS640": (640, 480),
    "DVXPLORER": (640, 480),
}
"""Sensor sizes [px] by the beginning of the source's name in the header."""


def open_aedat3(path: Path) -> Recording:
    """Open the events of an AEDAT 3.1 file."""
    with errors_name(path, lambda: "reading the header"):
        size, offset = _read_aedat3_header(path)
    events = FileEvents(path, partial(_event_packets, path, offset), size=size)
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


def _contents(path: Path, offset: int, notes: dict[str, int]) -> Iterator[tuple[int, int, bytes, int]]:
    """Yield type, source, events and time overflow [us] of the packets of events and of special events."""
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
            elif width != EVENT_BYTES:
                raise AmiwarpError(f"{path}: byte {at}: events of {width} bytes in a packet of type {kind}; expected 8")
            else:
                yield kind, source, file.read(length), overflow << 31
            notes["read"] = file.tell()


def _event_packets(path: Path, offset: int, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of the first source, and count other records."""
    from amiwarp.kernels.launch import start_once

    start_once()
    first: int | None = None
    parts: list[bytes] = []
    bases: list[int] = []
    count = 0
    for kind, source, data, base in _contents(path, offset, notes):
        if kind == POLARITY and first is None:
            first = source
        if kind == SPECIAL or source != first:
            _count_others(kind, data, notes)
            continue
        parts.append(data)
        bases.append(base)
        count += len(data) // EVENT_BYTES
        if count >= JOINED:  # packets of the camera are small
            yield _decoded(parts, bases, notes).to_host()
            parts = []
            bases = []
            count = 0
    if parts:
        yield _decoded(parts, bases, notes).to_host()


def _count_others(kind: int, data: bytes, notes: dict[str, int]) -> None:
    """Count the edges in a packet of special events, or the events of another source."""
    words = _valid(data)
    _add_invalid(notes, len(data) // EVENT_BYTES - len(words))
    if kind == SPECIAL:
        notes["triggers"] = notes.get("triggers", 0) + int(np.count_nonzero(_are_edges(words)))
    else:
        notes["events_of_other_sources"] = notes.get("events_of_other_sources", 0) + len(words)


def _add_invalid(notes: dict[str, int], count: int) -> None:
    notes["invalid_events"] = notes.get("invalid_events", 0) + count


def _valid(data: bytes) -> NDArray[np.int64]:
    """Return the valid events of a packet, of two words each, shape ``(n, 2)``."""
    words = np.frombuffer(data, "<i4").reshape(-1, 2).astype(np.int64)
    return words[words[:, 0] & 1 == 1]


def _are_edges(words: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which special events are edges at the external input."""
    return np.isin(words[:, 0] >> 1 & 0x7F, list(SPECIAL_EDGES))


def _decoded(parts: list[bytes], bases: list[int], notes: dict[str, int]) -> DeviceEvents:
    """Return the valid events of some packets, and count invalid ones. ``bases``: what is added to their times [us]."""
    counts = np.array([len(part) // EVENT_BYTES for part in parts])
    addresses = np.array([address_of(part) for part in parts], np.uint64)
    events = decode_packets(addresses, counts, np.array(bases), "cpu")
    _add_invalid(notes, int(counts.sum()) - len(events))
    return events


def decode_packets(
    addresses: NDArray[np.uint64], counts: NDArray[np.int64], bases: NDArray[np.int64], device: Any
) -> DeviceEvents:
    """Return the valid events of some packets in the memory of a device.

    Parameters
    ----------
    addresses, counts : array
        Address of the first event of each packet, and number of its events, shape ``(m,)``.
    bases : array
        Time that is added to those of each packet's events [us], shape ``(m,)``.
    device : str or wp.Device
        The device.
    """
    import warp as wp

    from amiwarp.events.device_events import DeviceEvents
    from amiwarp.kernels import aedat3
    from amiwarp.kernels.event_arrays import new_event_arrays
    from amiwarp.kernels.launch import launch

    device = wp.get_device(device)
    packet, before, held = cut_into_blocks(counts, device)
    blocks = new_rows(packet.size, aedat3.Block)
    blocks["address"] = addresses[packet] + (EVENT_BYTES * before).astype(np.uint64)
    blocks["events"] = held
    blocks["base"] = bases[packet]
    on_device = wp.array(blocks, dtype=aedat3.Block, device=device)

    valid = wp.empty(blocks.size, dtype=int, device=device)
    launch(aedat3.count_valid, blocks.size, [on_device], [valid], device=device, smallest=1)
    found = valid.numpy()
    arrays = new_event_arrays(int(found.sum()), device)
    places = wp.array(sums_before(found), dtype=int, device=device)
    launch(aedat3.decode_polarity, blocks.size, [on_device, places], [arrays], device=device, smallest=1)
    return DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p)


def aedat3_triggers(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    for kind, _, data, base in _contents(path, _read_aedat3_header(path)[1], {}):
        if kind == SPECIAL:
            words = _valid(data)
            words = words[_are_edges(words)]
            rising = (words[:, 0] >> 1 & 0x7F != 3).astype(np.int64)
            nothing = np.zeros(len(words), np.int64)
            yield nothing, nothing, words[:, 1] + base, rising
