"""Decoder of the records of AEDAT 2.0, on a CPU or a GPU."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.aedat.aedat2_header import Chip
from amiwarp.io.decoding import new_rows, records_per_thread, sums_before

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents


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
        self._last = -1
        """Time of the last record as stored [us]."""
        self._wraps = 0

    def decode(self, words: Any) -> tuple[DeviceEvents, Others]:
        """Return what the records that follow the last call's hold. ``words``: a Warp array of uint32, as stored."""
        import warp as wp

        from amiwarp.events.device_events import DeviceEvents
        from amiwarp.kernels import aedat2
        from amiwarp.kernels.event_arrays import new_event_arrays
        from amiwarp.kernels.launch import launch

        device = self._device
        records = words.shape[0] // 2
        length = records_per_thread(device)
        blocks = math.ceil(records / length)
        inputs = [words, length, self._camera, self._last]
        counts = wp.empty(blocks, dtype=aedat2.Counts, device=device)
        launch(aedat2.survey_aedat2, blocks, inputs, [counts], device=device, smallest=1)
        totals = counts.numpy()

        # Where the output of each block begins.
        starts = new_rows(blocks, aedat2.Start)
        starts["event"] = sums_before(totals["events"])
        starts["edge"] = sums_before(totals["edges"])
        starts["imu"] = sums_before(totals["imu"])
        starts["wraps"] = self._wraps + sums_before(totals["wraps"])

        events = int(totals["events"].sum())
        edges = int(totals["edges"].sum())
        imu = int(totals["imu"].sum())
        arrays = new_event_arrays(events, device)
        others = aedat2.OtherArrays()
        others.edge_t = wp.empty(edges, dtype=wp.int64, device=device)
        others.imu_t = wp.empty(imu, dtype=wp.int64, device=device)
        others.imu_words = wp.empty(imu, dtype=wp.uint32, device=device)
        launch(
            aedat2.decode_aedat2,
            blocks,
            [*inputs, wp.array(starts, dtype=aedat2.Start, device=device)],
            [arrays, others],
            device=device,
            smallest=1,
        )
        if blocks:
            self._last = int(totals["last"][-1])
            self._wraps += int(totals["wraps"].sum())
        return DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p), Others(
            edge_t=others.edge_t.numpy(),
            imu_t=others.imu_t.numpy(),
            imu_words=others.imu_words.numpy().astype(np.int64),
            frames=int(totals["frames"].sum()),
        )
