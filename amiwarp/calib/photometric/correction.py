"""Correction of the given camera and prism where the events contradict them, and the last judgement of the answer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.parameters import LENS
from amiwarp.calib.photometric.acceptance import (
    LARGEST_COST_RATIO,
    LARGEST_EXAMINED_COST,
    LARGEST_STILL_COST,
    judge_consistency,
)
from amiwarp.calib.photometric.answer_search import join_runs
from amiwarp.calib.photometric.causes import FLAT_SIDE, turned, with_cause
from amiwarp.calib.photometric.consistency import SIGNIFICANT, Consistency, check_consistency

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.photometric.answer_search import Answer, AnswerSearch
    from amiwarp.calib.photometric.causes import Cause
    from amiwarp.calib.photometric.consistency import Finding

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
