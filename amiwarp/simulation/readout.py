"""Readout of the simulated sensor: sequential readout of rows, and a bus with a queue that limits the event rate."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import launch, loading, pixels, readout
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.sensor_model import SensorModel

LONGEST_SCAN_US = 10_000.0
"""Longest allowed time to read all rows [us]. The integer keys of events can store a delay of up to 32 ms."""


def row_scan(sensor: SensorModel, width: int, height: int) -> Any:
    """Return the scan of a sensor's rows; raise :class:`AmiwarpError` if reading all rows takes too long."""
    scan_us = sensor.row_us * height
    if scan_us > LONGEST_SCAN_US:
        raise AmiwarpError(
            f"sensor row_us = {sensor.row_us} makes a scan of {height} rows take {scan_us:.0f} us; "
            f"the limit is {LONGEST_SCAN_US:.0f} us; give a smaller row_us"
        )
    scan = readout.RowScan()
    scan.row_ps = round(sensor.row_us * 1e6)
    scan.scan_ps = int(scan.row_ps) * height
    scan.width = width
    scan.height = height
    return scan


def bus_of(sensor: SensorModel) -> Any:
    """Return the bus of a sensor; it takes no time per event if its rate is unlimited."""
    bus = readout.Bus()
    bus.event_ps = round(1e6 / sensor.bus_rate_mev_s) if sensor.bus_rate_mev_s else 0
    bus.longest_ps = round(sensor.bus_queue) * int(bus.event_ps)
    bus.shares_stamps = int(round(sensor.row_us * 1e6) > 0)
    return bus


class Readout:
    """Readout of one simulated sensor. Only the state of the bus is kept between blocks of events."""

    def __init__(self, simulation: SimulationValues, device: Any) -> None:
        """Set up the readout; raise :class:`AmiwarpError` if reading all rows takes too long."""
        sensor = simulation.sensor
        camera = simulation.camera
        self._device = device
        self._width = camera.width
        self._duration_us = simulation.duration_us
        self._scan = row_scan(sensor, camera.width, camera.height)
        self._bus = bus_of(sensor)
        self._free = wp.zeros(1, dtype=wp.int64, device="cpu")

    @property
    def scans_rows(self) -> bool:
        """Whether the sensor reads rows one after the other, instead of every event at once."""
        return int(self._scan.row_ps) > 0

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
        self._scan.since_scan_us = origin_us
        self._scan.shift = shift
        launch.launch(readout.stamp_rows, count, [self._scan, keys], [], device=self._device)

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
            # Keys of one pixel in one scan differ in their low bits only.
            above = values >> int(pixels.LOW_BITS)
            is_first = np.diff(above, prepend=above[0] - 1) != 0
            values = values[is_first]
        if not self.limits_rate:
            return wp.array(values, dtype=wp.int64, device=self._device), None
        values, stamps = self._transmit(values, shift, origin_us)
        copy = not self._device.is_cpu
        return (
            wp.array(values, dtype=wp.int64, device=self._device, copy=copy),
            wp.array(stamps, dtype=wp.int64, device=self._device, copy=copy),
        )

    def _transmit(
        self, keys: NDArray[np.int64], shift: int, origin_us: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the keys of the events that the bus transmits, and the times at which it does [us].

        The memory of ``keys`` is overwritten. Events that do not fit into the queue, or leave it after the end of the
        recording, are left out.
        """
        host = wp.get_device("cpu")
        stamp = wp.empty(len(keys), dtype=wp.int64, device=host)
        kept = wp.zeros(1, dtype=int, device=host)
        loading.load(readout.queue_keys, host)
        inputs = [self._bus, shift, self._width, origin_us, self._duration_us]
        outputs = [wp.array(keys, dtype=wp.int64, device=host, copy=False), self._free, stamp, kept]
        wp.launch(readout.queue_keys, dim=1, inputs=inputs, outputs=outputs, device=host)
        n = int(kept.numpy()[0])
        return keys[:n], stamp.numpy()[:n]
