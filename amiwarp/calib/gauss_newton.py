"""Gauss and Newton's method on a projected least-squares problem, and what the slopes say of the parameters."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.parameters import RATES
from amiwarp.calib.solve import Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import Space

    Vector = NDArray[np.float64]

GAUSS_NEWTON = "gauss-newton"
MOST_STEPS = 15
LONGEST_STEP_PX = 1.0
HALVINGS = 4
UNDETERMINED_PX, LEAST_CURVATURE = 0.3, 1e-3
"""A parameter of a larger standard deviation, or of less curvature beside the largest, is not determined."""


@dataclass(frozen=True)
class Slopes:
    """Residuals r of a weighted least-squares problem, and their slopes with the map projected out (Kaufman 1975)."""

    residual: NDArray[np.float32]
    """Shape (pairs,) [thresholds]."""
    slope: NDArray[np.float32]
    """Shape (parameters, pairs) [thresholds/px]."""
    plain: NDArray[np.float32]
    """The slopes with the map as it is: the map is at its best, so it adds nothing to the cost's first derivative."""
    weight: NDArray[np.float64]

    @property
    def hessian(self) -> Vector:
        return np.asarray((self.slope * self.weight) @ self.slope.T, np.float64)

    def step(self) -> Vector:
        """Gauss and Newton's."""
        gradient = (self.plain * self.weight) @ self.residual
        hessian = self.hessian
        ridge = 1e-6 * float(np.trace(hessian)) * np.eye(len(hessian))
        return np.asarray(-np.linalg.solve(hessian + ridge, gradient))

    def covariance(self, clusters: NDArray[np.int64]) -> Vector:
        """Sandwich estimate [px²] from the scatter of the slopes of the cost between ``clusters`` of pairs."""
        _, index = np.unique(clusters, return_inverse=True)
        parts = np.array([np.bincount(index, weights=s * self.weight * self.residual) for s in self.slope])
        many = parts.shape[1]
        parts = parts - parts.mean(axis=1, keepdims=True)
        scatter = parts @ parts.T * many / max(1, many - 1 - len(parts))
        # pairs of one pixel share an event, so neighbours count against each other: H alone would be too sure
        inverse = _inverse(self.hessian)
        return np.asarray(inverse @ scatter @ inverse)


def _inverse(hessian: Vector) -> Vector:
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray(vectors @ np.diag(1.0 / np.maximum(values, 1e-9 * max(float(values[-1]), 1e-12))) @ vectors.T)


def determined(slopes: Slopes, clusters: NDArray[np.int64], space: Space, left: float) -> tuple[str, ...]:
    """Names that the curvature determines; size, phase and rates always stay, of the others the worst goes first.

    A parameter is weak where its standard deviation is large, or its curvature, the others left to follow, is nothing
    beside the largest: there the deviation, which knows no more of that direction, cannot be believed.
    """
    names = list(space.names)
    core = sum(n in (space.size_name, "phase", *RATES) for n in names)
    names.sort(key=lambda n: n not in (space.size_name, "phase", *RATES))
    while len(names) > max(core, 1):
        which = [space.names.index(n) for n in names]
        part = Slopes(slopes.residual, slopes.slope[which], slopes.plain[which], slopes.weight)
        curvature = 1.0 / np.diag(_inverse(part.hessian)) / part.hessian.diagonal().max()
        deviation = np.sqrt(np.diag(part.covariance(clusters))) / left
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
) -> Stage:
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
    return Stage(
        GAUSS_NEWTON, points[best], scores[best], len(scores), seconds, ended, np.array(points), np.array(scores)
    )
