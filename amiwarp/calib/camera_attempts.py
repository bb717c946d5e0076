"""Attempts for a camera that moves: with its rotation free, a growing image, or a gyroscope."""

from __future__ import annotations

import math
from dataclasses import replace

from amiwarp.calib import calm_span, checks
from amiwarp.calib.calibrator import Attempt, Calibrator, with_warnings
from amiwarp.calib.gyroscope import find_gyroscope
from amiwarp.calib.photometric import limits
from amiwarp.calib.preparation import (
    camera_of,
)
from amiwarp.calib.turn_by_turn import (
    CONFIRMED_PX,
    LEAST_GYROSCOPE_TURNS,
    LEAST_TURNS,
    MOST_GYROSCOPE_TURNS,
    turn_by_turn,
    turns_of,
)
from amiwarp.errors import AmiwarpError
from amiwarp.optics.models.comparison import predicted_error
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.prism import Plate
from amiwarp.results.calibration import (
    Calibration,
)
from amiwarp.results.parameters import GROWTH, MOTION, RATES

LEAST_LONGER = 1.5
"""Length of a recording above which its ends can confirm the answer of its middle, as a multiple of the length of a
calm span. Each end then begins half a turn from the middle span."""
LEAST_GROWTH_DEVIATIONS = 5.0
"""Smallest growth of the image that is taken for one [standard deviations]."""


def with_rotation(calibrator: Calibrator, tried: Attempt) -> Attempt:
    """Return the attempt with a free camera rotation if that lowers the photometric cost enough; else ``tried``.

    It uses two turns of the prism: the calmest ones, if these are clearly calmer than those in the middle of the
    recording. A camera that never rests must give about the same answer at other times. Otherwise the answer is
    the mean of many turns, or an error if the recording is too short for it, or no motion explains its turns.
    """
    encoder = calibrator.recording.encoder
    name = calibrator.recording.name
    assert encoder is not None
    # With two angles, a still scene does not repeat every turn.
    repetition = 1.0
    span = None
    if MODELS[calibrator.settings.model].ANGLES == 1:
        repetition, span = calm_span.calmest_span(calibrator.recording, encoder)
    restless = repetition < calm_span.LEAST_REPETITION
    calm = repetition >= calm_span.LEAST_CALM

    turns = turns_of(calibrator)
    many = len(turns) >= LEAST_TURNS
    too_fast = Attempt(None, checks.moves_too_fast(name, repetition, short=not many))
    if restless and many:
        mean = turn_by_turn(calibrator, tried, turns)
        return mean or (tried if tried.accepted else too_fast)

    rival = None if tried.camera_turned else tried  # a slow rotation hardly blurs the image
    again = calibrator.turning(rival) if span is None else calibrator.turning_in(span)
    if calm and span is None:
        growing = _growing(calibrator, tried, again)
        if growing is not None:
            return growing

    if not again.accepted or again.cost > limits.LARGEST_COST_RATIO * tried.cost:
        # a rotation makes the image sharper, or the attempt would have failed
        sharper = rival is not None and again.calibration is not None
        if restless and not tried.accepted and sharper:
            return too_fast
        if many and not calm and not tried.accepted:
            return turn_by_turn(calibrator, tried, turns) or too_fast
        return tried

    # Two wrong answers may be alike by chance
    apart_px = CONFIRMED_PX if many else limits.LARGEST_INCONSISTENCY_PX
    to_confirm = not calm or (many and again.unexplained)
    if to_confirm and not _is_confirmed(calibrator, again, apart_px):
        mean = turn_by_turn(calibrator, tried, turns) if many else None
        if mean is not None or not calm:
            return mean or too_fast

    calmest = ""
    if span is not None:
        since = ((t - calibrator.recording.events.t_first) * 1e-6 for t in span)
        calmest = ", from {:.2f} to {:.2f} s, where the camera is calmest".format(*since)
    return Attempt(without_rotation(again.found(), calmest))


def with_gyroscope(calibrator: Calibrator, tried: Attempt) -> Attempt | None:
    """Return the mean of the answers of turns whose rotation the gyroscope tells, for a camera in fast motion.

    The recording has samples of an inertial measurement unit. None if there is no fast motion. If the gyroscope cannot
    be used, the attempt has an error that says why.
    """
    recording = calibrator.recording
    encoder = calibrator.recording.encoder
    if encoder is None:
        return None
    if calibrator.settings.free is not None or not tried.doubtful:
        return None
    kind = MODELS[calibrator.settings.model]
    if kind.ANGLES > 1 or kind.GLASS is Plate or not encoder.rpm:
        return None
    if calm_span.calmest_span(recording, encoder)[0] >= calm_span.LEAST_CALM:
        return None
    try:
        gyroscope = find_gyroscope(recording, encoder, camera_of(recording))
        turns = turns_of(calibrator, gyroscope.span, MOST_GYROSCOPE_TURNS)
        if len(turns) < LEAST_GYROSCOPE_TURNS:
            raise checks.short_gyroscope(recording.name, len(turns), LEAST_GYROSCOPE_TURNS)
        path = gyroscope.path((turns[0][0], turns[-1][1]))
    except AmiwarpError as error:
        return Attempt(None, error)
    turned = replace(calibrator, turned=path)
    found = turn_by_turn(turned, tried, turns, gyroscope.in_words())
    return found or Attempt(None, checks.unexplained_by_gyroscope(recording.name))


def _growing(calibrator: Calibrator, tried: Attempt, turning: Attempt) -> Attempt | None:
    """Return the attempt with a growing image, if that explains the events better than a rotation; else None.

    ``turning`` is the attempt with a free rotation, of the same two turns. Those hold less of any slow change than
    the whole recording, so that a rotation seems to explain it.
    """
    encoder = calibrator.recording.encoder
    assert encoder is not None
    free = (*MODELS[calibrator.settings.model].freed(encoder.ratio), GROWTH)
    growing = replace(calibrator, settings=replace(calibrator.settings, free=free)).attempt()
    most_cost = limits.LARGEST_COST_RATIO * tried.cost
    if turning.accepted:
        most_cost = min(most_cost, turning.cost)
    if not growing.accepted or growing.cost > most_cost:
        return None
    found = growing.found()
    growth = found.parameters[GROWTH]
    std = found.uncertainty[GROWTH]
    if abs(growth) < LEAST_GROWTH_DEVIATIONS * std:
        return None
    how = "grew" if growth > 0.0 else "shrank"
    warning = (
        f"the image {how} by {100.0 * abs(growth):.2g} % a second, which was calibrated together with the prism: "
        "the focal length drifts, or the camera moves along its axis"
    )
    return Attempt(with_warnings(_without_motion(found), warning))


def _is_confirmed(calibrator: Calibrator, turning: Attempt, apart_px: float) -> bool:
    """Return whether the answer of the last or the first turns is at most ``apart_px`` from the answer of the middle.

    A motion with frequencies near the prism's changes the orbit by another amount at each time. Where there
    is no other answer, a low cost must do.
    """
    source = calibrator.recording.events
    encoder = calibrator.recording.encoder
    assert encoder is not None
    length_us = int(calm_span.CALM_TURNS * 60e6 / abs(encoder.rpm))
    if source.t_last - source.t_first < LEAST_LONGER * length_us:
        return not turning.unexplained

    at_the_end = (source.t_last - length_us, source.t_last)
    at_the_start = (source.t_first, source.t_first + length_us)
    for span in (at_the_end, at_the_start):
        other = calibrator.turning_in(span)
        if other.accepted:
            apart = predicted_error(turning.found().model, other.found().model, grid=8)
            return apart.rms <= apart_px
    return not turning.unexplained


def without_rotation(found: Calibration, calmest: str = "") -> Calibration:
    """Return the calibration without the camera's rotation, with a warning that it was found.

    ``calmest`` says from when to when the camera was calmest, if only these events were used.
    """
    speed = math.degrees(math.hypot(*(found.parameters[name] for name in RATES)))
    mover = MODELS[found.model_name].MOVER
    warning = f"the camera turned at {speed:.1f} deg/s; its rotation was calibrated together with the {mover}{calmest}"
    return with_warnings(_without_motion(found), warning)


def _without_motion(found: Calibration) -> Calibration:
    """Return the calibration with the prism's parameters only: the camera's motion holds for two turns."""
    return replace(
        found,
        parameters={n: x for n, x in found.parameters.items() if n not in MOTION},
        uncertainty={n: x for n, x in found.uncertainty.items() if n not in MOTION},
        free=tuple(n for n in found.free if n not in MOTION),
        middle_us=None,
    )
