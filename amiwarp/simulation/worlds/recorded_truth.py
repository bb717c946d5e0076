"""Ground truth that a simulation records next to the events: labels, instants and poses of its world, known pixels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import TIME_LIMIT
from amiwarp.events.recording import Truth
from amiwarp.events.truth import EventTruth, FrameTruth, MemoryFrames, MemoryMasks, Poses, WorldLabels, as_poses
from amiwarp.simulation.known import KnownPixels
from amiwarp.simulation.worlds.frame_truth import TruthRenderer
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.validation import array, real, shown

if TYPE_CHECKING:
    from amiwarp.events.truth import EventValues
    from amiwarp.simulation.simulator import Simulation

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

    def __init__(self, simulation: Simulation, instants: NDArray[np.int64]) -> None:
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
