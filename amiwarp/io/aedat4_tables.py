"""FlatBuffers in AEDAT 4 files: tables whose fields have their positions in a layout (vtable) that may be shared.

A position may point anywhere in a damaged file, so each is checked before it is read.
"""

import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

LARGEST_LIST = 1 << 22
"""Largest packet of IMU samples or triggers that is read [bytes]. Packets of cameras have a thousandth of it."""

U2 = struct.Struct("<H")
U4 = struct.Struct("<I")
I1 = struct.Struct("<b")
I2 = struct.Struct("<h")
I4 = struct.Struct("<i")
I8 = struct.Struct("<q")
"""Numbers without and with a sign, by their size [bytes]."""

DAMAGE = (struct.error, ValueError)
"""Exceptions of the functions that read a FlatBuffer with positions outside it."""


def number_at(form: struct.Struct, data: bytes, at: int) -> int:
    """Return a number at a position, which must not be negative: ``unpack_from`` would count from the end."""
    if at < 0:
        raise ValueError("a position lies before the data")
    return int(form.unpack_from(data, at)[0])


def _place(data: bytes, table: int, number: int) -> int:
    """Return the position of a table's field, or 0 if the table lacks it."""
    layout = table - number_at(I4, data, table)
    entry = 4 + 2 * number
    if entry + 2 > number_at(U2, data, layout):
        return 0
    offset = number_at(U2, data, layout + entry)
    return table + offset if offset else 0


def field_of(data: bytes, table: int, number: int, form: struct.Struct) -> int:
    """Return a number in a table's field; 0 if the table lacks it."""
    place = _place(data, table, number)
    return number_at(form, data, place) if place else 0


def vector_of(data: bytes, table: int, number: int, width: int) -> tuple[int, int]:
    """Return the position and the number of the elements of ``width`` bytes in a table's field."""
    place = _place(data, table, number)
    if not place:
        return 0, 0
    start = place + number_at(U4, data, place)
    count = number_at(U4, data, start)
    if start + 4 + width * count > len(data):
        raise ValueError("a vector ends beyond the data")
    return start + 4, count


def root_of(content: bytes) -> int:
    """Return the position of the table in a packet, behind its size and the position itself."""
    return 4 + number_at(U4, content, 4)


class Tables(NamedTuple):
    """Fields of the tables in some packets."""

    values: list[NDArray[Any]]
    """An array per field, shape ``(n,)``."""
    packet: NDArray[np.int64]
    """Index of the packet that holds each table, shape ``(n,)``."""
    damaged: int
    """Number of tables, and of packets without a list of tables, that are damaged and left out."""


def tables_of(contents: list[bytes], fields: dict[int, str]) -> Tables:
    """Return fields, by number and data type, of the tables that the packets list. All are read at the same time."""
    starts = []
    counts = []
    damaged = 0
    for content in contents:
        try:
            if len(content) > LARGEST_LIST:
                raise ValueError("the packet is too large")
            start, count = vector_of(content, root_of(content), 0, 4)
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
