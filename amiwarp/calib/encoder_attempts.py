"""Attempts with other angles instead of the encoder's, which may be wrong.

An encoder may have lost counts, give only pulses that come once a turn, have an error that repeats every turn, count in
the other direction or at another scale, or be swapped with the encoder of the other prism.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amiwarp.calib import checks, first_guess
from amiwarp.calib.calibrator import Attempt, Calibrator, with_warnings
from amiwarp.calib.lost_counts import Step, lost_counts, steps_in_words, without_steps
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.angles import sum_of_harmonics
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.stated_errors import BOUND
from amiwarp.calib.photometric.verdicts import angle_names, harmonics_in_words
from amiwarp.calib.preparation import prepare
from amiwarp.calib.prism_path import (
    GATE_PAIRS,
    GATE_TILES,
    PathFit,
    speed_in_words,
)
from amiwarp.calib.pulses import confirm, off_path, pulses_only, smooth_path
from amiwarp.calib.repeated_turns import steps_in_events
from amiwarp.calib.sharpness_search import Search
from amiwarp.calib.without_encoder import search_on
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder, each_encoder, together
from amiwarp.events.recording import Recording
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.prism import Prism
from amiwarp.results.calibration import (
    Calibration,
)

LARGEST_STRAIGHT_COST_RATIO = 1.05
"""Largest ratio of the photometric cost with a corrected encoder to the cost without, if the corrected answer is not
accepted with a low cost. A right answer may cost more by as much: two maps of the same scene differ so, and one of four
turns may no longer be whole at the corrected speed."""
CLEARLY_LOWER_RATIO = 0.95
"""Ratio of the costs without and with steps of the encoder below which the steps are taken out in any case, if the
events are not explained with them."""
MORE_CORRECTIONS = 2
"""Largest number of times that a correction of the encoder's angles is corrected again, if an error of them is left."""
QUADRATURE = (0.25, 0.5, 2.0, 4.0)
"""Scales of a quadrature encoder of which other edges are counted than stated."""
NEAR_QUADRATURE = 0.03
"""Largest relative difference of a found scale from one of :data:`QUADRATURE` that is taken for it."""
DOUBTFUL_PATH_RATIO = 0.9
"""Ratio of the costs with and without a path between pulses up to which the path is taken if the pulses confirm it, or
else the speed between them is said to vary. It was 0.85 where a speed that hunted by 3 % left 0.16 px; much noise makes
both costs high."""
VARYING_SPEED_TEXT = (
    "the encoder gives pulses only, and the speed between them varies or cannot be told from the events: the "
    "result may be off by a tenth of a pixel or more; let the motor turn more steadily, hold the camera still, or use "
    "an encoder with more samples a turn"
)
"""Warning about pulses between which the speed varies, or may vary."""
BETWEEN_PULSES = "a speed that varies between pulses"
"""Words of what could hide in the angle between pulses."""
LEAST_BETWEEN_PX = 0.01
"""Smallest deviation from the smooth path through pulses that is corrected [px rms]: half of an error that counts."""
DOUBT = 2.0
"""Number of standard deviations that are taken off a deviation which few pairs of events did not show. In a small
image, even pulses had 0.0107 +- 0.0013 px."""
KNOTS_BETWEEN_PULSES = 16.0
"""Number of knots in a turn for a path between pulses. With 8, a speed that hunted by 3 % four times a turn left 0.009
of 0.024 px, with 16 it left 0.002 px. The paths of a pair have as many each, but share them in the first look."""
GRADUAL_US = 5000
"""Duration of a step of an encoder's angle above which the events must tell how it came about [us]."""
LEAST_SCALE_ERROR = 0.003
"""Smallest relative error of an encoder's scale that is tried and reported. Three turns measure the scale to about
0.001."""


def with_mended_encoder(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
    """Put back counts that the encoder lost, or find the path between pulses that come once a turn.

    Return the calibrator of the mended recording, and its attempt; both unchanged if the events do not confirm it, but
    with what could hide between pulses.
    """
    encoder = calibrator.recording.encoder
    assert encoder is not None
    kind = MODELS[calibrator.settings.model]
    if kind.ANGLES > 1 and not kind.PRISM:  # commands may jump, and have no pulses
        return calibrator, tried
    if tried.search is None or not tried.search.space.sized:
        return calibrator, tried
    if any(map(pulses_only, each_encoder(encoder))):
        return _with_path_between_pulses(calibrator, tried, tried.search)

    try:
        mended = _with_all_counts(calibrator, tried)
    except AmiwarpError:  # the events do not determine the path
        return calibrator, tried
    if mended is None:
        return calibrator, tried
    again = mended.attempt()
    return (mended, again) if _explains_more(again, tried, encoder) else (calibrator, tried)


def _explains_more(again: Attempt, tried: Attempt, encoder: Encoder) -> bool:
    """Return whether an attempt with other angles than ``tried`` explains the events better.

    ``encoder`` is the one of the recording, with whose angles ``tried`` was made.
    """
    if again.calibration is None:
        return False
    if again.cost <= limits.LARGEST_COST_RATIO * tried.cost:
        return True
    if any(map(lost_counts, each_encoder(encoder))):
        return _repairs_steps(again, tried)
    return again.accepted and again.cost < tried.cost and not _something_moves(again)


def _repairs_steps(again: Attempt, tried: Attempt) -> bool:
    """Return whether an attempt without the encoder's steps is good enough to replace the attempt with them.

    No prism makes such steps: the attempt needs no lower cost, and what else is wrong is looked for next.
    """
    if tried.unexplained and again.cost <= CLEARLY_LOWER_RATIO * tried.cost:
        return True  # also if it is refused: an answer at impossible angles is no better
    has_harmonics = again.photometric is not None and bool(again.photometric.harmonics)
    may_be_judged = again.accepted or has_harmonics
    explains_as_much = _something_moves(tried) or not _something_moves(again)
    is_as_low = again.cost < LARGEST_STRAIGHT_COST_RATIO * tried.cost
    return may_be_judged and explains_as_much and is_as_low


def _something_moves(attempt: Attempt) -> bool:
    """Return whether an attempt leaves events unexplained, or explains them by a camera that turns."""
    return bool(attempt.unexplained or attempt.camera_turned)


def _with_path_between_pulses(
    calibrator: Calibrator, tried: Attempt, search: Search
) -> tuple[Calibrator, Attempt]:
    """Find the path between pulses if they are not evenly spaced, and calibrate again.

    Return the calibrator with this path, or with what could hide between pulses, and its attempt.
    """
    encoder = calibrator.recording.encoder
    assert encoder is not None
    doubtful = replace(calibrator, mended_words=VARYING_SPEED_TEXT)
    try:
        between = between_pulses(calibrator, tried, search)
    except AmiwarpError:  # the events do not determine the path
        return doubtful, tried

    # A path that was found in place of a turning camera's motion tells nothing of the pulses.
    untold_px = BOUND * between.std_px
    if not (tried.unexplained or tried.camera_turned):
        # The fit's own scatter is a part of the deviation, and is stated apart.
        scatter = min(between.std_px, between.deviation_px)
        left_px = math.sqrt(between.deviation_px**2 - scatter**2)
        bound_px = left_px + untold_px
        calibrator = replace(calibrator, hidden_px={BETWEEN_PULSES: bound_px})
    mended = between.calibrator
    if mended is None:
        return calibrator, tried

    mended = replace(mended, hidden_px={BETWEEN_PULSES: untold_px})
    again = mended.attempt()
    if _explains_more(again, tried, encoder):
        return mended, again
    if not again.accepted:
        return calibrator, tried
    hardly_worse = again.cost <= LARGEST_STRAIGHT_COST_RATIO * tried.cost
    if hardly_worse and not again.doubtful:
        return mended, again
    if again.cost <= DOUBTFUL_PATH_RATIO * tried.cost:
        confirmed = confirmed_by(mended, encoder) and not again.camera_turned
        return (mended, again) if confirmed else (doubtful, tried)
    return calibrator, tried


def confirmed_by(calibrator: Calibrator, encoder: Encoder) -> bool:
    """Return whether the pulses of an encoder lie on the paths that were found instead of their angles."""
    source = calibrator.recording.events
    if calibrator.mended is None:
        return False
    return all(
        confirm(pulses, path, source.t_first, source.t_last)
        for pulses, path in zip(each_encoder(encoder), each_encoder(calibrator.mended), strict=True)
        if pulses_only(pulses)
    )


def _with_all_counts(calibrator: Calibrator, tried: Attempt) -> Calibrator | None:
    """Return the calibrator of the recording without the steps of its encoders; None if there are none."""
    recording = calibrator.recording
    encoder = recording.encoder
    assert encoder is not None
    names = angle_names(MODELS[calibrator.settings.model])
    encoders = [*each_encoder(encoder)]
    gradual: list[int] = []
    said: list[str] = []
    for angle, each in enumerate(each_encoder(encoder)):
        steps, shown = _steps_of(each, recording, tried)
        if not steps:
            continue
        encoders[angle] = without_steps(each, steps)
        if any(step.last_us - step.first_us > GRADUAL_US for step in steps):
            gradual.append(angle)
        begin_us = recording.events.t_first + round(encoder.clock_offset_us)
        said.append(f"{steps_in_words(names[angle], steps, begin_us)}, as {shown} show")
    if not said:
        return None

    without = together(encoders)
    if gradual:
        without = _fitted_encoder(_on_angles(calibrator, without), gradual)
    words = (
        f"{' and '.join(said)}: it lost counts, or slipped. They were put back for this recording only: check its "
        "cable, supply and coupling"
    )
    return _on_angles(calibrator, without, words)


def _steps_of(
    encoder: Encoder, recording: Recording, tried: Attempt
) -> tuple[tuple[Step, ...], str]:
    """Return the steps of the encoder of one angle, and what shows them, in words.

    The index pulses, the encoder's samples and, if something is wrong or there is no index, the events tell them. The
    events of an optic with two angles do not repeat, so that they tell no steps, but confirm those of the samples.
    """
    steps = lost_counts(encoder)
    if steps and encoder.index_t is not None:
        return steps, "its index pulses"
    alone = recording.encoder is not None and recording.encoder.second is None
    if alone and (steps or tried.doubtful):
        steps = steps_in_events(recording, encoder) or steps
    return steps, "the events"


@dataclass(frozen=True)
class BetweenPulses:
    """What the events tell of the paths between pulses."""

    calibrator: Calibrator | None
    """The calibrator of the recording with these paths; None if they are evenly spaced."""
    deviation_px: float
    """How far the paths deviate from those through the pulses [px rms]."""
    std_px: float
    """Standard deviation of the paths [px rms]."""


def between_pulses(calibrator: Calibrator, tried: Attempt, search: Search) -> BetweenPulses:
    """Return what the events tell of the paths between the pulses of a recording.

    ``search`` is the search of ``tried``, an attempt at the pulses' angles. Few pairs of events tell first whether the
    paths deviate; all pairs decide where these leave it open, or found that something is wrong with two angles, of each
    of which they tell less.
    """
    source = calibrator.recording.events
    encoder = calibrator.recording.encoder
    assert encoder is not None
    given = each_encoder(encoder)
    angles = [angle for angle, each in enumerate(given) if pulses_only(each)]
    smooth = [smooth_path(each) if pulses_only(each) else each for each in given]
    path = together(smooth)
    recording = replace(calibrator.recording, encoder=path)
    start = search_on(path, _at_last_answer(search, tried))
    t = start.calibration_events.events.t
    v = start.space.to_vector(start.best)
    bent_px = [
        px_per_rad(start.space, v, angle)
        * float(np.std(smooth[angle].angle_at(t) - given[angle].angle_at(t)))
        for angle in angles
    ]
    must_be_found = tried.doubtful and len(angles) > 1
    evident = math.hypot(*bent_px) >= LEAST_BETWEEN_PX or must_be_found
    if not evident:
        quick = PathFit(recording, start, GATE_PAIRS, GATE_TILES, angles, KNOTS_BETWEEN_PULSES)
        evident = quick.deviates(LEAST_BETWEEN_PX)
        largest_px = quick.deviation_px() + BOUND * quick.std_px
        if not evident and largest_px < LEAST_BETWEEN_PX:
            return BetweenPulses(None, quick.deviation_px(), quick.std_px)
    knots = KNOTS_BETWEEN_PULSES * len(angles)
    fit = PathFit(recording, start, angles=angles, knots_per_turn=knots)
    path = fit.run()
    surely_px = fit.deviation_px() - DOUBT * fit.std_px
    is_shown = fit.shows(LEAST_BETWEEN_PX) and surely_px >= LEAST_BETWEEN_PX
    if not evident and not is_shown:
        return BetweenPulses(None, fit.deviation_px(), fit.std_px)

    names = angle_names(MODELS[calibrator.settings.model])
    found = [*each_encoder(path)]
    said: list[str] = []
    for angle in angles:
        # In the mean, the pulses lie on the path.
        off = off_path(given[angle], found[angle], source.t_first, source.t_last)
        found[angle] = replace(found[angle], angle=found[angle].angle - float(np.mean(off)))
        jitter_us = float(np.std(off)) / abs(given[angle].rpm) * 60e6 / math.tau
        which = names[angle].removesuffix("'s angle")
        said.append(
            f"{which} gives pulses only: the angle between them was found in the "
            f"events. The speed {speed_in_words(found[angle])}, and the pulses came {jitter_us:.0f} us rms early or "
            "late"
        )
    words = (
        f"{'; '.join(said)}. This holds for this recording only; if the camera moved, which looks the same, hold it "
        "still"
    )
    mended = _on_angles(calibrator, together(found), words)
    return BetweenPulses(mended, fit.deviation_px(), fit.std_px)


def _at_last_answer(search: Search, tried: Attempt) -> Search:
    """Return the search at the answer of the photometric stage, if it was accepted with the given camera and prism.

    Sharpness is some tenths of a pixel off, and residuals of that look like a path.
    """
    found = tried.calibration
    space = search.full_space
    if found is None or not tried.accepted:
        return search
    if (found.camera, found.prism) != (space.camera, space.prism):
        return search
    if found.parameters.keys() != search.best.keys():
        return search
    return search.at(found.parameters, stages=search.stages)


def _on_angles(calibrator: Calibrator, encoder: Encoder, said: str = "") -> Calibrator:
    """Return the calibrator with other angles instead of the recording's encoder, and why."""
    recording = replace(calibrator.recording, encoder=encoder)
    return replace(calibrator, recording=recording, mended=encoder, mended_words=said)


def _fitted_encoder(calibrator: Calibrator, angles: Sequence[int]) -> Encoder:
    """Return the recording's encoder, with some of its angles corrected by the paths that the events tell."""
    search = prepare(
        calibrator.recording,
        calibrator.settings,
        device=calibrator.device,
        progress=calibrator.progress,
    )[0]
    return PathFit(calibrator.recording, search.run(), angles=angles).run()


def with_straight_angles(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
    """Correct an error of the encoder that repeats every turn, if the events ask for it, and calibrate again.

    Return the calibrator of the corrected recording, and its attempt.
    """
    found = tried.photometric
    if found is None or not found.harmonics:
        return calibrator, tried

    corrected = _with_harmonics(calibrator, found.harmonics)
    again = corrected.attempt()
    for _ in range(MORE_CORRECTIONS):
        # a large error of one angle hides a smaller one of the other, or a part of its own
        left = () if again.photometric is None else again.photometric.harmonics
        if not left:
            break
        assert corrected.harmonics is not None
        angles = MODELS[calibrator.settings.model].ANGLES
        both = sum_of_harmonics(corrected.harmonics, left, angles)
        further = _with_harmonics(calibrator, both)
        next_attempt = further.attempt()
        if next_attempt.cost >= again.cost:
            break
        corrected = further
        again = next_attempt

    holds = again.accepted and again.cost <= limits.LARGEST_STILL_COST
    hardly_worse = again.cost <= LARGEST_STRAIGHT_COST_RATIO * tried.cost
    if again.calibration is None or not (holds or hardly_worse):
        return calibrator, tried
    if tried.accepted and not (again.accepted and again.cost < tried.cost):
        return calibrator, tried

    # A very wrong camera looks like both errors.
    assert again.photometric is not None
    more_freed = {*again.photometric.parameters} - {*found.parameters}
    if more_freed:
        rival = calibrator.attempt(angles_hold=True)
        if rival.accepted and rival.cost <= again.cost:
            return calibrator, rival

    assert corrected.harmonics is not None
    kind = MODELS[calibrator.settings.model]
    said = f"{harmonics_in_words(kind, corrected.harmonics)}: it was corrected"
    return corrected, Attempt(with_warnings(again.calibration, said))


def _with_harmonics(calibrator: Calibrator, harmonics: tuple[float, ...]) -> Calibrator:
    """Return the calibrator of the recording with an error of its encoder corrected that repeats every turn."""
    encoder = calibrator.recording.encoder
    assert encoder is not None
    straight = replace(calibrator.recording, encoder=encoder.with_harmonics(harmonics))
    return replace(calibrator, recording=straight, harmonics=harmonics)


@dataclass(frozen=True)
class WrongEncoder:
    """An encoder that turns the wrong way or has a wrong scale, as the events show."""

    cost: float
    """Photometric cost with the encoder corrected."""
    error: AmiwarpError
    """The error that says what is wrong."""


def with_other_encoder(calibrator: Calibrator, tried: Attempt) -> WrongEncoder | None:
    """Return what is wrong with the encoder's direction or scale; None if no correction lowers the cost enough."""
    recording = calibrator.recording
    encoder = recording.encoder
    assert encoder is not None
    for scale in _other_scales(calibrator):
        if abs(scale - 1.0) < LEAST_SCALE_ERROR:
            continue
        corrected = replace(encoder, angle=encoder.angle / scale, index_t=None)
        other = replace(calibrator, recording=replace(recording, encoder=corrected))
        again = other.attempt(tried)
        # a slipping index remains as an error that repeats every turn
        slips = again.photometric is not None and again.photometric.harmonics
        if not (again.accepted or slips):
            continue
        if again.cost > limits.LARGEST_COST_RATIO * tried.cost:
            continue
        if scale < 0.0:
            error = checks.wrong_direction(recording.name, tried.cost, again.cost)
        else:
            error = checks.wrong_scale(
                recording.name, scale, "the events repeat", tried.cost, again.cost
            )
        return WrongEncoder(again.cost, error)
    return None


def _other_scales(calibrator: Calibrator) -> list[float]:
    """Return the turns that the encoder may show for one turn of the prism. -1 is backwards, which is tried first.

    The events of a still scene repeat every turn of the prism. If they repeat at another encoder angle, the
    encoder's scale may be wrong.
    """
    encoder = calibrator.recording.encoder
    assert encoder is not None
    try:
        found = first_guess.encoder_turns_per_period(calibrator.recording, encoder)
    except AmiwarpError:  # the events do not repeat: the scene or the camera moves
        return [-1.0]
    near = [scale for scale in QUADRATURE if abs(found / scale - 1.0) < NEAR_QUADRATURE]
    return [-1.0, *near, found]


def with_order_examined(calibrator: Calibrator, found: Calibration) -> Calibration:
    """Return the calibration, with a warning if the encoders of two prisms seem to be swapped.

    Raises :class:`AmiwarpError` for it if the prisms are far from their nominal sizes.
    """
    recording = calibrator.recording
    encoder = recording.encoder
    nominal_prism = recording.prism
    if not isinstance(nominal_prism, Prism) or encoder is None or encoder.second is None:
        return found
    if not checks.look_swapped(found.parameters, nominal_prism):
        return found
    first, second = each_encoder(encoder)
    exchanged = together([second, first])
    again = replace(calibrator, recording=replace(recording, encoder=exchanged)).attempt()
    if not again.accepted or checks.look_swapped(again.found().parameters, nominal_prism):
        return found
    said = checks.swapped_encoders(found.parameters, again.found().parameters, nominal_prism)
    if checks.pair_is_far(found.parameters, nominal_prism):
        raise AmiwarpError(f"{recording.name}: {said}", ErrorCode.CALIBRATION_REFUSED)
    return with_warnings(found, said)
