"""Rendering of a simulated world without the prism: surfaces that rays hit, and maps of log intensity."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.imaging.sharpness_costs import gaussian
from amiwarp.kernels import world as kernels
from amiwarp.kernels import world_maps, world_view
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.simulation.worlds.device_world import DeviceWorld

SMALLEST_LAUNCH = 1 << 10
"""Smallest number of rays that one CPU thread handles."""
ROTATED_GRID = [(-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)]
"""Positions of four samples relative to the pixel's centre [px].

The positions are fixed, because random positions would differ between maps and cause events.
"""
TILE = int(world_maps.TILE)
"""Side of a tile of a map [texels]."""


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
    """Return the surfaces that rays from a camera hit.

    ``rays``: directions in the camera's frame, shape (n, 3); ``rotation``, ``position`` [m]: pose of the camera;
    ``instant``: index of the time in the last call of :meth:`DeviceWorld.set_instants`.
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
    """Return the unit rays of all pixels in the camera's frame, row by row, shape (height * width, 3)."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.pixels_to_rays(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64))


def sample_grid(samples: int, device: Any) -> wp.array:
    """Return the positions of ``samples`` rays relative to the centre of their pixel [px], on the device."""
    centres = (np.arange(math.isqrt(samples)) + 0.5) / math.isqrt(samples) - 0.5
    places = ROTATED_GRID if samples == 4 else [(x, y) for y in centres for x in centres]
    return wp.array(np.array(places, np.float32), dtype=wp.vec2, device=device)


def first_hits(n: int, device: Any) -> Any:
    """Return the :class:`amiwarp.kernels.world_maps.FirstHits` of ``n`` rays, without an array for the luminance."""
    hits = world_maps.FirstHits()
    hits.face = wp.empty(n, dtype=int, device=device)
    hits.white = wp.empty(n, dtype=float, device=device)
    hits.normal = wp.empty(n, dtype=wp.vec3, device=device)
    return hits


class MapRenderer:
    """Renderer of maps: pictures of a world on a plane at distance 1 from the camera, without the prism.

    One array holds the log intensity of all maps, as coefficients of bilinear interpolation. A second array holds the
    number of the face that each texel sees.
    """

    def __init__(self, world: DeviceWorld, frame: Any, *, blur: float, dark: float, samples: int) -> None:
        """Set up the renderer.

        ``frame``: a :class:`amiwarp.kernels.world_maps.MapFrame` without a pose; ``blur``: standard deviation [texels];
        ``dark``: luminance added before the logarithm; ``samples``: rays per texel at edges.
        """
        self._world, self._frame, self._dark = world, frame, dark
        frame.offsets = sample_grid(samples, world.device)
        n = frame.width * frame.height
        self._smooth, self._half = (wp.empty(n, dtype=float, device=world.device) for _ in range(2))
        self._hits = first_hits(n, world.device)
        self._hits.light = wp.empty(n, dtype=float, device=world.device)
        half = gaussian(blur)
        self._weights = wp.array(np.concatenate([half[:0:-1], half]), dtype=float, device=world.device)
        self._grid = (-(-frame.height // TILE), -(-frame.width // TILE))
        self._reach = -(-len(half) // TILE)  # [tiles]: the blur, and the next texel for interpolation
        self._all = self._numbers(np.ones(self._grid, bool))

    def render(self, pose: Any, maps: wp.array, faces: wp.array, first: int) -> None:
        """Render the whole map of the world's first instant into the arrays, from index ``first`` on."""
        self._frame.pose, self._frame.instant, self._frame.first = pose, 0, first
        self._cast(self._all, faces)
        self._blur(self._all, self._all, maps)

    def render_between(
        self, pose: Any, maps: wp.array, faces: wp.array, first: int, ends: tuple[int, int], weight: float
    ) -> None:
        """Render a map between an earlier and a later map, which begin at the indices ``ends``.

        The map is interpolated, with weight ``weight`` of the later map, and rendered only where bodies move. The
        world's first three instants are the times of this map, of the earlier and of the later map.
        """
        from scipy.ndimage import binary_dilation

        frame, world = self._frame, self._world
        n = frame.width * frame.height
        launch(world_maps.interpolate_maps, n, [maps, faces, *ends, weight, first], [], device=world.device)
        frame.pose, frame.instant, frame.first = pose, 0, ends[0]
        marks = wp.empty(self._grid[0] * self._grid[1], dtype=wp.uint8, device=world.device)
        inputs = [world.params, frame, faces, 3]
        launch(world_maps.mark_tiles, len(marks), inputs, [marks], device=world.device, smallest=SMALLEST_LAUNCH)
        neighbours = np.ones((3, 3), bool)
        changed = binary_dilation(marks.numpy().reshape(self._grid), neighbours)
        if not changed.any():
            return
        frame.first = first
        written = binary_dilation(changed, neighbours, iterations=self._reach)
        cast = binary_dilation(written, neighbours, iterations=self._reach)
        self._cast(self._numbers(cast), faces)
        self._blur(self._numbers(cast), self._numbers(written), maps)

    def _numbers(self, tiles: NDArray[np.bool_]) -> wp.array:
        """Return the numbers of the marked tiles, counted row by row, on the device."""
        return wp.array(np.flatnonzero(tiles).astype(np.int32), dtype=int, device=self._world.device)

    def _cast(self, tiles: wp.array, faces: wp.array) -> None:
        """Cast the rays of tiles, and compute their luminance before the blur."""
        f, device = self._frame, self._world.device
        f.tiles = tiles
        inputs, n = [self._world.params, f], len(tiles) * TILE * TILE
        launch(world_maps.render_map, n, inputs, [faces, self._hits], device=device, smallest=SMALLEST_LAUNCH)
        if len(f.offsets) == 1:
            wp.copy(self._smooth, self._hits.light)
            return
        inputs += [self._hits]
        launch(world_maps.smooth_edges, n, inputs, [self._smooth], device=device, smallest=SMALLEST_LAUNCH)

    def _blur(self, tiles: wp.array, written: wp.array, maps: wp.array) -> None:
        """Blur the luminance of ``tiles``, and write the log intensities of the tiles ``written`` to ``maps``."""
        f, device = self._frame, self._world.device
        for across, source, target in ((0, self._smooth, self._half), (1, self._half, self._smooth)):
            inputs = [f, source, self._weights, across]
            launch(world_maps.blur_lines, len(tiles) * TILE * TILE, inputs, [target], device=device)
        f.tiles = written
        inputs = [f, self._smooth, self._dark]
        launch(world_maps.log_pieces, len(written) * TILE * TILE, inputs, [maps], device=device)
