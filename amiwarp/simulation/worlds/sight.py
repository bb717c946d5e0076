"""Connection of the event simulator to a world: rays of pixels, image speeds, and surfaces that events saw."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import world as kernels
from amiwarp.kernels import world_rays
from amiwarp.kernels import world_rays as world_view
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import camera_params
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.renderer import (
    SMALLEST_LAUNCH,
    TILE,
    first_hits,
    movers_speed,
    parallax_speed,
    rotation_speed,
)

if TYPE_CHECKING:
    from amiwarp.simulation.description import SimulationValues
    from amiwarp.simulation.worlds.world import WorldScene

RAYS_PER_PIXEL = 4
"""Default number of rays per pixel if pixels see the world by rays."""
LEAST_CONE_PX = 0.25
"""Smallest width of the cone of a ray [px]. Textures are averaged over the cone."""
MOMENTS = 64
"""Number of times in a simulation at which the speed of the world's image is computed."""
INSTANTS_TOGETHER = 16
"""Number of instants at which all pixels cast their rays together."""


def aperture(samples: int, blur: float) -> NDArray[np.float32]:
    """Return the rays of a pixel, shape (n, 3): x and y relative to the centre [px], and weights that sum to 1.

    The rays are the nodes of a Gauss-Hermite quadrature with the standard deviation ``blur`` of the optical blur [px].
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(math.isqrt(samples))
    x, y = np.meshgrid(nodes * blur, nodes * blur)
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


def image_speed(world: DeviceWorld, simulation: SimulationValues, scene: WorldScene) -> ImageSpeed:
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
    """Light that pixels receive from a world through the prism, at the instants of a chunk of simulated time."""

    def __init__(self, simulation: SimulationValues, scene: WorldScene, world: DeviceWorld) -> None:
        self._scene, self._world, device = scene, world, world.device
        camera, samples = simulation.camera, scene.samples or RAYS_PER_PIXEL
        rays = aperture(samples, scene.blur)
        view = self._view = world_rays.RayView()
        view.camera = camera_params(camera, str(device))
        view.aperture = wp.array(rays, dtype=wp.vec3, device=device)
        view.reach = max(1, math.ceil(float(np.abs(rays[:, :2]).max())))
        side = math.isqrt(samples)
        width = 1.0 if side == 1 else max(2.0 * scene.blur * math.sqrt(2.0 / side), LEAST_CONE_PX)
        view.cone = width / max(camera.fx, camera.fy)
        self._pixels = camera.width * camera.height
        self._tiled = math.prod(-(-size // TILE) * TILE for size in (camera.width, camera.height))
        self._light: wp.array = wp.empty(0, dtype=float, device=device)
        self._cast: wp.array = wp.empty(0, dtype=float, device=device)
        self._batch = world_rays.Batch()
        self._marks: wp.array = wp.empty(0, dtype=int, device=device)
        self._listed: wp.array = wp.empty(0, dtype=int, device=device)

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

    def light(self, steps: Any, first: int, count: int) -> wp.array:
        """Return the luminance that each pixel sees at ``count`` instants, the first of which has the index ``first``.

        The shape of the array is (count, pixels). The array is valid until the next call.
        """
        n = self._pixels
        if len(self._light) < count * n:
            self._light = wp.empty(count * n, dtype=float, device=self._world.device)
        self._reserve(min(count, INSTANTS_TOGETHER))
        for k in range(0, count, INSTANTS_TOGETHER):
            self._batch.first, self._batch.count = first + k, min(INSTANTS_TOGETHER, count - k)
            self._batch.hits.light = self._light[k * n : (k + self._batch.count) * n]
            self._cast_batch(steps)
        return self._light[: count * n].reshape((count, n))

    def _reserve(self, count: int) -> None:
        """Allocate the arrays of a batch of ``count`` instants."""
        if len(self._listed) < count * self._tiled:
            device = self._world.device
            self._batch.hits = first_hits(count * self._pixels, device)
            self._marks, self._listed = (wp.empty(count * self._tiled, dtype=int, device=device) for _ in range(2))

    def _cast_batch(self, steps: Any) -> None:
        """Write the luminance of all pixels at the instants of the batch to ``light`` of its hits."""
        device, batch, view, rays = self._world.device, self._batch, self._view, len(self._view.aperture)
        seen = [self._world.params, view, steps]
        launch(world_rays.cast_centres, self._tiled, seen, [batch], device=device, smallest=SMALLEST_LAUNCH)
        if rays == 1:
            return
        n = self._tiled * batch.count
        marks = self._marks[:n]
        launch(world_rays.smooth_insides, n, [*seen, batch], [marks], device=device)
        wp.utils.array_scan(marks, marks, inclusive=True)
        launch(world_rays.list_marked, n, [marks], [self._listed], device=device)
        listed = int(marks[n - 1 :].numpy()[0])
        if len(self._cast) < listed * rays:
            self._cast = wp.empty(listed * rays * 5 // 4, dtype=float, device=device)
        launch(world_rays.cast_edges, listed * rays, [*seen, batch, self._listed], [self._cast], device=device,
               smallest=SMALLEST_LAUNCH)  # fmt: skip
        launch(world_rays.add_edges, listed, [view, batch, self._listed, self._cast], [], device=device)

    def look(self, view: Any, steps: Any, block: Any, n: int, faces: Any) -> Any:
        """Return the surfaces that ``n`` events saw, as a :class:`amiwarp.kernels.world_rays.SeenSurfaces`.

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
