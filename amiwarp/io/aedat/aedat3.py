"""Reader of AEDAT 3.1 files of cAER: packets of one type of event each, little-endian.

Pixels count from the upper left. Packets of events of the first source are read, and of samples of the first IMU.
Other packets are counted or skipped.
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

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io.decoding import address_of, cut_into_blocks, new_rows, sums_before
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.file_sensors import GRAVITY, only_counted, sensors_of
from amiwarp.io.inputs import errors_name, open_input

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
IMU_BYTES = {3: 36, 4: 48}
"""Size of an IMU sample by the type of its packet: information, time [us], acceleration x, y, z [g], angular velocity
x, y, z [deg/s], temperature, and with nine axes the magnetic field; four bytes each."""
EVENT_BYTES = 8
"""Size of an event of type :data:`SPECIAL` or :data:`POLARITY`."""

RISING = 2
FALLING = 3
PULSE = 4
EDGES = (RISING, FALLING, PULSE)
"""Types of special events at the external input. A pulse counts as rising."""

LARGEST_PACKET = 1 << 28
"""Largest packet that is read [bytes]."""

JOINED = 1 << 17
"""Number of events at which packets are joined and decoded."""

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
    counts = {name: count for name, count in events.records.items() if name != "frames"}
    imu, _, notes = sensors_of(path, counts, lambda _: _imu_packets(path, offset))
    notes |= only_counted(events.records, "frames")
    return Recording(
        events=events,
        metadata={"format": "aedat3", **events.metadata, **notes},
        name=path.stem,
        imu=imu,
    )


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
            format = re.match(r"#Format:\s*(\S+)", text)
            if format is not None and format[1] != "RAW":
                raise AmiwarpError(
                    f"the packets have the format '{format[1][:40]}'; export the file again as RAW",
                    ErrorCode.FORMAT_UNKNOWN,
                )
            source = re.match(r"#Source \d+:\s*(\S+)", text)
            if size is None and source is not None:
                size = _size_of(source[1])
        raise AmiwarpError(
            "the header does not end with #!END-HEADER; the file is damaged", ErrorCode.FILE_DAMAGED
        )


def _imu_packets(path: Path, offset: int) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of the valid samples of the first IMU."""
    first: int | None = None
    for kind, source, data, base in _contents(path, offset, {}, tuple(IMU_BYTES)):
        first = source if first is None else first
        if source != first:
            continue
        width = IMU_BYTES[kind] // 4
        words = np.frombuffer(data, "<i4").reshape(-1, width)
        words = words[words[:, 0] & 1 == 1]
        t = words[:, 1].astype(np.int64) + base
        values = np.ascontiguousarray(words[:, 2:8]).view("<f4").astype(np.float64)
        acceleration = values[:, :3] * GRAVITY
        angular_velocity = np.radians(values[:, 3:])
        yield t, *angular_velocity.T, *acceleration.T


def _size_of(source: str) -> tuple[int, int] | None:
    """Return the sensor size of a source of that name [px], or None if it is unknown."""
    for name, size in SIZES.items():
        if source.upper().startswith(name):
            return size
    return None


def _contents(
    path: Path,
    offset: int,
    notes: dict[str, int],
    kinds: tuple[int, ...] = (SPECIAL, POLARITY),
) -> Iterator[tuple[int, int, bytes, int]]:
    """Yield type, source, events and time overflow [us] of the packets of some types, by default of events."""
    total = path.stat().st_size
    notes["total"] = total
    with open_input(path) as file:
        file.seek(offset)
        while head := file.read(PACKET_HEADER.size):
            head_start = file.tell() - len(head)
            if len(head) < PACKET_HEADER.size:
                notes["truncated_bytes"] = len(head)
                return
            kind, source, width, _, overflow, _, count, _ = PACKET_HEADER.unpack(head)
            length = width * count
            is_negative = min(width, count, overflow, source) < 0
            if is_negative or length > LARGEST_PACKET or kind not in range(256):
                raise AmiwarpError(
                    f"{path}: byte {head_start} does not begin the header of a packet; the file is damaged",
                    ErrorCode.FILE_DAMAGED,
                )
            if head_start + PACKET_HEADER.size + length > total:
                notes["truncated_bytes"] = total - head_start
                return
            if kind in COUNTED_TYPES:
                name = COUNTED_TYPES[kind]
                notes[name] = notes.get(name, 0) + count
            expected = IMU_BYTES.get(kind, EVENT_BYTES)
            if kind not in kinds:
                if kind not in (SPECIAL, POLARITY, *COUNTED_TYPES):
                    notes["packets_of_other_types"] = notes.get("packets_of_other_types", 0) + 1
                file.seek(length, 1)
            elif width != expected:
                raise AmiwarpError(
                    f"{path}: byte {head_start}: events of {width} bytes in a packet of type {kind}; "
                    f"expected {expected}",
                    ErrorCode.FILE_DAMAGED,
                )
            else:
                yield kind, source, file.read(length), overflow << 31
            notes["read"] = file.tell()


def _event_packets(path: Path, offset: int, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of the first source, and count other records."""
    from amiwarp.kernels.quiet_start import start_once

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
        # Packets of the camera are small, so many are decoded together.
        if count >= JOINED:
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
        edges = int(np.count_nonzero(_are_edges(words)))
        notes["triggers"] = notes.get("triggers", 0) + edges
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
    return np.isin(words[:, 0] >> 1 & 0x7F, EDGES)


def _decoded(parts: list[bytes], bases: list[int], notes: dict[str, int]) -> DeviceEvents:
    """Return the valid events of some packets, and count invalid ones. ``bases``: what is added to their times [us]."""
    counts = np.array([len(part) // EVENT_BYTES for part in parts])
    addresses = np.array([address_of(part) for part in parts], np.uint64)
    events = decode_packets(addresses, counts, np.array(bases), "cpu")
    _add_invalid(notes, int(counts.sum()) - len(events))
    return events


def decode_packets(
    addresses: NDArray[np.uint64],
    counts: NDArray[np.int64],
    bases: NDArray[np.int64],
    device: Any,
) -> DeviceEvents:
    """Return the valid events of some packets in the memory of a device.

    Parameters
    ----------
    addresses, counts : array
        Address of the first event of each packet, and number of its events, shape ``(m,)``.
    bases : array
        Time that is added to the times of each packet's events [us], shape ``(m,)``.
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
    is_valid = valid.numpy()
    arrays = new_event_arrays(int(is_valid.sum()), device)
    places = wp.array(sums_before(is_valid), dtype=int, device=device)
    inputs = [on_device, places]
    launch(aedat3.decode_polarity, blocks.size, inputs, [arrays], device=device, smallest=1)
    return DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p)


def aedat3_triggers(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    _, offset = _read_aedat3_header(path)
    for kind, _, data, base in _contents(path, offset, {}):
        if kind == SPECIAL:
            words = _valid(data)
            edges = words[_are_edges(words)]
            kinds = edges[:, 0] >> 1 & 0x7F
            rising = (kinds != FALLING).astype(np.int64)
            nothing = np.zeros(len(edges), np.int64)
            yield nothing, nothing, edges[:, 1] + base, rising
