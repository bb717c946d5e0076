"""Calibration turn by turn, of a camera that never rests."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib import checks
from amiwarp.calib.calibrator import Attempt, Calibrator, with_warnings
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.distances import stated_px
from amiwarp.calib.photometric.pair_spans import van_der_corput
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.calibration import (
    Calibration,
)
from amiwarp.results.parameters import MOTION, RATES

WINDOW_TURNS = 1.5
"""Length of each part of the recording that gives an answer [turns]. In longer ones, the velocity is less linear. In
shorter ones, the map follows the few events, and orbits come out too large: by 0.013 px with 1.05 turns of 160×120 px,
by 0.008 px with 2.1."""
MOST_TURNS = 48
LEAST_TURNS = 16
"""Largest and smallest number of these parts, which begin one turn after another."""
MOST_GYROSCOPE_TURNS = 12
LEAST_GYROSCOPE_TURNS = 3
"""The same with a gyroscope: it tells the motion at the prism's frequency, except for translation, so that the answers
of single turns are off by 0.01 to 0.03 px only."""
LEAST_JUDGED = 8
"""Number of parts from which the recording may be given up."""
LEAST_ANSWERED = 0.75
"""Smallest share of the parts with an accepted answer."""
LARGEST_FAST_COST = 0.35
"""Largest median of the costs. It is about 0.18 for a rotation alone, and 0.27 in a street at 13 m/s."""
NEAR_OSCILLATIONS = (2, 3)
"""Numbers of oscillations over all turns whose amplitudes tell the error of the weighted mean. Slower ones change the
mean itself."""
PARALLAX_PX = 0.25
ROTATION_COST = 0.1
"""Error of size and phase that parallax leaves, however many turns are averaged [px per cost above a rotation's]. In
five worlds the error was 0.02 to 0.03 px at a cost of 0.19, and 0.03 to 0.04 at 0.26."""
CONFIRMED_PX = 0.03
LARGEST_MEAN_PX = 0.1
"""Largest distance of two answers of two turns that confirm each other where the mean of many turns is possible, and
largest stated error of that mean [px rms]."""


def turns_of(
    calibrator: Calibrator, within: tuple[int, int] | None = None, most: int | None = None
) -> list[tuple[int, int]]:
    """Return the time spans [us] of :func:`turn_by_turn`, which begin one turn after another, about the middle.

    They are at most ``most``, by default :data:`MOST_TURNS`, and within a time span [us], by default from the first to
    the last event.

    All begin at the same angle of the prism. Then a motion of any frequency but the prism's changes the answers by
    an oscillation, which a weighted mean of them removes.
    """
    source = calibrator.recording.events
    encoder = calibrator.recording.encoder
    assert encoder is not None
    if MODELS[calibrator.settings.model].ANGLES > 1 or not encoder.rpm:
        return []
    first = source.t_first
    last = source.t_last
    if within is not None:
        first = max(first, within[0])
        last = min(last, within[1])

    turn_us = 60e6 / abs(encoder.rpm)
    longest = last - first - WINDOW_TURNS * turn_us
    count = max(0, min(most or MOST_TURNS, math.floor(longest / turn_us) + 1))
    left = longest - (count - 1) * turn_us
    starts = [first + int(0.5 * left + turn_us * k) for k in range(count)]
    return [(start, start + int(WINDOW_TURNS * turn_us)) for start in starts]


def turn_by_turn(
    calibrator: Calibrator, tried: Attempt, turns: list[tuple[int, int]], how: str = ""
) -> Attempt | None:
    """Return the mean of the answers of single turns of the prism, or the error that it is too uncertain.

    None if no motion of the camera explains the events of single turns. ``turns`` are time spans [us]: at least
    :data:`LEAST_TURNS`, or with a gyroscope, whose use ``how`` tells in words, at least
    :data:`LEAST_GYROSCOPE_TURNS`.

    The camera's own motion changes the orbit by a different amount in each turn, unless it is in step with the
    prism, so the mean of these changes vanishes. Within a turn, the camera's angular velocity is taken as linear in
    time and the growth of the image as steady; the scene of each tile moves on a path beyond that.
    """
    most_cost = min(LARGEST_FAST_COST, limits.LARGEST_COST_RATIO * tried.cost)
    least_judged = min(LEAST_JUDGED, len(turns))
    single = replace(calibrator, progress=None)
    answers: dict[int, Mapping[str, float]] = {}  # not the attempts, which hold events and images
    best: Attempt | None = None
    costs: list[float] = []
    for k in van_der_corput(len(turns)):
        answer = single.turning_in(turns[k], fast=True)
        costs.append(answer.cost)
        if answer.accepted:
            answers[k] = answer.found().parameters
            best = answer if best is None or answer.cost < best.cost else best
        if calibrator.progress is not None:
            calibrator.progress("calibrating, turn by turn", len(costs) / len(turns))

        # Too few answers, or too high costs, are enough to give up.
        if len(costs) < least_judged:
            continue
        few = len(answers) < LEAST_ANSWERED * len(costs)
        if few or np.median(costs) > most_cost:
            return None

    assert best is not None
    mean, error_px = _mean(best, answers, len(turns), float(np.median(costs)))
    if error_px > LARGEST_MEAN_PX:
        name = calibrator.recording.name
        return Attempt(None, checks.scatters(name, len(answers), error_px, LARGEST_MEAN_PX))
    warning = f"the camera never rests: the answer is the mean of those of {len(answers)} turns, ± {error_px:.2f} px"
    if how:
        rates = [[found[name] for name in RATES] for found in answers.values()]
        bias = -np.degrees(np.mean(rates, axis=0))
        shown = ", ".join(f"{rate:.1f}" for rate in bias)
        warning += (
            f". The gyroscope's rotation was used: {how}. Its bias was free in each turn, in the mean {shown} "
            "deg/s about the camera's x, y, z, to which the camera's translation adds"
        )
    return Attempt(with_warnings(mean, warning))


def mean_of_turns(
    of_turns: NDArray[np.float64], share: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weighted mean of the answers of turns, shape (n,), and its covariance, shape (n, n).

    ``each`` holds their search vectors, shape (turns, n), and ``share`` their times as shares of the recording, 0 to 1.

    A camera that moves at the frequency f changes the answers by an oscillation at f minus the prism's frequency. A
    Hann window removes it unless it is slower than two oscillations over all turns (Harris 1978). What the answers do
    at the next frequencies tells the error of the mean.
    """
    weight = np.sin(math.pi * share) ** 2
    weight /= weight.sum()
    mean = weight @ of_turns
    oscillations = np.exp(2j * math.pi * np.outer(NEAR_OSCILLATIONS, share))
    amplitudes = oscillations @ (weight[:, None] * (of_turns - mean))
    return mean, np.real(amplitudes.T @ amplitudes.conj()) / len(NEAR_OSCILLATIONS)


def mean_of_few_turns(
    of_turns: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of the answers of a few turns, shape (n,), and its covariance, shape (n, n).

    ``each`` holds their search vectors, shape (turns, n). Parts overlap by half a turn, so that they count for
    :data:`WINDOW_TURNS` times fewer.
    """
    independent = max(len(of_turns) / WINDOW_TURNS, 1.0)
    return of_turns.mean(axis=0), np.atleast_2d(np.cov(of_turns.T)) / independent


def _mean(
    best: Attempt, answers: Mapping[int, Mapping[str, float]], count: int, cost: float
) -> tuple[Calibration, float]:
    """Return the mean of the answers of ``count`` successive turns, by number of the turn, and its error [px rms].

    ``best`` is the attempt with the lowest cost, of which the rest of the calibration is taken; ``cost`` the median.
    The camera's motion, which each turn has its own of, is left out.
    """
    assert best.search is not None
    assert best.photometric is not None
    space = best.search.full_space.without(MOTION)
    of_turns = np.array([space.to_vector(parameters) for parameters in answers.values()])
    if count < LEAST_TURNS:
        v, scatter = mean_of_few_turns(of_turns)
    else:
        v, scatter = mean_of_turns(of_turns, (np.array([*answers]) + 0.5) / count)
    parallax_px = PARALLAX_PX * max(0.0, cost - ROTATION_COST)
    covariance = scatter + parallax_px**2 * np.eye(of_turns.shape[1])
    # The values of the rotation would be the start's.
    values = {name: value for name, value in space.to_values(v).items() if name not in MOTION}
    stds = space.deviations(v, covariance)
    photometric = replace(
        best.photometric,
        parameters=values,
        uncertainty=stds,
        cost=cost,
        warnings=(),
        verdict=f"mean of the answers of {len(of_turns)} turns",
    )
    found = replace(
        best.found(),
        parameters=values,
        uncertainty=stds,
        free=space.names,
        photometric=photometric,
        middle_us=None,
        warnings=(),
    )
    return found, stated_px(space, v, covariance)
