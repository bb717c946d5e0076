"""Conversion of the controller's bytes to times, angles and messages about faults."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from amiwarp.live.link import protocol
from amiwarp.live.link.angle_tracker import AngleTracker, EncoderFault, FaultReport
from amiwarp.live.link.clocks import FEWEST_PAIRS, WRAP, ClockMap, fit_to_round_trips
from amiwarp.live.link.connection import Connection
from amiwarp.live.link.epoch import Epoch
from amiwarp.live.link.updates import LinkUpdate, UpdateQueue

TRIPS = 60
"""Number of latest round trips of pings in memory."""

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
        """Latest supply and time-out that the controller reported since the port was opened; None before the first."""
        self.older = False
        """Whether the controller has refused to say what it is: its firmware is older than 1.1."""
        self.settings: dict[int, int] = {}
        """Settings that the controller reported since the port was opened, by key."""
        self.trips: deque[tuple[int, int, int]] = deque(maxlen=TRIPS)
        """Round trips of pings: time sent (host), answered (controller), received (host) [us]."""
        self.updates = UpdateQueue()
        """Updates that wait to be fetched by the user of the link."""
        self._given_per_turn = counts_per_turn
        self._per_turn: int | None = None
        self._connection = Connection(0)
        self._epoch = Epoch(None)

    def opened(self, host_us: int) -> None:
        """Reset the state of the connection, because the port was opened or reopened."""
        self._connection = Connection(host_us)
        self.identity = None
        self.condition = None
        self.older = False
        self.settings.clear()

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
        suspect = self._epoch.suspect
        self._epoch.suspect = None
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
        waits_for_counts = not text and self._per_turn is None and bool(epoch.unscaled)
        if waits_for_counts and t - epoch.unscaled[0][0] > STATUS_US:
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
        # Negative for data that were delayed
        lead_us = epoch.clock.last + step_us - host_us - epoch.largest_lead_us
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
                self.say(
                    f"{self.name}: the controller does not report its counts per turn; give counts_per_turn"
                )
            self._connection.unusable = True
        elif per_turn != self._per_turn:
            before = self._per_turn
            self._per_turn = per_turn
            if before is not None:
                self._restart(
                    f"the controller now has {per_turn:,} counts per turn, not {before:,}"
                )
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
            self.say(
                f"first index pulse: angles are absolute from now on, and change by {moved:+.1f} deg"
            )
        self._epoch.pulses.append(t)
        self._release()

    def _release(self) -> None:
        """Give the samples that waited for the first index pulse to the caller's updates."""
        waiting = self._epoch.unreferenced or ()
        self._epoch.unreferenced = None
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
                self.say(
                    f"no index pulse for {abs(report.counts) / angles.counts_per_turn:.1f} turns"
                )
            else:
                self.say("the prism turns the other way")

    def _take_status(self, status: protocol.ControllerStatus, t: int) -> None:
        # The last one before a restart
        before = self.status if self._epoch.stall.status_us < 0 else None
        if before is not None and before.target_rpm != 0.0 and status.target_rpm == 0.0:
            self.say(
                f"the motor no longer has its speed of {before.target_rpm:g} rpm; set it again"
            )
        self.status = status
        self._epoch.stall.status_us = t
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
        elif (
            connection.received_bytes
            and host_us - connection.opened_us > STATUS_US
            and not connection.unusable
        ):
            self.say(
                f"{self.name}: receives neither frames nor lines of samples; is the port or baud rate wrong?"
            )
            connection.unusable = True
