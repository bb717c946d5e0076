"""iniVation's AEDAT 4.0 through faery: the first stream of events; frames, IMU and triggers are left out.

The decoder trusts the file's frame (text that is not UTF-8 ends the process), so header and packet sizes are checked
first.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.files import errors_name
from amiwarp.io.reading_process import packets, run
from amiwarp.io.reading_server import Reply
from amiwarp.io.scan import FileEvents, Packet
from amiwarp.regular_file import check_regular

MAGIC = b"#!AER-DAT4.0\r\n"


def open_aedat4(path: Path) -> Recording:
    """Open the first event stream of an AEDAT 4 file."""
    check_regular(path)
    with errors_name(path, lambda: "reading the header"):
        with path.open("rb") as file:
            _check_frame(path, file)
        width, height, number = run("amiwarp.io.aedat:read_head", os.path.abspath(path))
    source = partial(packets, "amiwarp.io.aedat:read_packets", os.path.abspath(path), number)
    events = FileEvents(path, source, size=(width, height))
    return Recording(events=events, metadata={"format": "aedat4", **events.repairs}, name=path.stem)


def _check_frame(path: Path, file: BinaryIO) -> None:
    """Check the header's text and that each packet ends within the file; raises naming the first bad byte."""
    file_bytes = path.stat().st_size
    head = file.read(len(MAGIC) + 4)
    if not head.startswith(MAGIC) or len(head) < len(MAGIC) + 4:
        raise AmiwarpError(f"{path}: byte 0: is not the head of an AEDAT 4.0 file")
    (header_bytes,) = struct.unpack_from("<I", head, len(MAGIC))
    at = len(head) + header_bytes
    if at > file_bytes:
        raise AmiwarpError(f"{path}: byte {len(head)}: header ends beyond the file; it is truncated")
    table = _check_header(path, file.read(header_bytes))
    if table > file_bytes:
        raise AmiwarpError(f"{path}: its table should be at byte {table}, beyond the file; it is truncated")
    end = table if table > 0 else file_bytes
    while at < end:
        file.seek(at)
        packet = file.read(8)
        size = struct.unpack("<ii", packet)[1] if len(packet) == 8 else -1
        if size < 0 or at + 8 + size > end:
            raise AmiwarpError(
                f"{path}: byte {at}: packet ends beyond the file or its table; it is truncated or damaged"
            )
        at += 8 + size


def _check_header(path: Path, header: bytes) -> int:
    """Check the header's XML; returns the position of the file's table, not positive where there is none.

    The header is a FlatBuffer: a table of compression, table's position and the XML text.
    """
    try:
        (root,) = struct.unpack_from("<I", header)
        fields = root - struct.unpack_from("<i", header, root)[0]
        position, text = struct.unpack_from("<HH", header, fields + 6)
        start = root + text + struct.unpack_from("<I", header, root + text)[0]
        (length,) = struct.unpack_from("<I", header, start)
        if min(fields, text) <= 0 or start + 4 + length > len(header):
            raise ValueError("text lies outside it")
        ElementTree.fromstring(header[start + 4 : start + 4 + length].decode("utf-8"))
        return int(struct.unpack_from("<q", header, root + position)[0]) if position else 0
    except (struct.error, ValueError, ElementTree.ParseError) as error:
        raise AmiwarpError(f"{path}: header is damaged: {error}") from error


def read_head(path: str) -> Reply:
    """Read width, height and number of the first stream of events; for the reading process."""
    from faery.extension import aedat

    with aedat.Decoder(path) as decoder:
        for track in decoder.tracks():
            if track.data_type == "events" and track.dimensions is not None:
                return (int(track.dimensions[0]), int(track.dimensions[1]), track.id), []
    raise AmiwarpError("has no stream of events")


def read_packets(notes: dict[str, int], path: str, number: int) -> Iterator[Packet]:
    """Decode a stream of events; for the reading process."""
    from faery.extension import aedat

    with aedat.Decoder(path) as decoder:
        for track, packet in decoder:
            if track.id == number and track.data_type == "events":
                yield packet["x"], packet["y"], packet["t"], packet["p"]
