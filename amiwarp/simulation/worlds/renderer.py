"""Views of a world: luminance, depth, normals and instances, without the prism."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import world as kernels
from amiwarp.kernels import world_view
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.simulation.worlds.device_world import DeviceWorld

SMALLEST_LAUNCH = 1 << 10
"""Rays that are worth a thread on a CPU."""
ROTATED_GRID = [(-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)]
"""Places of four samples from a pixel's centre [px]: fixed, so that sampling fires no events."""


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """What rays meet."""

    depth: NDArray[np.float32]
    """Depth along the camera's axis [m], shape (n,); infinite for the sky."""
    normal: NDArray[np.float32]
    """Unit normals in the world's frame, towards the camera, shape (n, 3); zero for the sky."""
    instance: NDArray[np.int32]
    """Instance numbers, shape (n,): 0 is the sky, i + 1 is ``World.instances[i]``."""
    mover: NDArray[np.int32]
    """Number of the moving body, as in ``World.moving``, shape (n,); -1 for what rests."""
    place: NDArray[np.float32]
    """Place in the world [m], shape (n, 3)."""


def device_pose(rotation: NDArray[np.float64], position: NDArray[np.float64]) -> Any:
    """Return a pose for the kernels from a matrix (3, 3) and a position [m]."""
    pose = kernels.Pose()
    pose.rotation = wp.mat33(*np.asarray(rotation).ravel().tolist())
    pose.position = wp.vec3(*np.asarray(position).tolist())
    return pose


def surfaces_at(
    world: DeviceWorld,
    rays: NDArray[Any],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    instant: int = 0,
) -> SurfaceView:
    """Return what rays meet.

    ``rays``: in the camera's frame, shape (n, 3); ``instant``: a row of :meth:`DeviceWorld.set_instants`.
    """
    n, device = len(rays), world.device
    out = world_view.Surfaces()
    for name, dtype in (("depth", float), ("normal", wp.vec3), ("instance", int), ("mover", int), ("place", wp.vec3)):
        setattr(out, name, wp.empty(n, dtype=dtype, device=device))
    unit = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    inputs = [world.params, instant, wp.array(unit, dtype=wp.vec3, device=device), device_pose(rotation, position)]
    launch(world_view.find_surfaces, n, inputs, [out], device=device, smallest=SMALLEST_LAUNCH)
    return SurfaceView(*(getattr(out, name).numpy() for name in ("depth", "normal", "instance", "mover", "place")))


def pixel_rays(camera: Camera) -> NDArray[np.float64]:
    """Return the unit rays of all pixels, row by row, shape (n, 3)."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.pixels_to_rays(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64))


def sample_grid(samples: int, device: Any) -> wp.array:
    """Return the places of a pixel's samples from its centre [px]."""
    centres = (np.arange(math.isqrt(samples)) + 0.5) / math.isqrt(samples) - 0.5
    places = ROTATED_GRID if samples == 4 else [(x, y) for y in centres for x in centres]
    return wp.array(np.array(places, np.float32), dtype=wp.vec2, device=device)


class MapRenderer:
    """Renders maps of a world on a plane at distance 1 before the camera, as bilinear pieces of log intensity."""

    def __init__(self, world: DeviceWorld, frame: Any, *, blur: float, dark: float, samples: int) -> None:
        """``frame``: a :class:`amiwarp.kernels.world_view.MapFrame` without a pose; ``blur``: sigma [texels]."""
        self._world, self._frame, self._dark = world, frame, dark
        frame.offsets = sample_grid(samples, world.device)
        n = frame.width * frame.height
        self._light, self._half = (wp.empty(n, dtype=float, device=world.device) for _ in range(2))
        self._body = wp.empty(n, dtype=int, device=world.device)
        reach = max(1, math.ceil(3.0 * blur))
        along = np.arange(-reach, reach + 1)
        weights = np.exp(-0.5 * (along / max(blur, 1e-6)) ** 2)
        self._weights = wp.array((weights / weights.sum()).astype(np.float32), dtype=float, device=world.device)

    def render(self, pose: Any, instant: int, out: wp.array, first: int) -> None:
        """Render one map into ``out`` from place ``first`` on."""
        f, device = self._frame, self._world.device
        f.pose, f.instant = pose, instant
        n = f.width * f.height
        inputs = [self._world.params, f]
        launch(world_view.render_map, n, inputs, [self._light, self._body], device=device, smallest=SMALLEST_LAUNCH)
        if len(f.offsets) > 1:
            inputs += [self._light, self._body]
            launch(world_view.refine_map, n, inputs, [self._half], device=device, smallest=SMALLEST_LAUNCH)
            self._light, self._half = self._half, self._light
        for across, source, target in ((0, self._light, self._half), (1, self._half, self._light)):
            inputs = [source, self._weights, f.width, f.height, across]
            launch(world_view.blur_lines, n, inputs, [target], device=device)
        inputs = [self._light, f.width, f.height, self._dark, first]
        launch(world_view.log_pieces, n, inputs, [out], device=device)
