"""Readout of the simulated sensor: sequential readout of rows, and a bus with a queue that limits the event rate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import event_generation, launch
from amiwarp.kernels import readout as kernels

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation

LONGEST_SCAN_US = 10_000.0
"""Longest allowed time to read all rows [us]. The integer keys of events can store a delay of up to 32 ms."""


class Readout:
    """Readout of one simulated sensor. Only the state of the bus is kept between blocks of events."""

    def __init__(self, simulation: Simulation, device: Any) -> None:
        """Set up the readout; raise :class:`AmiwarpError` if reading all rows takes too long."""
        sensor, camera = simulation.sensor, simulation.camera
        scan_us = sensor.row_us * camera.height
        if scan_us > LONGEST_SCAN_US:
            raise AmiwarpError(
                f"sensor row_us = {sensor.row_us} makes a scan of {camera.height} rows take {scan_us:.0f} us; "
                f"the limit is {LONGEST_SCAN_US:.0f} us; give a smaller row_us"
            )
        self._device, self._width = device, camera.width
        self._duration_us = simulation.duration_us
        self._row_ps = round(sensor.row_us * 1e6)
        self._scan_ps = self._row_ps * camera.height
        self._bus = kernels.Bus()
        self._bus.event_ps = round(1e6 / sensor.bus_rate_mev_s) if sensor.bus_rate_mev_s else 0
        self._bus.longest_ps = round(sensor.bus_queue) * int(self._bus.event_ps)
        self._bus.row = camera.width if self._row_ps else 0
        self._free = wp.zeros(1, dtype=wp.int64, device="cpu")

    @property
    def scans_rows(self) -> bool:
        """Whether the sensor reads rows one after the other, instead of every event at once."""
        return self._row_ps > 0

    @property
    def limits_rate(self) -> bool:
        """Whether the bus limits the event rate."""
        return int(self._bus.event_ps) > 0

    def stamp_rows(self, keys: wp.array, count: int, shift: int, origin_us: int) -> None:
        """Replace the times of the first ``count`` keys by the times at which their rows are read.

        ``shift``: bit position of the time in a key; ``origin_us``: time of tick 0 of the keys [us].
        """
        if not self.scans_rows or not count:
            return
        scan = kernels.RowScan()
        scan.row_ps, scan.scan_ps, scan.origin = self._row_ps, self._scan_ps, origin_us
        scan.width, scan.shift = self._width, shift
        launch.launch(kernels.stamp_rows, count, [scan, keys], [], device=self._device)

    def read(self, keys: wp.array, shift: int, origin_us: int) -> tuple[wp.array, wp.array | None]:
        """Return the keys of the events that are read out, and their time stamps [us].

        The time stamps are None if the keys already hold them.

        A row scan reads one event per pixel: later events of the pixel in the same scan are lost. Events that do not
        fit into the queue of the bus are lost, too.
        """
        if not len(keys) or not (self.scans_rows or self.limits_rate):
            return keys, None
        values = keys.numpy()
        if self.scans_rows:
            of_pixel = values >> int(event_generation.LOW_BITS)
            values = values[np.diff(of_pixel, prepend=of_pixel[0] - 1) != 0]
        stamps = None
        if self.limits_rate:
            stamp = self._transmit(values, shift, origin_us)
            kept = (stamp >= 0) & (stamp < self._duration_us)
            values = values[kept]
            stamps = wp.array(stamp[kept], dtype=wp.int64, device=self._device)
        return wp.array(values, dtype=wp.int64, device=self._device), stamps

    def _transmit(self, keys: NDArray[np.int64], shift: int, origin_us: int) -> NDArray[np.int64]:
        """Return the time at which the bus transmits each event [us]; -1 for events that do not fit into the queue."""
        t = keys >> shift
        pixel = ((keys - (t << shift)) >> int(event_generation.LOW_BITS)).astype(np.int32)
        stamp = wp.empty(len(keys), dtype=wp.int64, device="cpu")
        arrays = [wp.array(t + origin_us, dtype=wp.int64, device="cpu"), wp.array(pixel, dtype=int, device="cpu")]
        launch.load(kernels.queue_events, wp.get_device("cpu"))
        wp.launch(kernels.queue_events, dim=1, inputs=[self._bus, *arrays, self._free], outputs=[stamp], device="cpu")
        return np.asarray(stamp.numpy())
