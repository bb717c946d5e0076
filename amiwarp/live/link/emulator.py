"""An emulated controller: clock, encoder, index, commands and faults on demand, by the protocol; no port, no thread."""

from __future__ import annotations

import math
import random
import re
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.live.link.clocks import WRAP
from amiwarp.live.link.protocol import (
    FAULTS,
    MOST_SAMPLES,
    Answer,
    Decoder,
    Index,
    Message,
    Ping,
    Pong,
    Samples,
    SetCounts,
    SetSpeed,
    Status,
    Stop,
    Sync,
    encode,
)
from amiwarp.live.link.rotors import Played, Rotor

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

LASTING = {
    "garbage": 0.5, "truncate": 0.5, "crc": 0.5, "drop": 0.5, "missed-index": 0.5, "stall": 2.0, "reverse": 1.0,
    "unplug": 1.0,
}  # fmt: skip
"""Faults that last, and for how long [s] where nothing else is said: bytes put in, frames cut, bits changed, bytes lost
(each hits every other frame), index pulses missed, counts that stay, a motor that turns back, a cable pulled out."""
AT_ONCE = ("slip", "reset", "clock-jump")
"""Faults that happen at once: a twentieth of a turn of counts lost, a reboot, a clock that goes ahead by a minute."""
SLIP_TURNS, JUMP_US = 0.05, 60_000_000
STEP_US = 10_000
"""The state is looked at so often."""
BATCH_US = 5_000
"""Samples are sent at least so often."""
MOST_RPM = 6000.0
HOST_US = 3_000_000
"""Without a frame for so long the host is lost."""
MOST_OUT = 1 << 20
"""Bytes that wait to be sent; more are lost, as on any line without flow control, after the program was suspended."""
STOP_RAMP = 2000.0
"""[rpm/s]"""


@dataclass(frozen=True, slots=True)
class Fault:
    """One of :data:`LASTING` or :data:`AT_ONCE`, from a time of the world on [s]."""

    name: str
    start_s: float
    duration_s: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Fault:
        """``NAME@SECONDS`` or ``NAME@SECONDS+DURATION``. Raises :class:`AmiwarpError` for anything else."""
        match = re.fullmatch(r"([a-z-]+)@(\d+(?:\.\d*)?)(?:\+(\d+(?:\.\d*)?))?", text)
        if match is None or match[1] not in (*LASTING, *AT_ONCE):
            names = ", ".join((*LASTING, *AT_ONCE))
            raise AmiwarpError(f"fault {text!r}: give NAME@SECONDS or NAME@SECONDS+DURATION, NAME one of {names}")
        if match[1] in AT_ONCE and match[3]:
            raise AmiwarpError(f"fault {text!r}: {match[1]} happens at once; leave the duration out")
        return cls(match[1], float(match[2]), float(match[3] or LASTING.get(match[1], 0.0)))


class Controller:
    """Firmware of ``docs/link-protocol.md`` and the world around it; the caller tells the world's time [us].

    ``drift_ppm``: its clock is fast by so much; ``clock_start``: what the clock shows at ``start_us``, when it is
    switched on. Raises :class:`AmiwarpError` for a reversal of a rotor that takes no commands.
    """

    def __init__(
        self,
        rotor: Rotor,
        *,
        counts_per_turn: int = 4096,
        sample_hz: float = 1000.0,
        drift_ppm: float = 0.0,
        clock_start: int = 0,
        sync_hz: float = 10.0,
        start_us: int = 0,
        faults: Iterable[Fault] = (),
        seed: int = 0,
    ) -> None:
        faults = tuple(faults)
        if isinstance(rotor, Played) and any(fault.name == "reverse" for fault in faults):
            raise AmiwarpError("fault reverse: a recorded rotation is played as it was; leave it out")
        self.rotor = rotor
        self.counts_per_turn = counts_per_turn
        self.plugged = True
        """Whether its cable is in the port: an unplugged one turns on."""
        self.pulses: deque[tuple[int, int]] = deque(maxlen=1000)
        """The last sync pulses: number, and the world's time [us]."""
        self._rate = 1.0 + drift_ppm * 1e-6
        self._sample_us, self._sync_us = 1e6 / sample_hz, 1e6 / sync_hz
        self._batch_size = min(max(int(BATCH_US / self._sample_us), 1), MOST_SAMPLES)
        self._rng = random.Random(seed)
        due = [(edge, fault, on) for fault in faults for edge, on in _edges(fault, start_us)]
        self._due = sorted(due, key=itemgetter(0))
        self._active: list[str] = []
        self._decoder = Decoder()
        self._heard_us = self._now = start_us
        self._out = bytearray()
        self._boot(clock_start)
        self._switch()

    def advance(self, now_us: int) -> bytes:
        """What it sends until a time of the world; empty where its cable is out."""
        self._run(now_us)
        out = bytes(self._out)
        self._out.clear()
        return out

    def feed(self, data: bytes, now_us: int) -> None:
        """Bytes that reach it at a time of the world; answers come with the next :meth:`advance`."""
        self._run(now_us)
        for sequence, message in self._decoder.feed(data) if self.plugged else ():
            if sequence is not None:
                self._heard_us = self._now
                self._obey(sequence, message)

    def clock(self, world_us: float) -> int:
        """What its clock shows at a time of the world, not wrapped [us]."""
        return self._clock_start + math.floor((world_us - self._boot_us) * self._rate)

    def world(self, clock_us: ArrayLike) -> NDArray[np.float64]:
        """The world's times at which its clock, not wrapped, shows these [us]."""
        return self._boot_us + (np.asarray(clock_us) - self._clock_start) / self._rate

    def _boot(self, clock_start: int) -> None:
        self._boot_us, self._clock_start, self._sequence = self._now, clock_start, 0
        self._batch: list[tuple[int, int]] = []
        self._before = self._now, float(self.rotor.angle(self._now))
        self._lost = math.floor(self._turns())  # counts that the encoder would show, less this, is what it shows
        self._frozen: int | None = None
        self._shown: tuple[int, int, float, int] | None = None
        self._looked = self._now

    def _turns(self) -> float:
        """Where it is, in counts since the index of turn 0."""
        return float(self.rotor.angle(self._now)) * self.counts_per_turn / math.tau

    def _count(self, whole: int) -> int:
        return self._frozen if self._frozen is not None else whole - self._lost

    def _run(self, now_us: int) -> None:
        while self._now < now_us:
            until = min(now_us, self._now + STEP_US, *(edge for edge, *_ in self._due[:1]))
            self._span(until)
            self._now = until
            self._switch()
            if self._now - self._looked >= STEP_US or self._shown is None:
                self._report()

    def _span(self, until: int) -> None:
        """Sends what belongs to the time from now to ``until``, in its order."""
        first, last = ((t - self._boot_us) * self._rate for t in (self._now, until))
        sampled = np.arange(math.floor(first / self._sample_us) + 1, math.floor(last / self._sample_us) + 1)
        elapsed = sampled * self._sample_us
        world = self._boot_us + elapsed / self._rate
        angle = self.rotor.angle(world)
        whole = np.floor(angle * (self.counts_per_turn / math.tau)).astype(np.int64)
        due: list[tuple[float, Message | int]] = list(zip(elapsed.tolist(), whole.tolist(), strict=True))
        due += self._indices(np.append(self._before[0], world), np.append(self._before[1], angle))
        if len(world):
            self._before = world[-1], angle[-1]
        for k in range(math.floor(first / self._sync_us) + 1, math.floor(last / self._sync_us) + 1):
            at = k * self._sync_us
            self.pulses.append((k - 1, round(self._boot_us + at / self._rate)))
            due.append((at, Sync(self._t(at), (k - 1) % WRAP)))
        for at, what in sorted(due, key=itemgetter(0)):
            if isinstance(what, int):
                self._batch.append((self._t(at), _int32(self._count(what))))
                if len(self._batch) >= self._batch_size:
                    self._flush()
            else:
                self._send(what)
        if math.floor(last / 1e6) > math.floor(first / 1e6):
            self._shown = None  # the status is sent once a second

    def _indices(self, world: NDArray[np.float64], angle: NDArray[np.float64]) -> list[tuple[float, Message | int]]:
        """Pulses between samples."""
        turns = np.floor(angle / math.tau).astype(np.int64)
        found: list[tuple[float, Message | int]] = []
        for k in np.flatnonzero(np.diff(turns)) if "missed-index" not in self._active else ():
            turn = int(max(turns[k : k + 2]))
            share = (turn * math.tau - angle[k]) / (angle[k + 1] - angle[k])
            at = (world[k] + share * (world[k + 1] - world[k]) - self._boot_us) * self._rate
            found.append((at, Index(self._t(at), _int32(self._count(turn * self.counts_per_turn)))))
        return found

    def _t(self, elapsed: float) -> int:
        return (self._clock_start + math.floor(elapsed)) % WRAP

    def _switch(self) -> None:
        """Faults that begin or end now."""
        while self._due and self._due[0][0] <= self._now:
            _, fault, on = self._due.pop(0)
            if fault.name in LASTING:
                (self._active.append if on else self._active.remove)(fault.name)
            if fault.name == "slip":
                self._lost += round(SLIP_TURNS * self.counts_per_turn)
            elif fault.name == "reset":
                self._boot(0)
            elif fault.name == "clock-jump":
                self._flush()
                self._clock_start += JUMP_US
            elif fault.name == "stall":
                whole = math.floor(self._turns())
                if on:
                    self._frozen = whole - self._lost
                elif self._frozen is not None:
                    self._lost, self._frozen = whole - self._frozen, None
            elif fault.name == "reverse":
                self.rotor.set_speed(-self.rotor.target_rpm(self._now), STOP_RAMP, self._now)
        self.plugged = "unplug" not in self._active

    def _report(self) -> None:
        """The status, where something in it changed."""
        self._looked = self._now
        early = max(self._now - 20_000, self._boot_us)
        turned = float(self.rotor.angle(self._now)) - float(self.rotor.angle(early))
        rpm = turned / math.tau * 60e6 / max(self._now - early, 1)
        target = self.rotor.target_rpm(self._now)
        state = 0 if target == 0 and abs(rpm) < 1 else 1 if abs(rpm - target) <= 0.03 * abs(target) + 1 else 2
        lost = (1 << FAULTS.index("host lost")) * (self._now - self._heard_us > HOST_US)
        shown = state, lost, target, self.counts_per_turn
        if shown != self._shown:
            self._shown = shown
            t = self.clock(self._now) % WRAP
            self._send(Status(t, state, lost, rpm, target, self.counts_per_turn))

    def _obey(self, sequence: int, message: Message) -> None:
        refused = 0
        if isinstance(message, Ping):
            self._report()
            self._send(Pong(message.number, self.clock(self._now) % WRAP))
            return
        if isinstance(message, SetSpeed):
            fits = abs(message.rpm) <= MOST_RPM and 0 < message.ramp < math.inf
            refused = 2 if not fits else 0 if self.rotor.set_speed(message.rpm, message.ramp, self._now) else 3
        elif isinstance(message, Stop):
            refused = 0 if self.rotor.set_speed(0.0, STOP_RAMP, self._now) else 3
        elif isinstance(message, SetCounts):
            refused = 0 if 0 < message.per_turn < 1 << 24 else 2
            if not refused:
                self._flush()
                self.counts_per_turn = message.per_turn
                self._lost = math.floor(self._turns())
        else:
            refused = 1
        self._send(Answer(sequence, refused))
        self._report()

    def _flush(self) -> None:
        batch, self._batch = self._batch, []
        if batch:
            self._send(Samples(tuple(t for t, _ in batch), tuple(count for _, count in batch)))

    def _send(self, message: Message) -> None:
        if not isinstance(message, Samples):
            self._flush()
        frame = encode(message, self._sequence)
        self._sequence = (self._sequence + 1) % (1 << 16)
        if self.plugged and len(self._out) < MOST_OUT:
            self._out += self._wire(bytearray(frame))

    def _wire(self, frame: bytearray) -> bytearray:
        """A frame as it arrives."""
        for name in self._active:
            if name in ("garbage", "truncate", "crc", "drop") and self._rng.random() < 0.5:
                at = self._rng.randrange(1, len(frame))
                if name == "garbage":
                    frame = bytearray(self._rng.randbytes(self._rng.randrange(1, 40))) + frame
                elif name == "truncate":
                    del frame[at:]
                elif name == "crc":
                    frame[at] ^= 1 << self._rng.randrange(8)
                else:
                    del frame[at]
        return frame


def _edges(fault: Fault, start_us: int) -> list[tuple[int, bool]]:
    """When it begins, and ends where it lasts [us]."""
    first = start_us + round(fault.start_s * 1e6)
    ends = [(first + round(fault.duration_s * 1e6), False)] if fault.name in LASTING else []
    return [(first, True), *ends]


def _int32(count: int) -> int:
    return (count + (1 << 31)) % WRAP - (1 << 31)
