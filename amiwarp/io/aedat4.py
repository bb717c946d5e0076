"""Reader and writer of iniVation's AEDAT 4.0 files, with faery: streams of events, frames and IMU samples."""

import shutil
import struct
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events
from amiwarp.events.recording import Recording
from amiwarp.io.file_scan import GRAVITY, FileEvents, Packet, read_sensors
from amiwarp.io.formats import Outline
from amiwarp.io.input_files import errors_name, open_input
from amiwarp.io.reading_process import Reply, noting_progress, packets, run

# Reader of iniVation's AEDAT 4.0 files, with faery: the first streams of events, frames and IMU samples.
#
# The decoder does not check the file's structure: text that is not UTF-8 ends the process. Therefore the header and the
# packet sizes are checked first.

COUNTED = {"frame": "frames", "imus": "imu_samples"}
"""Types of other streams, and the names of their counts."""

RISING, FALLING, PULSE = 1, 2, 3
EDGES = (RISING, FALLING, PULSE)
"""Types of triggers at the external input. Others mark the exposure and the reading of frames."""

MAGIC = b"#!AER-DAT4.0\r\n"
"""First bytes of an AEDAT 4.0 file."""


def open_aedat4(path: Path) -> Recording:
    """Open the first event stream of an AEDAT 4 file."""
    with errors_name(path, lambda: "reading the header"):
        with open_input(path) as file:
            _check_frame(path, file)
        width, height, number = run(read_head, path.absolute())
    source = partial(packets, read_packets, path.absolute(), number, False)
    events = FileEvents(path, source, size=(width, height))
    imu, frames, notes = read_sensors(path, events.records, __name__)
    metadata = {"format": "aedat4", **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu, frames=frames)


def _check_frame(path: Path, file: BinaryIO) -> None:
    """Check the header, and that each packet ends within the file; raise :class:`AmiwarpError` if not."""
    file_bytes = path.stat().st_size
    head = file.read(len(MAGIC) + 4)
    if not head.startswith(MAGIC) or len(head) < len(MAGIC) + 4:
        raise AmiwarpError(f"{path}: byte 0: is not the header of an AEDAT 4.0 file; give another file")
    (header_bytes,) = struct.unpack_from("<I", head, len(MAGIC))
    at = len(head) + header_bytes
    if at > file_bytes:
        raise AmiwarpError(f"{path}: byte {len(head)}: the header ends beyond the file, which is truncated")
    table = _check_header(path, file.read(header_bytes))
    if table > file_bytes:
        raise AmiwarpError(
            f"{path}: its table should be at byte {table}, beyond the end of the file, which is truncated"
        )
    end = table if table > 0 else file_bytes
    while at < end:
        file.seek(at)
        packet = file.read(8)
        size = struct.unpack("<ii", packet)[1] if len(packet) == 8 else -1
        if size < 0 or at + 8 + size > end:
            raise AmiwarpError(
                f"{path}: byte {at}: a packet ends beyond the file or its table; the file is truncated or damaged"
            )
        at += 8 + size


def _check_header(path: Path, header: bytes) -> int:
    """Check the header's XML, and return the position of the file's table; 0 or less if there is no table.

    The header is a FlatBuffer with the compression, the position of the table and the XML text.
    """
    try:
        (root,) = struct.unpack_from("<I", header)
        fields = root - struct.unpack_from("<i", header, root)[0]
        position, text = struct.unpack_from("<HH", header, fields + 6)
        start = root + text + struct.unpack_from("<I", header, root + text)[0]
        (length,) = struct.unpack_from("<I", header, start)
        if min(fields, text) <= 0 or start + 4 + length > len(header):
            raise ValueError("its text lies outside the header")
        ElementTree.fromstring(header[start + 4 : start + 4 + length].decode("utf-8"))
        return int(struct.unpack_from("<q", header, root + position)[0]) if position else 0
    except (struct.error, ValueError, ElementTree.ParseError) as error:
        raise AmiwarpError(f"{path}: the header is damaged: {error}") from error


def read_head(path: str) -> Reply:
    """Return width, height and number of the first stream of events. Called in the reading process."""
    from faery.extension import aedat

    with aedat.Decoder(path) as decoder:
        for track in decoder.tracks():
            if track.data_type == "events" and track.dimensions is not None:
                return (int(track.dimensions[0]), int(track.dimensions[1]), track.id), []
    raise AmiwarpError("has no stream of events; give a file with events")


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    with open_input(path) as file:
        _check_frame(path, file)
    return packets(read_packets, path.absolute(), -1, True, {})


def read_packets(notes: dict[str, int], path: str, number: int, triggers: bool) -> Iterator[Packet]:
    """Yield the packets of a stream of events, or the edges at the external input. Runs in the reading process."""
    from faery.extension import aedat

    with aedat.Decoder(path) as decoder:
        for track, packet in noting_progress(decoder, path, notes):
            if name := COUNTED.get(track.data_type):
                notes[name] = notes.get(name, 0) + (1 if name == "frames" else len(packet))
            elif track.data_type == "triggers":
                edges = packet[np.isin(packet["source"], EDGES)]
                notes["triggers"] = notes.get("triggers", 0) + len(edges)
                if triggers:
                    channel = np.zeros(len(edges), np.uint8)
                    yield channel, channel, edges["t"], edges["source"] != FALLING
            elif track.id == number and track.data_type == "events" and not triggers:
                yield packet["x"], packet["y"], packet["t"], packet["p"]


# Reader of IMU samples and frames of AEDAT 4.0 files, with faery. Runs in the reading process.
#
# The file's units are g and degrees per second.


def read_imu(notes: dict[str, int], path: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of the first stream of IMU samples."""
    for samples in _packets(path, "imus"):
        turning = (np.radians(samples[f"gyroscope_{axis}"].astype(np.float64)) for axis in "xyz")
        pulling = (samples[f"accelerometer_{axis}"].astype(np.float64) * GRAVITY for axis in "xyz")
        yield samples["t"].astype(np.int64), *turning, *pulling


def read_heads(notes: dict[str, int], path: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each frame. The time is the middle of the exposure."""
    for frame in _packets(path, "frame"):
        if frame.format != "L" or frame.pixels.ndim != 2:
            raise AmiwarpError(f"the frames are in colour ('{frame.format}'), not grey")
        height, width = frame.pixels.shape
        yield tuple(np.array([value], np.int64) for value in (frame.t, width, height, frame.pixels.itemsize))


def read_images(notes: dict[str, int], path: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each frame."""
    for frame in _packets(path, "frame"):
        yield (np.ascontiguousarray(frame.pixels).reshape(-1).view(np.uint8),)


def _packets(path: str, kind: str) -> Iterator[Any]:
    """Yield the packets of the first stream of a type."""
    from faery.extension import aedat

    with aedat.Decoder(path) as decoder:
        number = next((track.id for track in decoder.tracks() if track.data_type == kind), None)
        for track, packet in decoder:
            if track.id == number:
                yield packet


# Writer of iniVation's AEDAT 4.0 files, with faery: one stream of events, compressed by LZ4.

PACKET_EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), (("p", "on"), "?")])
"""Events as faery takes them."""


LAST_BYTES = 1 << 16
"""Free disk space that is needed when the file is closed [bytes]."""


def write_aedat4(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events, then count them in the file."""
    from faery.extension import aedat

    written = 0
    with aedat.Encoder(part, _description(about), ("lz4", 1)) as encoder:
        for events in blocks:
            packet = np.empty(len(events), PACKET_EVENT)
            for name in ("t", "x", "y", "p"):
                packet[name] = getattr(events, name)
            encoder.write(0, packet)
            written += len(events)
    try:
        count = len(open_aedat4(part).events) if written else 0
    except AmiwarpError:  # the file is truncated
        count = 0
    # The encoder does not report whether it could write its last bytes.
    if count != written or shutil.disk_usage(part.parent).free < LAST_BYTES:
        raise AmiwarpError(f"the disk is full: {count} of {written} events could be written; free some space")


def _description(about: Outline) -> list[Any]:
    """Return the description of the stream in the header, as iniVation's recorder writes it."""
    from faery.extension import aedat

    attribute, node = aedat.DescriptionAttribute, aedat.DescriptionNode
    size = {"sizeX": about.width, "sizeY": about.height}
    texts = {
        "compression": "LZ4",
        "originalModuleName": "amiwarp",
        "originalOutputName": "events",
        "typeDescription": "Array of events (polarity ON/OFF).",
        "typeIdentifier": "EVTS",
    }
    root = "/mainloop/Recorder/outInfo/"
    attributes = {name: attribute("int", value) for name, value in size.items()}
    attributes["source"] = attribute("string", "amiwarp")
    info = node("info", f"{root}0/info/", attributes, [])
    stream = {name: attribute("string", text) for name, text in texts.items()}
    return [node("outInfo", root, {}, [node("0", f"{root}0/", stream, [info])])]
