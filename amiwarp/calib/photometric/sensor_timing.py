"""Timing of the sensor that was not given: its refractory period, and the time constant of slow photoreceptors.

Both shift the angles of the prism at which events tell the brightness. A linearised fit tells whether one of them
explains much of the residual; then it is searched for. All angles are those by which the prism turns within a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from amiwarp.brightness.solver import darkness, set_lags
from amiwarp.calib.photometric.answer_search import LARGEST_EXAMINED_COST
from amiwarp.calib.photometric.consistency import free_columns, linear_fit

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from numpy.typing import NDArray

    from amiwarp.calib.photometric.answer_search import Answer, AnswerSearch
    from amiwarp.calib.photometric.cost import Cost

    Vector = NDArray[np.float64]

LEAST_GAIN = 0.03
"""Smallest share of the squared residuals that a time must explain. Right ones explain 0.01 at most."""
SIGNIFICANT = 10.0
"""Smallest number of standard deviations of a time from 0."""
STEP_RAD = 0.004
"""Step of the finite differences that give the derivatives of the residuals by an angle [rad]."""
LARGEST_RAD = 0.5
"""Largest angle that is searched [rad]."""
FACTOR, MOST_TRIALS = 1.7, 7
"""Ratio between angles that are tried, and their largest number."""
PARABOLAS = 2
"""Number of parabolas that are laid through the lowest costs."""


def timing_can_be_found(answer: Answer, cost: Cost) -> bool:
    """Return whether the sensor's timing can be examined: for a still camera, if a map explains most of the events."""
    space = cost.space
    drifts = cost.brightness.pairs.arrays.slope.shape[0]
    return space.sized and not space.moving and not drifts and answer.result.cost <= LARGEST_EXAMINED_COST


def timing_steps(cost: Cost, v: Vector, direction: float) -> tuple[float, float]:
    """Return the angles per refractory period and per time constant at median brightness [rad].

    A linearised fit at the answer ``v`` estimates each of them. An angle that is not significant is 0.
    """
    cost.converge(v)
    relative, _ = darkness(cost.brightness, cost.space.build(cost.space.to_values(v)))
    # the refractory period sets the reference of a pair, its first event, later
    reference = wp.zeros_like(relative)
    reference[0].fill_(1.0)
    columns = free_columns(cost, v)
    columns["refractory"], columns["slow"] = (_shifted(cost, v, shift) for shift in (reference, relative))
    fit = linear_fit(cost, columns)

    def angle(name: str, sign: float) -> float:
        estimate, significance, gain = fit.adding(cost.space.names, (name,))
        change = sign * float(estimate.change[-1])
        return change if change > 0.0 and significance >= SIGNIFICANT and gain >= LEAST_GAIN else 0.0

    return angle("refractory", direction), angle("slow", -direction)


def _shifted(cost: Cost, v: Vector, shift: Any) -> Any:
    """Return the derivative of the residuals by a factor of ``shift``, changes of the angles at the ends of pairs.

    ``shift`` is a Warp array of shape (2, pairs), padded.
    """
    pairs, at = cost.brightness.pairs, cost.at(v)
    none = pairs.arrays.slope
    pairs.arrays.slope = shift.flatten()
    ends = {**at, "drift": STEP_RAD}, {**at, "drift": -STEP_RAD}
    column = cost.brightness.find_slope(*ends, 2.0 * STEP_RAD)
    pairs.arrays.slope = none
    return column


def find_refractory(search: AnswerSearch, v: Vector, first: float, direction: float) -> float:
    """Return the angle by which the prism turns in the refractory period, for which the cost is lowest [rad].

    The parameters are those of :func:`find_time_constant`; the pairs remain unchanged.
    """
    cost = search.cost
    azimuth = cost.brightness.pairs.arrays.azimuth
    given = azimuth.numpy().copy()

    def cost_at(angle: float) -> float:
        """Return the cost if the references are ``angle`` later."""
        turned = given.reshape(4, -1).copy()
        z = (turned[0] + 1j * turned[1]) * np.exp(1j * direction * angle)
        turned[0], turned[1] = z.real, z.imag
        azimuth.assign(turned.ravel())
        cost.renew(v)
        at = search.descend(v).x
        cost.residuals(at, rounds=2, steps=2 * cost.steps)
        return cost.mean()

    best = _lowest(cost_at, first)
    azimuth.assign(given)
    return best


def find_time_constant(search: AnswerSearch, v: Vector, first: float, direction: float) -> float:
    """Return the angle per time constant at median brightness, for which the cost is lowest [rad].

    Parameters
    ----------
    search : AnswerSearch
        Search on a map with one node per pixel, on which costs depend smoothly on the angle. The lags of its pairs are
        set to those of the result.
    v : numpy.ndarray
        Search vector of the answer without lags, shape (n,).
    first : float
        Angle from which the search starts [rad].
    direction : float
        Direction of rotation of the prism: 1 or -1.

    Returns
    -------
    float
        The angle; 0 if no lag lowers the cost.
    """
    cost, space = search.cost, search.cost.space

    def cost_at(turn: float) -> float:
        """Return the cost with the lags of an angle."""
        cost.brightness.pairs.clear_lags()
        cost.renew(v)
        cost.residuals(v, rounds=2)
        at = v
        for with_offsets in (False, True) if turn else ():
            set_lags(cost.brightness, space.build(space.to_values(at)), direction * turn, with_offsets=with_offsets)
            at = search.descend(at).x
        cost.residuals(at, rounds=2, steps=2 * cost.steps)
        return cost.mean()

    return _lowest(cost_at, first)


def _lowest(cost_at: Callable[[float], float], first: float) -> float:
    """Return the angle of the lowest cost, evaluated last; 0 if no angle costs less than 0.

    Angles in geometric progression from a little above ``first`` on bracket the lowest one; parabolas then find it.
    """
    angles = [FACTOR * first, FACTOR**2 * first]
    costs = [cost_at(angle) for angle in angles]
    while len(angles) < MOST_TRIALS and costs[-1] < costs[-2] and FACTOR * angles[-1] <= LARGEST_RAD:
        angles.append(FACTOR * angles[-1])
        costs.append(cost_at(angles[-1]))
    while len(angles) < MOST_TRIALS and costs[0] <= costs[1]:
        angles.insert(0, angles[0] / FACTOR)
        costs.insert(0, cost_at(angles[0]))
    for _ in range(PARABOLAS):
        k = int(np.argmin(costs))
        if not 0 < k < len(angles) - 1:
            break
        curve = np.polyfit(np.log(angles[k - 1 : k + 2]), costs[k - 1 : k + 2], 2)
        angle = float(np.exp(-0.5 * curve[1] / curve[0]))
        at = k if angle < angles[k] else k + 1
        angles.insert(at, angle)
        costs.insert(at, cost_at(angle))
    best = angles[int(np.argmin(costs))]
    none = cost_at(0.0)
    return best if cost_at(best) < none else 0.0


def timing_notes(refractory_us: float, time_constant_us: float) -> list[str]:
    """Return a sentence for each time that was found [us]; 0 for none."""
    notes = []
    if refractory_us:
        notes.append(
            f"the events show that pixels pause after an event (refractory period): {refractory_us:.0f} us of it fit "
            "best and were corrected; give the true one by --refractory-us"
        )
    if time_constant_us:
        notes.append(
            f"the pixels are slow: about {time_constant_us:.0f} us at the median brightness, more in the dark. The "
            "size of the orbit was corrected. The lag is part of the phase, which holds at this speed of the prism only"
        )
    return notes
