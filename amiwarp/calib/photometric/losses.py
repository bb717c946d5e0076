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
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.prism import Plate

SAMPLED_PAIRS = 1 << 15
"""Number of pairs whose residuals tell whether events are missing, or what moves."""
DOUBLE_STEP = -0.5
LEAST_DOUBLE_SHARE = 0.02
"""Residual below which brightness changed by more than one threshold [thresholds], and share of such pairs from which
on events are missing. It is 0.004 at most if half of the events are noise, and 0.045 or more if a fifth are lost."""
LEAST_PARTS = 0.2
"""Smallest share of the pairs that the still parts of the image must hold, and that the moving parts must hold, before
something is said to move. One part of the 4 x 3 grid holds less."""


def give_up_a_worse_answer(state: Refinement) -> Refinement:
    """End if the answer is refused and costs more than an answer that is of use."""
    too_high = state.answer.cost > state.problem.most_cost
    if too_high and not is_accepted(state.answer):
        return state.ending()
    return state


def refuse_moving_parts(state: Refinement) -> Refinement:
    """End if something moves in one part of the view while another part is still."""
    if state.answer.cost <= min(limits.LARGEST_STILL_COST, state.problem.most_cost):
        return state
    parts = moving_parts(state.search.cost)
    if not parts:
        return state
    return state.noticing(MovingParts(parts)).ending()


def see_what_can_be_examined(state: Refinement) -> Refinement:
    """Note whether the events tell errors of their angles, and how far brightness changes between them."""
    cost = state.search.cost
    space = state.space
    is_explained = state.answer.cost <= limits.LARGEST_EXAMINED_COST
    turns = bool(state.problem.rpm)
    if not (turns and space.sized and is_explained):
        return state

    # Next to a free speed or clock offset, or a moving camera, the events do not tell errors of the angles.
    drifts = bool(cost.brightness.pairs.arrays.slope.shape[0])
    if space.moving or drifts:
        return state
    state = replace(state, are_angles_examined=True)
    kind = MODELS[space.model]
    if kind.ANGLES > 1 or kind.GLASS is Plate:  # the phase of a plate is found without the timing
        return state
    return replace(state, is_timing_examined=True, missing_step=missing_step(cost))


def count_lost_events(state: Refinement) -> Refinement:
    """Note how many events are missing, for a while or between others."""
    state = state.noticing(Silence(state.equations.silent_share))
    if not state.is_timing_examined:
        return state
    return state.noticing(MissingEvents(state.missing_step))


def moving_parts(cost: Cost) -> tuple[tuple[bool, ...], ...]:
    """Return for each part of the image, row by row, whether the scene is not still there; empty if there are no such.

    A map explains the events of a still part as well as the events of a still scene, and hardly any of a moving one.
    If the camera turns, all parts move.
    """
    if cost.space.moving:
        return ()
    pairs = cost.brightness.pairs
    camera = cost.space.camera
    columns, rows = GRID

    # The mean cost in each part of the image, from some of the pairs.
    some = _some_pairs(cost)
    residuals = cost.brightness.residuals.values[some].numpy()
    costs = cauchy_costs(residuals, cost.scale)
    x = pairs.arrays.x[some].numpy().astype(int)
    y = pairs.arrays.y[some].numpy().astype(int)
    row = y * rows // camera.height
    column = x * columns // camera.width
    part = row * columns + column
    number = np.bincount(part, minlength=rows * columns)
    total = np.bincount(part, costs, rows * columns)
    mean = total / np.maximum(number, 1)

    still = (mean < limits.LARGEST_STILL_COST) & (number > 0)
    moving = mean > limits.LARGEST_EXAMINED_COST
    least = LEAST_PARTS * number.sum()
    if number[still].sum() < least or number[moving].sum() < least:
        return ()
    not_still = (~still).reshape(rows, columns)
    return tuple(tuple(row) for row in not_still.tolist())


def _some_pairs(cost: Cost) -> slice:
    """Return which pairs tell whether events are missing, or what moves."""
    pairs = len(cost.brightness.pairs)
    every = max(1, pairs // SAMPLED_PAIRS)
    return slice(None, pairs, every)


def missing_step(cost: Cost) -> float:
    """Return by how much the map's change between the events of a pair differs from one threshold [thresholds].

    It is the median over pairs; 0 if no events are missing.
    """
    some = _some_pairs(cost)
    change = cost.brightness.residuals.values[some].numpy()
    on = cost.brightness.pairs.arrays.on[some].numpy() & 1
    towards_event = np.where(on, change, -change)
    known = np.isfinite(change)
    return step_if_missing(towards_event[known])


def step_if_missing(residuals: NDArray[np.floating[Any]]) -> float:
    """Return the median of residuals in the direction of their events [thresholds]; 0 if no events are missing.

    Noise raises the median too: between a noise event and the one before it, brightness changes by less than one
    threshold, which leaves a residual above 0. Where an event between them is missing, brightness changes by two
    thresholds, which leaves a residual near -1. Noise leaves none.
    """
    if not len(residuals):
        return 0.0
    double_share = float(np.mean(residuals < DOUBLE_STEP))
    if double_share < LEAST_DOUBLE_SHARE:
        return 0.0
    return float(np.median(residuals))
