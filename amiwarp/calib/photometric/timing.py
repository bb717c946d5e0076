"""Steps of the photometric stage for a timing of the sensor that was not given: refractory period, and slow pixels.

Both shift the angles of the prism at which events tell the brightness. A linearised fit tells whether one of them
explains much of the residual; then it is searched for. All angles are how far the prism turns within a time.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.slow_pixels import darkness, set_lags
from amiwarp.calib.photometric.answers import AnswerSearch, join_runs
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.derivatives import shifted, slopes
from amiwarp.calib.photometric.distances import distance
from amiwarp.calib.photometric.findings import RefractoryPeriod, SlowPixels
from amiwarp.calib.photometric.linear_fit import SIGNIFICANT, linear_fit
from amiwarp.calib.photometric.one_dimension import FACTOR, bracketed, lowest
from amiwarp.calib.photometric.refinement import Refinement, first_answer
from amiwarp.calib.photometric.time_constants import find_time_constants

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

LEAST_REFRACTORY_GAIN = 0.015
"""Smallest share of the squared residuals that a refractory period must explain. Eight photographs without one explain
0.014 at most, or more with the wrong sign; 1.7 ms explain 0.017, and 3 ms 0.023 and more."""
LEAST_SLOW_GAIN = 0.03
"""Smallest share that slow photoreceptors must explain. Seven of eight photographs without them explain 0.005 at most,
but a smaller lag does less harm than its correction, whose light is estimated."""


def estimate_the_timing(state: Refinement) -> Refinement:
    """Estimate the refractory period and the time constant of slow pixels by a linearised fit."""
    if not state.is_timing_examined:
        return state
    pause, lag = timing_steps(state.search.cost, state.answer.x, state.problem.direction)
    return replace(state, pause_rad=pause, lag_rad=lag, before_timing=state.answer.x)


def find_the_refractory_period(state: Refinement) -> Refinement:
    """Search for the refractory period if events are missing right after others, and begin again with it.

    A pixel that has just fired is blind for a while. If that time is unknown, it looks like a lag that grows with the
    speed of the image.
    """
    problem = state.problem
    given = problem.settings.sensor
    if not state.pause_rad or given.refractory_us is not None:
        return state
    turn = find_refractory(
        state.on_coarse_map(),
        state.answer.x,
        first=state.pause_rad,
        direction=problem.direction,
    )
    found_us = turn / problem.rad_per_us
    # none was found is not the same as none is there
    sensor = replace(given, refractory_us=found_us or None)
    again = first_answer(problem, sensor)
    _, lag = timing_steps(again.search.cost, again.answer.x, problem.direction)
    state = replace(
        state,
        equations=again.equations,
        search=again.search,
        answer=again.answer,
        held=again.held,
        lag_rad=lag,
        timing=_change(state.before_timing, again.answer.x),
    )
    if not found_us:
        return state
    return state.noticing(RefractoryPeriod(found_us))


def find_slow_pixels(state: Refinement) -> Refinement:
    """Search for the time constant of slow pixels if the events come late where it is dark, and correct the orbit."""
    if not state.lag_rad:
        return state
    problem = state.problem
    pairs = state.equations.pairs
    v = state.answer.x
    pairs.clear_lags()
    turns, turn = find_time_constants(state.on_coarse_map(), v, state.lag_rad, problem.direction)
    if not turn:
        pairs.drop_lags()
        return state
    cost = state.equations.solved_on(state.search.cost.brightness.tiles, state.space)
    search = replace(state.search, cost=cost)
    stage = search.descend(v)
    # this map tells better than the coarse one how the output of the filters differs from the brightness
    model = cost.space.build(cost.space.to_values(stage.x))
    ahead = math.atan(problem.direction * turn)
    set_lags(cost.brightness, model, problem.direction * turns, ahead, with_offsets=True)
    cost.residuals(stage.x)
    again = search.search(stage.x)
    runs = join_runs(state.answer.stage, stage)
    answer = replace(again, stage=join_runs(runs, again.stage))

    fast = cost.space.build(cost.space.to_values(v))
    slow = cost.space.build(cost.space.to_values(answer.x))
    time_constant_us = turn / problem.rad_per_us
    lag_rad = time_constant_us * problem.rad_per_us
    state = replace(
        state,
        search=search,
        answer=answer,
        time_constant_us=time_constant_us,
        timing=_change(state.before_timing, answer.x),
    )
    moved_px = distance(fast, slow)
    return state.noticing(SlowPixels(time_constant_us, lag_rad, moved_px))


def timing_steps(cost: Cost, v: Vector, direction: float) -> tuple[float, float]:
    """Return the angles per refractory period and per time constant at median brightness [rad].

    A linearised fit at the answer ``v`` estimates each of them. An angle that is not significant is 0.
    """
    cost.converge(v)
    space = cost.space
    relative, _ = darkness(cost.brightness, space.build(space.to_values(v)))
    columns = slopes(cost, space, v, space.names)
    # the refractory period sets the reference of a pair, its first event, later
    columns["refractory"], _ = cost.by_angle(v)
    columns["slow"] = shifted(cost, v, relative)
    fit = linear_fit(cost, columns)

    def angle(name: str, sign: float) -> tuple[float, float, float]:
        estimate, significance, gain = fit.adding(space.names, (name,))
        change = sign * float(estimate.change[-1])
        return change, math.copysign(significance, change), gain

    pause, pause_significance, pause_gain = angle("refractory", direction)
    lag, lag_significance, lag_gain = angle("slow", -direction)
    is_pause = pause_significance >= SIGNIFICANT and pause_gain >= LEAST_REFRACTORY_GAIN
    if not is_pause:
        pause = 0.0
    # where the lags are long and the light of the tiles differs, they look rather like a refractory period below 0
    is_certain = max(lag_significance, -pause_significance) >= SIGNIFICANT
    is_lag = lag > 0.0 and is_certain and lag_gain >= LEAST_SLOW_GAIN
    if not is_lag:
        lag = 0.0
    return pause, lag


def find_refractory(search: AnswerSearch, v: Vector, first: float, direction: float) -> float:
    """Return the angle by which the prism turns in the refractory period, for which the cost is lowest [rad].

    The search is on a coarse map, ``v`` is the answer [px], ``first`` an estimate by a linearised fit [rad] and
    ``direction`` 1 or -1. The pairs remain unchanged.
    """
    cost = search.cost
    azimuth = cost.brightness.pairs.arrays.azimuth
    given = azimuth.numpy().copy()

    def cost_at(angle: float) -> float:
        """Return the cost if the references are ``angle`` later."""
        turned = given.reshape(4, -1).copy()
        first_events = (turned[0] + 1j * turned[1]) * np.exp(1j * direction * angle)
        turned[0] = first_events.real
        turned[1] = first_events.imag
        azimuth.assign(turned.ravel())
        cost.renew(v)
        at = search.descend(v).x
        cost.residuals(at, rounds=2, steps=2 * cost.steps)
        return cost.mean()

    try:
        angles, costs = bracketed(cost_at, [FACTOR * first, FACTOR**2 * first])
        return lowest(cost_at, angles, costs)
    finally:
        azimuth.assign(given)


def _change(before: Vector, after: Vector) -> Vector:
    """Return the change of an answer [px]; nothing if another number of parameters is determined."""
    if len(before) != len(after):
        return np.zeros(0)
    return after - before
