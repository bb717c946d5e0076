"""Simulate the events of an event camera from a picture or a world, a camera and a prism, with ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.choices import Seeing
from amiwarp.errors import AmiwarpError
from amiwarp.events import truth
from amiwarp.events.device_events import NAMES, DeviceEvents, DeviceMemoryEvents, DeviceValues, join, wait
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, EventSource, MemoryEvents, MetadataValue, Recording
from amiwarp.events.truth import EventTruth, EventValues, FrameTruth, Poses, Truth
from amiwarp.io import RecordingWriter
from amiwarp.io.pixel_map import PixelMap
from amiwarp.kernels import event_keys, launch, pixels, prism_view
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import ExactModel, Model, PlateModel, axis_rotation, model_camera, wrap_angle
from amiwarp.optics.prism import Plate, Prism
from amiwarp.simulation import scenery
from amiwarp.simulation.description import (
    CameraMotion,
    EncoderModel,
    Mirror,
    Moved,
    PrismMotion,
    Scene,
    SimulationValues,
    Vibration,
)
from amiwarp.simulation.pictures import DARK
from amiwarp.simulation.scenery import DeviceWorld, MapRing, WorldMapRing, WorldSight
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.tasks import Progress
from amiwarp.validation import TIME_LIMIT, array, guarded, real, shown, whole

# Ground truth of a simulated world at an instant: depth, normals, instances, optical flow and luminance.

ANGLE = 1e-3
"""Half of the angle over which derivatives with respect to direction are difference quotients [rad]."""
DEFLECTING_STEPS = 4
"""Number of steps of the fixed-point iteration that finds the pixel that sees a point through a plate."""
NEARER = 1e-3
"""Relative difference of depth from which a surface hides a point."""
OUTSIDE = 2
"""Value of :attr:`amiwarp.FrameTruth.occlusion` for points outside the image."""
MOMENT_S = 1e-4
"""Time between the moments whose difference quotient is the optical flow [s]."""


def rate_of_change(
    value_at: Callable[[float], NDArray[np.float64]], t: float, duration_s: float
) -> NDArray[np.float64]:
    """Return the rate at which a value changes at the time ``t`` [s], from its values at two or three moments.

    ``value_at`` returns the value at a moment [s]. All moments lie within the recording, because cameras, bodies and
    optics may rest before and after it. At its ends the rate is that of the parabola through three moments on one side,
    elsewhere the central difference quotient.
    """
    step = min(MOMENT_S, duration_s / 2.0)
    centre = t
    if 0.0 <= t <= duration_s:
        centre = min(max(t, step), duration_s - step)
    after_t = (centre - t) + step * np.array([-1.0, 0.0, 1.0])
    first = value_at(t + float(after_t[0]))
    rate = np.zeros_like(first)
    for k in (1, 2):
        others = np.delete(after_t, k)
        weight = float(-others.sum() / np.prod(after_t[k] - others))
        if weight:
            # the weights of all three sum to 0, and a value that does not change has no rate, not even a rounding error
            rate += weight * (value_at(t + float(after_t[k])) - first)
    return rate


@guarded
class TruthRenderer:
    """Renders the ground truth of a simulated world at any instant.

    Parameters
    ----------
    simulation : Simulation
        Simulation whose scene is a :class:`amiwarp.WorldScene`.

    Raises
    ------
    AmiwarpError
        If the scene of the simulation is a picture.

    Examples
    --------
    >>> square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> world = amiwarp.World("example", (amiwarp.Body("wall", square),))
    >>> way = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    >>> simulation = amiwarp.Simulation(
    ...     amiwarp.WorldScene(world, way), amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.01), duration_s=0.01)
    >>> round(float(amiwarp.TruthRenderer(simulation).at(0).depth[12, 16]), 3)
    2.0
    """

    def __init__(self, simulation: SimulationValues) -> None:
        if not isinstance(simulation.scene, WorldScene):
            raise AmiwarpError("the scene is a picture at infinity, which has no depth; give a WorldScene as the scene")
        self._simulation, self._scene = simulation, simulation.scene
        self._world = DeviceWorld(self._scene.world, simulation.device)
        self._sight = self._sight_at_rest = WorldSight(simulation, self._scene, self._world)
        if isinstance(simulation.prism, Moved):
            self._sight_at_rest = WorldSight(simulation.at_rest, self._scene, self._world)
        self._rays = scenery.pixel_rays(simulation.camera)
        self._pixels = simulation.camera.rays_to_pixels(self._rays)

    def at(self, t_us: int, next_us: int | None = None) -> FrameTruth:
        """Return the ground truth of all pixels at a time.

        Parameters
        ----------
        t_us : int
            Time from the start of the recording [us].
        next_us : int, optional
            Time of the next instant [us], to which displacements and occlusion refer. Without it, they are unknown.

        Returns
        -------
        FrameTruth
            Depth, normals, instances, optical flow, displacement and luminance of all pixels, the pose of the camera,
            and the positions of the joints.
        """
        t = t_us * 1e-6
        scene, camera, model = self._scene, self._simulation.camera, self._simulation.moving_model
        (rotation,), (position,) = self._poses([t])
        self._world.set_instants(np.array([t if at is None else at * 1e-6 for at in (t_us, next_us)]))
        pixels, theta = self._pixels, self._angles(t_us)
        bare = scenery.surfaces_at(self._world, self._rays, rotation, position)
        if self._simulation.plate is None:
            places = model.compensate_points(pixels, theta)
            through = scenery.surfaces_at(self._world, camera.pixels_to_rays(places), rotation, position)
            speed = self._flow(through, places, t)
            prism_flow = self._prism_flow(model, places, speed, theta, t_us)
        else:
            through, places = self._through_plate(t, rotation, position)
            prism_flow = self._plate_flow(self._simulation.plate, through, places, t)
        size = (camera.height, camera.width)
        moved, occluded = self._moved(bare, pixels, t_us, next_us, prism=False)
        moved_through, occluded_through = self._moved(through, places, t_us, next_us, prism=True)
        return FrameTruth(
            t_us,
            bare.depth.reshape(size),
            bare.normal.reshape(*size, 3),
            bare.instance.reshape(size).astype(np.uint16),
            self._flow(bare, pixels, t).astype(np.float32).reshape(*size, 2),
            prism_flow.astype(np.float32).reshape(*size, 2),
            moved.astype(np.float32).reshape(*size, 2),
            moved_through.astype(np.float32).reshape(*size, 2),
            occluded.reshape(size),
            occluded_through.reshape(size),
            self.luminance(t_us),
            self._intensity(t_us, prism=True).reshape(size),
            rotation @ scenery.mirrored(self._simulation).T,
            position,
            {name: path.poses([t])[1][0] for name, path in scene.world.joints.items()},
        )

    def luminance(self, t_us: int) -> NDArray[np.float32]:
        """Return the linear luminance without the prism at a time, which takes a fraction of the time of :meth:`at`.

        Parameters
        ----------
        t_us : int
            Time from the start of the recording [us].

        Returns
        -------
        numpy.ndarray
            Luminance of all pixels, shape ``(height, width)``.
        """
        camera = self._simulation.camera
        return self._intensity(t_us, prism=False).reshape(camera.height, camera.width)

    def _poses(self, t: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how directions of the camera at rest look in the world at times [s], (n, 3, 3), and its places."""
        rotation, position = self._scene.trajectory.poses(t)
        return rotation @ scenery.mirrored(self._simulation), position

    def _flow(self, seen: scenery.SurfaceView, pixels: NDArray[np.float64], t: float) -> NDArray[np.float64]:
        """Return the optical flow [px/s] of the points that pixels see at time ``t`` [s], shape (n, 2).

        ``seen``: surfaces that appear at ``pixels`` [px] in the image without the prism.
        """
        change = rate_of_change(lambda at: self._ray_at(seen, pixels, t, at)[0], t, self._simulation.duration_s)
        rate = np.linalg.norm(change, axis=1, keepdims=True)
        aside = ANGLE * change / np.maximum(rate, 1e-12)
        camera = self._simulation.camera
        rays = camera.pixels_to_rays(pixels).astype(np.float64)
        ends = [camera.rays_to_pixels(rays + sign * aside).astype(np.float64) for sign in (-1.0, 1.0)]
        return np.asarray((ends[1] - ends[0]) / (2.0 * ANGLE) * rate)

    def _ray_at(
        self, seen: scenery.SurfaceView, pixels: NDArray[np.float64], t: float, later: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return unit rays from the camera at time ``later`` [s] to the points that pixels see at time ``t`` [s].

        The rays are in the camera's frame, shape (n, 3). The second array has the depths of the points [m], shape (n,).
        """
        (r0, r1), (p0, p1) = self._poses([t, later])
        rays = self._simulation.camera.pixels_to_rays(pixels).astype(np.float64)
        distance = seen.depth.astype(np.float64) / rays[:, 2]
        sky = ~np.isfinite(distance)
        points = p0 + np.where(sky, 1.0, distance)[:, None] * (rays @ r0.T)
        for k, body in enumerate(self._world.movers):
            on = (seen.mover == k) & ~sky
            if body.trajectory is not None and on.any():
                (b0, b1), (q0, q1) = body.trajectory.poses([t, later])
                points[on] = (points[on] - q0) @ b0 @ b1.T + q1
        directions = np.where(sky[:, None], points - p0, points - p1) @ r1  # the sky is at infinity
        depth = np.where(sky, np.inf, directions[:, 2])
        return directions / np.linalg.norm(directions, axis=1, keepdims=True), depth

    def _angles(self, t_us: int) -> NDArray[np.float64]:
        """Return the prism angle of all pixels at a time [rad], shape (n,), or (n, 2) for two prisms."""
        return np.repeat(wrap_angle(self._simulation.prism_motion.angles([t_us])), len(self._rays), axis=0)

    def _moved(
        self, seen: scenery.SurfaceView, places: NDArray[np.float64], t_us: int, next_us: int | None, *, prism: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Return the displacement of what the pixels see until ``next_us`` [px], shape (n, 2), and its occlusion, (n,).

        ``seen``: surfaces that appear at ``places`` [px] in the image without the prism; ``prism``: whether the pixels
        see them through the prism.
        """
        camera, n = self._simulation.camera, len(self._rays)
        plate = self._simulation.plate if prism else None
        if next_us is None:
            return np.full((n, 2), np.nan), np.full(n, OUTSIDE, np.uint8)
        later, centres = next_us * 1e-6, None
        rays, depth = self._ray_at(seen, places, t_us * 1e-6, later)
        ends = camera.rays_to_pixels(rays)
        if plate is not None:
            ends = self._plate_pixels(plate, rays, depth, later)
            known = np.isfinite(ends).all(axis=1, keepdims=True)
            rays = np.where(known, camera.pixels_to_rays(ends), self._rays)
            centres, behind = self._behind_plate(rays, later)
            rays = behind.astype(np.float64)
        elif prism:
            ends = self._simulation.moving_model.deflect_points(ends, self._angles(next_us))
        (rotation,), (position,) = self._poses([later])
        hit = scenery.surfaces_at(self._world, rays, rotation, position, instant=1, centres=centres)
        hidden = hit.depth < depth * (1.0 - NEARER)
        inside = ((ends > -0.5) & (ends < np.array([camera.width, camera.height]) - 0.5)).all(axis=1)
        return ends - self._pixels, np.where(inside, hidden, OUTSIDE).astype(np.uint8)

    def _prism_flow(
        self,
        model: Model,
        places: NDArray[np.float64],
        speed: NDArray[np.float64],
        theta: NDArray[np.float64],
        t_us: int,
    ) -> NDArray[np.float64]:
        """Return the optical flow [px/s] that pixels see through the turning prism, shape (n, 2).

        ``places``: points [px] that the pixels would see without the prism; ``speed``: the flow at these points without
        the prism [px/s]; ``theta``: prism angle [rad].
        """
        size = np.linalg.norm(speed, axis=1, keepdims=True)
        aside = speed / np.maximum(size, 1e-9)
        along = [model.deflect_points(places + sign * aside, theta) for sign in (-1.0, 1.0)]
        motion, duration_s = self._simulation.prism_motion, self._simulation.duration_s
        rates = np.atleast_1d(rate_of_change(lambda at: motion.angles([1e6 * at])[0], t_us * 1e-6, duration_s))
        flow = (along[1] - along[0]) / 2.0 * size
        for rate, alone in zip(rates, np.eye(len(rates)), strict=True):
            step = ANGLE * (alone if len(rates) > 1 else 1.0)
            turned = [model.deflect_points(places, theta + sign * step) for sign in (-10.0, 10.0)]
            flow = flow + (turned[1] - turned[0]) / (20.0 * ANGLE) * rate
        return np.asarray(flow)

    def _through_plate(
        self, t: float, rotation: NDArray[np.float64], position: NDArray[np.float64]
    ) -> tuple[scenery.SurfaceView, NDArray[np.float64]]:
        """Return the surfaces that the pixels see through the turning plate at time ``t`` [s], and where they appear
        without it [px], shape (n, 2)."""
        centres, rays = self._behind_plate(self._rays, t)
        seen = scenery.surfaces_at(self._world, rays, rotation, position, centres=centres)
        away = np.where(np.isfinite(seen.depth)[:, None], (seen.place - position) @ rotation, rays)
        return seen, self._simulation.camera.rays_to_pixels(away)

    def _behind_plate(self, rays: NDArray[np.float64], t: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where rays of the camera begin through the plate at time ``t`` [s], and their directions there.

        Places [m] and directions have the shape (n, 3).
        """
        motion = self._simulation.prism_motion
        return self._sight.through_plate(rays, motion.phase + float(motion.angle([t * 1e6])[0]))

    def _plate_pixels(
        self, model: PlateModel, rays: NDArray[np.float64], depth: NDArray[np.float64], later: float
    ) -> NDArray[np.float64]:
        """Return the pixels that see points through the plate at time ``later`` [s], shape (n, 2).

        ``rays``, ``depth``: directions and depths [m] of the points from the camera at this time.
        """
        theta = np.full(len(rays), float(self._simulation.prism_motion.angle([later * 1e6])[0]))
        at, observed = self._simulation.camera.rays_to_pixels(rays), self._pixels
        for _ in range(DEFLECTING_STEPS):
            observed = observed - (model.compensate_at(observed, theta, 1.0 / depth) - at)
        return observed

    def _plate_flow(
        self, model: PlateModel, seen: scenery.SurfaceView, places: NDArray[np.float64], t: float
    ) -> NDArray[np.float64]:
        """Return the optical flow [px/s] that the pixels see through the turning plate at time ``t`` [s], (n, 2).

        ``seen``, ``places``: from :meth:`_through_plate`.
        """

        def pixels_at(at: float) -> NDArray[np.float64]:
            return self._plate_pixels(model, *self._ray_at(seen, places, t, at), at)

        return rate_of_change(pixels_at, t, self._simulation.duration_s)

    def _intensity(self, t_us: int, *, prism: bool) -> NDArray[np.float32]:
        """Return the luminance of all pixels at a time, through the prism or without the prism, shape (n,)."""
        device, simulation = self._world.device, self._simulation
        sight = self._sight if prism else self._sight_at_rest
        sight.set_plate(simulation.plate if prism else None)
        if not prism:
            simulation = cast("Simulation", simulation).without_prism()
        sight.set_instants(np.array([float(t_us)]), scenery.prism_view_of(simulation, device))
        table: NDArray[Any] = np.zeros(1, cast("Any", prism_view.Step).numpy_dtype())
        first, second = true_angles(simulation.prism_motion, np.array([float(t_us)]))
        table["azimuth"], table["second"] = azimuths_of(first), azimuths_of(second)
        steps = prism_view.Steps()
        steps.at = wp.array(table, dtype=prism_view.Step, device=device)
        return np.array(sight.light(steps, 0, 1).numpy()[0])


# Ground truth that a simulation records next to the events: labels, instants and poses of its world, known pixels.

POSE_INTERVAL_US = 1000
"""Time between two recorded poses [us]."""

MOST_INSTANTS = 1_000_000
"""Largest number of instants whose ground truth is recorded."""


def chosen_instants(
    duration_us: int, truth_hz: float | None = None, truth_times_us: ArrayLike | None = None
) -> NDArray[np.int64]:
    """Return the instants whose ground truth is recorded [us], shape ``(k,)``.

    Instants follow at the rate ``truth_hz`` from 0 to the end of the recording, or are ``truth_times_us``. Raises
    :class:`AmiwarpError` if times lie outside the recording or do not increase.
    """
    if truth_hz is not None and truth_times_us is not None:
        raise AmiwarpError("truth_hz and truth_times_us are both given; give one of them")
    if truth_hz is not None:
        rate = real(truth_hz, "truth_hz", 1e-3, 1e6, " 1/s")
        count = int(duration_us * rate / 1e6 + 1e-9) + 1  # rounding must not lose the last instant
        if count > MOST_INSTANTS:
            raise AmiwarpError(
                f"truth_hz {rate:g} gives {count} instants; the limit is {MOST_INSTANTS}; give a lower rate"
            )
        return np.unique(np.minimum(np.rint(np.arange(count) * (1e6 / rate)), duration_us).astype(np.int64))
    times = array([] if truth_times_us is None else truth_times_us, "truth_times_us")
    if not (np.abs(times) <= TIME_LIMIT).all():
        raise AmiwarpError(f"truth_times_us is {shown(times)}; give finite times within 0 .. {duration_us} us")
    found = np.rint(times).astype(np.int64)
    if found.ndim != 1 or (found < 0).any() or (found > duration_us).any() or (np.diff(found) <= 0).any():
        raise AmiwarpError(f"truth_times_us must increase and lie within 0 .. {duration_us} us; sort the times")
    return found


class RecordedTruth:
    """Producer of the ground truth that a simulation records, in order of time.

    A world gives labels, maps of the chosen instants, and poses. A picture scene gives nothing.
    """

    def __init__(self, simulation: SimulationValues, instants: NDArray[np.int64]) -> None:
        scene = simulation.scene
        self._scene = scene if isinstance(scene, WorldScene) else None
        self._renderer = TruthRenderer(simulation) if len(instants) else None
        self._instants = instants
        self._next_instant = self._next_pose = 0
        self._duration_us = simulation.duration_us
        self._frames: list[FrameTruth] = []
        self._poses: list[Poses] = []
        self._masks: list[tuple[int, NDArray[np.bool_]]] = []
        self.known = scenery.KnownPixels(simulation)
        """Masks of known pixels, if the pictures have some."""

    @property
    def labels(self) -> truth.WorldLabels | None:
        """Names and classes of the instances in the world; None for a picture scene."""
        if self._scene is None:
            return None
        world = self._scene.world
        return truth.WorldLabels(world.name, world.instances, world.categories)

    def frames_before(self, t_us: int) -> Iterator[FrameTruth]:
        """Yield the ground truth of the remaining instants before ``t_us`` [us].

        At the end of the recording, yield all remaining instants.
        """
        while self._next_instant < len(self._instants) and (
            self._instants[self._next_instant] < t_us or t_us >= self._duration_us
        ):
            assert self._renderer is not None
            first, *later = self._instants[self._next_instant : self._next_instant + 2].tolist()
            yield self._renderer.at(first, *later)
            self._next_instant += 1

    def poses_before(self, t_us: int) -> Poses | None:
        """Return the remaining poses before ``t_us`` [us]; None for a picture scene.

        At the end of the recording, return all remaining poses.
        """
        if self._scene is None:
            return None
        stop = self._duration_us + 1 if t_us >= self._duration_us else t_us
        t = np.arange(self._next_pose, max(stop, self._next_pose), POSE_INTERVAL_US, dtype=np.int64)
        self._next_pose += len(t) * POSE_INTERVAL_US
        return poses_at(self._scene, t)

    def keep(self, t_us: int) -> None:
        """Keep in memory the instants and poses before ``t_us`` [us]."""
        self._frames.extend(self.frames_before(t_us))
        self._masks.extend(self.known.take())
        poses = self.poses_before(t_us)
        if poses is not None:
            self._poses.append(poses)

    def kept(self, parameters: dict[str, float], of_events: Mapping[str, EventValues]) -> Truth:
        """Return the ground truth that :meth:`keep` stored, with the true parameters, and the truth of the events.

        ``of_events``: ground truth of all events by the names of :class:`EventTruth`.
        """
        frames = truth.MemoryFrames(self._frames) if self._frames else None
        poses = Poses.concatenate(self._poses) if self._poses else None
        masks = truth.MemoryMasks(*zip(*self._masks, strict=True)) if self._masks else None
        points, causes, instances, depths, places = (of_events.get(part.name) for part in fields(EventTruth))
        return Truth(
            parameters, points, causes, instances, depths, places, self.labels, frames, poses, masks
        )  # fmt: skip


def poses_at(scene: WorldScene, t_us: NDArray[np.int64]) -> Poses:
    """Return the poses of the camera, the moving bodies and the joints at times [us], shape ``(k,)``."""
    t, world = t_us * 1e-6, scene.world
    if not len(t):
        empty = {body.name: np.zeros((0, 7)) for body in world.moving}
        return Poses(t_us, np.zeros((0, 7)), empty, {name: np.zeros((0, 3)) for name in world.joints})
    bodies = {
        body.name: truth.as_poses(*body.trajectory.poses(t)) for body in world.moving if body.trajectory is not None
    }
    joints = {name: path.poses(t)[1] for name, path in world.joints.items()}
    return Poses(t_us, truth.as_poses(*scene.trajectory.poses(t)), bodies, joints)


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

    def __init__(self, count: int, device: Any, per_pixel: int | None = None) -> None:
        """Allocate the buffer for ``count`` pixels, with room for ``per_pixel`` events of each, or the default."""
        self._pixels, self._device = count, device
        self._segments = -(-count // CPU_RUN) if device.is_cpu else min(CUDA_SEGMENTS, count)
        self._sink = pixels.Sink()
        self._sink.run = CPU_RUN if device.is_cpu else 1
        columns = CACHE_LINE // 4 if device.is_cpu else 1
        self._sink.count = wp.zeros((self._segments, columns), dtype=int, device=device)
        self._reserve((per_pixel or EVENTS_PER_PIXEL) * -(-count // self._segments))

    def _reserve(self, capacity: int) -> None:
        """Allocate room for ``capacity`` keys per segment."""
        self._capacity = capacity
        self._sink.keys = wp.empty((self._segments, capacity), dtype=wp.int64, device=self._device)

    def run(self, kernel: Any, inputs: list[Any], state: list[wp.array], carry: wp.array) -> wp.array:
        """Simulate the pixels over a chunk and return the keys of their events, unsorted, with ``carry`` appended.

        The kernel gets the ``inputs``, then the pixels' ``state``. The array has twice the needed length, because
        sorting on CUDA needs scratch memory behind the keys.
        """
        before = [wp.clone(values) for values in state]
        while True:
            self._sink.count.zero_()
            self._launch(kernel, [*inputs, *state])
            counts = self._sink.count.numpy()[:, 0]
            if counts.max() <= self._capacity:
                return self._pack(counts, carry)
            # the buffer was too small: run again from the same state
            for values, copy in zip(state, before, strict=True):
                wp.copy(values, copy)
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
        list(launch.pool().map(run, starts, [min(start + CPU_RUN, self._pixels) for start in starts]))


def sort_keys(keys: wp.array, total: int, lowest: int, top: int) -> None:
    """Sort the first ``total`` keys by their bits from ``lowest`` to below ``top``.

    Without a row scan, no two events of a pixel share a microsecond, so that bits below the pixel's need no sorting.
    """
    if keys.device.is_cpu:
        keys.numpy()[:total].sort()  # shares the memory of keys
        return
    order = wp.empty(2 * total, dtype=wp.int32, device=keys.device)
    wp.utils.radix_sort_pairs(keys, order, total, begin_bit=lowest, end_bit=top)


# Readout of the simulated sensor: sequential readout of rows, and a bus with a queue that limits the event rate.

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
    scan = event_keys.RowScan()
    scan.row_ps = round(sensor.row_us * 1e6)
    scan.scan_ps, scan.width, scan.height = int(scan.row_ps) * height, width, height
    return scan


def bus_of(sensor: SensorModel) -> Any:
    """Return the bus of a sensor; it takes no time per event if its rate is unlimited."""
    bus = event_keys.Bus()
    bus.event_ps = round(1e6 / sensor.bus_rate_mev_s) if sensor.bus_rate_mev_s else 0
    bus.longest_ps = round(sensor.bus_queue) * int(bus.event_ps)
    bus.rows = int(round(sensor.row_us * 1e6) > 0)
    return bus


class Readout:
    """Readout of one simulated sensor. Only the state of the bus is kept between blocks of events."""

    def __init__(self, simulation: SimulationValues, device: Any) -> None:
        """Set up the readout; raise :class:`AmiwarpError` if reading all rows takes too long."""
        sensor, camera = simulation.sensor, simulation.camera
        self._device, self._width = device, camera.width
        self._duration_us = simulation.duration_us
        self._scan, self._bus = row_scan(sensor, camera.width, camera.height), bus_of(sensor)
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
        self._scan.origin, self._scan.shift = origin_us, shift
        launch.launch(event_keys.stamp_rows, count, [self._scan, keys], [], device=self._device)

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
        stamp, kept = wp.empty(len(keys), dtype=wp.int64, device=host), wp.zeros(1, dtype=int, device=host)
        launch.load(event_keys.queue_keys, host)
        inputs = [self._bus, shift, self._width, origin_us, self._duration_us]
        outputs = [wp.array(keys, dtype=wp.int64, device=host, copy=False), self._free, stamp, kept]
        wp.launch(event_keys.queue_keys, dim=1, inputs=inputs, outputs=outputs, device=host)
        n = int(kept.numpy()[0])
        return keys[:n], stamp.numpy()[:n]


# Engine of the event simulator: tables on the host, kernel launches, sorting of events.

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
    at_rest: wp.array | None = None
    """Pixel of each event's scene point in a vibrating camera's view at rest [px]; None if the camera has no vibration.
    """

    def events(self) -> Events:
        """Return the events in host memory."""
        b = self.arrays
        return Events(b.x.numpy(), b.y.numpy(), b.t.numpy(), b.p.numpy())

    def points(self) -> NDArray[np.float32]:
        """Return the scene point of each event: its pixel without prism and vibration [px], shape (n, 2)."""
        return np.asarray(self._points.numpy())

    @property
    def _points(self) -> wp.array:
        return self.arrays.points if self.at_rest is None else self.at_rest

    def on_device(self) -> tuple[DeviceEvents, wp.array]:
        """Return the finished events, and their scene points without the prism, without a copy."""
        b = self.arrays
        wait(b.t.device)
        return DeviceEvents(b.x, b.y, b.t, b.p), self._points

    def truth(self) -> EventTruth:
        """Return the ground truth of the events.

        In a world, call this method before the engine simulates the next chunk.
        """
        return EventTruth(**{name: a.numpy() for name, a in self.columns().items() if name not in NAMES})

    def columns(self) -> dict[str, wp.array]:
        """Return events and ground truth on the device, by the names of :class:`Events` and :class:`EventTruth`.

        In a world, call this method before the engine simulates the next chunk.
        """
        found = {name: getattr(self.arrays, name) for name in (*NAMES, "points", "cause")} | {"points": self._points}
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
            speed, flicker = scenery.image_speed(world, simulation, scene), scenery.flicker_interval_s(scene.world)
            near = 0.0
            if simulation.plate is not None:
                near = scenery.largest_inverse_depth(world, simulation.camera, scene.trajectory, simulation.duration_s)
            longest = 1e6 * flicker
            self._step = scenery.step_us(simulation, world_speed=speed.total, longest=longest, inverse_depth=near)
            longest_chunk = 1e6 * MAPS_PER_CHUNK * min(flicker, scene.motion_px / max(speed.in_maps, 1e-9))
            self._sight = WorldSight(simulation, scene, world)
            if scene.seeing is Seeing.RAYS:
                longest_chunk = RAYS_CHUNK_US
            else:
                self._maps = WorldMapRing(simulation, scene, world, scenery.seen_bearings(simulation))
        else:
            self._step = scenery.step_us(simulation)
            self._maps = MapRing(simulation, scenery.place_scene(simulation))
            if scene.frames.interval_us is not None:
                longest_chunk = FRAMES_PER_CHUNK * scene.frames.interval_us
        self._margin = int(pixels.LARGEST_LAG) // (int(pixels.TICKS) * self._step) + 2
        self._shift = int(pixels.LOW_BITS) + (self._pixels - 1).bit_length()
        self._chunk_steps = self._steps_per_chunk(chunk_us, longest_chunk)
        self._axis = axis_rotation(*simulation.prism_motion.tilt)
        self._sensor = sensor_params(simulation.sensor, self._step)
        self._view = scenery.prism_view_of(simulation, self._device)
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
        if chunk_us is None:
            span = CHUNK_US[self._device.is_cpu] * min(self._pixels, 640 * 480) // self._pixels
        else:
            span = whole(chunk_us, "chunk_us", 1, TIME_LIMIT, " us")
        of_keys = 1 << (63 - self._shift)  # first time that a key cannot hold [us]
        of_ticks = (1 << 31) // int(pixels.TICKS) - self._margin * self._step  # of DeviceBlock.arrays.ticks, an int32
        return max(1, int(min(span, longest, min(of_keys, of_ticks) - LATEST_US)) // self._step)

    def prepare(self) -> None:
        """Load the kernels and read or render the first maps, which otherwise happens in the first chunk."""
        launch.load(self._kernel(), self._device)
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
        simulation, margin = self._simulation, self._margin
        t = np.arange(first - margin, first + count + 1, dtype=np.float64) * self._step
        angle, second = true_angles(simulation.prism_motion, t)
        steps = prism_view.Steps()
        table: NDArray[Any] = np.zeros(len(t), cast("Any", prism_view.Step).numpy_dtype())
        table["azimuth"], table["second"] = azimuths_of(angle), azimuths_of(second)
        if self._maps is not None:
            self._fill_maps(self._maps, table, t, first, count)
        if self._sight is not None:
            self._sight.set_instants(t, self._view)
        steps.at = wp.array(table, dtype=prism_view.Step, device=self._device)
        if self._device.is_cpu:
            steps.ahead = wp.array(
                instants_in_blocks(table[margin + 1 :]), dtype=prism_view.Instants, device=self._device
            )
        steps.angle, steps.turn = self._angles(angle)
        steps.second_angle, steps.second_turn = self._angles(second)
        steps.per_tick = 1.0 / (self._step * int(pixels.TICKS))
        steps.shift = self._shift
        steps.margin, steps.count, steps.ticks = margin, count, self._step * int(pixels.TICKS)
        return steps

    def _angles(self, angle: NDArray[np.float64]) -> tuple[wp.array, wp.array]:
        """Return angles [rad] and their changes until the next instant on the device."""
        return self._upload(wrap_angle(angle)), self._upload(np.diff(angle, append=2.0 * angle[-1] - angle[-2]))

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
        orientation, axis = maps.orientations(t), scenery.shake(self._simulation, t) @ self._axis
        to_texel = maps.placement.to_texel()
        table["to_texel"] = to_texel @ axis if orientation is None else to_texel @ orientation @ axis
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
        launch.load(kernel, self._device)
        wp.launch(kernel, dim=self._pixels, inputs=inputs, device=self._device)
        if self._simulation.pixels is not None:
            self._set_pixels(self._simulation.pixels)
        if self._filters:  # at the start, the photoreceptors have settled to the light of the scene
            levels = np.ascontiguousarray(self._state[0].numpy()["level"])
            self._state.append(wp.array(levels, dtype=float, device=self._device))

    def _set_pixels(self, given: PixelMap) -> None:
        """Give the pixels the thresholds of a map, and its hot and dead pixels."""
        per_tick = given.hot_hz * np.float32(1e-6 / int(pixels.TICKS))
        arrays = [
            wp.array(values.ravel(), device=self._device) for values in (given.on, given.off, per_tick, given.dead)
        ]
        wp.launch(
            pixels.set_pixels, dim=self._pixels, inputs=[*arrays, self._sensor, self._state[0]], device=self._device
        )

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
            launch.load(event_keys.rebase, self._device)
            wp.launch(event_keys.rebase, dim=len(self._carry), inputs=[self._carry, count * self._step << steps.shift],
                      device=self._device)  # fmt: skip
        return keys

    def _sort(self, keys: wp.array, total: int, limit: int, top: int) -> int:
        """Sort the first ``total`` keys by their lowest ``top`` bits; return the number of keys below ``limit``."""
        sort_keys(keys, total, int(event_keys.LAG_BIT) if self._readout.scans_rows else int(pixels.LOW_BITS), top)
        if self._device.is_cpu:
            return int(np.searchsorted(keys.numpy()[:total], limit))
        found = wp.empty(1, dtype=int, device=self._device)
        wp.launch(event_keys.find, dim=1, inputs=[keys, total, limit], outputs=[found], device=self._device)
        return int(found.numpy()[0])

    def _unpack(self, keys: wp.array, steps: Any, first: int) -> DeviceBlock:
        """Convert sorted keys of events to a block of events with ground truth. ``first``: number of the first step."""
        keys, stamps = self._readout.read(keys, steps.shift, first * self._step)
        n = len(keys)
        block = event_keys.Block()
        for name, dtype in (("x", wp.uint16), ("y", wp.uint16), ("t", wp.int64), ("p", wp.uint8),
                            ("cause", wp.uint8), ("points", wp.vec2), ("ticks", int)):  # fmt: skip
            setattr(block, name, wp.empty(n, dtype=dtype, device=self._device))
        inputs = [self._view, steps, keys, first * self._step]
        launch.launch(event_keys.unpack, n, inputs, [block], device=self._device)
        if stamps is not None:
            block.t = stamps
        at_rest = None
        if isinstance(self._simulation.prism, Moved):
            at_rest = wp.empty_like(block.points)
            model = self._simulation.moving_model
            inputs = [model.params(self._device), model_camera(model, self._device), steps, block]
            launch.launch(event_keys.find_points_at_rest, n, inputs, [at_rest], device=self._device)
        if self._sight is None:
            return DeviceBlock(block, at_rest=at_rest)
        faces = (
            self._maps.faces if isinstance(self._maps, WorldMapRing) else wp.empty(0, dtype=int, device=self._device)
        )
        look = partial(self._sight.look, self._view, steps, block, n, faces)
        if self._simulation.plate is not None:  # the pixels without the plate depend on the surfaces
            seen = look()
            return DeviceBlock(block, lambda: seen)
        return DeviceBlock(block, look, at_rest)


def true_angles(motion: PrismMotion, t_us: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the true azimuths of the prism and of the second prism [rad]; without a second prism, zeros."""
    first, second = motion.phase + motion.angle(t_us), motion.second
    return first, np.zeros(len(t_us)) if second is None else second.phase + second.angle(t_us)


def azimuths_of(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return cosine and sine of angles [rad], shape (n, 2)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def instants_in_blocks(table: NDArray[Any]) -> NDArray[np.float32]:
    """Return the prism azimuths and matrices of a table of instants in blocks of 16, shape (n, 13, 16).

    The last block is padded with copies of the last instant.
    """
    ahead = int(prism_view.AHEAD)
    columns = np.concatenate([table["azimuth"], table["to_texel"].reshape(-1, 9), table["second"]], axis=1)
    filled = np.concatenate([columns, np.repeat(columns[-1:], -len(columns) % ahead, axis=0)])
    return np.ascontiguousarray(filled.reshape(-1, ahead, 13).swapaxes(1, 2))


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


# Values of a simulation: their checks, and the true parameters that they mean.


def true_parameters(simulation: SimulationValues) -> dict[str, float]:
    """Return the true values by the names that calibration uses, and those of the sensor."""
    constant = simulation.camera_motion.constant and not (
        isinstance(simulation.scene, WorldScene) and simulation.scene.trajectory.moves
    )  # a trajectory has no constant angular velocity
    rates = np.asarray(simulation.camera_motion.rates) if constant else np.full(3, np.nan)
    omega = dict(zip(("omega_x", "omega_y", "omega_z"), rates.ravel()[-3:].tolist(), strict=True))
    clock = {} if simulation.encoder_model is None else {"clock_offset_us": simulation.encoder_model.clock_offset_us}
    moving = {name: value for name, value in omega.items() if math.isfinite(value)}
    glass = simulation.prism
    if isinstance(glass, Moved):
        return {**glass.parameters(), **clock, **moving, **asdict(simulation.sensor)}
    uneven = {
        f"{name}_{axis}": angle
        for name in (("tilt", "cylinder", "wobble") if isinstance(glass, Prism) else ("wedge",))
        for axis, angle in zip("xy", getattr(simulation.prism_motion, name), strict=True)
    }
    size = (
        {"apex": glass.apex} if isinstance(glass, Prism) else {"thickness": glass.thickness, "plate_tilt": glass.tilt}
    )
    return {
        **size,
        "index": glass.index,
        "phase": simulation.prism_motion.phase,
        **of_second_prism(simulation),
        **clock,
        **uneven,
        **moving,
        **asdict(simulation.sensor),
    }


def of_second_prism(simulation: SimulationValues) -> dict[str, float]:
    """Return the true values of the second prism of a pair; none for one prism."""
    model = simulation.bending
    if isinstance(model, ExactModel):
        return {}
    second = cast("Prism", model.prism.second)
    return {"second_apex": second.apex, "second_index": second.index, "second_phase": model.second_phase,
            "ratio": model.ratio}  # fmt: skip


# Events of a simulation and their ground truth, collected in the memory of the host or of the device.


class CollectedEvents:
    """Columns of successive blocks of events and of their ground truth."""

    def __init__(self, *, on_device: bool) -> None:
        """Prepare to collect events on the device that simulates them, or on the host."""
        self._on_device = on_device
        self._parts: dict[str, list[Any]] = {}

    def add(self, block: DeviceBlock) -> None:
        """Add a block. In a world, call this method before the engine simulates the next chunk."""
        for name, values in block.columns().items():
            self._parts.setdefault(name, []).append(values if self._on_device else values.numpy())

    def take(self, width: int, height: int) -> tuple[EventSource, dict[str, EventValues]]:
        """Return a source of all events, and their ground truth by the names of :class:`EventTruth`.

        The blocks of a column are released once they are joined, so that only one column is held twice.
        """
        unite = join if self._on_device else np.concatenate
        found = {name: unite(self._parts.pop(name)) for name in list(self._parts)}
        events = [found.pop(name) for name in NAMES]
        if not self._on_device:
            return MemoryEvents(Events(*events), width, height), found
        source = DeviceMemoryEvents(DeviceEvents(*events), width, height)
        wait(source.device)
        return source, {name: DeviceValues(values) for name, values in found.items()}


@guarded
@dataclass(frozen=True, eq=False)
class Simulation(SimulationValues):
    """Description of a simulated recording, :class:`SimulationValues`, and the methods that simulate it.

    Equal values give equal events, bit for bit, on one kind of device.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> simulation = amiwarp.Simulation(
    ...     scene=amiwarp.Scene.from_picture(picture), camera=amiwarp.Camera.from_fov(32, 24, 1.0),
    ...     prism=amiwarp.Prism(0.03), duration_s=0.01)
    >>> recording = simulation.run()
    >>> recording.events.size
    (32, 24)
    """

    def without_prism(self) -> Simulation:
        """Return this simulation without prism and vibration, which makes it that of a plain event camera.

        Returns
        -------
        Simulation
            The same scene, sensor and seed with an apex angle of 0, or a mirror at rest. Its recording has neither
            encoder nor prism.
        """
        return replace(self.at_rest, nominal_prism=None, encoder_model=None)

    def encoder(self) -> Encoder | None:
        """Sample the prism's encoder.

        Returns
        -------
        Encoder or None
            Samples of the encoder, or None without a prism. Its clock offset is only in the ground truth.
        """
        if self.encoder_model is None:
            return None
        return self.encoder_model.sample(self.prism_motion, self.duration_us, self.seed)

    def truth_parameters(self) -> dict[str, float]:
        """Return the true values of the parameters of prism, encoder, camera motion and sensor.

        Returns
        -------
        dict
            Values by the names that calibration uses, and those of the sensor.
        """
        return true_parameters(self)

    def metadata(self) -> dict[str, MetadataValue]:
        """Return the metadata that the recording stores about its simulation.

        Returns
        -------
        dict
            Seed and duration, the optic if no glass tells it, and :attr:`source`.
        """
        known: dict[str, MetadataValue] = {"simulated": True, "seed": self.seed, "duration_us": self.duration_us}
        if isinstance(self.prism, Vibration) or (isinstance(self.prism, Mirror) and self.encoder_model is not None):
            known["optic"] = self.moving_model.NAME
        return {**known, **self.source}

    def blocks(
        self, *, chunk_us: int | None = None, progress: Progress | None = None
    ) -> Iterator[tuple[Events, NDArray[np.float32]]]:
        """Yield the events of successive time spans. Memory use is constant.

        Parameters
        ----------
        chunk_us : int, optional
            Length of a span [us], at least 1. The default depends on the device. The events do not depend on it. Spans
            of over 134 s are divided; with more than 16,384 pixels, shorter ones too, at 1280x720 those of over 2 s.
        progress : Progress, optional
            Called with the finished share.

        Yields
        ------
        tuple
            Events, and the scene point of each event: its pixel without prism and vibration [px], shape ``(n, 2)``, NaN
            if its ray misses the image plane.
        """
        for block, _ in self._run_engine(chunk_us, progress):
            yield block.events(), block.points()

    def device_blocks(
        self, *, chunk_us: int | None = None, progress: Progress | None = None
    ) -> Iterator[tuple[DeviceEvents, wp.array]]:
        """Yield the events of successive time spans on the device that simulates them, without a copy to the host.

        Parameters
        ----------
        chunk_us : int, optional
            Length of a span [us], at least 1. The default depends on the device. The events do not depend on it. Spans
            of over 134 s are divided; with more than 16,384 pixels, shorter ones too, at 1280x720 those of over 2 s.
        progress : Progress, optional
            Called with the finished share.

        Yields
        ------
        tuple
            Events, and the scene point of each event, as in :meth:`blocks`: a Warp array of vec2, shape ``(n,)``, which
            other libraries read as ``(n, 2)``.
        """
        for block, _ in self._run_engine(chunk_us, progress):
            yield block.on_device()

    def _run_engine(self, chunk_us: int | None, progress: Progress | None) -> Iterator[tuple[DeviceBlock, int]]:
        """Yield the blocks of successive time spans, each with the end of its span [us]."""
        engine = Engine(self, chunk_us)
        for block in engine.run():
            yield block, engine.now_us
            if progress is not None:
                progress("simulating", min(1.0, engine.now_us / self.duration_us))

    def log_view(self) -> NDArray[np.float32]:
        """Return the first picture as the camera sees it at t = 0 without the prism.

        Returns
        -------
        ndarray
            Log intensity, float32, shape ``(height, width)``.
        """
        return scenery.log_view(self)

    def run(
        self,
        *,
        truth_hz: float | None = None,
        truth_times_us: ArrayLike | None = None,
        on_device: bool = False,
        progress: Progress | None = None,
    ) -> Recording:
        """Simulate the whole recording in memory.

        Parameters
        ----------
        truth_hz : float, optional
            Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s]. Only worlds
            have them. By default there are none.
        truth_times_us : array_like, optional
            The instants themselves instead of a rate [us], shape (k,), rising.
        on_device : bool, optional
            Keep the events and their ground truth on :attr:`device`, as :func:`simulate` does.
        progress : Progress, optional
            Called with the finished share.

        Returns
        -------
        Recording
            The recording, with ground truth.
        """
        recorded = RecordedTruth(self, chosen_instants(self.duration_us, truth_hz, truth_times_us))
        collected = CollectedEvents(on_device=on_device)
        for block, now_us in self._run_engine(None, progress):
            collected.add(block)
            recorded.keep(now_us)
        events, of_events = collected.take(self.camera.width, self.camera.height)
        known = recorded.kept(self.truth_parameters(), of_events)
        camera, encoder, prism = self.camera, self.encoder(), self._stored_prism
        return Recording(events, camera, encoder, prism, known, self.metadata(), "simulation")

    @property
    def _stored_prism(self) -> Prism | Plate | None:
        """Nominal prism or plate to store with the recording, or None for a camera without glass."""
        glass = self.prism if isinstance(self.prism, Plate) else self.glass
        moved = self.encoder_model is None or isinstance(self.prism, Moved)
        return None if moved else self.nominal_prism or glass

    def write(
        self,
        path: str | Path,
        *,
        truth_hz: float | None = None,
        truth_times_us: ArrayLike | None = None,
        progress: Progress | None = None,
        overwrite: bool = False,
    ) -> int:
        """Simulate the whole recording to a file, in constant memory.

        Parameters
        ----------
        path : str or Path
            Path of the recording.
        truth_hz : float, optional
            Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s], as in
            :meth:`run`.
        truth_times_us : array_like, optional
            The instants themselves instead of a rate [us], shape (k,), rising.
        progress : Progress, optional
            Called with the finished share.
        overwrite : bool, optional
            Replace an existing file.

        Returns
        -------
        int
            Number of events.
        """
        recorded = RecordedTruth(self, chosen_instants(self.duration_us, truth_hz, truth_times_us))
        with RecordingWriter(
            path,
            width=self.camera.width,
            height=self.camera.height,
            camera=self.camera,
            prism=self._stored_prism,
            encoder=self.encoder(),
            truth_parameters=self.truth_parameters(),
            truth_labels=recorded.labels,
            metadata=self.metadata(),
            overwrite=overwrite,
        ) as writer:
            for block, now_us in self._run_engine(None, progress):
                writer.append(block.events(), truth=block.truth())
                for frame in recorded.frames_before(now_us):
                    writer.append_frame(frame)
                for t_us, mask in recorded.known.take():
                    writer.append_known(t_us, mask)
                poses = recorded.poses_before(now_us)
                if poses is not None:
                    writer.append_poses(poses)
        return len(writer)


@guarded
def simulate(
    scene: Scene | WorldScene | str | Path | NDArray[Any],
    camera: Camera,
    prism: Prism | Plate | Vibration | Mirror,
    *,
    duration_s: float,
    motion: PrismMotion | float = 720.0,
    camera_motion: CameraMotion | None = None,
    sensor: SensorModel | None = None,
    pixels: PixelMap | None = None,
    encoder: EncoderModel | None = None,
    nominal_prism: Prism | Plate | None = None,
    seed: int = 0,
    device: str = "cpu",
    on_device: bool = False,
    truth_hz: float | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Simulate a recording.

    For recordings larger than memory, use :meth:`Simulation.write`, :meth:`Simulation.blocks` or
    :meth:`Simulation.device_blocks`.

    Parameters
    ----------
    scene : Scene, WorldScene, str, Path or ndarray
        Scene, world, picture file, or pixel values (see :meth:`Scene.from_picture`).
    camera : Camera
        The camera.
    prism : Prism, Plate, Vibration or Mirror
        The true prism; or a plate, in a world; or a mirror; or the vibration of a camera without glass, whose recording
        has neither encoder nor prism.
    duration_s : float
        Duration [s].
    motion : PrismMotion or float, optional
        Motion of the prism, or its constant speed [turns/min]. Vibrations and mirrors have their own.
    camera_motion : CameraMotion, optional
        Rotation of the camera; by default none.
    sensor : SensorModel, optional
        Pixels of the sensor.
    pixels : PixelMap, optional
        Thresholds of each pixel, and hot and dead pixels, instead of random ones.
    encoder : EncoderModel, optional
        Errors of the encoder.
    nominal_prism : Prism or Plate, optional
        The prism or plate stored with the recording; by default the true one.
    seed : int, optional
        Seed of all random numbers.
    device : str, optional
        Device to compute on.
    on_device : bool, optional
        Keep the events and their ground truth on ``device``: the recording has :class:`DeviceMemoryEvents`. By default,
        they are copied to the host's memory.
    truth_hz : float, optional
        Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s], in a world.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    Recording
        The recording, with ground truth.

    Raises
    ------
    AmiwarpError
        If a value is out of range, or the camera turns away from the picture.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> camera = amiwarp.Camera.from_fov(32, 24, 1.0)
    >>> recording = amiwarp.simulate(picture, camera, amiwarp.Prism(0.03), duration_s=0.01)
    >>> len(recording.events) > 0
    True
    """
    return Simulation(
        scene=scene if isinstance(scene, Scene | WorldScene) else Scene.from_picture(scene),
        camera=camera,
        prism=prism,
        duration_s=duration_s,
        motion=motion,
        camera_motion=camera_motion or CameraMotion(),
        sensor=sensor or SensorModel(),
        pixels=pixels,
        encoder_model=encoder or EncoderModel(),
        nominal_prism=nominal_prism,
        seed=seed,
        device=device,
    ).run(truth_hz=truth_hz, on_device=on_device, progress=progress)
