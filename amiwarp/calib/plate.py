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
from amiwarp.calib.calm_span import LEAST_REPETITION, calmest_span
from amiwarp.calib.photometric.distances import displacements
from amiwarp.calib.photometric.stated_errors import BOUND
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.device_events import read_between
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording
from amiwarp.optics.models.comparison import rms
from amiwarp.optics.models.plate import PlateModel
from amiwarp.optics.prism import Plate
from amiwarp.results.calibration import Calibration

LARGEST_INVERSE = 4.0
"""Default of the largest inverse depth that is tried [1/m]."""
MOST_EVENTS = 8_000_000
"""Largest number of events that are used: more hardly lower the errors, which are those of the method."""
LEAST_EVENTS = 1_000
"""Smallest number of events."""
ROUNDS = 12
"""Largest number of steps in which depths and phase are found in turn. Most plates need three. After five, the phase of
few and strong events was still 0.01 rad off."""
STEP_RAD = 0.05
FINE_STEP_RAD = 0.01
"""Half the distance of the phases at which the derivative of the cost is computed, far from the answer and at the end
[rad]. The cost rises faster on one side: with 0.05 rad, phases came out 1 to 1.5 deg ahead, with 0.1 rad 4 deg."""
SLOPE_RAD = 0.01
"""Half the distance of the phases of a difference quotient [rad]."""
GOOD_SHARE = 0.05
"""Largest relative deviation of the depths whose pixels determine the phase. Others have depths that fit a wrong phase.
"""
LONGEST_RAD = 0.3
BACK_SHARE = 0.5
"""Longest step of the phase [rad], and longest step back as a share of the one before. Far from the answer the cost
bends too little for Newton's method: from 15 deg off, there were steps of 17 deg to and fro without end."""
FLOOR_PX = 0.02
"""Standard deviation of the phase by errors of the method, as the motion of a point at the mean depth [px]. Simulations
of walls were off by at most 0.005 px, that of a desk by 0.012 px."""
LARGEST_STD_RAD = 0.2
"""Largest accepted standard deviation of the phase [rad]. Every orbit is this much ahead of or behind its place."""
FAR_RAD = 0.02
FEWEST_SQUARES = 30
"""Step of the phase below which the angle between the faces is looked for [rad], and the smallest number of squares of
pixels that tell it. At a phase that is farther off, few pixels have a depth: parallel faces seemed to be at an angle of
10 ± 1.4 arcmin, by 105 pixels."""
SIGNIFICANT = 5.0
"""Number of standard deviations above which faces are at an angle to each other."""
STOCK_WEDGE_RAD = math.radians(1.0 / 60.0)
"""Largest standard deviation of an angle between the faces that was not found [rad]. Stock glass is parallel within it.
"""
WEDGE_FLOOR_PX = 0.004
"""Standard deviation of the motion of all points by faces at an angle, by errors of the method [px]."""
THICKNESS_SHARE = 0.03
TILT_RAD = math.radians(1.0)
INDEX_STD = 0.01
"""Standard deviations of the plate that is given: a share of its thickness, which is the tolerance of 10 mm of float
glass (EN 572-2), its tilt [rad] and its refractive index. They scale all inverse depths alike, which no event shows."""
SETTLED_RAD = 0.002
"""Step of the phase that ends the search [rad]."""
CLUSTER_PX = 8
"""Side of the squares of pixels whose errors are counted as independent [px]."""
MARGIN = 1.5
"""Margin of the brightness map around the image, relative to the largest orbit on the optical axis."""
LARGEST_COST = 0.2
"""Largest mean cost of a pair of events [thresholds²] of a scene at rest: without a map it is 0.4."""


def costs_at_rest(
    recording: Recording, model: PlateModel, encoder: Encoder, largest: float, device: Any
) -> PixelCosts:
    """Return the costs of the pixels over a recording from a camera at rest.

    Raises :class:`AmiwarpError` as :func:`span_at_rest`.
    """
    source = recording.events
    turn_us, start, stop = span_at_rest(recording, encoder)
    events = read_between(source, start, stop)
    margin = orbit_px(model) * largest * MARGIN
    return PixelCosts(
        events, source.size, encoder, longest_gap_us=round(turn_us), margin_px=margin, device=device
    )


def span_at_rest(recording: Recording, encoder: Encoder) -> tuple[float, int, int]:
    """Return the time of a turn of the plate, and start and stop of the events that tell the depths [us].

    Raises :class:`AmiwarpError` if the camera or the scene moves, the plate does not turn, or there are few events.
    """
    source = recording.events
    name = recording.name
    if len(source) < LEAST_EVENTS:
        raise AmiwarpError(
            f"{name}: {len(source)} events do not determine depths; give a longer recording",
            ErrorCode.CALIBRATION_REFUSED,
        )
    turn_us = 60e6 / abs(encoder.rpm) if encoder.rpm else math.inf
    first, last = source.t_first, source.t_last
    if last - first < turn_us:
        raise AmiwarpError(
            f"{name}: depths need a whole turn of the plate; give a longer recording"
        )
    repetition, _ = calmest_span(recording, encoder)
    if repetition < LEAST_REPETITION:
        raise AmiwarpError(
            f"{name}: the events of successive turns differ (correlation {repetition:.2f}): the camera or the scene "
            "moves, and depths are found from a camera at rest only; record a still scene with a camera on a stand",
            ErrorCode.CALIBRATION_REFUSED,
        )
    # In the first turn, the pixels' references are unknown
    start = round(min(first + turn_us, last + 1 - turn_us))
    end = min(source.find(start) + MOST_EVENTS, len(source) - 1)
    stop = max(int(source.slice(end, end + 1).t[0]), round(start + turn_us)) + 1
    return turn_us, start, stop


def check_still(depths: Depths, name: str) -> None:
    """Raise :class:`AmiwarpError` if no depths explain the events."""
    if depths.cost > LARGEST_COST:
        raise AmiwarpError(
            f"{name}: no depths explain the events (mean cost {depths.cost:.2f}, at most {LARGEST_COST} expected): the "
            "camera or the scene moves, or the plate or the phase is wrong; record a still scene, and check thickness "
            "and tilt",
            ErrorCode.CALIBRATION_REFUSED,
        )


def refine_phase(
    found: Calibration,
    recording: Recording,
    device: Any,
    report: Callable[[float], None] = lambda share: None,
) -> tuple[Calibration, NDArray[np.float64]]:
    """Return the calibration with the phase that minimises the photometric cost, and its standard deviation.

    The second result is the inverse depth of what each pixel sees, relative to the mean that the calibration states,
    shape (height, width). Raises :class:`AmiwarpError` as :func:`costs_at_rest`, or if no depths explain the events.
    """
    model = found.model
    assert isinstance(model, PlateModel)
    encoder = found.encoder_for(
        recording.encoder, recording.events.t_first, recording.events.t_last
    )
    costs = costs_at_rest(recording, model, encoder, LARGEST_INVERSE, device)
    step = STEP_RAD
    half = STEP_RAD
    wedge = 0.0
    unseen_wedge = 0.0
    wedge_is_given = "wedge_y" in found.parameters
    for k in range(ROUNDS):
        half = min(half, max(abs(step), FINE_STEP_RAD))
        depths = find_depths(costs, model, LARGEST_INVERSE)
        here = model.with_depths(depths.inverse_depth)
        good = depths.std < GOOD_SHARE * depths.inverse_depth
        low, high = (np.where(good, _slope(costs, here, by), 0.0) for by in (-half, half))
        slope = (low + high) / 2.0
        bend = (high - low) / (2.0 * half)
        if not float(bend.sum()) > 0.0:
            raise AmiwarpError(
                f"{recording.name}: the events do not determine the phase; record a scene with texture",
                ErrorCode.CALIBRATION_REFUSED,
            )
        same = np.ones((1, *slope.shape))
        fit = _newton(slope, bend, same)
        is_near = abs(float(fit.step[0])) < FAR_RAD or wedge
        if is_near and not wedge_is_given:
            by_wedge = phase_by_wedge(model, np.where(good, depths.inverse_depth, np.inf))
            joint = _newton(slope, bend, np.stack([same[0], by_wedge]))
            wedge_std = math.hypot(joint.std(1), wedge_floor(model))
            in_all = wedge + float(joint.step[1])
            unseen_wedge = min(STOCK_WEDGE_RAD, math.hypot(in_all, wedge_std))
            is_told = joint.to_minimum and joint.squares >= FEWEST_SQUARES
            if is_told and abs(in_all) > SIGNIFICANT * wedge_std:
                fit = joint
            elif wedge:  # there is none after all: the phase without it
                fit = _newton(slope - wedge * bend * by_wedge, bend, same)
                wedge = 0.0
        wanted, *of_wedge = fit.step.tolist()
        longest = LONGEST_RAD
        if k > 0 and wanted * step < 0.0:
            longest = min(LONGEST_RAD, BACK_SHARE * abs(step))
        shorter = min(1.0, longest / max(abs(wanted), longest))
        step = shorter * wanted
        wedge += shorter * sum(of_wedge)
        model = replace(
            model,
            phase=math.remainder(model.phase + step, math.tau),
            wedge=model.wedge if wedge_is_given else (model.wedge[0], wedge),
        )
        report((k + 1) / ROUNDS)
        if abs(wanted) < SETTLED_RAD and half == FINE_STEP_RAD:
            break
    check_still(depths, recording.name)
    check_settled(wanted, recording.name)
    weight = depths.count / np.maximum(depths.std, 1e-9) ** 2
    mean = float((weight * depths.inverse_depth).sum() / max(weight.sum(), 1e-30))
    std = math.hypot(fit.std(0), FLOOR_PX / max(mean * orbit_px(model), 1e-9))
    check_known_phase(std, recording.name)
    uncertainty = {
        **found.uncertainty,
        "phase": std,
        "inverse_depth": mean * scale_doubt(model.plate),
    }
    parameters = {**found.parameters, "phase": model.phase, "inverse_depth": mean}
    # Windows without a depth have few events: any depth will do.
    known = np.isfinite(depths.std)
    relative = np.where(known, depths.inverse_depth, mean) / max(mean, 1e-9)
    if wedge:
        found = replace(found, parameters=parameters, uncertainty=uncertainty)
        return with_wedge(found, wedge, math.hypot(fit.std(1), wedge_floor(model))), relative
    if unseen_wedge:
        # an angle that is too small to be found may be there, and one along the tilt is likely as large
        for name in ("wedge_x", "wedge_y"):
            if name not in parameters:
                parameters[name] = 0.0
                uncertainty[name] = unseen_wedge
    return replace(found, parameters=parameters, uncertainty=uncertainty), relative


def scale_doubt(plate: Plate) -> float:
    """Return the standard deviation of the scale of all inverse depths, as a share, by what is given of the plate."""
    less_tilted = replace(plate, tilt=max(0.0, plate.tilt - TILT_RAD))
    # one step towards the middle of the allowed indices
    of_other_glass = replace(plate, index=plate.index + math.copysign(INDEX_STD, 2.0 - plate.index))
    by_tilt, by_index = (each.shift / plate.shift - 1.0 for each in (less_tilted, of_other_glass))
    return math.hypot(THICKNESS_SHARE, by_tilt, by_index)


def hidden_by_plate(found: Calibration) -> dict[str, float]:
    """Return by how much another thickness, tilt or glass of the plate may move points [px rms], by words.

    It is the motion at depths that are known from elsewhere: found depths make up for it, so that no event shows it.
    """
    model = found.model
    assert isinstance(model, PlateModel)
    motion = displacements([model])
    motion_px = rms(motion.reshape(-1, 2))
    return {"the plate's thickness, tilt and glass": BOUND * scale_doubt(model.plate) * motion_px}


def check_known_phase(std: float, name: str) -> None:
    """Raise :class:`AmiwarpError` if the standard deviation of the phase [rad] leaves it unknown."""
    if std > LARGEST_STD_RAD:
        raise AmiwarpError(
            f"{name}: the events determine the phase of the plate within {math.degrees(std):.0f} deg only (at most "
            f"{math.degrees(LARGEST_STD_RAD):.0f} deg are of use): record for longer, or nearer things with more "
            "texture, or use a thicker plate; faces that are not parallel, or a wrong thickness or tilt, do this too",
            ErrorCode.CALIBRATION_REFUSED,
        )


def check_settled(step: float, name: str) -> None:
    """Raise :class:`AmiwarpError` if the search for the phase would go on by a long step [rad]."""
    if abs(step) >= FAR_RAD:
        raise AmiwarpError(
            f"{name}: the search for the phase of the plate does not settle (its next step would be "
            f"{math.degrees(abs(step)):.1f} deg): check the encoder, or record for longer, or nearer things with more "
            "texture",
            ErrorCode.CALIBRATION_REFUSED,
        )


# Faces that are not parallel: all points move alike by them, so that far points are not in step with near ones.


def turn_by_wedge(model: PlateModel) -> tuple[float, float]:
    """Return the turn of the axial ray per angle between the faces, along the tilt and across it."""
    cosine = math.cos(model.plate.tilt)
    index = model.plate.index
    inside = math.sqrt(index**2 - math.sin(model.plate.tilt) ** 2)
    return inside / cosine - 1.0, inside - cosine


def inverse_depth_by_wedge(model: PlateModel) -> float:
    """Return the change of all inverse depths [1/m] per angle between the faces along the tilt [rad]."""
    return turn_by_wedge(model)[0] / model.plate.shift


def phase_by_wedge(model: PlateModel, inverse_depth: NDArray[Any]) -> NDArray[np.float64]:
    """Return the change of the phase per angle between the faces across the tilt, which moves points alike."""
    return np.asarray(
        -turn_by_wedge(model)[1] / (model.plate.shift * np.maximum(inverse_depth, 1e-9)), np.float64
    )


def wedge_floor(model: PlateModel) -> float:
    """Return the standard deviation of the angle between the faces by errors of the method [rad]."""
    return WEDGE_FLOOR_PX / (turn_by_wedge(model)[1] * model.camera.fx)


def hidden_by_faces(found: Calibration) -> dict[str, float]:
    """Return by how much faces that are not parallel may move points [px rms], by words; nothing if it is given.

    It is the motion at depths that are known from elsewhere: found depths make up for most of an angle along the tilt.
    That angle is not looked for, so that it may be as large as in glass from stock.
    """
    model = found.model
    assert isinstance(model, PlateModel)
    largest = {name: BOUND * found.uncertainty.get(name, 0.0) for name in ("wedge_x", "wedge_y")}
    if "wedge_x" in found.uncertainty:
        largest["wedge_x"] = max(largest["wedge_x"], STOCK_WEDGE_RAD)
    along, across = model.wedge
    by_each = [
        replace(model, wedge=(along + largest["wedge_x"], across)),
        replace(model, wedge=(along, across + largest["wedge_y"])),
    ]
    here, *there = displacements([model, *by_each])
    # through a wide lens, no ray passes at the border of the image
    px = math.hypot(*(rms((each - here).reshape(-1, 2)) for each in there))
    return {"faces that are not parallel": px} if px > 0.0 else {}


def with_wedge(found: Calibration, wedge: float, std: float) -> Calibration:
    """Return the calibration with an angle between the faces across the tilt [rad], and a warning of the one along it.

    The angle along the tilt, which looks much like other depths, is not looked for. It is likely as large.
    """
    model = found.model
    assert isinstance(model, PlateModel)
    along = found.parameters.get("wedge_x")
    given = along is not None
    uncertainty = {
        **found.uncertainty,
        "wedge_y": std,
        **({} if given else {"wedge_x": abs(wedge)}),
    }
    arcmin = 60.0 * math.degrees(1.0)
    said = (
        f"the faces of the plate are not parallel: {arcmin * wedge:.2g} ± {arcmin * std:.1g} arcmin across the tilt "
        "were found and corrected"
    )
    if not given:
        change = inverse_depth_by_wedge(model) * abs(wedge)
        said += (
            "; the angle along the tilt looks like other depths, and is not looked for: if it is as large, the inverse "
            f"depths in the middle are off by {change:.2g} 1/m, which is part of their standard deviations; measure it "
            "and give it by --start wedge_x, or use a plate with parallel faces"
        )
    return replace(
        found,
        parameters={**found.parameters, "wedge_x": along or 0.0, "wedge_y": wedge},
        uncertainty=uncertainty,
        warnings=(*found.warnings, said),
    )


@dataclass(frozen=True)
class _Step:
    """Step of Newton's method in a few parameters."""

    step: NDArray[np.float64]
    """The step, shape (n,)."""
    covariance: NDArray[np.float64]
    """Covariance of the parameters after it by the scatter between squares of pixels, shape (n, n)."""
    squares: int
    """Number of squares of pixels that tell it. Of few squares, the scatter is not known."""
    to_minimum: bool
    """Whether the cost has a minimum there. Noise may bend it downwards along what changes it little."""

    def std(self, k: int) -> float:
        """Return the standard deviation of a parameter."""
        return math.sqrt(float(self.covariance[k, k]))


def _newton(
    slope: NDArray[np.float64], bend: NDArray[np.float64], by: NDArray[np.float64]
) -> _Step:
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
    squares = rest[:, :height, :width].reshape(
        len(by), height // CLUSTER_PX, CLUSTER_PX, -1, CLUSTER_PX
    )
    sums = squares.sum(axis=(2, 4)).reshape(len(by), -1)
    return _Step(
        step,
        covariance=inverse @ (sums @ sums.T) @ inverse,
        squares=int(np.count_nonzero(sums[0])),
        to_minimum=bool(np.linalg.eigvalsh(curvature)[0] > 0.0),
    )


def _slope(costs: PixelCosts, model: PlateModel, by: float) -> Any:
    """Return the derivative of the cost of each pixel by the phase, at a phase changed ``by`` an angle [rad]."""
    at, plus, minus = (
        replace(model, phase=model.phase + by + d) for d in (0.0, SLOPE_RAD, -SLOPE_RAD)
    )
    return costs.gradient(at, plus, minus, 2.0 * SLOPE_RAD)
