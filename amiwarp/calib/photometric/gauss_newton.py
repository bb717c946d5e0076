"""Gauss and Newton's method on a projected least-squares problem, and what the slopes say of the parameters."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.parameters import RATES
from amiwarp.calib.solve import SearchStage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace

    Vector = NDArray[np.float64]

GAUSS_NEWTON = "gauss-newton"
MOST_STEPS = 15
LONGEST_STEP_PX = 1.0
HALVINGS = 4
UNDETERMINED_PX, LEAST_CURVATURE = 0.3, 1e-3
"""A parameter of a larger standard deviation, or of less curvature beside the largest, is not determined."""


@dataclass(frozen=True)
class Slopes:
    """Of a weighted least-squares problem with the map projected out (Kaufman 1975): sums over all pairs."""

    hessian: Vector
    """Of the slopes' products, shape (parameters, parameters) [thresholds²/px²]."""
    gradient: Vector
    """Half the cost's first derivative [thresholds²/px]. It is that with the map as it is: the map is at its best, so
    it adds nothing."""
    parts: Vector
    """What each cluster of pairs adds to it with the map projected out, shape (parameters, clusters)."""

    def of(self, which: list[int]) -> Slopes:
        """By some of the parameters alone."""
        return Slopes(self.hessian[np.ix_(which, which)], self.gradient[which], self.parts[which])

    def step(self) -> Vector:
        """Gauss and Newton's."""
        ridge = 1e-6 * float(np.trace(self.hessian)) * np.eye(len(self.hessian))
        return np.asarray(-np.linalg.solve(self.hessian + ridge, self.gradient))

    def covariance(self) -> Vector:
        """Sandwich estimate [px²] from the scatter of the slopes of the cost between clusters."""
        many = self.parts.shape[1]
        parts = self.parts - self.parts.mean(axis=1, keepdims=True)
        scatter = parts @ parts.T * many / max(1, many - 1 - len(parts))
        # pairs of one pixel share an event, so neighbours count against each other: H alone would be too sure
        inverse = _inverse(self.hessian)
        return np.asarray(inverse @ scatter @ inverse)


def _inverse(hessian: Vector) -> Vector:
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray(vectors @ np.diag(1.0 / np.maximum(values, 1e-9 * max(float(values[-1]), 1e-12))) @ vectors.T)


def determined(slopes: Slopes, space: ParameterSpace, left: float) -> tuple[str, ...]:
    """Names that the curvature determines; size, phase and rates always stay, of the others the worst goes first.

    A parameter is weak where its standard deviation is large, or its curvature, the others left to follow, is nothing
    beside the largest: there the deviation, which knows no more of that direction, cannot be believed.
    """
    names = list(space.names)
    core = sum(n in (space.size_name, "phase", *RATES) for n in names)
    names.sort(key=lambda n: n not in (space.size_name, "phase", *RATES))
    while len(names) > max(core, 1):
        part = slopes.of([space.names.index(n) for n in names])
        curvature = 1.0 / np.diag(_inverse(part.hessian)) / part.hessian.diagonal().max()
        deviation = np.sqrt(np.diag(part.covariance())) / left
        weak = [
            k for k in range(core, len(names))
            if not (deviation[k] <= UNDETERMINED_PX and curvature[k] >= LEAST_CURVATURE)
        ]  # fmt: skip
        if not weak:
            break
        names.pop(min(weak, key=lambda k: float(curvature[k])))
    return tuple(n for n in space.names if n in names)


def iterate(
    score: Callable[[Vector], float],
    slopes: Callable[[Vector], Slopes],
    start: Vector,
    low: Vector,
    high: Vector,
    tolerance: float,
    tell: Callable[[int, int], None],
) -> SearchStage:
    """Steps until they are shorter than ``tolerance`` [px] in every direction; a step that does not help is halved.

    The best point seen counts; the score is higher where it is better.
    """
    began = time.perf_counter()
    v, points, scores, ended = np.clip(start, low, high), [], [], "budget"
    here = score(v)
    points.append(v)
    scores.append(here)
    for k in range(MOST_STEPS):
        tell(k, MOST_STEPS)
        step = slopes(v).step()
        step *= min(1.0, LONGEST_STEP_PX / max(float(np.abs(step).max()), 1e-12))
        for _ in range(HALVINGS):
            trial = np.clip(v + step, low, high)
            value = score(trial)
            points.append(trial)
            scores.append(value)
            if value >= here:
                break
            step = step / 2.0
        moved = float(np.abs(trial - v).max())
        if value >= here:
            v, here = trial, value
        if moved < tolerance or value < here:
            ended = "tolerance" if moved < tolerance else "no better step"
            break
    best = int(np.argmax(scores))
    seconds = time.perf_counter() - began
    return SearchStage(
        GAUSS_NEWTON, points[best], scores[best], len(scores), seconds, ended, np.array(points), np.array(scores)
    )
