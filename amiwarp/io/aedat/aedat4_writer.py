"""Writer of AEDAT 4 files: one stream of events, compressed by LZ4, and the table of all packets."""

import contextlib
import struct
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.events.recording import Events
from amiwarp.io.aedat.aedat4_compression import Compression, compressed
from amiwarp.io.aedat.aedat4_header import MAGIC
from amiwarp.io.aedat.aedat4_packets import EVENT, PACKET_HEADER
from amiwarp.io.aedat.aedat4_tables import I8, U4
from amiwarp.io.output_formats import Outline
from amiwarp.tasks import in_order

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
DEFINITION = np.dtype(
    [
        ("layout", "<i4"),
        ("position", "<i8"),
        ("stream", "<i4"),
        ("size", "<i4"),
        ("count", "<i8"),
        ("first", "<i8"),
        ("last", "<i8"),
        ("padding", "<i4"),
    ]
)
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
    pieces = (
        events[begin : begin + PACKET_EVENTS]
        for events in blocks
        for begin in range(0, len(events), PACKET_EVENTS)
    )
    with (
        part.open("xb") as file,
        contextlib.closing(in_order(partial(_encoded, piece) for piece in pieces)) as packets,
    ):
        file.write(MAGIC + _file_header(about))
        for data, count, first, last in packets:
            file.write(PACKET_HEADER.pack(0, len(data)))
            rows.append((file.tell(), len(data), count, first, last))
            file.write(data)
        position = file.tell()
        file.write(compressed(_packet_table(rows)))
        file.seek(TABLE_POSITION)
        file.write(I8.pack(position))


def _encoded(events: Events) -> tuple[bytes, int, int, int]:
    """Return a packet of some events, at least one, their number, and the times of the first and last [us]."""
    rows = np.zeros(len(events), EVENT)
    for name in ("t", "x", "y", "p"):
        rows[name] = getattr(events, name)
    # The table stands at byte 20; its only field, 4 bytes on, tells that the events follow immediately.
    size = EVENT_HEAD.size - 4 + rows.nbytes
    head = EVENT_HEAD.pack(size, 16, b"EVTS", 6, 8, 4, 6, 4, len(rows))
    return compressed(head + rows.tobytes()), len(rows), int(events.t[0]), int(events.t[-1])


def _file_header(about: Outline) -> bytes:
    """Return the header with its size. The position of the table is not known yet."""
    text = DESCRIPTION.format(width=about.width, height=about.height).encode()
    # The table stands at byte 24, with its fields at 16, 8 and 4: compression, position of the table, text.
    head = FILE_HEAD.pack(
        24,
        b"IOHE",
        10,
        20,
        16,
        8,
        4,
        10,
        16,
        -1,
        list(Compression).index(Compression.LZ4),
        len(text),
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
    return (
        TABLE_HEAD.pack(TABLE_HEAD.size - 4 + len(body), 20, b"FTAB", 6, 8, 4, 6, 4, count) + body
    )
