"""Steps of the photometric stage about what a map cannot explain: moving parts of the view, and lost events."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.answers import is_accepted
from amiwarp.calib.photometric.cauchy import cauchy_costs
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.findings import MissingEvents, MovingParts, Silence
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.tiles import GRID
from amiwarp.optics.models import MODELS

SAMPLED_PAIRS = 1 << 15
"""Number of pairs whose residuals tell whether events are missing, or what moves."""
DOUBLE_STEP, LEAST_DOUBLE_SHARE = -0.5, 0.02
"""Residual below which brightness changed by more than one threshold [thresholds], and share of such pairs from which
on events are missing. It is 0.004 at most if half of the events are noise, and 0.045 or more if a fifth are lost."""
LEAST_PARTS = 0.2
"""Smallest share of the pairs that the still parts of the image must hold, and that the moving parts must hold, before
something is said to move. One part of the 4 x 3 grid holds less."""


def give_up_a_worse_answer(state: Refinement) -> Refinement:
    """End if the answer is refused and costs more than an answer that is of use."""
    too_high = state.answer.cost > state.problem.most_cost
    return state.ending() if too_high and not is_accepted(state.answer) else state


def refuse_moving_parts(state: Refinement) -> Refinement:
    """End if something moves in one part of the view while another part is still."""
    if state.answer.cost <= min(limits.LARGEST_STILL_COST, state.problem.most_cost):
        return state
    parts = moving_parts(state.search.cost)
    return state.noticing(MovingParts(parts)).ending() if parts else state


def see_what_can_be_examined(state: Refinement) -> Refinement:
    """Note whether the events tell errors of their angles, and how far brightness changes between them."""
    cost = state.search.cost
    space = state.space
    drifts = bool(cost.brightness.pairs.arrays.slope.shape[0])
    is_explained = state.answer.cost <= limits.LARGEST_EXAMINED_COST
    turns = bool(state.problem.rpm)
    if not (turns and space.sized and is_explained) or space.moving or drifts:
        return state
    state = replace(state, are_angles_examined=True)
    if MODELS[space.model].ANGLES > 1:
        return state
    return replace(state, is_timing_examined=True, missing_step=missing_step(cost))


def count_lost_events(state: Refinement) -> Refinement:
    """Note how many events are missing, for a while or between others."""
    state = state.noticing(Silence(state.equations.silent_share))
    return state.noticing(MissingEvents(state.missing_step)) if state.is_timing_examined else state


def moving_parts(cost: Cost) -> tuple[tuple[bool, ...], ...]:
    """Return for each part of the image, row by row, whether the scene is not still there; empty if there are no such.

    A map explains the events of a still part as well as those of a still scene, and hardly any of a moving one. If the
    camera turns, all parts move.
    """
    if cost.space.moving:
        return ()
    pairs = cost.brightness.pairs
    camera = cost.space.camera
    columns, rows = GRID
    some = slice(None, len(pairs), max(1, len(pairs) // SAMPLED_PAIRS))
    costs = cauchy_costs(cost.brightness.residuals.values[some].numpy(), cost.scale)
    x = pairs.arrays.x[some].numpy().astype(int)
    y = pairs.arrays.y[some].numpy().astype(int)
    part = y * rows // camera.height * columns + x * columns // camera.width
    number = np.bincount(part, minlength=rows * columns)
    mean = np.bincount(part, costs, rows * columns) / np.maximum(number, 1)
    still = (mean < limits.LARGEST_STILL_COST) & (number > 0)
    moving = mean > limits.LARGEST_EXAMINED_COST
    if min(number[still].sum(), number[moving].sum()) < LEAST_PARTS * number.sum():
        return ()
    return tuple(tuple(row) for row in (~still).reshape(rows, columns).tolist())


def missing_step(cost: Cost) -> float:
    """Return by how much the map's change between the events of a pair differs from one threshold [thresholds].

    It is the median over pairs; 0 if no events are missing.
    """
    pairs = cost.brightness.pairs
    every = max(1, len(pairs) // SAMPLED_PAIRS)
    change = cost.brightness.residuals.values[: len(pairs) : every].numpy()
    on = pairs.arrays.on[: len(pairs) : every].numpy() & 1
    return step_if_missing(np.where(on, change, -change)[np.isfinite(change)])


def step_if_missing(residuals: NDArray[np.floating[Any]]) -> float:
    """Return the median of residuals in the direction of their events [thresholds]; 0 if no events are missing.

    Noise raises the median too: between a noise event and the one before it, brightness changes by less than one
    threshold, which leaves a residual above 0. Where an event between them is missing, brightness changes by two
    thresholds, which leaves a residual near -1. Noise leaves none.
    """
    if not len(residuals) or float(np.mean(residuals < DOUBLE_STEP)) < LEAST_DOUBLE_SHARE:
        return 0.0
    return float(np.median(residuals))
