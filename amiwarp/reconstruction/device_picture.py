"""Pictures from sums in phase, wholly on a GPU: as :func:`phase_picture`, but nothing waits for the host.

What depends on optic and size is made once. On CUDA, the launches of a picture are a graph: there are twenty, which
would take longer to launch than to run. On a CPU the same launches run one by one, slowly: for tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.imaging.bessel import BESSEL_STEP
from amiwarp.imaging.phase_costs import DAMPING, LONGEST_WAVES
from amiwarp.kernels import long_waves, matrix_product, phase_lag, phase_lines
from amiwarp.kernels.launch import launch
from amiwarp.kernels.phase_grid import SIDE, TileGrid, join_tiles
from amiwarp.kernels.phase_scene import write_scenes
from amiwarp.kernels.phase_slopes import write_divergence, write_slopes
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.phase_lag import FINEST, LAGS, LEAST_GAIN, TILES
from amiwarp.reconstruction.phase_tiles import plan_of, tile_starts
from amiwarp.reconstruction.picture_in_phase import long_wave_filters, pixel_motion


class DevicePictures:
    """Pictures through one optic, each from the sums that an array holds at the time of :meth:`draw`.

    Use one object from one thread only. The sums have the shape (harmonics, height, width).
    """

    def __init__(self, model: Model, sums: wp.array) -> None:
        self.device = sums.device
        self._sums = sums
        _, height, width = sums.shape
        self.picture = self._empty((height, width))
        """Log intensity of the last picture [ON thresholds], median 0."""
        self.detail = self._empty((height, width))
        """The same without waves longer than a tile."""
        self.lag = wp.zeros(1, dtype=wp.float64, device=self.device)
        """Angle by which the optic has turned on before an event is seen [rad]."""
        self._turn = wp.empty(1, dtype=wp.vec2, device=self.device)  # its cosine and sine
        self._plan_tiles(model)
        self._plan_lag()
        self._plan_long_waves(model)
        self._graph: Any = None

    def draw(self) -> None:
        """Make the picture of the sums."""
        if self.device.is_cpu:
            self.run()
            return
        if self._graph is None:
            # No kernel may be loaded while launches are captured
            self.run()
            self._graph = captured(self.run, self.device)
        wp.capture_launch(self._graph)

    def run(self) -> None:
        """Make the picture of the sums by single launches."""
        self.draw_detail()
        self.add_long_waves()

    def draw_detail(self) -> None:
        """Make the detail of the picture, and find the lag."""
        self.transform()
        self.find_lag()
        self.make_scenes()

    def log(self) -> NDArray[np.float32]:
        """Return the last picture, copied, shape (height, width)."""
        return np.array(self.picture.numpy())

    def _plan_tiles(self, model: Model) -> None:
        """Make the arrays of the tiles."""
        harmonics = len(self._sums)
        plan = plan_of(model, harmonics)
        rows, overlap_y = tile_starts(model.camera.height)
        columns, overlap_x = tile_starts(model.camera.width)
        grid = TileGrid()
        grid.rows = len(rows)
        grid.columns = len(columns)
        grid.step_y = SIDE - overlap_y
        grid.step_x = SIDE - overlap_x
        grid.overlap_y = overlap_y
        grid.overlap_x = overlap_x
        self._grid = grid
        self._count = len(plan.places)
        self._window = wp.array(plan.window, dtype=float, device=self.device)
        self._orbits = self._pairs(plan.orbits)
        self._bessel = wp.array(plan.bessel.numpy(), dtype=float, device=self.device)
        self._spectra = self._empty((self._count, harmonics, SIDE, SIDE), wp.vec2)
        self._scenes = self._empty((self._count, SIDE, SIDE), wp.vec2)
        self._turns = self._pairs(phase_lines.turns_of_places())
        # On CUDA the blocks use shared memory
        self._room = self._empty(phase_lines.ROOM if self.device.is_cpu else 1, wp.vec2)

    def _plan_lag(self) -> None:
        """Make the arrays for the lag."""
        self._strengths = self._empty(self._count)
        self._chosen = self._empty(min(TILES, self._count), int)
        self._finest = self._empty(1)
        self._costs = self._empty((len(LAGS), len(self._chosen)), wp.vec2d)
        self._lags = wp.array(LAGS, dtype=wp.float64, device=self.device)
        self._lag_turns = self._pairs(np.exp(1j * LAGS))

    def _plan_long_waves(self, model: Model) -> None:
        """Make the arrays for the long waves, of those that the gradient gives."""
        height, width = self.picture.shape
        motion = pixel_motion(model)
        self._forward = self._pairs(motion.forward.ravel())
        self._backward = self._pairs(motion.backward.ravel())
        self.slopes = self._empty((height, width), wp.vec2)
        """Gradient of the last picture [thresholds/px]."""
        filters = long_wave_filters(height, width, motion.radius)
        lines, columns = filters.share.shape
        self._by_divergence = self._floats(filters.by_divergence)
        self._share = self._floats(filters.share)
        along_y = cosines(height, lines)
        along_x = cosines(width, columns)
        self._to_lines = self._floats(along_y)
        self._from_lines = self._floats(along_y.T)
        self._to_columns = self._floats(along_x.T)
        self._from_columns = self._floats(along_x)
        # Divergence and detail, one below the other, so that one product transforms the lines of both
        self._both = self._empty((2 * height, width))
        self._half = self._empty((2 * height, columns))
        self._waves = [self._empty((lines, columns)) for _ in range(3)]
        self._back = self._empty((height, columns))
        self._long = self._empty((height, width))
        self.keys = self._empty(2 * height * width)
        """Numbers that are sorted for a median, with twice the room."""
        self._idle = self._empty(2 * height * width, int)

    def transform(self) -> None:
        """Cut out the tiles of all sums, and transform them."""
        planes = self._spectra.reshape((-1, SIDE, SIDE))
        inputs = [self._sums, self._window, self._grid, self._turns, self._room]
        self._transform(phase_lines.cut_lines, inputs, planes)
        inputs = [planes, self._turns, self._room, 1.0]
        self._transform(phase_lines.transform_columns, inputs)

    def find_lag(self) -> None:
        """Find the lag from the tiles with the largest first sums."""
        threads = phase_lag.THREADS
        spectra = self._spectra
        self._blocks(phase_lag.tile_strengths, [self._count], [spectra], [self._strengths], threads)
        inputs = [self._strengths, self._orbits, FINEST]
        self._blocks(phase_lag.choose_tiles, [1], inputs, [self._chosen, self._finest], threads)
        inputs = [spectra, self._orbits, self._lag_turns, self._chosen, self._finest]
        inputs += [self._bessel, 1.0 / BESSEL_STEP, DAMPING, LONGEST_WAVES]
        self._blocks(phase_lag.lag_costs, self._costs.shape, inputs, [self._costs], threads)
        zero = int(np.argmin(np.abs(LAGS)))
        inputs = [self._costs, self._lags, zero, LEAST_GAIN]
        self._blocks(phase_lag.best_lag, [1], inputs, [self.lag, self._turn], threads)

    def make_scenes(self) -> None:
        """Make the scenes of all tiles, transform them back, and join them to the detail."""
        inputs = [self._spectra, self._orbits, self._turn, self._bessel]
        inputs += [1.0 / BESSEL_STEP, DAMPING]
        waves = self._count * SIDE * (SIDE // 2 + 1)
        self._launch(write_scenes, waves, inputs, [self._scenes])
        back = [self._scenes, self._turns, self._room, -1.0]
        self._transform(phase_lines.transform_lines, back)
        self._transform(phase_lines.transform_columns, back)
        inputs = [self._scenes, self._window, self._grid]
        self._launch(join_tiles, self.detail.size, inputs, [self.detail])

    def add_long_waves(self) -> None:
        """Replace the long waves of the detail by the waves of the gradient, and subtract the median."""
        first = self._sums[0].flatten()
        inputs = [first, self._forward, self._backward, self._turn]
        self._launch(write_slopes, first.size, inputs, [self.slopes.flatten()])
        self.replace_long_waves(self.detail, self.slopes, self.picture)

    def replace_long_waves(self, detail: wp.array, slopes: wp.array, out: wp.array) -> None:
        """Write an image with its long waves replaced by the waves of a gradient, and with a median of 0."""
        height = out.shape[0]
        self._launch(write_divergence, out.size, [slopes], [self._both[:height]])
        wp.copy(self._both[height:], detail)

        self._multiply(self._both, self._to_columns, self._half)
        of_divergence, of_detail, change = self._waves
        self._multiply(self._to_lines, self._half[:height], of_divergence)
        self._multiply(self._to_lines, self._half[height:], of_detail)
        inputs = [of_divergence, of_detail, self._by_divergence, self._share]
        self._launch(long_waves.weigh_waves, change.size, inputs, [change])
        self._multiply(self._from_lines, change, self._back)
        self._multiply(self._back, self._from_columns, self._long)
        self._launch(long_waves.add_waves, out.size, [detail, self._long], [out, self.keys])
        self.subtract_median(out)

    def subtract_median(self, image: wp.array) -> None:
        """Subtract the median from an image, whose pixels are the first ones of :attr:`keys`, too."""
        wp.utils.radix_sort_pairs(self.keys, self._idle, image.size)
        self._launch(long_waves.take_median, image.size, [self.keys], [image])

    def _transform(self, kernel: Any, inputs: list[Any], *outputs: wp.array) -> None:
        """Run a kernel that transforms lines or columns of planes, the first of its inputs or its output."""
        planes = (*outputs, inputs[0])[0]
        groups = SIDE // phase_lines.LINES
        shape = [len(planes), groups]
        self._blocks(kernel, shape, inputs, list(outputs), phase_lines.THREADS)

    def _multiply(self, left: wp.array, right: wp.array, out: wp.array) -> None:
        """Compute the product of two matrices."""
        blocks = [math.ceil(length / matrix_product.BLOCK) for length in out.shape]
        threads = matrix_product.THREADS
        self._blocks(matrix_product.multiply, blocks, [left, right], [out], threads)

    def _launch(self, kernel: Any, n: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Run a kernel whose last input is ``start: int``."""
        launch(kernel, n, inputs, outputs, device=self.device)

    def _blocks(
        self, kernel: Any, shape: Any, inputs: list[Any], outputs: list[Any], threads: int
    ) -> None:
        """Run a kernel over blocks of threads."""
        wp.launch_tiled(
            kernel,
            dim=list(shape),
            inputs=inputs,
            outputs=outputs,
            block_dim=threads,
            device=self.device,
        )

    def _empty(self, shape: Any, dtype: Any = float) -> wp.array:
        """Return an array on the device, without values."""
        return wp.empty(shape, dtype=dtype, device=self.device)

    def _floats(self, values: NDArray[Any]) -> wp.array:
        """Return numbers on the device."""
        return wp.array(np.ascontiguousarray(values), dtype=float, device=self.device)

    def _pairs(self, values: NDArray[Any]) -> wp.array:
        """Return complex numbers on the device."""
        pairs = np.stack([values.real, values.imag], axis=-1).astype(np.float32)
        return wp.array(pairs, dtype=wp.vec2, device=self.device)


def captured(run: Callable[[], None], device: Any) -> Any:
    """Return the CUDA graph of what a function launches, whose kernels must be loaded."""
    with wp.ScopedCapture(device, force_module_load=False) as capture:
        run()
    return capture.graph


def cosines(length: int, count: int) -> NDArray[np.float64]:
    """Return the first ``count`` orthonormal cosine waves of a line, shape (count, length)."""
    places = 2 * np.arange(length) + 1
    waves = np.cos(np.outer(np.arange(count), places) * (math.pi / (2 * length)))
    waves[0] *= math.sqrt(0.5)
    return np.asarray(waves * math.sqrt(2.0 / length))
