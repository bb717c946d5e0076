"""Calibration of the phase of a rotating tilted plate, in front of a scene of any depths.

Sharpness of one plane gives a first phase. Then each pixel gets its own inverse depth, and the phase minimises the
photometric cost of all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from amiwarp.brightness.depths import Depths, find_depths, orbit_px
from amiwarp.brightness.pixel_costs import PixelCosts
from amiwarp.calib.first_guess import LEAST_REPETITION, calmest_span
from amiwarp.calib.result import Calibration
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import read_between
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording
from amiwarp.optics.models import PlateModel

LARGEST_INVERSE = 4.0
"""Default of the largest inverse depth that is tried [1/m]."""
MOST_EVENTS = 8_000_000
"""Largest number of events that are used: more hardly lower the errors, which are those of the method."""
LEAST_EVENTS = 1_000
"""Smallest number of events."""
ROUNDS = 5
"""Largest number of steps in which depths and phase are found in turn."""
STEP_RAD, FINE_STEP_RAD = 0.05, 0.01
"""Half the distance of the phases at which the derivative of the cost is computed, far from the answer and at the end
[rad]. The cost rises faster on one side: with 0.05 rad, phases came out 1 to 1.5 deg ahead, with 0.1 rad 4 deg."""
SLOPE_RAD = 0.01
"""Half the distance of the phases of a difference quotient [rad]."""
GOOD_SHARE = 0.05
"""Largest relative deviation of the depths whose pixels determine the phase. Others have depths that fit a wrong phase.
"""
LONGEST_RAD = 0.3
"""Longest step of the phase [rad]."""
FLOOR_PX = 0.02
"""Standard deviation of the phase by errors of the method, as the motion of a point at the mean depth [px]. Simulations
of walls were off by at most 0.005 px, that of a desk by 0.012 px."""
SETTLED_RAD = 0.002
"""Step of the phase that ends the search [rad]."""
CLUSTER_PX = 8
"""Side of the squares of pixels whose errors are counted as independent [px]."""
MARGIN = 1.5
"""Margin of the brightness map around the image, relative to the largest orbit on the optical axis."""
LARGEST_COST = 0.2
"""Largest mean cost of a pair of events [thresholds²] of a scene at rest: without a map it is 0.4."""


def costs_at_rest(recording: Recording, model: PlateModel, encoder: Encoder, largest: float, device: Any) -> PixelCosts:
    """Return the costs of the pixels over a recording from a camera at rest.

    Raises :class:`AmiwarpError` if the camera or the scene moves, the plate does not turn, or there are few events.
    """
    source, name = recording.events, recording.name
    if len(source) < LEAST_EVENTS:
        raise AmiwarpError(f"{name}: {len(source)} events do not determine depths; give a longer recording")
    turn_us = 60e6 / abs(encoder.rpm) if encoder.rpm else math.inf
    first, last = source.t_first, source.t_last
    if last - first < turn_us:
        raise AmiwarpError(f"{name}: depths need a whole turn of the plate; give a longer recording")
    repetition, _ = calmest_span(recording, encoder)
    if repetition < LEAST_REPETITION:
        raise AmiwarpError(
            f"{name}: the events of successive turns differ (correlation {repetition:.2f}): the camera or the scene "
            "moves, and depths are found from a camera at rest only; record a still scene with a camera on a stand"
        )
    start = round(min(first + turn_us, last + 1 - turn_us))  # in the first turn, the pixels' references are unknown
    end = min(source.find(start) + MOST_EVENTS, len(source) - 1)
    stop = max(int(source.slice(end, end + 1).t[0]), round(start + turn_us)) + 1
    events = read_between(source, start, stop)
    margin = orbit_px(model) * largest * MARGIN
    return PixelCosts(events, source.size, encoder, longest_gap_us=round(turn_us), margin_px=margin, device=device)


def check_still(depths: Depths, name: str) -> None:
    """Raise :class:`AmiwarpError` if no depths explain the events."""
    if depths.cost > LARGEST_COST:
        raise AmiwarpError(
            f"{name}: no depths explain the events (mean cost {depths.cost:.2f}, at most {LARGEST_COST} expected): the "
            "camera or the scene moves, or the plate or the phase is wrong; record a still scene, and check thickness "
            "and tilt"
        )


def refine_phase(
    found: Calibration, recording: Recording, device: Any, report: Callable[[float], None] = lambda share: None
) -> Calibration:
    """Return the calibration with the phase that minimises the photometric cost, and its standard deviation.

    Raises :class:`AmiwarpError` as :func:`costs_at_rest`, or if no depths explain the events.
    """
    model = found.model
    assert isinstance(model, PlateModel)
    encoder = found.encoder_for(recording.encoder, recording.events.t_first, recording.events.t_last)
    costs = costs_at_rest(recording, model, encoder, LARGEST_INVERSE, device)
    std, step, half = math.pi, STEP_RAD, STEP_RAD
    for k in range(ROUNDS):
        half = min(half, max(abs(step), FINE_STEP_RAD))
        depths = find_depths(costs, model, LARGEST_INVERSE)
        here = model.with_depths(depths.inverse_depth)
        good = depths.std < GOOD_SHARE * depths.inverse_depth
        low, high = (np.where(good, _slope(costs, here, by), 0.0) for by in (-half, half))
        slope, bend = (low + high) / 2.0, float((high - low).sum()) / (2.0 * half)
        if not bend > 0.0:
            raise AmiwarpError(f"{recording.name}: the events do not determine the phase; record a scene with texture")
        step = float(np.clip(-slope.sum() / bend, -LONGEST_RAD, LONGEST_RAD))
        model = replace(model, phase=math.remainder(model.phase + step, math.tau))
        rest = slope + (high - low) / (2.0 * half) * step
        height, width = (n // CLUSTER_PX * CLUSTER_PX for n in rest.shape)
        squares = rest[:height, :width].reshape(height // CLUSTER_PX, CLUSTER_PX, -1, CLUSTER_PX).sum(axis=(1, 3))
        std = math.sqrt(float((squares**2).sum())) / bend
        report((k + 1) / ROUNDS)
        if abs(step) < SETTLED_RAD and half == FINE_STEP_RAD:
            break
    check_still(depths, recording.name)
    weight = depths.count / np.maximum(depths.std, 1e-9) ** 2
    mean = float((weight * depths.inverse_depth).sum() / max(weight.sum(), 1e-30))
    return replace(
        found, parameters={**found.parameters, "phase": model.phase, "inverse_depth": mean},
        uncertainty={**found.uncertainty, "phase": math.hypot(std, FLOOR_PX / max(mean * orbit_px(model), 1e-9))},
    )  # fmt: skip


def _slope(costs: PixelCosts, model: PlateModel, by: float) -> Any:
    """Return the derivative of the cost of each pixel by the phase, at a phase changed ``by`` an angle [rad]."""
    at, plus, minus = (replace(model, phase=model.phase + by + d) for d in (0.0, SLOPE_RAD, -SLOPE_RAD))
    return costs.gradient(at, plus, minus, 2.0 * SLOPE_RAD)
