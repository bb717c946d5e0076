"""Steps of the photometric stage that correct the given camera and prism where the events contradict them.

A correction is kept if it lowers the cost. The last of the steps judges whether the answer holds everywhere, and adds
the systematic part of its uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.answers import Answer, AnswerSearch, is_accepted, join_runs
from amiwarp.calib.photometric.causes import FLAT_SIDE, UNEVEN, SuspectedError
from amiwarp.calib.photometric.consistency import Consistency, LikelyCause, check_consistency
from amiwarp.calib.photometric.distances import distance, stated_px
from amiwarp.calib.photometric.findings import (
    Finding,
    FlatSideCorrected,
    LensBeyondCorrection,
    MotionError,
    ParameterCorrected,
    RivalCauses,
    Shake,
    StatedError,
)
from amiwarp.calib.photometric.linear_fit import SIGNIFICANT
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.stated_errors import BOUND, motion_slopes, shift_px, spread_px
from amiwarp.calib.photometric.systematic import LEAST_STD_PX
from amiwarp.calib.sharpness_search import LEAST_INSIDE_PX
from amiwarp.optics.camera import LENS
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.prism import as_wedge
from amiwarp.results.parameters import ParameterSpace

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

MOST_CORRECTIONS = 4
"""Largest number of corrections, and of searches that continue an unfinished one."""
RIVAL_SHARE = 0.75
"""A cause is tried if it removes at least this share of the residual that the likeliest one removes."""
TIE_SHARE = 0.04
"""Of the tried causes, the first one counts whose cost is at most this share of the gain above the lowest cost."""
GIVEN_SHARE = 0.15
"""The same share for what was given, the camera and the flat side: it is likelier wrong than the prism's shape, whose
two free numbers follow the noise too."""
TIMING_SHARE = 0.3
"""Systematic standard deviation of the answer if the sensor's timing was corrected: a share of the correction. The
thresholds, which turn the map's brightness into light, are not known."""
NOISE = "noise, or what else no map explains"
"""Words of what could hide in the residual that remains."""
NOISE_PX = 0.15
"""Bound of the error by it [px per cost]. Events of noise lie anywhere, so that they make every motion seem smaller. At
a cost of 0.25, the amplitudes of a mirror were 0.03 px too small, and the motion was 0.038 px off."""
RIVAL_STD = 0.5
"""Systematic standard deviation of an answer with a rival explanation: a share of the difference of their answers."""
LARGE_PART = 0.5
"""Share of the largest part of a stated error above which another part is named too."""
SAME_COST = 1.05
"""Largest ratio of the costs of two answers that count as equal. Two maps of the same scene differ by less."""
LARGEST_LAST_STEP_PX = 0.01
"""Longest step that is added to the answer without a new search [px]."""


@dataclass(frozen=True)
class Corrected:
    """Answer after the correction of a cause."""

    cause: SuspectedError
    search: AnswerSearch
    """Search in the corrected space, on the map that all explanations share."""
    answer: Answer
    cost: float
    """Cost with a new map, which compares with the cost of other answers."""
    rivals: tuple[Corrected, ...] = ()
    """Other corrections that explain the events as well."""

    @property
    def space(self) -> ParameterSpace:
        """The corrected space."""
        return self.search.space

    def distance_px(self, other: Corrected) -> float:
        """Return how far the models of two corrections are apart [px rms]."""
        here, there = (
            each.space.build(each.space.to_values(each.answer.x)) for each in (self, other)
        )
        return distance(here, there)


def correct_camera_and_prism(given: Refinement) -> Refinement:
    """Correct the likeliest cause of what the answer leaves, and look again, until nothing is left to correct.

    All is taken back if the events stay unexplained: there is another trouble then, such as a rotating camera, which is
    tried later. In much noise, they stay so after the right correction too, but nothing is left that a check sees.
    """
    if given.answer.cost > limits.LARGEST_EXAMINED_COST or not given.space.sized:
        return given
    if given.space.depths is not None:  # they must be found anew for another lens
        return _checked(given)
    state = given
    tied: list[tuple[Corrected, Corrected]] = []
    for left in range(MOST_CORRECTIONS, -1, -1):
        state = _checked(state)
        assert state.check is not None
        if state.check.shake_px:
            return replace(state, check=None).noticing(Shake(state.check.shake_px))
        best = _best_correction(state) if left else None
        step = state.check.step
        if best is not None:
            # the same map, but what was known about it belongs to another space
            state = replace(state, search=best.search.in_space(best.space), answer=best.answer)
            tied += [(best, rival) for rival in best.rivals]
            refused_lens = _lens_beyond_correction(given.space, state)
            if refused_lens is not None:
                return replace(state, check=None).noticing(refused_lens)
        elif (
            left and state.space is not given.space and np.linalg.norm(step) > LARGEST_LAST_STEP_PX
        ):
            again = state.search.search(state.answer.x + step)
            if again.cost > SAME_COST * state.answer.cost:
                state.search.cost.converge(state.answer.x)
                break
            state = replace(
                state, answer=replace(again, stage=join_runs(state.answer.stage, again.stage))
            )
        else:
            break
    unexplained = state.answer.cost > max(
        limits.LARGEST_STILL_COST, limits.LARGEST_COST_RATIO * given.answer.cost
    )
    if unexplained and state.space is not given.space and not _is_consistent(state):
        return _checked(given)
    return _with_corrections(given.space, state, tied)


def _is_consistent(state: Refinement) -> bool:
    """Return whether the check of an answer sees no cause and no rotation of the camera in what is left."""
    check = state.check
    if check is None:
        return False
    return not check.likely and check.rotation_gain <= limits.LARGEST_ROTATION_GAIN


def _checked(state: Refinement) -> Refinement:
    """Return the state with a check of its answer."""
    state.search.cost.converge(state.answer.x)
    return replace(state, check=check_consistency(state.search.cost, state.answer.x))


def _with_corrections(
    given: ParameterSpace, state: Refinement, tied: Sequence[tuple[Corrected, Corrected]]
) -> Refinement:
    """Return the state with what was taken, and which other explanations are as good."""
    freed = set(state.space.names)
    # an explanation that was corrected later too is no rival: the answer is their joint one
    rivals = [(best, rival) for best, rival in tied if not freed >= {*rival.cause.names}]
    n = len(given.names)
    apart = [
        rival.answer.x[:n] - best.answer.x[:n]
        for best, rival in rivals
        if as_wedge(best.space.prism).flat_side is as_wedge(rival.space.prism).flat_side
    ]
    findings = [
        RivalCauses(best.cause, rival.cause, best.distance_px(rival)) for best, rival in rivals
    ]
    return replace(state, given_space=given, apart=tuple(apart)).noticing(*findings)


def _best_correction(state: Refinement) -> Corrected | None:
    """Return the best answer with a likely cause corrected, and its rivals; None if none lowers the cost."""
    assert state.check is not None
    causes = state.check.likely
    likely = [each for each in causes if each.gain >= RIVAL_SHARE * causes[0].gain]
    if not likely:
        return None
    here = _comparable_cost(state.search, state.answer.x)
    found: list[Corrected] = []
    for each in likely:
        # a cause that cannot come near the cost of another one on the same map is given up
        least = min((other.answer.cost for other in found), default=math.inf)
        most_cost = least + GIVEN_SHARE * max(0.0, state.answer.cost - least)
        corrected = _corrected(state, each, most_cost)
        if corrected is not None:
            found.append(corrected)
    tried = [each for each in found if _is_significant(each) and each.cost < here]
    if not tried:
        return None

    def near_best(among: list[Corrected], share: float) -> float:
        least = min(each.cost for each in among)
        return least + share * (here - least)

    of_given = [each for each in tried if each.cause not in UNEVEN]
    if of_given and min(each.cost for each in of_given) <= near_best(tried, GIVEN_SHARE):
        tried = of_given
    good = [each for each in tried if each.cost <= near_best(tried, TIE_SHARE)]
    best, *rivals = sorted(good, key=lambda each: each.cause.rank)
    return replace(best, rivals=tuple(rivals))


def _corrected(state: Refinement, likely: LikelyCause, most_cost: float) -> Corrected | None:
    """Return the answer with a cause corrected, or None if it costs far more than ``most_cost``."""
    search = state.search.with_cause(likely.cause, state.answer.x)
    stage = search.descend(likely.start, most_cost)
    if not -stage.score <= SAME_COST * most_cost:
        return None
    answer = search.search_on(stage)
    return Corrected(likely.cause, search, answer, _comparable_cost(search, answer.x))


def _is_significant(found: Corrected) -> bool:
    """Return whether a corrected parameter differs significantly from the given one. A turned prism always does."""
    start = found.space.start
    answer = found.answer
    names = [n for n in found.cause.names if n != FLAT_SIDE]
    return not names or any(
        abs(answer.parameters[n] - start[n]) >= SIGNIFICANT * answer.uncertainty[n] for n in names
    )


def _comparable_cost(search: AnswerSearch, v: Vector) -> float:
    """Return the cost at ``v`` with a new map: a map that was improved for longer has another cost."""
    cost = search.cost
    present = cost.brightness.copy_unknowns()
    cost.renew(v)
    cost.residuals(v, rounds=2, steps=2 * cost.steps)
    mean = cost.mean()
    cost.replace_map(present)
    return mean


def _lens_beyond_correction(
    given: ParameterSpace, state: Refinement
) -> LensBeyondCorrection | None:
    """Return the lens of an answer whose correction is too large to be believed; None if it is not."""
    space = state.space
    answer = state.answer
    low, high = space.bounds()
    inside = np.minimum(answer.x - low, high - answer.x).tolist()
    lens = {
        n: x for n, x in zip(space.names, inside, strict=True) if n in LENS and n not in given.names
    }
    if not lens:
        return None
    unfinished = answer.stage.ended == "budget" and not is_accepted(answer)
    if not (unfinished or min(lens.values()) < LEAST_INSIDE_PX or limits.is_far(answer.moved_px)):
        return None
    return LensBeyondCorrection({name: answer.parameters[name] for name in lens})


def judge_the_consistency(state: Refinement) -> Refinement:
    """Add the last step to the answer, and all systematic errors to its uncertainty; note where it does not hold."""
    check = state.check
    if check is None:
        return state
    space = state.space
    v = state.answer.x
    timing = _padded(TIMING_SHARE * state.timing, len(v))
    doubt = _padded(state.doubt, len(v))
    systematic = (
        check.systematic
        + np.outer(check.step, check.step)
        + np.outer(timing, timing)
        + np.outer(doubt, doubt)
    )
    for change in state.apart:
        systematic[: len(change), : len(change)] += RIVAL_STD**2 * np.outer(change, change)
    if np.linalg.norm(check.step) <= LARGEST_LAST_STEP_PX:
        v = v + check.step
    covariance = state.answer.covariance + systematic
    answer = replace(
        state.answer, parameters=space.to_values(v), uncertainty=space.deviations(v, covariance)
    )
    state = replace(state, answer=answer).noticing(check, motion_error(state, check, v))
    # an answer with a free speed is found again at that speed
    if MODELS[space.model].PRISM or "rpm" in space.names:
        return state
    error_px = stated_px(space, v, covariance)
    if error_px < limits.NOTABLE_STATED_PX:
        return state.noticing(StatedError(error_px, ()))
    covariances = {
        "thresholds": check.of_map,
        "refractory": np.outer(doubt, doubt),
        "events": state.answer.covariance,
    }
    parts_px = {name: stated_px(space, v, part) for name, part in covariances.items()}
    least_px = LARGE_PART * max(parts_px.values())
    large = tuple(name for name, px in parts_px.items() if px >= least_px)
    return state.noticing(StatedError(error_px, large))


def motion_error(state: Refinement, check: Consistency, v: Vector) -> MotionError:
    """Return what is stated of the error of the motion of an answer with a search vector.

    A doubt about the refractory period is no scatter: it is one of the causes that could hide.
    """
    n = len(v)
    timing = _padded(TIMING_SHARE * state.timing, n)
    covariance = (
        state.answer.covariance
        + check.method
        + np.outer(check.step, check.step)
        + np.outer(timing, timing)
    )
    for change in state.apart:
        covariance[: len(change), : len(change)] += RIVAL_STD**2 * np.outer(change, change)
    slopes = motion_slopes(state.space, v)
    hidden = {**check.hidden_px, NOISE: NOISE_PX * state.answer.cost}
    doubt_px = BOUND * shift_px(slopes, _padded(state.doubt, n))
    if doubt_px > 0.0:
        hidden["the refractory period"] = doubt_px
    # the least error counts once for the motion, not for each parameter: a mirror has eight
    return MotionError(math.hypot(spread_px(slopes, covariance), LEAST_STD_PX), hidden)


def name_the_corrections(state: Refinement) -> Refinement:
    """Note each correction of the given camera and prism."""
    given = state.given_space
    if given is None:
        return state
    space = state.space
    answer = state.answer
    findings: list[Finding] = []
    if space.prism is not given.prism:  # only a prism is turned
        side = as_wedge(space.prism).flat_side
        given_side = as_wedge(given.prism).flat_side
        if side is not given_side:
            findings.append(FlatSideCorrected(given_side, side))
    for name in space.names:
        if name not in given.names:
            found = answer.parameters[name]
            findings.append(
                ParameterCorrected(name, space.start[name], found, answer.uncertainty[name])
            )
    return state.noticing(*findings)


def _padded(change: Vector, count: int) -> Vector:
    """Return a change of the first parameters, with 0 for the others, shape (count,)."""
    padded = np.zeros(count)
    padded[: len(change)] = change
    return padded
