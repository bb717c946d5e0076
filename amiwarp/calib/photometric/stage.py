"""Photometric stage: the parameters for which one brightness map of the scene explains the events.

Sharpness is biased by the sensor's hysteresis. This stage models the hysteresis by its equations, see
:mod:`amiwarp.brightness.solver`. For given parameters the map is the solution of a linear least-squares problem. The
parameters minimise its robust residual.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.brightness.event_pairs import SensorTiming, off_excess
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.calib.nlopt_solver import LOCAL_ALGORITHMS, SearchStage, check_algorithm, maximise
from amiwarp.calib.parameters import DEGENERATE_WITH_APEX, MOTION
from amiwarp.calib.photometric.acceptance import LARGEST_MOVE_PX, judge_optimum
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.gauss_newton import GAUSS_NEWTON, determined, iterate
from amiwarp.calib.photometric.minimum_check import cost_around_optimum
from amiwarp.calib.photometric.pair_collection import (
    FINE_PAIRS_PER_NODE,
    check_pairs,
    collect_pairs,
    pairs_per_node,
)
from amiwarp.calib.progress_share import stage_share
from amiwarp.calib.summaries import PhotometricSummary, StageSummary
from amiwarp.validation import real, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.brightness.solver import Tiles
    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.sharpness.search import Search
    from amiwarp.events.recording import Recording
    from amiwarp.progress import Progress

LARGEST_ROTATION_MOVE_PX = 4.0
"""Largest distance from the sharpness optimum that is searched in the parameters of the camera's rotation [px]."""
RESTARTS = 3
"""Largest number of further searches, each from a point near the previous result that has a lower cost."""
FIRST_STEP_PX = 0.2
"""First step of an NLopt algorithm's first run [px]."""
POLISH_STEP_PX = 0.05
"""First step of an NLopt algorithm's second run, which starts at the result of the first run [px]."""


@dataclass(frozen=True)
class PhotometricSettings:
    """Settings of the photometric stage of a calibration.

    Examples
    --------
    >>> settings = amiwarp.PhotometricSettings(pairs=100_000)
    >>> settings.check()
    >>> settings.algorithm
    'gauss-newton'
    """

    pairs: int = 300_000
    """Approximate largest number of pairs of events, from whole turns spread over the recording."""
    algorithm: str = GAUSS_NEWTON
    """Algorithm: ``gauss-newton`` or one of NLopt's derivative-free local algorithms."""
    evaluations: int = 80
    """Largest number of evaluations in each of the two runs of an NLopt algorithm."""
    tolerance_px: float = 0.002
    """Length below which the search's steps end it, as displacement of events [px]."""
    steps: int = 20
    """Number of conjugate-gradient steps that solve the brightness map in each evaluation, starting from the previous
    map."""
    density: float = 2.0
    """Nodes of the brightness map per pixel along each axis. With too few pairs of events for it, there is one node per
    pixel."""
    sensor: SensorTiming = field(default_factory=SensorTiming)
    """Known latency and refractory period of the sensor. If they are unknown, the calibrated phase contains their
    effect."""

    def check(self) -> None:
        """Check the settings.

        Raises
        ------
        AmiwarpError
            If the algorithm is unknown or a number out of range.
        """
        check_algorithm(self.algorithm, (GAUSS_NEWTON, *LOCAL_ALGORITHMS))
        for name in ("pairs", "evaluations", "steps"):
            whole(getattr(self, name), f"photometric {name}", 1, 10**12)
        real(self.tolerance_px, "photometric tolerance_px", 0.0, 1e3, " px")
        real(self.density, "photometric density", 0.01, 100.0)


def refine(
    recording: Recording, search: Search, linear: tuple[str, ...], *, progress: Progress | None = None
) -> tuple[PhotometricSummary, StageSummary]:
    """Run the photometric stage, which starts at the result of the sharpness stage, and return its result.

    ``linear`` names the free ones of ``off_ratio`` and ``leak``. Raises :class:`AmiwarpError` for too few pairs.
    """
    settings: PhotometricSettings = search.settings.photometric
    pairs, tiles = collect_pairs(recording, search, settings)
    full = search.full_space
    space = full.holding({n: x for n, x in search.best.items() if n not in full.names})
    # the count of OFF and ON events gives the ratio of thresholds only if brightness returns after a whole turn
    duration_us = recording.events.t_last - recording.events.t_first
    whole_turn = abs(search.calibration_events.encoder.rpm) * duration_us >= 60e6
    excess = off_excess(pairs, with_leak="leak" in linear) if whole_turn else 0.0

    def cost_on(tiles: Tiles) -> Cost:
        brightness = BrightnessMap(
            pairs, tiles, off_excess=None if "off_ratio" in linear else excess, with_leak="leak" in linear,
            middle_us=space.middle_us,
        )  # fmt: skip
        cost = Cost(space, brightness, settings.steps)
        cost.warm_up(v)
        return cost

    v = space.to_vector({**space.start, **search.best})
    cost = cost_on(tiles)
    coverage = cost.brightness.coverage(cost.scale)
    few = pairs_per_node(coverage, len(pairs)) < FINE_PAIRS_PER_NODE
    # a fine map converges too slowly for parameters that make nearly the same motion
    if tiles.density > 1.0 and (few or any(n in DEGENERATE_WITH_APEX for n in space.names)):
        cost = cost_on(tiles.at_density(1.0))
        coverage = cost.brightness.coverage(cost.scale)
    left = check_pairs(recording.name, coverage, len(pairs))
    keep = determined(cost.slopes(v, with_parts=True), space, left)
    held = tuple(n for n in space.names if n not in keep)
    # undetermined parameters stay at the answer of sharpness, because the others were found together with them
    cost.space = space = space.without(held).holding({n: x for n, x in search.best.items() if n in held})
    v = space.to_vector({**space.start, **search.best})
    if held:
        cost.warm_up(v)

    def report(share: float) -> None:
        if progress is not None:
            progress(*stage_share(search.settings, "photometric", share))

    stage, result = _search_with_restarts(cost, v, left, settings, report)
    found = replace(result, sharpness_parameters=dict(search.best), pairs=len(pairs), held=held)
    return found, StageSummary.of("photometric", stage, space)


def search_box(space: ParameterSpace, v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the box about the sharpness stage's result ``v`` in which this stage searches."""

    def largest_move(name: str) -> float:
        if name in DEGENERATE_WITH_APEX:
            return math.inf
        return LARGEST_ROTATION_MOVE_PX if name in MOTION else LARGEST_MOVE_PX

    most = np.array([largest_move(n) for n in space.names])
    low, high = space.bounds()
    return np.clip(low, v - most, v + most), np.clip(high, v - most, v + most)


def _search_with_restarts(
    cost: Cost, v: NDArray[np.float64], left: float, settings: PhotometricSettings, report: Callable[[float], None]
) -> tuple[SearchStage, PhotometricSummary]:
    """Search from the sharpness stage's result, and again from any point near the new result with a lower cost.

    If there are few events, the map can adapt to wrong parameters so well that no single step lowers the cost.
    """
    stage = _search(cost, v, v, settings, report)
    result, around = _evaluate(cost, stage.x, v, left)
    for _ in range(RESTARTS):
        lower = [point for point, rise in around if rise < 0.0]
        if not lower:
            break
        cost.renew(lower[0])
        stage = join_runs(stage, _search(cost, v, lower[0], settings, report))
        result, around = _evaluate(cost, stage.x, v, left)
    return stage, result


def _search(
    cost: Cost,
    v: NDArray[np.float64],
    start: NDArray[np.float64],
    settings: PhotometricSettings,
    report: Callable[[float], None],
) -> SearchStage:
    """Run one search from ``start``, in the box about the sharpness stage's result ``v``."""
    low, high = search_box(cost.space, v)

    def report_steps(done: int, budget: int) -> None:
        report(done / budget)

    def score(at: NDArray[np.float64]) -> float:
        report_steps(cost.evaluations, 2 * settings.evaluations)
        return cost(at)

    if settings.algorithm == GAUSS_NEWTON:
        return iterate(
            cost.settled, cost.slopes, start, low=low, high=high, tolerance=settings.tolerance_px, report=report_steps
        )

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
    """Return two successive runs as one.

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
    best: NDArray[np.float64],
    v: NDArray[np.float64],
    left: float,
) -> tuple[PhotometricSummary, list[tuple[NDArray[np.float64], float]]]:
    """Evaluate the optimum ``best``: final map, covariance and acceptance.

    ``v`` is the answer of the sharpness stage, ``left`` the share of equations of :func:`check_pairs`. Return the
    summary, and points near the optimum with their rise in cost, the lowest first.
    """
    space = cost.space
    # the map is better converged now than at the start of the search, so the cost at the start is measured again
    cost.residuals(v, rounds=2)
    at_start = cost.mean()
    cost.residuals(best, rounds=2)
    final, residual = cost.mean(), cost.brightness.residuals.median()
    slopes = cost.slopes(best, with_parts=True)
    covariance = slopes.covariance() / left**2
    of_sharpness = np.array([n not in DEGENERATE_WITH_APEX for n in space.names])
    of_prism = np.array([n not in (*DEGENERATE_WITH_APEX, *MOTION) for n in space.names])
    leak, excess = (float(x) for x in cost.brightness.extra)  # read before the map is solved at other points
    around = cost_around_optimum(cost, best, final)
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
        cost_at_sharpness=at_start,
        residual=residual,
        pairs=0,
        off_over_on=1.0 + excess,
        leak=leak,
    )
    return found, around
