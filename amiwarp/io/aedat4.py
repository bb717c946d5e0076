"""Reader and writer of iniVation's AEDAT 4.0 files: packets of FlatBuffers, compressed by LZ4 or Zstandard.

After a header with an XML description of the streams, a file holds packets of one stream each: events (EVTS), frames
(FRME), IMU samples (IMUS) or triggers (TRIG). A table of all packets (FTAB) may stand at the end. Every size in the
file is checked before memory is taken. A packet that is damaged is left out, and the next one is searched for.
"""

import bisect
import contextlib
import enum
import itertools
import re
import struct
from collections.abc import Collection, Generator, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, MetadataValue, Recording
from amiwarp.io.file_scan import GRAVITY, FileEvents, Packet, sensors_of
from amiwarp.io.files import errors_name, open_input
from amiwarp.io.formats import Outline
from amiwarp.tasks import in_order
from amiwarp.validation import TIME_LIMIT

MAGIC = b"#!AER-DAT4.0\r\n"
"""First bytes of a file."""

HEADER_BYTES = 1 << 24
"""Longest header that is read [bytes]."""
LARGEST_FRAME = 1 << 24
"""Content of a small packet up to which Zstandard is undone [bytes]: a black frame gains any factor."""
LARGEST_PACKET = 1 << 28
"""Largest packet that is read, before and after its compression is undone [bytes]."""
BATCH_BYTES = 1 << 21
"""Size of the packets that are decoded together [bytes]."""
BATCH_PACKETS = 1 << 12
"""Largest number of packets that are decoded together."""
LARGEST_LIST = 1 << 22
"""Largest packet of IMU samples or triggers that is read [bytes]. Those of cameras have a thousandth of it."""
WINDOW_BYTES = 1 << 22
"""Size of the part of a file that is read at once [bytes]. A larger packet is read whole."""
RESTART_US = 100_000
"""Least step back of the time that can be a restart of the camera's clock [us]."""
RESTART_EVENTS = 64
"""Number of events before and behind a restart whose times are compared."""
LEAST_BEHIND = 3
"""Fewest events behind a step back that decide whether the clock has started again."""
MOST_RESTARTS = 100
"""Largest number of restarts. With more steps back, the times are damaged, and are left as they are."""

PACKET_HEADER = struct.Struct("<ii")
"""Header of a packet: number of its stream, and size."""

EVENT = np.dtype({"names": ["t", "x", "y", "p"], "formats": ["<i8", "<i2", "<i2", "u1"],
                  "offsets": [0, 8, 10, 12], "itemsize": 16})  # fmt: skip
"""An event as a packet stores it."""


class Compression(enum.StrEnum):
    """Compression of the packets, in the order of the numbers that the header stores."""

    NONE = "none"
    LZ4 = "lz4"
    LZ4_HIGH = "lz4_high"
    ZSTD = "zstd"
    ZSTD_HIGH = "zstd_high"


LZ4_MARK, ZSTD_MARK = b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd"
FRAME_MARKS = {
    Compression.LZ4: LZ4_MARK,
    Compression.LZ4_HIGH: LZ4_MARK,
    Compression.ZSTD: ZSTD_MARK,
    Compression.ZSTD_HIGH: ZSTD_MARK,
}
"""First bytes of the packets that are compressed."""
MARK_BYTES = 4
"""Number of these bytes, and of the letters of a type."""

RISING, FALLING, PULSE = 1, 2, 3
EDGES = (RISING, FALLING, PULSE)
"""Types of triggers at the external input. Others mark the exposure and the reading of frames."""
TRIGGER_FIELDS = {0: "<i8", 1: "i1"}
"""Fields of a trigger: time and type."""

GREY_BYTES = {0: 1, 2: 2}
"""Bytes per pixel of grey frames, by their format, as OpenCV numbers it."""

KINDS = ("EVTS", "FRME", "IMUS", "TRIG")
"""Types of streams that are read."""


# FlatBuffers: tables whose fields have their positions in a layout (vtable) that may be shared.

U2, U4, I1, I2, I4, I8 = (struct.Struct(form) for form in ("<H", "<I", "<b", "<h", "<i", "<q"))

DAMAGE = (struct.error, ValueError)
"""Exceptions of the functions that read a FlatBuffer with positions outside it."""


def _number(form: struct.Struct, data: bytes, at: int) -> int:
    """Return a number at a position, which must not be negative: ``unpack_from`` would count from the end."""
    if at < 0:
        raise ValueError("a position lies before the data")
    return int(form.unpack_from(data, at)[0])


def _place(data: bytes, table: int, number: int) -> int:
    """Return the position of a table's field, or 0 if the table lacks it."""
    layout = table - _number(I4, data, table)
    entry = 4 + 2 * number
    if entry + 2 > _number(U2, data, layout):
        return 0
    offset = _number(U2, data, layout + entry)
    return table + offset if offset else 0


def _field(data: bytes, table: int, number: int, form: struct.Struct) -> int:
    """Return a number in a table's field; 0 if the table lacks it."""
    place = _place(data, table, number)
    return _number(form, data, place) if place else 0


def _vector(data: bytes, table: int, number: int, width: int) -> tuple[int, int]:
    """Return the position and the number of the elements of ``width`` bytes in a table's field."""
    place = _place(data, table, number)
    if not place:
        return 0, 0
    start = place + _number(U4, data, place)
    count = _number(U4, data, start)
    if start + 4 + width * count > len(data):
        raise ValueError("a vector ends beyond the data")
    return start + 4, count


def _root(content: bytes) -> int:
    """Return the position of the table in a packet, behind its size and the position itself."""
    return 4 + _number(U4, content, 4)


class Tables(NamedTuple):
    """Fields of the tables in some packets."""

    values: list[NDArray[Any]]
    """An array per field, shape ``(n,)``."""
    packet: NDArray[np.int64]
    """Index of the packet that holds each table, shape ``(n,)``."""
    damaged: int
    """Number of tables, and of packets without a list of tables, that are damaged and left out."""


def _tables(contents: list[bytes], fields: dict[int, str]) -> Tables:
    """Return fields, by number and data type, of the tables that the packets list. All are read at the same time."""
    starts, counts, damaged = [], [], 0
    for content in contents:
        try:
            if len(content) > LARGEST_LIST:
                raise ValueError("the packet is too large")
            start, count = _vector(content, _root(content), 0, 4)
        except DAMAGE:
            start, count = 0, 0
            damaged += 1
        starts.append(start)
        counts.append(count)
    listed = [content if count else b"" for content, count in zip(contents, counts, strict=True)]
    data = np.frombuffer(b"".join(listed), np.uint8)
    packet = np.repeat(np.arange(len(contents)), counts)
    if not packet.size:
        return Tables([np.zeros(0, dtype) for dtype in fields.values()], packet, damaged)

    sizes = np.array([len(content) for content in listed])
    ends = np.cumsum(sizes)
    low = (ends - sizes)[packet]
    high = ends[packet]
    order = np.arange(packet.size) - (np.cumsum(counts) - counts)[packet]
    inside = np.ones(packet.size, np.bool_)

    def numbers_at(places: NDArray[np.int64], dtype: str) -> NDArray[Any]:
        """Return the numbers at some places. A place outside the packet gives any number, and marks its table."""
        width = np.dtype(dtype).itemsize
        good = (places >= low) & (places + width <= high)
        np.logical_and(inside, good, out=inside)
        rows = data[np.where(good, places, low)[:, None] + np.arange(width)]
        return np.ascontiguousarray(rows).view(dtype)[:, 0]

    slots = low + np.array(starts)[packet] + 4 * order
    tables = slots + numbers_at(slots, "<u4")
    layouts = tables - numbers_at(tables, "<i4")
    lengths = numbers_at(layouts, "<u2")
    values = []
    for number, dtype in fields.items():
        entry = 4 + 2 * number
        has = lengths >= entry + 2
        offset = np.where(has, numbers_at(np.where(has, layouts + entry, layouts), "<u2"), 0)
        # A field that a table lacks is 0. What stands at the start of the packet is read, and not used.
        found = numbers_at(np.where(offset > 0, tables + offset, low), dtype)
        values.append(np.where(offset > 0, found, np.zeros(1, dtype)))
    damaged += int(packet.size - np.count_nonzero(inside))
    return Tables([value[inside] for value in values], packet[inside], damaged)


# The file: header, and packets, which are found again behind damage.


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
    """Position behind the last packet: that of the table of the packets, or the end of the file."""

    def first(self, kind: str) -> int | None:
        """Return the lowest number of a stream of this type, or None."""
        return min((number for number, stream in self.streams.items() if stream.kind == kind), default=None)


def _read_header(path: Path) -> Aedat4File:
    """Read the header; raise :class:`AmiwarpError` if it is damaged."""
    file_bytes = path.stat().st_size
    with open_input(path) as file:
        head = file.read(len(MAGIC) + U4.size)
        if not head.startswith(MAGIC) or len(head) < len(MAGIC) + U4.size:
            raise AmiwarpError(f"{path}: byte 0: is not the header of an AEDAT 4.0 file; give another file")
        size = _number(U4, head, len(MAGIC))
        start = len(head) + size
        if start > file_bytes:
            raise AmiwarpError(f"{path}: byte {len(head)}: the header ends beyond the file, which is truncated")
        if size > HEADER_BYTES:
            raise AmiwarpError(
                f"{path}: byte {len(head)}: the header has {size} bytes, more than {HEADER_BYTES}; the file is damaged"
            )
        header = file.read(size)
        try:
            # Positions count from behind the size.
            root = _number(U4, header, 0)
            number = _field(header, root, 0, I4)
            if number not in range(len(Compression)):
                raise ValueError(f"the compression has the number {number}; expected 0 to {len(Compression) - 1}")
            compression = list(Compression)[number]
            table = _field(header, root, 1, I8)
            text, length = _vector(header, root, 2, 1)
            streams = dict(_streams(ElementTree.fromstring(header[text : text + length].decode("utf-8"))))
        except (*DAMAGE, ElementTree.ParseError) as error:
            raise AmiwarpError(f"{path}: the header is damaged: {error}") from error
        has_table = start <= table < file_bytes and _is_table(file, table, file_bytes - table, compression)
    return Aedat4File(path, compression, streams, start, table if has_table else file_bytes)


def _is_table(file: BinaryIO, at: int, size: int, compression: Compression) -> bool:
    """Return whether the table of the packets is at a position, and no packet."""
    if size > LARGEST_PACKET:
        return False
    file.seek(at)
    content = _Decompressor(compression)(file.read(size)) or b""
    return content[8:12] == b"FTAB"


def _streams(description: ElementTree.Element) -> Iterator[tuple[int, Stream]]:
    """Yield number and description of each stream in the XML text of a header."""
    for node in description.iterfind("node[@name='outInfo']/node"):
        name = node.get("name", "")
        if re.fullmatch(r"[0-9]{1,9}", name):
            sides = [node.findtext(f"node[@name='info']/attr[@key='size{axis}']", "") for axis in "XY"]
            known = all(re.fullmatch(r"[0-9]{1,9}", side) for side in sides)
            size = (int(sides[0]), int(sides[1])) if known else None
            yield int(name), Stream(node.findtext("attr[@key='typeIdentifier']", ""), size)


class _Decompressor:
    """Undoes the compression of packets, within a limit of their size."""

    def __init__(self, compression: Compression) -> None:
        self._compression = compression
        self._lz4: Any = None

    def __call__(self, data: bytes | memoryview) -> bytes | None:
        """Return the content of a packet, or None if it is damaged or too large."""
        if self._compression is Compression.NONE:
            return bytes(data)
        if self._compression in (Compression.ZSTD, Compression.ZSTD_HIGH):
            return _undo_zstd(data, min(LARGEST_PACKET, 256 * len(data) + LARGEST_FRAME))
        # More than LZ4 can gain. Events of a camera gain a twentieth of it.
        most = min(LARGEST_PACKET, 256 * len(data) + (1 << 16))
        try:
            content = self._undo_lz4(data, most)
        except (RuntimeError, MemoryError):
            content = None
        if content is None:
            self._lz4 = None  # its state is that of an unfinished packet
        return content

    def _undo_lz4(self, data: bytes | memoryview, most: int) -> bytes | None:
        import lz4.frame

        if self._lz4 is None:
            self._lz4 = lz4.frame.create_decompression_context()
        # Most packets need one call. Memory for the largest packet would be taken and given back for each.
        room = min(most, 8 * len(data))
        content, used, whole = lz4.frame.decompress_chunk(self._lz4, data, max_length=room)
        parts = [content]
        size = len(content)
        while not whole and size < most:
            data = data[used:]
            content, used, whole = lz4.frame.decompress_chunk(self._lz4, data, max_length=most - size)
            if not content and not used:
                return None
            parts.append(content)
            size += len(content)
        return b"".join(parts) if whole else None


def _undo_zstd(data: bytes | memoryview, most: int) -> bytes | None:
    """Return what Zstandard has compressed, or None if it is damaged or has more than ``most`` bytes."""
    import zstandard

    try:
        stated = zstandard.frame_content_size(data)
        decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_PACKET)
        if stated > most:
            return None
        if stated >= 0:
            return bytes(decompressor.decompress(data, max_output_size=most))
        parts: list[bytes] = []
        with decompressor.stream_reader(data) as reader:
            while part := reader.read(BATCH_BYTES):
                parts.append(part)
                if sum(map(len, parts)) > most:
                    return None
        return b"".join(parts)
    except (zstandard.ZstdError, MemoryError):
        return None


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


class _Packets:
    """Pass over the packets of a file."""

    def __init__(self, about: Aedat4File, kinds: Collection[str]) -> None:
        """Undo the compression of packets of some ``kinds``; the others are only listed."""
        self._about = about
        self._kinds = kinds
        self._decompress = _Decompressor(about.compression)
        self._mark = FRAME_MARKS.get(about.compression, b"")
        """What all packets have at the start of their data, if they are compressed."""
        self._pattern = re.compile(re.escape(self._mark) if self._mark else "|".join(KINDS).encode())
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
            at = self._about.start
            while at < self._about.end:
                content, at = self._read(file, at)
                if content is not None:
                    yield content

    def _read(self, file: BufferedReader, at: int) -> tuple[Content | None, int]:
        """Return the packet at a position, or None if it is damaged, and the position of the next one."""
        end = self._about.end
        behind = at + PACKET_HEADER.size
        self._fill(file, at, behind)
        number, size = self._header(at)
        stated = behind + size
        stop: int | None = None
        if 0 <= size <= LARGEST_PACKET and stated <= end:
            stop = stated
            # The size is damaged if no packet begins behind this one, but within it.
            if stop < end and not self._begins(file, at, stop):
                self._fill(file, at, stop)
                stop = self._find(at + 1, stop) or stop
        elif size >= 0 and number in self._about.streams:
            stop = self._search(file, at + 1)
            if stop is None:
                self._note("truncated_bytes", end - at)
                return None, end
        content = self._content(file, at, stop, number)
        if content is None:
            # The stated size may be too small, or what seemed to be a packet may hide others.
            tried = stop
            stop = self._search(file, at + 1) or end
            content = self._content(file, at, stop, number) if stop != tried else None
        assert stop is not None
        if content is None:
            self._note("dropped_damaged_bytes", stop - at)
        elif stop != stated:
            self._note("repaired_packet_sizes", 1)
        return content, stop

    def _content(self, file: BufferedReader, at: int, stop: int | None, number: int) -> Content | None:
        """Return the content of the packet in a part of the file, or None if it is damaged or has no end."""
        if stop is None or not 0 <= stop - at - PACKET_HEADER.size <= LARGEST_PACKET:
            return None
        self._fill(file, at, stop)
        data = memoryview(self._window)[at + PACKET_HEADER.size - self._base : stop - self._base]
        stream = self._about.streams.get(number)
        kind = "" if stream is None else stream.kind
        if stream is None or kind in self._kinds:
            content = self._decompress(data) or b""
            sound = len(content) >= 12 and 4 + _number(U4, content, 0) <= len(content)
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
        return Content(at, stop - at, number, kind, content)

    def _fill(self, file: BufferedReader, at: int, stop: int) -> None:
        """Let the window hold the file from ``at`` on, at least up to ``stop`` or the end of the packets."""
        stop = min(stop, self._about.end)
        if self._base <= at and stop <= self._base + self._held:
            return
        size = min(max(stop - at, WINDOW_BYTES), self._about.end - at)
        if size > len(self._window):
            self._window = bytearray(size)
        file.seek(at)
        self._base = at
        self._held = file.readinto(memoryview(self._window)[:size])
        if self._held < size:
            raise AmiwarpError("the file became shorter while it was read; open it again")

    def _header(self, at: int) -> tuple[int, int]:
        """Return number of the stream and size of the packet at a position; -1 and -1 beyond the window."""
        place = at - self._base
        if place + PACKET_HEADER.size > self._held:
            return -1, -1
        number, size = PACKET_HEADER.unpack_from(self._window, place)
        return int(number), int(size)

    def _begins(self, file: BufferedReader, at: int, place: int) -> bool:
        """Return whether a packet of a known stream begins at a place behind ``at``, from where the window starts."""
        self._fill(file, at, place + self._lead + MARK_BYTES)
        return self._find(place, place + self._lead + MARK_BYTES) == place

    def _find(self, start: int, stop: int) -> int | None:
        """Return the position of the first packet of a known stream in a part of the window, or None."""
        stop = min(stop - self._base, self._held)
        for match in self._pattern.finditer(self._window, start - self._base + self._lead, stop):
            at = match.start() - self._lead + self._base
            number, size = self._header(at)
            if number in self._about.streams and 0 < size <= self._about.end - at - PACKET_HEADER.size:
                return at
        return None

    def _search(self, file: BufferedReader, start: int) -> int | None:
        """Return the position of the first packet of a known stream from ``start`` on, or None."""
        while start + self._lead < self._about.end:
            self._fill(file, start, start + self._lead + MARK_BYTES)
            stop = self._base + self._held
            found = self._find(start, stop)
            if found is not None or stop >= self._about.end:
                return found
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


def _batches(about: Aedat4File, *kinds: str) -> Generator[Batch, None, None]:
    """Yield the packets of a file in order. A thread undoes the compression of the next ones meanwhile."""
    batches = _joined(_Packets(about, kinds), about.end)
    with contextlib.closing(in_order(itertools.repeat(partial(next, batches, None)), 1)) as results:
        for batch in results:
            if batch is None:
                return
            yield batch


def _joined(packets: _Packets, end: int) -> Iterator[Batch]:
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


# Events, with the clock of the camera.


@dataclass(slots=True)
class Clock:
    """Times of the events as stored, which are made to go on where the clock of the camera starts again."""

    restarts: list[tuple[int, int]] = field(default_factory=list)
    """Positions of the packets in which the clock starts again, and what is added to the times from there on [us]."""
    _last: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Latest times, as stored [us]."""
    _is_open: bool = False
    """Whether too few events follow the last step back to decide what it is."""

    @property
    def shift(self) -> int:
        """What is added to the times now [us]."""
        return self.restarts[-1][1] if self.restarts else 0

    def shift_all(self, t: NDArray[np.int64], starts: list[int], places: list[int]) -> None:
        """Shift the times of the next events, at least one, in place [us].

        ``places`` are the positions of their packets, ``starts`` the index of the first event of each.
        """
        count = self._last.size
        if self._is_open or bool((t[1:] < t[:-1]).any()) or (count and self._last[-1] > t[0]):
            stored = np.concatenate([self._last, t])
            back = np.flatnonzero(stored[1:] < stored[:-1] - RESTART_US) + 1
        else:
            stored = t
            back = np.zeros(0, np.int64)
        last = stored[-RESTART_EVENTS:].copy()
        if self.shift:
            t += self.shift
        self._is_open = False
        # A step just before the end of the last call was not decided then.
        undecided = max(count - LEAST_BEHIND + 1, 0)
        for at in back[back >= undecided].tolist() if back.size <= MOST_RESTARTS else ():
            if stored.size - at < LEAST_BEHIND:
                self._is_open = True
                break
            before = np.sort(stored[max(at - RESTART_EVENTS, 0) : at])
            behind = np.sort(stored[at : at + RESTART_EVENTS])
            shift = self.shift + int(stored[at - 1]) - int(stored[at])
            # Times in the middle: a single wrong one changes them little.
            step = int(behind[behind.size // 2]) - int(before[(before.size - 1) // 2])
            if step < -RESTART_US and shift < TIME_LIMIT and len(self.restarts) < MOST_RESTARTS:
                first = max(at - count, 0)
                self.restarts.append((places[bisect.bisect_right(starts, first) - 1], shift))
                t[first:] = stored[count + first :] + shift
        self._last = last


class OtherClock:
    """Times of another stream than the events, which are shifted as these are."""

    def __init__(self, restarts: list[tuple[int, int]]) -> None:
        """Take the restarts of the clock, see :attr:`Clock.restarts`."""
        self._places = [place for place, _ in restarts]
        self._shifts = [0, *(shift for _, shift in restarts)]
        self._part = 0
        self._last: int | None = None

    def shift(self, t: int, place: int) -> int:
        """Return what to add to the times of the packet at ``place``, whose first time is ``t`` [us].

        The streams are not stored in step: a packet may stand on the wrong side of a restart of the clock.
        """
        part = bisect.bisect_right(self._places, place)
        if self._last is not None:
            step = t - self._last
            if part > self._part and 0 <= step < RESTART_US:
                part = self._part
            elif part == self._part and step < -RESTART_US and part + 1 < len(self._shifts):
                part += 1
        self._part, self._last = part, t
        return self._shifts[part]

    def shift_all(self, contents: list[Content], tables: Tables) -> NDArray[np.int64]:
        """Return the times in field 0 of the tables of some packets, shifted [us]."""
        t: NDArray[np.int64] = tables.values[0].astype(np.int64)
        if len(self._shifts) > 1:
            firsts = np.flatnonzero(np.diff(tables.packet, prepend=-1))
            for start, stop in itertools.pairwise([*firsts.tolist(), t.size]):
                t[start:stop] += self.shift(int(t[start]), contents[tables.packet[start]].at)
        return t


def _event_packets(about: Aedat4File, restarts: list[tuple[int, int]], notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of the first stream. Note other records, damage and the restarts of the clock."""
    number = about.first("EVTS")
    clock = Clock()
    notes["total"] = about.end
    damaged: dict[str, int] = {"dropped_damaged_bytes": 0, "dropped_damaged_events": 0}
    buffer = bytearray()  # for the events of a batch: new memory for each takes long
    with contextlib.closing(_batches(about, "EVTS", "IMUS", "TRIG")) as batches:
        for batch in batches:
            notes["read"] = batch.end
            _count_records(batch.contents, number, notes)
            found = [content for content in batch.contents if content.stream == number]
            size = sum(len(content.data) for content in found)
            buffer = buffer if size <= len(buffer) else bytearray(size)
            rows, starts, places, lost = _event_rows(found, buffer)
            damaged["dropped_damaged_bytes"] += lost
            t: NDArray[np.int64] = rows["t"].astype(np.int64)
            if t.size and not (t.min() > -TIME_LIMIT and t.max() < TIME_LIMIT):
                sound = (t > -TIME_LIMIT) & (t < TIME_LIMIT)
                damaged["dropped_damaged_events"] += int(t.size - np.count_nonzero(sound))
                starts = (np.array(starts) - np.searchsorted(np.flatnonzero(~sound), starts)).tolist()
                rows = rows[sound]
                t = t[sound]
            for name in {*damaged, *batch.notes}:
                notes[name] = damaged.get(name, 0) + batch.notes.get(name, 0)
            if t.size:
                clock.shift_all(t, starts, places)
                restarts[:] = clock.restarts
                notes["clock_restarts"] = len(restarts)
                # Negative coordinates become large ones, which lie outside the frame.
                x, y = rows["x"].astype(np.uint16), rows["y"].astype(np.uint16)
                yield Events(x, y, t, (rows["p"] != 0).view(np.uint8))


def _event_rows(contents: list[Content], buffer: bytearray) -> tuple[NDArray[Any], list[int], list[int], int]:
    """Return the events of some packets, the index of the first event and the position of each, and damaged bytes.

    The events are written into ``buffer``, which is at least as large as the packets.
    """
    starts, places = [], []
    stop = damaged = 0
    for content in contents:
        try:
            place, count = _vector(content.data, _root(content.data), 0, EVENT.itemsize)
        except DAMAGE:
            damaged += content.size
            continue
        starts.append(stop // EVENT.itemsize)
        places.append(content.at)
        size = EVENT.itemsize * count
        buffer[stop : stop + size] = memoryview(content.data)[place : place + size]
        stop += size
    return np.frombuffer(buffer, EVENT, stop // EVENT.itemsize), starts, places, damaged


def _count_records(contents: list[Content], number: int | None, notes: dict[str, int]) -> None:
    """Count frames, IMU samples, triggers, and the events of other streams than ``number``."""
    contents = [content for content in contents if content.stream != number]
    if not contents:
        return
    others = [content for content in contents if content.kind == "EVTS"]
    buffer = bytearray(sum(len(content.data) for content in others))
    samples = _tables([content.data for content in contents if content.kind == "IMUS"], {0: "<i8"})
    edges = _tables([content.data for content in contents if content.kind == "TRIG"], TRIGGER_FIELDS)
    found = {
        "frames": sum(content.kind == "FRME" for content in contents),
        "imu_samples": samples.packet.size,
        "triggers": int(np.count_nonzero(np.isin(edges.values[1], EDGES))),
        "events_of_other_sources": len(_event_rows(others, buffer)[0]),
        "dropped_damaged_records": samples.damaged + edges.damaged,
    }
    for name, count in found.items():
        notes[name] = notes.get(name, 0) + count


def open_aedat4(path: Path) -> Recording:
    """Open the first event stream of an AEDAT 4 file."""
    with errors_name(path, lambda: "reading the header"):
        about = _read_header(path)
    number = about.first("EVTS")
    if number is None:
        raise AmiwarpError(f"{path}: has no stream of events; give a file with events")
    restarts: list[tuple[int, int]] = []
    events = FileEvents(path, partial(_event_packets, about, restarts), size=about.streams[number].size)
    metadata: dict[str, MetadataValue] = {"format": "aedat4", **events.metadata}
    if restarts:
        times = "1 time" if len(restarts) == 1 else f"{len(restarts)} times"
        added = ", ".join(str(shift) for _, shift in restarts)
        metadata["clock_note"] = (
            f"started again {times}: the times behind it follow the earlier ones, for which {added} us were added"
        )
    readers = {
        "read_imu": partial(_imu_packets, about, restarts),
        "read_heads": partial(_frame_heads, about, restarts),
        "read_images": partial(_frame_images, about, restarts),
    }
    imu, frames, notes = sensors_of(path, events.records, lambda name: readers[name]())
    return Recording(events=events, metadata=metadata | notes, name=path.stem, imu=imu, frames=frames)


# Triggers, IMU samples and frames. The file's units are g and degrees per second.


def aedat4_triggers(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    with errors_name(path, lambda: "reading the header"):
        about = _read_header(path)
    restarts: list[tuple[int, int]] = []
    for _ in _event_packets(about, restarts, {}):
        pass
    clock = OtherClock(restarts)
    with contextlib.closing(_batches(about, "TRIG")) as batches:
        for batch in batches:
            contents = [content for content in batch.contents if content.kind == "TRIG"]
            found = _tables([content.data for content in contents], TRIGGER_FIELDS)
            t, source = clock.shift_all(contents, found), found.values[1]
            at = np.isin(source, EDGES)
            channel = np.zeros(np.count_nonzero(at), np.uint8)
            yield channel, channel, t[at], source[at] != FALLING


def _imu_packets(about: Aedat4File, restarts: list[tuple[int, int]]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of the first stream of IMU samples."""
    number, clock = about.first("IMUS"), OtherClock(restarts)
    # Time, acceleration x, y, z and angular velocity x, y, z.
    fields = {0: "<i8", **dict.fromkeys(range(2, 8), "<f4")}
    with contextlib.closing(_batches(about, "IMUS")) as batches:
        for batch in batches:
            contents = [content for content in batch.contents if content.stream == number]
            found = _tables([content.data for content in contents], fields)
            t = clock.shift_all(contents, found)
            values = [value.astype(np.float64) for value in found.values[1:]]
            yield t, *map(np.radians, values[3:]), *(value * GRAVITY for value in values[:3])


class Frame(NamedTuple):
    """A grey frame."""

    t: int
    """Middle of the exposure [us]."""
    width: int
    height: int
    depth: int
    """Bytes per pixel."""
    pixels: NDArray[np.uint8]
    """Bytes of the pixels."""


def _frames(about: Aedat4File, restarts: list[tuple[int, int]]) -> Iterator[Frame]:
    """Yield the frames of the first stream of frames. Raises :class:`AmiwarpError` if they are in colour."""
    number, clock = about.first("FRME"), OtherClock(restarts)
    with contextlib.closing(_batches(about, "FRME")) as batches:
        for batch in batches:
            for content in (content for content in batch.contents if content.stream == number):
                data = content.data
                try:
                    root = _root(data)
                    t, kind, width, height = (
                        _field(data, root, place, form) for place, form in ((0, I8), (5, I1), (6, I2), (7, I2))
                    )
                    start, size = _vector(data, root, 10, 1)
                except DAMAGE:
                    continue
                if kind not in GREY_BYTES:
                    raise AmiwarpError(f"the frames are in colour (format {kind} of OpenCV), not grey")
                depth = GREY_BYTES[kind]
                if min(width, height) > 0 and size == width * height * depth:
                    pixels = np.frombuffer(data, np.uint8, size, start)
                    yield Frame(t + clock.shift(t, content.at), width, height, depth, pixels)


def _frame_heads(about: Aedat4File, restarts: list[tuple[int, int]]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each frame."""
    for frame in _frames(about, restarts):
        yield tuple(np.array([value], np.int64) for value in frame[:4])


def _frame_images(about: Aedat4File, restarts: list[tuple[int, int]]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each frame."""
    for frame in _frames(about, restarts):
        yield (frame.pixels,)


# Writer: one stream of events, compressed by LZ4.

PACKET_EVENTS = 1 << 13
"""Number of events in a packet."""

EVENT_HEAD = struct.Struct("<II4s2x3HiII")
"""Start of a packet of events: size, position of its table, type; layout, table with one field, number of events."""
FILE_HEAD = struct.Struct("<I4s6x5HiIqiI")
"""Start of the header: position of its table, type; layout, table with three fields, length of the text."""
TABLE_POSITION = len(MAGIC) + U4.size + 32
"""Position in the file of the position of the table."""
TABLE_HEAD = struct.Struct("<II4s6x3HiII")
"""Start of the table of the packets: as of a packet of events."""
DEFINITION_LAYOUT = struct.Struct("<7H")
"""Layout of a row of that table."""
DEFINITION = np.dtype([("layout", "<i4"), ("position", "<i8"), ("stream", "<i4"), ("size", "<i4"), ("count", "<i8"),
                       ("first", "<i8"), ("last", "<i8"), ("padding", "<i4")])  # fmt: skip
"""Row of that table: a packet's position, stream, size, number of events, and times of the first and last [us]."""

DESCRIPTION = """<dv version="2.0">
    <node name="outInfo" path="/mainloop/Recorder/outInfo/">
        <node name="0" path="/mainloop/Recorder/outInfo/0/">
            <attr key="compression" type="string">LZ4</attr>
            <attr key="originalModuleName" type="string">amiwarp</attr>
            <attr key="originalOutputName" type="string">events</attr>
            <attr key="typeDescription" type="string">Array of events (polarity ON/OFF).</attr>
            <attr key="typeIdentifier" type="string">EVTS</attr>
            <node name="info" path="/mainloop/Recorder/outInfo/0/info/">
                <attr key="sizeX" type="int">{width}</attr>
                <attr key="sizeY" type="int">{height}</attr>
                <attr key="source" type="string">amiwarp</attr>
            </node>
        </node>
    </node>
</dv>
"""
"""Description of the stream in the header, as iniVation's recorder writes it."""


def write_aedat4(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events."""
    rows: list[tuple[int, ...]] = []
    pieces = (events[at : at + PACKET_EVENTS] for events in blocks for at in range(0, len(events), PACKET_EVENTS))
    with part.open("xb") as file, contextlib.closing(in_order(partial(_encoded, piece) for piece in pieces)) as packets:
        file.write(MAGIC + _file_header(about))
        for data, count, first, last in packets:
            file.write(PACKET_HEADER.pack(0, len(data)))
            rows.append((file.tell(), len(data), count, first, last))
            file.write(data)
        position = file.tell()
        file.write(_compressed(_packet_table(rows)))
        file.seek(TABLE_POSITION)
        file.write(I8.pack(position))


def _compressed(content: bytes) -> bytes:
    import lz4.frame

    return bytes(lz4.frame.compress(content, store_size=False))


def _encoded(events: Events) -> tuple[bytes, int, int, int]:
    """Return a packet of some events, at least one, their number, and the times of the first and last [us]."""
    rows = np.zeros(len(events), EVENT)
    for name in ("t", "x", "y", "p"):
        rows[name] = getattr(events, name)
    # The table stands at byte 20; its only field, 4 bytes on, tells that the events follow immediately.
    size = EVENT_HEAD.size - 4 + rows.nbytes
    head = EVENT_HEAD.pack(size, 16, b"EVTS", 6, 8, 4, 6, 4, len(rows))
    return _compressed(head + rows.tobytes()), len(rows), int(events.t[0]), int(events.t[-1])


def _file_header(about: Outline) -> bytes:
    """Return the header with its size. The position of the table is not known yet."""
    text = DESCRIPTION.format(width=about.width, height=about.height).encode()
    # The table stands at byte 24, with its fields at 16, 8 and 4: compression, position of the table, text.
    head = FILE_HEAD.pack(
        24, b"IOHE", 10, 20, 16, 8, 4, 10, 16, -1, list(Compression).index(Compression.LZ4), len(text)
    )
    padding = bytes(8 - (len(head) + len(text)) % 8)  # at least the byte that ends a text
    data = head + text + padding
    return U4.pack(len(data)) + data


def _packet_table(rows: list[tuple[int, ...]]) -> bytes:
    """Return the table of all packets: position, size, number of events, first and last time [us] of each."""
    count = len(rows)
    layout_at = TABLE_HEAD.size + 4 * count
    first_at = layout_at + DEFINITION_LAYOUT.size
    first_at += -(first_at + 4) % 8  # numbers of 8 bytes stand at multiples of 8
    places = first_at + DEFINITION.itemsize * np.arange(count)
    found = np.zeros(count, DEFINITION)
    found["layout"] = places - layout_at
    columns = np.array(rows, np.int64).reshape(count, 5).T
    for name, column in zip(("position", "size", "count", "first", "last"), columns, strict=True):
        found[name] = column
    slots = places - (TABLE_HEAD.size + 4 * np.arange(count))
    layout = DEFINITION_LAYOUT.pack(14, DEFINITION.itemsize - 4, 4, 12, 20, 28, 36)
    padding = bytes(first_at - layout_at - len(layout))
    body = slots.astype("<u4").tobytes() + layout + padding + found.tobytes()
    return TABLE_HEAD.pack(TABLE_HEAD.size - 4 + len(body), 20, b"FTAB", 6, 8, 4, 6, 4, count) + body
