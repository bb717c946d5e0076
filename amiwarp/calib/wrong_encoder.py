"""Encoders that count in the other direction, at another scale, or for the other prism, as the events show."""

from __future__ import annotations

from dataclasses import dataclass, replace

from amiwarp.calib import checks, first_guess
from amiwarp.calib.calibrator import Attempt, Calibrator, with_warnings
from amiwarp.calib.photometric import limits
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import each_encoder, together
from amiwarp.optics.prism import Prism
from amiwarp.results.calibration import Calibration

QUADRATURE = (0.25, 0.5, 2.0, 4.0)
"""Scales of a quadrature encoder of which other edges are counted than stated."""
NEAR_QUADRATURE = 0.03
"""Largest relative difference of a found scale from one of :data:`QUADRATURE` that is taken for it."""
LEAST_SCALE_ERROR = 0.003
"""Smallest relative error of an encoder's scale that is tried and reported. Three turns measure the scale to about
0.001."""


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
    assert isinstance(nominal_prism, Prism)
    assert encoder is not None
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
