"""Lens in front of a plate: how it is corrected where the depths of the scene are found, too.

The depths were found through the lens that was given, and have absorbed a part of what a wrong one does. So a search
at these depths would not find the lens. A linearised fit tells a share of its error; the depths are then found anew
through a better lens, and the next fit tells how large the share was.

Only the distortion k1 is corrected: it makes ellipses of orbits, whose axes point to the middle of the image. An
encoder off centre looks like another principal point, and one that is wrong twice a turn like another fy / fx: of these
it is only said how much could hide.
"""

from __future__ import annotations

from dataclasses import dataclass

from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.causes import DISTORTION
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.stated_errors import BOUND, FOUND_OF_LENS
from amiwarp.calib.photometric.verdicts import refused

LEAST_SHARE = 0.2
"""Smallest share of the error of a lens that a fit is taken to find. It was 0.25 in an image of few pixels."""


@dataclass(frozen=True)
class LensStep:
    """Correction of the distortion k1 of a lens."""

    found: float
    """Change of k1 that a linearised fit finds."""
    share: float
    """Share of the error of k1 that this is taken to be."""
    deviation: float
    """Standard deviation of the corrected k1."""

    @property
    def step(self) -> float:
        """Whole change of k1."""
        return self.found / self.share

    def share_of(self, left: float) -> float:
        """Return the share of the error that a fit finds, from what the fit after this step still finds."""
        share = (self.found - left) / self.step
        return min(max(share, LEAST_SHARE), 1.0)


def next_lens(state: Refinement, last: LensStep | None) -> LensStep | None:
    """Return the next correction of the lens after the ``last`` one, if there was one; None if none is needed."""
    check = state.check
    if check is None or check.distortion is None or not is_explained(state):
        return None
    found, deviation = check.distortion
    if last is not None:
        if abs(found) > BOUND * deviation:
            share = last.share_of(found)
            return LensStep(found, share, deviation / share)
        return None
    if any(likely.cause == DISTORTION for likely in check.likely):
        return LensStep(found, FOUND_OF_LENS, deviation / FOUND_OF_LENS)
    return None


def is_explained(state: Refinement) -> bool:
    """Return whether an answer at found depths explains the events, without a rotation of the camera."""
    check = state.check
    turned = check is not None and check.rotation_gain > limits.LARGEST_ROTATION_GAIN
    unexplained = state.answer.cost > limits.LARGEST_EXAMINED_COST
    return not (turned or unexplained or refused(state.answer.optimum))
