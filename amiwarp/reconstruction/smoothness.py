"""Choice of the smoothness of a picture by equations that are held out of the fit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

SMOOTHNESS = (0.004, 0.02, 0.1, 0.5)
"""Candidate weights of the smoothness prior, ascending; held-out equations choose among them."""
TIE = 1.05
"""Ratio of costs of held-out equations up to which the larger weight is chosen. Converged maps nearly tie."""
CHOICE_STEPS = 12
"""Number of conjugate-gradient steps in each round with which the weights are compared. In 28 windows of 12 recordings,
8, 12, 16 and 24 steps chose the same."""
CHOICE_SIDES_PX = (64, 96)
"""Sides of the square of pixels in which the smoothness is chosen [px]."""
CHOICE_EVENTS = 24_000
"""Number of events that suffices for the choice in the smaller square."""


def choice_square(count: NDArray[np.int32]) -> tuple[int, int, int]:
    """Return first column, first row and side of the square of pixels in which the smoothness is chosen.

    It is the square with the most events, of the smallest side with enough events. It may reach beyond the image,
    right and below. ``count``: events per pixel, shape
    ``(height, width)``.
    """
    height, width = count.shape
    for side in CHOICE_SIDES_PX:
        rows = [
            count[top : top + side].sum(axis=0, dtype=count.dtype) for top in range(0, height, side)
        ]
        squares = np.add.reduceat(rows, np.arange(0, width, side), axis=1)
        row, column = np.unravel_index(int(squares.argmax()), squares.shape)
        if squares.max() >= CHOICE_EVENTS:
            break
    return int(column) * side, int(row) * side, side


def start_weight_choice(start_cost: Callable[[float], Callable[[], float]]) -> Callable[[], float]:
    """Start to find the largest weight of :data:`SMOOTHNESS` whose cost is nearly the lowest; see :data:`TIE`.

    ``start_cost`` starts to compute the cost of a weight and returns a function that waits for it. Return a function
    that waits for the weight. The cost falls and then rises with the weight. So the two middle weights show on which
    side the lowest cost is.
    """
    weakest, weak, strong, strongest = SMOOTHNESS
    cost_of_weak = start_cost(weak)
    cost_of_strong = start_cost(strong)

    def result() -> float:
        weak_cost = cost_of_weak()
        strong_cost = cost_of_strong()
        if strong_cost <= TIE * weak_cost:
            strongest_cost = start_cost(strongest)()
            if strongest_cost <= TIE * min(weak_cost, strong_cost):
                return strongest
            return strong
        weakest_cost = start_cost(weakest)()
        if weak_cost <= TIE * weakest_cost:
            return weak
        return weakest

    return result
