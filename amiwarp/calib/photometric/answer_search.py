"""Search for the answer of the photometric stage on one brightness map, and the tests that it must pass."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.nlopt_solver import SearchStage, maximise
from amiwarp.calib.parameters import MOTION, like_size
from amiwarp.calib.photometric.cost import iterate
from amiwarp.calib.result import PhotometricSummary
from amiwarp.calib.settings import GAUSS_NEWTON

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.photometric.cost import Cost
    from amiwarp.calib.settings import PhotometricSettings

    Vector = NDArray[np.float64]


# Gauss-Newton search for parameters with the brightness map eliminated (variable projection), with uncertainty.


# Acceptance of the photometric stage's optimum.
#
# Each limit was set by failures that it prevents; ``docs/explanation/stability.md`` describes them.

LARGEST_MOVE_PX = 1.5
"""Largest accepted distance between the optima of the photometric and the sharpness stage, in the prism's parameters
[px]."""
PERTURBATION_PX, LEAST_COST_RISE = 0.3, 0.01
"""Reject the photometric optimum if changing the prism's orbit by ``PERTURBATION_PX`` [px] raises the cost by less than
``LEAST_COST_RISE``.

Without such a rise there is no distinct optimum, or a brightness map of few events fits any orbit. The cost is relative
to that without a brightness map.
"""
RISE_SHARE, SMALLEST_RISE = 0.1, 0.003
"""A rise below ``LEAST_COST_RISE`` suffices if it is this share of the cost, and at least ``SMALLEST_RISE``.

Few edges leave a small cost, and small rises. In recordings that determined the orbit the share was 0.11 to 0.25, in
those that did not, 0.02 at most.
"""
LARGEST_NEXT_STEP_PX = 0.06
"""Largest Gauss-Newton step that may remain when the search ends [px]. The step is about 0.01 px if the search
converged."""
LARGEST_COST = 0.75
"""Largest accepted cost, relative to the cost without a brightness map. Above it the map explains too little of the
events."""

LARGEST_EXAMINED_COST = 0.5
"""Largest cost, relative to that without a map, of an answer that is examined for causes of an error."""
LARGEST_STILL_COST = 0.2
"""Largest cost of the photometric stage, relative to that without a brightness map, that a still camera and a correct
encoder scale leave."""
LARGEST_ROTATION_GAIN = 0.05
"""Largest share of the squared residuals that a camera rotation may explain before it is freed. Cameras that turned at
0.1 to 1 deg/s left 0.1 to 0.5; still ones 0.007 at most, whatever the noise."""
LARGEST_COST_RATIO = 0.75
"""Ratio of the new to the previous cost up to which another explanation is accepted if the previous cost was high: a
camera rotation, a corrected encoder scale, or a corrected lens."""
LARGEST_INCONSISTENCY_PX = 0.1
"""Largest accepted error that the check of the answer's consistency leaves [px]."""


LARGEST_LAG_RAD = 0.35
"""Largest angle by which the prism may turn within the time constant of slow photoreceptors [rad]. At 0.2 an error of
0.02 px remains, at 0.4 one of 0.14 px."""


def judge_lag(turn: float) -> tuple[bool, str]:
    """Return whether to accept an answer for pixels within whose time constant the prism turns by an angle [rad]."""
    if turn <= LARGEST_LAG_RAD:
        return True, ""
    return False, (
        f"the pixels are too slow: the prism turns by {math.degrees(turn):.0f} deg within their time constant; use "
        "more light, a larger bandwidth or a slower prism"
    )


def judge_consistency(error_px: float, cause: str) -> tuple[bool, str]:
    """Return whether to accept an answer that differs over the image and over time by ``error_px``, and the reason.

    ``cause`` is the likeliest cause, in words.
    """
    if error_px <= LARGEST_INCONSISTENCY_PX:
        return True, ""
    return False, f"the answer differs by {error_px:.2f} px between parts of the image or of the recording: {cause}"


def judge_optimum(cost: float, *, rise: float, moved: float, next_step: float) -> tuple[bool, str]:
    """Return whether to accept an optimum of the photometric stage, and the reason.

    Parameters
    ----------
    cost : float
        Remaining cost, relative to that without a map.
    rise : float
        Smallest rise of the cost for an orbit that is :data:`PERTURBATION_PX` larger, smaller or rotated either way.
    moved : float
        Distance from the answer of the sharpness stage [px].
    next_step : float
        Length of the next Gauss-Newton step [px].

    Returns
    -------
    accepted : bool
        Whether to accept the optimum.
    reason : str
        The reason.
    """
    if cost > LARGEST_COST:
        return False, (
            f"no brightness map of the scene explains the events ({min(100 * cost, 100):.0f} % of the residual "
            "remains): the scene or the camera moved, light flickered, or the encoder or the lens is wrong"
        )
    if moved > 0.95 * LARGEST_MOVE_PX:
        return False, (
            f"the optimum is over {LARGEST_MOVE_PX:g} px away from that of sharpness: the lens or the encoder is "
            "wrong, or the scene or the camera moved"
        )
    if next_step > LARGEST_NEXT_STEP_PX:
        size = f"{next_step:.2f} px" if next_step <= LARGEST_MOVE_PX else f"over {LARGEST_MOVE_PX:g} px"
        return False, (
            f"the search did not converge: its next step would be {size}, but no step lowers the cost: too few events, "
            "or many lost"
        )
    if rise < min(LEAST_COST_RISE, max(SMALLEST_RISE, RISE_SHARE * cost)):
        well = f"as well ({100 * rise:.1f} % of the residual more)" if rise > 0.0 else "better"
        return False, (
            f"an orbit that is {PERTURBATION_PX:g} px larger, smaller or rotated explains the events {well}: "
            "too few events, too little contrast, or the scene or the camera moved"
        )
    return True, f"one brightness map explains the events ({100 * cost:.0f} % of the residual remains)"


# Check that the photometric stage's result is a minimum: slightly larger, smaller or rotated orbits must cost more.

FEW_PAIRS = 50_000
"""Number of pairs of events below which a new brightness map is solved for each tested point."""


def start_costs_around(
    cost: Cost, best: NDArray[np.float64], final: Callable[[], float]
) -> Callable[[], list[tuple[NDArray[np.float64], float]]]:
    """Start to compute the costs at points :data:`PERTURBATION_PX` from ``best`` in size and phase.

    Return a function that waits, and returns the points with their rise in cost, lowest first. ``final`` waits for the
    cost at ``best`` with the present map. A map of few pairs is biased to the point where it was fitted, and all other
    points would cost more. Then a new map is solved for each point, ``best`` included.
    """
    few = cost.brightness.count < FEW_PAIRS

    def start(point: NDArray[np.float64]) -> Callable[[], float]:
        if few:
            cost.renew(point)
            cost.residuals(point, rounds=2)
        else:
            cost.predict(point)
            cost.residuals(point, rounds=2, steps=cost.steps // 2)
        return cost.start_mean()

    reference = start(best) if few else final
    shifts = [
        side * along
        for along in size_and_phase_directions(cost.space, best)
        for side in (PERTURBATION_PX, -PERTURBATION_PX)
    ]
    costs = [(best + shift, start(best + shift)) for shift in shifts]

    def result() -> list[tuple[NDArray[np.float64], float]]:
        here = reference()
        return sorted(((point, there() - here) for point, there in costs), key=lambda found: found[1])

    return result


def size_and_phase_directions(space: ParameterSpace, best: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return unit vectors of the search space along the prism's size and phase, if these are free."""
    if space.cartesian:
        x, y = best[:2] / max(float(np.linalg.norm(best[:2])), 1e-9)
        rest = np.zeros(len(best) - 2)
        return [np.array([x, y, *rest]), np.array([-y, x, *rest])]
    unit = np.eye(len(best))
    return [unit[k] for k, name in enumerate(space.names) if name in (space.size_name, "phase")]


# Search for the answer of the photometric stage on one brightness map, from the result of the sharpness stage.

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
    unsharp = like_size(space.names)
    of_sharpness = np.array([n not in unsharp for n in space.names])
    of_prism = np.array([n not in (*unsharp, *MOTION) for n in space.names])
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

    unsharp = like_size(space.names)

    def largest_move(name: str) -> float:
        if name in unsharp:
            return math.inf
        return LARGEST_ROTATION_MOVE_PX if name in MOTION else LARGEST_MOVE_PX

    most = np.array([largest_move(n) for n in space.names])
    low, high = space.bounds()
    return np.clip(low, v - most, v + most), np.clip(high, v - most, v + most)
