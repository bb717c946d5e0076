"""Statistics of the residuals of a map's equations, computed on the device: mean cost, sums, median."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.pairs import PairSet
from amiwarp.kernels import conjugate_gradients as cg
from amiwarp.kernels import equations as eqs
from amiwarp.kernels.launch import BLOCK_DIM, RepeatedLaunches, launch
from amiwarp.kernels.page_locked_memory import start_read
from amiwarp.kernels.residual_sums import (
    CLUSTER_PX,
    add_clusters,
    magnitudes,
    sum_costs,
    sum_products,
)
from amiwarp.kernels.square_sums import (
    MOST_ROWS,
    find_squares,
    find_starts,
    sum_square_products,
    sum_squares,
)

Vector = NDArray[np.float64]

CHUNKS = 8
"""Smallest number of chunks of a vector for which a second CPU thread is used."""
SUM_COPIES = 64
"""Number of copies of each cluster's sum on a GPU, where many threads would wait for each other to add to few sums."""


class Residuals:
    """Residuals of the equations of ``pairs`` [thresholds] and the equations' weights.

    A pair off the map has the residual NaN.
    """

    def __init__(self, pairs: PairSet, tiles: int) -> None:
        self.pairs = pairs
        self.tiles = tiles
        self.device = wp.get_device(pairs.device)
        self.count = len(pairs)
        stride = pairs.arrays.stride
        self.values = wp.zeros(stride, dtype=float, device=self.device)
        """Residual of each pair [thresholds], on the device."""
        self.weight = wp.zeros(stride, dtype=float, device=self.device)
        """Weight of each pair, on the device."""
        self._width = int(cg.CPU_WIDTH) if self.device.is_cpu else 1
        self._launch = RepeatedLaunches(self.device)

    def start_mean_cost(
        self,
        scale: float,
        *,
        missing: float = math.nan,
        held: bool = False,
    ) -> Callable[[], float]:
        """Start to compute the mean Cauchy cost of the residuals, and return a function that waits for it.

        That is log(1 + (r / ``scale``)²) for the residuals r of all pairs or the held-out ones. ``held``: whether only
        held-out pairs count. ``missing``: residual of pairs off the map; NaN excludes these pairs.
        """
        threads, parts = self._sum_shape
        partial = self._doubles(2, parts)
        marked = int(eqs.HELD) if held else 0
        on = self.pairs.arrays.on
        inputs = [self.values, on, marked, self.count, scale, missing, self._width]
        self._launch(sum_costs, threads, inputs, [partial], smallest=CHUNKS)
        sums = start_read(partial)

        def result() -> float:
            total, number = sums().sum(axis=1)
            if not number:
                return math.nan
            return float(total / number)

        return result

    def start_products(self, factors: list[tuple[Any, Any]]) -> Callable[[], Vector]:
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

    def start_clusters(self, slopes: list[Any], width: int, height: int) -> Callable[[], Vector]:
        """Start to sum slope · weight · residual over clusters of neighbouring pairs.

        ``width`` and ``height`` are the sensor's size [px]. Return a function that waits for the sums, shape (slopes,
        clusters).
        """
        # The clusters are the tiles. On a map of one tile, they are squares of pixels.
        columns = math.ceil(width / CLUSTER_PX)
        size = self.tiles
        if size == 1:
            size = columns * math.ceil(height / CLUSTER_PX)
        copies = SUM_COPIES if self.device.is_cuda else 1
        shape = (len(slopes), 2, size * copies)
        sums = wp.zeros(shape, dtype=wp.int64, device=self.device)
        for k, slope in enumerate(slopes):
            # One CPU thread only: several would add to the same sums.
            wp.launch(
                add_clusters,
                self.count,
                inputs=[
                    self.pairs.arrays,
                    self.tiles,
                    columns,
                    copies,
                    slope,
                    self.weight,
                    self.values,
                    0,
                    sums[k],
                ],
                device=self.device,
            )
        read = start_read(sums)

        def result() -> Vector:
            of_copies = read().reshape(len(slopes), 2, size, copies)
            total, number = np.moveaxis(of_copies.sum(axis=3), 1, 0)
            # The pairs of a cluster are the same for every slope.
            return np.asarray(total[:, number[0] > 0] / 2.0**32)

        return result

    def products_by_square(
        self,
        factors: list[Any],
        side: int,
        columns: int,
        rows: int,
    ) -> tuple[Vector, NDArray[np.int64]]:
        """Return sums of a · b · weight over the pairs of each square of pixels, for all a and b of ``factors``.

        The factors are on the device. The squares have ``side`` pixels along each axis; there are ``columns`` x
        ``rows`` of them. Those without pairs are left out, and so are pairs for which any factor is NaN. Return the
        sums, shape (squares, factors, factors), and the numbers of the squares, row by row, shape (squares,).
        """
        device = self.device
        count = self.count
        squares = columns * rows
        values = wp.empty((len(factors), count), dtype=float, device=device)
        for k, factor in enumerate(factors):
            wp.copy(values[k], factor, count=count)

        # Sort the pairs by square. The sort needs twice the room.
        square = wp.empty(2 * count, dtype=int, device=device)
        order = wp.empty(2 * count, dtype=int, device=device)
        inputs = [self.pairs.arrays, values, side, columns, squares]
        launch(find_squares, count, inputs, [square, order], device=device)
        wp.utils.radix_sort_pairs(square, order, count, end_bit=squares.bit_length())
        starts = wp.empty(squares + 1, dtype=int, device=device)
        launch(find_starts, squares + 1, [square, count], [starts], device=device)

        # The sums are symmetric: only the upper triangle is computed.
        first, second = np.triu_indices(len(factors))
        sums = self._doubles(squares, len(first))
        inputs = [values, self.weight, order, starts]
        if device.is_cpu and len(factors) <= MOST_ROWS:
            launch(sum_squares, squares, inputs, [sums], device="cpu", smallest=CHUNKS)
        else:
            lanes = 1 if device.is_cpu else 32
            inputs.append(wp.array(first, dtype=int, device=device))
            inputs.append(wp.array(second, dtype=int, device=device))
            inputs.append(lanes)
            launch(
                sum_square_products,
                lanes * sums.size,
                inputs,
                [sums],
                device=device,
                smallest=CHUNKS,
            )

        pairs_of_square = np.diff(starts.numpy())
        used = np.flatnonzero(pairs_of_square)
        triangle = sums.numpy()[used]
        products = np.empty((len(used), len(factors), len(factors)))
        products[:, first, second] = triangle
        products[:, second, first] = triangle
        return products, used

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
            median = float(np.median(values)) if len(values) else math.nan
            return lambda: median
        # The sort needs twice the room, and numbers beside the keys, which are not used.
        keys = wp.empty(2 * n, dtype=float, device=self.device)
        order = wp.empty(2 * n, dtype=int, device=self.device)
        number = wp.zeros(1, dtype=int, device=self.device)
        inputs = [self.values, 0, keys, number]
        wp.launch(magnitudes, n, inputs=inputs, device=self.device)
        wp.utils.radix_sort_pairs(keys, order, n)

        def result() -> float:
            known = int(number.numpy()[0])
            if not known:
                return math.nan
            middle = keys[(known - 1) // 2 : known // 2 + 1]
            return float(middle.numpy().mean())

        return result

    @cached_property
    def _sum_shape(self) -> tuple[int, int]:
        """Numbers of threads and of partial sums for a sum over all pairs."""
        if self.device.is_cpu:
            threads = math.ceil(self.count / self._width)
            return threads, threads
        blocks = math.ceil(self.count / BLOCK_DIM)  # block sums need whole blocks
        return blocks * BLOCK_DIM, blocks

    def _doubles(self, *shape: int) -> Any:
        return wp.empty(shape, dtype=wp.float64, device=self.device)
