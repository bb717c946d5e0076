"""Gauss-Newton search on the cost of the photometric stage, with the brightness map eliminated."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.nlopt_solver import best_of
from amiwarp.calib.settings import GAUSS_NEWTON
from amiwarp.results.parameters import RATES, ParameterSpace
from amiwarp.results.search_stage import SearchStage

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

MOST_STEPS = 15
"""Largest number of Gauss-Newton steps."""
FIRST_STEPS = 3
"""Number of steps after which a search may be given up: the first ones may only turn towards the optimum."""
LONGEST_STEP_PX = 1.0
"""Largest change of any parameter in one Gauss-Newton step [px]."""
HALVINGS = 4
"""Number of step lengths that are tried along a Gauss-Newton direction, each half of the previous one."""


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the weighted least-squares problem with the brightness map eliminated (Kaufman 1975).

    They are sums over the pairs of events.
    """

    hessian: Vector
    """Gauss-Newton Hessian [thresholds²/px²], shape ``(parameters, parameters)``."""
    gradient: Vector
    """Half the cost's gradient [thresholds²/px], shape ``(parameters,)``. The brightness map is optimal, so its change
    adds nothing to the gradient."""
    parts: Vector
    """Contribution of each cluster of pairs of events to the gradient, shape ``(parameters, clusters)``."""

    def restricted_to(self, which: list[int]) -> Slopes:
        """Return the derivatives by some of the parameters only."""
        return Slopes(self.hessian[np.ix_(which, which)], self.gradient[which], self.parts[which])

    def step(self) -> Vector:
        """Return the change of the parameters by a Gauss-Newton step [px]."""
        ridge = 1e-6 * float(np.trace(self.hessian)) * np.eye(len(self.hessian))
        return np.asarray(-np.linalg.solve(self.hessian + ridge, self.gradient))

    def covariance(self) -> Vector:
        """Return the parameters' covariance [px²]: the sandwich estimate from the clusters' gradients."""
        clusters = self.parts.shape[1]
        parts = self.parts - self.parts.mean(axis=1, keepdims=True)
        scatter = parts @ parts.T * clusters / max(1, clusters - 1 - len(parts))
        # successive pairs of a pixel share an event and are correlated, so the inverse Hessian alone is too small
        inverse = _inverse(self.hessian)
        return np.asarray(inverse @ scatter @ inverse)


def _inverse(hessian: Vector) -> Vector:
    """Return the inverse of the Hessian, with very small eigenvalues raised."""
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray(
        vectors
        @ np.diag(1.0 / np.maximum(values, 1e-9 * max(float(values[-1]), 1e-12)))
        @ vectors.T
    )


UNDETERMINED_PX = 0.3
"""Standard deviation above which a parameter is undetermined [px]."""
LEAST_CURVATURE = 1e-3
"""Curvature, as a share of the largest one, below which a parameter is undetermined."""


def determined(slopes: Slopes, space: ParameterSpace, left: float) -> tuple[str, ...]:
    """Return the names of the free parameters that the events determine.

    A parameter is weak if its standard deviation is large, or if its curvature, with all others free, is far below the
    largest one: then the standard deviation is unreliable. The weakest parameter is removed until none is weak. Size,
    phase and rates always stay. ``left`` is the share of equations beyond the map's unknowns.
    """
    always = (space.size_name, "phase", *RATES)
    names = sorted(space.names, key=lambda n: n not in always)
    core = sum(n in always for n in names)
    while len(names) > max(core, 1):
        part = slopes.restricted_to([space.names.index(n) for n in names])
        curvature = 1.0 / np.diag(_inverse(part.hessian)) / part.hessian.diagonal().max()
        deviation = np.sqrt(np.diag(part.covariance())) / left
        is_strong = (deviation <= UNDETERMINED_PX) & (curvature >= LEAST_CURVATURE)
        weak = [k for k in range(core, len(names)) if not is_strong[k]]
        if not weak:
            break
        names.pop(min(weak, key=lambda k: float(curvature[k])))
    return tuple(n for n in space.names if n in names)


def iterate(
    start_score: Callable[[Vector], Callable[[], float]],
    start_slopes: Callable[[Vector], Callable[[], Slopes]],
    start: Vector,
    *,
    low: Vector,
    high: Vector,
    tolerance: float,
    report: Callable[[int, int], None],
    early: bool = True,
    least: float = -math.inf,
    walls: tuple[Vector, Vector] | None = None,
) -> SearchStage:
    """Maximise a score by Gauss-Newton steps until they are shorter than ``tolerance`` [px] in every parameter.

    A step that lowers the score is halved. The search stays in the box ``low .. high`` [px]. It also ends if all steps
    that are left, each as good as the last one, would not reach the score ``least``, and at the second step in turn to
    one of the ``walls``, bounds [px] on which an answer is of no use. Its answer is the best evaluated point.
    ``report`` gets the number of steps done and the largest number. ``start_score`` and ``start_slopes`` return
    functions that wait for the result at a point. If ``early``, slopes are also started where the score may turn out
    lower, and then not waited for.
    """
    began = time.perf_counter()
    v = np.clip(start, low, high)
    points: list[Vector] = []
    scores: list[float] = []
    ended = "budget"
    at_wall = 0
    waiting = start_score(v)
    slopes = start_slopes(v) if early else None
    here = waiting()
    points.append(v)
    scores.append(here)
    for k in range(MOST_STEPS):
        report(k, MOST_STEPS)
        step = (slopes or start_slopes(v))().step()
        step *= min(1.0, LONGEST_STEP_PX / max(float(np.abs(step).max()), 1e-12))
        for _ in range(HALVINGS):
            trial = np.clip(v + step, low, high)
            moved = float(np.abs(trial - v).max())
            waiting = start_score(trial)
            slopes = (
                start_slopes(trial) if early and moved >= tolerance and k + 1 < MOST_STEPS else None
            )
            value = waiting()
            points.append(trial)
            scores.append(value)
            if value >= here:
                break
            step = step / 2.0
        gained = value - here
        if walls is not None and ((trial <= walls[0]) | (trial >= walls[1])).any():
            at_wall += 1
        else:
            at_wall = 0
        if value >= here:
            v = trial
            here = value
        steps_left = MOST_STEPS - 1 - k
        if k + 1 >= FIRST_STEPS and here + steps_left * gained < least:
            ended = "too far from the least score"
            break
        if at_wall > 1:
            ended = "bound"
            break
        if moved < tolerance:
            ended = "tolerance"
            break
        if value < here:
            ended = "no better step"
            break
    return best_of(GAUSS_NEWTON, points, scores, seconds=time.perf_counter() - began, ended=ended)
