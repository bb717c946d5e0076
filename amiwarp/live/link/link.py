"""Link to the prism's controller: conversion of its bytes to times, angles and faults; port, commands and pings."""

from __future__ import annotations

import contextlib
import enum
import errno
import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.live.link import protocol
from amiwarp.live.link.clocks import FEWEST_PAIRS, WRAP, ClockMap, UnwrappedClock, fit_to_round_trips, monotonic_us
from amiwarp.live.queues import BackgroundLoop

# Absolute prism angle from encoder counts and index pulses, with detection of encoder faults.

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


# Data received from the controller, in updates that are split where its clock or counts restarted.

MOST_WAITING_SAMPLES = 100_000
"""Largest number of samples that wait to be fetched: more than 90 s at 1 kHz. Then the oldest are dropped."""
MOST_PULSES, MOST_UPDATES = 10_000, 64
"""Largest number of index or sync pulses in an update that waits to be fetched, and largest number of such updates."""
MOST_MESSAGES = 1000
"""Largest number of messages in an update that waits to be fetched."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LinkUpdate:
    """Data received from the controller since the last fetch, or until its clock or counts restarted."""

    t_us: NDArray[np.int64]
    """Times of the encoder samples [us] on the controller's unwrapped clock, strictly increasing, shape ``(n,)``."""
    angle: NDArray[np.float64]
    """Unwrapped prism angle of each sample [rad], shape ``(n,)``. After the first index pulse, the angle is a whole
    number of turns at each index pulse."""
    index_t_us: NDArray[np.int64]
    """Times of the index pulses from the previous update's last sample to this update's last sample [us]."""
    sync: tuple[tuple[int, int, int], ...]
    """Sync pulses, each with its number, the controller's time [us], and the host's time of arrival [us]."""
    restarted: bool
    """Whether the controller's clock or counts restarted before these samples. Maps fitted to the earlier clock are
    then void."""
    messages: tuple[str, ...]
    """Messages for the user about encoder faults, losses, resets and the port."""


class _PendingUpdate:
    """Update that is being filled; :class:`UpdateQueue` limits the number of its samples."""

    def __init__(self, *, restarted: bool) -> None:
        self.restarted = restarted
        self.samples: deque[tuple[int, float]] = deque()
        self.index: deque[int] = deque(maxlen=MOST_PULSES)
        self.sync: deque[tuple[int, int, int]] = deque(maxlen=MOST_PULSES)
        self.messages: deque[str] = deque(maxlen=MOST_MESSAGES)

    def finished(self) -> LinkUpdate:
        return LinkUpdate(
            t_us=np.array([t for t, _ in self.samples], np.int64),
            angle=np.array([angle for _, angle in self.samples], np.float64),
            index_t_us=np.array(self.index, np.int64),
            sync=tuple(self.sync),
            restarted=self.restarted,
            messages=tuple(self.messages),
        )


class UpdateQueue:
    """Bounded queue of updates between the reader of the port and the user of the link."""

    def __init__(self) -> None:
        self.samples = 0
        """Number of samples that wait to be fetched."""
        self._updates = deque([_PendingUpdate(restarted=False)])
        self._dropped = 0

    def __len__(self) -> int:
        """Number of updates that wait to be fetched."""
        return len(self._updates)

    def say(self, sentence: str) -> None:
        """Add a message for the user, in order with the samples."""
        self._updates[-1].messages.append(sentence)

    def add_sync(self, number: int, t_us: int, host_us: int) -> None:
        """Add a sync pulse: its number, the controller's time and the host's time of arrival [us]."""
        self._updates[-1].sync.append((number, t_us, host_us))

    def add_sample(self, t_us: int, angle: float, index_t_us: Iterable[int]) -> None:
        """Add a sample and the index pulses before it; drop the oldest sample if there are too many."""
        latest = self._updates[-1]
        latest.index.extend(index_t_us)
        latest.samples.append((t_us, angle))
        self.samples += 1
        if self.samples > MOST_WAITING_SAMPLES:
            dropped_us, _ = self._updates[0].samples.popleft()
            while (pulses := self._updates[0].index) and pulses[0] <= dropped_us:
                pulses.popleft()
            self.samples, self._dropped = self.samples - 1, self._dropped + 1
            if not self._updates[0].samples:
                self._merge_first()

    def restart(self) -> None:
        """Begin a new update, because the controller's clock or counts restarted."""
        if self._updates[-1].samples:
            self._updates.append(_PendingUpdate(restarted=True))
        if len(self._updates) > MOST_UPDATES:
            dropped = len(self._updates[0].samples)
            self.samples, self._dropped = self.samples - dropped, self._dropped + dropped
            self._merge_first()
        self._updates[-1].restarted = True
        self._updates[-1].sync.clear()  # the times of these pulses are on the clock before the restart

    def take(self) -> LinkUpdate:
        """Remove and return the oldest update."""
        update = self._updates.popleft()
        if not self._updates:
            self._updates.append(_PendingUpdate(restarted=False))
        self.samples -= len(update.samples)
        if self._dropped:
            update.messages.append(f"{self._dropped:,} samples were dropped, the oldest: they were not fetched in time")
            self._dropped = 0
        return update.finished()

    def _merge_first(self) -> None:
        """Merge the first update, whose samples are dropped, into the second, which began with a restart."""
        dropped, update = self._updates.popleft(), self._updates[0]
        update.messages.extendleft(reversed(dropped.messages))


# State of a :class:`~amiwarp.live.link.link.Follower`, in one class for each occasion on which it is reset.

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

    def forget_lost(self, received: protocol.FrameCounters) -> None:
        """Mark the frames lost so far as reported."""
        self._lost = received.lost

    def check(self, received: protocol.FrameCounters, host_us: int) -> Iterator[str]:
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
    decoder: protocol.FrameDecoder = field(default_factory=protocol.FrameDecoder)
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

    def check(self, t: int, count: int, status: protocol.ControllerStatus | None, counts_per_turn: int) -> str | None:
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


LATE_US = 100_000
"""Step backwards of the controller's clock beyond which the clock is considered reset [us]."""
AHEAD_US = 2_000_000
"""Sudden advance of the controller's clock relative to the host's beyond which the clock is considered changed [us]."""
SILENT_US = 1_800_000_000
"""Time without data after which the number of wraps of the controller's clock is unknown [us]."""
FASTEST = 200.0
"""Speed that no prism exceeds [turns/s]. A faster change of the count, by more than a turn, is taken for a restart."""
HOLD_TURNS = 2
"""Number of turns for which samples wait for the first index pulse."""
STATUS_US = 2_000_000
"""Longest time for which samples wait until the controller's status gives the counts per turn [us]. The status is sent
once per second."""
FROM_FIRST = "angles are relative to the first encoder count"
HOST_LOST = 1 << protocol.FAULTS.index("host lost")


class Follower:
    """Converts a controller's bytes to updates. Accepts any bytes without raising; its memory is bounded.

    ``name``: name of the port, for messages. ``counts_per_turn``: used if the controller does not report it. Samples
    wait until the first index pulse makes their angles absolute, for :data:`HOLD_TURNS` at most. Text lines do not
    wait, because they have no index pulse.
    """

    def __init__(self, name: str, counts_per_turn: int | None = None) -> None:
        self.name = name
        self.status: protocol.ControllerStatus | None = None
        """Latest status that the controller sent; None before the first."""
        self.identity: protocol.Identity | None = None
        """Firmware and board, once the controller has said them since the port was opened."""
        self.condition: protocol.Condition | None = None
        """Latest supply and time-out that the controller told since the port was opened; None before the first."""
        self.older = False
        """Whether the controller has refused to say what it is: its firmware is older than 1.1."""
        self.settings: dict[int, int] = {}
        """Settings that the controller told, by key."""
        self.trips: deque[tuple[int, int, int]] = deque(maxlen=TRIPS)
        """Round trips of pings: time sent (host), answered (controller), received (host) [us]."""
        self.updates = UpdateQueue()
        """Updates that wait to be fetched by the user of the link."""
        self._given_per_turn = counts_per_turn
        self._per_turn: int | None = None
        self._connection, self._epoch = Connection(0), Epoch(None)

    def opened(self, host_us: int) -> None:
        """Reset the state of the connection, because the port was opened or reopened."""
        self._connection = Connection(host_us)
        self.identity, self.condition, self.older = None, None, False

    @property
    def speaks(self) -> bool:
        """Whether frames have arrived since the port was opened, so that the controller takes pings and commands."""
        return self._connection.decoder.received.frames > 0

    @property
    def text(self) -> bool:
        """Whether text lines have arrived. A controller that sends text lines answers neither pings nor commands."""
        return self._connection.decoder.received.lines > 0

    def pinged(self, number: int, host_us: int) -> None:
        """Store the host time of a ping that was sent."""
        self._epoch.pings[number] = host_us
        self._epoch.pings.pop(number - TRIPS, None)

    def clock(self) -> ClockMap | None:
        """Return the map from the host's clock to the controller's; None until three pings are answered.

        A constant asymmetry between the two directions is unobservable and does not average out. The standard
        deviation of the offset includes it.
        """
        if len(self.trips) < FEWEST_PAIRS:
            return None
        sent, answered, received = np.array(self.trips, np.int64).T
        clock = fit_to_round_trips(sent, answered, received)
        shared = float((received - sent).min()) / math.sqrt(12.0)
        return replace(clock, offset_std_us=math.hypot(clock.offset_std_us, shared))

    def say(self, sentence: str) -> None:
        """Add a message for the user, in order with the samples."""
        self.updates.say(sentence)

    def take(self) -> LinkUpdate:
        """Return the oldest update. After a restart of the controller, data from before the restart come first."""
        return self.updates.take()

    def feed(self, data: bytes, host_us: int) -> list[protocol.Answer]:
        """Process bytes that were read at a host time [us]; return the answers to commands among them."""
        connection = self._connection
        connection.received_bytes += len(data)
        answers = []
        for sequence, message in connection.decoder.feed(data):
            if sequence is not None and connection.runs_back(sequence):
                self._restart("the controller was reset")
            if isinstance(message, protocol.Answer):
                answers.append(message)
            else:
                self._process(message, host_us, text=sequence is None)
        self._report_losses(host_us)
        return answers

    def _process(self, message: protocol.Message, host_us: int, *, text: bool) -> None:
        if isinstance(message, protocol.Samples):
            for raw_t, raw_count in zip(message.t_us, message.count, strict=True):
                self._sample(raw_t, raw_count, host_us, text=text)
        elif isinstance(message, protocol.Index):
            t, count = self._unwrap(message.t_us, message.count, host_us)
            self._convert(t, count, pulse=True)
        elif isinstance(message, protocol.Sync):
            self.updates.add_sync(message.number, self._unwrap_time(message.t_us, host_us), host_us)
        elif isinstance(message, protocol.Pong):
            t = self._unwrap_time(message.t_us, host_us)
            self._connection.ping_answered = True
            if message.number in self._epoch.pings:
                self.trips.append((self._epoch.pings.pop(message.number), t, host_us))
        elif isinstance(message, protocol.ControllerStatus):
            self._take_status(message, self._unwrap_time(message.t_us, host_us))
        elif isinstance(message, protocol.Identity):
            self.identity = message
        elif isinstance(message, protocol.Condition):
            self._unwrap_time(message.t_us, host_us)
            self.condition = message
        elif isinstance(message, protocol.Setting):
            self.settings[message.key] = message.value

    def _sample(self, raw_t: int, raw_count: int, host_us: int, *, text: bool) -> None:
        """Convert a sample. An implausible text line is accepted only once the next line continues it."""
        if text and self._per_turn is None:
            self._decide_counts(self._given_per_turn)
        suspect, self._epoch.suspect = self._epoch.suspect, None
        if text and self._discontinuity(raw_t, raw_count, host_us):
            if suspect is None or not self._continues(suspect, raw_t, raw_count):
                self._epoch.suspect = raw_t, raw_count
                self._connection.decoder.received.damaged += 1
                return
            self._convert(*self._unwrap(*suspect, host_us), pulse=False)
        t, count = self._unwrap(raw_t, raw_count, host_us)
        epoch = self._epoch
        if text and epoch.unreferenced is not None and self._per_turn is not None:
            self.say(f"{self.name}: lines of text have no index pulse: {FROM_FIRST}")
            self._release()
        if not text and self._per_turn is None and epoch.unscaled and t - epoch.unscaled[0][0] > STATUS_US:
            self._decide_counts(self._given_per_turn)
        self._convert(t, count, pulse=False)

    def _continues(self, suspect: tuple[int, int], raw_t: int, raw_count: int) -> bool:
        """Return whether a text line plausibly continues the implausible line ``suspect``."""
        step = (raw_t - suspect[0]) % WRAP
        return 0 < step < AHEAD_US and abs(raw_count - suspect[1]) <= self._largest_step(step)

    def _largest_step(self, step_us: int) -> float:
        """Return the largest plausible change of the count during a time step [us]."""
        return (self._per_turn or math.inf) * (1.0 + FASTEST * max(step_us, 0) * 1e-6)

    def _discontinuity(self, raw_t: int, raw_count: int | None, host_us: int) -> str:
        """Return why a sample does not continue the previous samples; an empty string if it continues them."""
        epoch = self._epoch
        if epoch.clock.last is None:
            return ""
        step_us = epoch.clock.difference(raw_t)
        lead_us = epoch.clock.last + step_us - host_us - epoch.largest_lead_us  # negative for data that were delayed
        behind = self._connection.unread and lead_us < -AHEAD_US  # a closed port delays no data
        if step_us < -LATE_US or behind or host_us - epoch.heard_us > SILENT_US:
            return "the controller's clock restarted, it was reset"
        if lead_us > AHEAD_US:
            return "the controller's clock jumped ahead"
        if raw_count is not None and epoch.counted is not None:
            step = epoch.count_step(raw_count)
            if abs(step) > self._largest_step(epoch.clock.last + step_us - epoch.counted[0]):
                return f"the counts jumped by {step:,}"
        return ""

    def _unwrap_time(self, raw_t: int, host_us: int) -> int:
        """Return the unwrapped time of a reading of the controller's clock [us]; restart at a discontinuity."""
        why = self._discontinuity(raw_t, None, host_us)
        if why:
            self._restart(why)
        t = self._epoch.note_time(raw_t, host_us)
        self._connection.unread = False
        return t

    def _unwrap(self, raw_t: int, raw_count: int, host_us: int) -> tuple[int, int]:
        """Return the unwrapped time [us] and the unwrapped count; restart at a discontinuity."""
        why = self._discontinuity(raw_t, raw_count, host_us)
        if why:
            self._restart(why)
        t = self._unwrap_time(raw_t, host_us)
        return t, self._epoch.note_count(t, raw_count)

    def _restart(self, why: str) -> None:
        """Start new angles and times, because the controller's clock or counts restarted."""
        self._release()
        self.updates.restart()
        self.say(f"{self.name}: {why}; angles restart")
        self._connection.losses.forget_lost(self._connection.decoder.received)
        self._epoch = Epoch(self._per_turn)
        self.trips.clear()

    def _decide_counts(self, per_turn: int | None) -> None:
        """Set the counts per turn and convert the data that waited for them.

        ``per_turn``: None if no source gives them.
        """
        if per_turn is None:
            if not self._connection.unusable:
                self.say(f"{self.name}: the controller does not report its counts per turn; give counts_per_turn")
            self._connection.unusable = True
        elif per_turn != self._per_turn:
            before, self._per_turn = self._per_turn, per_turn
            if before is not None:
                self._restart(f"the controller now has {per_turn:,} counts per turn, not {before:,}")
            self._epoch.angles = AngleTracker(per_turn)
            while self._epoch.unscaled:
                t, count, pulse = self._epoch.unscaled.popleft()
                self._convert(t, count, pulse=pulse)

    def _convert(self, t: int, count: int, *, pulse: bool) -> None:
        """Convert the count of a sample or index pulse to a prism angle, once the counts per turn are known."""
        angles = self._epoch.angles
        if angles is None:
            self._epoch.unscaled.append((t, count, pulse))
        elif pulse:
            self._convert_pulse(angles, t, count)
        else:
            self._convert_sample(angles, t, count)

    def _convert_sample(self, angles: AngleTracker, t: int, count: int) -> None:
        angle, reports = angles.count(t, count)
        self._report_faults(angles, reports)
        sentence = self._epoch.stall.check(t, count, self.status, angles.counts_per_turn)
        if sentence is not None:
            self.say(sentence)
        waiting = self._epoch.unreferenced
        if waiting is None:
            self._give(t, angle)
            return
        waiting.append((t, count))
        if abs(count - waiting[0][1]) > HOLD_TURNS * angles.counts_per_turn:
            self.say(f"no index pulse in {HOLD_TURNS} turns: {FROM_FIRST}")
            self._release()

    def _convert_pulse(self, angles: AngleTracker, t: int, count: int) -> None:
        late = self._epoch.unreferenced is None and not angles.absolute
        before = angles.angle(count) if late else 0.0
        self._report_faults(angles, angles.index(t, count))
        if late:
            moved = math.degrees(angles.angle(count) - before)
            self.say(f"first index pulse: angles are absolute from now on, and change by {moved:+.1f} deg")
        self._epoch.pulses.append(t)
        self._release()

    def _release(self) -> None:
        """Give the samples that waited for the first index pulse to the caller's updates."""
        waiting, self._epoch.unreferenced = self._epoch.unreferenced or (), None
        for t, count in waiting:
            assert self._epoch.angles is not None
            self._give(t, self._epoch.angles.angle(count))

    def _give(self, t: int, angle: float) -> None:
        """Add a sample, and the index pulses before it, to the caller's updates; drop it if it is out of order."""
        epoch = self._epoch
        if epoch.given_us is not None and t <= epoch.given_us:
            self._connection.losses.out_of_order += 1
            return
        epoch.given_us = t
        self.updates.add_sample(t, angle, epoch.pulses_until(t))

    def _report_faults(self, angles: AngleTracker, reports: tuple[FaultReport, ...]) -> None:
        for report in reports:
            if report.fault is EncoderFault.SLIP:
                what = f"{abs(report.counts):,} counts {'were lost' if report.counts < 0 else 'too many'}"
                self.say(f"slip: {what} at the index pulse; angles are correct again from there")
            elif report.fault is EncoderFault.MISSED_INDEX:
                self.say(f"no index pulse for {abs(report.counts) / angles.counts_per_turn:.1f} turns")
            else:
                self.say("the prism turns the other way")

    def _take_status(self, status: protocol.ControllerStatus, t: int) -> None:
        self.status, self._epoch.stall.status_us = status, t
        self._decide_counts(status.counts_per_turn or self._per_turn or self._given_per_turn)
        # Before the first ping the controller cannot know the host: this is not a fault.
        faults = status.faults if self._connection.ping_answered else status.faults & ~HOST_LOST
        for bit, name in enumerate(protocol.FAULTS):
            if faults & ~self._epoch.faults & 1 << bit:
                self.say(f"the controller reports a fault: {name}")
        self._epoch.faults = faults

    def _report_losses(self, host_us: int) -> None:
        """Report lost and damaged data, at a limited rate; report once if no data can be decoded at all."""
        connection = self._connection
        if self.speaks or self.text:
            for sentence in connection.losses.check(connection.decoder.received, host_us):
                self.say(f"{self.name}: {sentence}")
        elif connection.received_bytes and host_us - connection.opened_us > STATUS_US and not connection.unusable:
            self.say(f"{self.name}: receives neither frames nor lines of samples; is the port or baud rate wrong?")
            connection.unusable = True


# Serial ports, opened by name, by USB id, or by detection of the controller.

BAUD = 460_800
"""Baud rate of the serial port [bit/s]. USB CDC ports ignore it."""
READ_S, WRITE_S = 0.05, 0.5
"""Time-outs of a read and of a write on the port [s]."""
LISTEN_S = 1.0
"""Time for which each port is read when the controller is searched for [s]."""
_USB = re.compile(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})")


def open_port(where: str | None) -> Any:
    """Open a port and return its ``serial.Serial``.

    ``where``: name, pySerial URL, USB id ``VID:PID`` (hexadecimal), or None to detect the controller. Raises
    :class:`AmiwarpError`, with the available ports, if there is no such port or it cannot be opened.
    """
    if where is None:
        return _find()
    match = _USB.fullmatch(where)
    if match is None:
        return _open(where)
    wanted = int(match[1], 16), int(match[2], 16)
    names = [p.device for p in _ports() if (p.vid, p.pid) == wanted]
    if len(names) != 1:
        raise AmiwarpError(f"USB id {where}: {len(names)} ports have this id; {_available()}")
    return _open(names[0])


def usb_id(name: str) -> str | None:
    """Return ``VID:PID`` of a port, or None if it has none or shares it with another port."""
    ports = _ports()
    ids = [(p.vid, p.pid) for p in ports if p.device == name and p.vid is not None]
    if len(ids) != 1 or sum((p.vid, p.pid) == ids[0] for p in ports) != 1:
        return None
    return f"{ids[0][0]:04x}:{ids[0][1]:04x}"


def _ports() -> list[Any]:
    from serial.tools import list_ports

    return sorted(list_ports.comports(), key=lambda p: p.device)


def _available() -> str:
    listed = [p.device if p.vid is None else f"{p.device} ({p.vid:04x}:{p.pid:04x} {p.product})" for p in _ports()]
    return f"there are {', '.join(listed)}" if listed else "there is no serial port; is the controller plugged in?"


def _open(name: str) -> Any:
    import serial

    try:
        return serial.serial_for_url(name, BAUD, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
    except Exception as error:  # includes termios.error, which is not an OSError
        number = getattr(error, "errno", None)
        if number in (errno.EAGAIN, errno.EBUSY):
            raise AmiwarpError(f"{name}: another program has this port open; close that program first") from error
        if number == errno.EACCES:
            raise AmiwarpError(
                f"{name}: no permission to open this port; on Linux join the port's group (see ls -l {name})"
            ) from error
        why = "no such port" if number == errno.ENOENT else f"cannot be opened ({error})"
        raise AmiwarpError(f"{name}: {why}; {_available()}") from error


def _find() -> Any:
    """Open the first port on which controller frames or lines arrive, and return it."""
    errors = []
    for candidate in _ports():
        try:
            port = _open(candidate.device)
        except AmiwarpError as error:
            errors.append(str(error))
            continue
        if _is_controller(port):
            return port
        port.close()
    detail = "".join(f" ({line})" for line in errors)
    raise AmiwarpError(f"no port sends controller data; {_available()}{detail}; give a port by name")


def _is_controller(port: Any) -> bool:
    """Return whether controller frames or lines arrive within :data:`LISTEN_S`."""
    decoder, end = protocol.FrameDecoder(), time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        try:
            decoder.feed(port.read(max(1, port.in_waiting)))
        except OSError:
            return False
        if decoder.received.frames or decoder.received.lines > 1:
            return True
    return False


READ_BYTES = 1 << 16
"""Largest number of bytes read from the port at once."""
RETRY_S = 0.2
"""Interval between attempts to reopen a lost port [s]."""
ANSWER_S = 1.0
"""Longest wait for the answer to a command [s]."""
QUICK_PINGS, QUICK_PING_US, PING_US = 10, 50_000, 1_000_000
"""Number of quick pings after the port is opened, interval of the quick pings [us], and interval of later pings [us].
"""
QUICK_ASK_US, ASK_US = 250_000, 1_000_000
"""Interval of the questions for the controller's identity and condition until they are known, and later [us]."""
PINGS_PER_TIMEOUT = 4
"""Number of pings within the time after which a controller stops the motor for a lost host, so that some may be lost.
"""


class Link(BackgroundLoop):
    """Connection to a controller, open until closed. No call blocks for longer than about a second.

    The motor keeps its last commanded speed after :meth:`close`.

    ``port``: name, USB id ``VID:PID``, pySerial URL, or None to detect the controller. ``counts_per_turn``: for a
    controller that does not report it (text lines). ``host_us``: the host's clock [us], increasing. Raises
    :class:`AmiwarpError` if the port cannot be opened at first; a port that is lost later is reopened.
    """

    def __init__(
        self, port: str | None = None, *, counts_per_turn: int | None = None, host_us: Callable[[], int] = monotonic_us
    ) -> None:
        if counts_per_turn is not None and counts_per_turn < 1:
            raise AmiwarpError(f"counts_per_turn = {counts_per_turn}; give the encoder's counts per turn, 1 or more")
        self._port: Any = open_port(port)
        self.name = str(self._port.port)
        self._where = port or usb_id(self.name) or self.name
        self._host_us = host_us
        self._follower = Follower(self.name, counts_per_turn)
        self._follower.opened(host_us())
        self._changed = threading.Condition()  # held while the follower or the answers are used
        self._writing = threading.Lock()  # held while the port or the sequence number is used
        self._answers: dict[int, int | None] = {}  # by the command's sequence number; None: not yet received
        self._sequence = self._number = 0
        self._ping_us = self._ask_us = host_us()
        self._question: int | None = None  # sequence number of the latest question in the background
        self._start_thread("amiwarp-link")

    @property
    def connected(self) -> bool:
        """Whether the serial port is open."""
        return self._port is not None

    @property
    def status(self) -> protocol.ControllerStatus | None:
        """Latest status of the controller; None before the first status."""
        return self._follower.status

    @property
    def identity(self) -> protocol.Identity | None:
        """Firmware and board of the controller; None if it has not said them, as firmware before 1.1."""
        return self._follower.identity

    @property
    def condition(self) -> protocol.Condition | None:
        """Supply voltage and time-out, asked for once per second; None if the controller has not told them."""
        return self._follower.condition

    @property
    def older(self) -> bool:
        """Whether the controller has refused to say what it is: its firmware is older than 1.1."""
        return self._follower.older

    def poll(self) -> LinkUpdate:
        """Return the data received since the last call, without waiting."""
        with self._changed:
            return self._follower.take()

    def clock(self) -> ClockMap | None:
        """Return the map from the host's clock to the controller's clock (that of :attr:`LinkUpdate.t_us`).

        Returns None until three pings are answered.
        """
        with self._changed:
            return self._follower.clock()

    def set_speed(self, rpm: float, ramp: float) -> None:
        """Change the motor's speed to ``rpm`` (negative: backwards) at the rate ``ramp`` [rpm/s].

        Raises :class:`AmiwarpError` if the controller refuses the command.
        """
        self._command(protocol.SetSpeed(rpm, ramp), f"set speed {rpm:g} rpm")

    def stop(self) -> None:
        """Stop the motor. Raises :class:`AmiwarpError` if the controller refuses the command."""
        self._command(protocol.Stop(), "stop")

    def set_counts(self, per_turn: int) -> None:
        """Set the encoder's counts per turn in the controller.

        Raises :class:`AmiwarpError` if it refuses the command.
        """
        self._command(protocol.SetCounts(per_turn), f"set {per_turn} counts per turn")

    def settings(self) -> dict[str, int]:
        """Return the controller's settings by name, in the units of ``protocol.SETTINGS``.

        Raises :class:`AmiwarpError` if the controller does not tell them, as firmware before 1.1.
        """
        for key, setting in enumerate(protocol.SETTINGS):
            self._command(protocol.Ask(protocol.Setting.KIND, key), f"read the setting {setting.name}")
        with self._changed:
            return {setting.name: self._follower.settings[key] for key, setting in enumerate(protocol.SETTINGS)}

    def set_setting(self, name: str, value: int) -> None:
        """Change a setting of the controller until its next reset, while the prism rests.

        ``name`` and unit are those of ``protocol.SETTINGS``. Raises :class:`AmiwarpError` for another name, for a value
        out of its range, or if the controller refuses.
        """
        found = {setting.name: (key, setting) for key, setting in enumerate(protocol.SETTINGS)}
        if name not in found:
            raise AmiwarpError(f"setting {name!r}: there is none of this name; give one of {', '.join(found)}")
        key, setting = found[name]
        if not setting.contains(value):
            off = "0 (off), or " if setting.off else ""
            unit = f" {setting.unit}" if setting.unit else ""
            raise AmiwarpError(f"setting {name} = {value}: give {off}{setting.least} to {setting.most}{unit}")
        self._command(protocol.SetSetting(key, value), f"set {name} = {value}")

    def save_settings(self) -> None:
        """Save the settings in the controller's memory, where they outlive a reset.

        Raises :class:`AmiwarpError` if it refuses, as while the prism turns, or if the memory does not keep them.
        """
        self._command(protocol.SaveSettings(), "save the settings")

    def restore_settings(self) -> None:
        """Change all settings back to those of the build, until the next reset.

        Raises :class:`AmiwarpError` if the controller refuses, as while the prism turns.
        """
        self._command(protocol.RestoreSettings(), "restore the settings of the build")

    def _command(self, message: protocol.Message, what: str) -> None:
        """Send a command and wait for its answer. ``what``: name of the command in messages."""
        if self._follower.text:
            raise AmiwarpError(f"{self.name}: {what}: the controller sends lines of text, which take no commands")
        try:
            sequence = self._send(message, answered=True)
        except ValueError as error:
            raise AmiwarpError(f"{self.name}: {what}: {error}") from error
        except OSError as error:
            raise AmiwarpError(f"{self.name}: {what}: not sent, {error}") from error
        with self._changed:
            self._changed.wait_for(lambda: self._answers[sequence] is not None, ANSWER_S)
            refused = self._answers.pop(sequence)
        if refused is None:
            raise AmiwarpError(
                f"{self.name}: {what}: no answer in {ANSWER_S:g} s; check the controller by 'amiwarp motor status'"
            )
        if refused:
            why = protocol.REFUSALS[refused] if refused < len(protocol.REFUSALS) else f"reason {refused}"
            if refused == protocol.REFUSALS.index("not possible now"):
                why += "; a command to the motor waits for a stop after a fault, one that changes settings for rest"
            raise AmiwarpError(f"{self.name}: {what}: refused by the controller, {why}")

    def _send(self, message: protocol.Message, *, answered: bool = False) -> int:
        """Send a message and return its sequence number; ``answered``: store its answer.

        Raises OSError if the port is gone or blocks, ValueError for numbers outside their range.
        """
        with self._writing:
            sequence = self._sequence
            frame = protocol.encode(message, sequence)
            if self._port is None:
                raise OSError("the port is gone")
            self._sequence = (sequence + 1) & 0xFFFF
            if answered:
                with self._changed:
                    self._answers[sequence] = None
            try:
                self._port.write(frame)
            except BaseException:
                with self._changed:
                    self._answers.pop(sequence, None)
                raise
            return sequence

    def _run(self) -> None:
        while True:
            try:
                while not self._ended.is_set():
                    self._read_port()
            except OSError:
                self._note_loss()
            self._close_port()
            if self._ended.is_set() or not self._reopen():
                return

    def _read_port(self) -> None:
        """Read the bytes that have arrived, for a short time, and send a ping if one is due."""
        data = self._port.read(1)
        if data:
            data += self._port.read(min(self._port.in_waiting, READ_BYTES))
        now = self._host_us()
        with self._changed:
            for answer in self._follower.feed(data, now):
                if answer.sequence in self._answers:  # ignore answers to commands that nobody waits for
                    self._answers[answer.sequence] = answer.refused
                elif answer.sequence == self._question:
                    self._follower.older |= answer.refused == protocol.REFUSALS.index("unknown command")
            self._changed.notify_all()
            speaks, condition = self._follower.speaks, self._follower.condition
            quick = len(self._follower.trips) < QUICK_PINGS
        timeout_s = 0 if condition is None else condition.host_timeout_s
        if speaks and now >= self._ping_us:
            keep_alive_us = min(PING_US, timeout_s * 1_000_000 // PINGS_PER_TIMEOUT or PING_US)
            self._ping_us = now + (QUICK_PING_US if quick else keep_alive_us)
            self._ping()
        if speaks and now >= self._ask_us and not self._follower.older:
            self._ask_us = now + (QUICK_ASK_US if condition is None else ASK_US)
            self._ask(protocol.Identity if self._follower.identity is None else protocol.Condition)

    def _ask(self, kind: type[protocol.Identity | protocol.Condition]) -> None:
        """Ask for a message, without waiting for it."""
        from serial import SerialTimeoutException

        with contextlib.suppress(SerialTimeoutException):
            self._question = self._send(protocol.Ask(kind.KIND))

    def _ping(self) -> None:
        from serial import SerialTimeoutException

        self._number = (self._number + 1) & 0xFFFFFFFF
        with self._changed:
            self._follower.pinged(self._number, self._host_us())
        with contextlib.suppress(SerialTimeoutException):  # a port that blocks for a while is not gone
            self._send(protocol.Ping(self._number))

    def _note_loss(self) -> None:
        with self._changed:
            self._follower.say(f"{self.name}: the port is gone; trying again until it is back")

    def _close_port(self) -> None:
        with self._writing:
            port, self._port = self._port, None
        with contextlib.suppress(OSError):
            port.close()

    def _reopen(self) -> bool:
        """Open the port again; return False if the link was closed meanwhile."""
        while not self._ended.wait(RETRY_S):
            with contextlib.suppress(AmiwarpError):
                port = open_port(self._where)
                with self._changed:
                    self._follower.opened(self._host_us())
                    self._follower.say(f"{self.name}: the port is back")
                with self._writing:
                    self._port = port
                return True
        return False
