"""Multigrid preconditioner for large maps.

Corrections are computed on coarser and coarser grids, which transport brightness far across the map.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from amiwarp.kernels import multilevel as k
from amiwarp.kernels.conjugate_gradients import gather
from amiwarp.kernels.launch import SMALLEST_SLICE

COARSEST = 6
"""Smallest number of rows or columns of a grid; coarser grids are not made."""
STRIDES = (3, 5, 11, 23)
"""Every how many pairs one is used to estimate the diagonal of the first grid, the second, the third, and the further
ones. They have no common divisor with the usual numbers of pairs per silent pixel. With fewer pairs, more steps are
needed."""


class GridHierarchy:
    """Grids over one tile of (rows, columns) map nodes. Each grid has twice the node spacing of the previous grid."""

    def __init__(self, rows: int, columns: int, device: Any) -> None:
        """Allocate the grids over a tile of ``rows`` × ``columns`` nodes."""
        self.shapes = [(rows, columns)]
        while min(self.shapes[-1]) // 2 + 1 >= COARSEST:
            self.shapes.append((self.shapes[-1][0] // 2 + 1, self.shapes[-1][1] // 2 + 1))
        sizes = [r * c for r, c in self.shapes]
        self._diagonal, self._residual, self._correction = (
            [wp.zeros(n, dtype=float, device=device) for n in sizes[1:]] for _ in range(3)
        )

    def prepare(self, program: Any, equations: list[Any], count: int, sums: Any, slices: list[Any]) -> None:
        """Add to ``program`` the computation of the grids' diagonals for the current weights of the equations."""
        for level, diagonal in enumerate(self._diagonal, start=1):
            stride = STRIDES[min(level, len(STRIDES)) - 1]
            inputs = [*equations, float(2**level), self.shapes[level][1], stride]
            program.add_slices(k.add_coarse_diagonal, count // stride, inputs, slices)
            program.add(gather, len(diagonal), [sums], [diagonal])

    def correct(self, program: Any, diagonal: Any, prior: Any, residual: Any, out: Any) -> None:
        """Add to ``program`` the step ``out`` = sum of the grids' corrections for the finest grid's ``residual``."""
        program.add(k.divide, len(out), [diagonal, residual], [out])
        fine, on_cpu = residual, program.device.is_cpu
        for level, (rows, columns) in enumerate(self.shapes[1:], start=1):
            outputs = [self._residual[level - 1], self._correction[level - 1]]
            inputs = [fine, *self.shapes[level - 1], columns, self._diagonal[level - 1], prior, 4.0**level]
            if on_cpu:
                program.add(k.restrict_rows, rows, inputs, outputs, smallest=SMALLEST_SLICE // (4 * columns) + 1)
            else:
                program.add(k.restrict, rows * columns, inputs, outputs)
            fine = outputs[0]
        for level in range(len(self.shapes) - 1, 0, -1):
            rows, columns = self.shapes[level - 1]
            target = out if level == 1 else self._correction[level - 2]
            inputs = [self._correction[level - 1], self.shapes[level][1]]
            if on_cpu:
                smallest = SMALLEST_SLICE // columns + 1
                program.add(k.prolong_rows, rows, [*inputs, columns], [target], smallest=smallest)
            else:
                program.add(k.prolong, rows * columns, [*inputs, rows, columns], [target])
