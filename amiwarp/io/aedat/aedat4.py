"""Reader of iniVation's AEDAT 4.0 files: packets of FlatBuffers, compressed by LZ4 or Zstandard.

After a header with an XML description of the streams, a file holds packets of one stream each: events (EVTS), frames
(FRME), IMU samples (IMUS) or triggers (TRIG). A table of all packets (FTAB) may stand at the end.

Here the events are read, which :mod:`~amiwarp.io.aedat.aedat4_events` decodes. The layers below have modules of their
own: :mod:`~amiwarp.io.aedat.aedat4_tables` for the FlatBuffers, :mod:`~amiwarp.io.aedat.aedat4_compression`,
:mod:`~amiwarp.io.aedat.aedat4_header`, and :mod:`~amiwarp.io.aedat.aedat4_packets`, which finds the packets again
behind damage; :mod:`~amiwarp.io.aedat.aedat4_clock` for the times, :mod:`~amiwarp.io.aedat.aedat4_records` for what is
next to the events, and :mod:`~amiwarp.io.aedat.aedat4_writer`.
"""

import contextlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.io.aedat.aedat4_clock import Clock
from amiwarp.io.aedat.aedat4_events import decode_packets, find_events, packets_in_memory
from amiwarp.io.aedat.aedat4_header import Aedat4File, read_header
from amiwarp.io.aedat.aedat4_packets import Content, read_batches
from amiwarp.io.aedat.aedat4_records import (
    EDGES,
    TRIGGER_FIELDS,
    edge_packets,
    frame_heads,
    frame_images,
    imu_packets,
)
from amiwarp.io.aedat.aedat4_tables import tables_of
from amiwarp.io.decoding import sums_before
from amiwarp.io.event_packets import Packet, Surveyed
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.file_sensors import sensors_of
from amiwarp.io.inputs import errors_name
from amiwarp.validation import TIME_LIMIT


def open_aedat4(path: Path) -> Recording:
    """Open the first event stream of an AEDAT 4 file."""
    with errors_name(path, lambda: "reading the header"):
        about = read_header(path)
    number = about.first("EVTS")
    if number is None:
        raise AmiwarpError(
            f"{path}: has no stream of events; give a file with events", ErrorCode.CONTENT_MISSING
        )
    restarts: list[tuple[int, int]] = []
    read = partial(_event_packets, about, restarts)
    events = FileEvents(path, read, size=about.streams[number].size)
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
    return Recording(
        events=events, metadata=metadata | notes, name=path.stem, imu=imu, frames=frames
    )


def aedat4_triggers(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    with errors_name(path, lambda: "reading the header"):
        about = read_header(path)
    restarts: list[tuple[int, int]] = []
    for _ in _event_packets(about, restarts, {}):
        pass
    yield from edge_packets(about, restarts)


def _event_packets(
    about: Aedat4File, restarts: list[tuple[int, int]], notes: dict[str, int]
) -> Iterator[Packet]:
    """Yield the events of the first stream. Note other records, damage and the restarts of the clock."""
    from amiwarp.kernels.quiet_start import start_once

    start_once()
    number = about.first("EVTS")
    clock = Clock()
    notes["total"] = about.end
    damaged: dict[str, int] = {"dropped_damaged_bytes": 0, "dropped_damaged_events": 0}
    with contextlib.closing(read_batches(about, "EVTS", "IMUS", "TRIG")) as batches:
        for batch in batches:
            notes["read"] = batch.end
            _count_records(batch.contents, number, notes)
            contents = [content for content in batch.contents if content.stream == number]
            decoded = decode_packets(
                packets_in_memory([content.data for content in contents]), "cpu"
            )

            # Damaged packets give no events.
            is_sound = decoded.counts >= 0
            for index in np.flatnonzero(~is_sound):
                damaged["dropped_damaged_bytes"] += contents[index].size
            starts = sums_before(decoded.counts[is_sound])
            places = [contents[index].at for index in np.flatnonzero(is_sound)]

            # Events with impossible times are dropped.
            events = decoded.events.to_host()
            packet = Surveyed(events, decoded.surveys)
            earliest = decoded.earliest.min(initial=0)
            latest = decoded.surveys["latest"].max(initial=0)
            if earliest <= -TIME_LIMIT or latest >= TIME_LIMIT:
                has_time = (events.t > -TIME_LIMIT) & (events.t < TIME_LIMIT)
                dropped = np.flatnonzero(~has_time)
                damaged["dropped_damaged_events"] += dropped.size
                # Each packet begins earlier by the events before it that are dropped.
                starts -= np.searchsorted(dropped, starts)
                packet = Surveyed(events[has_time], None)

            for name in {*damaged, *batch.notes}:
                notes[name] = damaged.get(name, 0) + batch.notes.get(name, 0)
            if len(packet.events):
                clock.shift_all(packet.events.t, starts, places, in_order=packet.is_in_order)
                restarts[:] = clock.restarts
                notes["clock_restarts"] = len(restarts)
                yield Surveyed(packet.events, None) if restarts else packet


def _count_records(contents: list[Content], number: int | None, notes: dict[str, int]) -> None:
    """Count frames, IMU samples, triggers, and the events of other streams than ``number``."""
    data: dict[str, list[bytes]] = {"EVTS": [], "IMUS": [], "TRIG": [], "FRME": []}
    others = [content for content in contents if content.stream != number]
    if not others:
        return
    for content in others:
        data.setdefault(content.kind, []).append(content.data)
    events = find_events(packets_in_memory(data["EVTS"]), "cpu")
    samples = tables_of(data["IMUS"], {0: "<i8"})
    edges = tables_of(data["TRIG"], TRIGGER_FIELDS)
    counts = {
        "frames": len(data["FRME"]),
        "imu_samples": samples.packet.size,
        "triggers": int(np.count_nonzero(np.isin(edges.values[1], EDGES))),
        "events_of_other_sources": int(np.maximum(events["count"], 0).sum()),
        "dropped_damaged_records": samples.damaged + edges.damaged,
    }
    for name, count in counts.items():
        notes[name] = notes.get(name, 0) + count
