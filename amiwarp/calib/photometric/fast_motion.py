"""Step of the photometric stage for a vibration or a mirror, whose image moves so fast that pixels miss events."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.derivatives import by_wave_of_angle, slopes
from amiwarp.calib.photometric.distances import distance, fastest_px_per_rad, px_per_rad
from amiwarp.calib.photometric.findings import BlindTime, RefractoryDoubt, UnsteadySpeed
from amiwarp.calib.photometric.limits import REFRACTORY_DOUBT_US
from amiwarp.calib.photometric.linear_fit import SIGNIFICANT, linear_fit, pseudo_inverse
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.verdicts import refractory_doubt_us
from amiwarp.optics.models.registry import MODELS

if TYPE_CHECKING:
    Vector = NDArray[np.float64]


def bound_what_blind_pixels_hide(state: Refinement) -> Refinement:
    """Note how far the image moves while a pixel is blind, and how much an error of that time changes the answer."""
    kind = MODELS[state.space.model]
    has_angles = state.are_angles_examined or kind.ANGLES > 1
    if not has_angles:
        return state
    problem = state.problem
    cost = state.search.cost
    v = state.answer.x
    cost.converge(v)
    if problem.recording.encoder is None:
        moved_px = change_of_speed_px(cost, v)
        state = state.noticing(UnsteadySpeed(moved_px))

    std_us = refractory_doubt_us(state.sensor)
    doubt = np.zeros(0)
    if std_us > 0.0:
        std_rad = problem.direction * problem.rad_per_us * std_us
        doubt = std_rad * by_refractory(cost, v)

    blind_us = state.sensor.refractory_us
    if blind_us is None:
        blind_us = REFRACTORY_DOUBT_US
    blind_rad = problem.rad_per_us * blind_us
    moved_px = fastest_px_per_rad(state.space, v) * blind_rad
    finding = BlindTime(moved_px, state.sensor)
    return replace(state, doubt=doubt).noticing(finding)


def weigh_the_refractory_doubt(state: Refinement) -> Refinement:
    """Note how far the answer moves by the doubt about the refractory period."""
    if not len(state.doubt):
        return state
    space = state.space
    v = state.answer.x
    doubt = np.zeros(len(v))
    doubt[: len(state.doubt)] = state.doubt
    moved = space.build(space.to_values(v + doubt))
    here = space.build(space.to_values(v))
    moved_px = distance(moved, here)
    return state.noticing(RefractoryDoubt(state.sensor, moved_px))


def by_refractory(cost: Cost, best: Vector) -> Vector:
    """Return the change of the answer ``best`` [px] per angle by which what moves turns in the refractory period [rad].

    The period sets the reference of a pair, its first event, later. The map must be solved at ``best``.
    """
    columns = slopes(cost, cost.space, best, cost.space.names)
    columns["refractory"], _ = cost.by_angle(best)
    fit = linear_fit(cost, columns)
    hessian = fit.hessian.sum(axis=0)
    of_parameters = hessian[:-1, :-1]
    by_period = hessian[:-1, -1]
    return np.asarray(-pseudo_inverse(of_parameters) @ by_period)


def change_of_speed_px(cost: Cost, best: Vector) -> float:
    """Return how far a steady change of the speed over the recording moves events [px rms]; 0 if not significant.

    It is the estimate of a linearised fit, which finds a share of the change only. The map must be solved at ``best``.
    """
    times = cost.brightness.pairs.time.astype(np.float64)
    late = (times - times.mean()) / max(float(times.std()), 1e-9)
    square = late**2 - np.mean(late**2)
    names = cost.space.names
    columns = slopes(cost, cost.space, best, names)
    columns["late"] = by_wave_of_angle(cost, best, late)
    columns["square"] = by_wave_of_angle(cost, best, square)
    fit = linear_fit(cost, columns)
    estimate, significance, _ = fit.adding((*names, "late"), ("square",))
    if significance < SIGNIFICANT:
        return 0.0
    change = abs(float(estimate.change[-1]))
    return px_per_rad(cost.space, best) * change * float(square.std())
