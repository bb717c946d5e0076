"""Light of the frames of a simulated camera: the mean over the exposure of each row."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.engine import steps_of
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.rigs.cameras import RigFrameCamera
from amiwarp.simulation.view import prism_view_of
from amiwarp.simulation.worlds.device_world import device_world
from amiwarp.simulation.worlds.image_speed import flicker_interval_s, image_speed_at
from amiwarp.simulation.worlds.sight import INSTANTS_TOGETHER, WorldSight
from amiwarp.simulation.worlds.world_scene import WorldScene

MOTION_PX = 0.5
"""Largest motion of the image between two instants of an exposure [px]."""
MOST_INSTANTS = 128
"""Largest number of instants of an exposure. If the image moves by over 64 px, the instants are further apart."""


class FrameRenderer:
    """Renders the light of frames of a camera that follows a trajectory through a world."""

    def __init__(self, frames: RigFrameCamera, scene: WorldScene, device: str) -> None:
        self._frames = frames
        self._scene = scene
        # A camera without an optic; its duration has no effect.
        self._simulation = SimulationValues(
            scene, frames.camera, Prism(0.0), 1.0, PrismMotion(0.0), encoder_model=None
        )
        self._world = device_world(scene.world, device)
        worlds = [self._world]
        if frames.colour:
            worlds = [self._world.in_colour(channel) for channel in range(3)]
        self._sights = [WorldSight(self._simulation, scene, world) for world in worlds]
        self._view = prism_view_of(self._simulation, self._world.device)
        if frames.readout_us:
            for sight in self._sights:
                sight.roll()

    def light(self, begin_us: int) -> NDArray[np.float32]:
        """Return the mean luminance of a frame, whose middle row's exposure begins at ``begin_us``.

        The shape is (height, width), or (height, width, 3) in colour.
        """
        camera = self._frames.camera
        exposure_us = self._frames.exposure_us
        begins = begin_us + self._row_delays()
        count = self._instants(begins)
        # The middles of equal parts of each exposure, row by row
        parts = (np.arange(count) + 0.5) / count * exposure_us
        totals = np.zeros((len(self._sights), camera.width * camera.height))
        for first in range(0, count, INSTANTS_TOGETHER):
            together = parts[first : first + INSTANTS_TOGETHER]
            times = (together[:, None] + begins).ravel()
            steps = steps_of(self._simulation, times, self._world.device)
            for sight, total in zip(self._sights, totals, strict=True):
                sight.set_instants(times, self._view)
                lights = sight.light(steps, 0, len(together)).numpy()
                total += lights.sum(axis=0, dtype=np.float64)
        mean = (totals.T / count).astype(np.float32)
        channels = (3,) if self._frames.colour else ()
        return mean.reshape(camera.height, camera.width, *channels)

    def _row_delays(self) -> NDArray[np.float64]:
        """Return how much later than the middle row's each row's exposure begins [us].

        With a global shutter, there is one for all rows.
        """
        readout_us = self._frames.readout_us
        height = self._frames.camera.height
        if not readout_us or height == 1:
            return np.zeros(1 if not readout_us else height)
        return readout_us * (np.arange(height) / (height - 1) - 0.5)

    def _instants(self, begins: NDArray[np.float64]) -> int:
        """Return the number of instants of each exposure, by the speed of the image while the rows are exposed.

        ``begins``: begins of the exposures of the rows [us].
        """
        exposure_s = 1e-6 * self._frames.exposure_us
        moments = 1e-6 * np.linspace(begins[0], begins[-1] + self._frames.exposure_us, 3)
        trajectory = self._scene.trajectory
        speed = image_speed_at(self._world, self._frames.camera, trajectory, moments)
        by_motion = math.ceil(speed.total * exposure_s / MOTION_PX)
        by_flicker = math.ceil(exposure_s / flicker_interval_s(self._scene.world))
        return min(max(1, by_motion, by_flicker), MOST_INSTANTS)
