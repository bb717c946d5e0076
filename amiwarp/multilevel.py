"""Corrections of a large map on ever coarser grids: the preconditioner that carries brightness across it."""

from __future__ import annotations

from typing import Any

COARSEST = 6
"""A grid of fewer rows or columns has no coarser one."""
STRIDE = 8
"""Every so many-th pair tells a coarse grid's diagonal, which need only be about right."""


class Levels:
    """Grids over one tile of (rows, columns) nodes, each of twice the spacing of the one before."""

    def __init__(self, rows: int, columns: int, device: Any) -> None:
        import warp as wp

        self.device, self.shapes = device, [(rows, columns)]
        while min(self.shapes[-1]) // 2 + 1 >= COARSEST:
            self.shapes.append((self.shapes[-1][0] // 2 + 1, self.shapes[-1][1] // 2 + 1))
        sizes = [r * c for r, c in self.shapes]
        self._diagonal, self._residual, self._correction = (
            [wp.zeros(n, dtype=float, device=device) for n in sizes[1:]] for _ in range(3)
        )

    def prepare(self, equations: list[Any], count: int, sums: Any, slices: list[Any]) -> None:
        """The grids' diagonals, for the equations' weights as they are."""
        from amiwarp.kernels import multilevel as k
        from amiwarp.kernels.descent import gather
        from amiwarp.kernels.launch import launch, launch_slices

        for level, diagonal in enumerate(self._diagonal, start=1):
            inputs = [*equations, float(2**level), self.shapes[level][1], STRIDE]
            launch_slices(k.add_coarse_diagonal, count // STRIDE, inputs, slices, device=self.device)
            launch(gather, len(diagonal), [sums], [diagonal], device=self.device)

    def correct(self, diagonal: Any, prior: Any, smooth: float, residual: Any, out: Any) -> None:
        """``out``: the sum of all grids' corrections for the finest one's ``residual``."""
        from amiwarp.kernels import multilevel as k
        from amiwarp.kernels.launch import launch

        launch(k.divide, len(out), [diagonal, prior, residual], [out], device=self.device)
        fine = residual
        for level, (rows, columns) in enumerate(self.shapes[1:], start=1):
            floor = smooth * float(k.HAT) + prior.damping * 4.0**level
            coarse, correction = self._residual[level - 1], self._correction[level - 1]
            inputs = [fine, *self.shapes[level - 1], columns, self._diagonal[level - 1], floor]
            launch(k.restrict, rows * columns, inputs, [coarse, correction], device=self.device)
            fine = coarse
        for level in range(len(self.shapes) - 1, 0, -1):
            rows, columns = self.shapes[level - 1]
            target = out if level == 1 else self._correction[level - 2]
            inputs = [self._correction[level - 1], self.shapes[level][1], columns]
            launch(k.prolong, rows * columns, inputs, [target], device=self.device)
