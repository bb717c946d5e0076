"""Attempt without the steps of an encoder that lost counts, or slipped."""

from __future__ import annotations

from collections.abc import Sequence

from amiwarp.calib.calibrator import Attempt, Calibrator
from amiwarp.calib.lost_counts import Step, lost_counts, steps_in_words, without_steps
from amiwarp.calib.other_angles import explains_more, on_angles
from amiwarp.calib.photometric.verdicts import angle_names
from amiwarp.calib.preparation import prepare
from amiwarp.calib.prism_path import PathFit
from amiwarp.calib.repeated_turns import steps_in_events
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, each_encoder, together
from amiwarp.events.recording import Recording
from amiwarp.optics.models.registry import MODELS

GRADUAL_US = 5000
"""Duration of a step of an encoder's angle above which the events must tell how it came about [us]."""


def with_all_counts(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
    """Put back counts that the encoder lost, and calibrate again.

    Return the calibrator of the mended recording, and its attempt; both unchanged if the events do not confirm it.
    """
    encoder = calibrator.recording.encoder
    assert encoder is not None
    try:
        mended = without_lost_counts(calibrator, tried)
    except AmiwarpError:  # the events do not determine the path
        return calibrator, tried
    if mended is None:
        return calibrator, tried
    again = mended.attempt()
    return (mended, again) if explains_more(again, tried, encoder) else (calibrator, tried)


def without_lost_counts(calibrator: Calibrator, tried: Attempt) -> Calibrator | None:
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
        without = _fitted_encoder(on_angles(calibrator, without), gradual)
    words = (
        f"{' and '.join(said)}: it lost counts, or slipped. They were put back for this recording only: check its "
        "cable, supply and coupling"
    )
    return on_angles(calibrator, without, words)


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


def _fitted_encoder(calibrator: Calibrator, angles: Sequence[int]) -> Encoder:
    """Return the recording's encoder, with some of its angles corrected by the paths that the events tell."""
    search = prepare(
        calibrator.recording,
        calibrator.settings,
        device=calibrator.device,
        progress=calibrator.progress,
    )[0]
    return PathFit(calibrator.recording, search.run(), angles=angles).run()
