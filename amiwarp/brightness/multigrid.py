"""Multigrid preconditioner for large maps.

Corrections are computed on coarser and coarser grids, which transport brightness far across the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Any

import warp as wp

from amiwarp.kernels import multilevel as k
from amiwarp.kernels.conjugate_gradients import gather
from amiwarp.kernels.launch import BLOCK_DIM, SMALLEST_SLICE

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray


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
        while min(self.shapes[-1]) // 2 + 1 >= COARSEST:
            self.shapes.append((self.shapes[-1][0] // 2 + 1, self.shapes[-1][1] // 2 + 1))
        sizes = [r * c for r, c in self.shapes[1:]]
        self._first = [sum(sizes[:k]) for k in range(len(sizes) + 1)]
        self._all = [wp.zeros(sum(sizes), dtype=float, device=device) for _ in range(3)]
        self._diagonal, self._residual, self._correction = (
            [one[a:b] for a, b in pairwise(self._first)] for one in self._all
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
        if not self._correction:
            program.add(k.divide, len(out), [diagonal, residual], [out])
        elif program.device.is_cpu:
            self._correct_by_rows(program, diagonal, prior, residual, out)
        else:
            self._correct_by_nodes(program, diagonal, prior, residual, out)

    def _restrictions(self, residual: Any, prior: Any) -> Iterator[tuple[list[Any], list[Any]]]:
        """Yield inputs and outputs of the restriction to each grid but the finest."""
        fines = [residual, *self._residual]
        for level, (fine, *outputs) in enumerate(zip(fines, self._residual, self._correction, strict=False)):
            yield [fine, *self.shapes[level], self._diagonal[level], prior, 4.0 ** (level + 1)], outputs

    def _correct_by_rows(self, program: Any, diagonal: Any, prior: Any, residual: Any, out: Any) -> None:
        """Correct with a row of nodes per thread."""
        grids = zip(self.shapes[1:], self._restrictions(residual, prior), strict=True)
        for (rows, columns), (inputs, outputs) in grids:
            program.add(k.restrict_rows, rows, inputs, outputs, smallest=SMALLEST_SLICE // (4 * columns) + 1)
        for level in range(len(self._correction) - 1, -1, -1):
            rows, columns = self.shapes[level]
            inputs, smallest = [self._correction[level], self.shapes[level + 1][1]], SMALLEST_SLICE // columns + 1
            if level:
                outputs = [self._correction[level - 1]]
                program.add(k.prolong_rows, rows, [*inputs, columns], outputs, smallest=smallest)
            else:
                inputs += [rows, columns, diagonal, residual]
                program.add(k.prolong_rows_to_finest, rows, inputs, [out], smallest=smallest)

    def _correct_by_nodes(self, program: Any, diagonal: Any, prior: Any, residual: Any, out: Any) -> None:
        """Correct with a node per thread, and the small grids in one block of threads."""
        small = sum(rows * columns <= SMALL for rows, columns in self.shapes[2:])
        large = len(self._correction) - small
        for inputs, outputs in islice(self._restrictions(residual, prior), large):
            program.add(k.restrict, len(outputs[0]), inputs, outputs)
        if small:
            all_diagonals, *outputs = self._all
            inputs = [*self.shapes[large], self._first[large - 1], small, all_diagonals, prior, 4.0**large]
            program.add(k.correct_small, BLOCK_DIM, inputs, outputs)
        for level in range(large if small else large - 1, 0, -1):
            rows, columns = self.shapes[level]
            program.add(
                k.prolong, rows * columns, [self._correction[level], rows, columns], [self._correction[level - 1]]
            )
        inputs = [self._correction[0], *self.shapes[0], diagonal, residual]
        program.add(k.prolong_to_finest, len(out), inputs, [out])


# Tiles of the brightness map.


@dataclass(frozen=True, slots=True)
class Tiles:
    """Rectangular parts of the map, all of the same size, with nodes ``1 / density`` px apart."""

    origin: NDArray[np.float32]
    """Pixel coordinates (x, y) of each tile's first node [px], shape (tiles, 2)."""
    rows: int
    """Number of rows of nodes per tile."""
    columns: int
    """Number of columns of nodes per tile."""
    density: float = 2.0
    """Map nodes per pixel along each axis."""

    @property
    def nodes(self) -> int:
        """Total number of map nodes."""
        return len(self.origin) * self.rows * self.columns

    def at_density(self, density: float) -> Tiles:
        """Return tiles of the same place and size with another number of nodes per pixel along each axis."""
        rows, columns = (math.ceil((n - 1) * density / self.density) + 1 for n in (self.rows, self.columns))
        return replace(self, rows=rows, columns=columns, density=density)
