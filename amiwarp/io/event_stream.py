"""Reader of Event Stream files (.es): events of DVS files, and change detections of ATIS files."""

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events, Recording
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_pieces import read_pieces
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.inputs import errors_name, open_input

HEADER = struct.Struct("<12s4B2H")
"""Start of a file: signature, three parts of the version, type, width and height [px]."""
PIECE_BYTES = 1 << 20
"""Number of bytes that are decoded at once."""
TYPES = {0: "generic", 1: "dvs", 2: "atis", 3: "display", 4: "color", 5: "liquid"}
"""Names of the types of events."""


def open_es(path: Path) -> Recording:
    """Open an Event Stream file. Its rows are counted from the bottom, so they are flipped."""
    with errors_name(path, lambda: "reading the header"), open_input(path) as file:
        head = file.read(HEADER.size)
        # Generic events have no size.
        if len(head) < HEADER.size - 4:
            raise AmiwarpError(
                "the header ends beyond the file, which is truncated", ErrorCode.FILE_DAMAGED
            )
        padded = head.ljust(HEADER.size, b"\0")
        _, major, minor, patch, kind, width, height = HEADER.unpack(padded)
        if major != 2:
            raise AmiwarpError(
                f"has the version {major}.{minor}.{patch}; expected 2; convert the file",
                ErrorCode.FORMAT_UNKNOWN,
            )
        name = TYPES.get(kind, f"unknown (type {kind})")
        if name not in ("dvs", "atis"):
            raise AmiwarpError(
                f"holds {name} events; expected dvs or atis", ErrorCode.FORMAT_UNKNOWN
            )
    source = partial(_packets, path, name == "atis", height)
    events = FileEvents(path, source, size=(width, height))
    metadata = {"format": "es", **events.metadata}
    return Recording(events=events, metadata=metadata, name=path.stem)


def _packets(path: Path, atis: bool, height: int, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events."""
    import warp as wp

    from amiwarp.kernels.event_arrays import new_event_arrays
    from amiwarp.kernels.event_stream import EVENT_BYTES, Progress, decode_stream
    from amiwarp.kernels.loading import load
    from amiwarp.kernels.quiet_start import start_once

    start_once()
    load(decode_stream, wp.get_device("cpu"))
    now = 0
    rest = b""
    for piece in read_pieces(path, HEADER.size, PIECE_BYTES, notes):
        data = np.frombuffer(rest + piece, np.uint8)
        most = data.size // int(EVENT_BYTES)
        arrays = new_event_arrays(most, "cpu")
        found = wp.empty(1, dtype=Progress, device="cpu")
        values = wp.array(data, dtype=wp.uint8, device="cpu", copy=False)
        inputs = [values, int(atis), height, now, arrays]
        wp.launch(decode_stream, 1, inputs, [found], device="cpu")
        used, count, now = found.numpy()[0].tolist()
        rest = data[used:].tobytes()
        if rest:
            notes["truncated_bytes"] = len(rest)
        else:
            notes.pop("truncated_bytes", None)
        yield Events(
            arrays.x.numpy()[:count],
            arrays.y.numpy()[:count],
            arrays.t.numpy()[:count],
            arrays.p.numpy()[:count],
        )
