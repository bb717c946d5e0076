"""The prism's absolute angle from counts and the index pulse, as they come; what does not fit is found and mended."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from amiwarp.errors import AmiwarpError

TOLERANCE = 0.01
"""Of a turn: the index pulse has a width, and its count was latched a little late."""
BACK = 0.1
"""Of a turn: counts that went back by so much were turned back; less is a slip, or an encoder on an edge."""
GAP = 0.5
"""Of a turn: after counts so far apart nothing is said of the index pulse, it may have been in between."""
LATE = 1.5
"""Turns after the last index pulse when the next was missed."""


class Fault(enum.StrEnum):
    """What does not fit."""

    SLIP = "slip"
    """The index pulse came where the counts do not say: counts were lost, or the disc moved."""
    MISSED_INDEX = "missed index"
    REVERSED = "reversed"
    """The counts run the other way than before."""


@dataclass(frozen=True, slots=True)
class Report:
    """A fault, when it was found and how large it is."""

    fault: Fault
    t_us: int
    counts: int
    """Of a slip those that were too many; of a missed index those since the last; of a reversal 0."""


class Angles:
    """Counts to angles [rad] that go on over turns: whole turns at index pulses, 0 at the first count until one."""

    def __init__(self, counts_per_turn: int) -> None:
        """Raises :class:`AmiwarpError` for a turn of no counts."""
        if counts_per_turn < 1:
            raise AmiwarpError(f"counts_per_turn = {counts_per_turn}; give 1 or more")
        self.counts_per_turn = counts_per_turn
        self.absolute = False
        """Whether an index pulse has told where the turn begins."""
        self._zero: int | None = None
        self._index: int | None = None
        self._furthest: int | None = None
        self._last = 0
        self._way = 0
        self._missed = False

    def count(self, t_us: int, count: int) -> tuple[float, tuple[Report, ...]]:
        """The angle at a count, and what was found out by it."""
        if self._zero is None:
            self._zero = count
        if self._index is not None and abs(count - self._last) > GAP * self.counts_per_turn:
            self._index = count
        self._last = count
        reports = []
        if self._furthest is None or (count - self._furthest) * self._way >= 0:
            self._way = self._way or (
                0 if self._furthest is None else (count > self._furthest) - (count < self._furthest)
            )
            self._furthest = count
        elif abs(count - self._furthest) > BACK * self.counts_per_turn:
            reports.append(Report(Fault.REVERSED, t_us, 0))
            self._way, self._furthest = -self._way, count
            self._index = None if self._index is None else count
        since = 0 if self._index is None else count - self._index
        if abs(since) > LATE * self.counts_per_turn and not self._missed:
            self._missed = True
            reports.append(Report(Fault.MISSED_INDEX, t_us, since))
        return self.angle(count), tuple(reports)

    def index(self, t_us: int, count: int) -> tuple[Report, ...]:
        """The index pulse at a count: tells the zero, or whether it was right; angles after it are mended."""
        self._index, self._last, self._missed = count, count, False
        known, self.absolute = self.absolute, True
        if self._zero is None:
            self._zero = count
        away = (count - self._zero + self.counts_per_turn // 2) % self.counts_per_turn - self.counts_per_turn // 2
        if known and abs(away) <= TOLERANCE * self.counts_per_turn:
            return ()
        self._zero += away
        return (Report(Fault.SLIP, t_us, away),) if known else ()

    def angle(self, count: int) -> float:
        """At a count, by what is known now. There must have been a count or an index pulse."""
        assert self._zero is not None
        return math.tau * (count - self._zero) / self.counts_per_turn
