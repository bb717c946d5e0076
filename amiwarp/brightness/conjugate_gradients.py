"""Conjugate gradients on the weighted equations of pairs of events: launches that are recorded once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from amiwarp.brightness.multigrid import GridHierarchy
from amiwarp.kernels import conjugate_gradients as kernels
from amiwarp.kernels.program import Program

LEAST_CHUNKS_OF_TWO_THREADS = 16
"""Smallest number of chunks of the unknowns for which a second CPU thread is used. Fewer take less time than the
hand-over to a thread."""


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations of the weighted equations of pairs and of the prior, with the buffers to solve them."""

    equations: Any
    """Equations: :class:`PairChains` or :class:`PairEnds`."""
    weight: wp.array
    """Weight of each equation."""
    prior: Any
    """Damping and smoothness: Warp struct :class:`amiwarp.kernels.conjugate_gradients.Prior`."""
    grids: GridHierarchy | None
    """Coarser grids for the preconditioner; None for the diagonal."""
    sums: wp.array
    """Sums over the equations for each unknown, in fixed point, a row for each thread."""
    rows_of_sums: list[wp.array]
    """Rows of ``sums``."""
    vectors: Any
    """Warp struct :class:`amiwarp.kernels.conjugate_gradients.Unknowns`."""
    preconditioned: wp.array
    """Preconditioned residual, one element for each unknown; empty without grids."""
    dots: Any
    """Warp struct :class:`amiwarp.kernels.conjugate_gradients.Dots`."""
    unknowns_per_thread: int
    """Number of unknowns of a thread."""
    threads: int
    """Number of threads for all unknowns."""
    device: Any
    """Device of all buffers."""


class ConjugateGradients:
    """Conjugate gradients on normal equations, preconditioned by the diagonal or by :class:`GridHierarchy`.

    They change ``image`` to reduce ``residual``, which must be the residual of the initial ``image``.
    """

    def __init__(self, system: NormalEquations, image: wp.array, residual: wp.array) -> None:
        """Record the launches. ``image``: the unknowns; ``residual``: residual of each equation [thresholds]."""
        self.image = image
        self.residual = residual
        self._system = system
        equations = system.equations
        vectors = system.vectors
        dots = system.dots

        self._start = Program(system.device)
        equations.add_transpose(self._start, system.weight, residual, system.rows_of_sums)
        inputs = [system.sums, system.prior, image]
        self._add(self._start, kernels.start_descent, inputs, [vectors, dots])
        self._add_preconditioner(self._start)

        self._step = Program(system.device)
        if system.grids is None:
            self._add(self._step, kernels.update_search_direction, [], [vectors, dots])
        else:
            inputs = [system.preconditioned]
            kernel = kernels.update_search_direction_with
            self._add(self._step, kernel, inputs, [vectors, dots])
        equations.add_product(self._step, system.weight, vectors.direction, system.rows_of_sums)
        inputs = [system.sums, system.prior]
        self._add(self._step, kernels.finish_product, inputs, [vectors, dots])
        self._add(self._step, kernels.descend, [], [image, vectors, dots])
        self._add_preconditioner(self._step)

    def _add_preconditioner(self, program: Program) -> None:
        """Add to ``program`` the preconditioned residual, and its product with the residual, if there are grids."""
        system = self._system
        if system.grids is None:
            return
        residual = system.vectors.residual
        system.grids.correct(
            program,
            diagonal=system.vectors.diagonal,
            prior=system.prior,
            residual=residual,
            out=system.preconditioned,
        )
        self._add(program, kernels.dot, [residual, system.preconditioned], [system.dots.rz])

    def run(self, steps: int) -> None:
        """Start from the current ``image`` and run ``steps`` iterations."""
        self._start.run()
        self._step.run(steps)

    def _add(self, program: Program, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        """Add to ``program`` a kernel over the unknowns."""
        inputs = [*inputs, self._system.unknowns_per_thread]
        program.add(
            kernel, self._system.threads, inputs, outputs, smallest=LEAST_CHUNKS_OF_TWO_THREADS
        )
