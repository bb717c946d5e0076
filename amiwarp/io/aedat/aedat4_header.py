"""Header of AEDAT 4 files: compression of the packets, streams, and position of the table of all packets."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.aedat.aedat4_compression import LARGEST_PACKET, Compression, Decompressor
from amiwarp.io.aedat.aedat4_tables import DAMAGE, I4, I8, U4, field_of, number_at, vector_of
from amiwarp.io.inputs import open_input

MAGIC = b"#!AER-DAT4.0\r\n"
"""First bytes of a file."""

HEADER_BYTES = 1 << 24
"""Longest header that is read [bytes]."""

NUMBER = re.compile(r"[0-9]{1,9}")
"""Number of up to nine digits, which fits into 32 bits."""


@dataclass(frozen=True, slots=True)
class Stream:
    """Description of a stream in the header."""

    kind: str
    """Type of its packets, four letters."""
    size: tuple[int, int] | None
    """Width and height of the sensor [px], if the header states them."""


@dataclass(frozen=True, slots=True)
class Aedat4File:
    """Header of a file."""

    path: Path
    compression: Compression
    streams: dict[int, Stream]
    """Streams by their number."""
    start: int
    """Position of the first packet."""
    end: int
    """Position behind the last packet: the start of the table of the packets, or the end of the file."""

    def first(self, kind: str) -> int | None:
        """Return the lowest number of a stream of this type, or None."""
        numbers = [number for number, stream in self.streams.items() if stream.kind == kind]
        return min(numbers, default=None)


def read_header(path: Path) -> Aedat4File:
    """Read the header; raise :class:`AmiwarpError` if it is damaged."""
    file_bytes = path.stat().st_size
    with open_input(path) as file:
        head = file.read(len(MAGIC) + U4.size)
        if not head.startswith(MAGIC) or len(head) < len(MAGIC) + U4.size:
            raise AmiwarpError(
                f"{path}: byte 0: is not the header of an AEDAT 4.0 file; give another file",
                ErrorCode.FORMAT_UNKNOWN,
            )
        size = number_at(U4, head, len(MAGIC))
        start = len(head) + size
        if start > file_bytes:
            raise AmiwarpError(
                f"{path}: the header ends at byte {start:,}, the file at byte {file_bytes:,}; it is cut off, copy it "
                "again",
                ErrorCode.FILE_DAMAGED,
            )
        if size > HEADER_BYTES:
            raise AmiwarpError(
                f"{path}: byte {len(head)}: the header has {size} bytes, more than {HEADER_BYTES}; the file is "
                "damaged, copy it again",
                ErrorCode.FILE_DAMAGED,
            )
        header = file.read(size)
        try:
            # Positions count from behind the size.
            root = number_at(U4, header, 0)
            number = field_of(header, root, 0, I4)
            if number not in range(len(Compression)):
                raise ValueError(
                    f"the compression has the number {number}; expected 0 to {len(Compression) - 1}"
                )
            compression = list(Compression)[number]
            table = field_of(header, root, 1, I8)
            text, length = vector_of(header, root, 2, 1)
            description = header[text : text + length].decode("utf-8")
            streams = dict(_streams(ElementTree.fromstring(description)))
        except (*DAMAGE, ElementTree.ParseError) as error:
            raise AmiwarpError(
                f"{path}: bytes {len(head)} to {start}: the header is damaged: {error}; copy the file again",
                ErrorCode.FILE_DAMAGED,
            ) from error
        end = file_bytes
        if start <= table < file_bytes and _is_table(file, table, file_bytes - table, compression):
            end = table
    return Aedat4File(path, compression, streams, start, end)


def _is_table(file: BinaryIO, offset: int, size: int, compression: Compression) -> bool:
    """Return whether the table of the packets is at a position, and no packet."""
    if size > LARGEST_PACKET:
        return False
    file.seek(offset)
    content = Decompressor(compression)(file.read(size)) or b""
    return content[8:12] == b"FTAB"


def _streams(description: ElementTree.Element) -> Iterator[tuple[int, Stream]]:
    """Yield number and description of each stream in the XML text of a header."""
    for node in description.iterfind("node[@name='outInfo']/node"):
        name = node.get("name", "")
        if NUMBER.fullmatch(name):
            width = node.findtext("node[@name='info']/attr[@key='sizeX']", "")
            height = node.findtext("node[@name='info']/attr[@key='sizeY']", "")
            size = None
            if NUMBER.fullmatch(width) and NUMBER.fullmatch(height):
                size = (int(width), int(height))
            yield int(name), Stream(node.findtext("attr[@key='typeIdentifier']", ""), size)
