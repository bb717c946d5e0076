"""What an orbit a little larger, smaller or turned costs: an answer of the photometric stage must be the cheapest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.photometric.acceptance import BESIDE_PX

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.photometric.stage import Cost

FEW_PAIRS = 50_000
"""Pairs up to which making the map anew takes less time than it saves in doubt."""


def around_optimum(cost: Cost, best: NDArray[np.float64], final: float) -> list[tuple[NDArray[np.float64], float]]:
    """Places :data:`BESIDE_PX` from ``best`` in size and in phase, either way, and by how much each costs more.

    ``final`` is the cost of ``best`` with the map as it is. A map of few pairs remembers where it was fitted, and
    would find every other place worse: then it is made anew for each place, the best one included.
    """
    few = cost.brightness.count < FEW_PAIRS

    def at(place: NDArray[np.float64]) -> float:
        if few:
            cost.renew(place)
        cost.residuals(place, rounds=2)
        return cost.mean()

    reference = at(best) if few else final
    places = [best + side * along for along in directions(cost.space, best) for side in (BESIDE_PX, -BESIDE_PX)]
    return sorted(((place, at(place) - reference) for place in places), key=lambda found: found[1])


def directions(space: ParameterSpace, best: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Unit vectors along the size and the phase, of those that are free."""
    if space.cartesian:
        x, y = best[:2] / max(float(np.linalg.norm(best[:2])), 1e-9)
        rest = np.zeros(len(best) - 2)
        return [np.array([x, y, *rest]), np.array([-y, x, *rest])]
    unit = np.eye(len(best))
    return [unit[k] for k, name in enumerate(space.names) if name in (space.size_name, "phase")]
