"""Reader of AEDAT 2.0 files of jAER: DVS128 and the DAVIS cameras.

After a header of lines that begin with ``#``, each record has a 32-bit address and a 32-bit time [us], both
big-endian. The address holds an event, a sample of a frame (APS) or of the inertial unit (IMU), or an edge at the
external input. Pixels count from the bottom right, as jAER decodes them, and are turned into columns from the left,
rows from the top. :mod:`~amiwarp.io.aedat.aedat2_header` reads the header, :mod:`~amiwarp.io.aedat.aedat2_imu` the
samples of the IMU.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.events.other_sensors import ImuSamples
from amiwarp.events.recording import DEFAULT_BLOCK, Events, MetadataValue, Recording
from amiwarp.io.aedat.aedat2_decoder import Aedat2Decoder, Others
from amiwarp.io.aedat.aedat2_header import Chip, read_aedat2_header
from amiwarp.io.aedat.aedat2_imu import RANGES, SampleCount, read_ranges, read_samples
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_pieces import last_word, read_words
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.file_sensors import only_counted
from amiwarp.io.inputs import errors_name
from amiwarp.io.opening import head_limit


def open_aedat2(path: Path, chip: str | None = None) -> Recording:
    """Open the events of an AEDAT 2.0 file.

    ``chip`` is the name of the camera, one of :data:`~amiwarp.io.aedat.aedat2_header.CHIPS`. By default, it is taken
    from the header.
    """
    with errors_name(path, lambda: "reading the header"):
        camera, offset, assumed = read_aedat2_header(path, chip)
    events = FileEvents(
        path,
        partial(_event_packets, path, camera, offset),
        size=(camera.width, camera.height),
        last_time=partial(last_word, path, offset, ">u4"),
    )
    imu, notes = _imu(path, camera, offset, events)
    notes |= only_counted(events.records, "frames")
    if assumed is not None:
        name, text = assumed.entry
        notes[name] = text
    metadata = {"format": "aedat2", **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu)


def aedat2_triggers(path: Path, chip: str | None = None) -> Iterator[Packet]:
    """Yield the edges at the external input, all as rising edges of channel 0. ``chip`` as for :func:`open_aedat2`."""
    camera, offset, _ = read_aedat2_header(path, chip)
    for _, others in _decoded(path, camera, offset, {}):
        zeros = np.zeros(others.edge_t.size, np.int64)
        rising = zeros + 1
        yield zeros, zeros, others.edge_t, rising


def _imu(
    path: Path,
    chip: Chip,
    offset: int,
    events: FileEvents,
) -> tuple[ImuSamples | None, dict[str, MetadataValue]]:
    """Return the IMU samples, unless only the head of the file was read, and notes about them."""
    if not events.records.get("imu_samples") or head_limit() is not None:
        return None, {}
    notes: dict[str, MetadataValue] = {}
    ranges = read_ranges(path, offset)
    if ranges is None:
        ranges = RANGES
        notes["imu_ranges"] = f"assumed: {RANGES[0]} g and {RANGES[1]} deg/s, the defaults of jAER"
    decoded = _decoded(path, chip, offset, {})
    records = ((others.imu_words, others.imu_t) for _, others in decoded)
    return read_samples(path, records, ranges), notes


def _event_packets(
    path: Path,
    chip: Chip,
    offset: int,
    notes: dict[str, int],
) -> Iterator[Packet]:
    """Yield the events, and count other records."""
    samples = SampleCount()
    for events, others in _decoded(path, chip, offset, notes):
        found = {"triggers": others.edge_t.size}
        if chip.davis:
            found["frames"] = others.frames
            found["imu_samples"] = samples.add(others.imu_words)
        for name, count in found.items():
            notes[name] = notes.get(name, 0) + count
        yield events


def _decoded(
    path: Path,
    chip: Chip,
    offset: int,
    notes: dict[str, int],
) -> Iterator[tuple[Events, Others]]:
    """Yield what the records of a file hold."""
    import warp as wp

    from amiwarp.kernels.quiet_start import start_once

    start_once()
    decoder = Aedat2Decoder(chip, "cpu")
    for records in read_words(path, offset, "<u4", DEFAULT_BLOCK, notes):
        flat = records.ravel()
        words = wp.array(flat, dtype=wp.uint32, device="cpu", copy=False)
        events, others = decoder.decode(words)
        yield events.to_host(), others
