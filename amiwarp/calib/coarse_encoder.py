"""Encoders whose angles are multiples of so large a step that it shows in the events."""

from __future__ import annotations

import math

import numpy as np

from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.stated_errors import BOUND
from amiwarp.calib.photometric.verdicts import angle_names
from amiwarp.calib.sharpness_search import Search
from amiwarp.events.encoder import Encoder, each_encoder
from amiwarp.optics.models.registry import MODELS

LEAST_RESTING_SHARE = 0.05
"""Smallest share of samples with the angle of the sample before them: those of an encoder that is read more often than
it counts."""
RESTING_RAD = 1e-4
"""Largest step between samples of an angle that stays [rad]."""
OFF_MULTIPLE = 0.02
"""Largest distance of a step from a multiple of the smallest one, as a share of that."""
NOTABLE_PX = 0.01
"""Smallest error by the rounding of angles that is said [px rms]: half of an error that counts."""
COARSE = "the steps of a coarse encoder"
"""Words of what could hide in angles that are rounded."""


def step_rad(encoder: Encoder) -> float:
    """Return the step of which an encoder's angles are multiples, if some samples repeat the last angle; else 0 [rad].

    An encoder that is read less often than it counts has steps of several sizes, as a speed that varies has.
    """
    steps = np.abs(np.diff(encoder.angle))
    moving = steps[steps > RESTING_RAD]
    resting = len(steps) - len(moving)
    if not len(moving) or resting < LEAST_RESTING_SHARE * len(steps):
        return 0.0
    smallest = float(moving.min())
    multiples = moving / smallest
    off = np.abs(multiples - np.rint(multiples))
    return smallest if float(off.max()) <= OFF_MULTIPLE else 0.0


def rounding_px(search: Search, encoder: Encoder) -> list[tuple[int, float, float]]:
    """Return the number of each angle that a coarse encoder reads, its step [rad], and its error [px rms]."""
    space = search.space
    v = space.to_vector(search.best)
    found: list[tuple[int, float, float]] = []
    for angle, each in enumerate(each_encoder(encoder)):
        step = step_rad(each)
        error_px = px_per_rad(space, v, angle) * step / math.sqrt(12.0)
        if error_px >= NOTABLE_PX:
            found.append((angle, step, error_px))
    return found


def hidden_by_rounding(search: Search, encoder: Encoder) -> dict[str, float]:
    """Return by how much rounded angles may move events [px rms], by words; nothing if they are fine enough."""
    errors_px = [error_px for _, _, error_px in rounding_px(search, encoder)]
    return {COARSE: BOUND * math.hypot(*errors_px)} if errors_px else {}


def rounding_in_words(search: Search, encoder: Encoder) -> list[str]:
    """Return a warning for each angle that a coarse encoder reads."""
    names = angle_names(MODELS[search.space.model])
    said: list[str] = []
    for angle, step, error_px in rounding_px(search, encoder):
        which = names[angle].removesuffix("'s angle")
        said.append(
            f"{which} is coarse: its angles are multiples of {math.degrees(step):.2g} deg, which moves events by "
            f"{error_px:.2f} px rms; use one with more counts a turn"
        )
    return said
