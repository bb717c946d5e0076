"""State of a :class:`~amiwarp.live.link.follower.Follower`, in one class for each occasion on which it is reset."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from amiwarp.live.link import updates
from amiwarp.live.link.angles import AngleTracker
from amiwarp.live.link.clocks import WRAP, UnwrappedClock
from amiwarp.live.link.protocol import ControllerStatus, FrameCounters, FrameDecoder

TRIPS = 60
"""Number of latest round trips of pings in memory."""
REPORT_US = 1_000_000
"""Shortest interval between messages about losses, and between those about noise [us]."""
STALL_US, STALL_COUNTS = 300_000, 5.0
"""Time for which a count must be constant to be reported as stalled [us], and number of counts that the motor must move
in that time at its speed."""


@dataclass(slots=True)
class LossReporter:
    """Turns the frame decoder's statistics into messages for the user, at a limited rate."""

    out_of_order: int = 0
    """Number of samples that were dropped because they were out of order, and are not yet reported."""
    _damaged: int | None = None
    """Number of damaged frames so far; None at first, because opening the port cuts a frame."""
    _lost: int = 0
    """Number of lost frames that were already reported."""
    _noise_us: int = -REPORT_US
    _lost_us: int = -REPORT_US

    def forget_lost(self, received: FrameCounters) -> None:
        """Mark the frames lost so far as reported."""
        self._lost = received.lost

    def check(self, received: FrameCounters, host_us: int) -> Iterator[str]:
        """Yield the messages about losses and noise that are due."""
        if self._damaged is not None and received.damaged > self._damaged:
            if host_us - self._noise_us > REPORT_US:
                yield "dropped damaged frames or lines; is the cable noisy?"
            self._noise_us = host_us
        self._damaged = received.damaged
        if host_us - self._lost_us > REPORT_US and (received.lost > self._lost or self.out_of_order):
            if received.lost > self._lost:
                yield f"frames lost: {received.lost - self._lost:,}"
            if self.out_of_order:
                yield f"samples dropped, out of order: {self.out_of_order:,}"
            self._lost, self.out_of_order, self._lost_us = received.lost, 0, host_us


@dataclass(slots=True)
class Connection:
    """State that is reset when the port is opened."""

    opened_us: int
    """Host time at which the port was opened [us]."""
    decoder: FrameDecoder = field(default_factory=FrameDecoder)
    losses: LossReporter = field(default_factory=LossReporter)
    received_bytes: int = 0
    unusable: bool = False
    """Whether the user was told that the data cannot be used."""
    ping_answered: bool = False
    unread: bool = True
    """Whether no time of the controller has arrived since the port was opened."""
    _sequence: int | None = None
    """Latest sequence number of a frame."""

    def runs_back(self, sequence: int) -> bool:
        """Store a frame's sequence number; return whether it went backwards."""
        before, self._sequence = self._sequence, sequence
        return before is not None and (sequence - before) & 0xFFFF >= 1 << 15


@dataclass(slots=True)
class StallDetector:
    """Finds counts that stay constant while the controller reports that the motor turns."""

    status_us: int = -1
    """Time of the controller's latest status [us]; -1 before the first status."""
    _since_us: int = 0
    """Time from which the count has been constant [us]; 0 before the first sample."""
    _count: int = 0
    _reported: bool = False

    def check(self, t: int, count: int, status: ControllerStatus | None, counts_per_turn: int) -> str | None:
        """Process a sample; return a message when a stall begins."""
        if self._since_us == 0 or count != self._count:
            self._since_us, self._count, self._reported = t, count, False
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
        self.unscaled: deque[tuple[int, int, bool]] = deque(maxlen=updates.MOST_WAITING_SAMPLES)
        """Data that wait for the counts per turn: time, count, and whether they are an index pulse."""
        self.unreferenced: deque[tuple[int, int]] | None = deque(maxlen=updates.MOST_WAITING_SAMPLES)
        """Samples that wait for the first index pulse: time and count; None once samples no longer have to wait."""
        self.pulses: deque[int] = deque(maxlen=updates.MOST_PULSES)
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
        self.largest_lead_us, self.heard_us = max(self.largest_lead_us, t - host_us), host_us
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
