"""Step of the stage that looks for what a vibration does beyond its model: harmonics, changes of amplitude or speed.

Each is a few unknowns of a linearised fit about the answer, as the causes of ``consistency.py``. A fit finds a share of
what is there only, because the map absorbs the rest.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.photometric.cost import place_arguments
from amiwarp.calib.photometric.derivatives import by_swing, by_wave_of_angle, masked, slopes
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.findings import UnsteadyMotion
from amiwarp.calib.photometric.linear_fit import linear_fit, telling
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.stated_errors import BOUND

if TYPE_CHECKING:
    from amiwarp.calib.photometric.cost import Cost

    Vector = NDArray[np.float64]

HIGHER = (4, 5)
"""Multiples of the frequency that the model does not have."""
WAVES = 8
"""Number of half oscillations over the recording up to which amplitude and speed may change."""
STEP_SHARE = 0.005
"""Step of the finite difference: a share of the amplitude."""
SIGNIFICANT = 5.0
LEAST_GAIN = 0.015
"""Standard deviations and share of the squared residuals above which one of these is there. A steady ellipse left
0.004, an amplitude that varied by 15 % 0.16, a triangle 0.12."""
LEAST_PX = 0.01
"""Motion of events by it above which an answer is refused [px rms]."""
FIRST_LOOK = 0.3
"""Share of this gain above which a group of unknowns is fitted, to bound what it hides."""
AMPLITUDE = "an amplitude of the vibration that changes"
"""Words of what could hide if the amplitude is not found to change, or little."""
AMPLITUDE_SHARE = 0.4
"""Share of a change of the amplitude that a fit finds at least. It was 0.45 to 0.58 of changes by 1.1 %."""


def refuse_unsteady_motion(state: Refinement) -> Refinement:
    """Note what a vibration does beyond its model, and how much a change of its amplitude could hide."""
    if not state.are_angles_examined:
        return state
    cost = state.search.cost
    cost.converge(state.answer.x)
    found = find_unsteady(cost, state.answer.x)
    for each in found:
        if each.kind == "amplitude":
            bound_px = (each.moved_px + BOUND * each.std_px) / AMPLITUDE_SHARE
            state = state.hiding(AMPLITUDE, bound_px)
    certain = [each for each in found if _is_certain(each)]
    if not certain:
        return state
    return state.noticing(max(certain, key=lambda each: each.gain))


def _is_certain(found: UnsteadyMotion) -> bool:
    """Return whether an answer is refused because of what a vibration does beyond its model."""
    is_there = found.significance >= SIGNIFICANT and found.gain >= LEAST_GAIN
    return is_there and found.moved_px >= LEAST_PX


def find_unsteady(cost: Cost, best: Vector) -> list[UnsteadyMotion]:
    """Return what a vibration seems to do beyond its model at the answer ``best`` [px]; nothing if it keeps to it.

    The map must be solved at ``best``, whose speed is known.
    """
    all_groups = {
        "harmonics": _harmonics(cost, best),
        "amplitude": _amplitude(cost, best),
        "speed": _speed(cost, best),
    }
    # Only some groups are worth a fit.
    told = telling(cost, list(all_groups.values()), FIRST_LOOK * LEAST_GAIN)
    groups = {}
    for kind, group in all_groups.items():
        if any(group is each for each in told):
            groups[kind] = group
    if not groups:
        return []

    names = cost.space.names
    columns = slopes(cost, cost.space, best, names)
    for group in groups.values():
        columns |= group
    fit = linear_fit(cost, columns)
    found = []
    for kind, group in groups.items():
        estimate, significance, gain = fit.adding(names, tuple(group))
        change = estimate.change[len(names) :]
        deviations = np.sqrt(np.diag(estimate.covariance)[len(names) :])
        found.append(
            UnsteadyMotion(
                kind=kind,
                moved_px=_moved_px(cost, best, kind, change),
                std_px=_moved_px(cost, best, kind, deviations),
                significance=significance,
                gain=gain,
            )
        )
    return found


def _moved_px(cost: Cost, best: Vector, kind: str, change: Vector) -> float:
    """Return how far the changes of a group move events [px rms]."""
    size = float(np.linalg.norm(change))
    if kind == "harmonics":  # amplitudes of a rotation about x and y
        return size / math.sqrt(2.0)
    if kind == "amplitude":
        amplitude_px = float(np.linalg.norm(best))
        return amplitude_px * size / math.sqrt(2.0)
    return px_per_rad(cost.space, best) * size / math.sqrt(2.0)


def _harmonics(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by rotations about x and y at multiples of the frequency [px]."""
    patterns = cost.brightness.pairs.angle_patterns((0.0, 0.0)).numpy()
    cosine = patterns[0]
    sine = patterns[1]
    columns = {}
    for multiple in HIGHER:
        wave = (cosine + 1j * sine) ** multiple
        for part, values in (("cos", wave.real), ("sin", wave.imag)):
            swing = _on_device(cost, values)
            for axis, name in enumerate("xy"):
                columns[f"harmonic {multiple} {part} {name}"] = by_swing(cost, best, swing, axis)
    return columns


def _on_device(cost: Cost, values: NDArray[Any]) -> Any:
    """Return values of the pairs, or of their ends, on the device of a cost."""
    single = values.astype(np.float32)
    return wp.array(single, dtype=float, device=cost.brightness.device)


def _waves(cost: Cost) -> dict[int, Vector]:
    """Return cosines over the recording by their number of half oscillations, at both ends of each pair, (2, pairs)."""
    times = cost.brightness.pairs.time.astype(np.float64)
    duration = max(float(np.ptp(times)), 1e-9)
    share = (times - times.min()) / duration
    return {k: np.cos(math.pi * k * share) for k in range(1, WAVES + 1)}


def _amplitude(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by changes of the amplitude over time, as shares of it."""
    space = cost.space
    pairs = cost.brightness.pairs

    larger = best * (1.0 + STEP_SHARE)
    smaller = best * (1.0 - STEP_SHARE)
    by_size = cost.brightness.find_slope(
        place_arguments(space, space.to_values(larger)),
        place_arguments(space, space.to_values(smaller)),
        2.0 * STEP_SHARE,
    )

    columns = {}
    for k, wave in _waves(cost).items():
        padded = np.zeros(pairs.arrays.stride, np.float32)
        padded[: len(pairs)] = wave.mean(axis=0)
        columns[f"amplitude {k}"] = masked(by_size, _on_device(cost, padded))
    return columns


def _speed(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by changes of the angle over time that no constant speed makes [rad]."""
    columns = {}
    for k, wave in _waves(cost).items():
        if k > 1:
            columns[f"speed {k}"] = by_wave_of_angle(cost, best, wave)
    return columns
