"""Absolute prism angle from encoder counts and index pulses, with detection of encoder faults."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from amiwarp.errors import AmiwarpError

INDEX_TOLERANCE_TURNS = 0.01
"""Largest disagreement between an index pulse and the encoder count that is not reported as a slip [turns]. A pulse has
a width and a latch delay."""
REVERSAL_TURNS = 0.1
"""Distance that counts must run backwards before it is reported as a reversal [turns]. A shorter one is a slip, or an
encoder resting on an edge."""
UNSEEN_TURNS = 0.5
"""Step between two counts above which an index pulse between them may have been missed [turns]."""
MISSED_INDEX_TURNS = 1.5
"""Distance from the last index pulse at which the next pulse is reported as missed [turns]."""


class EncoderFault(enum.StrEnum):
    """Kind of fault in the encoder's counts or index pulses."""

    SLIP = "slip"
    """The index pulse and the count disagree: counts were lost, or the encoder disc moved."""
    MISSED_INDEX = "missed index"
    """No index pulse came within :data:`MISSED_INDEX_TURNS` turns after the last one."""
    REVERSED = "reversed"
    """The prism changed its direction of rotation."""


@dataclass(frozen=True, slots=True)
class FaultReport:
    """Encoder fault with its time and size."""

    fault: EncoderFault
    t_us: int
    """Time of the fault on the controller's clock [us]."""
    counts: int
    """Size of the fault [counts]. For a slip: surplus counts, negative if counts were lost, whatever the direction of
    rotation. For a missed index: counts since the last pulse. For a reversal: 0."""


class AngleTracker:
    """Converts encoder counts to unwrapped angles [rad].

    Angles are relative to the first count until an index pulse comes. From then on, an angle at an index pulse is a
    whole number of turns.
    """

    def __init__(self, counts_per_turn: int) -> None:
        """Raise :class:`AmiwarpError` if ``counts_per_turn`` is below 1."""
        if counts_per_turn < 1:
            raise AmiwarpError(
                f"counts_per_turn = {counts_per_turn}; give the encoder's counts per turn, 1 or more"
            )
        self.counts_per_turn = counts_per_turn
        self.absolute = False
        """Whether an index pulse has defined the zero of the angle, so that angles are absolute."""
        self._zero: int | None = None
        # Count at the last index pulse, or at which the distance from it started again
        self._index: int | None = None
        # Farthest count in the direction of rotation
        self._extreme: int | None = None
        self._last = 0
        # 1, -1, or 0 before the count first changes
        self._direction = 0
        # Whether a missed index pulse was reported since the last one
        self._missed = False

    def count(self, t_us: int, count: int) -> tuple[float, tuple[FaultReport, ...]]:
        """Return the prism angle at an encoder count [rad], and the faults that this count reveals."""
        if self._zero is None:
            self._zero = count
        step = abs(count - self._last)
        if self._index is not None and step > UNSEEN_TURNS * self.counts_per_turn:
            # A pulse may have come between the two counts: the distance from the last pulse starts again.
            self._index = count
        self._last = count
        reversal = self._check_direction(t_us, count)
        missed_index = self._check_distance(t_us, count)
        reports = tuple(report for report in (reversal, missed_index) if report is not None)
        return self.angle(count), reports

    def _check_direction(self, t_us: int, count: int) -> FaultReport | None:
        """Follow the farthest count in the direction of rotation; report a reversal."""
        if self._extreme is None:
            self._extreme = count
            return None
        if (count - self._extreme) * self._direction >= 0:
            if self._direction == 0:
                self._direction = (count > self._extreme) - (count < self._extreme)
            self._extreme = count
            return None
        if abs(count - self._extreme) <= REVERSAL_TURNS * self.counts_per_turn:
            return None
        self._direction = -self._direction
        self._extreme = count
        if self._index is not None:
            # The next pulse comes within a turn of where the prism turned round.
            self._index = count
        return FaultReport(EncoderFault.REVERSED, t_us, 0)

    def _check_distance(self, t_us: int, count: int) -> FaultReport | None:
        """Report once that the last index pulse is too far away."""
        if self._index is None or self._missed:
            return None
        since = count - self._index
        if abs(since) <= MISSED_INDEX_TURNS * self.counts_per_turn:
            return None
        self._missed = True
        return FaultReport(EncoderFault.MISSED_INDEX, t_us, since)

    def index(self, t_us: int, count: int) -> tuple[FaultReport, ...]:
        """Set or check the zero of the angle by an index pulse at an encoder count.

        After a slip, later angles use the corrected zero.
        """
        self._index = count
        self._last = count
        self._missed = False
        was_absolute = self.absolute
        self.absolute = True
        if self._zero is None:
            self._zero = count
        # Distance from the nearest whole turn
        half = self.counts_per_turn // 2
        error = (count - self._zero + half) % self.counts_per_turn - half
        if was_absolute and abs(error) <= INDEX_TOLERANCE_TURNS * self.counts_per_turn:
            return ()
        self._zero += error
        if not was_absolute:
            return ()  # the first pulse defines the zero
        surplus = -error if self._direction < 0 else error
        return (FaultReport(EncoderFault.SLIP, t_us, surplus),)

    def angle(self, count: int) -> float:
        """Return the prism angle at an encoder count [rad] for the present zero.

        Needs an earlier count or index pulse.
        """
        assert self._zero is not None
        return math.tau * (count - self._zero) / self.counts_per_turn
