"""What pixels see of a world: the luminance of their rays, and the surfaces that events saw."""

import math
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.launch import launch
from amiwarp.kernels.plate import PlateParams
from amiwarp.optics.models.plate import PlateModel
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.kernels import visible_surfaces, world_rays
from amiwarp.simulation.kernels import world as kernels
from amiwarp.simulation.kernels.visible_surfaces import (
    find_centres,
    find_seen_surfaces,
    find_surfaces_through_plate,
)
from amiwarp.simulation.view import shake
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.map_renderer import TILE
from amiwarp.simulation.worlds.surfaces import SMALLEST_LAUNCH, first_hits
from amiwarp.simulation.worlds.world_scene import WorldScene

RAYS_PER_PIXEL = 4
"""Default number of rays per pixel if pixels see the world by rays."""
LEAST_CONE_PX = 0.25
"""Smallest width of the cone of a ray [px]. Textures are averaged over the cone."""
INSTANTS_TOGETHER = 16
"""Number of instants at which all pixels cast their rays together."""


def aperture(samples: int, blur: float) -> NDArray[np.float32]:
    """Return the rays of a pixel, shape (n, 3): x and y relative to the centre [px], and weights that sum to 1.

    The rays are the nodes of a Gauss-Hermite quadrature with the standard deviation ``blur`` of the optical blur [px].
    """
    along_axis = math.isqrt(samples)
    nodes, weights = np.polynomial.hermite_e.hermegauss(along_axis)
    places = nodes * blur
    x, y = np.meshgrid(places, places)
    weight = np.outer(weights, weights) / weights.sum() ** 2
    return np.stack([x.ravel(), y.ravel(), weight.ravel()], axis=1).astype(np.float32)


class WorldSight:
    """Light that pixels receive from a world through the prism, at the instants of a chunk of simulated time."""

    def __init__(self, simulation: SimulationValues, scene: WorldScene, world: DeviceWorld) -> None:
        self._scene = scene
        self._world = world
        self._simulation = simulation
        device = world.device
        camera = simulation.camera
        samples = scene.samples or RAYS_PER_PIXEL
        rays = aperture(samples, scene.blur)
        self._view = world_rays.RayView()
        self._view.camera = camera_params(camera, str(device))
        self.set_plate(simulation.plate)
        self._view.aperture = wp.array(rays, dtype=wp.vec3, device=device)
        self._view.reach = max(1, math.ceil(float(np.abs(rays[:, :2]).max())))
        side = math.isqrt(samples)
        cone_px = 1.0
        if side > 1:
            cone_px = max(2.0 * scene.blur * math.sqrt(2.0 / side), LEAST_CONE_PX)
        self._view.cone = cone_px / max(camera.fx, camera.fy)

        # Pixels of the image, and of the image rounded up to whole tiles.
        self._pixels = camera.width * camera.height
        columns = -(-camera.width // TILE)
        rows = -(-camera.height // TILE)
        self._tiled = columns * rows * TILE * TILE

        # These arrays grow when they are needed.
        self._light: wp.array = wp.empty(0, dtype=float, device=device)
        self._cast: wp.array = wp.empty(0, dtype=float, device=device)
        self._batch = world_rays.Batch()
        self._batch.rows = 1
        self._marks: wp.array = wp.empty(0, dtype=int, device=device)
        self._listed: wp.array = wp.empty(0, dtype=int, device=device)

    def roll(self) -> None:
        """Give each row of the image its own instants: :meth:`set_instants` then takes them row by row."""
        self._batch.rows = self._simulation.camera.height

    def set_plate(self, plate: PlateModel | None) -> None:
        """Set the plate through which the camera looks; None takes it out."""
        self._view.plate = PlateParams() if plate is None else plate.params(self._world.device)

    def through_plate(
        self, rays: NDArray[Any], angle: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where rays of the camera, shape (n, 3), begin at an azimuth of the plate [rad], and their directions.

        Places [m] and directions have the shape (n, 3).
        """
        device = self._world.device
        rays_on_device = wp.array(rays.astype(np.float32), dtype=wp.vec3, device=device)
        places = wp.empty_like(rays_on_device)
        directions = wp.empty_like(rays_on_device)
        inputs = [self._view, wp.vec2(math.cos(angle), math.sin(angle)), rays_on_device]
        launch(find_centres, len(rays), inputs, [places, directions], device=device)
        return places.numpy(), directions.numpy()

    def set_instants(self, t_us: NDArray[np.float64], view: Any) -> None:
        """Set the poses of the camera and the bodies at the instants of a chunk.

        ``t_us``: times [us]; ``view``: a :class:`amiwarp.kernels.prism_view.View` with the prism.
        """
        t = np.maximum(t_us, 0.0) * 1e-6
        self._world.set_instants(t)
        poses: NDArray[Any] = np.zeros(len(t), cast("Any", kernels.Pose).numpy_dtype())
        rotation, position = self._scene.trajectory.poses(t)
        poses["position"] = position
        poses["rotation"] = rotation @ shake(self._simulation, t_us)
        self._view.poses = wp.array(poses, dtype=kernels.Pose, device=self._world.device)
        self._view.prism = view.prism
        self._view.second = view.second
        self._view.steered = view.steered

    def light(self, steps: Any, first: int, count: int) -> wp.array:
        """Return the luminance that each pixel sees at ``count`` instants, the first of which has the index ``first``.

        After :meth:`roll`, these are the numbers of images, whose rows have their own instants.
        The shape of the array is (count, pixels). The array is valid until the next call.
        """
        pixels = self._pixels
        if len(self._light) < count * pixels:
            self._light = wp.empty(count * pixels, dtype=float, device=self._world.device)
        self._reserve(min(count, INSTANTS_TOGETHER))
        for start in range(0, count, INSTANTS_TOGETHER):
            stop = min(start + INSTANTS_TOGETHER, count)
            self._batch.first = first + start
            self._batch.count = stop - start
            self._batch.hits.light = self._light[start * pixels : stop * pixels]
            self._cast_batch(steps)
        return self._light[: count * pixels].reshape((count, pixels))

    def _reserve(self, count: int) -> None:
        """Allocate the arrays of a batch of ``count`` instants."""
        if len(self._listed) < count * self._tiled:
            device = self._world.device
            self._batch.hits = first_hits(count * self._pixels, device)
            self._marks = wp.empty(count * self._tiled, dtype=int, device=device)
            self._listed = wp.empty(count * self._tiled, dtype=int, device=device)

    def _cast_batch(self, steps: Any) -> None:
        """Write the luminance of all pixels at the instants of the batch to ``light`` of its hits."""
        device = self._world.device
        batch = self._batch
        view = self._view
        rays = len(view.aperture)
        scene = [self._world.params, view, steps]
        self._launch_rays(world_rays.cast_centres, self._tiled, scene, [batch])
        if rays == 1:
            return

        # Most pixels see one smooth surface, and need no further rays; the others are listed.
        tiled = self._tiled * batch.count
        marks = self._marks[:tiled]
        launch(world_rays.smooth_insides, tiled, [*scene, batch], [marks], device=device)
        wp.utils.array_scan(marks, marks, inclusive=True)
        launch(world_rays.list_marked, tiled, [marks], [self._listed], device=device)
        listed = int(marks[tiled - 1 :].numpy()[0])

        if len(self._cast) < listed * rays:
            self._cast = wp.empty(listed * rays * 5 // 4, dtype=float, device=device)
        inputs = [*scene, batch, self._listed]
        self._launch_rays(world_rays.cast_edges, listed * rays, inputs, [self._cast])
        inputs = [view, batch, self._listed, self._cast]
        launch(world_rays.add_edges, listed, inputs, [], device=device)

    def _launch_rays(self, kernel: Any, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel that casts rays."""
        device = self._world.device
        launch(kernel, count, inputs, outputs, device=device, smallest=SMALLEST_LAUNCH)

    def look(self, view: Any, steps: Any, block: Any, count: int, faces: Any) -> Any:
        """Return the surfaces that ``count`` events saw, as a :class:`SeenSurfaces`.

        With a plate, this also finds the events' pixels without the plate, so that it can be called only once.
        ``view``, ``steps``: camera and instants of the chunk; ``block``: events; ``faces``: face of each texel of the
        maps, or an empty array without maps.
        """
        device = self._world.device
        world = self._world.params
        surfaces = visible_surfaces.SeenSurfaces()
        surfaces.instance = wp.empty(count, dtype=wp.uint16, device=device)
        surfaces.depth = wp.empty(count, dtype=float, device=device)
        surfaces.place = wp.empty(count, dtype=wp.vec3, device=device)
        if self._view.plate.thickness:
            inputs = [world, self._view, steps, block.ticks]
            outputs = [block.points, surfaces]
            self._launch_rays(find_surfaces_through_plate, count, inputs, outputs)
            return surfaces
        inputs = [world, view, steps, self._view.poses, faces, block.points, block.ticks]
        self._launch_rays(find_seen_surfaces, count, inputs, [surfaces])
        return surfaces
