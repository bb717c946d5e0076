"""Packets of AEDAT 4 files. One that is damaged is left out or repaired, and the next one is searched for.

A pass over the packets reads a window of the file, and moves it on. Every size is checked before memory is taken. Where
the next packet does not begin behind the stated size, the start of another one is searched for: the number of a known
stream, a size that fits into the file, and the bytes with which compression, or the type of a packet, begins.
"""

import contextlib
import itertools
import re
import struct
from collections.abc import Collection, Generator, Iterator
from functools import partial
from io import BufferedReader
from typing import NamedTuple

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.aedat.aedat4_compression import FRAME_MARKS, LARGEST_PACKET, Decompressor
from amiwarp.io.aedat.aedat4_header import Aedat4File
from amiwarp.io.aedat.aedat4_tables import U4, number_at
from amiwarp.io.inputs import open_input
from amiwarp.tasks import in_order

BATCH_BYTES = 1 << 23
"""Size of the packets that are decoded together [bytes]."""
BATCH_PACKETS = 1 << 12
"""Largest number of packets that are decoded together."""
WINDOW_BYTES = 1 << 22
"""Size of the part of a file that is read at once [bytes]. A larger packet is read whole."""

PACKET_HEADER = struct.Struct("<ii")
"""Header of a packet: number of its stream, and size."""

EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "p"],
        "formats": ["<i8", "<i2", "<i2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
"""An event as a packet stores it."""

KINDS = ("EVTS", "FRME", "IMUS", "TRIG")
"""Types of streams that are read."""
MARK_BYTES = 4
"""Number of the bytes with which a compressed packet begins, and of the letters of a type."""


class Content(NamedTuple):
    """A packet whose compression is undone."""

    at: int
    """Position of the packet."""
    size: int
    """Size of the packet in the file [bytes]."""
    stream: int
    """Number of its stream."""
    kind: str
    """Type of its stream."""
    data: bytes
    """The FlatBuffer; empty for a type that was not asked for."""


class Packets:
    """Pass over the packets of a file."""

    def __init__(self, about: Aedat4File, kinds: Collection[str]) -> None:
        """Undo the compression of packets of some ``kinds``; the others are only listed."""
        self._about = about
        self._kinds = kinds
        self._decompress = Decompressor(about.compression)
        self._mark = FRAME_MARKS.get(about.compression, b"")
        """What all packets have at the start of their data, if they are compressed."""
        self._pattern = re.compile(
            re.escape(self._mark) if self._mark else "|".join(KINDS).encode()
        )
        self._lead = PACKET_HEADER.size if self._mark else PACKET_HEADER.size + 8
        """Position of what the pattern finds, from the start of the packet on."""
        self._window = bytearray()
        self._base = 0
        """Position of the window in the file."""
        self._held = 0
        """Number of bytes of the file in the window."""
        self.notes: dict[str, int] = {}
        """Counts of what was left out so far."""

    def __iter__(self) -> Iterator[Content]:
        with open_input(self._about.path) as file:
            offset = self._about.start
            while offset < self._about.end:
                content, offset = self._read(file, offset)
                if content is not None:
                    yield content

    def _read(self, file: BufferedReader, offset: int) -> tuple[Content | None, int]:
        """Return the packet at a position, or None if it is damaged, and the position of the next one."""
        end = self._about.end
        behind = offset + PACKET_HEADER.size
        self._fill(file, offset, behind)
        number, size = self._header(offset)
        stated = behind + size
        stop: int | None = None
        if 0 <= size <= LARGEST_PACKET and stated <= end:
            stop = stated
            # The size is damaged if no packet begins behind this one, but within it.
            if stop < end and not self._begins(file, offset, stop):
                self._fill(file, offset, stop)
                stop = self._find(offset + 1, stop) or stop
        elif size >= 0 and number in self._about.streams:
            stop = self._search(file, offset + 1)
            if stop is None:
                self._note("truncated_bytes", end - offset)
                return None, end
        content = self._content(file, offset, stop, number)
        if content is None:
            # The stated size may be too small, or what seemed to be a packet may hide others.
            tried = stop
            stop = self._search(file, offset + 1) or end
            content = self._content(file, offset, stop, number) if stop != tried else None
        assert stop is not None
        if content is None:
            self._note("dropped_damaged_bytes", stop - offset)
        elif stop != stated:
            self._note("repaired_packet_sizes", 1)
        return content, stop

    def _content(
        self, file: BufferedReader, offset: int, stop: int | None, number: int
    ) -> Content | None:
        """Return the content of the packet in a part of the file, or None if it is damaged or has no end."""
        if stop is None or not 0 <= stop - offset - PACKET_HEADER.size <= LARGEST_PACKET:
            return None
        self._fill(file, offset, stop)
        data = memoryview(self._window)[
            offset + PACKET_HEADER.size - self._base : stop - self._base
        ]
        stream = self._about.streams.get(number)
        kind = "" if stream is None else stream.kind
        if stream is None or kind in self._kinds:
            content = self._decompress(data) or b""
            sound = len(content) >= 12 and 4 + number_at(U4, content, 0) <= len(content)
            if stream is None:
                sound = sound and re.fullmatch(rb"[A-Z]{4}", content[8:12]) is not None
                content = b""
            else:
                sound = sound and content[8:12] == kind.encode()
        else:
            content = b""
            sound = data[: len(self._mark)] == self._mark
        if not sound:
            return None
        if kind not in KINDS:
            self._note("packets_of_unknown_streams", 1)
        return Content(offset, stop - offset, number, kind, content)

    def _fill(self, file: BufferedReader, offset: int, stop: int) -> None:
        """Let the window hold the file from ``at`` on, at least up to ``stop`` or the end of the packets."""
        stop = min(stop, self._about.end)
        if self._base <= offset and stop <= self._base + self._held:
            return
        size = min(max(stop - offset, WINDOW_BYTES), self._about.end - offset)
        if size > len(self._window):
            self._window = bytearray(size)
        file.seek(offset)
        self._base = offset
        self._held = file.readinto(memoryview(self._window)[:size])
        if self._held < size:
            raise AmiwarpError(
                "the file became shorter while it was read; open it again",
                ErrorCode.FILE_UNREADABLE,
            )

    def _header(self, offset: int) -> tuple[int, int]:
        """Return number of the stream and size of the packet at a position; -1 and -1 beyond the window."""
        place = offset - self._base
        if place + PACKET_HEADER.size > self._held:
            return -1, -1
        number, size = PACKET_HEADER.unpack_from(self._window, place)
        return int(number), int(size)

    def _begins(self, file: BufferedReader, offset: int, place: int) -> bool:
        """Return whether a packet of a known stream begins at a place behind ``at``, from where the window starts."""
        self._fill(file, offset, place + self._lead + MARK_BYTES)
        return self._find(place, place + self._lead + MARK_BYTES) == place

    def _find(self, start: int, stop: int) -> int | None:
        """Return the position of the first packet of a known stream in a part of the window, or None."""
        stop = min(stop - self._base, self._held)
        for match in self._pattern.finditer(self._window, start - self._base + self._lead, stop):
            offset = match.start() - self._lead + self._base
            number, size = self._header(offset)
            if (
                number in self._about.streams
                and 0 < size <= self._about.end - offset - PACKET_HEADER.size
            ):
                return offset
        return None

    def _search(self, file: BufferedReader, start: int) -> int | None:
        """Return the position of the first packet of a known stream from ``start`` on, or None."""
        while start + self._lead < self._about.end:
            self._fill(file, start, start + self._lead + MARK_BYTES)
            stop = self._base + self._held
            place = self._find(start, stop)
            if place is not None or stop >= self._about.end:
                return place
            # What the pattern finds may lie across the end of the window.
            start = max(stop - self._lead - MARK_BYTES + 1, start + 1)
        return None

    def _note(self, name: str, count: int) -> None:
        self.notes[name] = self.notes.get(name, 0) + count


class Batch(NamedTuple):
    """Packets that are decoded together."""

    contents: list[Content]
    end: int
    """Position behind the last of them."""
    notes: dict[str, int]
    """Counts of what was left out up to there."""


def read_batches(about: Aedat4File, *kinds: str) -> Generator[Batch, None, None]:
    """Yield the packets of a file in order. A thread undoes the compression of the next ones meanwhile."""
    batches = _joined(Packets(about, kinds), about.end)
    with contextlib.closing(in_order(itertools.repeat(partial(next, batches, None)), 1)) as results:
        for batch in results:
            if batch is None:
                return
            yield batch


def _joined(packets: Packets, end: int) -> Iterator[Batch]:
    """Yield packets in batches; the last one may be empty, and has the final counts."""
    contents: list[Content] = []
    size = 0
    for content in packets:
        contents.append(content)
        size += len(content.data)
        if size >= BATCH_BYTES or len(contents) >= BATCH_PACKETS:
            yield Batch(contents, content.at + content.size, dict(packets.notes))
            contents = []
            size = 0
    yield Batch(contents, end, dict(packets.notes))
