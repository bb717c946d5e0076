"""Renderer of maps of log intensity of a world."""

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.imaging.sharpness import gaussian
from amiwarp.kernels.launch import launch
from amiwarp.simulation.kernels import image_tiles
from amiwarp.simulation.kernels.between_maps import interpolate_maps, mark_tiles
from amiwarp.simulation.kernels.map_rendering import (
    blur_lines,
    log_pieces,
    render_map,
    smooth_edges,
)
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.surfaces import SMALLEST_LAUNCH, first_hits

ROTATED_GRID = [(-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)]
"""Positions of four samples relative to the pixel's centre [px].

The positions are fixed, because random positions would differ between maps and cause events.
"""
TILE = int(image_tiles.TILE)
"""Side of a tile of a map [texels]."""


def sample_grid(samples: int, device: Any) -> wp.array:
    """Return the positions of ``samples`` rays relative to the centre of their pixel [px], on the device."""
    side = math.isqrt(samples)
    centres = (np.arange(side) + 0.5) / side - 0.5
    places = [(x, y) for y in centres for x in centres]
    if samples == 4:
        places = ROTATED_GRID
    return wp.array(np.array(places, np.float32), dtype=wp.vec2, device=device)


class MapRenderer:
    """Renderer of maps: pictures of a world on a plane at distance 1 from the camera, without the prism.

    One array holds the log intensity of all maps, as coefficients of bilinear interpolation. A second array holds the
    number of the face that each texel sees.
    """

    def __init__(
        self, world: DeviceWorld, frame: Any, *, blur: float, dark: float, samples: int
    ) -> None:
        """Set up the renderer.

        ``frame``: a ``MapFrame`` without a pose; ``blur``: standard deviation [texels];
        ``dark``: luminance added before the logarithm; ``samples``: rays per texel at edges.
        """
        self._world = world
        self._frame = frame
        self._dark = dark
        frame.offsets = sample_grid(samples, world.device)
        n = frame.width * frame.height
        self._smooth: wp.array = wp.empty(n, dtype=float, device=world.device)
        self._half: wp.array = wp.empty(n, dtype=float, device=world.device)
        self._hits = first_hits(n, world.device)
        self._hits.light = wp.empty(n, dtype=float, device=world.device)
        half = gaussian(blur)
        both_halves = np.concatenate([half[:0:-1], half])
        self._weights = wp.array(both_halves, dtype=float, device=world.device)
        self._grid = (-(-frame.height // TILE), -(-frame.width // TILE))
        # [tiles]: the blur, and the next texel for interpolation
        self._reach = -(-len(half) // TILE)
        self._all = self._numbers(np.ones(self._grid, bool))

    def render(self, pose: Any, maps: wp.array, faces: wp.array, first: int) -> None:
        """Render the whole map of the world's first instant into the arrays, from index ``first`` on."""
        self._frame.pose = pose
        self._frame.instant = 0
        self._frame.first = first
        self._cast(self._all, faces)
        self._blur(self._all, self._all, maps)

    def render_between(
        self,
        pose: Any,
        maps: wp.array,
        faces: wp.array,
        first: int,
        ends: tuple[int, int],
        weight: float,
    ) -> None:
        """Render a map between an earlier and a later map, which begin at the indices ``ends``.

        The map is interpolated, with weight ``weight`` of the later map, and rendered only where bodies move. The
        world's first three instants are the times of this map, of the earlier and of the later map.
        """
        from scipy.ndimage import binary_dilation

        frame = self._frame
        world = self._world
        n = frame.width * frame.height
        inputs = [maps, faces, *ends, weight, first]
        launch(interpolate_maps, n, inputs, [], device=world.device)

        # Tiles in which bodies move, and their neighbours.
        frame.pose = pose
        frame.instant = 0
        frame.first = ends[0]
        rows, columns = self._grid
        marks: wp.array = wp.empty(rows * columns, dtype=wp.uint8, device=world.device)
        self._launch_rays(mark_tiles, len(marks), [faces, 3], [marks])
        neighbours = np.ones((3, 3), bool)
        changed = binary_dilation(marks.numpy().reshape(self._grid), neighbours)
        if not changed.any():
            return

        # The blur carries their light to tiles further away, and needs the light of tiles still further away.
        frame.first = first
        written = binary_dilation(changed, neighbours, iterations=self._reach)
        cast = binary_dilation(written, neighbours, iterations=self._reach)
        self._cast(self._numbers(cast), faces)
        self._blur(self._numbers(cast), self._numbers(written), maps)

    def _numbers(self, tiles: NDArray[np.bool_]) -> wp.array:
        """Return the numbers of the marked tiles, counted row by row, on the device."""
        numbers = np.flatnonzero(tiles).astype(np.int32)
        return wp.array(numbers, dtype=int, device=self._world.device)

    def _launch_rays(self, kernel: Any, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel that casts rays. It gets the world, the frame, and then ``inputs``."""
        launch(
            kernel,
            count,
            [self._world.params, self._frame, *inputs],
            outputs,
            device=self._world.device,
            smallest=SMALLEST_LAUNCH,
        )

    def _cast(self, tiles: wp.array, faces: wp.array) -> None:
        """Cast the rays of tiles, and compute their luminance before the blur."""
        self._frame.tiles = tiles
        n = len(tiles) * TILE * TILE
        self._launch_rays(render_map, n, [], [faces, self._hits])
        if len(self._frame.offsets) == 1:
            wp.copy(self._smooth, self._hits.light)
            return
        self._launch_rays(smooth_edges, n, [self._hits], [self._smooth])

    def _blur(self, tiles: wp.array, written: wp.array, maps: wp.array) -> None:
        """Blur the luminance of ``tiles``, and write the log intensities of the tiles ``written`` to ``maps``."""
        frame = self._frame
        device = self._world.device
        n = len(tiles) * TILE * TILE
        inputs = [frame, self._smooth, self._weights, 0]
        launch(blur_lines, n, inputs, [self._half], device=device)
        inputs = [frame, self._half, self._weights, 1]
        launch(blur_lines, n, inputs, [self._smooth], device=device)
        frame.tiles = written
        inputs = [frame, self._smooth, self._dark]
        launch(log_pieces, len(written) * TILE * TILE, inputs, [maps], device=device)
