"""Which findings are refused, and all of them in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import singledispatch

import numpy as np

from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.causes import FLAT_SIDE, SuspectedError
from amiwarp.calib.photometric.consistency import CLOCK, Consistency
from amiwarp.calib.photometric.findings import (
    AngleError,
    BlindTime,
    Finding,
    FlatSideCorrected,
    LensBeyondCorrection,
    MissingEvents,
    MovingParts,
    Optimum,
    ParameterCorrected,
    RefractoryDoubt,
    RefractoryPeriod,
    RivalCauses,
    SectorError,
    Shake,
    Silence,
    SlowPixels,
    StatedError,
    UnsteadyMotion,
    UnsteadySpeed,
)
from amiwarp.optics.camera import LENS
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.parameters import units

REFUSED_IN_ORDER: tuple[type[Finding], ...] = (
    LensBeyondCorrection,
    Optimum,
    MovingParts,
    AngleError,
    UnsteadyMotion,
    UnsteadySpeed,
    BlindTime,
    Shake,
    Consistency,
    StatedError,
    RivalCauses,
    SlowPixels,
    RefractoryDoubt,
    MissingEvents,
)
"""Findings that may be refused: of several refused ones, the first one of this order is the reason that is given."""
SAID_IN_ORDER: tuple[type[Finding], ...] = (
    RefractoryPeriod,
    SlowPixels,
    Silence,
    MissingEvents,
    AngleError,
    FlatSideCorrected,
    ParameterCorrected,
    RivalCauses,
    Consistency,
    SectorError,
    StatedError,
    RefractoryDoubt,
    BlindTime,
)
"""Findings that warnings may be made from, in the order of the warnings."""
HOW_OFTEN = ("once", "twice", "three times", "four times")
"""How often the harmonics of an angle's error repeat, in words."""


def refusal(findings: Iterable[Finding]) -> str:
    """Return why an answer with these findings is refused; empty if it is accepted."""
    noticed = [*findings]
    for kind in REFUSED_IN_ORDER:
        for finding in noticed:
            if type(finding) is kind and (reason := refused(finding)):
                return reason
    return ""


def warnings(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return a sentence for all that a user should know of."""
    noticed = [*findings]
    return tuple(
        said
        for kind in SAID_IN_ORDER
        for each in noticed
        if type(each) is kind
        for said in warned(each)
    )


def accepted_in_words(optimum: Optimum) -> str:
    """Return why an answer is accepted."""
    return f"one brightness map explains the events ({100 * optimum.cost:.0f} % of the residual remains)"


@singledispatch
def refused(finding: Finding) -> str:
    """Return why an answer with this finding is refused; empty if it is accepted."""
    return ""


@singledispatch
def warned(finding: Finding) -> Sequence[str]:
    """Return the sentences that a user should read because of this finding."""
    return ()


@refused.register
def _(optimum: Optimum) -> str:
    if optimum.cost > limits.LARGEST_COST:
        return (
            f"no brightness map of the scene explains the events ({min(100 * optimum.cost, 100):.0f} % of the residual "
            "remains): the scene or the camera moved, light flickered, or the encoder or the lens is wrong"
        )
    if limits.is_far(optimum.moved_px):
        return (
            f"the optimum is over {limits.LARGEST_MOVE_PX:g} px away from that of sharpness: the lens or the encoder "
            "is wrong, or the scene or the camera moved"
        )
    if optimum.next_step_px > limits.LARGEST_NEXT_STEP_PX:
        known = optimum.next_step_px <= limits.LARGEST_MOVE_PX
        size = f"{optimum.next_step_px:.2f} px" if known else f"over {limits.LARGEST_MOVE_PX:g} px"
        return (
            f"the search did not converge: its next step would be {size}, but no step lowers the cost: too few events, "
            "or many lost"
        )
    if optimum.rise < min(
        limits.LEAST_COST_RISE, max(limits.SMALLEST_RISE, limits.RISE_SHARE * optimum.cost)
    ):
        well = (
            f"as well ({100 * optimum.rise:.1f} % of the residual more)"
            if optimum.rise > 0.0
            else "better"
        )
        return (
            f"an orbit that is {limits.PERTURBATION_PX:g} px larger, smaller or rotated explains the events {well}: "
            "too few events, too little contrast, or the scene or the camera moved"
        )
    return ""


@refused.register
def _(found: MovingParts) -> str:
    return "something moves in a part of the view"


# Errors of the angles.


@refused.register
def _(found: AngleError) -> str:
    if found.late_px >= limits.LARGEST_SKEW_PX:
        return _skew_in_words(found)
    if found.harmonics:
        said = harmonics_in_words(MODELS[found.model], found.harmonics)
        return f"{said}, and its correction was not confirmed: check how it is mounted"
    return ""


@warned.register
def _(found: AngleError) -> Sequence[str]:
    return (
        [_skew_in_words(found)]
        if found.late_px >= limits.NOTABLE_SKEW_PX and not refused(found)
        else []
    )


def _skew_in_words(found: AngleError) -> str:
    x, y = found.late_us
    return (
        f"the sensor reads its pixels one after another: events come late by {x:.2g} us more from column to column "
        f"and {y:.2g} us from row to row, an error of {found.late_px:.2f} px; subtract {x:.3g} * x + {y:.3g} * y from "
        "the events' times [us]"
    )


@warned.register
def _(found: SectorError) -> Sequence[str]:
    if found.moved_px < limits.NOTABLE_SECTOR_PX:
        return []
    name = angle_names(MODELS[found.model])[found.angle]
    return [
        f"an error of about {found.moved_px:.2f} px rms is left that repeats with {name}, most at "
        f"{math.degrees(found.at_rad):.0f} deg: it is not corrected; check the angle there, or calibrate again with a "
        "camera and a scene that stay still"
    ]


def harmonics_in_words(kind: type[Model], harmonics: Sequence[float]) -> str:
    """Return the error of the angles of a model in words: its size, and how often it repeats."""
    turn = "turn" if kind.PRISM else "period"
    said = []
    of_angles = np.reshape(harmonics, (kind.ANGLES, -1, 2))
    for name, of_angle in zip(angle_names(kind), of_angles, strict=True):
        sizes = np.degrees(np.linalg.norm(of_angle, axis=1)).tolist()
        named = [
            f"{x:.2g} deg {how} a {turn}"
            for x, how in zip(sizes, HOW_OFTEN, strict=False)
            if x and x >= 0.2 * max(sizes)
        ]
        if named:
            said.append(f"{name} is wrong by {' and '.join(named)}")
    return ", ".join(said)


def angle_names(kind: type[Model]) -> tuple[str, ...]:
    """Return what each angle of a model is called."""
    if kind.ANGLES == 1:
        return ("the encoder's angle",)
    if kind.PRISM:
        return "the first encoder's angle", "the second encoder's angle"
    return "the angle of the first command", "the angle of the second command"


# Timing of the sensor.


@warned.register
def _(found: RefractoryPeriod) -> Sequence[str]:
    return [
        f"the events show that pixels pause after an event (refractory period): {found.found_us:.0f} us of it "
        "fit best and were corrected; give the true one by --refractory-us"
    ]


@refused.register
def _(found: SlowPixels) -> str:
    remedy = "use more light, a larger bandwidth or a slower prism"
    if found.turn_rad > limits.LARGEST_LAG_RAD:
        angle = math.degrees(found.turn_rad)
        return f"the pixels are too slow: the prism turns by {angle:.0f} deg within their time constant; {remedy}"
    if found.moved_px > limits.LARGEST_SLOW_PX:
        return (
            f"the pixels are too slow for this texture: they change the size of the orbit by {found.moved_px:.2f} px "
            f"rms, and the correction leaves about a tenth of that; {remedy}, or show a scene with stronger edges"
        )
    return ""


@warned.register
def _(found: SlowPixels) -> Sequence[str]:
    return [
        f"the pixels are slow: about {found.time_constant_us:.0f} us at the median brightness, more in the dark. The "
        f"size of the orbit was corrected, by {found.moved_px:.2f} px rms, of which about a tenth may remain. The lag "
        "is part of the phase, which holds at this speed of the prism only"
    ]


@refused.register
def _(found: UnsteadyMotion) -> str:
    if found.kind == "harmonics":
        return (
            f"the vibration is no sum of three harmonics: the fourth and fifth move events by {found.moved_px:.2f} px "
            "or more, as those of a triangle do; drive it by a sine, or damp what rattles"
        )
    changes = "amplitude" if found.kind == "amplitude" else "frequency"
    return (
        f"the {changes} of the vibration changes during the recording, which moves events by {found.moved_px:.2f} px "
        "or more; record while it is steady, or a shorter time"
    )


@refused.register
def _(found: UnsteadySpeed) -> str:
    if found.moved_px <= limits.LARGEST_CHANGE_OF_SPEED_PX:
        return ""
    return (
        f"the frequency of the vibration changes, which moves events by {found.moved_px:.2f} px or more; record while "
        "it is steady, or a shorter time"
    )


@refused.register
def _(found: BlindTime) -> str:
    if found.moved_px <= limits.LARGEST_BLIND_PX:
        return ""
    return f"{_blindness_in_words(found)}; over {limits.LARGEST_BLIND_PX:g} px are refused"


@warned.register
def _(found: BlindTime) -> Sequence[str]:
    return [_blindness_in_words(found)] if found.moved_px >= limits.NOTABLE_BLIND_PX else []


def _blindness_in_words(found: BlindTime) -> str:
    period = "the sensor's refractory period"
    remedy = "let the image move less, or more slowly"
    if found.sensor.refractory_us is None:
        period += f" if that is {limits.REFRACTORY_DOUBT_US:g} us"
        remedy = f"give the period by --refractory-us, or {remedy}"
    return f"the image moves by up to {found.moved_px:.2f} px within {period}, so that events are lost: {remedy}"


def refractory_doubt_us(sensor: SensorTiming) -> float:
    """Return the standard deviation of a sensor's refractory period [us]."""
    if sensor.refractory_us is None:
        return limits.REFRACTORY_DOUBT_US
    return limits.KNOWN_SHARE * sensor.refractory_us


@refused.register
def _(found: RefractoryDoubt) -> str:
    return "" if found.moved_px <= limits.LARGEST_DOUBT_PX else _doubt_in_words(found)


@warned.register
def _(found: RefractoryDoubt) -> Sequence[str]:
    return [_doubt_in_words(found)] if found.moved_px >= limits.NOTABLE_DOUBT_PX else []


def _doubt_in_words(found: RefractoryDoubt) -> str:
    known = found.sensor.refractory_us
    given = "which is not given" if known is None else f"given as {known:.0f} us"
    remedy = "give it by --refractory-us" if known is None else "let the image move less"
    return (
        f"the image moves fast for the sensor: an error of {refractory_doubt_us(found.sensor):.0f} us in its "
        f"refractory period, {given}, changes the answer by {found.moved_px:.2f} px; {remedy}"
    )


# Camera, prism and consistency.


@refused.register
def _(found: Shake) -> str:
    return (
        f"the camera shakes with the prism, by {found.amplitude_px:.2f} px or more, which looks like a weaker or "
        "stronger prism; mount the camera apart from the motor, or balance the prism; a given refractive index that is "
        "wrong by 0.1 or more looks alike"
    )


@refused.register
def _(found: LensBeyondCorrection) -> str:
    values = ", ".join(f"{name} = {x:.4g}" for name, x in found.values.items())
    return (
        f"the given lens is wrong by more than can be corrected (the search ended at {values}): give its true field of "
        "view or focal length, and its distortion; a fisheye lens is no pinhole"
    )


@warned.register
def _(found: FlatSideCorrected) -> Sequence[str]:
    return [
        f"the events show that the flat face of the prism points to the {found.found.value}, not to the "
        f"{found.given.value}: the calibration uses this side"
    ]


@warned.register
def _(found: ParameterCorrected) -> Sequence[str]:
    name = found.name
    scale = 1.0
    unit = "" if name in ("k1", "fy_over_fx", "index") else " px"
    if units().get(name) == "rad":
        scale = math.degrees(1.0)
        unit = " deg"
    was, now, by = (scale * x for x in (found.given, found.found, found.std))
    remedy = ""
    if name in LENS:
        remedy = "; calibrate the lens"
    elif name == "index":
        remedy = "; give that of the glass"
    if abs(now - was) >= limits.CONTRADICTING * by:
        said = f"the events contradict {name} = {was:.5g}{unit}: it was corrected to"
    else:  # the other one of two, or what a later correction explains
        said = f"{name} = {was:.5g}{unit} was fitted too, and is"
    return [f"{said} {now:.5g} ± {by:.2g}{unit}{remedy}"]


@refused.register
def _(found: RivalCauses) -> str:
    return "" if found.apart_px <= limits.LARGEST_RIVAL_PX else rivals_in_words(found)


@warned.register
def _(found: RivalCauses) -> Sequence[str]:
    return [rivals_in_words(found)] if found.apart_px >= limits.NOTABLE_RIVAL_PX else []


def rivals_in_words(found: RivalCauses) -> str:
    """Return that two explanations explain the events equally well, and what to do."""
    remedy = " or ".join(
        f"--free apex,phase,{names}" for names in map(_freed, (found.taken, found.rival)) if names
    )
    return (
        f"the events do not tell whether {found.taken.words} or {found.rival.words} is wrong: both explain them as "
        f"well, and differ by {found.apart_px:.2f} px rms; choose the right one ({remedy})"
    )


def _freed(cause: SuspectedError) -> str:
    return ",".join(n for n in cause.names if n != FLAT_SIDE)


@refused.register
def _(check: Consistency) -> str:
    error_px = check.inconsistent_px()
    if error_px <= limits.LARGEST_INCONSISTENCY_PX:
        return ""
    cause = likeliest(check)
    return f"the answer differs by {error_px:.2f} px between parts of the image or of the recording: {cause}"


@warned.register
def _(check: Consistency) -> Sequence[str]:
    out = []
    # what was tried and did not lower the cost is no cause of a small error, unless it explains much
    first = check.likely[0] if check.likely else None
    if first is not None and (
        first.moved_px >= limits.NOTABLE_PX or first.gain >= limits.NOTABLE_GAIN
    ):
        out.append(
            f"the answer does not hold everywhere in the image: {first.cause.words} seems to be wrong, which amounts "
            f"to {first.moved_px:.2f} px rms"
        )
    elif max(check.spread) >= limits.NOTABLE_PX:
        what = "phase" if check.spread[1] > check.spread[0] else "size"
        out.append(
            f"the {what} of the orbit differs by {max(check.spread):.2f} px between parts of the image: "
            f"{likeliest(check)}"
        )
    size_drift, phase_drift = (abs(d) for d in check.drift)
    notable_phase = limits.NOTABLE_CLOCK_PX if CLOCK in check.hidden_px else limits.NOTABLE_PX
    if size_drift >= limits.NOTABLE_PX or phase_drift >= notable_phase:
        what = "phase" if phase_drift > size_drift else "size"
        out.append(
            f"the {what} of the orbit drifts over the recording by {max(size_drift, phase_drift):.2g} px rms or more: "
            "the scale or the clock of the encoder is wrong, or the camera moved"
        )
    if check.untold_px:
        out.append(
            "the events do not tell which side of the prism is flat; if the given one is wrong, the error is "
            f"{check.untold_px:.2f} px rms"
        )
    return out


def likeliest(check: Consistency) -> str:
    """Return the likeliest cause of an inconsistency, in words."""
    if check.likely:
        return f"{check.likely[0].cause.words} is wrong"
    if abs(check.drift[0]) >= max(check.spread):
        return "the camera or the scene moved"
    if check.spread[1] > check.spread[0]:
        return "the pixels are slow where it is dark, or the clock or the encoder is wrong"
    return "the lens is wrong, near things moved past the camera, or events were lost"


@refused.register
def _(found: StatedError) -> str:
    return "" if found.error_px <= limits.LARGEST_STATED_PX else _stated_in_words(found)


@warned.register
def _(found: StatedError) -> Sequence[str]:
    return [_stated_in_words(found)] if found.error_px >= limits.NOTABLE_STATED_PX else []


def _stated_in_words(found: StatedError) -> str:
    causes = {
        "thresholds": (
            "the scene's brightness changes by few contrast thresholds where the image moves: lower the sensor's "
            "thresholds, or show a scene with more contrast"
        ),
        "refractory": "the sensor's refractory period is not known well: give it by --refractory-us",
        "events": "there are few events: show a scene with more texture, or record for longer",
    }
    named = "; and ".join(causes[part] for part in found.parts)
    return (
        f"the events determine the motion of the image within {found.error_px:.2g} px only: {named}"
    )


# Lost events.


@warned.register
def _(found: Silence) -> Sequence[str]:
    if found.share < limits.LEAST_SILENCE:
        return []
    return [
        f"no events came in {100.0 * found.share:.0f} % of the time: the sensor or its link lost them; lower the "
        "event rate"
    ]


@refused.register
def _(found: MissingEvents) -> str:
    if found.step < limits.LARGEST_STEP:
        return ""
    return (
        "a third or more of the events are missing, so that brightness changes by more than one threshold between two "
        "events of a pixel: lower the event rate (thresholds, region of interest, slower prism), or record without a "
        "filter that drops events"
    )


@warned.register
def _(found: MissingEvents) -> Sequence[str]:
    if not limits.NOTABLE_STEP <= found.step < limits.LARGEST_STEP:
        return []
    return [
        "a fifth or more of the events are missing: lower the event rate, or record without a filter"
    ]
