"""Engine of the event simulator :class:`amiwarp.Simulation`: tables on the host, kernel launches, sorting of events."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.choices import Seeing
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import NAMES, DeviceEvents, wait
from amiwarp.events.events import Events
from amiwarp.events.truth import EventTruth
from amiwarp.kernels import event_keys, launch, pixels, prism_view
from amiwarp.kernels import event_keys as readout
from amiwarp.kernels import launch as launching
from amiwarp.optics.camera import camera_params
from amiwarp.optics.models import axis_rotation, wrap_angle
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.pictures import DARK
from amiwarp.simulation.scenery import MapRing, place_scene, seen_bearings, step_us
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.renderer import WorldMapRing, WorldSight, flicker_interval_s, image_speed
from amiwarp.simulation.worlds.world import WorldScene

# Buffer on the device for the events that pixels generate, as sortable keys.

CPU_RUN = 8192
"""Number of consecutive pixels per task of a CPU thread."""

CUDA_SEGMENTS = 1024
"""Number of event buffers on CUDA; buffer k gets the events of pixels k, k + 1024, k + 2048, …"""

CACHE_LINE = 64
"""Distance between the event counters of CPU threads in memory [bytes].

Threads whose counters share a cache line would slow each other down.
"""

EVENTS_PER_PIXEL = 128
"""Initial capacity of the event buffer of a chunk [events per pixel]. The buffer grows if necessary."""


class KeyBuffer:
    """Buffer for the event keys of a chunk, in segments of pixels. The buffer grows if a chunk has more events."""

    def __init__(self, count: int, device: Any) -> None:
        """Allocate the buffer for ``count`` pixels."""
        self._pixels, self._device = count, device
        self._segments = -(-count // CPU_RUN) if device.is_cpu else min(CUDA_SEGMENTS, count)
        self._sink = pixels.Sink()
        self._sink.run = CPU_RUN if device.is_cpu else 1
        columns = CACHE_LINE // 4 if device.is_cpu else 1
        self._sink.count = wp.zeros((self._segments, columns), dtype=int, device=device)
        self._reserve(EVENTS_PER_PIXEL * -(-count // self._segments))

    def _reserve(self, capacity: int) -> None:
        """Allocate room for ``capacity`` keys per segment."""
        self._capacity = capacity
        self._sink.keys = wp.empty((self._segments, capacity), dtype=wp.int64, device=self._device)

    def run(self, kernel: Any, inputs: list[Any], state: list[wp.array], carry: wp.array) -> wp.array:
        """Simulate the pixels over a chunk and return the keys of their events, unsorted, with ``carry`` appended.

        The kernel gets the ``inputs``, then the pixels' ``state``. The array has twice the needed length, because
        sorting on CUDA needs scratch memory behind the keys.
        """
        before = [wp.clone(array) for array in state]
        while True:
            self._sink.count.zero_()
            self._launch(kernel, [*inputs, *state])
            counts = self._sink.count.numpy()[:, 0]
            if counts.max() <= self._capacity:
                return self._pack(counts, carry)
            # the buffer was too small: run again from the same state
            for array, copy in zip(state, before, strict=True):
                wp.copy(array, copy)
            self._reserve(int(counts.max()) * 5 // 4)

    def _pack(self, counts: NDArray[np.int32], carry: wp.array) -> wp.array:
        """Join the segments' keys and ``carry`` without gaps."""
        ends = np.cumsum(counts, dtype=np.int64)
        n = int(ends[-1]) + len(carry)
        keys = wp.empty(2 * n, dtype=wp.int64, device=self._device)
        if self._device.is_cpu:
            rows = self._sink.keys.numpy()
            parts = [row[:count] for row, count in zip(rows, counts.tolist(), strict=True)]
            np.concatenate([*parts, carry.numpy()], out=keys.numpy()[:n])
            return keys
        offset = wp.array((ends - counts).astype(np.int32), dtype=int, device=self._device)
        wp.launch(event_keys.pack, dim=(self._segments, int(counts.max())), inputs=[self._sink, offset, keys],
                  device=self._device)  # fmt: skip
        if len(carry):
            wp.copy(keys, carry, dest_offset=int(ends[-1]))
        return keys

    def _launch(self, kernel: Any, inputs: list[Any]) -> None:
        """Launch the kernel that simulates the pixels, for all pixels."""

        def run(start: int, stop: int) -> None:
            wp.launch(kernel, dim=stop - start, inputs=[*inputs, start, self._sink], device=self._device)

        if not self._device.is_cpu:
            run(0, self._pixels)
            return
        starts = range(0, self._pixels, CPU_RUN)
        list(launching.pool().map(run, starts, [min(start + CPU_RUN, self._pixels) for start in starts]))


# Readout of the simulated sensor: sequential readout of rows, and a bus with a queue that limits the event rate.

LONGEST_SCAN_US = 10_000.0
"""Longest allowed time to read all rows [us]. The integer keys of events can store a delay of up to 32 ms."""


class Readout:
    """Readout of one simulated sensor. Only the state of the bus is kept between blocks of events."""

    def __init__(self, simulation: SimulationValues, device: Any) -> None:
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
        self._bus = event_keys.Bus()
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
        scan = event_keys.RowScan()
        scan.row_ps, scan.scan_ps, scan.origin = self._row_ps, self._scan_ps, origin_us
        scan.width, scan.shift = self._width, shift
        launch.launch(event_keys.stamp_rows, count, [scan, keys], [], device=self._device)

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
            of_pixel = values >> int(pixels.LOW_BITS)
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
        pixel = ((keys - (t << shift)) >> int(pixels.LOW_BITS)).astype(np.int32)
        stamp = wp.empty(len(keys), dtype=wp.int64, device="cpu")
        arrays = [wp.array(t + origin_us, dtype=wp.int64, device="cpu"), wp.array(pixel, dtype=int, device="cpu")]
        launch.load(event_keys.queue_events, wp.get_device("cpu"))
        wp.launch(
            event_keys.queue_events, dim=1, inputs=[self._bus, *arrays, self._free], outputs=[stamp], device="cpu"
        )
        return np.asarray(stamp.numpy())


FRAMES_PER_CHUNK = 8
"""Largest number of pictures of a sequence that one chunk of simulated time contains."""

MAPS_PER_CHUNK = 32
"""Approximate largest number of maps of a simulated world per chunk of simulated time."""

CHUNK_US = {True: 100_000, False: 500_000}
"""Length of a chunk of simulated time [us] on a CPU (True) and on CUDA (False), for up to 640x480 pixels; shorter for
more pixels."""

RAYS_CHUNK_US = 100_000
"""Longest chunk of simulated time [us] if pixels cast rays: the chunk's luminance is held in memory."""

LATEST_US = 1 << 16
"""Largest time by which an event's time stamp can exceed the end of its chunk of simulated time [us]."""


@dataclass(slots=True)
class DeviceBlock:
    """Sorted events of one chunk of simulated time, in device memory."""

    arrays: Any
    """Columns of the events: the kernels' struct :class:`amiwarp.kernels.event_keys.Block`."""
    look: Callable[[], Any] | None = None
    """Function that finds the surfaces that the events saw, valid until the next chunk; None for a picture scene."""

    def events(self) -> Events:
        """Return the events in host memory."""
        b = self.arrays
        return Events(b.x.numpy(), b.y.numpy(), b.t.numpy(), b.p.numpy())

    def points(self) -> NDArray[np.float32]:
        """Return the scene point of each event: its pixel without the prism [px], shape (n, 2)."""
        return np.asarray(self.arrays.points.numpy())

    def on_device(self) -> tuple[DeviceEvents, wp.array]:
        """Return the finished events, and their scene points without the prism, without a copy."""
        b = self.arrays
        wait(b.t.device)
        return DeviceEvents(b.x, b.y, b.t, b.p), b.points

    def truth(self) -> EventTruth:
        """Return the ground truth of the events.

        In a world, call this method before the engine simulates the next chunk.
        """
        return EventTruth(**{name: a.numpy() for name, a in self.columns().items() if name not in NAMES})

    def columns(self) -> dict[str, wp.array]:
        """Return events and ground truth on the device, by the names of :class:`Events` and :class:`EventTruth`.

        In a world, call this method before the engine simulates the next chunk.
        """
        found = {name: getattr(self.arrays, name) for name in (*NAMES, "points", "cause")}
        if self.look is not None:
            seen = self.look()
            found |= {name: getattr(seen, name) for name in ("instance", "depth", "place")}
        return found


class Engine:
    """One run of a simulation from start to end."""

    def __init__(self, simulation: SimulationValues, chunk_us: int | None = None) -> None:
        """Place the scene and allocate the pixels' states.

        ``chunk_us``: length of a chunk of simulated time [us]; None for the default.
        """
        self._simulation = simulation
        self._device = wp.get_device(simulation.device)
        self._pixels = simulation.camera.width * simulation.camera.height
        scene = simulation.scene
        self._sight: WorldSight | None = None
        self._maps: MapRing | WorldMapRing | None = None
        longest_chunk = math.inf
        if isinstance(scene, WorldScene):
            world = DeviceWorld(scene.world, self._device)
            speed, flicker = image_speed(world, simulation, scene), flicker_interval_s(scene.world)
            self._step = step_us(simulation, world_speed=speed.total, longest=1e6 * flicker)
            longest_chunk = 1e6 * MAPS_PER_CHUNK * min(flicker, scene.motion_px / max(speed.in_maps, 1e-9))
            self._sight = WorldSight(simulation, scene, world)
            if scene.seeing is Seeing.RAYS:
                longest_chunk = RAYS_CHUNK_US
            else:
                self._maps = WorldMapRing(simulation, scene, world, seen_bearings(simulation))
        else:
            self._step = step_us(simulation)
            self._maps = MapRing(simulation, place_scene(simulation))
            if scene.frames.interval_us is not None:
                longest_chunk = FRAMES_PER_CHUNK * scene.frames.interval_us
        self._chunk_steps = self._steps_per_chunk(chunk_us, longest_chunk)
        self._margin = int(pixels.LARGEST_LAG) // (int(pixels.TICKS) * self._step) + 2
        self._axis = axis_rotation(*simulation.motion.tilt)
        self._sensor = sensor_params(simulation.sensor, self._step)
        self._view = prism_view.View()
        self._view.camera = camera_params(simulation.camera, str(self._device))
        self._view.prism = simulation.true_model.params(self._device)
        if self._maps is not None:
            self._view.width, self._view.height = self._maps.placement.width, self._maps.placement.height
        sensor = simulation.sensor
        self._filters = bool(sensor.cutoff_hz or (sensor.leak_hz and sensor.leak_jitter_fraction))
        self._readout = Readout(simulation, self._device)
        self._state = [wp.empty(self._pixels, dtype=pixels.Pixel, device=self._device)]
        self._buffer = KeyBuffer(self._pixels, self._device)
        self._nothing: wp.array = wp.empty(0, dtype=wp.int64, device=self._device)
        self._carry = self._nothing
        self.now_us = 0

    def _steps_per_chunk(self, chunk_us: int | None, longest: float) -> int:
        """Return the number of time steps per chunk.

        ``chunk_us``: length of a chunk [us], None for the default; ``longest``: upper bound of the length [us].
        """
        span = chunk_us or CHUNK_US[self._device.is_cpu] * min(self._pixels, 640 * 480) // self._pixels
        return max(1, int(min(span, longest)) // self._step)

    def prepare(self) -> None:
        """Load the kernels and read or render the first maps, which otherwise happens in the first chunk."""
        launching.load(self._kernel(), self._device)
        if self._maps is not None:
            self._maps.cover(0, self._chunk_steps * self._step)

    def run(self) -> Iterator[DeviceBlock]:
        """Yield the sorted events of successive chunks of simulated time."""
        self.prepare()
        total = -(-self._simulation.duration_us // self._step)
        for first in range(0, total, self._chunk_steps):
            count = min(self._chunk_steps, total - first)
            steps = self._tables(first, count)
            if first == 0:
                self._start_pixels(steps)
            keys = self._generate_keys(steps, count)
            block = self._unpack(keys, steps, first, count)
            self.now_us = (first + count) * self._step
            yield block

    def _tables(self, first: int, count: int) -> Any:
        """Return the kernels' tables of the instants of a chunk, computed in float64.

        ``first``: number of the chunk's first step; ``count``: number of steps.
        """
        simulation, margin = self._simulation, self._margin
        t = np.arange(first - margin, first + count + 1, dtype=np.float64) * self._step
        angle = simulation.motion.phase + simulation.motion.angle(t)
        steps = prism_view.Steps()
        table: NDArray[Any] = np.zeros(len(t), cast("Any", prism_view.Step).numpy_dtype())
        table["azimuth"] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        if self._maps is not None:
            self._fill_maps(self._maps, table, t, first, count)
        if self._sight is not None:
            self._sight.set_instants(t, self._view)
        steps.at = wp.array(table, dtype=prism_view.Step, device=self._device)
        if self._device.is_cpu:
            steps.ahead = wp.array(
                instants_in_blocks(table[margin + 1 :]), dtype=prism_view.Instants, device=self._device
            )
        steps.angle = self._upload(wrap_angle(angle))
        steps.turn = self._upload(np.diff(angle, append=2.0 * angle[-1] - angle[-2]))
        steps.per_tick = 1.0 / (self._step * int(pixels.TICKS))
        steps.shift = int(pixels.LOW_BITS) + (self._pixels - 1).bit_length()
        steps.margin, steps.count, steps.ticks = margin, count, self._step * int(pixels.TICKS)
        return steps

    def _fill_maps(
        self, maps: MapRing | WorldMapRing, table: NDArray[Any], t: NDArray[np.float64], first: int, count: int
    ) -> None:
        """Enter the maps before and after each instant, and the projection onto the maps, into ``table``.

        ``t``: instants [us], shape (n,); ``first``, ``count``: number of the chunk's first step, and number of steps.
        """
        times, slots = maps.cover(first * self._step, (first + count) * self._step)
        self._view.maps = maps.maps
        before = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
        after = np.minimum(before + 1, len(times) - 1)
        weight = np.clip((t - times[before]) / np.maximum(times[after] - times[before], 1.0), 0.0, 1.0)
        weight[before == after] = 0.0  # with weight 0 the kernel reads only one map
        orientation = maps.orientations(t)
        to_texel = maps.placement.to_texel()
        table["to_texel"] = to_texel @ self._axis if orientation is None else to_texel @ orientation @ self._axis
        table["before"], table["after"], table["weight"] = slots[before], slots[after], weight

    def _kernel(self) -> Any:
        """Return the kernel that simulates the pixels over a chunk."""
        if self._maps is None:
            return pixels.run_filtered_world_pixels if self._filters else pixels.run_world_pixels
        if self._filters:
            ahead = self._device.is_cpu
            return pixels.run_filtered_pixels_ahead if ahead else pixels.run_filtered_pixels
        return pixels.run_pixels_ahead if self._device.is_cpu else pixels.run_pixels

    def _seen(self, steps: Any, ahead: int, count: int) -> Any:
        """Return the kernels' input that describes what pixels see: the maps, or the luminance at each instant.

        ``ahead``: index of the first instant, counted from the start of the chunk; ``count``: number of instants.
        """
        if self._maps is not None or self._sight is None:
            return self._view
        return self._sight.light(steps, steps.margin + ahead, count)

    def _upload(self, values: NDArray[np.float64]) -> wp.array:
        """Copy values to the device as float32."""
        return wp.array(values.astype(np.float32), dtype=float, device=self._device)

    def _start_pixels(self, steps: Any) -> None:
        """Set the initial state of every pixel."""
        inputs = [self._seen(steps, 0, 1), steps, self._sensor, self._simulation.seed, 0, *self._state]
        kernel = pixels.start_pixels if self._maps is not None else pixels.start_world_pixels
        wp.launch(kernel, dim=self._pixels, inputs=inputs, device=self._device)
        if self._filters:  # at the start, the photoreceptors have settled to the light of the scene
            levels = np.ascontiguousarray(self._state[0].numpy()["level"])
            self._state.append(wp.array(levels, dtype=float, device=self._device))

    def _generate_keys(self, steps: Any, count: int) -> wp.array:
        """Simulate the pixels over a chunk; return the sorted keys of the events before the end of the chunk.

        Later events are kept for the next chunk.
        """
        inputs = [self._seen(steps, 1, count), steps, self._sensor]
        keys = self._buffer.run(self._kernel(), inputs, self._state, self._carry)
        limit = min(count * self._step, self._simulation.duration_us - self.now_us)
        total = len(keys) // 2
        if not total:  # Warp cannot slice an empty array
            return keys
        self._readout.stamp_rows(keys, total - len(self._carry), steps.shift, self.now_us)
        top = (limit + LATEST_US).bit_length() + steps.shift
        cut = self._sort(keys, total, limit << steps.shift, top)
        keys, self._carry = keys[:cut], wp.clone(keys[cut:total]) if cut < total else self._nothing
        if len(self._carry):  # key times are relative to the start of their chunk
            wp.launch(event_keys.rebase, dim=len(self._carry), inputs=[self._carry, count * self._step << steps.shift],
                      device=self._device)  # fmt: skip
        return keys

    def _sort(self, keys: wp.array, total: int, limit: int, top: int) -> int:
        """Sort the first ``total`` keys by their lowest ``top`` bits; return the number of keys below ``limit``."""
        if self._device.is_cpu:
            values = keys.numpy()[:total]  # shares the memory of keys
            values.sort()
            return int(np.searchsorted(values, limit))
        # without a row scan, no two events of a pixel share a microsecond: bits below the pixel's need no sorting
        lowest = int(readout.LAG_BIT) if self._readout.scans_rows else int(pixels.LOW_BITS)
        order = wp.empty(2 * total, dtype=wp.int32, device=self._device)
        wp.utils.radix_sort_pairs(keys, order, total, begin_bit=lowest, end_bit=top)
        found = wp.empty(1, dtype=int, device=self._device)
        wp.launch(event_keys.find, dim=1, inputs=[keys, total, limit], outputs=[found], device=self._device)
        return int(found.numpy()[0])

    def _unpack(self, keys: wp.array, steps: Any, first: int, count: int) -> DeviceBlock:
        """Convert sorted keys of events to a block of events with ground truth."""
        keys, stamps = self._readout.read(keys, steps.shift, first * self._step)
        n = len(keys)
        block = event_keys.Block()
        for name, dtype in (("x", wp.uint16), ("y", wp.uint16), ("t", wp.int64), ("p", wp.uint8),
                            ("cause", wp.uint8), ("points", wp.vec2), ("ticks", int)):  # fmt: skip
            setattr(block, name, wp.empty(n, dtype=dtype, device=self._device))
        inputs = [self._view, steps, keys, first * self._step]
        launching.launch(event_keys.unpack, n, inputs, [block], device=self._device)
        if stamps is not None:
            block.t = stamps
        if self._sight is None:
            return DeviceBlock(block)
        faces = (
            self._maps.faces if isinstance(self._maps, WorldMapRing) else wp.empty(0, dtype=int, device=self._device)
        )
        return DeviceBlock(block, partial(self._sight.look, self._view, steps, block, n, faces))


def instants_in_blocks(table: NDArray[Any]) -> NDArray[np.float32]:
    """Return the prism azimuths and matrices of a table of instants in blocks of 16, shape (n, 11, 16).

    The last block is padded with copies of the last instant.
    """
    ahead = int(prism_view.AHEAD)
    columns = np.concatenate([table["azimuth"], table["to_texel"].reshape(-1, 9)], axis=1)
    filled = np.concatenate([columns, np.repeat(columns[-1:], -len(columns) % ahead, axis=0)])
    return np.ascontiguousarray(filled.reshape(-1, ahead, 11).swapaxes(1, 2))


def sensor_params(sensor: SensorModel, step: int) -> Any:
    """Return the sensor's parameters in the kernels' units: ticks of 1/16 us, and time steps of ``step`` [us]."""
    ticks = float(pixels.TICKS)
    s = pixels.SensorParams()
    s.on, s.off, s.mismatch = sensor.contrast_on, sensor.contrast_off, sensor.mismatch
    s.leak = sensor.leak_hz * step * 1e-6
    s.leak_jitter = sensor.leak_jitter_fraction
    s.noise = sensor.shot_noise_hz * sensor.shot_noise_dark * 1e-6 / ticks
    s.noise_white = 1.0 / sensor.shot_noise_dark
    s.spread = math.log(10.0) * sensor.noise_rate_cov_decades
    s.bandwidth = 2.0 * math.pi * (sensor.cutoff_hz or 0.0) * step * 1e-6 / (1.0 + DARK)
    s.dark = DARK
    s.hot_fraction, s.hot = sensor.hot_fraction, sensor.hot_hz * 1e-6 / ticks
    s.refractory = round(sensor.refractory_us * ticks)
    s.latency, s.jitter = sensor.latency_us * ticks, sensor.latency_jitter_us * ticks
    return s
