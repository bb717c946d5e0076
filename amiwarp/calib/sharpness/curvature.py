"""Gradients and Hessian of sharpness about a point by finite differences, for disjoint parts of the events."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Vector = NDArray[np.float64]

STEP_PX = 0.25
"""Step of the finite differences, as displacement of events [px]."""


def finite_differences(at: Callable[[Vector], Vector], directions: Vector) -> tuple[Vector, Vector]:
    """Return the parts' gradients of sharpness [1/px], shape (n, parts), and the mean Hessian [1/px²], shape (n, n).

    ``at`` returns the sharpness of each part, shape (parts,), at a shift from the point. Each row of ``directions`` is
    a shift that moves events by one pixel, shape (n, entries of the shift).
    """
    n = len(directions)
    steps = STEP_PX * directions
    centre, up, down = at(np.zeros(directions.shape[1])), [at(h) for h in steps], [at(-h) for h in steps]
    hessian = np.zeros((n, n))
    for i in range(n):
        hessian[i, i] = np.mean(up[i] - 2.0 * centre + down[i]) / STEP_PX**2
        for j in range(i):
            both = at(steps[i] + steps[j]) + at(-steps[i] - steps[j])
            mixed = both - up[i] - up[j] - down[i] - down[j] + 2.0 * centre
            hessian[i, j] = hessian[j, i] = np.mean(mixed) / (2.0 * STEP_PX**2)
    return (np.array(up) - np.array(down)) / (2.0 * STEP_PX), hessian
