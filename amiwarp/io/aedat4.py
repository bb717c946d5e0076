"""Reader of iniVation's AEDAT 4.0 files: packets of FlatBuffers, compressed by LZ4 or Zstandard.

After a header with an XML description of the streams, a file holds packets of one stream each: events (EVTS), frames
(FRME), IMU samples (IMUS) or triggers (TRIG). A table of all packets (FTAB) may stand at the end.

Here the events are decoded. The layers below have modules of their own: :mod:`~amiwarp.io.aedat4_tables` for the
FlatBuffers, :mod:`~amiwarp.io.aedat4_compression`, :mod:`~amiwarp.io.aedat4_header`, and
:mod:`~amiwarp.io.aedat4_packets`, which finds the packets again behind damage; :mod:`~amiwarp.io.aedat4_clock` for the
times, :mod:`~amiwarp.io.aedat4_records` for what is next to the events, and :mod:`~amiwarp.io.aedat4_writer`.
"""

import contextlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, MetadataValue, Recording
from amiwarp.io.aedat4_clock import Clock
from amiwarp.io.aedat4_header import Aedat4File, read_header
from amiwarp.io.aedat4_packets import EVENT, Content, read_batches
from amiwarp.io.aedat4_records import EDGES, TRIGGER_FIELDS, edge_packets, frame_heads, frame_images, imu_packets
from amiwarp.io.aedat4_tables import DAMAGE, root_of, tables_of, vector_of
from amiwarp.io.file_scan import FileEvents, Packet, sensors_of
from amiwarp.io.files import errors_name
from amiwarp.validation import TIME_LIMIT

BLOCK_EVENTS = 1 << 15
"""Number of events that one thread unpacks."""


def open_aedat4(path: Path) -> Recording:
    """Open the first event stream of an AEDAT 4 file."""
    with errors_name(path, lambda: "reading the header"):
        about = read_header(path)
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
        "read_imu": partial(imu_packets, about, restarts),
        "read_heads": partial(frame_heads, about, restarts),
        "read_images": partial(frame_images, about, restarts),
    }
    imu, frames, notes = sensors_of(path, events.records, lambda name: readers[name]())
    return Recording(events=events, metadata=metadata | notes, name=path.stem, imu=imu, frames=frames)


def aedat4_triggers(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    with errors_name(path, lambda: "reading the header"):
        about = read_header(path)
    restarts: list[tuple[int, int]] = []
    for _ in _event_packets(about, restarts, {}):
        pass
    yield from edge_packets(about, restarts)


def _event_packets(about: Aedat4File, restarts: list[tuple[int, int]], notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of the first stream. Note other records, damage and the restarts of the clock."""
    number = about.first("EVTS")
    clock = Clock()
    notes["total"] = about.end
    damaged: dict[str, int] = {"dropped_damaged_bytes": 0, "dropped_damaged_events": 0}
    buffer = bytearray()  # for the events of a batch: new memory for each takes long
    with contextlib.closing(read_batches(about, "EVTS", "IMUS", "TRIG")) as batches:
        for batch in batches:
            notes["read"] = batch.end
            _count_records(batch.contents, number, notes)
            found = [content for content in batch.contents if content.stream == number]
            size = sum(len(content.data) for content in found)
            buffer = buffer if size <= len(buffer) else bytearray(size)
            rows, starts, places, lost = _event_rows(found, buffer)
            damaged["dropped_damaged_bytes"] += lost
            events = _unpacked(rows)
            t = events.t
            if t.size and not (t.min() > -TIME_LIMIT and t.max() < TIME_LIMIT):
                sound = (t > -TIME_LIMIT) & (t < TIME_LIMIT)
                damaged["dropped_damaged_events"] += int(t.size - np.count_nonzero(sound))
                # Each packet begins earlier by the events before it that are dropped.
                dropped_before = np.searchsorted(np.flatnonzero(~sound), starts)
                starts = (np.array(starts) - dropped_before).tolist()
                events = events[sound]
                t = events.t
            for name in {*damaged, *batch.notes}:
                notes[name] = damaged.get(name, 0) + batch.notes.get(name, 0)
            if t.size:
                clock.shift_all(t, starts, places)
                restarts[:] = clock.restarts
                notes["clock_restarts"] = len(restarts)
                yield events


def _unpacked(rows: NDArray[Any]) -> Events:
    """Return the events of some rows of a file."""
    import warp as wp

    from amiwarp.events.device_events import DeviceEvents
    from amiwarp.kernels.aedat4 import unpack_events
    from amiwarp.kernels.evt import new_event_arrays
    from amiwarp.kernels.launch import launch, start_once

    if not rows.size:
        return Events.empty()
    start_once()
    arrays = new_event_arrays(rows.size, "cpu")
    words = wp.array(rows.view(np.uint64), dtype=wp.uint64, device="cpu", copy=False)
    blocks = -(-rows.size // BLOCK_EVENTS)
    launch(unpack_events, blocks, [words, BLOCK_EVENTS], [arrays], device="cpu", smallest=1)
    return DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p).to_host()


def _event_rows(contents: list[Content], buffer: bytearray) -> tuple[NDArray[Any], list[int], list[int], int]:
    """Return the events of some packets, the index of the first event and the position of each, and damaged bytes.

    The events are written into ``buffer``, which is at least as large as the packets.
    """
    starts = []
    places = []
    stop = 0
    damaged = 0
    for content in contents:
        try:
            place, count = vector_of(content.data, root_of(content.data), 0, EVENT.itemsize)
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
    samples = tables_of([content.data for content in contents if content.kind == "IMUS"], {0: "<i8"})
    edges = tables_of([content.data for content in contents if content.kind == "TRIG"], TRIGGER_FIELDS)
    found = {
        "frames": sum(content.kind == "FRME" for content in contents),
        "imu_samples": samples.packet.size,
        "triggers": int(np.count_nonzero(np.isin(edges.values[1], EDGES))),
        "events_of_other_sources": len(_event_rows(others, buffer)[0]),
        "dropped_damaged_records": samples.damaged + edges.damaged,
    }
    for name, count in found.items():
        notes[name] = notes.get(name, 0) + count
