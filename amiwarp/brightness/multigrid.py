"""Corrections of a large map on ever coarser grids: the preconditioner that carries brightness across it."""

from __future__ import annotations

from typing import Any

import warp as wp

from amiwarp.kernels import multilevel as k
from amiwarp.kernels.descent import gather

COARSEST = 6
"""A grid of fewer rows or columns has no coarser one."""
STRIDE = 8
"""Every so many-th pair tells a coarse grid's diagonal, which need only be about right."""


class Levels:
    """Grids over one tile of (rows, columns) nodes, each of twice the spacing of the one before."""

    def __init__(self, rows: int, columns: int, device: Any) -> None:
        self.shapes = [(rows, columns)]
        while min(self.shapes[-1]) // 2 + 1 >= COARSEST:
            self.shapes.append((self.shapes[-1][0] // 2 + 1, self.shapes[-1][1] // 2 + 1))
        sizes = [r * c for r, c in self.shapes]
        self._diagonal, self._residual, self._correction = (
            [wp.zeros(n, dtype=float, device=device) for n in sizes[1:]] for _ in range(3)
        )

    def prepare(self, program: Any, equations: list[Any], count: int, sums: Any, slices: list[Any]) -> None:
        """Adds to ``program`` what finds the grids' diagonals, for the equations' weights as they are."""
        for level, diagonal in enumerate(self._diagonal, start=1):
            inputs = [*equations, float(2**level), self.shapes[level][1], STRIDE]
            program.add_slices(k.add_coarse_diagonal, count // STRIDE, inputs, slices)
            program.add(gather, len(diagonal), [sums], [diagonal])

    def correct(self, program: Any, diagonal: Any, prior: Any, residual: Any, out: Any) -> None:
        """Adds to ``program``: ``out`` = the sum of all grids' corrections for the finest one's ``residual``."""
        program.add(k.divide, len(out), [diagonal, residual], [out])
        fine = residual
        for level, (rows, columns) in enumerate(self.shapes[1:], start=1):
            coarse, correction = self._residual[level - 1], self._correction[level - 1]
            inputs = [fine, *self.shapes[level - 1], columns, self._diagonal[level - 1], prior, 4.0**level]
            program.add(k.restrict, rows * columns, inputs, [coarse, correction])
            fine = coarse
        for level in range(len(self.shapes) - 1, 0, -1):
            rows, columns = self.shapes[level - 1]
            target = out if level == 1 else self._correction[level - 2]
            inputs = [self._correction[level - 1], self.shapes[level][1], rows, columns]
            program.add(k.prolong, rows * columns, inputs, [target])
