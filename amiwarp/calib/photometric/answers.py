"""Search for the answer of the photometric stage on one brightness map, from the result of the sharpness stage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.nlopt_solver import maximise
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.causes import (
    SIDE,
    SuspectedError,
    values_with_other_side,
    with_cause,
)
from amiwarp.calib.photometric.cost import Cost, size_and_phase_directions
from amiwarp.calib.photometric.descent import iterate
from amiwarp.calib.photometric.findings import Optimum
from amiwarp.calib.photometric.verdicts import refused
from amiwarp.calib.settings import GAUSS_NEWTON, PhotometricSettings
from amiwarp.optics.camera import LENS
from amiwarp.results.parameters import MOTION, ParameterSpace, like_size
from amiwarp.results.search_stage import SearchStage

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

LARGEST_ROTATION_MOVE_PX = 4.0
"""Largest distance from the sharpness optimum that is searched in the parameters of the camera's rotation [px]."""
RESTARTS = 3
"""Largest number of further searches, each from a point near the previous result that has a lower cost."""
FIRST_STEP_PX = 0.2
"""First step of an NLopt algorithm's first run [px]."""
POLISH_STEP_PX = 0.05
"""First step of an NLopt algorithm's second run, which starts at the result of the first run [px]."""
FEW_PAIRS = 50_000
"""Number of pairs of events below which a new brightness map is solved for each tested point."""


@dataclass(frozen=True)
class Answer:
    """Result of a search, with the evidence for it."""

    stage: SearchStage
    """The search that found it."""
    optimum: Optimum
    """How good the optimum is."""
    parameters: Mapping[str, float]
    """Parameter values, in their units."""
    uncertainty: Mapping[str, float]
    """Standard deviation of each free parameter, in its unit."""
    covariance: Vector
    """Covariance of the search vector from the scatter between places [px²], shape (n, n)."""
    moved_px: float
    """Distance from the result of the sharpness stage, without what sharpness does not tell [px]."""
    cost_at_sharpness: float
    """Cost at the result of the sharpness stage."""
    residual: float
    """Median magnitude of the residuals [thresholds]."""
    off_over_on: float
    """Ratio of the OFF to the ON threshold."""
    leak: float
    """Drift of a pixel's reference level [thresholds/s]."""

    @property
    def x(self) -> Vector:
        """Search vector [px], shape (n,)."""
        return self.stage.x

    @property
    def cost(self) -> float:
        """Remaining cost, relative to the cost without a map."""
        return self.optimum.cost


@dataclass(frozen=True)
class AnswerSearch:
    """Searches on one brightness map, from the result of the sharpness stage."""

    cost: Cost
    sharpest: Mapping[str, float]
    """Parameter values that the sharpness stage found, in their units, expressed in the cost's space."""
    free_share: float
    """Share of equations beyond the unknowns of the map."""
    settings: PhotometricSettings
    report: Callable[[float], None]
    most_cost: float = math.inf
    """Cost above which an answer is of no use."""

    @property
    def space(self) -> ParameterSpace:
        """Space of the search vector."""
        return self.cost.space

    @property
    def origin(self) -> Vector:
        """Search vector of the sharpness stage's result [px]."""
        return self.space.to_vector({**self.space.start, **self.sharpest})

    def in_space(self, space: ParameterSpace) -> AnswerSearch:
        """Return the search in another space, on the same map."""
        return replace(self, cost=self.cost.in_space(space))

    def with_cause(self, cause: SuspectedError, v: Vector) -> AnswerSearch:
        """Return the search with a cause corrected or free, on the same map; ``v`` is the present answer [px]."""
        space, _ = with_cause(self.space, cause, self.space.to_values(v))
        sharpest = (
            values_with_other_side(self.space, self.sharpest) if cause == SIDE else self.sharpest
        )
        return replace(self.in_space(space), sharpest=sharpest)

    def search(self, start: Vector) -> Answer:
        """Search from ``start``, and again from any point near the new result with a lower cost.

        If there are few events, the map can adapt to wrong parameters so well that no single step lowers the cost. An
        answer that would be refused anyway is not searched for again.
        """
        return self.search_on(self.descend(start))

    def search_on(self, stage: SearchStage) -> Answer:
        """Return the answer of a search, or of the searches that follow it from lower points near its result."""
        answer, around = _evaluate(self, stage)
        few = self.cost.brightness.count < FEW_PAIRS
        for _ in range(RESTARTS):
            lower = [point for point, rise in around if rise < 0.0]
            most = limits.LARGEST_EXAMINED_COST if stage.ended != "budget" else 0.0
            hopeless = answer.cost > most and not few
            if not lower or limits.is_far(answer.moved_px) or hopeless:
                break
            self.cost.renew(lower[0])
            stage = join_runs(stage, self.descend(lower[0]))
            answer, around = _evaluate(self, stage)
        return answer

    def descend(self, start: Vector, most_cost: float | None = None) -> SearchStage:
        """Run one search from ``start``, in the box about the sharpness stage's result.

        It is given up if it will not come below ``most_cost``; by default the cost above which answers are of no use.
        """
        cost = self.cost
        settings = self.settings
        low, high = search_box(cost.space, self.origin)

        def report_steps(done: int, budget: int) -> None:
            self.report(done / budget)

        def score(at: Vector) -> float:
            report_steps(cost.evaluations, 2 * settings.evaluations)
            return cost(at)

        if settings.algorithm == GAUSS_NEWTON:
            # A GPU computes slopes while the host waits for the score. A CPU would do so in vain if the score is low.
            # After a low score, the map on a GPU converges from the derivatives there, to the same solution.
            return iterate(
                cost.start_settled,
                cost.start_slopes,
                start,
                low=low,
                high=high,
                tolerance=settings.tolerance_px,
                report=report_steps,
                early=not cost.brightness.device.is_cpu,
                least=-(self.most_cost if most_cost is None else most_cost),
                walls=search_walls(cost.space, low, high),
            )

        def run(at: Vector, step: float) -> SearchStage:
            return maximise(
                score,
                settings.algorithm,
                low=low,
                high=high,
                start=at,
                evaluations=settings.evaluations,
                tolerance=settings.tolerance_px,
                step=step,
            )

        stage = run(start, FIRST_STEP_PX)
        # during long steps the map is not fully converged, so a second run starts nearby with a better map
        cost.double_steps()
        return join_runs(stage, run(stage.x, POLISH_STEP_PX))


def join_runs(first: SearchStage, second: SearchStage) -> SearchStage:
    """Return two successive runs with the same free parameters as one.

    The result is the second run's, whose brightness map was better converged.
    """
    return replace(
        second,
        evaluations=first.evaluations + second.evaluations,
        seconds=first.seconds + second.seconds,
        points=np.concatenate([first.points, second.points]),
        scores=np.concatenate([first.scores, second.scores]),
    )


def _evaluate(
    search: AnswerSearch, stage: SearchStage
) -> tuple[Answer, list[tuple[Vector, float]]]:
    """Evaluate the optimum of ``stage``: final map, covariance and how good it is.

    Return the answer, and points near the optimum with their rise in cost, the lowest first.
    """
    cost = search.cost
    space = cost.space
    brightness = cost.brightness
    best = stage.x
    origin = search.origin
    cost.predict(best)
    cost.residuals(best, rounds=2)
    # everything is started before the first result is waited for
    waiting_final = cost.start_mean()
    waiting_residual = brightness.residuals.start_median(brightness.residuals.count)
    waiting_slopes = cost.start_slopes(best, with_parts=True)
    solved = brightness.copy_unknowns()
    moved_px = None if cost.paths is None else cost.paths.moved_px
    waiting_around = start_costs_around(cost, best, waiting_final)
    # the map is better converged now than at the start of the search, so the cost at the start is measured again
    cost.predict(origin)
    cost.residuals(origin)
    waiting_at_start = cost.start_mean()
    cost.replace_map(solved)
    if cost.paths is not None and moved_px is not None:
        cost.paths.set(moved_px)
    cost.residuals(best, rounds=0)
    slopes = waiting_slopes()
    final = waiting_final()
    around = waiting_around()
    covariance = slopes.covariance() / search.free_share**2
    unsharp = like_size(space.names)
    is_of_sharpness = np.array([n not in unsharp for n in space.names])
    is_of_prism = np.array([n not in (*unsharp, *MOTION) for n in space.names])
    leak, excess = (float(x) for x in brightness.extra)
    optimum = Optimum(
        cost=final,
        rise=around[0][1] if around else math.inf,
        moved_px=float(np.linalg.norm((best - origin)[is_of_prism])),
        next_step_px=float(np.linalg.norm(slopes.step()[is_of_prism])),
    )
    answer = Answer(
        stage=stage,
        optimum=optimum,
        parameters=space.to_values(best),
        uncertainty=space.deviations(best, covariance),
        covariance=covariance,
        moved_px=float(np.linalg.norm((best - origin)[is_of_sharpness])),
        cost_at_sharpness=waiting_at_start(),
        residual=waiting_residual(),
        off_over_on=1.0 + excess,
        leak=leak,
    )
    return answer, around


def is_accepted(answer: Answer) -> bool:
    """Return whether the optimum of an answer is good enough."""
    return not refused(answer.optimum)


def search_box(space: ParameterSpace, v: Vector) -> tuple[Vector, Vector]:
    """Return the corners of the box about the sharpness stage's result ``v`` in which this stage searches."""
    unsharp = like_size(space.names)

    def largest_move(name: str) -> float:
        if name in unsharp:
            return math.inf
        return LARGEST_ROTATION_MOVE_PX if name in MOTION else limits.LARGEST_MOVE_PX

    most = np.array([largest_move(n) for n in space.names])
    low, high = space.bounds()
    return np.clip(low, v - most, v + most), np.clip(high, v - most, v + most)


def search_walls(space: ParameterSpace, low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """Return those bounds of the search box ``low .. high`` on which an answer is refused [px]; infinite for others."""
    given_low, given_high = space.bounds()
    lens = np.array([name in LENS for name in space.names])
    return np.where(lens | (low > given_low), low, -np.inf), np.where(
        lens | (high < given_high), high, np.inf
    )


def start_costs_around(
    cost: Cost, best: Vector, final: Callable[[], float]
) -> Callable[[], list[tuple[Vector, float]]]:
    """Start to compute the costs at points that are a little away from ``best`` in size and phase.

    The distance is :data:`limits.PERTURBATION_PX`. Return a function that waits, and returns the points with their rise
    in cost, lowest first. ``final`` waits for the cost at ``best`` with the present map. A map of few pairs is biased
    to the point where it was fitted, and all other points would cost more. Then a new map is solved for each point,
    ``best`` included.
    """
    few = cost.brightness.count < FEW_PAIRS
    points = [
        best + side * along
        for along in size_and_phase_directions(cost.space, best)
        for side in (limits.PERTURBATION_PX, -limits.PERTURBATION_PX)
    ]
    costs = []
    for point in [best, *points] if few else points:
        if few:
            cost.renew(point)
            cost.residuals(point, rounds=2)
        else:
            cost.predict(point)
            cost.residuals(point, rounds=2, steps=cost.steps // 2)
        costs.append(cost.start_mean())
    reference = costs.pop(0) if few else final

    def result() -> list[tuple[Vector, float]]:
        here = reference()
        rises = [there() - here for there in costs]
        return sorted(zip(points, rises, strict=True), key=lambda found: found[1])

    return result
