"""Rounds of robust weights that solve for the map of a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from amiwarp.reconstruction.known import known_nodes, nodes_near

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from amiwarp.brightness.solver import BrightnessMap
    from amiwarp.reconstruction.result import Picture

SCALES = (1.0, 0.5, 0.5)
"""Residual at which an equation gets half weight, in each round of Cauchy weights [thresholds]."""
STEPS = 24
"""Number of conjugate-gradient steps in each round of Cauchy weights."""
NOISE_DISTANCE = 2
"""Distance from known pixels beyond which pairs of events are excluded as noise [px]."""


def solve_rounds(
    solver: BrightnessMap, pair_count: int, last: Picture | None
) -> tuple[Callable[[], float], Callable[[], NDArray[np.bool_]]]:
    """Solve for the map. Return functions that wait for the median residual and for the known nodes.

    The known nodes have shape (rows, columns). A GPU still works when this returns. ``last`` is the picture of the
    previous window, from which the solution starts.
    """
    nodes = solver.tiles.nodes
    if last is not None:
        unknowns = last.to_host().unknowns.copy()
        unknowns[nodes:] = solver.unknowns[nodes:]
        solver.unknowns = unknowns
    solver.solve(*SCALES[0 if last is None else 1 : -1], steps=STEPS)
    residual = solver.residuals.start_median(pair_count)
    covered = known_nodes(solver)
    solver.keep(nodes_near(covered, NOISE_DISTANCE))
    solver.solve(SCALES[-1], steps=STEPS)
    return residual, lambda: covered.numpy().view(np.bool_)
