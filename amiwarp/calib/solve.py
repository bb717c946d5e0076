"""The only place that knows NLopt: its derivative-free algorithms by their own names, global and local."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
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
"""NLopt's derivative-free global algorithms. The MLSL ones run the chosen local algorithm inside."""
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
"""Quadratic models of Powell's that NLopt gives only from two dimensions up."""


@dataclass(frozen=True)
class SearchStage:
    """What one run of an algorithm did."""

    algorithm: str
    x: NDArray[np.float64]
    """Best point seen [px]."""
    score: float
    """Sharpness there."""
    evaluations: int
    seconds: float
    ended: str
    """Why it ended, in NLopt's words."""
    points: NDArray[np.float64] = field(repr=False)
    """Every point evaluated, in order, shape (evaluations, dimensions)."""
    scores: NDArray[np.float64] = field(repr=False)
    """The sharpness at each."""


def check_algorithm(name: str, known: tuple[str, ...]) -> None:
    """Raises :class:`AmiwarpError` unless ``name`` is one of ``known``."""
    one_of(name, known, "algorithm")


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
) -> SearchStage:
    """Runs one algorithm on ``score`` (higher is better) in the box ``low .. high``.

    ``tolerance`` and ``step``: end of the search and first step [px], in every dimension. ``inner``: the local
    algorithm of MLSL. The best point seen counts, whatever NLopt returns: DIRECT ends by its budget, and BOBYQA may
    stop at round-off. Raises :class:`AmiwarpError` where the score is not finite or the algorithm does not fit.
    """
    import nlopt

    names = LOCAL_ALGORITHMS if algorithm.startswith("LN_") else GLOBAL_ALGORITHMS
    check_algorithm(algorithm, names)
    began = time.perf_counter()
    nlopt.srand(seed + 1)  # NLopt takes 0 for the clock
    optimiser = _optimiser(algorithm, low, high, evaluations, tolerance, step, inner)
    samples = _Samples(score, evaluations, optimiser.force_stop)
    optimiser.set_min_objective(samples.cost)
    try:
        optimiser.optimize(np.clip(start, low, high))
        ended = _ENDS.get(optimiser.last_optimize_result(), str(optimiser.last_optimize_result()))
    except nlopt.RoundoffLimited:
        ended = "round-off"
    except nlopt.ForcedStop:
        ended = "budget"
    except (RuntimeError, ValueError) as error:
        raise AmiwarpError(f"{algorithm} failed in {len(low)} dimensions: {error}; choose another algorithm") from error
    finally:
        samples.release()
    if samples.failure is not None:
        raise samples.failure
    points, scores = np.array(samples.points), np.array(samples.scores)
    best = int(np.argmax(scores))
    seconds = time.perf_counter() - began
    return SearchStage(algorithm, points[best], float(scores[best]), len(scores), seconds, ended, points, scores)


class _Samples:
    """What NLopt calls: keeps every sample, and stops NLopt at the budget and at a failure."""

    def __init__(self, score: Callable[[NDArray[np.float64]], float], most: int, stop: Callable[[], None]) -> None:
        self.points: list[NDArray[np.float64]] = []
        self.scores: list[float] = []
        self.failure: BaseException | None = None
        self._score: Callable[[NDArray[np.float64]], float] | None = score
        self._stop: Callable[[], None] | None = stop
        self._most = most

    def release(self) -> None:
        """Let go of the score and of what it holds: NLopt keeps what it has called for ever."""
        self._score = self._stop = None

    def cost(self, x: NDArray[np.float64], _gradient: Any) -> float:
        assert self._score is not None
        assert self._stop is not None
        # NLopt's C code may go on calling after an exception, so none is let through: it is kept, and NLopt stopped.
        if self.failure is not None or len(self.scores) >= self._most:  # some algorithms overrun their budget
            self._stop()
            return -min(self.scores, default=0.0)
        try:
            value = self._score(x)
            if not math.isfinite(value):
                raise AmiwarpError(f"sharpness is {value} at {x} px; check camera and prism")
        except BaseException as error:
            self.failure = error
            self._stop()
            return 0.0
        self.points.append(x.copy())
        self.scores.append(value)
        return -value


_ENDS = {1: "converged", 2: "score reached", 3: "tolerance of the score", 4: "tolerance", 5: "budget", 6: "time"}


def _optimiser(
    algorithm: str,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    evaluations: int,
    tolerance: float,
    step: float,
    inner: str,
) -> Any:
    import nlopt

    n = len(low)
    if n < 2 and algorithm in _NEEDS_TWO:
        raise AmiwarpError(f"{algorithm} needs two free parameters or more; for one use LN_COBYLA or LN_SBPLX")
    optimiser = nlopt.opt(getattr(nlopt, algorithm), n)
    if algorithm != "LN_NEWUOA":  # the one without bounds
        optimiser.set_lower_bounds(low)
        optimiser.set_upper_bounds(high)
    optimiser.set_maxeval(evaluations)
    if algorithm.startswith("LN_"):
        optimiser.set_xtol_abs(np.full(n, tolerance))
        optimiser.set_initial_step(np.minimum(step, 0.45 * (high - low)))
    if "MLSL" in algorithm:
        check_algorithm(inner, LOCAL_ALGORITHMS)
        local = _optimiser(inner, low, high, max(20, evaluations // 8), max(tolerance, 0.05), step, inner)
        optimiser.set_local_optimizer(local)
    return optimiser
