"""Multigrid preconditioner for large maps.

Corrections are computed on coarser and coarser grids, which transport brightness far across the map.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, pairwise
from typing import Any

import warp as wp

from amiwarp.kernels import conjugate_gradients as cg
from amiwarp.kernels import multilevel
from amiwarp.kernels.launch import BLOCK_DIM, SMALLEST_SLICE

_Step = tuple[Any, int, list[Any], list[Any], int]
"""Launch of a kernel: kernel, number of threads, inputs, outputs, smallest slice."""
COARSEST = 6
"""Smallest number of rows or columns of a grid; coarser grids are not made."""
STRIDES = (3, 5, 11, 23)
"""Every how many pairs one is used to estimate the diagonal of the first grid, the second, the third, and the further
ones. They have no common divisor with the usual numbers of pairs per silent pixel. With fewer pairs, more steps are
needed."""
SMALL = 2048
"""Largest number of nodes of a grid that a single block of threads processes on CUDA, with all coarser grids."""


class GridHierarchy:
    """Grids over one tile of (rows, columns) map nodes. Each grid has twice the node spacing of the previous grid."""

    def __init__(self, rows: int, columns: int, device: Any) -> None:
        """Allocate the grids over a tile of ``rows`` × ``columns`` nodes."""
        self.shapes = [(rows, columns)]
        """Rows and columns of each grid, the map itself first."""
        while min(rows, columns) // 2 + 1 >= COARSEST:
            rows = rows // 2 + 1
            columns = columns // 2 + 1
            self.shapes.append((rows, columns))

        # The vectors of all grids but the finest lie behind each other in one array.
        self._first = [0]
        for rows, columns in self.shapes[1:]:
            self._first.append(self._first[-1] + rows * columns)
        nodes = self._first[-1]
        self._all_diagonals = wp.zeros(nodes, dtype=float, device=device)
        self._all_residuals = wp.zeros(nodes, dtype=float, device=device)
        self._all_corrections = wp.zeros(nodes, dtype=float, device=device)
        self._diagonal = self._by_grid(self._all_diagonals)
        self._residual = self._by_grid(self._all_residuals)
        self._correction = self._by_grid(self._all_corrections)

    def _by_grid(self, vectors: Any) -> list[Any]:
        return [vectors[first:stop] for first, stop in pairwise(self._first)]

    def prepare(
        self,
        program: Any,
        equations: list[Any],
        count: int,
        sums: Any,
        slices: list[Any],
    ) -> None:
        """Add to ``program`` the computation of the grids' diagonals for the current weights of the equations."""
        for level, diagonal in enumerate(self._diagonal, start=1):
            _, columns = self.shapes[level]
            spacing = float(2**level)
            stride = STRIDES[min(level, len(STRIDES)) - 1]
            program.add_slices(
                multilevel.add_coarse_diagonal,
                count // stride,
                [*equations, spacing, columns, stride],
                slices,
            )
            program.add(cg.gather, len(diagonal), [sums], [diagonal])

    def correct(
        self,
        program: Any,
        diagonal: Any,
        prior: Any,
        residual: Any,
        out: Any,
    ) -> None:
        """Add to ``program`` the step ``out`` = sum of the grids' corrections for the finest grid's ``residual``."""
        if not self._correction:
            program.add(multilevel.divide, len(out), [diagonal, residual], [out])
            return
        if program.device.is_cpu:
            steps = self._steps_by_rows(diagonal, prior, residual, out)
        else:
            steps = self._steps_by_nodes(diagonal, prior, residual, out)
        for kernel, threads, inputs, outputs, smallest in steps:
            program.add(kernel, threads, inputs, outputs, smallest=smallest)

    def _restrictions(self, residual: Any, prior: Any) -> Iterator[tuple[list[Any], list[Any]]]:
        """Yield inputs and outputs of the restriction to each grid but the finest."""
        fine = residual
        for level, coarse in enumerate(self._residual):
            rows, columns = self.shapes[level]
            diagonal = self._diagonal[level]
            correction = self._correction[level]
            scale = 4.0 ** (level + 1)
            inputs = [fine, rows, columns, diagonal, prior, scale]
            yield inputs, [coarse, correction]
            fine = coarse

    def _steps_by_rows(
        self,
        diagonal: Any,
        prior: Any,
        residual: Any,
        out: Any,
    ) -> Iterator[_Step]:
        """Yield the launches of :meth:`correct` with a row of nodes per thread."""
        # Down, from the finest grid to the coarsest.
        restrictions = self._restrictions(residual, prior)
        for (rows, columns), (inputs, outputs) in zip(self.shapes[1:], restrictions, strict=True):
            smallest = SMALLEST_SLICE // (4 * columns) + 1
            yield multilevel.restrict_rows, rows, inputs, outputs, smallest

        # And up again.
        coarsest = len(self._correction) - 1
        for level in range(coarsest, 0, -1):
            rows, columns = self.shapes[level]
            _, coarse_columns = self.shapes[level + 1]
            inputs = [self._correction[level], coarse_columns, columns]
            outputs = [self._correction[level - 1]]
            smallest = SMALLEST_SLICE // columns + 1
            yield multilevel.prolong_rows, rows, inputs, outputs, smallest

        rows, columns = self.shapes[0]
        _, coarse_columns = self.shapes[1]
        correction = self._correction[0]
        inputs = [correction, coarse_columns, rows, columns, diagonal, residual]
        smallest = SMALLEST_SLICE // columns + 1
        yield multilevel.prolong_rows_to_finest, rows, inputs, [out], smallest

    def _steps_by_nodes(
        self,
        diagonal: Any,
        prior: Any,
        residual: Any,
        out: Any,
    ) -> Iterator[_Step]:
        """Yield the launches of :meth:`correct` with a node per thread, and the small grids in one block of threads."""
        small = sum(rows * columns <= SMALL for rows, columns in self.shapes[2:])
        large = len(self._correction) - small
        restrictions = self._restrictions(residual, prior)
        for inputs, outputs in islice(restrictions, large):
            coarse = outputs[0]
            yield multilevel.restrict, len(coarse), inputs, outputs, SMALLEST_SLICE

        if small:
            rows, columns = self.shapes[large]
            first = self._first[large - 1]
            scale = 4.0**large
            inputs = [rows, columns, first, small, self._all_diagonals, prior, scale]
            outputs = [self._all_residuals, self._all_corrections]
            yield multilevel.correct_small, BLOCK_DIM, inputs, outputs, SMALLEST_SLICE

        coarsest_large = large if small else large - 1
        for level in range(coarsest_large, 0, -1):
            rows, columns = self.shapes[level]
            inputs = [self._correction[level], rows, columns]
            outputs = [self._correction[level - 1]]
            yield multilevel.prolong, rows * columns, inputs, outputs, SMALLEST_SLICE

        rows, columns = self.shapes[0]
        inputs = [self._correction[0], rows, columns, diagonal, residual]
        yield multilevel.prolong_to_finest, len(out), inputs, [out], SMALLEST_SLICE
