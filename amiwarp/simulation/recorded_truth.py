"""Ground truth that a simulation records next to the events: labels, instants and poses of its world, known pixels."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events import poses, truth
from amiwarp.events.poses import Poses
from amiwarp.events.truth import EventValues, FrameTruth, Truth
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.known_pixels import KnownPixels
from amiwarp.simulation.truth_renderer import TruthRenderer
from amiwarp.simulation.worlds.world import World
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.validation import TIME_LIMIT, array, real, shown

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
        raise AmiwarpError(
            "truth_hz and truth_times_us are both given; give one of them", ErrorCode.OPTIONS
        )
    if truth_hz is not None:
        rate = real(truth_hz, "truth_hz", 1e-3, 1e6, " 1/s")
        count = int(duration_us * rate / 1e6 + 1e-9) + 1  # rounding must not lose the last instant
        if count > MOST_INSTANTS:
            raise AmiwarpError(
                f"truth_hz {rate:g} gives {count} instants; the limit is {MOST_INSTANTS}; give a lower rate"
            )
        times = np.rint(np.arange(count) * (1e6 / rate))
        return np.unique(np.minimum(times, duration_us).astype(np.int64))
    times = array([] if truth_times_us is None else truth_times_us, "truth_times_us")
    if not (np.abs(times) <= TIME_LIMIT).all():
        raise AmiwarpError(
            f"truth_times_us is {shown(times)}; give finite times within 0 .. {duration_us} us"
        )
    instants = np.rint(times).astype(np.int64)
    outside = (instants < 0).any() or (instants > duration_us).any()
    if instants.ndim != 1 or outside or (np.diff(instants) <= 0).any():
        raise AmiwarpError(
            f"truth_times_us must increase and lie within 0 .. {duration_us} us; sort the times"
        )
    return instants


class RecordedTruth:
    """Producer of the ground truth that a simulation records, in order of time.

    A world gives labels, maps of the chosen instants, and poses. A picture scene gives nothing.
    """

    def __init__(self, simulation: SimulationValues, instants: NDArray[np.int64]) -> None:
        scene = simulation.scene
        self._scene = scene if isinstance(scene, WorldScene) else None
        self._renderer = TruthRenderer(simulation) if len(instants) else None
        self._instants = instants
        self._next_instant = 0  # index
        self._next_pose = 0  # time [us]
        self._duration_us = simulation.duration_us
        self._frames: list[FrameTruth] = []
        self._poses: list[Poses] = []
        self._masks: list[tuple[int, NDArray[np.bool_]]] = []
        self.known = KnownPixels(simulation)
        """Masks of known pixels, if the pictures have some."""

    @property
    def labels(self) -> truth.WorldLabels | None:
        """Names and classes of the instances in the world; None for a picture scene."""
        return None if self._scene is None else labels_of(self._scene.world)

    def frames_before(self, t_us: int) -> Iterator[FrameTruth]:
        """Yield the ground truth of the remaining instants before ``t_us`` [us].

        At the end of the recording, yield all remaining instants.
        """
        at_the_end = t_us >= self._duration_us
        while self._next_instant < len(self._instants):
            instant = int(self._instants[self._next_instant])
            if instant >= t_us and not at_the_end:
                return
            assert self._renderer is not None
            following = self._other_instant(self._next_instant + 1)
            before = self._other_instant(self._next_instant - 1)
            yield self._renderer.at(instant, following, before)
            self._next_instant += 1

    def _other_instant(self, index: int) -> int | None:
        """Return the time of an instant [us], or None if there is none of this index."""
        return int(self._instants[index]) if 0 <= index < len(self._instants) else None

    def poses_before(self, t_us: int) -> Poses | None:
        """Return the remaining poses before ``t_us`` [us]; None for a picture scene.

        At the end of the recording, return all remaining poses.
        """
        if self._scene is None:
            return None
        at_the_end = t_us >= self._duration_us
        stop = self._duration_us + 1 if at_the_end else t_us
        stop = max(stop, self._next_pose)
        times = np.arange(self._next_pose, stop, POSE_INTERVAL_US, dtype=np.int64)
        self._next_pose += len(times) * POSE_INTERVAL_US
        return poses_at(self._scene, times)

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
        masks = None
        if self._masks:
            times, known = zip(*self._masks, strict=True)
            masks = truth.MemoryMasks(times, known)
        return Truth(
            parameters,
            stored_points=of_events.get("points"),
            stored_causes=of_events.get("cause"),
            stored_instances=of_events.get("instance"),
            stored_depths=of_events.get("depth"),
            stored_places=of_events.get("place"),
            labels=self.labels,
            frames=frames,
            poses=poses,
            known=masks,
        )


def labels_of(world: World) -> truth.WorldLabels:
    """Return the names and classes of the instances in a world."""
    return truth.WorldLabels(world.name, world.instances, world.categories)


def poses_at(scene: WorldScene, t_us: NDArray[np.int64]) -> Poses:
    """Return the poses of the camera, the moving bodies and the joints at times [us], shape ``(k,)``."""
    t = t_us * 1e-6
    world = scene.world
    if not len(t):
        bodies = {body.name: np.zeros((0, 7)) for body in world.moving}
        joints = {name: np.zeros((0, 3)) for name in world.joints}
        return Poses(t_us, np.zeros((0, 7)), bodies, joints)
    camera = poses.as_poses(*scene.trajectory.poses(t))
    bodies = {}
    for body in world.moving:
        assert body.trajectory is not None
        bodies[body.name] = poses.as_poses(*body.trajectory.poses(t))
    joints = {name: path.poses(t)[1] for name, path in world.joints.items()}
    return Poses(t_us, camera, bodies, joints)
