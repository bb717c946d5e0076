"""Optics with two angles whose motion repeats: the turns after which both angles are as before."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.optics.models.base import Model
from amiwarp.optics.orbit import LockedAngles, image_grid, paths_of

Vector = NDArray[np.float64]
MOST_TURNS = 8
"""Largest number of turns of the first angle after which both angles must be as before."""
MOST_STRAY = 0.15
"""Largest distance of the second angle from where the first one says that it is [rad]. With an orbit of 7 px, the image
is then 1 px off."""
SAMPLES = 1000
"""Number of times at which both angles are compared."""
LEAST_MOTION_PX = 0.02
"""Motion below which the second angle moves nothing [px]."""
ANGLES = 16
"""Number of angles of a turn at which this is examined."""


@dataclass(frozen=True)
class MotionPeriod:
    """The period in which an optic's motion repeats: a turn, or some turns of the first of two angles."""

    model: Model
    """Model of the optic."""
    encoder: Encoder
    """Encoder whose angle goes one turn in a period."""
    angles: Encoder
    """Encoder of all angles."""
    turns: tuple[int, int] | None
    """Turns of the first and of the second angle in a period; None for one angle."""

    @classmethod
    def of(cls, model: Model, encoder: Encoder, start_us: int, stop_us: int) -> MotionPeriod:
        """Return the period during a time.

        Raises :class:`AmiwarpError` if the encoder has another number of angles, or the motion does not repeat.
        """
        if model.ANGLES == 1:
            return cls(model, encoder, encoder, None)
        turns = _turns_of(model, encoder, start_us, stop_us)
        slower = replace(encoder, angle=encoder.angle / turns[0], index_t=None, second=None)
        return cls(model, slower, encoder, turns)

    def locked(self, start_us: int, stop_us: int) -> LockedAngles | None:
        """Return how the second angle follows the first one during a time; None for one angle.

        Raises :class:`AmiwarpError` if it strays from there by more than :data:`MOST_STRAY`.
        """
        if self.turns is None:
            return None
        turns, second_turns = self.turns
        if not second_turns:
            return LockedAngles(turns, 0, 0.0)
        first, second = _both_angles(self.angles, start_us, stop_us)
        ahead = second - second_turns / turns * first
        at_zero = float(ahead.mean())
        stray = float(np.abs(ahead - at_zero).max())
        if stray > MOST_STRAY:
            raise AmiwarpError(
                f"between {start_us} and {stop_us} us the second angle of the {self.model.NAME} strays by "
                f"{math.degrees(stray):.0f} deg from {second_turns}/{turns} of the first one; sums in phase need both "
                "in step: drive them in step, give a shorter window, or use the method 'solver'"
            )
        return LockedAngles(turns, second_turns, math.remainder(at_zero, math.tau))


def _turns_of(model: Model, encoder: Encoder, start_us: int, stop_us: int) -> tuple[int, int]:
    """Return after how many turns of both angles the motion repeats. Raises :class:`AmiwarpError` if it does not."""
    if not _moves_second(model):
        return 1, 0
    check_prisms(encoder, model.ANGLES)
    first, second = _both_angles(encoder, start_us, stop_us)
    if not np.ptp(first):
        raise AmiwarpError(
            f"the first angle of the {model.NAME} is at rest, and sums in phase need one that turns; use the method "
            "'solver'"
        )
    ratio = float(np.polyfit(first, second, 1)[0])
    for turns in range(1, MOST_TURNS + 1):
        second_turns = round(ratio * turns)
        # How far the second angle runs away in a period
        if math.tau * abs(ratio * turns - second_turns) <= MOST_STRAY:
            return turns, second_turns
    raise AmiwarpError(
        f"the second angle of the {model.NAME} turns {ratio:.4g} times as fast as the first one, so that both do not "
        f"come back together within {MOST_TURNS} turns, as sums in phase need; drive both in step, or use the method "
        "'solver'"
    )


def _both_angles(encoder: Encoder, start_us: int, stop_us: int) -> tuple[Vector, Vector]:
    """Return both angles at some times [rad]."""
    low, high = encoder.coverage
    times = np.linspace(max(start_us, low), min(stop_us, high), SAMPLES).astype(np.int64)
    first, second = encoder.angles_at(times).T
    return first, second


def _moves_second(model: Model) -> bool:
    """Return whether the second angle moves anything."""
    points = image_grid(model.camera, 3, 3)
    here = paths_of(model, points, ANGLES, LockedAngles(1, 0, 0.0))
    farthest = 0.0
    for second in (0.25, 0.5, 0.75):
        there = paths_of(model, points, ANGLES, LockedAngles(1, 0, second * math.tau))
        farthest = max(farthest, float(np.abs(there - here).max()))
    return farthest > LEAST_MOTION_PX
