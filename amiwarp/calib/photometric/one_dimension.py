"""Search for one angle by trial: the costs of a few angles, and parabolas through the lowest ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

LARGEST_RAD = 0.5
"""Largest angle that is searched [rad]."""
FACTOR = 1.7
"""Ratio between angles that are tried."""
MOST_TRIALS = 7
"""Largest number of angles that are tried."""
PARABOLAS = 2
"""Number of parabolas that are laid through the lowest costs."""


def bracketed(
    cost_at: Callable[[float], float],
    angles: list[float],
) -> tuple[list[float], list[float]]:
    """Return angles in geometric progression about the one of the lowest cost, and their costs, from two of them on."""
    angles = list(angles)
    costs = [cost_at(angle) for angle in angles]
    while len(angles) < MOST_TRIALS and costs[-1] < costs[-2]:
        larger = FACTOR * angles[-1]
        if larger > LARGEST_RAD:
            break
        angles.append(larger)
        costs.append(cost_at(larger))
    while len(angles) < MOST_TRIALS and costs[0] <= costs[1]:
        smaller = angles[0] / FACTOR
        angles.insert(0, smaller)
        costs.insert(0, cost_at(smaller))
    return angles, costs


def lowest(
    cost_at: Callable[[float], float],
    angles: list[float],
    costs: list[float],
) -> float:
    """Return the angle of the lowest cost, evaluated last; 0 if no angle costs less than 0.

    Parabolas find it, between angles of :func:`bracketed`.
    """
    for _ in range(PARABOLAS):
        k = int(np.argmin(costs))
        if not 0 < k < len(angles) - 1:
            break
        near = slice(k - 1, k + 2)
        square, slope, _ = np.polyfit(np.log(angles[near]), costs[near], 2)
        angle = float(np.exp(-0.5 * slope / square))
        at = k if angle < angles[k] else k + 1  # its place in the order of the angles
        angles.insert(at, angle)
        costs.insert(at, cost_at(angle))
    best = angles[int(np.argmin(costs))]
    cost_of_none = cost_at(0.0)
    if cost_at(best) < cost_of_none:
        return best
    return 0.0
