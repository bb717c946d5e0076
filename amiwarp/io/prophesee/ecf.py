"""Decoder of Prophesee's ECF codec, with which Metavision compresses the events in its HDF5 files.

:mod:`amiwarp.io.hdf5.server_rows` reads the chunks in the reading process. They are decoded here, in the program.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.decoding import new_rows, sums_before
from amiwarp.io.event_packets import Columns, Packet
from amiwarp.io.reading_process import packets

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents

Integers = NDArray[np.int64]

MOST_EVENTS = 65535
"""Largest number of events in a chunk."""
MOST_BYTES = 32 * MOST_EVENTS
"""Largest chunk that is read [bytes]. The codec writes at most nine bytes per event, and more only for gaps of time."""
HEAD = struct.Struct("<Iq")
"""Start of a chunk: number of events, with two bits that tell how they are packed; first time [us]."""
PLAIN = np.dtype([("x", "<i8"), ("y", "<i8"), ("t", "<i8"), ("p", "<i8")])
"""An event of a chunk that is stored without the codec, as the reading process sends it."""
DAMAGE = ("", "times", "runs", "columns", "packed numbers")
"""Part of a chunk that is damaged, by the numbers of :mod:`amiwarp.kernels.ecf`."""


def event_packets(server: str, path: Path, name: str, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a dataset in the codec. ``server``: module that reads it in the reading process."""
    for data, sizes, rows, is_plain in packets(f"{server}:read_coded", path, name, notes):
        stops = np.cumsum(sizes)
        starts = stops - sizes
        # A chunk without the codec is rare: the chunks before and behind it are decoded apart.
        changes = np.flatnonzero(np.diff(is_plain)) + 1
        edges = [0, *changes.tolist(), len(sizes)]
        for first, stop in itertools.pairwise(edges):
            chunks = slice(first, stop)
            part = data[starts[first] : stops[stop - 1]]
            expected = rows[chunks]
            if is_plain[first]:
                yield _plain_columns(part, sizes[chunks], expected, name)
            else:
                try:
                    on_device, counts = decode_chunks(part, sizes[chunks])
                except AmiwarpError as error:
                    raise AmiwarpError(f"dataset '{name}': {error}") from error
                events = on_device.to_host()
                wanted = _wanted(counts, expected, name)
                yield events if wanted.all() else events[wanted]


def _plain_columns(
    data: NDArray[np.uint8],
    sizes: Integers,
    rows: Integers,
    name: str,
) -> Columns:
    """Return the events of chunks that are stored without the codec."""
    wanted = _wanted(sizes // PLAIN.itemsize, rows, name)
    events = data.view(PLAIN)[wanted]
    return events["x"], events["y"], events["t"], events["p"]


def _wanted(counts: Integers, rows: Integers, name: str) -> NDArray[np.bool_]:
    """Return which events of some chunks belong to the dataset: the last chunk may hold more than its ``rows``."""
    few = np.flatnonzero(counts < rows)
    if few.size:
        first = few[0]
        raise AmiwarpError(
            f"dataset '{name}': a chunk has {counts[first]} events; expected {rows[first]}; the file is damaged, "
            "copy it again",
            ErrorCode.FILE_DAMAGED,
        )
    chunk = np.repeat(np.arange(counts.size), counts)
    first_of_chunk = sums_before(counts)[chunk]
    index_in_chunk = np.arange(chunk.size) - first_of_chunk
    return np.asarray(index_in_chunk < rows[chunk])


def decode_chunks(
    data: bytes | NDArray[np.uint8],
    sizes: Sequence[int] | Integers,
    device: Any = "cpu",
) -> tuple[DeviceEvents, Integers]:
    """Return the events of chunks that follow one another, on a device, and the number of events of each.

    ``sizes``: sizes of the chunks [bytes]. Raises :class:`AmiwarpError` if one is damaged.
    """
    import warp as wp

    from amiwarp.events.device_events import DeviceEvents
    from amiwarp.kernels import ecf
    from amiwarp.kernels.event_arrays import new_event_arrays
    from amiwarp.kernels.launch import launch
    from amiwarp.kernels.quiet_start import start_once

    start_once()
    values = np.frombuffer(data, np.uint8)
    chunks = new_rows(len(sizes), ecf.Chunk)
    start = 0
    for chunk, size in zip(chunks, sizes, strict=True):
        stop = start + int(size)
        head, chunk["origin"] = _read_head(values[start:stop])
        chunk["start"] = start + HEAD.size
        chunk["stop"] = stop
        chunk["count"] = head >> 2
        chunk["packing"] = head & 3
        start = stop
    counts = chunks["count"].astype(np.int64)
    chunks["place"] = sums_before(counts)

    words = wp.array(values, dtype=wp.uint8, device=device, copy=False)
    on_device = wp.array(chunks, dtype=ecf.Chunk, device=device)
    parts = wp.empty(chunks.size, dtype=ecf.Parts, device=device)
    launch(ecf.survey_ecf, chunks.size, [words, on_device], [parts], device=device, smallest=1)
    damage = parts.numpy()["damage"]
    if damage.any():
        first = np.flatnonzero(damage)[0]
        what = DAMAGE[damage[first]]
        raise AmiwarpError(
            f"the {what} of a chunk of the ECF codec, number {first + 1} of {len(sizes)}, are damaged; copy the file "
            "again",
            ErrorCode.FILE_DAMAGED,
        )
    arrays = new_event_arrays(int(counts.sum()), device)
    inputs = [words, on_device, parts]
    launch(ecf.decode_ecf, chunks.size, inputs, [arrays], device=device, smallest=1)
    return DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p), counts


def _read_head(chunk: NDArray[np.uint8]) -> tuple[int, int]:
    """Return number of events with packing, and first time [us], of a chunk."""
    if chunk.size < HEAD.size:
        raise AmiwarpError(
            f"a chunk of the ECF codec has {chunk.size} bytes; expected {HEAD.size} of its head or more; the file is "
            "damaged, copy it again",
            ErrorCode.FILE_DAMAGED,
        )
    head, origin = HEAD.unpack_from(chunk.data)
    count = head >> 2
    if count > MOST_EVENTS or chunk.size > MOST_BYTES:
        raise AmiwarpError(
            f"a chunk of the ECF codec has {count} events in {chunk.size} bytes; expected at most {MOST_EVENTS} in "
            f"{MOST_BYTES}; the file is damaged, copy it again",
            ErrorCode.FILE_DAMAGED,
        )
    return head, origin
