"""Depth images of a simulated depth camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.rigs.cameras import RigDepthCamera
from amiwarp.simulation.worlds.device_world import device_world
from amiwarp.simulation.worlds.surfaces import pixel_rays, surfaces_at
from amiwarp.simulation.worlds.world_scene import WorldScene


class DepthRenderer:
    """Renders the depth that a camera sees that follows a trajectory through a world."""

    def __init__(self, depths: RigDepthCamera, scene: WorldScene, device: str) -> None:
        self._depths = depths
        self._scene = scene
        self._world = device_world(scene.world, device)
        self._rays = pixel_rays(depths.camera)
        self._no_ray = ~np.isfinite(self._rays).all(axis=1)

    def depth(self, t_us: int) -> NDArray[np.float32]:
        """Return the depth of all pixels along the optical axis at a time [m], shape (height, width).

        It is infinite for the sky, and NaN for surfaces out of range and for pixels without a ray.
        """
        t = np.array([1e-6 * t_us])
        (rotation,), (position,) = self._scene.trajectory.poses(t)
        self._world.set_instants(t)
        depth = surfaces_at(self._world, self._rays, rotation, position).depth.copy()
        is_sky = np.isinf(depth)
        out_of_range = depth < self._depths.nearest_m
        if self._depths.farthest_m is not None:
            out_of_range |= depth > self._depths.farthest_m
        depth[(out_of_range & ~is_sky) | self._no_ray] = np.nan
        camera = self._depths.camera
        return depth.reshape(camera.height, camera.width)
