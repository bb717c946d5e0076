"""Attempts at a calibration, one after the other, to be read from top to bottom.

If the first attempt says that something is wrong, :func:`calibrated` makes further ones. With an encoder:

1. with counts that the encoder lost put back, or with the path between pulses that come once a turn found in the events
2. with an error of the encoder that repeats every turn corrected
3. without hot and flickering pixels, if no brightness map explains the events
4. then one of these: without the parts of the image in which something moves; or, if no map explains the events, with
   the encoder's direction or scale corrected, which ends in an error that says so, or with the camera's rotation free;
   or with the rotation free, if it explains much of the rest at a low cost. A camera that never rests is calibrated
   turn by turn. The rotation is dropped from the result

Without an encoder, an attempt also examines whether the prism's speed varies, and finds the path of its angle. Another
attempt corrects an error of the path that repeats every turn. What a single attempt does is in ``calibrator.py``.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from amiwarp.calib import checks
from amiwarp.calib.bad_pixels import MaskedEventSource, find_bad_pixels, searched_part
from amiwarp.calib.calibrator import Attempt, Calibrator, hiding, with_warnings
from amiwarp.calib.camera_attempts import with_gyroscope, with_rotation, without_rotation
from amiwarp.calib.coarse_encoder import hidden_by_rounding, rounding_in_words
from amiwarp.calib.lost_count_attempts import with_all_counts
from amiwarp.calib.photometric import causes, limits
from amiwarp.calib.prism_path import speed_in_words
from amiwarp.calib.pulse_attempts import with_path_between_pulses
from amiwarp.calib.pulses import pulses_only
from amiwarp.calib.sharpness_search import Search
from amiwarp.calib.straight_angles import with_straight_angles
from amiwarp.calib.thinning import middle_time
from amiwarp.calib.uneven_prism import with_rival_shape
from amiwarp.calib.wrong_encoder import with_order_examined, with_other_encoder
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder, each_encoder
from amiwarp.optics.models.registry import MODELS, size_names
from amiwarp.optics.prism import Plate, Prism
from amiwarp.results.calibration import (
    Calibration,
    constant_speed,
)

LEAST_BAD_SHARE = 0.01
"""Share of the events on hot or flickering pixels above which these pixels are masked."""


def calibrated(calibrator: Calibrator) -> Calibration:
    """Return the calibration of ``settings.model``; raise :class:`AmiwarpError` as :func:`calibrate` does."""
    began = time.perf_counter()
    tried = calibrator.attempt()
    if "photometric" not in calibrator.settings.stages:
        return _with_assumptions(calibrator, tried.found())

    last = calibrator
    by_gyroscope = None
    if calibrator.recording.imu is not None:
        by_gyroscope = with_gyroscope(last, tried)
    unused_gyroscope = ""
    if by_gyroscope is not None and by_gyroscope.error is not None:
        unused_gyroscope = str(by_gyroscope.error)

    if by_gyroscope is not None and not unused_gyroscope:
        tried = by_gyroscope
    elif calibrator.recording.encoder is not None:
        last, tried = _with_encoder(last, tried)
    elif MODELS[calibrator.settings.model].PRISM:
        tried = with_straight_path(last, tried)
    else:
        tried = of_turning_vibration(last, at_found_speed(last, tried))
    if unused_gyroscope and tried.error is not None:
        raise AmiwarpError(f"{tried.error}; {unused_gyroscope}") from tried.error

    found = replace(tried.found(), harmonics=last.harmonics)
    found = _with_assumptions(calibrator, found)
    if unused_gyroscope:
        found = with_warnings(found, unused_gyroscope)
    if last.mended is not None:
        found = replace(found, path=last.mended)
    if last.mended_words:
        found = with_warnings(found, last.mended_words)
    found = hiding(found, last.hidden_px)
    if not tried.accepted:
        raise _rejected(found, calibrator.recording.name)

    found = _with_shape_examined(last, found)
    return replace(found, seconds=time.perf_counter() - began)


def _with_encoder(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
    """Make the further attempts for a recording with an encoder.

    Return the calibrator with what they found of the encoder and of bad pixels, and the attempt that holds.
    """
    given = calibrator
    search = tried.search
    calibrator, tried = with_mended_encoder(calibrator, tried)
    straight, straight_tried = with_straight_angles(calibrator, tried)
    last, answer = _with_camera_examined(straight, straight_tried)
    is_doubtful = straight_tried.camera_turned or straight_tried.unexplained
    if is_doubtful and straight.harmonics != calibrator.harmonics:
        # A camera that turns looks like errors of the angles, too: the lower cost decides.
        held = calibrator.attempt(angles_hold=True)
        uncorrected, rival = _with_camera_examined(calibrator, held)
        if rival.accepted and not (answer.accepted and answer.cost <= rival.cost):
            last = uncorrected
            answer = rival
    if search is not None and last.mended is None:
        assert given.recording.encoder is not None
        last = with_rounding_named(last, search, given.recording.encoder)
    return last, answer


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
        return with_path_between_pulses(calibrator, tried, tried.search)
    return with_all_counts(calibrator, tried)


def _with_camera_examined(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
    """Make the attempts for bad pixels, moving things and a camera that turns, with angles that are right.

    Return the calibrator with what they found of bad pixels, and the attempt that holds.
    """
    if MODELS[calibrator.settings.model].GLASS is Plate:
        return calibrator, tried  # its depths are found from a camera at rest
    if tried.unexplained:
        calibrator, tried = without_bad_pixels(calibrator, tried)

    if tried.moving.any():
        tried = without_moving_parts(calibrator, tried)
    elif tried.unexplained:
        tried = explained(calibrator, tried)
    elif calibrator.settings.free is None and tried.camera_turned:
        turning = with_rotation(calibrator, tried)
        tried = _with_turning_named(tried) if turning is tried else turning
    return calibrator, tried


def with_rounding_named(calibrator: Calibrator, search: Search, encoder: Encoder) -> Calibrator:
    """Return the calibrator with what the steps of a coarse encoder hide, and a warning of them.

    ``encoder`` is the one of the recording as it was given.
    """
    if not search.space.sized:
        return calibrator
    hidden_px = {**calibrator.hidden_px, **hidden_by_rounding(search, encoder)}
    said = [*filter(None, [calibrator.mended_words]), *rounding_in_words(search, encoder)]
    return replace(calibrator, hidden_px=hidden_px, mended_words="; ".join(said))


def _with_turning_named(tried: Attempt) -> Attempt:
    """Return an attempt whose camera turned, with a warning that its rotation was not found."""
    if tried.photometric is None or not tried.accepted:
        return tried
    warning = (
        f"the camera turned: a slow rotation explains {100 * tried.photometric.rotation_gain:.0f} % of the residual, "
        "but none was found that explains the events; hold the camera still"
    )
    return replace(tried, calibration=with_warnings(tried.found(), warning))


def _with_assumptions(calibrator: Calibrator, found: Calibration) -> Calibration:
    """Return the calibration, with warnings of an assumed sensor size and of a speed that is not constant."""
    found = with_warnings(found, *checks.size_warnings(calibrator.recording))
    if found.path is None or calibrator.path is not None:
        return found
    return with_warnings(
        found,
        f"the prism's speed is not constant: it {speed_in_words(found.path)}; if the camera or the scene moved, which "
        "looks the same, hold it still, or use an encoder; the path that was found holds for this recording only",
    )


def _rejected(found: Calibration, name: str) -> AmiwarpError:
    """Return the error that the photometric stage rejected its answer.

    The answer of sharpness alone, which is left, may be off by tenths of a pixel.
    """
    reasons = [warning for warning in found.warnings if "photometric" in warning]
    return AmiwarpError(
        f"{name}: {'; '.join(reasons)}; the result of the sharpness stage alone may be off by "
        "several tenths of a pixel: accept it with --stages sharpness, or record a scene that stays still",
        ErrorCode.CALIBRATION_REFUSED,
    )


def _with_shape_examined(calibrator: Calibrator, found: Calibration) -> Calibration:
    """Return the calibration, with warnings if another shape or order of the prisms fits as well.

    Raises :class:`AmiwarpError` if the prism is far from its nominal size, unless the settings say where to look.
    """
    recording = calibrator.recording
    settings = calibrator.settings
    found = with_rival_shape(found, settings.free)
    sizes_given = size_names() & {*settings.bounds, *settings.start}
    if isinstance(recording.prism, Prism) and not sizes_given:
        if recording.encoder is not None and recording.encoder.second is not None:
            found = with_order_examined(calibrator, found)
        checks.check_nominal(found.model_name, found.parameters, recording.prism, recording.name)
    return found


def with_straight_path(calibrator: Calibrator, tried: Attempt) -> Attempt:
    """Correct an error of the path that repeats every turn, if the events ask for it, and calibrate again."""
    found = tried.calibration
    if found is None or found.path is None:
        return tried
    if found.photometric is None or not found.photometric.harmonics:
        return tried

    # The angle stays 0 in the middle of the recording.
    path = found.path.with_harmonics(found.photometric.harmonics)
    zero = float(path.angle_at([middle_time(calibrator.recording)])[0])
    straight = replace(path, angle=path.angle - zero)
    again = replace(calibrator, path=straight).attempt()
    if again.calibration is None or again.cost > tried.cost:
        return tried
    if tried.accepted and not again.accepted:
        return tried
    return again


def at_found_speed(calibrator: Calibrator, tried: Attempt) -> Attempt:
    """Calibrate again at the speed that was found: known angles let the sensor's timing be examined."""
    found = tried.calibration
    if found is None or found.zero_us is None or not tried.accepted or "rpm" not in found.free:
        return tried
    held: dict[str, float] = {}
    if not calibrator.settings.free:
        held = causes.without_doubtful_harmonic(found.parameters, found.uncertainty)
    known = {name: value for name, value in found.parameters.items() if name != "rpm"}
    free = tuple(name for name in found.free if name != "rpm" and name not in held)
    settings = replace(
        calibrator.settings, free=free, start={**known, **held}, global_algorithm=None
    )
    speed = found.parameters["rpm"]
    events = calibrator.recording.events
    path = constant_speed(speed, events.t_first, events.t_last, found.zero_us)
    again = replace(calibrator, settings=settings, path=path).attempt()
    if again.calibration is None:
        return again

    # The result says the speed again as a parameter that was found.
    calibration = replace(
        again.calibration,
        path=None,
        free=(*again.calibration.free, "rpm"),
        parameters={**again.calibration.parameters, "rpm": speed},
        uncertainty={**again.calibration.uncertainty, "rpm": found.uncertainty["rpm"]},
        stages=(*found.stages, *again.calibration.stages),
    )
    return replace(again, calibration=calibration)


def of_turning_vibration(calibrator: Calibrator, tried: Attempt) -> Attempt:
    """Free the rotation of a vibrating camera if it may have turned, and calibrate again at the speed that is found.

    Return the attempt with the rotation free if it lowers the cost enough; else ``tried``, with a warning if it was
    accepted although its cost is too high for it to be examined.
    """
    unexamined = tried.cost > limits.LARGEST_EXAMINED_COST
    if calibrator.settings.free is not None or not (unexamined or tried.camera_turned):
        return tried
    again = at_found_speed(calibrator, calibrator.turning(None))
    lower = again.cost <= limits.LARGEST_COST_RATIO * tried.cost
    if again.accepted and lower and again.cost <= limits.LARGEST_EXAMINED_COST:
        return replace(again, calibration=without_rotation(again.found()))
    if not tried.accepted:
        return tried
    if unexamined:
        warning = (
            f"{100 * tried.cost:.0f} % of the residual remains, too much for the answer to be examined: much noise, or "
            "the camera turned while it vibrated; it may be off by tenths of a pixel: hold the camera where it only "
            "vibrates, and lower the sensor's sensitivity"
        )
        return replace(tried, calibration=with_warnings(tried.found(), warning))
    return _with_turning_named(tried)


def without_bad_pixels(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
    """Mask hot and flickering pixels if they have a notable share of the events, and calibrate without them.

    Return the calibrator of the masked recording, and its attempt unless only the first one was accepted.
    Raises :class:`AmiwarpError` if most pixels flicker.
    """
    source = calibrator.recording.events
    encoder = calibrator.recording.encoder
    assert encoder is not None
    mask, summary = find_bad_pixels(searched_part(source, encoder), encoder, source.size)
    if summary.share < LEAST_BAD_SHARE:
        return calibrator, tried
    checks.check_light(mask, summary, calibrator.recording.name)
    recording = replace(calibrator.recording, events=MaskedEventSource(source, mask))
    cleaned = replace(calibrator, recording=recording)
    again = cleaned.attempt()
    if tried.accepted and not again.accepted:
        return cleaned, tried
    if again.calibration is None:
        return cleaned, again
    return cleaned, Attempt(with_warnings(again.calibration, str(summary)))


def without_moving_parts(calibrator: Calibrator, tried: Attempt) -> Attempt:
    """Calibrate from the parts of the image in which nothing moves."""
    source = calibrator.recording.events
    width, height = source.size
    rows, columns = tried.moving.shape
    part_row = np.arange(height) * rows // height
    part_column = np.arange(width) * columns // width
    mask = tried.moving[part_row][:, part_column]
    recording = replace(calibrator.recording, events=MaskedEventSource(source, mask))
    again = replace(calibrator, recording=recording).attempt()
    warning = f"something moves: {100 * mask.mean():.0f} % of the view are left out"
    if again.accepted and not again.unexplained:
        return Attempt(with_warnings(again.found(), warning))
    return Attempt(
        None,
        AmiwarpError(
            f"{calibrator.recording.name}: {warning}, but the rest does not determine the prism; "
            "record a scene that stays still",
            ErrorCode.CALIBRATION_REFUSED,
        ),
    )


def explained(calibrator: Calibrator, tried: Attempt) -> Attempt:
    """Return the attempt with a free camera rotation, the error of a wrong encoder, or ``tried`` unchanged.

    The encoder's direction and scale are examined first, because they take few searches. If a correction of them
    leaves a high cost, the cause with the lower cost is taken.
    """
    wrong = with_other_encoder(calibrator, tried)
    if wrong is not None and wrong.cost <= limits.LARGEST_STILL_COST:
        return Attempt(None, wrong.error)

    moving = tried
    if calibrator.settings.free is None:
        moving = with_rotation(calibrator, tried)
    if wrong is None:
        return moving
    if moving is not tried and moving.cost <= wrong.cost:
        return moving
    return Attempt(None, wrong.error)
