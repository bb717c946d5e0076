"""What is known since the controller's clock and counts last restarted: state that is reset then."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from amiwarp.live.link import protocol
from amiwarp.live.link.angle_tracker import AngleTracker
from amiwarp.live.link.clocks import WRAP, UnwrappedClock
from amiwarp.live.link.updates import MOST_PULSES, MOST_WAITING_SAMPLES

STALL_US = 300_000
STALL_COUNTS = 5.0
"""Time for which a count must be constant to be reported as stalled [us], and number of counts that the motor must move
in that time at its speed."""


@dataclass(slots=True)
class StallDetector:
    """Finds counts that stay constant while the controller reports that the motor turns."""

    status_us: int = -1
    """Time of the controller's latest status [us]; -1 before the first status."""
    _since_us: int = 0
    """Time from which the count has been constant [us]; 0 before the first sample."""
    _count: int = 0
    _reported: bool = False

    def check(
        self, t: int, count: int, status: protocol.ControllerStatus | None, counts_per_turn: int
    ) -> str | None:
        """Process a sample; return a message when a stall begins."""
        if self._since_us == 0 or count != self._count:
            self._since_us = t
            self._count = count
            self._reported = False
            return None
        if self._reported or status is None or self.status_us < self._since_us:
            return None
        rpm = max(abs(status.rpm), abs(status.target_rpm) if status.state == 1 else 0.0)
        rate = rpm / 60e6 * counts_per_turn
        if rpm > 0 and t - self._since_us > max(STALL_US, STALL_COUNTS / rate):
            self._reported = True
            return f"the encoder stays at count {count:,} while the controller reports {status.rpm:g} rpm"
        return None


class Epoch:
    """State that is reset when the controller's clock or counts restart."""

    def __init__(self, counts_per_turn: int | None) -> None:
        self.clock = UnwrappedClock()
        self.largest_lead_us = -math.inf
        """Largest amount by which the controller's clock was ahead of the host's when data arrived [us]."""
        self.heard_us = 0
        """Host time of the latest data [us]."""
        self.counted: tuple[int, int] | None = None
        """Latest unwrapped time [us] and unwrapped count."""
        self.suspect: tuple[int, int] | None = None
        """Raw time and raw count of a text line that did not continue the previous lines."""
        self.angles = None if counts_per_turn is None else AngleTracker(counts_per_turn)
        self.unscaled: deque[tuple[int, int, bool]] = deque(maxlen=MOST_WAITING_SAMPLES)
        """Data that wait for the counts per turn: time, count, and whether they are an index pulse."""
        self.unreferenced: deque[tuple[int, int]] | None = deque(maxlen=MOST_WAITING_SAMPLES)
        """Samples that wait for the first index pulse: time and count; None once samples no longer have to wait."""
        self.pulses: deque[int] = deque(maxlen=MOST_PULSES)
        """Times of index pulses that wait for the next sample [us]."""
        self.given_us: int | None = None
        """Time of the latest sample that was added to the updates [us]."""
        self.stall = StallDetector()
        self.faults = 0
        """Fault bits of the controller's latest status, see ``protocol.FAULTS``."""
        self.pings: dict[int, int] = {}
        """Host times at which unanswered pings were sent [us], by number of the ping."""

    def note_time(self, raw_t: int, host_us: int) -> int:
        """Store the time of data that arrived at ``host_us`` [us], and return it unwrapped."""
        t = self.clock(raw_t)
        self.largest_lead_us = max(self.largest_lead_us, t - host_us)
        self.heard_us = host_us
        return t

    def note_count(self, t: int, raw_count: int) -> int:
        """Store the count of a sample at an unwrapped time, and return it unwrapped."""
        count = raw_count if self.counted is None else self.counted[1] + self.count_step(raw_count)
        self.counted = t, count
        return count

    def count_step(self, raw_count: int) -> int:
        """Return the step from the latest count, across a wrap of 32 bits if that is shorter."""
        assert self.counted is not None
        return (raw_count - self.counted[1] + WRAP // 2) % WRAP - WRAP // 2

    def pulses_until(self, t: int) -> list[int]:
        """Remove and return the times of the index pulses up to ``t`` [us]."""
        found = []
        while self.pulses and self.pulses[0] <= t:
            found.append(self.pulses.popleft())
        return found
