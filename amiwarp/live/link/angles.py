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
    """Size of the fault [counts]. For a slip: surplus counts, negative if counts were lost. For a missed index: counts
    since the last pulse. For a reversal: 0."""


class AngleTracker:
    """Converts encoder counts to unwrapped angles [rad].

    Angles are relative to the first count until an index pulse comes. From then on, an angle at an index pulse is a
    whole number of turns.
    """

    def __init__(self, counts_per_turn: int) -> None:
        """Raise :class:`AmiwarpError` if ``counts_per_turn`` is below 1."""
        if counts_per_turn < 1:
            raise AmiwarpError(f"counts_per_turn = {counts_per_turn}; give the encoder's counts per turn, 1 or more")
        self.counts_per_turn = counts_per_turn
        self.absolute = False
        """Whether an index pulse has defined the zero of the angle, so that angles are absolute."""
        self._zero: int | None = None
        self._index: int | None = None
        self._extreme: int | None = None
        self._last = 0
        self._direction = 0
        self._missed = False

    def count(self, t_us: int, count: int) -> tuple[float, tuple[FaultReport, ...]]:
        """Return the prism angle at an encoder count [rad], and the faults that this count reveals."""
        if self._zero is None:
            self._zero = count
        if self._index is not None and abs(count - self._last) > UNSEEN_TURNS * self.counts_per_turn:
            self._index = count
        self._last = count
        reports = []
        if self._extreme is None or (count - self._extreme) * self._direction >= 0:
            self._direction = self._direction or (
                0 if self._extreme is None else (count > self._extreme) - (count < self._extreme)
            )
            self._extreme = count
        elif abs(count - self._extreme) > REVERSAL_TURNS * self.counts_per_turn:
            reports.append(FaultReport(EncoderFault.REVERSED, t_us, 0))
            self._direction, self._extreme = -self._direction, count
            self._index = None if self._index is None else count
        since = 0 if self._index is None else count - self._index
        if abs(since) > MISSED_INDEX_TURNS * self.counts_per_turn and not self._missed:
            self._missed = True
            reports.append(FaultReport(EncoderFault.MISSED_INDEX, t_us, since))
        return self.angle(count), tuple(reports)

    def index(self, t_us: int, count: int) -> tuple[FaultReport, ...]:
        """Set or check the zero of the angle by an index pulse at an encoder count.

        After a slip, later angles use the corrected zero.
        """
        self._index, self._last, self._missed = count, count, False
        was_absolute, self.absolute = self.absolute, True
        if self._zero is None:
            self._zero = count
        error = (count - self._zero + self.counts_per_turn // 2) % self.counts_per_turn - self.counts_per_turn // 2
        if was_absolute and abs(error) <= INDEX_TOLERANCE_TURNS * self.counts_per_turn:
            return ()
        self._zero += error
        return (FaultReport(EncoderFault.SLIP, t_us, error),) if was_absolute else ()

    def angle(self, count: int) -> float:
        """Return the prism angle at an encoder count [rad] for the present zero.

        Needs an earlier count or index pulse.
        """
        assert self._zero is not None
        return math.tau * (count - self._zero) / self.counts_per_turn
