"""Reader of Event Stream files (.es): events of DVS files, and change detections of ATIS files."""

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.io.file_scan import FileEvents, Packet, read_pieces
from amiwarp.io.files import errors_name, open_input

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
        if len(head) < HEADER.size - 4:  # generic events have no size
            raise AmiwarpError("the header ends beyond the file, which is truncated")
        _, major, minor, patch, kind, width, height = HEADER.unpack(head.ljust(HEADER.size, b"\0"))
        if major != 2:
            raise AmiwarpError(f"has the version {major}.{minor}.{patch}; expected 2; convert the file")
        name = TYPES.get(kind, f"unknown (type {kind})")
        if name not in ("dvs", "atis"):
            raise AmiwarpError(f"holds {name} events; expected dvs or atis")
    source = partial(_packets, path, name == "atis", height)
    events = FileEvents(path, source, size=(width, height))
    return Recording(events=events, metadata={"format": "es", **events.metadata}, name=path.stem)


def _packets(path: Path, atis: bool, height: int, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events."""
    import warp as wp

    from amiwarp.kernels.event_arrays import new_event_arrays
    from amiwarp.kernels.event_stream import EVENT_BYTES, Progress, decode_stream
    from amiwarp.kernels.launch import load, start_once

    start_once()

    load(decode_stream, wp.get_device("cpu"))
    now = 0
    rest = b""
    for piece in read_pieces(path, HEADER.size, PIECE_BYTES, notes):
        data = np.frombuffer(rest + piece, np.uint8)
        most = data.size // int(EVENT_BYTES)
        arrays = new_event_arrays(most, "cpu")
        found = wp.empty(1, dtype=Progress, device="cpu")
        inputs = [wp.array(data, dtype=wp.uint8, device="cpu", copy=False), int(atis), height, now, arrays]
        wp.launch(decode_stream, 1, inputs, [found], device="cpu")
        used, count, now = found.numpy()[0].tolist()
        rest = data[used:].tobytes()
        if rest:
            notes["truncated_bytes"] = len(rest)
        else:
            notes.pop("truncated_bytes", None)
        yield Events(*(getattr(arrays, name).numpy()[:count] for name in ("x", "y", "t", "p")))
