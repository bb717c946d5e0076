"""Surfaces of a world that rays hit."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.simulation.kernels import visible_surfaces
from amiwarp.simulation.kernels.edges import FirstHits
from amiwarp.simulation.kernels.visible_surfaces import find_surfaces
from amiwarp.simulation.kernels.world import Pose
from amiwarp.simulation.worlds.device_world import DeviceWorld

SMALLEST_LAUNCH = 1 << 10
"""Smallest number of rays that one CPU thread handles."""


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """Surface that each of n rays hits first."""

    depth: NDArray[np.float32]
    """Depth of the surface along the camera's optical axis [m], shape (n,); infinite for the sky."""
    normal: NDArray[np.float32]
    """Unit normals in the world's frame, pointing to the camera's side, shape (n, 3); zero for the sky."""
    instance: NDArray[np.int32]
    """Instance numbers, shape (n,): 0 is the sky, i + 1 is ``World.instances[i]``."""
    mover: NDArray[np.int32]
    """Index of the body in ``World.moving``, shape (n,); -1 for bodies at rest and for the sky."""
    place: NDArray[np.float32]
    """Points on the surfaces, in the world's frame [m], shape (n, 3)."""


def device_pose(rotation: NDArray[np.float64], position: NDArray[np.float64]) -> Any:
    """Return the kernels' pose of a rotation matrix (3, 3) and a position (3,) [m]."""
    pose = Pose()
    pose.rotation = wp.mat33(*np.asarray(rotation).ravel().tolist())
    pose.position = wp.vec3(*np.asarray(position).tolist())
    return pose


def surfaces_at(
    world: DeviceWorld,
    rays: NDArray[Any],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    instant: int = 0,
    centres: NDArray[Any] | None = None,
) -> SurfaceView:
    """Return the surfaces that rays from a camera hit.

    ``rays``: directions in the camera's frame, shape (n, 3); ``rotation``, ``position`` [m]: pose of the camera;
    ``instant``: index of the time in the last call of :meth:`DeviceWorld.set_instants`; ``centres``: where the rays
    begin in the camera's frame [m], shape (n, 3), by default at its origin.
    """
    n = len(rays)
    device = world.device
    unit = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    starts = np.empty((0, 3), np.float32) if centres is None else centres.astype(np.float32)
    inputs = [
        world.params,
        instant,
        wp.array(unit, dtype=wp.vec3, device=device),
        wp.array(starts, dtype=wp.vec3, device=device),
        device_pose(rotation, position),
    ]
    out = visible_surfaces.Surfaces()
    out.depth = wp.empty(n, dtype=float, device=device)
    out.normal = wp.empty(n, dtype=wp.vec3, device=device)
    out.instance = wp.empty(n, dtype=int, device=device)
    out.mover = wp.empty(n, dtype=int, device=device)
    out.place = wp.empty(n, dtype=wp.vec3, device=device)
    launch(find_surfaces, n, inputs, [out], device=device, smallest=SMALLEST_LAUNCH)
    return SurfaceView(
        depth=out.depth.numpy(),
        normal=out.normal.numpy(),
        instance=out.instance.numpy(),
        mover=out.mover.numpy(),
        place=out.place.numpy(),
    )


def pixel_rays(camera: Camera) -> NDArray[np.float64]:
    """Return the unit rays of all pixels in the camera's frame, row by row, shape (height * width, 3)."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    return camera.pixels_to_rays(pixels)


def first_hits(n: int, device: Any) -> Any:
    """Return the ``FirstHits`` of ``n`` rays, without an array for the luminance."""
    hits = FirstHits()
    hits.face = wp.empty(n, dtype=int, device=device)
    hits.white = wp.empty(n, dtype=float, device=device)
    hits.normal = wp.empty(n, dtype=wp.vec3, device=device)
    return hits
