"""AEDAT 4 files of all types of packets, made by the schema of iniVation, not with the package's own code."""

import struct
from collections.abc import Callable
from typing import Any

import lz4.frame
import numpy as np
import zstandard

from amiwarp import Events
from reference.io_samples import SIZE

DOUBLE = struct.Struct("<q")
"""A number of 8 bytes."""


def table(fields: dict[int, bytes], vectors: dict[int, bytes]) -> tuple[bytes, int]:
    """A FlatBuffer table with its layout before it and its vectors behind it, and the table's position in it."""
    count = 1 + max([*fields, *vectors], default=-1)
    places, body = [0] * count, b""
    for number, data in fields.items():
        body += bytes(-(4 + len(body)) % len(data))
        places[number] = 4 + len(body)
        body += data
    for number in vectors:
        body += bytes(-len(body) % 4)
        places[number] = 4 + len(body)
        body += b"slot"
    layout = struct.pack(f"<{2 + count}H", 4 + 2 * count, 4 + len(body), *places)
    layout = bytes(-len(layout) % 8 + 4) + layout if len(layout) % 4 == 0 else bytes(2) + layout
    start = len(layout)
    out = bytearray(layout + struct.pack("<i", 4 + 2 * count) + body)
    for number, data in vectors.items():
        out += bytes(-len(out) % 4)
        struct.pack_into("<I", out, start + places[number], len(out) - start - places[number])
        out += data
    return bytes(out), start


def flat(kind: str, fields: dict[int, bytes], vectors: dict[int, bytes]) -> bytes:
    """A packet: size, position of its table, type, and table."""
    data, start = table(fields, vectors)
    body = struct.pack("<I", 8 + start) + kind.encode() + data
    return struct.pack("<I", len(body)) + body


def lists(kind: str, rows: list[dict[int, bytes]]) -> bytes:
    """A packet with a list of tables."""
    parts = [table(row, {}) for row in rows]
    at = 4 * len(parts)
    slots, body = b"", b""
    for k, (data, start) in enumerate(parts):
        slots += struct.pack("<I", at + len(body) + start - 4 * k)
        body += data + bytes(-len(data) % 4)
    return flat(kind, {}, {0: struct.pack("<I", len(parts)) + slots + body})


def events_packet(events: Events, **wrong: Any) -> bytes:
    rows = np.zeros(
        len(events), [("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("rest", "V3")]
    )
    for name in "xytp":
        rows[name] = wrong.get(name, getattr(events, name))
    rows["rest"] = b"\xff\xff\xff"  # bytes without a meaning
    return flat("EVTS", {}, {0: struct.pack("<I", len(rows)) + rows.tobytes()})


def frame_packet(t: int, pixels: np.ndarray, kind: int) -> bytes:
    sides = {6: struct.pack("<h", pixels.shape[1]), 7: struct.pack("<h", pixels.shape[0])}
    data = pixels.tobytes()
    return flat(
        "FRME",
        {0: DOUBLE.pack(t), 5: bytes([kind]), **sides},
        {10: struct.pack("<I", len(data)) + data},
    )


def imu_row(t: int, *values: float) -> dict[int, bytes]:
    """A sample with acceleration x, y, z and angular velocity x, y, z; fields of the value 0 are left out."""
    return {
        0: DOUBLE.pack(t),
        **{2 + k: struct.pack("<f", value) for k, value in enumerate(values) if value},
    }


COMPRESSIONS: dict[str, tuple[int, Callable[[bytes], bytes]]] = {
    "none": (0, bytes),
    "lz4": (1, lz4.frame.compress),
    "lz4_high": (2, lambda data: lz4.frame.compress(data, compression_level=9, store_size=False)),
    "zstd": (3, zstandard.ZstdCompressor().compress),
    "zstd_high": (4, zstandard.ZstdCompressor(level=12, write_content_size=False).compress),
}


def file_of(
    packets: list[tuple[int, bytes]],
    *,
    kinds: str = "EVTS FRME IMUS TRIG",
    compression: str = "lz4",
) -> tuple[bytes, list[int]]:
    """A file without a table, and the positions of its packets. Stream k is of the kind k."""
    sizes = f'<attr key="sizeX" type="int">{SIZE[0]}</attr><attr key="sizeY" type="int">{SIZE[1]}</attr>'
    nodes = "".join(
        f'<node name="{k}"><attr key="typeIdentifier" type="string">{kind}</attr>'
        f'<node name="info">{sizes}</node></node>'
        for k, kind in enumerate(kinds.split())
    )
    text = f'<dv version="2.0"><node name="outInfo">{nodes}</node></dv>'.encode()
    number, compress = COMPRESSIONS[compression]
    data, start = table(
        {0: struct.pack("<i", number), 1: DOUBLE.pack(-1)},
        {2: struct.pack("<I", len(text)) + text + b"\0"},
    )
    header = struct.pack("<I", 8 + start) + b"IOHE" + data
    out = b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(header)) + header
    places = []
    for stream, content in packets:
        places.append(len(out))
        packed = compress(content)
        out += struct.pack("<ii", stream, len(packed)) + packed
    return out, places


def whole_file(events: Events, compression: str) -> bytes:
    """A file with packets of all types; the frames have 8 bits."""
    rows = [
        imu_row(int(events.t[k]), 0.1, 0.2, 0.3, 1.0, 2.0, 3.0) for k in range(0, len(events), 50)
    ]
    edges = [{0: DOUBLE.pack(int(t)), 1: bytes([1 + k % 3])} for k, t in enumerate(events.t[::60])]
    image = np.arange(35, dtype=np.uint8).reshape(5, 7)
    packets = [(0, events_packet(events[at : at + 100])) for at in range(0, len(events), 100)]
    packets += [(1, frame_packet(int(t), image, 0)) for t in events.t[::150]]
    packets += [(2, lists("IMUS", rows)), (3, lists("TRIG", edges))]
    return file_of(packets, compression=compression)[0]
