"""What the simulator's engine asks of a world: maps or rays, and what each event saw."""

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
from amiwarp.simulation.worlds.motion import body_speed, flicker_interval_s, parallax_speed, turn_speed
from amiwarp.simulation.worlds.renderer import SMALLEST_LAUNCH

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation
    from amiwarp.simulation.worlds.world_scene import WorldScene

RAYS_PER_PIXEL = 4
LEAST_CONE_PX = 0.25
"""Smallest angular width of a ray [px]."""
MOMENTS = 64
"""Times of a simulation at which the speed of the world's image is taken."""


def aperture(scene: WorldScene) -> NDArray[np.float32]:
    """Return the rays of a pixel, shape (n, 3): x and y from its centre [px], and weights that sum to 1.

    Nodes of the Gauss-Hermite quadrature of the optical blur: their variance is the blur's.
    """
    side = math.isqrt(scene.samples or RAYS_PER_PIXEL)
    nodes, weights = np.polynomial.hermite_e.hermegauss(side)
    x, y = np.meshgrid(nodes * scene.blur, nodes * scene.blur)
    return np.stack([x.ravel(), y.ravel(), np.outer(weights, weights).ravel() / weights.sum() ** 2], 1).astype(
        np.float32
    )


@dataclass(frozen=True, eq=False)
class SeenSurfaces:
    """What each event saw, on the device: the surface that its pixel saw through the prism at its crossing."""

    instance: Any
    """Instance number, uint16, shape (n,): 0 is the sky, i + 1 is ``World.instances[i]``."""
    depth: Any
    """Depth along the camera's axis [m], float32, shape (n,); infinite for the sky."""
    place: Any
    """Point in the world [m], vec3, shape (n,); NaN for the sky."""


def largest_speed(world: DeviceWorld, simulation: Simulation, scene: WorldScene) -> float:
    """Return a bound of the image's speed [px/s] but for the prism's share."""
    t = np.linspace(0.0, simulation.duration_s, MOMENTS)
    camera, trajectory = simulation.camera, scene.trajectory
    world.set_instants(t)
    speed = turn_speed(camera, trajectory, t)
    if trajectory.moves:
        speed = speed + [parallax_speed(world, camera, trajectory, float(at), k) for k, at in enumerate(t)]
    bodies = [body_speed(body, trajectory, max(camera.fx, camera.fy), t) for body in world.movers]
    return float((speed + np.max(bodies, axis=0, initial=0.0)).max()) if bodies else float(speed.max())


class WorldSight:
    """The poses of a chunk's instants on the device, the rays of pixels, and what events saw."""

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
        """Put camera and bodies where they are at the instants of a chunk [us]."""
        t = np.maximum(t_us, 0.0) * 1e-6
        self._world.set_instants(t)
        poses: NDArray[Any] = np.zeros(len(t), cast("Any", kernels.Pose).numpy_dtype())
        poses["rotation"], poses["position"] = self._scene.trajectory.poses(t)
        self._view.poses = wp.array(poses, dtype=kernels.Pose, device=self._world.device)
        self._view.prism = view.prism

    def inputs(self) -> list[Any]:
        """First inputs of the kernels that cast rays for pixels."""
        return [self._world.params, self._view]

    def look(self, view: Any, steps: Any, block: Any, n: int) -> SeenSurfaces:
        """Return what ``n`` events saw."""
        out = world_view.EventTruth()
        device = self._world.device
        for name, dtype in (("instance", wp.uint16), ("depth", float), ("place", wp.vec3)):
            setattr(out, name, wp.empty(n, dtype=dtype, device=device))
        inputs = [self._world.params, view, steps, self._view.poses, block.x, block.y, block.ticks]
        launch(world_view.find_event_truth, n, inputs, [out], device=device, smallest=SMALLEST_LAUNCH)
        return SeenSurfaces(out.instance, out.depth, out.place)


def interval_limit_us(scene: WorldScene) -> float:
    """Return the longest step that flickering lamps allow [us]."""
    return 1e6 * flicker_interval_s(scene.world)
