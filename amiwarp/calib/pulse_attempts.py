"""Attempt with the path of the angle between pulses that come once a turn, found in the events."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from amiwarp.calib.calibrator import Attempt, Calibrator
from amiwarp.calib.other_angles import LARGEST_STRAIGHT_COST_RATIO, explains_more, on_angles
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.stated_errors import BOUND
from amiwarp.calib.photometric.verdicts import angle_names
from amiwarp.calib.prism_path import (
    GATE_PAIRS,
    GATE_TILES,
    PathFit,
    speed_in_words,
)
from amiwarp.calib.pulses import confirm, off_path, pulses_only, smooth_path
from amiwarp.calib.sharpness_search import Search
from amiwarp.calib.without_encoder import search_on
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, each_encoder, together
from amiwarp.optics.models.registry import MODELS

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


def with_path_between_pulses(
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
    if explains_more(again, tried, encoder):
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
    mended = on_angles(calibrator, together(found), words)
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
