"""Reader of AEDAT 2.0 files of jAER: DVS128 and the DAVIS cameras.

After a header of lines that begin with ``#``, each record has a 32-bit address and a 32-bit time [us], both
big-endian. The address holds an event, a sample of a frame (APS) or of the inertial unit (IMU), or an edge at the
external input. Pixels count from the bottom right, as jAER decodes them, and are turned into columns from the left,
rows from the top. :mod:`~amiwarp.io.aedat2_header` reads the header, :mod:`~amiwarp.io.aedat2_imu` the samples of the
IMU.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import DEFAULT_BLOCK, Events, ImuSamples, MetadataValue, Recording
from amiwarp.io import file_scan
from amiwarp.io.aedat2_header import Chip, read_aedat2_header
from amiwarp.io.aedat2_imu import RANGES, SampleCount, read_ranges, read_samples
from amiwarp.io.decoding import BLOCK_RECORDS, new_rows, sums_before
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.files import errors_name

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents


def open_aedat2(path: Path, chip: str | None = None) -> Recording:
    """Open the events of an AEDAT 2.0 file.

    ``chip`` is the name of the camera, one of :data:`~amiwarp.io.aedat2_header.CHIPS`. By default, it is taken from the
    header.
    """
    with errors_name(path, lambda: "reading the header"):
        camera, offset, assumed = read_aedat2_header(path, chip)
    read = partial(_event_packets, path, camera, offset)
    last = partial(file_scan.last_word, path, offset, ">u4")
    events = FileEvents(path, read, size=(camera.width, camera.height), last_time=last)
    imu, notes = _imu(path, camera, offset, events)
    notes |= file_scan.only_counted(events.records, "frames")
    if assumed is not None:
        name, text = assumed.entry
        notes[name] = text
    metadata = {"format": "aedat2", **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu)


def aedat2_triggers(path: Path) -> Iterator[Packet]:
    """Yield the edges at the external input, all as rising edges of channel 0."""
    chip, offset, _ = read_aedat2_header(path)
    for _, others in _decoded(path, chip, offset, {}):
        nothing = np.zeros(others.edge_t.size, np.int64)
        yield nothing, nothing, others.edge_t, nothing + 1


def _imu(path: Path, chip: Chip, offset: int, events: FileEvents) -> tuple[ImuSamples | None, dict[str, MetadataValue]]:
    """Return the IMU samples, unless only the head of the file was read, and notes about them."""
    if not events.records.get("imu_samples") or file_scan.head_limit() is not None:
        return None, {}
    ranges = read_ranges(path, offset)
    notes: dict[str, MetadataValue] = {}
    if ranges is None:
        notes["imu_ranges"] = f"assumed: {RANGES[0]} g and {RANGES[1]} deg/s, the defaults of jAER"
    records = ((others.imu_words, others.imu_t) for _, others in _decoded(path, chip, offset, {}))
    return read_samples(path, records, ranges or RANGES), notes


def _event_packets(path: Path, chip: Chip, offset: int, notes: dict[str, int]) -> Iterator[Packet]:
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


def _decoded(path: Path, chip: Chip, offset: int, notes: dict[str, int]) -> Iterator[tuple[Events, Others]]:
    """Yield what the records of a file hold."""
    import warp as wp

    from amiwarp.kernels.launch import start_once

    start_once()
    decoder = Aedat2Decoder(chip, "cpu")
    for records in file_scan.read_words(path, offset, "<u4", DEFAULT_BLOCK, notes):
        words = wp.array(records.ravel(), dtype=wp.uint32, device="cpu", copy=False)
        events, others = decoder.decode(words)
        yield events.to_host(), others


# Decoder of the records, on a CPU or a GPU.


class Others(NamedTuple):
    """What some records hold next to the events."""

    edge_t: NDArray[np.int64]
    """Times of the edges at the external input [us], shape ``(n,)``."""
    imu_t: NDArray[np.int64]
    """Times of the records of IMU samples [us], shape ``(m,)``."""
    imu_words: NDArray[np.int64]
    """Addresses of these records, shape ``(m,)``."""
    frames: int
    """Number of frames."""


class Aedat2Decoder:
    """Decoder of the records of one file or stream, in pieces."""

    def __init__(self, chip: Chip, device: Any) -> None:
        import warp as wp

        from amiwarp.kernels.aedat2 import Camera

        self._device = wp.get_device(device)
        self._camera = Camera()
        self._camera.davis = int(chip.davis)
        self._camera.width = chip.width
        self._camera.height = chip.height
        self._last = -1  # time of the last record as stored [us]
        self._wraps = 0

    def decode(self, words: Any) -> tuple[DeviceEvents, Others]:
        """Return what the records that follow the last call's hold. ``words``: a Warp array of uint32, as stored."""
        import warp as wp

        from amiwarp.events.device_events import DeviceEvents
        from amiwarp.kernels import aedat2
        from amiwarp.kernels.event_arrays import new_event_arrays
        from amiwarp.kernels.launch import launch

        device = self._device
        length = BLOCK_RECORDS[device.is_cpu]
        blocks = -(-(words.shape[0] // 2) // length)
        inputs = [words, length, self._camera, self._last]
        counts = wp.empty(blocks, dtype=aedat2.Counts, device=device)
        launch(aedat2.survey_aedat2, blocks, inputs, [counts], device=device, smallest=1)
        found = counts.numpy()
        starts = new_rows(blocks, aedat2.Start)
        starts["event"] = sums_before(found["events"])
        starts["edge"] = sums_before(found["edges"])
        starts["imu"] = sums_before(found["imu"])
        starts["wraps"] = self._wraps + sums_before(found["wraps"])

        event_arrays = new_event_arrays(int(found["events"].sum()), device)
        other_arrays = aedat2.OtherArrays()
        imu = int(found["imu"].sum())
        other_arrays.edge_t = wp.empty(int(found["edges"].sum()), dtype=wp.int64, device=device)
        other_arrays.imu_t = wp.empty(imu, dtype=wp.int64, device=device)
        other_arrays.imu_words = wp.empty(imu, dtype=wp.uint32, device=device)
        inputs = [*inputs, wp.array(starts, dtype=aedat2.Start, device=device)]
        launch(aedat2.decode_aedat2, blocks, inputs, [event_arrays, other_arrays], device=device, smallest=1)
        if blocks:
            self._last = int(found["last"][-1])
            self._wraps += int(found["wraps"].sum())
        events = DeviceEvents(event_arrays.x, event_arrays.y, event_arrays.t, event_arrays.p)
        edge_t, imu_t, imu_words = (
            array.numpy() for array in (other_arrays.edge_t, other_arrays.imu_t, other_arrays.imu_words)
        )
        return events, Others(edge_t, imu_t, imu_words.astype(np.int64), int(found["frames"].sum()))
