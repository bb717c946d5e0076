"""Statistics of the residuals of a map's equations, computed on the device: mean cost, sums, median."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.kernels.conjugate_gradients import CPU_WIDTH
from amiwarp.kernels.launch import RepeatedLaunches, launch
from amiwarp.kernels.page_locked import start_read
from amiwarp.kernels.photometric import HELD
from amiwarp.kernels.recorded_launches import BLOCK_DIM
from amiwarp.kernels.residual_slopes import add_clusters, magnitudes, sum_costs, sum_products
from amiwarp.kernels.square_sums import MOST_ROWS, find_squares, find_starts, sum_square_products, sum_squares

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from amiwarp.brightness.event_pairs import PairSet

CHUNKS = 8
"""Smallest number of chunks of a vector for which a second CPU thread is used."""
SUM_COPIES = 64
"""Number of copies of each tile's sum on a GPU."""


class Residuals:
    """Residuals of the equations of ``pairs`` [thresholds] and the equations' weights.

    A pair off the map has the residual NaN.
    """

    def __init__(self, pairs: PairSet, tiles: int) -> None:
        self.pairs, self.tiles, self.device, self.count = pairs, tiles, wp.get_device(pairs.device), len(pairs)
        n = pairs.arrays.stride
        self.values, self.weight = (wp.zeros(n, dtype=float, device=self.device) for _ in "vw")
        self._width = int(CPU_WIDTH) if self.device.is_cpu else 1
        self._launch = RepeatedLaunches(self.device)

    def start_mean_cost(self, scale: float, *, missing: float = math.nan, held: bool = False) -> Callable[[], float]:
        """Start to compute the mean Cauchy cost of the residuals, and return a function that waits for it.

        That is log(1 + (r / ``scale``)²) for the residuals r of all pairs or the held-out ones. ``held``: whether only
        held-out pairs count. ``missing``: residual of pairs off the map; NaN excludes these pairs.
        """
        threads, parts = self._sum_shape
        partial = self._doubles(2, parts)
        inputs = [self.values, self.pairs.arrays.on, int(HELD) * held, self.count, scale, missing, self._width]
        self._launch(sum_costs, threads, inputs, [partial], smallest=CHUNKS)
        sums = start_read(partial)

        def result() -> float:
            total, number = sums().sum(axis=1)
            return float(total / number) if number else math.nan

        return result

    def start_products(self, factors: list[tuple[Any, Any]]) -> Callable[[], NDArray[np.float64]]:
        """Start to sum a · b · weight over the pairs, for each (a, b) on the device.

        Return a function that waits for the sums.
        """
        threads, parts = self._sum_shape
        partial = self._doubles(len(factors), parts)
        for k, (a, b) in enumerate(factors):
            inputs = [a, b, self.weight, self.count, self._width]
            self._launch(sum_products, threads, inputs, [partial[k]], smallest=CHUNKS)
        sums = start_read(partial)
        return lambda: np.asarray(sums().sum(axis=1))

    def start_clusters(self, slopes: list[Any]) -> Callable[[], NDArray[np.float64]]:
        """Start to sum slope · weight · residual over clusters of neighbouring pairs.

        Return a function that waits for the sums, shape (slopes, clusters).
        """
        size = self.tiles if self.tiles > 1 else 1 << 20
        rows = []
        for slope in slopes:
            # on a GPU, many threads would wait for each other to add to the few sums of the tiles
            copies = SUM_COPIES if self.device.is_cuda and self.tiles > 1 else 1
            sums = wp.zeros((2, size * copies), dtype=wp.int64, device=self.device)
            inputs = [self.pairs.arrays, self.tiles, copies, slope, self.weight, self.values, 0, sums]
            # one CPU thread only: several would add to the same sums
            wp.launch(add_clusters, self.count, inputs=inputs, device=self.device)
            # the sums of one tile are too large for page-locked memory
            rows.append(start_read(sums) if self.tiles > 1 else sums.numpy)

        def result() -> NDArray[np.float64]:
            both = [row().reshape(2, size, -1).sum(axis=2) for row in rows]
            return np.array([total[number > 0] / 2.0**32 for total, number in both])

        return result

    def products_by_square(
        self, factors: list[Any], side: int, columns: int, rows: int
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return sums of a · b · weight over the pairs of each square of pixels, for all a and b of ``factors``.

        The factors are on the device. The squares have ``side`` pixels along each axis; there are ``columns`` x
        ``rows`` of them. Those without pairs are left out, and so are pairs for which any factor is NaN. Return the
        sums, shape (squares, factors, factors), and the numbers of the squares, row by row, shape (squares,).
        """
        n, squares = self.count, columns * rows
        values = wp.empty((len(factors), n), dtype=float, device=self.device)
        for k, factor in enumerate(factors):
            wp.copy(values[k], factor, count=n)
        square, order = (wp.empty(2 * n, dtype=int, device=self.device) for _ in "so")
        launch(
            find_squares, n, [self.pairs.arrays, values, side, columns, squares], [square, order], device=self.device
        )
        wp.utils.radix_sort_pairs(square, order, n, end_bit=squares.bit_length())
        starts = wp.empty(squares + 1, dtype=int, device=self.device)
        launch(find_starts, squares + 1, [square, n], [starts], device=self.device)
        upper = np.triu_indices(len(factors))
        sums = self._doubles(squares, len(upper[0]))
        inputs = [values, self.weight, order, starts]
        if self.device.is_cpu and len(factors) <= MOST_ROWS:
            launch(sum_squares, squares, inputs, [sums], device="cpu", smallest=CHUNKS)
        else:
            lanes = 1 if self.device.is_cpu else 32
            inputs += [*(wp.array(k, dtype=int, device=self.device) for k in upper), lanes]
            launch(sum_square_products, lanes * sums.size, inputs, [sums], device=self.device, smallest=CHUNKS)
        used = np.flatnonzero(np.diff(starts.numpy()))
        found = np.empty((len(used), len(factors), len(factors)))
        found[:, upper[0], upper[1]] = found[:, upper[1], upper[0]] = sums.numpy()[used]
        return found, used

    def median(self) -> float:
        """Return the median absolute residual; NaN if there is none."""
        return self.start_median(self.count)()

    def start_median(self, n: int) -> Callable[[], float]:
        """Start to compute the median absolute residual of the first ``n`` pairs, NaN if there is none.

        Return a function that waits for it.
        """
        if self.device.is_cpu:
            values = np.abs(self.values.numpy()[:n])
            values = values[np.isfinite(values)]
            found = float(np.median(values)) if len(values) else math.nan
            return lambda: found
        keys, order = (wp.empty(2 * n, dtype=t, device=self.device) for t in (float, int))
        number = wp.zeros(1, dtype=int, device=self.device)
        wp.launch(magnitudes, n, inputs=[self.values, 0, keys, number], device=self.device)
        wp.utils.radix_sort_pairs(keys, order, n)

        def result() -> float:
            known = int(number.numpy()[0])
            return float(keys[(known - 1) // 2 : known // 2 + 1].numpy().mean()) if known else math.nan

        return result

    @cached_property
    def _sum_shape(self) -> tuple[int, int]:
        """Numbers of threads and of partial sums for a sum over all pairs."""
        if self.device.is_cpu:
            threads = -(-self.count // self._width)
            return threads, threads
        blocks = -(-self.count // BLOCK_DIM)  # block sums need whole blocks
        return blocks * BLOCK_DIM, blocks

    def _doubles(self, *shape: int) -> Any:
        return wp.empty(shape, dtype=wp.float64, device=self.device)
