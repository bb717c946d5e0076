"""FlatBuffers in AEDAT 4 files: tables whose fields have their positions in a layout (vtable) that may be shared.

A position may point anywhere in a damaged file, so each is checked before it is read.
"""

import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

LARGEST_LIST = 1 << 22
"""Largest packet of IMU samples or triggers that is read [bytes]. Packets of cameras have a thousandth of it."""

# Numbers without and with a sign, by their size [bytes].
U2 = struct.Struct("<H")
U4 = struct.Struct("<I")
I1 = struct.Struct("<b")
I2 = struct.Struct("<h")
I4 = struct.Struct("<i")
I8 = struct.Struct("<q")

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
    if not place:
        return 0
    return number_at(form, data, place)


def vector_of(data: bytes, table: int, number: int, width: int) -> tuple[int, int]:
    """Return the position and the number of the elements of ``width`` bytes in a table's field."""
    place = _place(data, table, number)
    if not place:
        return 0, 0
    length_at = place + number_at(U4, data, place)
    count = number_at(U4, data, length_at)
    start = length_at + 4
    if start + width * count > len(data):
        raise ValueError("a vector ends beyond the data")
    return start, count


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
    starts, counts, damaged = _lists_of(contents)
    packet = np.repeat(np.arange(len(contents)), counts)
    if not packet.size:
        nothing = [np.zeros(0, dtype) for dtype in fields.values()]
        return Tables(nothing, packet, damaged)

    # The packets with tables are laid behind each other. Each table knows the places where its packet begins and ends.
    joined = [content if count else b"" for content, count in zip(contents, counts, strict=True)]
    data = np.frombuffer(b"".join(joined), np.uint8)
    sizes = np.array([len(content) for content in joined])
    ends = np.cumsum(sizes)
    begins = ends - sizes
    low = begins[packet]
    high = ends[packet]
    inside = np.ones(packet.size, np.bool_)

    def numbers_at(places: NDArray[np.int64], dtype: str) -> NDArray[Any]:
        """Return the numbers at some places. A place outside the packet gives any number, and marks its table."""
        width = np.dtype(dtype).itemsize
        good = (places >= low) & (places + width <= high)
        np.logical_and(inside, good, out=inside)
        first_bytes = np.where(good, places, low)
        rows = data[first_bytes[:, None] + np.arange(width)]
        numbers = np.ascontiguousarray(rows).view(dtype)
        return numbers[:, 0]

    # From the list of a packet to its tables, and from each table to its layout.
    tables_before = np.cumsum(counts) - counts
    index_in_list = np.arange(packet.size) - tables_before[packet]
    slots = low + np.array(starts)[packet] + 4 * index_in_list
    tables = slots + numbers_at(slots, "<u4")
    layouts = tables - numbers_at(tables, "<i4")
    lengths = numbers_at(layouts, "<u2")

    values = []
    for number, dtype in fields.items():
        entry = 4 + 2 * number
        has_entry = lengths >= entry + 2
        entries = numbers_at(np.where(has_entry, layouts + entry, layouts), "<u2")
        offset = np.where(has_entry, entries, 0)
        # A field that a table lacks is 0. What stands at the start of the packet is read, and not used.
        has_field = offset > 0
        found = numbers_at(np.where(has_field, tables + offset, low), dtype)
        values.append(np.where(has_field, found, np.zeros(1, dtype)))
    damaged += int(packet.size - np.count_nonzero(inside))
    return Tables([value[inside] for value in values], packet[inside], damaged)


def _lists_of(contents: list[bytes]) -> tuple[list[int], list[int], int]:
    """Return where the list of tables begins in each packet, how many it lists, and how many packets are damaged."""
    starts = []
    counts = []
    damaged = 0
    for content in contents:
        try:
            if len(content) > LARGEST_LIST:
                raise ValueError("the packet is too large")
            start, count = vector_of(content, root_of(content), 0, 4)
        except DAMAGE:
            start = 0
            count = 0
            damaged += 1
        starts.append(start)
        counts.append(count)
    return starts, counts, damaged
