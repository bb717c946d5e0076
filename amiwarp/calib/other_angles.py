"""Other angles instead of the encoder's, which may be wrong: whether they explain the events better."""

from __future__ import annotations

from dataclasses import replace

from amiwarp.calib.calibrator import Attempt, Calibrator
from amiwarp.calib.lost_counts import lost_counts
from amiwarp.calib.photometric import limits
from amiwarp.events.encoder import Encoder, each_encoder

LARGEST_STRAIGHT_COST_RATIO = 1.05
"""Largest ratio of the photometric cost with a corrected encoder to the cost without, if the corrected answer is not
accepted with a low cost. A right answer may cost more by as much: two maps of the same scene differ so, and one of four
turns may no longer be whole at the corrected speed."""
CLEARLY_LOWER_RATIO = 0.95
"""Ratio of the costs without and with steps of the encoder below which the steps are taken out in any case, if the
events are not explained with them."""


def on_angles(calibrator: Calibrator, encoder: Encoder, said: str = "") -> Calibrator:
    """Return the calibrator with other angles instead of the recording's encoder, and why."""
    recording = replace(calibrator.recording, encoder=encoder)
    return replace(calibrator, recording=recording, mended=encoder, mended_words=said)


def explains_more(again: Attempt, tried: Attempt, encoder: Encoder) -> bool:
    """Return whether an attempt with other angles than ``tried`` explains the events better.

    ``encoder`` is the one of the recording, with whose angles ``tried`` was made.
    """
    if again.calibration is None:
        return False
    if again.cost <= limits.LARGEST_COST_RATIO * tried.cost:
        return True
    if any(map(lost_counts, each_encoder(encoder))):
        return repairs_steps(again, tried)
    return again.accepted and again.cost < tried.cost and not _something_moves(again)


def repairs_steps(again: Attempt, tried: Attempt) -> bool:
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
