"""Photometric stage: the parameters for which one brightness map of the scene explains the events.

Sharpness is biased by the sensor's hysteresis. This stage models the hysteresis by its equations, see
:mod:`amiwarp.brightness.solver`. For given parameters the map is the solution of a linear least-squares problem. The
parameters minimise its robust residual.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.brightness.event_pairs import SensorTiming, off_excess
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.calib.parameters import LENS, like_size
from amiwarp.calib.photometric.answer_search import (
    LARGEST_COST_RATIO,
    LARGEST_EXAMINED_COST,
    LARGEST_STILL_COST,
    AnswerSearch,
    join_runs,
    judge_consistency,
    judge_lag,
)
from amiwarp.calib.photometric.consistency import SIGNIFICANT, Consistency, check_consistency
from amiwarp.calib.photometric.cost import (
    FLAT_SIDE,
    Cost,
    check_pairs,
    collect_pairs,
    determined,
    fine_map_is_determined,
    turned,
    with_cause,
)
from amiwarp.calib.photometric.sensor_timing import (
    find_refractory,
    find_time_constant,
    timing_can_be_found,
    timing_notes,
    timing_steps,
)
from amiwarp.calib.result import PhotometricSummary, StageSummary
from amiwarp.calib.settings import PhotometricSettings, stage_share

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from amiwarp.brightness.event_pairs import PairSet
    from amiwarp.brightness.multigrid import Tiles
    from amiwarp.calib.calibration_events import EventsAhead
    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.photometric.answer_search import Answer
    from amiwarp.calib.photometric.consistency import Finding
    from amiwarp.calib.photometric.cost import Cause
    from amiwarp.calib.sharpness import Search
    from amiwarp.events.recording import Recording
    from amiwarp.progress import Progress


# Correction of the given camera and prism where the events contradict them, and the last judgement of the answer.

MOST_CORRECTIONS = 4
"""Largest number of corrections, and of searches that continue an unfinished one."""
RIVAL_SHARE = 0.75
"""A cause is tried if it removes at least this share of the residual that the likeliest one removes."""
TIE_SHARE = 0.04
"""Of the tried causes, the first one counts whose cost is at most this share of the gain above the lowest cost."""
TIMING_SHARE = 0.3
"""Systematic standard deviation of the answer if the sensor's timing was corrected: a share of the correction. The
thresholds, which turn the map's brightness into light, are not known."""
LARGEST_LAST_STEP_PX = 0.01
"""Longest step that is added to the answer without a new search [px]."""


@dataclass(frozen=True)
class _Corrected:
    """Answer after the correction of a cause."""

    cause: Cause
    answer: Answer
    cost: float
    """Cost with a new map, which compares with that of other answers."""
    space: ParameterSpace
    sharpest: dict[str, float]
    """Result of the sharpness stage, expressed in ``space``."""


def checked(search: AnswerSearch, answer: Answer) -> Answer:
    """Return the answer after corrections of the given camera and prism, judged by its consistency.

    A correction is kept if it lowers the cost. The search's space is the corrected one then. The answer's uncertainty
    includes its systematic part.
    """
    if answer.result.cost > LARGEST_EXAMINED_COST or not search.cost.space.sized:
        return answer
    given, cost = search.cost.space, search.cost
    first = answer, search.sharpest
    for left in range(MOST_CORRECTIONS, -1, -1):
        cost.converge(answer.stage.x)
        check = check_consistency(cost, answer.stage.x)
        best = _best_correction(search, answer, check) if left else None
        if best is not None:
            cost.space, search.sharpest, answer = best.space, best.sharpest, best.answer
        elif left and cost.space is not given and np.linalg.norm(check.step) > LARGEST_LAST_STEP_PX:
            again = search.search(answer.stage.x + check.step)
            answer = replace(again, stage=join_runs(answer.stage, again.stage))
        else:
            break
    unexplained = answer.result.cost > max(LARGEST_STILL_COST, LARGEST_COST_RATIO * first[0].result.cost)
    if unexplained and cost.space is not given:  # another trouble, such as a rotating camera, which is tried later
        cost.space, (answer, search.sharpest) = given, first
        cost.converge(answer.stage.x)
        check = check_consistency(cost, answer.stage.x)
    answer = _final(search, answer, check)
    notes = (*_corrections(given, search.cost.space, answer), *check.warnings())
    return replace(answer, result=replace(answer.result, warnings=notes))


def _best_correction(search: AnswerSearch, answer: Answer, check: Consistency) -> _Corrected | None:
    """Return the best answer with one of the likeliest causes corrected; None if none lowers the cost."""
    rivals = [f for f in check.findings if f.gain >= RIVAL_SHARE * check.findings[0].gain]
    if not rivals:
        return None
    v = answer.stage.x
    here = _comparable_cost(search, v)
    tried = [t for t in (_corrected(search, finding, v) for finding in rivals) if _significant(t)]
    if not tried:
        return None
    limit = min(min(t.cost for t in tried), here)
    limit += TIE_SHARE * (here - limit)
    return next((t for t in sorted(tried, key=lambda t: t.cause.rank) if t.cost < here and t.cost <= limit), None)


def _corrected(search: AnswerSearch, finding: Finding, v: NDArray[np.float64]) -> _Corrected:
    """Return the answer with a cause corrected. The search's space stays."""
    cost, space, sharpest, cause = search.cost, search.cost.space, search.sharpest, finding.cause
    cost.space, _ = with_cause(space, cause, space.to_values(v))
    if cause.names == (FLAT_SIDE,):
        search.sharpest = turned(space, sharpest)
    answer = search.search(finding.start)
    found = _Corrected(cause, answer, _comparable_cost(search, answer.stage.x), cost.space, search.sharpest)
    cost.space, search.sharpest = space, sharpest
    return found


def _significant(found: _Corrected) -> bool:
    """Return whether a corrected parameter differs significantly from the given one. A turned prism always does."""
    result, start = found.answer.result, found.space.start
    names = [n for n in found.cause.names if n != FLAT_SIDE]
    return not names or any(abs(result.parameters[n] - start[n]) >= SIGNIFICANT * result.uncertainty[n] for n in names)


def _comparable_cost(search: AnswerSearch, v: NDArray[np.float64]) -> float:
    """Return the cost at ``v`` with a new map: a map that was improved for longer has another cost."""
    cost = search.cost
    present = cost.brightness.copy_unknowns()
    cost.renew(v)
    cost.residuals(v, rounds=2, steps=2 * cost.steps)
    mean = cost.mean()
    cost.replace_map(present)
    return mean


def _final(search: AnswerSearch, answer: Answer, check: Consistency) -> Answer:
    """Return the answer with the last step added, its whole uncertainty and the judgement of its consistency."""
    result, v, space = answer.result, answer.stage.x, search.cost.space
    timing = np.zeros(len(v))
    timing[: len(search.timing)] = TIMING_SHARE * search.timing
    systematic = check.systematic + np.outer(check.step, check.step) + np.outer(timing, timing)
    if np.linalg.norm(check.step) <= LARGEST_LAST_STEP_PX:
        v = v + check.step
    result = replace(
        result, parameters=space.to_values(v),
        uncertainty=space.deviations(v, answer.covariance + systematic), rotation_gain=check.rotation_gain,
        center_px=check.center_px,
    )  # fmt: skip
    accepted, reason = judge_consistency(check.inconsistent_px(), check.likeliest())
    if result.accepted and not accepted:
        result = replace(result, accepted=False, verdict=reason)
    return replace(answer, result=result)


def _corrections(given: ParameterSpace, space: ParameterSpace, answer: Answer) -> list[str]:
    """Return a sentence for each correction of the given camera and prism."""
    found, std = answer.result.parameters, answer.result.uncertainty
    out = []
    if space.prism.flat_side is not given.prism.flat_side:
        out.append(
            f"the events show that the flat face of the prism points to the {space.prism.flat_side.value}, not to the "
            f"{given.prism.flat_side.value}: the calibration uses this side"
        )
    for name in space.names:
        if name not in given.names:
            scale, unit = (math.degrees(1.0), "deg") if name.startswith("tilt") else (1.0, "px")
            unit = "" if name == "k1" else f" {unit}"
            was, now, by = (scale * x for x in (space.start[name], found[name], std[name]))
            remedy = "; calibrate the lens" if name in LENS else ""
            out.append(
                f"the events contradict {name} = {was:.5g}{unit}: it was corrected to {now:.5g} ± {by:.2g}{unit}"
                f"{remedy}"
            )
    return out


LARGEST_FINE_COST = 0.3
"""Largest cost, relative to that without a map, for which a map has more than one node per pixel along each axis. Where
half of the events are noise, a finer map follows them, and orbits come out too small."""


@dataclass(frozen=True)
class _Equations:
    """Equations of the stage: pairs of events, a map, and the search on it."""

    pairs: PairSet
    cost_on: Callable[[Tiles, ParameterSpace], Cost]
    """Function that returns a cost with a new map on tiles, solved at the sharpness stage's result."""
    answers: AnswerSearch
    start: NDArray[np.float64]
    """Search vector of the sharpness stage's result."""
    held: tuple[str, ...]
    """Free parameters that the events do not determine."""

    def coarse(self) -> AnswerSearch:
        """Return the search on a new map with one node per pixel."""
        cost = self.answers.cost
        return replace(self.answers, cost=self.cost_on(cost.brightness.tiles.at_density(1.0), cost.space))


def refine(
    recording: Recording,
    search: Search,
    linear: tuple[str, ...],
    *,
    ahead: EventsAhead | None = None,
    progress: Progress | None = None,
    meanwhile: Iterator[None] | None = None,
) -> tuple[PhotometricSummary, StageSummary, ParameterSpace]:
    """Run the photometric stage, which starts at the result of the sharpness stage.

    ``linear`` names the free ones of ``off_ratio`` and ``leak``. ``ahead``: events already on the device, of
    :func:`upload_ahead`. Some steps of ``meanwhile`` are taken while a GPU works. Return the result, the summary of the
    search, and the space of the result, whose camera and prism are corrected. Raises :class:`AmiwarpError` for too few
    pairs.
    """

    def report(share: float) -> None:
        if progress is not None:
            progress(*stage_share(search.settings, "photometric", share))

    def equations(sensor: SensorTiming) -> _Equations:
        settings = replace(search.settings.photometric, sensor=sensor)
        collected = collect_pairs(recording, search, settings, ahead)
        return _equations(recording, search, linear, settings, collected, report, meanwhile)

    given = search.settings.photometric.sensor
    found = equations(given)
    answer = found.answers.search(found.start)
    rpm, sensor, time_constant = search.calibration_events.encoder.rpm, given, 0.0
    rad_per_us, direction = abs(rpm) * math.tau / 60e6, math.copysign(1.0, rpm)
    if timing_can_be_found(answer, found.answers.cost) and rpm:
        v = answer.stage.x
        pause, lag = timing_steps(found.answers.cost, v, direction)
        if pause and not given.refractory_us:
            turn = find_refractory(found.coarse(), v, pause, direction)
            sensor = replace(given, refractory_us=turn / rad_per_us)
            found = equations(sensor)
            answer = found.answers.search(found.start)
            _, lag = timing_steps(found.answers.cost, answer.stage.x, direction)
        if lag:
            answer, turn = _with_slow_pixels(found, answer, lag, direction)
            time_constant = turn / rad_per_us
        if len(v) == len(answer.stage.x):
            found.answers.timing = answer.stage.x - v
    answers = found.answers
    answer = checked(answers, answer)
    accepted, reason = judge_lag(time_constant * rad_per_us)
    if answer.result.accepted and not accepted:
        answer = replace(answer, result=replace(answer.result, accepted=False, verdict=reason))
    notes = (*timing_notes(sensor.refractory_us - given.refractory_us, time_constant), *answer.result.warnings)
    result = replace(
        answer.result, sharpness_parameters=answers.sharpest, pairs=len(found.pairs), held=found.held, warnings=notes,
        refractory_us=sensor.refractory_us, time_constant_us=time_constant,
    )  # fmt: skip
    space = answers.cost.space
    values = map(space.to_values, answer.stage.points)
    return result, StageSummary.of("photometric", answer.stage, space.names, values), space


def _with_slow_pixels(found: _Equations, answer: Answer, first: float, direction: float) -> tuple[Answer, float]:
    """Return the answer for pixels with slow photoreceptors, and the angle per time constant [rad]; 0 if it fails.

    ``first`` is a first estimate of that angle. The search of ``found`` has a new map then.
    """
    answers, v = found.answers, answer.stage.x
    found.pairs.clear_lags()
    turn = find_time_constant(found.coarse(), v, first, direction)
    answers.cost = found.cost_on(answers.cost.brightness.tiles, answers.cost.space)
    again = answers.search(v)
    return replace(again, stage=join_runs(answer.stage, again.stage)), turn


def _equations(
    recording: Recording,
    search: Search,
    linear: tuple[str, ...],
    settings: PhotometricSettings,
    collected: tuple[PairSet, Tiles],
    report: Callable[[float], None],
    meanwhile: Iterator[None] | None,
) -> _Equations:
    """Return the equations of ``collected`` pairs. Raises :class:`AmiwarpError` for too few pairs."""
    pairs, tiles = collected
    full = search.full_space
    space = full.holding({n: x for n, x in search.best.items() if n not in full.names})
    # the count of OFF and ON events gives the ratio of thresholds only if brightness returns after a whole turn
    duration_us = recording.events.t_last - recording.events.t_first
    whole_turn = abs(search.calibration_events.encoder.rpm) * duration_us >= 60e6
    excess = off_excess(pairs, with_leak="leak" in linear) if whole_turn else 0.0

    def cost_on(tiles: Tiles, space: ParameterSpace = space) -> Cost:
        brightness = BrightnessMap(
            pairs, tiles, off_excess=None if "off_ratio" in linear else excess, with_leak="leak" in linear,
            middle_us=space.middle_us,
        )  # fmt: skip
        cost = Cost(space, brightness, settings.steps, meanwhile)
        cost.warm_up(space.to_vector({**space.start, **search.best}))
        return cost

    v = space.to_vector({**space.start, **search.best})
    cost = cost_on(tiles)
    mean, coverage = cost.start_mean(), cost.brightness.coverage(cost.scale)
    few = not fine_map_is_determined(coverage, len(pairs))
    noisy = mean() > LARGEST_FINE_COST
    # a fine map converges too slowly for parameters that make nearly the same motion
    if tiles.density > 1.0 and (few or noisy or like_size(space.names)):
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
    return _Equations(pairs, cost_on, AnswerSearch(cost, dict(search.best), left, settings, report), v, held)
