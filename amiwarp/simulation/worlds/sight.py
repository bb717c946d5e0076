"""Connection of the event simulator to a world: rays of pixels, image speeds, and surfaces that events saw."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import world as kernels
from amiwarp.kernels import world_events, world_view
from amiwarp.kernels.launch import launch
from amiwarp.optics.device_camera import camera_params
from amiwarp.simulation.pictures import DARK
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.motion import movers_speed, parallax_speed, rotation_speed
from amiwarp.simulation.worlds.renderer import SMALLEST_LAUNCH

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation
    from amiwarp.simulation.worlds.world_scene import WorldScene

RAYS_PER_PIXEL = 4
"""Default number of rays per pixel if pixels see the world by rays."""
LEAST_CONE_PX = 0.25
"""Smallest width of the cone of a ray [px]. Textures are averaged over the cone."""
MOMENTS = 64
"""Number of times in a simulation at which the speed of the world's image is computed."""


def aperture(scene: WorldScene) -> NDArray[np.float32]:
    """Return the rays of a pixel, shape (n, 3): x and y relative to the centre [px], and weights that sum to 1.

    The rays are the nodes of a Gauss-Hermite quadrature with the variance of the optical blur.
    """
    side = math.isqrt(scene.samples or RAYS_PER_PIXEL)
    nodes, weights = np.polynomial.hermite_e.hermegauss(side)
    x, y = np.meshgrid(nodes * scene.blur, nodes * scene.blur)
    return np.stack([x.ravel(), y.ravel(), np.outer(weights, weights).ravel() / weights.sum() ** 2], 1).astype(
        np.float32
    )


@dataclass(frozen=True, slots=True)
class ImageSpeed:
    """Upper bounds of the speed at which a world's image without the prism moves [px/s]."""

    total: float
    """Speed due to all motion of the camera and the bodies [px/s]."""
    in_maps: float
    """Speed due to moving bodies and the camera's translation [px/s], which require new maps."""


def image_speed(world: DeviceWorld, simulation: Simulation, scene: WorldScene) -> ImageSpeed:
    """Return the largest speeds of a world's image over the duration of a simulation."""
    t = np.linspace(0.0, simulation.duration_s, MOMENTS)
    camera, trajectory = simulation.camera, scene.trajectory
    world.set_instants(t)
    speed = movers_speed(world, camera, trajectory, t)
    if trajectory.moves:
        speed = speed + [parallax_speed(world, camera, trajectory, float(at), k) for k, at in enumerate(t)]
    total = speed + rotation_speed(camera, trajectory, t)
    return ImageSpeed(float(total.max()), float(speed.max()))


class WorldSight:
    """Inputs of the kernels that cast rays: camera and world at the instants of a chunk of simulated time."""

    def __init__(self, simulation: Simulation, scene: WorldScene, world: DeviceWorld) -> None:
        self._scene, self._world, device = scene, world, world.device
        camera = simulation.camera
        self._view = world_events.RayView()
        self._view.camera = camera_params(camera, str(device))
        self._view.aperture = wp.array(aperture(scene), dtype=wp.vec3, device=device)
        side = math.isqrt(scene.samples or RAYS_PER_PIXEL)
        width = 1.0 if side == 1 else max(2.0 * scene.blur * math.sqrt(2.0 / side), LEAST_CONE_PX)
        self._view.cone = width / max(camera.fx, camera.fy)
        self._view.dark = DARK

    def set_instants(self, t_us: NDArray[np.float64], view: Any) -> None:
        """Set the poses of the camera and the bodies at the instants of a chunk.

        ``t_us``: times [us]; ``view``: a :class:`amiwarp.kernels.prism_view.View` with the prism.
        """
        t = np.maximum(t_us, 0.0) * 1e-6
        self._world.set_instants(t)
        poses: NDArray[Any] = np.zeros(len(t), cast("Any", kernels.Pose).numpy_dtype())
        poses["rotation"], poses["position"] = self._scene.trajectory.poses(t)
        self._view.poses = wp.array(poses, dtype=kernels.Pose, device=self._world.device)
        self._view.prism = view.prism

    def inputs(self) -> list[Any]:
        """Return world and camera, the first inputs of the kernels that cast rays for pixels."""
        return [self._world.params, self._view]

    def look(self, view: Any, steps: Any, block: Any, n: int, faces: Any) -> Any:
        """Return the surfaces that ``n`` events saw, as a :class:`amiwarp.kernels.world_view.SeenSurfaces`.

        ``view``, ``steps``: camera and instants of the chunk; ``block``: events; ``faces``: face of each texel of the
        maps, or an empty array without maps.
        """
        out = world_view.SeenSurfaces()
        device = self._world.device
        for name, dtype in (("instance", wp.uint16), ("depth", float), ("place", wp.vec3)):
            setattr(out, name, wp.empty(n, dtype=dtype, device=device))
        inputs = [self._world.params, view, steps, self._view.poses, faces, block.points, block.ticks]
        launch(world_view.find_seen_surfaces, n, inputs, [out], device=device, smallest=SMALLEST_LAUNCH)
        return out
