"""Calibration of the phase of a rotating tilted plate, in front of a scene of any depths.

Sharpness of one plane gives a first phase. Then each pixel gets its own inverse depth, and the phase minimises the
photometric cost of all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
LARGEST_STD_RAD = 0.2
"""Largest accepted standard deviation of the phase [rad]. Every orbit is this much ahead of or behind its place."""
FAR_RAD = 0.05
"""Step of the phase below which the angle between the faces is looked for [rad]."""
SIGNIFICANT = 5.0
"""Number of standard deviations from which on faces are at an angle to each other."""
WEDGE_FLOOR_PX = 0.004
"""Standard deviation of the motion of all points by faces at an angle, by errors of the method [px]."""
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
    step, half, wedge = STEP_RAD, STEP_RAD, 0.0
    known = "wedge_y" in found.parameters
    for k in range(ROUNDS):
        half = min(half, max(abs(step), FINE_STEP_RAD))
        depths = find_depths(costs, model, LARGEST_INVERSE)
        here = model.with_depths(depths.inverse_depth)
        good = depths.std < GOOD_SHARE * depths.inverse_depth
        low, high = (np.where(good, _slope(costs, here, by), 0.0) for by in (-half, half))
        slope, bend = (low + high) / 2.0, (high - low) / (2.0 * half)
        if not float(bend.sum()) > 0.0:
            raise AmiwarpError(f"{recording.name}: the events do not determine the phase; record a scene with texture")
        same = np.ones((1, *slope.shape))
        fit = _newton(slope, bend, same)
        if abs(float(fit.step[0])) < FAR_RAD and not known:
            by_wedge = phase_by_wedge(model, np.where(good, depths.inverse_depth, np.inf))
            joint = _newton(slope, bend, np.stack([same[0], by_wedge]))
            if wedge or abs(float(joint.step[1])) > SIGNIFICANT * math.hypot(joint.std(1), wedge_floor(model)):
                fit = joint
        step = float(np.clip(fit.step[0], -LONGEST_RAD, LONGEST_RAD))
        wedge += float(fit.step[1]) if len(fit.step) > 1 else 0.0
        model = replace(
            model, phase=math.remainder(model.phase + step, math.tau),
            wedge=model.wedge if known else (model.wedge[0], wedge),
        )  # fmt: skip
        report((k + 1) / ROUNDS)
        if abs(step) < SETTLED_RAD and half == FINE_STEP_RAD:
            break
    check_still(depths, recording.name)
    weight = depths.count / np.maximum(depths.std, 1e-9) ** 2
    mean = float((weight * depths.inverse_depth).sum() / max(weight.sum(), 1e-30))
    std = math.hypot(fit.std(0), FLOOR_PX / max(mean * orbit_px(model), 1e-9))
    check_known_phase(std, recording.name)
    found = replace(
        found, parameters={**found.parameters, "phase": model.phase, "inverse_depth": mean},
        uncertainty={**found.uncertainty, "phase": std},
    )  # fmt: skip
    return with_wedge(found, wedge, math.hypot(fit.std(1), wedge_floor(model))) if wedge else found


def check_known_phase(std: float, name: str) -> None:
    """Raise :class:`AmiwarpError` if the standard deviation of the phase [rad] leaves it unknown."""
    if std > LARGEST_STD_RAD:
        raise AmiwarpError(
            f"{name}: the events determine the phase of the plate within {math.degrees(std):.0f} deg only (at most "
            f"{math.degrees(LARGEST_STD_RAD):.0f} deg are of use): record for longer, or nearer things with more "
            "texture, or use a thicker plate; faces that are not parallel, or a wrong thickness or tilt, do this too"
        )


# Faces that are not parallel: all points move alike by them, so that far points are not in step with near ones.


def turn_by_wedge(model: PlateModel) -> tuple[float, float]:
    """Return the turn of the axial ray per angle between the faces, along the tilt and across it."""
    cosine, index = math.cos(model.plate.tilt), model.plate.index
    inside = math.sqrt(index**2 - math.sin(model.plate.tilt) ** 2)
    return inside / cosine - 1.0, inside - cosine


def inverse_depth_by_wedge(model: PlateModel) -> float:
    """Return the change of all inverse depths [1/m] per angle between the faces along the tilt [rad]."""
    return turn_by_wedge(model)[0] / model.plate.shift


def phase_by_wedge(model: PlateModel, inverse_depth: NDArray[Any]) -> NDArray[np.float64]:
    """Return the change of the phase per angle between the faces across the tilt, which moves points alike."""
    return np.asarray(-turn_by_wedge(model)[1] / (model.plate.shift * np.maximum(inverse_depth, 1e-9)), np.float64)


def wedge_floor(model: PlateModel) -> float:
    """Return the standard deviation of the angle between the faces by errors of the method [rad]."""
    return WEDGE_FLOOR_PX / (turn_by_wedge(model)[1] * model.camera.fx)


def with_wedge(found: Calibration, wedge: float, std: float) -> Calibration:
    """Return the calibration with an angle between the faces across the tilt [rad], and a warning of the one along it.

    The events do not show the angle along the tilt, which looks like other depths. It is likely as large.
    """
    model = found.model
    assert isinstance(model, PlateModel)
    along = found.parameters.get("wedge_x")
    given = along is not None
    uncertainty = {**found.uncertainty, "wedge_y": std, **({} if given else {"wedge_x": abs(wedge)})}
    arcmin = 60.0 * math.degrees(1.0)
    said = (
        f"the faces of the plate are not parallel: {arcmin * wedge:.2g} ± {arcmin * std:.1g} arcmin across the tilt "
        "were found and corrected"
    )
    if not given:
        change = inverse_depth_by_wedge(model) * abs(wedge)
        said += (
            "; the events do not show the angle along the tilt: if it is as large, all inverse depths are off by "
            f"{change:.2g} 1/m, which is part of their standard deviations; measure it and give it by --start wedge_x, "
            "or use a plate with parallel faces"
        )
    return replace(
        found, parameters={**found.parameters, "wedge_x": along or 0.0, "wedge_y": wedge}, uncertainty=uncertainty,
        warnings=(*found.warnings, said),
    )  # fmt: skip


@dataclass(frozen=True)
class _Step:
    """Step of Newton's method in a few parameters."""

    step: NDArray[np.float64]
    """The step, shape (n,)."""
    covariance: NDArray[np.float64]
    """Covariance of the parameters after it by the scatter between squares of pixels, shape (n, n)."""

    def std(self, k: int) -> float:
        """Return the standard deviation of a parameter."""
        return math.sqrt(float(self.covariance[k, k]))


def _newton(slope: NDArray[np.float64], bend: NDArray[np.float64], by: NDArray[np.float64]) -> _Step:
    """Return the step that minimises the cost.

    ``slope``, ``bend``: derivatives of the cost of each pixel by the phase, (height, width); ``by``: derivatives of the
    phase of each pixel by the parameters, (n, height, width).
    """
    gradient = (by * slope).sum(axis=(1, 2))
    curvature = np.einsum("ahw,hw,bhw->ab", by, bend, by)
    inverse = np.linalg.pinv(curvature)
    step = -inverse @ gradient
    rest = by * (slope + bend * np.tensordot(step, by, 1))
    height, width = (n // CLUSTER_PX * CLUSTER_PX for n in slope.shape)
    squares = rest[:, :height, :width].reshape(len(by), height // CLUSTER_PX, CLUSTER_PX, -1, CLUSTER_PX)
    sums = squares.sum(axis=(2, 4)).reshape(len(by), -1)
    return _Step(step, inverse @ (sums @ sums.T) @ inverse)


def _slope(costs: PixelCosts, model: PlateModel, by: float) -> Any:
    """Return the derivative of the cost of each pixel by the phase, at a phase changed ``by`` an angle [rad]."""
    at, plus, minus = (replace(model, phase=model.phase + by + d) for d in (0.0, SLOPE_RAD, -SLOPE_RAD))
    return costs.gradient(at, plus, minus, 2.0 * SLOPE_RAD)
