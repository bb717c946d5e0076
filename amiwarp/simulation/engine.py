"""Engine of the event simulator: tables on the host, kernel launches, sorting of events."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import (
    event_keys,
    launch,
    loading,
    photoreceptors,
    pixels,
    prism_view,
    world_pixels,
)
from amiwarp.optics.models.angles import wrap_angle
from amiwarp.optics.models.base import model_camera
from amiwarp.optics.models.exact import axis_rotation
from amiwarp.results.pixel_map import PixelMap
from amiwarp.simulation.choices import Seeing
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.device_block import DeviceBlock
from amiwarp.simulation.image_motion import step_us
from amiwarp.simulation.key_buffer import KeyBuffer, sort_keys
from amiwarp.simulation.motion import Moved, PrismMotion, Steerer
from amiwarp.simulation.picture_light import DARK
from amiwarp.simulation.picture_maps import MapRing, place_scene
from amiwarp.simulation.readout import Readout
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.view import prism_view_of, seen_bearings, shake
from amiwarp.simulation.worlds.device_world import device_world
from amiwarp.simulation.worlds.image_speed import (
    flicker_interval_s,
    image_speed,
    largest_inverse_depth,
)
from amiwarp.simulation.worlds.map_ring import WorldMapRing
from amiwarp.simulation.worlds.sight import WorldSight
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.validation import TIME_LIMIT, whole

FRAMES_PER_CHUNK = 8
"""Largest number of pictures of a sequence that one chunk of simulated time contains."""
MAPS_PER_CHUNK = 32
"""Approximate largest number of maps of a simulated world per chunk of simulated time."""
CPU_CHUNK_US = 100_000
CUDA_CHUNK_US = 500_000
"""Length of a chunk of simulated time [us] for up to 640x480 pixels; shorter for more pixels."""
RAYS_CHUNK_US = 100_000
"""Longest chunk of simulated time [us] if pixels cast rays: the chunk's luminance is held in memory."""
LATEST_US = 1 << 16
"""Largest time by which an event's time stamp can exceed the end of its chunk of simulated time [us]."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What the pixels of a simulation look at, and the time steps that this needs."""

    maps: MapRing | WorldMapRing | None
    """Maps in which pixels look up their light; None if they cast rays."""
    sight: WorldSight | None
    """Sight of a world; None for a scene of pictures."""
    step_us: int
    """Length of a time step [us]."""
    longest_chunk_us: float
    """Upper bound of the length of a chunk of simulated time [us]."""


def surroundings(simulation: SimulationValues, device: Any) -> Surroundings:
    """Place the scene of a simulation around its camera."""
    scene = simulation.scene
    if isinstance(scene, WorldScene):
        return world_around(simulation, scene, device)
    step = step_us(simulation)
    maps = MapRing(simulation, place_scene(simulation))
    longest_chunk = math.inf
    if scene.frames.interval_us is not None:
        longest_chunk = FRAMES_PER_CHUNK * scene.frames.interval_us
    return Surroundings(maps, None, step, longest_chunk)


def world_around(simulation: SimulationValues, scene: WorldScene, device: Any) -> Surroundings:
    """Place the world of a simulation around its camera."""
    world = device_world(scene.world, device)
    speed = image_speed(world, simulation, scene)
    flicker_s = flicker_interval_s(scene.world)
    inverse_depth = 0.0
    if simulation.plate is not None:
        inverse_depth = largest_inverse_depth(
            world, simulation.camera, scene.trajectory, simulation.duration_s
        )
    step = step_us(
        simulation,
        world_speed=speed.total,
        longest=1e6 * flicker_s,
        inverse_depth=inverse_depth,
    )
    sight = WorldSight(simulation, scene, world)
    if scene.seeing is Seeing.RAYS:
        return Surroundings(None, sight, step, RAYS_CHUNK_US)
    maps = WorldMapRing(simulation, scene, world, seen_bearings(simulation))
    interval_s = min(flicker_s, scene.motion_px / max(speed.in_maps, 1e-9))
    return Surroundings(maps, sight, step, 1e6 * MAPS_PER_CHUNK * interval_s)


class Engine:
    """One run of a simulation from start to end."""

    def __init__(self, simulation: SimulationValues, chunk_us: int | None = None) -> None:
        """Place the scene and allocate the pixels' states.

        ``chunk_us``: length of a chunk of simulated time [us]; None for the default.
        """
        self._simulation = simulation
        self._device = wp.get_device(simulation.device)
        self._pixels = simulation.camera.width * simulation.camera.height

        around = surroundings(simulation, self._device)
        self._maps = around.maps
        self._sight = around.sight
        self._step = around.step_us

        # Instants before the chunk, at which pixels saw what events with a lag show; and bits of an event's key below
        # its time.
        self._margin = int(pixels.LARGEST_LAG) // (int(pixels.TICKS) * self._step) + 2
        self._shift = int(pixels.LOW_BITS) + (self._pixels - 1).bit_length()
        self._chunk_steps = self._steps_per_chunk(chunk_us, around.longest_chunk_us)

        self._axis = axis_rotation(*simulation.prism_motion.tilt)
        self._sensor = sensor_params(simulation.sensor, self._step)
        self._view = prism_view_of(simulation, self._device)
        if self._maps is not None:
            self._view.width = self._maps.placement.width
            self._view.height = self._maps.placement.height
        self._filters = has_photoreceptors(simulation.sensor)
        self._readout = Readout(simulation, self._device)
        self._state = [wp.empty(self._pixels, dtype=pixels.Pixel, device=self._device)]
        self._buffer = KeyBuffer(self._pixels, self._device)
        self._nothing: wp.array = wp.empty(0, dtype=wp.int64, device=self._device)
        self._carry = self._nothing  # keys of events after the end of the last chunk
        self.now_us = 0

    def _steps_per_chunk(self, chunk_us: int | None, longest: float) -> int:
        """Return the number of time steps per chunk.

        ``chunk_us``: length of a chunk [us], None for the default; ``longest``: upper bound of the length [us].
        """
        if chunk_us is None:
            default = CPU_CHUNK_US if self._device.is_cpu else CUDA_CHUNK_US
            span = default * min(self._pixels, 640 * 480) // self._pixels
        else:
            span = whole(chunk_us, "chunk_us", 1, TIME_LIMIT, " us")
        # First times that a key, and an int32 of ticks from the first instant on, cannot hold [us].
        beyond_keys = 1 << (63 - self._shift)
        beyond_ticks = (1 << 31) // int(pixels.TICKS) - self._margin * self._step
        span_us = int(min(span, longest, min(beyond_keys, beyond_ticks) - LATEST_US))
        return max(1, span_us // self._step)

    def prepare(self) -> None:
        """Load the kernels and read or render the first maps, which otherwise happens in the first chunk."""
        loading.load(self._kernel(), self._device)
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
            block = self._unpack(keys, steps, first)
            self.now_us = (first + count) * self._step
            yield block

    def _tables(self, first: int, count: int) -> Any:
        """Return the kernels' tables of the instants of a chunk, computed in float64.

        ``first``: number of the chunk's first step; ``count``: number of steps.
        """
        simulation = self._simulation
        margin = self._margin
        t = np.arange(first - margin, first + count + 1, dtype=np.float64) * self._step
        angle, second = true_angles(simulation.prism_motion, t)
        table: NDArray[Any] = np.zeros(len(t), cast("Any", prism_view.Step).numpy_dtype())
        table["azimuth"] = azimuths_of(angle)
        table["second"] = second_bends(simulation, t, second)
        if self._maps is not None:
            self._fill_maps(self._maps, table, t, first, count)
        if self._sight is not None:
            self._sight.set_instants(t, self._view)

        steps = prism_view.Steps()
        steps.at = wp.array(table, dtype=prism_view.Step, device=self._device)
        if self._device.is_cpu:
            ahead = instants_in_blocks(table[margin + 1 :])
            steps.ahead = wp.array(ahead, dtype=prism_view.Instants, device=self._device)
        steps.angle, steps.turn = self._angles(angle)
        steps.second_angle, steps.second_turn = self._angles(second)
        steps.per_tick = 1.0 / (self._step * int(pixels.TICKS))
        steps.shift = self._shift
        steps.margin = margin
        steps.count = count
        steps.ticks = self._step * int(pixels.TICKS)
        return steps

    def _angles(self, angle: NDArray[np.float64]) -> tuple[wp.array, wp.array]:
        """Return angles [rad] and their changes until the next instant on the device."""
        beyond_last = 2.0 * angle[-1] - angle[-2]
        changes = np.diff(angle, append=beyond_last)
        return self._upload(wrap_angle(angle)), self._upload(changes)

    def _fill_maps(
        self,
        maps: MapRing | WorldMapRing,
        table: NDArray[Any],
        t: NDArray[np.float64],
        first: int,
        count: int,
    ) -> None:
        """Enter the maps before and after each instant, and the projection onto the maps, into ``table``.

        ``t``: instants [us], shape (n,); ``first``, ``count``: number of the chunk's first step, and number of steps.
        """
        times, slots = maps.cover(first * self._step, (first + count) * self._step)
        self._view.maps = maps.maps
        before = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
        after = np.minimum(before + 1, len(times) - 1)
        interval = np.maximum(times[after] - times[before], 1.0)
        weight = np.clip((t - times[before]) / interval, 0.0, 1.0)
        weight[before == after] = 0.0  # with weight 0 the kernel reads only one map
        table["before"] = slots[before]
        table["after"] = slots[after]
        table["weight"] = weight

        orientation = maps.orientations(t)
        axis = shake(self._simulation, t) @ self._axis
        to_texel = maps.placement.to_texel()
        if orientation is not None:
            to_texel = to_texel @ orientation
        table["to_texel"] = to_texel @ axis

    def _kernel(self) -> Any:
        """Return the kernel that simulates the pixels over a chunk."""
        if self._filters:
            return self._filtered_kernel()
        if self._maps is None:
            return world_pixels.run_world_pixels
        if self._device.is_cpu:
            return pixels.run_pixels_ahead
        return pixels.run_pixels

    def _filtered_kernel(self) -> Any:
        """Return the kernel for pixels with photoreceptors that lag."""
        if self._maps is None:
            return world_pixels.run_filtered_world_pixels
        if self._device.is_cpu:
            return photoreceptors.run_filtered_pixels_ahead
        return photoreceptors.run_filtered_pixels

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
        light = self._seen(steps, 0, 1)
        inputs = [light, steps, self._sensor, self._simulation.seed, 0, *self._state]
        kernel = pixels.start_pixels if self._maps is not None else world_pixels.start_world_pixels
        loading.load(kernel, self._device)
        wp.launch(kernel, dim=self._pixels, inputs=inputs, device=self._device)
        if self._simulation.pixels is not None:
            self._set_pixels(self._simulation.pixels)
        if self._filters:
            # At the start, the photoreceptors have settled to the light of the scene.
            levels = self._state[0].numpy()["level"]
            receptor_type = cast("Any", photoreceptors.Receptor).numpy_dtype()
            settled: NDArray[Any] = np.zeros(self._pixels, receptor_type)
            settled["seen"] = levels
            settled["first"] = levels
            self._state.append(
                wp.array(settled, dtype=photoreceptors.Receptor, device=self._device)
            )

    def _set_pixels(self, given: PixelMap) -> None:
        """Give the pixels the thresholds of a map, and its hot and dead pixels."""
        per_tick = given.hot_hz * np.float32(1e-6 / int(pixels.TICKS))
        maps = (given.on, given.off, per_tick, given.dead)
        arrays = [wp.array(values.ravel(), device=self._device) for values in maps]
        inputs = [*arrays, self._sensor, self._state[0]]
        wp.launch(pixels.set_pixels, dim=self._pixels, inputs=inputs, device=self._device)

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
        # Keys that an earlier chunk left have their stamps already.
        self._readout.stamp_rows(keys, total - len(self._carry), steps.shift, self.now_us)
        top = (limit + LATEST_US).bit_length() + steps.shift
        cut = self._sort(keys, total, limit << steps.shift, top)
        self._carry = self._nothing
        if cut < total:
            # The times in keys are relative to the start of their chunk.
            self._carry = wp.clone(keys[cut:total])
            inputs = [self._carry, count * self._step << steps.shift]
            loading.load(event_keys.rebase, self._device)
            wp.launch(event_keys.rebase, dim=total - cut, inputs=inputs, device=self._device)
        return keys[:cut]

    def _sort(self, keys: wp.array, total: int, limit: int, top: int) -> int:
        """Sort the first ``total`` keys by their lowest ``top`` bits; return the number of keys below ``limit``."""
        lowest = pixels.LAG_BIT if self._readout.scans_rows else pixels.LOW_BITS
        sort_keys(keys, total, int(lowest), top)
        if self._device.is_cpu:
            return int(np.searchsorted(keys.numpy()[:total], limit))
        below_limit = wp.empty(1, dtype=int, device=self._device)
        inputs = [keys, total, limit]
        wp.launch(event_keys.find, dim=1, inputs=inputs, outputs=[below_limit], device=self._device)
        return int(below_limit.numpy()[0])

    def _unpack(self, keys: wp.array, steps: Any, first: int) -> DeviceBlock:
        """Convert sorted keys of events to a block of events with ground truth. ``first``: number of the first step."""
        keys, stamps = self._readout.read(keys, steps.shift, first * self._step)
        count = len(keys)
        block = empty_block(count, self._device)
        inputs = [self._view, steps, keys, first * self._step]
        launch.launch(event_keys.unpack, count, inputs, [block], device=self._device)
        if stamps is not None:
            block.t = stamps

        at_rest = None
        if isinstance(self._simulation.prism, Moved):
            at_rest = wp.empty_like(block.points)
            model = self._simulation.moving_model
            inputs = [model.params(self._device), model_camera(model, self._device), steps, block]
            launch.launch(
                event_keys.find_points_at_rest, count, inputs, [at_rest], device=self._device
            )
        if self._sight is None:
            return DeviceBlock(block, at_rest=at_rest)
        if isinstance(self._simulation.prism, Steerer):
            # A beam steerer does not turn the camera, by whose pose surfaces are found.
            block.points = at_rest

        if isinstance(self._maps, WorldMapRing):
            faces = self._maps.faces
        else:
            faces = wp.empty(0, dtype=int, device=self._device)
        look = partial(self._sight.look, self._view, steps, block, count, faces)
        if self._simulation.plate is not None:
            # The events' pixels without the plate depend on the surfaces, so that these are needed in any case.
            surfaces = look()
            return DeviceBlock(block, lambda: surfaces)
        return DeviceBlock(block, look, at_rest)


def empty_block(count: int, device: Any) -> Any:
    """Return the kernels' columns of ``count`` events, to be filled."""
    block = event_keys.Block()
    block.x = wp.empty(count, dtype=wp.uint16, device=device)
    block.y = wp.empty(count, dtype=wp.uint16, device=device)
    block.t = wp.empty(count, dtype=wp.int64, device=device)
    block.p = wp.empty(count, dtype=wp.uint8, device=device)
    block.cause = wp.empty(count, dtype=wp.uint8, device=device)
    block.points = wp.empty(count, dtype=wp.vec2, device=device)
    block.ticks = wp.empty(count, dtype=int, device=device)
    return block


def steps_of(simulation: SimulationValues, t_us: NDArray[np.float64], device: Any) -> Any:
    """Return the kernels' instants at times [us], for all that only looks through the optic."""
    first, second = true_angles(simulation.prism_motion, t_us)
    table: NDArray[Any] = np.zeros(len(t_us), cast("Any", prism_view.Step).numpy_dtype())
    table["azimuth"] = azimuths_of(first)
    table["second"] = second_bends(simulation, t_us, second)
    steps = prism_view.Steps()
    steps.at = wp.array(table, dtype=prism_view.Step, device=device)
    return steps


def true_angles(
    motion: PrismMotion, t_us: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the true azimuths of the prism and of the second prism [rad]; without a second prism, zeros."""
    first = motion.phase + motion.angle(t_us)
    if motion.second is None:
        return first, np.zeros(len(t_us))
    return first, motion.second.phase + motion.second.angle(t_us)


def second_bends(
    simulation: SimulationValues, t_us: NDArray[np.float64], angle: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ``second`` of the kernels' instants: by the azimuths of the second prism [rad], or the beam steerer."""
    steerer = simulation.prism
    if isinstance(steerer, Steerer):
        return steerer.model(simulation.camera).added(steerer.motion.angles(t_us))
    return azimuths_of(angle)


def azimuths_of(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return cosine and sine of angles [rad], shape (n, 2)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def instants_in_blocks(table: NDArray[Any]) -> NDArray[np.float32]:
    """Return the prism azimuths and matrices of a table of instants in blocks of 16, shape (n, 13, 16).

    The last block is padded with copies of the last instant.
    """
    ahead = int(prism_view.AHEAD)
    matrices = table["to_texel"].reshape(-1, 9)
    columns = np.concatenate([table["azimuth"], matrices, table["second"]], axis=1)
    missing = -len(columns) % ahead
    padding = np.repeat(columns[-1:], missing, axis=0)
    blocks = np.concatenate([columns, padding]).reshape(-1, ahead, 13)
    return np.ascontiguousarray(blocks.swapaxes(1, 2))


def has_photoreceptors(sensor: SensorModel) -> bool:
    """Return whether a sensor needs the kernels with photoreceptors, which also draw the leak's jitter."""
    filters = sensor.cutoff_hz or sensor.buffer_hz
    return bool(filters or (sensor.leak_hz and sensor.leak_jitter_fraction))


def sensor_params(sensor: SensorModel, step: int) -> Any:
    """Return the sensor's parameters in the kernels' units: ticks of 1/16 us, and time steps of ``step`` [us]."""
    ticks = float(pixels.TICKS)
    params = pixels.SensorParams()
    params.on = sensor.contrast_on
    params.off = sensor.contrast_off
    params.mismatch = sensor.mismatch
    params.leak = sensor.leak_hz * step * 1e-6
    params.leak_jitter = sensor.leak_jitter_fraction
    params.noise = sensor.shot_noise_hz * sensor.shot_noise_dark * 1e-6 / ticks
    params.noise_white = 1.0 / sensor.shot_noise_dark
    params.spread = math.log(10.0) * sensor.noise_rate_cov_decades
    params.bandwidth = 2.0 * math.pi * (sensor.cutoff_hz or 0.0) * step * 1e-6 / (1.0 + DARK)
    params.buffer = 2.0 * math.pi * (sensor.buffer_hz or 0.0) * step * 1e-6
    params.dark = DARK
    params.hot_fraction = sensor.hot_fraction
    params.hot = sensor.hot_hz * 1e-6 / ticks
    params.refractory = round(sensor.refractory_us * ticks)
    params.latency = sensor.latency_us * ticks
    params.jitter = sensor.latency_jitter_us * ticks
    return params
