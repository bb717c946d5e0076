"""Time constants of slow photoreceptors: a search on a coarse map, in which each tile has its own light."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.slow_pixels import set_lags
from amiwarp.calib.photometric.answers import AnswerSearch
from amiwarp.calib.photometric.cauchy import cauchy_costs
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.one_dimension import FACTOR, bracketed, lowest
from amiwarp.calib.photometric.systematic import LEAST_STD_PX

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

LIGHT_STEP = 0.5
"""Step of the logarithm of a tile's light. In photographs it has a standard deviation of about 0.6 between tiles."""
LIGHT_ROUNDS = 2
"""How many times the light of the tiles is found, and after it the mean time constant."""


def find_time_constants(
    search: AnswerSearch, v: Vector, first: float, direction: float
) -> tuple[Vector, float]:
    """Return the angle per time constant at median brightness in each tile, and their mean, for the lowest cost [rad].

    Events come late in the dark, but their steps of brightness do not tell how dark a tile is compared with another. So
    each tile has a time constant of its own: the costs at three values tell the time constants of all tiles at once.

    Parameters
    ----------
    search : AnswerSearch
        Search on a map with one node per pixel, on which costs depend smoothly on the angle. The lags of its pairs are
        set to the lags of the result, but if that is 0, the caller must clear them.
    v : numpy.ndarray
        Search vector of the answer without lags, shape (n,).
    first : float
        Estimate of a linearised fit [rad], above 0: a fifth to an eighth of the angle, because the map absorbs the
        rest.
    direction : float
        Direction of rotation of the prism: 1 or -1.

    Returns
    -------
    turns : numpy.ndarray
        The angles, shape (tiles,); 0 if no lag lowers the cost, or if the lag contracts the orbit by less than the
        smallest deviation of an answer.
    mean : float
        Their geometric mean over all pairs.
    """
    cost = search.cost
    space = cost.space
    tile = cost.brightness.pairs.column("tile")
    tiles = len(cost.brightness.tiles.origin)
    count = np.bincount(tile, minlength=tiles)
    moved_per_rad = (
        px_per_rad(space, v) or math.inf
    )  # 0 if it is not known: no lag is negligible then
    relative = np.ones(tiles)
    at = v
    answers: dict[float, Vector] = {}

    def is_negligible(turn: float) -> bool:
        return (1.0 - math.cos(math.atan(turn))) * moved_per_rad < LEAST_STD_PX

    def solve_without_lags() -> None:
        cost.brightness.pairs.clear_lags()
        cost.renew(at)
        cost.residuals(at, rounds=2)

    def set_lags_of(turn: float, log_factor: float, *, with_offsets: bool) -> None:
        turns = direction * turn * math.exp(log_factor) * relative
        ahead = math.atan(direction * turn)
        set_lags(
            cost.brightness,
            space.build(space.to_values(at)),
            turns,
            ahead,
            with_offsets=with_offsets,
        )

    def cost_at(turn: float) -> float:
        """Return the cost with the lags of an angle."""
        nonlocal at
        at = v
        solve_without_lags()
        if turn:
            # Offsets need a map that was solved with lags.
            for with_offsets in (False, True):
                set_lags_of(turn, 0.0, with_offsets=with_offsets)
                at = search.descend(at).x
        cost.residuals(at, rounds=2, steps=2 * cost.steps)
        answers[turn] = at
        return cost.mean()

    def costs_of_tiles(turn: float, log_factor: float) -> Vector:
        """Return the mean cost of each tile with longer time constants, at the answer for an angle."""
        solve_without_lags()
        for with_offsets in (False, True):
            set_lags_of(turn, log_factor, with_offsets=with_offsets)
            cost.residuals(at, rounds=2, steps=2 * cost.steps)
        residuals = cost.brightness.residuals.values.numpy()
        each = cauchy_costs(residuals[: len(tile)], cost.scale)
        total = np.bincount(tile, each, tiles)
        return total / np.maximum(count, 1)

    # The factors are about 5 and 8, by which the estimate is too small.
    angles, costs = bracketed(cost_at, [FACTOR**3 * first, FACTOR**4 * first])
    if is_negligible(angles[int(np.argmin(costs))]):
        return np.zeros(tiles), 0.0
    for _ in range(LIGHT_ROUNDS if tiles > 1 else 0):
        turn = angles[int(np.argmin(costs))]
        at = answers[turn]
        below = costs_of_tiles(turn, -LIGHT_STEP)
        here = costs_of_tiles(turn, 0.0)
        above = costs_of_tiles(turn, LIGHT_STEP)
        change = steps_to_lowest(below, here, above) * LIGHT_STEP
        mean = np.average(change, weights=count)
        relative = relative * np.exp(change - mean)
        angles, costs = bracketed(cost_at, [turn, FACTOR * turn])
    turn = lowest(cost_at, angles, costs)
    turn = 0.0 if is_negligible(turn) else turn
    return turn * relative, turn


def steps_to_lowest(below: Vector, here: Vector, above: Vector) -> Vector:
    """Return how many steps away the lowest points of parabolas are, at most one, from values a step apart.

    Where there is no lowest point, it is a whole step downwards.
    """
    curved = below + above > 2.0 * here
    bend = np.where(curved, below + above - 2.0 * here, 1.0)
    to_lowest = 0.5 * (below - above) / bend
    steps = np.where(curved, to_lowest, np.sign(below - above))
    return np.asarray(steps.clip(-1.0, 1.0))
