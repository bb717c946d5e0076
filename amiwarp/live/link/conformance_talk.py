"""Line to a controller whose conformance is checked, and what it has said since the suite began."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.live.link import protocol
from amiwarp.live.link.clocks import UnwrappedClock, monotonic_us
from amiwarp.live.link.conformance_limits import (
    ANSWER_S,
    LAG_US,
    PING_S,
    STALE_US,
)
from amiwarp.live.link.ports import open_port

FIRST_SEQUENCE = 65_400
"""First sequence number: it uses all of its bytes, and wraps during the suite."""
FIRST_PING = 0xFFFF_FFC0
"""First number of a ping: it uses all of its bytes, and wraps during the suite."""


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
    """Wire through a serial port, see :func:`~amiwarp.live.link.ports.open_port`."""

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


def reason(refused: int | None) -> str:
    """Return the reason of a refusal for messages; "none" without an answer."""
    return "none" if refused is None else str(refused)


class Conversation:
    """What was sent to a controller and received from it, with unwrapped times."""

    def __init__(self, wire: Wire, rpm: float) -> None:
        """``rpm``: largest speed of the suite [turns/min]."""
        self.wire = wire
        self.rpm = rpm
        """Largest speed of the suite [turns/min]."""
        self.decoder = protocol.FrameDecoder()
        self.first: protocol.FrameCounters | None = None
        """Counters of the decoder after the first frames, because opening the port cuts a frame."""
        self.sent: dict[int, int] = {}
        """Host times [us] of the pings without a pong, by number."""
        self.trips: list[tuple[int, int, int]] = []
        """Round trips of pings: time sent (host), answered (controller), received (host) [us]."""
        self.commands: set[int] = set()
        """Sequence numbers of the commands without an answer."""
        self.answers: dict[int, int] = {}
        """Reasons for refusals, 0 for none, by the command's sequence number."""
        self.reported: list[protocol.Message] = []
        """Identities, conditions and settings since the latest question."""
        self.last_status: protocol.ControllerStatus | None = None
        """Latest status; None before the first."""
        self.statuses: list[tuple[int, protocol.ControllerStatus]] = []
        """All statuses, each with its time [us]."""
        self.samples: list[tuple[int, int]] = []
        """Times [us] and raw counts of the samples."""
        self.index: list[tuple[int, int]] = []
        """Times [us] and raw counts of the index pulses."""
        self.sync: list[tuple[int, int]] = []
        """Times [us] and numbers of the sync pulses."""
        self.latest_us = -math.inf
        """Time of the latest sample or index pulse [us]."""
        self.disorder = 0
        """Number of samples and index pulses out of order."""
        self.apart = 0
        """Number of messages whose time is too far before the time of an earlier message."""
        self.stray = 0
        """Number of pongs and answers that nobody waits for."""
        self.older = False
        """Whether the controller does not know the messages of firmware 1.1; set by the check of its identity."""
        self.timeout_s = 0
        """Setting host-timeout before the suite [s]; set by the check of the settings."""
        self._clock = UnwrappedClock()
        self._sequence = itertools.count(FIRST_SEQUENCE)
        self._numbers = itertools.count(FIRST_PING)
        # Latest time in any message
        self._newest_us = -math.inf

    def send(self, message: protocol.Message) -> int:
        """Send a message and return its sequence number."""
        number = self.next_sequence()
        if not isinstance(message, protocol.Ping):
            self.commands.add(number)
        self.wire.write(protocol.encode(message, number))
        return number

    def next_sequence(self) -> int:
        """Return the next sequence number."""
        return next(self._sequence) & 0xFFFF

    def ping(self) -> int:
        """Send a ping and return its number."""
        number = self.expect_pong()
        self.send(protocol.Ping(number))
        return number

    def expect_pong(self) -> int:
        """Return the number of the next ping, which is sent now."""
        number = next(self._numbers) & 0xFFFF_FFFF
        self.sent[number] = self.wire.now_us()
        return number

    def run(
        self, seconds: float, *, until: Callable[[], bool] = lambda: False, pings: bool = True
    ) -> bool:
        """Receive for a time, or until a condition holds; return whether it holds."""
        end = self.wire.now_us() + round(seconds * 1e6)
        due = self.wire.now_us() + round(PING_S * 1e6)
        while not until():
            now = self.wire.now_us()
            if now >= end:
                return until()
            if pings and now >= due:
                self.ping()
                due = now + round(PING_S * 1e6)
            data = self.wire.read()
            host_us = self.wire.now_us()
            for _, message in self.decoder.feed(data):
                self._take(message, host_us)
        return True

    def _take(self, message: protocol.Message, host_us: int) -> None:
        """Store a message that arrived at a host time [us]."""
        if isinstance(message, protocol.Samples):
            for raw, count in zip(message.t_us, message.count, strict=True):
                t = self._time(raw, LAG_US)
                self.disorder += t <= self.latest_us
                self.latest_us = t
                self.samples.append((t, count))
        elif isinstance(message, protocol.Index):
            t = self._time(message.t_us, LAG_US)
            self.disorder += t < self.latest_us
            self.index.append((t, message.count))
        elif isinstance(message, protocol.Sync):
            self.sync.append((self._time(message.t_us, LAG_US), message.number))
        elif isinstance(message, protocol.ControllerStatus):
            self.last_status = message
            self.statuses.append((self._time(message.t_us, STALE_US), message))
        elif isinstance(message, protocol.Pong):
            t = self._time(message.t_us, STALE_US)
            if message.number in self.sent:
                self.trips.append((self.sent.pop(message.number), t, host_us))
            else:
                self.stray += 1
        elif isinstance(message, protocol.Identity | protocol.Condition | protocol.Setting):
            self.reported.append(message)
            if isinstance(message, protocol.Condition):
                self._time(message.t_us, STALE_US)
        elif isinstance(message, protocol.Answer):
            self.stray += message.sequence not in self.commands
            self.commands.discard(message.sequence)
            self.answers[message.sequence] = message.refused

    def _time(self, raw: int, late_us: int) -> int:
        """Return an unwrapped time [us], and count it if it is earlier than the latest one by more than ``late_us``."""
        t = self._clock(raw)
        self.apart += t < self._newest_us - late_us
        self._newest_us = max(self._newest_us, t)
        return t

    def command(self, message: protocol.Message) -> int | None:
        """Send a command and return the answer's reason for a refusal; None without an answer."""
        number = self.send(message)
        self.run(ANSWER_S, until=lambda: number in self.answers)
        return self.answers.pop(number, None)

    def ask(self, kind: type[protocol.Plain], key: int = 0) -> protocol.Message | None:
        """Ask for a message and return it; None if it does not come, alone and before the answer 0."""
        self.reported.clear()
        accepted = self.command(protocol.Ask(kind.KIND, key)) == 0
        if not accepted or len(self.reported) != 1 or not isinstance(self.reported[0], kind):
            return None
        return self.reported[0]

    def setting(self, key: int) -> int | None:
        """Return the value of a setting; None if the controller does not tell it."""
        found = self.ask(protocol.Setting, key)
        if not isinstance(found, protocol.Setting) or found.key != key:
            return None
        return found.value

    @property
    def status(self) -> protocol.ControllerStatus:
        """Latest status; there must be one."""
        assert self.last_status is not None
        return self.last_status

    def counts_since(self, start: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return times [us] and counts, both without wraps, of the samples from number ``start`` on."""
        rows = np.array(self.samples[start:], np.int64).reshape(-1, 2)
        return rows[:, 0], np.unwrap(rows[:, 1], period=1 << 32).astype(np.int64)

    def speed(self, start: int) -> float:
        """Return the mean speed by the samples from number ``start`` on [turns/min]; NaN without samples."""
        t, count = self.counts_since(start)
        if len(t) < 2:
            return math.nan
        counts_per_us = float(count[-1] - count[0]) / float(t[-1] - t[0])
        return counts_per_us * 60e6 / max(self.status.counts_per_turn, 1)
