"""Search for the answer of the photometric stage on one brightness map, from the result of the sharpness stage."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.nlopt_solver import SearchStage, maximise
from amiwarp.calib.parameters import DEGENERATE_WITH_APEX, MOTION
from amiwarp.calib.photometric.acceptance import LARGEST_MOVE_PX, judge_optimum
from amiwarp.calib.photometric.gauss_newton import GAUSS_NEWTON, iterate
from amiwarp.calib.photometric.minimum_check import start_costs_around
from amiwarp.calib.summaries import PhotometricSummary

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.photometric.cost import Cost
    from amiwarp.calib.photometric.stage import PhotometricSettings

LARGEST_ROTATION_MOVE_PX = 4.0
"""Largest distance from the sharpness optimum that is searched in the parameters of the camera's rotation [px]."""
RESTARTS = 3
"""Largest number of further searches, each from a point near the previous result that has a lower cost."""
FIRST_STEP_PX = 0.2
"""First step of an NLopt algorithm's first run [px]."""
POLISH_STEP_PX = 0.05
"""First step of an NLopt algorithm's second run, which starts at the result of the first run [px]."""


@dataclass(frozen=True)
class Answer:
    """Result of a search, with the evidence for it."""

    stage: SearchStage
    """The search that found it."""
    result: PhotometricSummary
    """The result, and whether it is accepted."""
    covariance: NDArray[np.float64]
    """Covariance of the search vector from the scatter between places [px²], shape (n, n)."""


@dataclass
class AnswerSearch:
    """Searches on one brightness map, from the result of the sharpness stage."""

    cost: Cost
    sharpest: dict[str, float]
    """Parameter values that the sharpness stage found, in their units."""
    left: float
    """Share of equations of :func:`check_pairs`."""
    settings: PhotometricSettings
    report: Callable[[float], None]
    timing: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Change of the first answer by a correction of the sensor's timing [px]; empty for none."""

    @property
    def origin(self) -> NDArray[np.float64]:
        """Search vector of the sharpness stage's result [px]."""
        space = self.cost.space
        return space.to_vector({**space.start, **self.sharpest})

    def search(self, start: NDArray[np.float64]) -> Answer:
        """Search from ``start``, and again from any point near the new result with a lower cost.

        If there are few events, the map can adapt to wrong parameters so well that no single step lowers the cost.
        """
        cost = self.cost
        stage = self.descend(start)
        answer, around = _evaluate(cost, stage, self.origin, self.left)
        for _ in range(RESTARTS):
            lower = [point for point, rise in around if rise < 0.0]
            if not lower:
                break
            cost.renew(lower[0])
            stage = join_runs(stage, self.descend(lower[0]))
            answer, around = _evaluate(cost, stage, self.origin, self.left)
        return answer

    def descend(self, start: NDArray[np.float64]) -> SearchStage:
        """Run one search from ``start``, in the box about the sharpness stage's result."""
        cost, settings = self.cost, self.settings
        low, high = search_box(cost.space, self.origin)

        def report_steps(done: int, budget: int) -> None:
            self.report(done / budget)

        def score(at: NDArray[np.float64]) -> float:
            report_steps(cost.evaluations, 2 * settings.evaluations)
            return cost(at)

        if settings.algorithm == GAUSS_NEWTON:
            # A GPU computes slopes while the host waits for the score. A CPU would do so in vain if the score is low.
            # After a low score, the map on a GPU converges from the derivatives there, to the same solution.
            slopes = (lambda at: lambda: cost.slopes(at)) if cost.brightness.device.is_cpu else cost.start_slopes
            return iterate(
                cost.start_settled, slopes, start, low=low, high=high, tolerance=settings.tolerance_px,
                report=report_steps,
            )  # fmt: skip

        def run(at: NDArray[np.float64], step: float) -> SearchStage:
            return maximise(
                score, settings.algorithm, low=low, high=high, start=at, evaluations=settings.evaluations,
                tolerance=settings.tolerance_px, step=step,
            )  # fmt: skip

        stage = run(start, FIRST_STEP_PX)
        # during long steps the map is not fully converged, so a second run starts nearby with a better map
        cost.steps *= 2
        return join_runs(stage, run(stage.x, POLISH_STEP_PX))


def join_runs(first: SearchStage, second: SearchStage) -> SearchStage:
    """Return two successive runs with the same free parameters as one.

    The result is that of the second run, whose brightness map was better converged.
    """
    return replace(
        second,
        evaluations=first.evaluations + second.evaluations,
        seconds=first.seconds + second.seconds,
        points=np.concatenate([first.points, second.points]),
        scores=np.concatenate([first.scores, second.scores]),
    )


def _evaluate(
    cost: Cost,
    stage: SearchStage,
    v: NDArray[np.float64],
    left: float,
) -> tuple[Answer, list[tuple[NDArray[np.float64], float]]]:
    """Evaluate the optimum of ``stage``: final map, covariance and acceptance.

    ``v`` is the answer of the sharpness stage, ``left`` the share of equations of :func:`check_pairs`. Return the
    answer, and points near the optimum with their rise in cost, the lowest first.
    """
    space, best = cost.space, stage.x
    cost.predict(best)
    cost.residuals(best, rounds=2)
    # everything is started before the first result is waited for
    waiting_final, residuals = cost.start_mean(), cost.brightness.residuals
    waiting_residual = residuals.start_median(residuals.count)
    waiting_slopes = cost.start_slopes(best, with_parts=True)
    solved = cost.brightness.copy_unknowns()
    waiting_around = start_costs_around(cost, best, waiting_final)
    # the map is better converged now than at the start of the search, so the cost at the start is measured again
    cost.predict(v)
    cost.residuals(v)
    waiting_at_start = cost.start_mean()
    cost.replace_map(solved)
    cost.residuals(best, rounds=0)
    slopes, final, around = waiting_slopes(), waiting_final(), waiting_around()
    covariance = slopes.covariance() / left**2
    of_sharpness = np.array([n not in DEGENERATE_WITH_APEX for n in space.names])
    of_prism = np.array([n not in (*DEGENERATE_WITH_APEX, *MOTION) for n in space.names])
    leak, excess = (float(x) for x in cost.brightness.extra)
    rise = around[0][1] if around else math.inf
    next_step = float(np.linalg.norm(slopes.step()[of_prism]))
    moved = float(np.linalg.norm((best - v)[of_prism]))
    accepted, verdict = judge_optimum(final, rise=rise, moved=moved, next_step=next_step)
    found = PhotometricSummary(
        accepted=accepted,
        verdict=verdict,
        parameters=space.to_values(best),
        uncertainty=space.deviations(best, covariance),
        sharpness_parameters={},
        moved_px=float(np.linalg.norm((best - v)[of_sharpness])),
        cost=final,
        cost_at_sharpness=waiting_at_start(),
        residual=waiting_residual(),
        pairs=0,
        off_over_on=1.0 + excess,
        leak=leak,
    )
    return Answer(stage, found, covariance), around


def search_box(space: ParameterSpace, v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the box about the sharpness stage's result ``v`` in which this stage searches."""

    def largest_move(name: str) -> float:
        if name in DEGENERATE_WITH_APEX:
            return math.inf
        return LARGEST_ROTATION_MOVE_PX if name in MOTION else LARGEST_MOVE_PX

    most = np.array([largest_move(n) for n in space.names])
    low, high = space.bounds()
    return np.clip(low, v - most, v + most), np.clip(high, v - most, v + most)
