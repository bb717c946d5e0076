"""Reader of the folders of EV-IMO2, with ``dataset_events_t.npy`` [s], ``dataset_events_xy.npy`` and
``dataset_events_p.npy``.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import IO

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io.event_packets import Packet, microseconds
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.inputs import open_input
from amiwarp.io.numpy_arrays import Array, array_header, lengths, next_rows


def _header(stream: IO[bytes], name: str, file_bytes: int, kinds: str) -> Array:
    """Read the header of an array of ``file_bytes`` bytes, and check it. Refuse an array that is stored by columns."""
    array, by_columns = array_header(stream, f"array {name}", file_bytes, kinds)
    if by_columns:
        raise AmiwarpError(
            f"array {name} is stored by columns; save numpy.ascontiguousarray of it",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return array


EVIMO = {"t": "f", "xy": "iu", "p": "iub"}
"""Parts of the names of the files in a folder, with the kinds of data types that each may have."""


def open_evimo(path: Path) -> Recording:
    """Open the events of a folder of EV-IMO2. Its sensor size is taken from the events."""
    events = FileEvents(path, partial(_evimo_packets, path), size=None)
    metadata = {"format": "evimo2", **events.metadata}
    return Recording(events=events, metadata=metadata, name=path.name)


def _evimo_packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a folder."""
    with contextlib.ExitStack() as opened:
        arrays = {}
        for name, kinds in EVIMO.items():
            part = path / f"dataset_events_{name}.npy"
            stream = opened.enter_context(open_input(part))
            arrays[name] = _header(stream, part.name, part.stat().st_size, kinds)
        count = _check_shapes(path, arrays)
        for length in lengths(count, notes):
            t = next_rows(arrays["t"], length)
            xy = next_rows(arrays["xy"], length)
            p = next_rows(arrays["p"], length)
            yield xy[:, 0], xy[:, 1], microseconds(t.reshape(-1)), p.reshape(-1)


def _check_shapes(path: Path, arrays: Mapping[str, Array]) -> int:
    """Return the number of events. Refuse arrays that do not have one row per event."""
    counts = set()
    widths = {}
    listed = []
    for name, (_, shape, _) in arrays.items():
        counts.add(shape[0] if shape else 0)
        widths[name] = math.prod(shape[1:])
        listed.append(f"{name} {shape}")
    if len(counts) != 1 or widths != {"t": 1, "xy": 2, "p": 1}:
        shapes = ", ".join(listed)
        raise AmiwarpError(
            f"{path}: the arrays have the shapes {shapes}; expected (n,), (n, 2), (n,)",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return counts.pop()
