"""Conformance suite for a controller: checks firmware, or the emulator, against ``docs/reference/link-protocol.md``.

The suite turns the motor. It stops the motor at its end, also after an error.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.live.link import protocol
from amiwarp.live.link.camera_clock import are_multiples
from amiwarp.live.link.clocks import FEWEST_PAIRS, UnwrappedClock, fit_to_round_trips, monotonic_us
from amiwarp.live.link.link import open_port

LISTEN_S, ANSWER_S, PING_S = 2.5, 1.0, 0.25
"""Time for which the first frames are awaited, longest wait for an answer, and interval of pings [s]."""
FIRST_SEQUENCE, FIRST_PING = 65_400, 0xFFFF_FFC0
"""First sequence number and first number of a ping: both use all of their bytes, and wrap during the suite."""
PONG_S, BURST = 0.05, 3
"""Longest usual round trip of a ping [s], and number of pings sent at once."""
STATUS_S, CHANGE_S = 1.3, 0.3
"""Longest time between two statuses, and until a change is in one [s]."""
LEAST_HZ, LONGEST_GAP_US = 990.0, 20_000
"""Smallest rate of encoder samples [1/s], and longest time between two of them [us]."""
CLOCK_TOLERANCE = 0.01
"""Largest relative difference between the rates of the controller's and the host's clocks."""
SPEED_TOLERANCE, OVERSHOOT = 0.02, 0.15
"""Largest relative errors of the mean speed at rest of the ramp, and of the speed at the end of the ramp."""
RAMP_S, SETTLE_S, STEADY_S, STOP_S = 1.0, 5.0, 3.0, 8.0
"""Duration of the ramp, longest time from its end to the state "at speed", time at constant speed, and longest time to
stop [s]."""
EARLY_SHARE = 0.25, 0.65
"""Smallest and largest mean speed in the second time of :data:`SLICE_S` of the ramp, as a part of the speed."""
LATCH_US, LATCH_COUNTS = 2, 2.0
"""Coarsest resolution of the controller's clock [us], and largest distance of an index pulse from the samples [counts].
"""
INDEX_COUNTS, INDEX_SHARE, PLACE_SHARE = 6.0, 0.001, 0.002
"""Largest error of the counts between index pulses [counts] or [turns], whichever is more, and largest difference
[turns] between the places of the index in the two directions."""
LAG_US, STALE_US = 35_000, 1_000
"""Longest time for which a sample may wait to be sent, and largest error of the time of a pong or status [us]."""
JUMP = 4.0
"""Speed at which counts may change, as a multiple of the largest speed of the suite."""
SYNC_HZ = (1.5, 30.0)
"""Smallest and largest rate of sync pulses [1/s]."""
SILENCE_S = 10.0
"""Longest silence of the host until the controller must report it [s]."""
SLICE_S = 0.3
"""Time at which the speed is measured during the ramp, and for which a stopped motor must stand still [s]."""
LOST_HOST_S, MOST_SUPPLY_V = 2, 60.0
"""Silence for which the controller is told to stop the motor [s], and largest plausible voltage of its supply [V]."""
HOST_TIMEOUT = [setting.name for setting in protocol.SETTINGS].index("host-timeout")
LOST_HOST_STOP = 1 << protocol.FAULTS.index("stopped for lost host")
STEEP_RPM_S, STEEP_SLICE_S, STEEP_COUNTS = 1e5, 0.05, 20.0
"""Ramp that no motor follows [rpm/s], and least time [s] and counts in which its speed is measured."""


class Wire(Protocol):
    """Line to a controller, with the host's clock."""

    def now_us(self) -> int:
        """Return the time [us]."""

    def read(self) -> bytes:
        """Wait for a short time and return the bytes that have arrived."""

    def write(self, data: bytes) -> None:
        """Send bytes."""

    def reopen(self) -> bool:
        """Close the line and open it again; return False if this line cannot."""


class SerialWire:
    """Wire through a serial port, see :func:`~amiwarp.live.link.link.open_port`."""

    def __init__(self, port: str | None) -> None:
        self._port: Any = open_port(port)
        self.name = str(self._port.port)
        self._where = port or self.name

    def now_us(self) -> int:
        """Return the time of the host's monotonic clock [us]."""
        return monotonic_us()

    def read(self) -> bytes:
        """Return the bytes that have arrived, after waiting for at most 50 ms."""
        return bytes(self._port.read(max(1, self._port.in_waiting)))

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._port.write(data)

    def reopen(self) -> bool:
        """Close the port and open it again."""
        self.close()
        self._port = open_port(self._where)
        return True

    def close(self) -> None:
        """Close the port."""
        self._port.close()


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check."""

    name: str
    """What is checked."""
    passed: bool | None
    """Whether the controller passed; None if the check was skipped."""
    measured: str
    """What was found."""
    remedy: str
    """What to do about a failure."""


def check_controller(wire: Wire, rpm: float, done: Callable[[Check], None] = lambda check: None) -> list[Check]:
    """Check a controller and return the results in order. The motor turns at up to ``rpm`` [turns/min].

    ``done`` is called with each result. A controller without frames, or without a status, ends the suite early.
    """
    suite, results = _Suite(wire, rpm), []
    try:
        for check in suite.checks():
            results.append(check)
            done(check)
    finally:
        with contextlib.suppress(OSError, AmiwarpError):
            suite.send(protocol.Stop())
    return results


class _Suite:
    """State of the suite: what was received, with unwrapped times."""

    def __init__(self, wire: Wire, rpm: float) -> None:
        self._wire, self._rpm = wire, rpm
        self._decoder, self._clock = protocol.FrameDecoder(), UnwrappedClock()
        self._sequence, self._numbers = itertools.count(FIRST_SEQUENCE), itertools.count(FIRST_PING)
        self._sent: dict[int, int] = {}
        self._trips: list[tuple[int, int, int]] = []
        self._answers: dict[int, int] = {}
        self._told: list[protocol.Message] = []  # identities, conditions and settings, as they were asked for
        self._commands: set[int] = set()  # sequence numbers of the commands without an answer
        self._status: protocol.ControllerStatus | None = None
        self._samples: list[tuple[int, int]] = []
        self._index: list[tuple[int, int]] = []
        self._sync: list[tuple[int, int]] = []
        self._statuses: list[tuple[int, protocol.ControllerStatus]] = []
        self._latest = -math.inf  # time of the latest sample or index pulse
        self._newest = -math.inf  # latest time in any message
        self._disorder, self._apart, self._stray = 0, 0, 0
        self._timeout_s = 0  # setting host-timeout before the suite
        self._older = False  # whether it does not know the messages of firmware 1.1
        self._first: protocol.FrameCounters | None = None  # opening the port cuts the first frame

    def checks(self) -> Iterator[Check]:
        """Run all checks."""
        self._run(LISTEN_S, until=lambda: self._decoder.received.frames > 1)
        received = self._decoder.received
        what = f"{received.frames} frames, {received.damaged} damaged, {received.lines} lines of text"
        yield Check("frames arrive", received.frames > 1, what, "check port, baud rate (460,800) and the sender's CRC")
        if received.frames <= 1:
            return
        self._first = protocol.FrameCounters(damaged=received.damaged, unknown=received.unknown, lost=received.lost)
        self._run(LISTEN_S, until=lambda: self._status is not None)
        yield self._check_status()
        if self._status is None:
            return
        yield self._check_pings()
        yield self._check_rest()
        yield self._check_samples()
        yield self._check_refusals()
        yield self._check_identity()
        yield self._check_settings()
        yield from self._check_speed()
        yield from self._check_bad_frames()
        yield self._check_silence()
        yield self._check_other_way()
        yield self._check_stop()
        yield self._check_steep_ramp()
        yield self._check_lost_host()
        remedy = "send samples and index pulses in the order of their times, with time and count latched together"
        yield Check("times increase", self._disorder == 0, f"{self._disorder} out of order", remedy)
        yield self._check_latch()
        yield self._check_jumps()
        yield self._check_status_times()
        yield self._check_opening()
        yield self._check_clock()
        yield self._check_pong_times()
        yield self._check_losses()

    # Talking.

    def send(self, message: protocol.Message) -> int:
        """Send a message and return its sequence number."""
        number = self._next_sequence()
        if not isinstance(message, protocol.Ping):
            self._commands.add(number)
        self._wire.write(protocol.encode(message, number))
        return number

    def _next_sequence(self) -> int:
        return next(self._sequence) & 0xFFFF

    def _ping(self) -> int:
        number = self._expect_pong()
        self.send(protocol.Ping(number))
        return number

    def _expect_pong(self) -> int:
        """Return the number of the next ping, which is sent now."""
        number = next(self._numbers) & 0xFFFF_FFFF
        self._sent[number] = self._wire.now_us()
        return number

    def _run(self, seconds: float, *, until: Callable[[], bool] = lambda: False, pings: bool = True) -> bool:
        """Receive for a time, or until a condition holds; return whether it holds."""
        end, due = self._wire.now_us() + round(seconds * 1e6), self._wire.now_us() + round(PING_S * 1e6)
        while not until():
            now = self._wire.now_us()
            if now >= end:
                return until()
            if pings and now >= due:
                self._ping()
                due = now + round(PING_S * 1e6)
            data = self._wire.read()
            host_us = self._wire.now_us()
            for _, message in self._decoder.feed(data):
                self._take(message, host_us)
        return True

    def _take(self, message: protocol.Message, host_us: int) -> None:
        if isinstance(message, protocol.Samples):
            for raw, count in zip(message.t_us, message.count, strict=True):
                t = self._time(raw, LAG_US)
                self._disorder += t <= self._latest
                self._latest = t
                self._samples.append((t, count))
        elif isinstance(message, protocol.Index):
            t = self._time(message.t_us, LAG_US)
            self._disorder += t < self._latest
            self._index.append((t, message.count))
        elif isinstance(message, protocol.Sync):
            self._sync.append((self._time(message.t_us, LAG_US), message.number))
        elif isinstance(message, protocol.ControllerStatus):
            self._status = message
            self._statuses.append((self._time(message.t_us, STALE_US), message))
        elif isinstance(message, protocol.Pong):
            t = self._time(message.t_us, STALE_US)
            if message.number in self._sent:
                self._trips.append((self._sent.pop(message.number), t, host_us))
            else:
                self._stray += 1
        elif isinstance(message, protocol.Identity | protocol.Condition | protocol.Setting):
            self._told.append(message)
            if isinstance(message, protocol.Condition):
                self._time(message.t_us, STALE_US)
        elif isinstance(message, protocol.Answer):
            self._stray += message.sequence not in self._commands
            self._commands.discard(message.sequence)
            self._answers[message.sequence] = message.refused

    def _time(self, raw: int, late_us: int) -> int:
        """Return an unwrapped time [us], and count it if it is earlier than the latest one by more than ``late_us``."""
        t = self._clock(raw)
        self._apart += t < self._newest - late_us
        self._newest = max(self._newest, t)
        return t

    def _command(self, message: protocol.Message) -> int | None:
        """Send a command and return the answer's reason for a refusal; None without an answer."""
        number = self.send(message)
        self._run(ANSWER_S, until=lambda: number in self._answers)
        return self._answers.pop(number, None)

    def _ask(self, kind: type[protocol.Plain], key: int = 0) -> protocol.Message | None:
        """Ask for a message and return it; None if it does not come, alone and before the answer 0."""
        self._told.clear()
        accepted = self._command(protocol.Ask(kind.KIND, key)) == 0
        return self._told[0] if accepted and len(self._told) == 1 and isinstance(self._told[0], kind) else None

    def _setting(self, key: int) -> int | None:
        """Return the value of a setting; None if the controller does not tell it."""
        found = self._ask(protocol.Setting, key)
        return found.value if isinstance(found, protocol.Setting) and found.key == key else None

    @property
    def _now(self) -> protocol.ControllerStatus:
        assert self._status is not None
        return self._status

    def _counts_since(self, start: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return times [us] and counts, both without wraps, of the samples from number ``start`` on."""
        rows = np.array(self._samples[start:], np.int64).reshape(-1, 2)
        return rows[:, 0], np.unwrap(rows[:, 1], period=1 << 32).astype(np.int64)

    def _speed(self, start: int) -> float:
        """Return the mean speed by the samples from number ``start`` on [turns/min]; NaN without samples."""
        t, count = self._counts_since(start)
        if len(t) < 2:
            return math.nan
        return float(count[-1] - count[0]) / float(t[-1] - t[0]) * 60e6 / max(self._now.counts_per_turn, 1)

    # Checks.

    def _check_status(self) -> Check:
        name, remedy = "status once per second", "send a status (type 0x04) once per second and on each change"
        status = self._status
        if status is None:
            return Check(name, False, f"none in {LISTEN_S:g} s", remedy)
        known = status.state < len(protocol.STATES) and status.faults >> len(protocol.FAULTS) == 0
        what = f"state {status.state}, faults {status.faults:#x}, {status.counts_per_turn:,} counts per turn"
        return Check(name, known and status.counts_per_turn > 0, what, "send a known state, faults and counts per turn")

    def _check_pings(self) -> Check:
        sent = []
        for _ in range(10):
            sent.append(self._ping())
            self._run(ANSWER_S, until=lambda: sent[-1] not in self._sent, pings=False)
        trips = sorted(received - at for at, _, received in self._trips)
        burst = [self._expect_pong() for _ in range(BURST)]
        together = b"".join(protocol.encode(protocol.Ping(number), self._next_sequence()) for number in burst)
        self._wire.write(b"\0" + together)  # two zeros in a row enclose no frame
        self._run(ANSWER_S, until=lambda: not self._sent.keys() & set(burst), pings=False)
        sent += burst
        missing = sum(number in self._sent for number in sent)
        what = f"{missing} of {len(sent)} without a pong"
        median_us = trips[len(trips) // 2] if trips else 0
        if trips:
            what += f", round trip {median_us / 1000:.1f} ms"
        good = missing == 0 and median_us <= PONG_S * 1e6
        return Check("answers pings", good, what, "check the line to the controller, and send a pong at once")

    def _check_rest(self) -> Check:
        refused = self._command(protocol.Stop())
        rests = self._run(STOP_S, until=lambda: self._now.state == 0)
        faults = [f for bit, f in enumerate(protocol.FAULTS) if self._now.faults >> bit & 1]
        what = f"answer {_reason(refused)}, state {self._now.state}, faults: {', '.join(faults) or 'none'}"
        remedy = "answer a stop (0x82) with 0 and report state 0; remove the cause of faults"
        return Check("rests after a stop", refused == 0 and rests and not faults, what, remedy)

    def _check_samples(self) -> Check:
        start = len(self._samples)
        self._run(2.0)
        t, _ = self._counts_since(start)
        rate = (len(t) - 1) / max(float(t[-1] - t[0]), 1.0) * 1e6 if len(t) > 1 else 0.0
        gap = int(np.diff(t).max()) if len(t) > 1 else 0
        what = f"{rate:.0f} per second, longest gap {gap / 1000:.1f} ms"
        good = rate >= LEAST_HZ and gap <= LONGEST_GAP_US
        remedy = "latch a sample each millisecond; is the line too slow?"
        return Check("encoder samples at 1 kHz", good, what, remedy)

    def _check_refusals(self) -> Check:
        speeds = (math.nan, 100.0), (math.inf, 100.0), (1e9, 100.0), (-1e9, 100.0)
        ramps = (10.0, -1.0), (10.0, 0.0), (10.0, math.nan), (10.0, math.inf)
        wrong: list[protocol.Message] = [protocol.SetSpeed(*pair) for pair in (*speeds, *ramps)]
        wrong.append(protocol.SetCounts(0))
        answers = [*(self._command(message) for message in wrong), self._command(protocol.SetCounts(1 << 24))]
        same = self._command(protocol.SetCounts(self._now.counts_per_turn))
        target = self._now.target_rpm
        what = f"answers {', '.join(map(_reason, answers))}; target {target:g} rpm; same counts: {_reason(same)}"
        remedy = (
            "answer 2 to speeds that are not finite or too high, to ramps that are not finite or not above 0, and to 0 "
            "or more than 16,777,215 counts per turn; answer 0 to the counts that it has"
        )
        good = set(answers) == {2} and target == 0 and same == 0
        return Check("refuses what is out of range", good, what, remedy)

    def _check_speed(self) -> Iterator[Check]:
        rpm, start = self._rpm, len(self._samples)
        refused = self._command(protocol.SetSpeed(rpm, abs(rpm) / RAMP_S))
        same = self._run(CHANGE_S, until=lambda: math.isclose(self._now.target_rpm, rpm, rel_tol=1e-6))
        what = f"answer {_reason(refused)}, target {self._now.target_rpm:g} rpm"
        yield Check(
            "accepts a speed", refused == 0 and same, what, "answer 0, and send a status with the same target at once"
        )
        arrived = self._run(RAMP_S + SETTLE_S, until=lambda: self._now.state == 1)
        self._run(RAMP_S)  # the speed may still overshoot
        yield self._check_ramp(start, arrived)
        steady, pulses, syncs = len(self._samples), len(self._index), len(self._sync)
        self._run(STEADY_S)
        mean = self._speed(steady)
        what = f"{mean:.2f} rpm by the counts, {self._now.rpm:.2f} rpm by the status"
        good = abs(mean / rpm - 1.0) <= SPEED_TOLERANCE and abs(self._now.rpm / rpm - 1.0) <= OVERSHOOT
        yield Check(
            "keeps its speed", good and self._now.state == 1, what, "check counts per turn and the control loop"
        )
        yield self._check_index(pulses)
        yield self._check_sync(syncs)

    def _check_ramp(self, start: int, arrived: bool) -> Check:
        t, count = self._counts_since(start)
        at = np.arange(t[0], t[-1], SLICE_S * 1e6) if len(t) else np.zeros(0)
        factor = 60.0 / (SLICE_S * max(self._now.counts_per_turn, 1) * self._rpm)
        speed = np.diff(np.interp(at, t, count)) * factor  # of the target
        highest, lowest = (float(speed.max()), float(speed.min())) if len(speed) else (math.nan, math.nan)
        begun, early = (float(speed[0]), float(speed[1])) if len(speed) > 1 else (math.nan, math.nan)
        what = (
            f"{100 * begun:.0f} % of the speed in the first {SLICE_S:g} s, then {100 * early:.0f} %, at most "
            f"{100 * highest:.0f} %"
        )
        if lowest < -OVERSHOOT:
            return Check(
                "follows the ramp", False, what, "the counts run backwards: exchange A and B, or the motor's wires"
            )
        on_time = begun <= SLICE_S / RAMP_S and EARLY_SHARE[0] <= early <= EARLY_SHARE[1]
        good = arrived and highest <= 1.0 + OVERSHOOT and on_time
        if not arrived:
            what += f'; no state "at speed" {SETTLE_S:g} s after the ramp'
        return Check("follows the ramp", good, what, "limit the change of the speed; tune the control loop")

    def _check_identity(self) -> Check:
        name, remedy = "says what it is", "answer 0x85 by the message that it asks for, then 0; 2 to other types"
        older = self._command(protocol.Ask(protocol.Identity.KIND))
        if older in (None, 1):
            self._older = True
            return Check(name, None, f"answer {_reason(older)}: older than firmware 1.1", "")
        who, condition = self._ask(protocol.Identity), self._ask(protocol.Condition)
        other = self._command(protocol.Ask(0x7F))
        if not isinstance(who, protocol.Identity) or not isinstance(condition, protocol.Condition):
            return Check(name, False, f"answer {_reason(older)}, but no identity or condition before it", remedy)
        supply = "unknown" if condition.supply_v is None else f"{condition.supply_v:.1f} V"
        what = f"firmware {who.version} on {who.board_name or 'an unnamed board'}, supply {supply}"
        named = who.board_name != "" and "?" not in who.board_name and who.version != "0.0.0"
        possible = condition.supply_v is None or 0 < condition.supply_v <= MOST_SUPPLY_V
        known = condition.stored < len(protocol.STORED)
        return Check(name, named and possible and known and other == 2, f"{what}, other: {_reason(other)}", remedy)

    def _check_settings(self) -> Check:
        name, remedy = "keeps settings within their ranges", "compare the settings' keys and ranges with the protocol"
        if self._older:
            return Check(name, None, "older than firmware 1.1", "")
        wrong = []
        for key, setting in enumerate(protocol.SETTINGS):
            value = self._setting(key)
            if value is None or not setting.contains(value):
                wrong.append(f"{setting.name} is {value}")
                continue
            harmless = setting.most if setting.name == "overvoltage" else setting.least
            other = next(v for v in (value - 1, value + 1, harmless) if setting.contains(v))
            below = setting.least - 2 if setting.contains(setting.least - 1) else setting.least - 1
            steps = [(setting.most + 1, 2, value), (below, 2, value), (-(1 << 31), 2, value)]
            steps += [(other, 0, other), (value, 0, value)]
            for tried, expected, kept in steps:
                answer = self._command(protocol.SetSetting(key, tried))
                if answer != expected or self._setting(key) != kept:
                    wrong.append(f"{setting.name} {tried}: answer {_reason(answer)}, then {self._setting(key)}")
        beyond = self._command(protocol.SetSetting(len(protocol.SETTINGS), 1))
        if beyond != 2:
            wrong.append(f"an unknown setting: answer {_reason(beyond)}")
        counts = self._now.counts_per_turn
        if self._setting(0) != counts:
            wrong.append(f"counts-per-turn is not the status's {counts:,}")
        self._timeout_s = self._setting(HOST_TIMEOUT) or 0
        self._command(protocol.SetSetting(HOST_TIMEOUT, 0))  # else the motor stops in the silence of later checks
        what = "; ".join(wrong[:3]) or f"{len(protocol.SETTINGS)} settings read, changed, and changed back"
        return Check(name, not wrong, what, remedy)

    def _check_lost_host(self) -> Check:
        """Turn, be silent, and expect that the motor stops by itself; the setting is the one of before at the end."""
        name = "stops for a lost host, if told so"
        if self._older:
            return Check(name, None, "older than firmware 1.1", "")
        rpm = self._rpm / 2.0
        start = self._ask(protocol.Condition)
        self._run(SLICE_S)
        taken = self._command(protocol.SetSetting(HOST_TIMEOUT, LOST_HOST_S))
        self._command(protocol.SetSpeed(rpm, 2.0 * abs(rpm)))
        kept = self._run(LOST_HOST_S + 1.0, until=lambda: self._now.target_rpm == 0)
        silent = self._wire.now_us()
        self._run(LOST_HOST_S + STOP_S, until=lambda: self._now.target_rpm == 0, pings=False)
        after = (self._wire.now_us() - silent) * 1e-6
        stopped = self._run(STOP_S, until=lambda: self._now.state == 0, pings=False)
        said = bool(self._now.faults & LOST_HOST_STOP)
        end, again = self._ask(protocol.Condition), self._command(protocol.SetSpeed(rpm, abs(rpm)))
        self._run(CHANGE_S)
        cleared = not self._now.faults & LOST_HOST_STOP
        while_turning = self._command(protocol.SetSetting(HOST_TIMEOUT, LOST_HOST_S + 1))
        self._command(protocol.Stop())
        self._run(STOP_S, until=lambda: self._now.state == 0)
        self._run(SLICE_S)
        restored = self._command(protocol.SetSetting(HOST_TIMEOUT, self._timeout_s))
        counted = (
            isinstance(start, protocol.Condition)
            and isinstance(end, protocol.Condition)
            and end.host_stops == min(start.host_stops + 1, 0xFFFF)
            and end.host_timeout_s == LOST_HOST_S
        )
        on_time = LOST_HOST_S - PING_S <= after <= LOST_HOST_S + CHANGE_S
        good = taken == restored == again == 0 and not kept and stopped and said and counted and cleared
        what = f"told {LOST_HOST_S} s, {'' if stopped else 'not '}stopped after {after:.1f} s of silence"
        what += f"{'' if counted else ', not counted'}{'' if said else ', not said'}"
        remedy = "brake when no frame came for the setting host-timeout; count it; set fault bit 10 until a new command"
        return Check(name, good and on_time and while_turning == 3, what, remedy)

    def _check_index(self, pulses: int) -> Check:
        name, remedy = "one index pulse per turn", "check the index sensor, its interrupt, and the counts per turn"
        counts = np.unwrap(np.array([c for _, c in self._index[pulses:]], np.int64), period=1 << 32)
        expected = STEADY_S * abs(self._rpm) / 60.0
        if len(counts) < max(2, expected / 2.0):
            return Check(name, False, f"{len(counts)} pulses in {expected:.0f} turns", remedy)
        per_turn = self._now.counts_per_turn
        steps = np.abs(np.diff(counts))
        allowed = max(INDEX_COUNTS, INDEX_SHARE * per_turn)
        error = float(np.abs(steps - per_turn).max())
        together = float(abs(steps.sum() - len(steps) * per_turn))
        what = f"{len(counts)} pulses, {steps.min():,} to {steps.max():,} counts apart"
        return Check(name, error <= 0.01 * per_turn and together <= allowed, what, remedy)

    def _check_latch(self) -> Check:
        name = "latches time and count together"
        t, count = self._counts_since(0)
        inside = [(at, c) for at, c in self._index if len(t) and t[0] < at < t[-1]]
        if len(inside) < 2:
            return Check(name, None, "too few index pulses", "")
        at, latched = np.array(inside, np.int64).T
        off = latched - np.interp(at, t, count)
        off -= (1 << 32) * np.rint(off / (1 << 32))
        # Pulses of the ramps, too: at a perfectly constant speed all of them are whole milliseconds apart.
        resolution = math.gcd(*np.diff(at).tolist())
        rate = abs(self._rpm) / 60e6 * self._now.counts_per_turn
        what = f"index pulses within {np.abs(off).max():.1f} counts of the samples, clock in steps of {resolution} us"
        good = np.abs(off).max() <= LATCH_COUNTS + LATCH_US * rate + 0.01 * 1000 * rate and resolution <= LATCH_US
        return Check(name, bool(good), what, "read clock and counter together in the interrupt; use a clock of 1 us")

    def _check_jumps(self) -> Check:
        t, count = self._counts_since(0)
        fastest = JUMP * abs(self._rpm) / 60e6 * self._now.counts_per_turn  # counts per us
        jumps = int((np.abs(np.diff(count)) > LATCH_COUNTS + fastest * np.maximum(np.diff(t), 1000)).sum())
        remedy = "count in 32 bits, over turns and past zero, and lose no edge"
        return Check("counts continue", jumps == 0, f"{jumps} jumps in {len(count):,} samples", remedy)

    def _check_status_times(self) -> Check:
        gaps = np.diff([t for t, _ in self._statuses])
        gap = float(gaps.max()) * 1e-6 if len(gaps) else math.inf
        early = [
            m for _, m in self._statuses if m.state == 1 and abs(m.rpm - m.target_rpm) > OVERSHOOT * abs(self._rpm)
        ]
        what = (
            f"{len(self._statuses)} statuses, {gap:.2f} s apart at most, {len(early)} say too early that it is at speed"
        )
        remedy = "send a status once per second, and state 1 only at the speed"
        return Check("keeps sending its status", gap <= STATUS_S and not early, what, remedy)

    def _check_sync(self, syncs: int) -> Check:
        name, pulses = "sync pulses", self._sync[syncs:]
        if not pulses:
            return Check(name, None, "none; without them clocks agree to about a millisecond", "")
        rate = len(pulses) / STEADY_S
        consecutive = all((b - a) % (1 << 32) == 1 for (_, a), (_, b) in itertools.pairwise(pulses))
        times = np.unwrap(np.array([t for t, _ in pulses], np.int64), period=1 << 32).astype(np.int64)
        regular = are_multiples(times)
        order = "numbers in order" if consecutive else "numbers with gaps"
        spacing = (
            "at regular intervals, by which clocks are not known for sure" if regular else "at irregular intervals"
        )
        good = consecutive and SYNC_HZ[0] <= rate <= SYNC_HZ[1]
        least, most = protocol.PULSE_INTERVAL_MS
        remedy = f"send a pulse every {least} to {most} ms, drawn at random for each, and number them from 0"
        return Check(name, good, f"{rate:.1f} per second, {spacing}, {order}", remedy)

    def _check_bad_frames(self) -> Iterator[Check]:
        rng = random.Random(0)
        for frame in [
            *(self._damaged(protocol.Stop(), byte) for byte in range(2, 8)),
            *(self._damaged(protocol.SetSpeed(self._rpm / 2.0, 1e3), byte) for byte in (4, 6, 8, 11)),
            protocol.encode(protocol.Stop(), self._next_sequence())[:-3] + b"\0",
            bytes(rng.randrange(1, 256) for _ in range(300)) + b"\0",
            b"\x55" * 700 + b"\0",
        ]:
            self._wire.write(frame)
            self._run(0.05, pings=False)
        damaged = self._kept_speed()
        unanswered = [b"\2\x82\0\0", b"\1\xf0\0\0" + b"\1" * 600]  # another version, longer than a frame may be
        unheard = [self._offer(packet) for packet in unanswered]
        other = [
            b"\1\xf0\0\0",
            b"\1\xf0\0\0" + bytes(300),
            b"\1\xf0\0\0" + b"\1" * 300,  # more than one full block
            b"\1\x82\0\0\7",
            b"\1\x81\0\0" + bytes(12),
            b"\1\x83\0\0\1",
        ]
        answers = [self._answers.pop(self._offer(packet), None) for packet in other]
        heard = sum(number in self._answers for number in unheard)
        kept = self._kept_speed()
        what = f"pong: {'yes' if damaged and kept else 'no'}, target {self._now.target_rpm:g} rpm, {heard} answered"
        remedy = "drop frames with a wrong CRC, version or length, and synchronise at the next zero byte"
        yield Check("ignores bad frames", damaged and kept and heard == 0, what, remedy)
        name, what = "answers unknown commands", f"answers {', '.join(map(_reason, answers))}"
        if not any(answer is not None for answer in answers):
            yield Check(name, None, "none: an older controller, which skips them", "")
            return
        yield Check(name, set(answers) == {1}, what, "answer 1 to an unknown type, and to a payload of another size")

    def _damaged(self, message: protocol.Message, byte: int) -> bytes:
        """Return a frame that is whole but for one bit of a byte of the packet or of its CRC."""
        from cobs import cobs

        packet = bytearray(cobs.decode(protocol.encode(message, self._next_sequence())[:-1]))
        packet[byte] ^= 0x10
        return bytes(cobs.encode(bytes(packet))) + b"\0"

    def _offer(self, packet: bytes) -> int:
        """Send a packet with a sequence number and a valid CRC; return the number."""
        number = self._next_sequence()
        self._commands.add(number)
        self._wire.write(protocol.framed(packet[:2] + number.to_bytes(2, "little") + packet[4:]))
        self._run(0.05, pings=False)
        return number

    def _kept_speed(self) -> bool:
        """Whether a ping is answered, and the speed is the same as before."""
        number = self._ping()
        answered = self._run(ANSWER_S, until=lambda: number not in self._sent, pings=False)
        return answered and math.isclose(self._now.target_rpm, self._rpm, rel_tol=1e-6)

    def _check_silence(self) -> Check:
        lost = 1 << protocol.FAULTS.index("host lost")
        start = self._wire.now_us()
        noticed = self._run(SILENCE_S, until=lambda: bool(self._now.faults & lost), pings=False)
        after = (self._wire.now_us() - start) * 1e-6
        samples = len(self._samples)
        self._run(0.5, pings=False)
        speed = self._speed(samples)
        self._ping()
        cleared = self._run(LISTEN_S, until=lambda: not self._now.faults & lost)
        turning = abs(speed / self._rpm - 1.0) <= OVERSHOOT
        noted = f"reported after {after:.1f} s" if noticed else f"not reported in {SILENCE_S:g} s"
        what = f'"host lost" {noted}, {speed:.0f} rpm meanwhile, {"" if cleared else "not "}cleared by a ping'
        remedy = "set fault bit 4 after a few seconds without a frame, clear it at the next; keep the motor turning"
        return Check("notices a silent host", noticed and turning and cleared, what, remedy)

    def _check_other_way(self) -> Check:
        """Turn the other way, at a speed that is not a whole number."""
        rpm, before = -0.75 * self._rpm - math.copysign(0.375, self._rpm), self._index[-1:]
        refused = self._command(protocol.SetSpeed(rpm, abs(self._rpm) / RAMP_S))
        arrived = self._run(
            2.0 * RAMP_S + SETTLE_S, until=lambda: self._now.state == 1 and math.isclose(self._now.target_rpm, rpm)
        )
        self._run(RAMP_S)
        start, pulses = len(self._samples), len(self._index)
        self._run(STEADY_S)
        mean, per_turn = self._speed(start), max(self._now.counts_per_turn, 1)
        what = (
            f"answer {_reason(refused)}, {mean:.2f} of {rpm:.2f} rpm by the counts, {self._now.rpm:.2f} by the status"
        )
        good = abs(mean / rpm - 1.0) <= SPEED_TOLERANCE and abs(self._now.rpm / rpm - 1.0) <= OVERSHOOT
        if before:
            away = [math.remainder(count - before[0][1], per_turn) for _, count in self._index[pulses:]]
            place = max(map(abs, away), default=math.inf)
            what += f", the index {place:g} counts from its place forwards"
            good &= place <= LATCH_COUNTS + PLACE_SHARE * per_turn
        remedy = (
            "count down backwards; take the same edge of the index pulse in both directions, which is at lower counts"
        )
        return Check("turns the other way", refused == 0 and arrived and good, what, remedy)

    def _check_stop(self) -> Check:
        refused, start = self._command(protocol.Stop()), self._wire.now_us()
        rests = self._run(STOP_S, until=lambda: self._now.state == 0)
        after, samples = (self._wire.now_us() - start) * 1e-6, len(self._samples)
        self._run(SLICE_S)
        speed = self._speed(samples)
        slow = max(0.05 * abs(self._rpm), 60.0 / SLICE_S / max(self._now.counts_per_turn, 1) * 2)
        still = abs(speed) < slow and abs(self._now.rpm) < slow
        what = f"answer {_reason(refused)}, state {self._now.state} after {after:.1f} s, {speed:.1f} rpm by the counts"
        good = refused == 0 and rests and still and self._now.target_rpm == 0
        return Check("stops", good, what, "brake to rest and report state 0 and target 0")

    def _check_steep_ramp(self) -> Check:
        name, rpm, start = "limits its acceleration", self._rpm / 2.0, len(self._samples)
        refused = self._command(protocol.SetSpeed(rpm, STEEP_RPM_S))
        if refused == 2:
            return Check(name, None, f"it refuses a ramp of {STEEP_RPM_S:g} rpm/s", "")
        self._run(RAMP_S)
        t, count = self._counts_since(start)
        self._command(protocol.Stop())
        self._run(STOP_S, until=lambda: self._now.state == 0)
        per_us = abs(rpm) / 60e6 * max(self._now.counts_per_turn, 1)
        slice_us = max(STEEP_SLICE_S * 1e6, STEEP_COUNTS / per_us)
        at = np.arange(t[0], t[-1], slice_us) if len(t) else np.zeros(0)
        speed = np.diff(np.interp(at, t, count)) / (slice_us * per_us) * math.copysign(1.0, rpm)
        highest = float(speed.max()) if len(speed) else math.nan
        what = f"answer {_reason(refused)}, at most {100 * highest:.0f} % of {rpm:g} rpm"
        remedy = "limit the ramp to one that the motor can follow, or tune the control loop"
        return Check(name, refused == 0 and 0.5 < highest <= 1.0 + OVERSHOOT, what, remedy)

    def _check_opening(self) -> Check:
        name, before, restarts = "runs on when the port is opened", self._latest, self._decoder.received.restarts
        kept = self._decoder.received.damaged, self._decoder.received.lost
        if not self._wire.reopen():
            return Check(name, None, "this line cannot be opened again", "")
        start = len(self._samples)
        self._run(LISTEN_S, until=lambda: len(self._samples) > start + 100)
        again = self._decoder.received
        alive = len(self._samples) > start
        good = alive and again.restarts == restarts and self._samples[start][0] > before
        again.damaged, again.lost = kept  # closing the port cuts frames
        what = "sequence numbers and clock continue" if good else "restarted" if alive else "no samples"
        return Check(name, good, what, "disable the board's automatic reset by DTR")

    def _check_clock(self) -> Check:
        name, remedy = "its clock counts microseconds", "count microseconds; wrap at 32 bits, not before"
        if len(self._trips) < FEWEST_PAIRS:
            return Check(name, None, "too few pongs", remedy)
        drift = fit_to_round_trips(*np.array(self._trips, np.int64).T).drift
        return Check(name, abs(drift) <= CLOCK_TOLERANCE, f"{1e6 * drift:+.0f} ppm to this computer's", remedy)

    def _check_pong_times(self) -> Check:
        name, remedy = "pongs carry its time", "put the clock of the samples into each pong and status as it is sent"
        if len(self._trips) < FEWEST_PAIRS:
            return Check(name, None, "too few pongs", remedy)
        sent, at, received = np.array(self._trips, np.int64).T
        middle = sent + (received - sent) // 2
        outside = np.abs(at - fit_to_round_trips(sent, at, received)(middle)) - (received - sent) / 2
        worst = max(float(outside.max()), 0.0)
        what = f"{worst / 1000:.1f} ms outside the round trip, {self._apart} times apart, {self._stray} not asked for"
        return Check(name, worst <= STALE_US and self._apart + self._stray == 0, what, remedy)

    def _check_losses(self) -> Check:
        now, first = self._decoder.received, self._first
        assert first is not None
        damaged, lost, unknown = now.damaged - first.damaged, now.lost - first.lost, now.unknown - first.unknown
        what = f"{now.frames:,} frames: {damaged} damaged, {lost} lost, {unknown} unknown, {now.restarts} restarts"
        remedy = "check cable and baud rate; print nothing else on this port; did the controller reset?"
        return Check("no frame is damaged or lost", damaged + lost + unknown + now.restarts == 0, what, remedy)


def _reason(refused: int | None) -> str:
    return "none" if refused is None else str(refused)
