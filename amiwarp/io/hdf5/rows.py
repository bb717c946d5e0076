"""Files of MVSEC and Prophesee, which hold one row per event. They are read from the beginning."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from amiwarp.events.recording import Recording
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.file_sensors import read_sensors
from amiwarp.io.prophesee import ecf
from amiwarp.io.reading_process import packets, run

SERVER = "amiwarp.io.hdf5.server_rows"
"""Name of the module that reads rows in the reading process."""

SENSORS = "amiwarp.io.hdf5.server_sensors"
"""Name of the module that reads IMU samples and frames in the reading process."""


def open_rows(path: Path, layout: str, group: str) -> Recording:
    """Open the events of a group, which :func:`amiwarp.io.hdf5.server_layouts.find_layout` has found."""
    source = path.absolute()
    about = run(f"{SERVER}:read_head", source, group)
    counts = about["counts"]
    size = about["size"] and tuple(about["size"])
    name = f"{group}/events"
    read = partial(packets, f"{SERVER}:read_rows", source, name)
    if about["coded"]:
        read = partial(ecf.event_packets, SERVER, source, name)
    events = FileEvents(path, read, size=size)
    imu, frames, notes = read_sensors(path, counts, SENSORS, group)
    metadata = {
        "format": layout,
        "topic": group,
        **counts,
        **events.metadata,
        **notes,
    }
    return Recording(
        events=events,
        metadata=metadata,
        name=path.stem,
        imu=imu,
        frames=frames,
    )


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges of the external triggers in Prophesee's file."""
    return packets(f"{SERVER}:read_rows", path.absolute(), "EXT_TRIGGER/events", {})
