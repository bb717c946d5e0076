"""Check that the photometric stage's result is a minimum: slightly larger, smaller or rotated orbits must cost more."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.photometric.acceptance import PERTURBATION_PX

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.photometric.cost import Cost

FEW_PAIRS = 50_000
"""Number of pairs of events below which a new brightness map is solved for each tested point."""


def start_costs_around(
    cost: Cost, best: NDArray[np.float64], final: Callable[[], float]
) -> Callable[[], list[tuple[NDArray[np.float64], float]]]:
    """Start to compute the costs at points :data:`PERTURBATION_PX` from ``best`` in size and phase.

    Return a function that waits, and returns the points with their rise in cost, lowest first. ``final`` waits for the
    cost at ``best`` with the present map. A map of few pairs is biased to the point where it was fitted, and all other
    points would cost more. Then a new map is solved for each point, ``best`` included.
    """
    few = cost.brightness.count < FEW_PAIRS

    def start(point: NDArray[np.float64]) -> Callable[[], float]:
        if few:
            cost.renew(point)
            cost.residuals(point, rounds=2)
        else:
            cost.predict(point)
            cost.residuals(point, rounds=2, steps=cost.steps // 2)
        return cost.start_mean()

    reference = start(best) if few else final
    shifts = [
        side * along
        for along in size_and_phase_directions(cost.space, best)
        for side in (PERTURBATION_PX, -PERTURBATION_PX)
    ]
    costs = [(best + shift, start(best + shift)) for shift in shifts]

    def result() -> list[tuple[NDArray[np.float64], float]]:
        here = reference()
        return sorted(((point, there() - here) for point, there in costs), key=lambda found: found[1])

    return result


def size_and_phase_directions(space: ParameterSpace, best: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return unit vectors of the search space along the prism's size and phase, if these are free."""
    if space.cartesian:
        x, y = best[:2] / max(float(np.linalg.norm(best[:2])), 1e-9)
        rest = np.zeros(len(best) - 2)
        return [np.array([x, y, *rest]), np.array([-y, x, *rest])]
    unit = np.eye(len(best))
    return [unit[k] for k, name in enumerate(space.names) if name in (space.size_name, "phase")]
