"""Reader of HDF5 files that store one row per event: MVSEC's and Prophesee's. They are read from the beginning."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from amiwarp.events.recording import Recording
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.reading_process import packets, run
from amiwarp.io.sensor_streams import read_sensors

READ = "amiwarp.io.hdf5_row_server:read_rows"
"""Function of the reading process."""


def open_rows(path: Path, layout: str, group: str) -> Recording:
    """Open the events of a group, which :func:`amiwarp.io.hdf5_layouts.find_layout` has found."""
    source = path.absolute()
    about = run("amiwarp.io.hdf5_row_server:read_head", source, group)
    events = FileEvents(path, partial(packets, READ, source, f"{group}/events"), size=_size(about["size"]))
    imu, frames, notes = read_sensors(path, about["counts"], "hdf5_sensors", group)
    metadata = {"format": layout, "topic": group, **about["counts"], **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu, frames=frames)


def _size(given: list[int] | None) -> tuple[int, int] | None:
    return None if given is None else (given[0], given[1])


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges of the external triggers in Prophesee's file."""
    return packets(READ, path.absolute(), "EXT_TRIGGER/events", {})
