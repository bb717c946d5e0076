"""Ground truth of a simulated world: at instants, and next to the recorded events."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import TIME_LIMIT
from amiwarp.events.recording import Truth
from amiwarp.events.truth import (
    EventTruth,
    EventValues,
    FrameTruth,
    MemoryFrames,
    MemoryMasks,
    Poses,
    WorldLabels,
    as_poses,
)
from amiwarp.kernels import prism_view
from amiwarp.optics.models import ExactModel, wrap_angle
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.scenery import KnownPixels
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.renderer import SurfaceView, WorldSight, pixel_rays, surfaces_at
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.validation import array, guarded, real, shown

# Ground truth of a simulated world at an instant: depth, normals, instances, optical flow and luminance.

ANGLE = 1e-3
"""Half of the angle over which derivatives with respect to direction are difference quotients [rad]."""
MOMENT_S = 1e-4
"""Half of the time over which optical flow is computed as a difference quotient [s]."""


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
        self._sight = WorldSight(simulation, self._scene, self._world)
        self._rays = pixel_rays(simulation.camera)

    def at(self, t_us: int) -> FrameTruth:
        """Return the ground truth of all pixels at a time.

        Parameters
        ----------
        t_us : int
            Time from the start of the recording [us].

        Returns
        -------
        FrameTruth
            Depth, normals, instances, optical flow and luminance of all pixels, the pose of the camera, and the
            positions of the joints.
        """
        t = t_us * 1e-6
        scene, camera, model = self._scene, self._simulation.camera, self._simulation.true_model
        (rotation,), (position,) = scene.trajectory.poses([t])
        self._world.set_instants(np.array([t]))
        pixels = camera.rays_to_pixels(self._rays)
        theta = np.full(len(pixels), wrap_angle(self._simulation.motion.angle([t_us]))[0])
        bare = surfaces_at(self._world, self._rays, rotation, position)
        places = model.compensate_points(pixels, theta)
        through = surfaces_at(self._world, camera.pixels_to_rays(places), rotation, position)
        speed = self._flow(through, places, t)
        size = (camera.height, camera.width)
        return FrameTruth(
            t_us,
            bare.depth.reshape(size),
            bare.normal.reshape(*size, 3),
            bare.instance.reshape(size).astype(np.uint16),
            self._flow(bare, pixels, t).astype(np.float32).reshape(*size, 2),
            self._prism_flow(model, places, speed, theta, t_us).astype(np.float32).reshape(*size, 2),
            self._intensity(t_us, prism=False).reshape(size),
            self._intensity(t_us, prism=True).reshape(size),
            rotation,
            position,
            {name: path.poses([t])[1][0] for name, path in scene.world.joints.items()},
        )

    def _flow(self, seen: SurfaceView, pixels: NDArray[np.float64], t: float) -> NDArray[np.float64]:
        """Return the optical flow [px/s] of the points that pixels see at time ``t`` [s], shape (n, 2).

        ``seen``: surfaces that appear at ``pixels`` [px] in the image without the prism.
        """
        rays = [self._ray_at(seen, pixels, t, t + h) for h in (-MOMENT_S, MOMENT_S)]
        change = (rays[1] - rays[0]) / (2.0 * MOMENT_S)
        middle = (rays[0] + rays[1]) / 2.0
        rate = np.linalg.norm(change, axis=1, keepdims=True)
        aside = ANGLE * change / np.maximum(rate, 1e-12)
        camera = self._simulation.camera
        ends = [camera.rays_to_pixels(middle + sign * aside).astype(np.float64) for sign in (-1.0, 1.0)]
        return np.asarray((ends[1] - ends[0]) / (2.0 * ANGLE) * rate)

    def _ray_at(self, seen: SurfaceView, pixels: NDArray[np.float64], t: float, later: float) -> NDArray[np.float64]:
        """Return unit rays from the camera at time ``later`` [s] to the points that pixels see at time ``t`` [s].

        The rays are in the camera's frame, shape (n, 3).
        """
        (r0, r1), (p0, p1) = self._scene.trajectory.poses([t, later])
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
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))

    def _prism_flow(
        self,
        model: ExactModel,
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
        turned = [model.deflect_points(places, theta + sign * ANGLE) for sign in (-10.0, 10.0)]
        (before, after) = self._simulation.motion.angle([t_us - 50.0, t_us + 50.0])
        rate = (after - before) / 1e-4
        return np.asarray((along[1] - along[0]) / 2.0 * size + (turned[1] - turned[0]) / (20.0 * ANGLE) * rate)

    def _intensity(self, t_us: int, *, prism: bool) -> NDArray[np.float32]:
        """Return the luminance of all pixels at a time, through the prism or without the prism, shape (n,)."""
        simulation, device = self._simulation, self._world.device
        model = simulation.true_model
        if not prism:
            model = replace(model, prism=replace(model.prism, apex=0.0), cylinder=(0.0, 0.0))
        view = prism_view.View()
        view.prism = model.params(device)
        self._sight.set_instants(np.array([float(t_us)]), view)
        angle = simulation.motion.phase + float(simulation.motion.angle([t_us])[0])
        table: NDArray[Any] = np.zeros(1, cast("Any", prism_view.Step).numpy_dtype())
        table["azimuth"] = (math.cos(angle), math.sin(angle))
        steps = prism_view.Steps()
        steps.at = wp.array(table, dtype=prism_view.Step, device=device)
        return np.array(self._sight.light(steps, 0, 1).numpy()[0])


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
        count = int(duration_us * 1e-6 * rate) + 1
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
        self.known = KnownPixels(simulation)
        """Masks of known pixels, if the pictures have some."""

    @property
    def labels(self) -> WorldLabels | None:
        """Names and classes of the instances in the world; None for a picture scene."""
        if self._scene is None:
            return None
        world = self._scene.world
        return WorldLabels(world.name, world.instances, world.categories)

    def frames_before(self, t_us: int) -> Iterator[FrameTruth]:
        """Yield the ground truth of the remaining instants before ``t_us`` [us].

        At the end of the recording, yield all remaining instants.
        """
        while self._next_instant < len(self._instants) and (
            self._instants[self._next_instant] < t_us or t_us >= self._duration_us
        ):
            assert self._renderer is not None
            yield self._renderer.at(int(self._instants[self._next_instant]))
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
        frames = MemoryFrames(self._frames) if self._frames else None
        poses = Poses.concatenate(self._poses) if self._poses else None
        masks = MemoryMasks(*zip(*self._masks, strict=True)) if self._masks else None
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
    bodies = {body.name: as_poses(*body.trajectory.poses(t)) for body in world.moving if body.trajectory is not None}
    joints = {name: path.poses(t)[1] for name, path in world.joints.items()}
    return Poses(t_us, as_poses(*scene.trajectory.poses(t)), bodies, joints)
