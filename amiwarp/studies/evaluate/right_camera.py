"""Right camera of a stereo pair: the same world, camera and kind of prism, next to the camera of a condition."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.evaluate.conditions import Condition
from amiwarp.studies.evaluate.streams import Streams

BASELINE_M = 0.1
"""Distance of the right camera from the left one, along the x axis, which they share [m]."""
PHASE_AHEAD = 2.0
"""Azimuth of the right camera's prism, relative to the left one's [rad]: two motors do not turn in phase."""
OTHER_SEED = 1_000_033
"""Difference of the seeds of the two sensors."""
RATE_HZ = 1000.0
"""Rate at which the path of the right camera is sampled [Hz]; its error is below a nanometre."""


@dataclass(frozen=True)
class RightCondition(Condition):
    """Condition of the right camera: a sensor with other noise, and a prism at another angle."""

    @classmethod
    def of(cls, left: Condition) -> RightCondition:
        """Return the condition of the right camera of a pair whose left camera has the condition ``left``."""
        return cls(**asdict(left))

    @property
    def phase(self) -> float:
        """Azimuth of the prism at the start of the recording [rad]."""
        return super().phase + PHASE_AHEAD

    def simulation(self, device: str) -> Simulation:
        """Return the simulation of the right AMI-EV."""
        at_left = super().simulation(device)
        scene = at_left.scene
        assert isinstance(scene, WorldScene)
        path = to_the_right(scene.trajectory, BASELINE_M)
        seed = self.seed + OTHER_SEED
        return replace(at_left, scene=replace(scene, trajectory=path), seed=seed)


def right_streams(left: Streams) -> Streams:
    """Return the streams of the right camera. Its prism is known as well as the left one's."""
    return Streams(RightCondition.of(left.condition), left.device, left.setup)


def to_the_right(trajectory: Trajectory, distance_m: float) -> Trajectory:
    """Return the path of a camera with the same orientation, at a distance along the first one's x axis."""
    from scipy.spatial.transform import Rotation

    t = np.asarray(trajectory.t, np.float64)
    if len(t) > 1:
        samples = round((t[-1] - t[0]) * RATE_HZ) + 1
        t = np.linspace(t[0], t[-1], max(samples, 3))
    rotation, position = trajectory.poses(t)
    orientation = Rotation.from_matrix(rotation).as_quat()
    return Trajectory(t, position + distance_m * rotation[:, :, 0], orientation)
