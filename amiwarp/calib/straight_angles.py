"""Attempt with an error of the encoder corrected that repeats every turn."""

from __future__ import annotations

from dataclasses import replace

from amiwarp.calib.calibrator import Attempt, Calibrator, with_warnings
from amiwarp.calib.other_angles import LARGEST_STRAIGHT_COST_RATIO
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.angles import sum_of_harmonics
from amiwarp.calib.photometric.verdicts import harmonics_in_words
from amiwarp.optics.models.registry import MODELS

MORE_CORRECTIONS = 2
"""Largest number of times that a correction of the encoder's angles is corrected again, if an error of them is left."""


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
