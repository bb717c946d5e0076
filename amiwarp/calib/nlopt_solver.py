"""Maximisation of a score by NLopt's derivative-free algorithms. Only this module imports NLopt."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.results.search_stage import SearchStage
from amiwarp.validation import one_of

GLOBAL_ALGORITHMS = (
    "GN_DIRECT",
    "GN_DIRECT_L",
    "GN_DIRECT_L_RAND",
    "GN_DIRECT_NOSCAL",
    "GN_DIRECT_L_NOSCAL",
    "GN_DIRECT_L_RAND_NOSCAL",
    "GN_ORIG_DIRECT",
    "GN_ORIG_DIRECT_L",
    "GN_CRS2_LM",
    "GN_ISRES",
    "GN_ESCH",
    "GN_AGS",
    "GN_MLSL",
    "GN_MLSL_LDS",
    "G_MLSL",
    "G_MLSL_LDS",
)
"""NLopt's derivative-free global algorithms. The MLSL algorithms run one of the local algorithms inside."""
LOCAL_ALGORITHMS = (
    "LN_COBYLA",
    "LN_BOBYQA",
    "LN_NEWUOA",
    "LN_NEWUOA_BOUND",
    "LN_PRAXIS",
    "LN_NELDERMEAD",
    "LN_SBPLX",
)
"""NLopt's derivative-free local algorithms."""
_NEEDS_TWO = ("LN_BOBYQA", "LN_NEWUOA", "LN_NEWUOA_BOUND")
"""Powell's algorithms with quadratic models, which need at least two dimensions."""
_ENDS = {
    1: "converged",
    2: "score reached",
    3: "tolerance of the score",
    4: "tolerance",
    5: "budget",
    6: "time",
}
"""Why NLopt ended, by its result codes."""
LARGEST_STEP_SHARE = 0.45
"""Largest first step, as a share of the box: NLopt refuses a step that leaves the box from its middle."""
LEAST_INNER_EVALUATIONS = 20
"""Smallest number of evaluations of a search inside MLSL."""
INNER_SEARCHES = 8
"""Number of searches inside MLSL that fit into the budget."""
LEAST_INNER_TOLERANCE_PX = 0.05
"""Smallest tolerance of a search inside MLSL [px]: the best optimum is refined by the local search that follows."""
SAME_OPTIMUM_PX = 1.0
"""Distance from a known optimum below which a search would end there [px]."""


def best_of(
    algorithm: str,
    points: list[NDArray[np.float64]],
    scores: list[float],
    *,
    seconds: float,
    ended: str,
) -> SearchStage:
    """Return the record of a run, with the best of its evaluated points."""
    best = int(np.argmax(scores))
    return SearchStage(
        algorithm=algorithm,
        x=points[best],
        score=float(scores[best]),
        evaluations=len(scores),
        seconds=seconds,
        ended=ended,
        points=np.array(points),
        scores=np.array(scores),
    )


def maximise(
    score: Callable[[NDArray[np.float64]], float],
    algorithm: str,
    *,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    start: NDArray[np.float64],
    evaluations: int,
    tolerance: float,
    step: float = 1.0,
    inner: str = "LN_SBPLX",
    seed: int = 0,
    known: Sequence[NDArray[np.float64]] = (),
) -> SearchStage:
    """Maximise a score in a box by one algorithm.

    Parameters
    ----------
    score : callable
        Function of a point, shape ``(n,)``; higher is better.
    algorithm : str
        Name of the algorithm.
    low : ndarray
        Lower corner of the box [px], shape ``(n,)``.
    high : ndarray
        Upper corner of the box [px], shape ``(n,)``.
    start : ndarray
        First point [px], shape ``(n,)``.
    evaluations : int
        Largest number of evaluations.
    tolerance : float
        A local search ends when its steps are smaller than this in every dimension [px].
    step : float
        First step of a local search [px].
    inner : str
        Local algorithm of the MLSL algorithms.
    seed : int
        Seed of random algorithms.
    known : sequence of ndarray
        Optima that earlier searches found. The search ends if it comes near one of them.

    Returns
    -------
    SearchStage
        The run. Its answer is the best evaluated point, whatever NLopt returns: DIRECT ends by its budget, and BOBYQA
        may stop because of round-off.

    Raises
    ------
    AmiwarpError
        If the score is not finite, or if the algorithm does not suit the problem.
    """
    import nlopt

    one_of(algorithm, (*GLOBAL_ALGORITHMS, *LOCAL_ALGORITHMS), "algorithm")
    one_of(inner, LOCAL_ALGORITHMS, "inner algorithm")
    began = time.perf_counter()
    nlopt.srand(seed + 1)  # 0 would seed NLopt from the clock
    optimiser = _optimiser(
        algorithm,
        low=low,
        high=high,
        evaluations=evaluations,
        tolerance=tolerance,
        step=step,
        inner=inner,
    )
    samples = _EvaluationLog(score, evaluations, optimiser.force_stop, known)
    optimiser.set_min_objective(samples.cost)
    try:
        optimiser.optimize(np.clip(start, low, high))
        ended = _ENDS.get(optimiser.last_optimize_result(), str(optimiser.last_optimize_result()))
    except nlopt.RoundoffLimited:
        ended = "round-off"
    except nlopt.ForcedStop:
        ended = "known optimum" if samples.near_known else "budget"
    except (RuntimeError, ValueError) as error:
        raise AmiwarpError(
            f"{algorithm} failed in {len(low)} dimensions: {error}; choose another algorithm or other bounds"
        ) from error
    finally:
        samples.release()
    if samples.failure is not None:
        raise samples.failure
    return best_of(
        algorithm, samples.points, samples.scores, seconds=time.perf_counter() - began, ended=ended
    )


class _EvaluationLog:
    """Objective function for NLopt. It records every evaluation.

    It stops NLopt at the budget, at an exception, and near a ``known`` optimum.
    """

    def __init__(
        self,
        score: Callable[[NDArray[np.float64]], float],
        most: int,
        stop: Callable[[], None],
        known: Sequence[NDArray[np.float64]],
    ) -> None:
        self.points: list[NDArray[np.float64]] = []
        self.scores: list[float] = []
        self.failure: BaseException | None = None
        self._score: Callable[[NDArray[np.float64]], float] | None = score
        self._stop: Callable[[], None] | None = stop
        self._most = most
        self._known = known

    @property
    def near_known(self) -> bool:
        """Whether the last point is near a known optimum."""
        return bool(self.points) and any(
            math.dist(self.points[-1], optimum) < SAME_OPTIMUM_PX for optimum in self._known
        )

    def release(self) -> None:
        """Drop the reference to the score function, because NLopt never frees its callbacks."""
        self._score = self._stop = None

    def cost(self, x: NDArray[np.float64], _gradient: Any) -> float:
        """Return the negative score of a point, for NLopt, which minimises."""
        assert self._score is not None
        assert self._stop is not None
        # NLopt's C code may continue after an exception. So the exception is stored here and raised after NLopt stops.
        # Some algorithms exceed their budget.
        if self.failure is not None or len(self.scores) >= self._most:
            self._stop()
            return -min(self.scores, default=0.0)
        try:
            value = self._score(x)
            if not math.isfinite(value):
                raise AmiwarpError(
                    f"sharpness or cost is {value} at the search vector {x} px; check camera and prism"
                )
        except BaseException as error:
            self.failure = error
            self._stop()
            return 0.0
        self.points.append(x.copy())
        self.scores.append(value)
        if self.near_known:
            self._stop()
        return -value


def _optimiser(
    algorithm: str,
    *,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    evaluations: int,
    tolerance: float,
    step: float,
    inner: str,
) -> Any:
    """Return an NLopt optimiser with bounds, budget and tolerances set."""
    import nlopt

    n = len(low)
    if n < 2 and algorithm in _NEEDS_TWO:
        raise AmiwarpError(
            f"{algorithm} needs at least two free parameters; use LN_COBYLA or LN_SBPLX for one"
        )
    optimiser = nlopt.opt(getattr(nlopt, algorithm), n)
    if algorithm != "LN_NEWUOA":  # the only algorithm without bounds
        optimiser.set_lower_bounds(low)
        optimiser.set_upper_bounds(high)
    optimiser.set_maxeval(evaluations)
    if algorithm.startswith("LN_"):
        optimiser.set_xtol_abs(np.full(n, tolerance))
        optimiser.set_initial_step(np.minimum(step, LARGEST_STEP_SHARE * (high - low)))
    if "MLSL" in algorithm:
        local = _optimiser(
            inner,
            low=low,
            high=high,
            evaluations=max(LEAST_INNER_EVALUATIONS, evaluations // INNER_SEARCHES),
            tolerance=max(tolerance, LEAST_INNER_TOLERANCE_PX),
            step=step,
            inner=inner,
        )
        optimiser.set_local_optimizer(local)
    return optimiser
