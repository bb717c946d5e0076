"""Emulated controller: clock, encoder, index pulse, commands and injected faults, without a port or a thread."""

from __future__ import annotations

import bisect
import contextlib
import math
import os
import random
import re
import select
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.live.link import protocol
from amiwarp.live.link.clocks import WRAP, monotonic_us
from amiwarp.live.queues import BackgroundLoop

# Rotation of the emulated prism: by a simulated motor, or as in a recording.

MOST_SEGMENTS = 1024
"""Largest number of motor segments in memory. The oldest segment then also describes all earlier times."""
RPM = math.tau / 60.0
"""Factor from turns per minute to rad/s."""


class Rotor(Protocol):
    """Rotation of the emulated prism, with an index pulse at every whole turn. All times are emulation times [us]."""

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Return the unwrapped prism angles [rad] at times ``t_us``, same shape.

        Angles of future times assume that no further command comes.
        """

    def target_rpm(self, t_us: int) -> float:
        """Return the commanded speed at a time [turns/min]."""

    def set_speed(self, rpm: float, ramp: float, t_us: int) -> bool:
        """Change to the speed ``rpm`` at ``ramp`` [rpm/s] from ``t_us`` on; return False if commands are not taken."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Segment:
    """Motion of the motor from ``start`` on: the target speed changes linearly, and the speed follows with a lag."""

    start: float
    """Time at which the segment starts [s]."""
    angle: float
    """Prism angle at the start of the segment [rad]."""
    speed: float
    """Speed of the prism at the start of the segment [rad/s]."""
    target: float
    """Target speed at the start of the segment [rad/s]."""
    slope: float
    """Rate of change of the target speed [rad/s²]."""


class Motor:
    """Simulated motor whose speed follows the ramped target speed with the time constant ``inertia_s`` [s].

    The angle is 0 at time 0. ``ripple``: relative speed variation once and six times per turn, as caused by magnet
    poles. ``noise``: relative rms speed variation by random friction, from ``seed``. Both are functions of the angle,
    so a motor at rest stays at rest. The angle is a closed formula: angles can be computed for any times, in any order.
    """

    def __init__(
        self, rpm: float = 0.0, *, inertia_s: float = 0.15, ripple: float = 0.01, noise: float = 0.003, seed: int = 0
    ) -> None:
        rng = np.random.default_rng(seed)
        self._inertia = inertia_s
        self._frequency = np.concatenate([[1.0, 6.0], np.exp(rng.uniform(math.log(0.05), math.log(3.0), 8))])
        amplitude = np.concatenate([np.full(2, ripple / 2.0), np.full(8, noise * 0.5)])
        self._amplitude, self._phase = amplitude / self._frequency, rng.uniform(0.0, math.tau, 10)
        self._segments = [_Segment(start=0.0, angle=0.0, speed=rpm * RPM, target=rpm * RPM, slope=0.0)]

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Return the unwrapped prism angles [rad], see :class:`Rotor`. The speed is constant before time 0."""
        t = np.asarray(t_us, np.float64) * 1e-6
        smooth = np.empty(t.shape)
        index = np.maximum(np.searchsorted([p.start for p in self._segments], t, side="right") - 1, 0)
        for k in np.unique(index):
            smooth[index == k] = self._state_at(self._segments[k], t[index == k])[0]
        ripple_angle = np.sin(smooth[..., None] * self._frequency + self._phase) - np.sin(self._phase)
        return np.asarray(smooth + ripple_angle @ self._amplitude, np.float64)

    def target_rpm(self, t_us: int) -> float:
        """Return the commanded speed [turns/min], see :class:`Rotor`."""
        last = self._segments[-1]
        return last.target / RPM

    def set_speed(self, rpm: float, ramp: float, t_us: int) -> bool:
        """Change to a speed at a constant rate from now on, see :class:`Rotor`."""
        t = t_us * 1e-6
        current = self._segments[max(bisect.bisect_right([p.start for p in self._segments], t) - 1, 0)]
        self._segments = [p for p in self._segments if p.start <= t][-MOST_SEGMENTS:]
        target = current.target + current.slope * (t - current.start)
        slope = math.copysign(ramp * RPM, rpm * RPM - target)
        angle, speed = self._state_at(current, np.asarray(t))
        ramped = _Segment(start=t, angle=float(angle), speed=float(speed), target=target, slope=slope)
        end = t + (rpm * RPM - target) / slope
        angle, speed = self._state_at(ramped, np.asarray(end))
        final = _Segment(start=end, angle=float(angle), speed=float(speed), target=rpm * RPM, slope=0.0)
        self._segments += [ramped, final]
        return True

    def _state_at(self, segment: _Segment, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return angle [rad] and speed [rad/s], both without ripple, at times of a segment [s]."""
        elapsed, lag = t - segment.start, self._inertia
        behind = segment.speed - segment.target + segment.slope * lag
        # Before the first segment nothing decays: its speed equals its target.
        decay = behind * np.exp(-np.maximum(elapsed, 0.0) / lag)
        angle = segment.angle + elapsed * (segment.target - segment.slope * lag + segment.slope * elapsed / 2.0)
        return angle + lag * (behind - decay), segment.target + segment.slope * (elapsed - lag) + decay


class Played:
    """Rotation played from a recording.

    The first sample is at ``start_us``; the prism is at rest before and after it.
    """

    def __init__(self, encoder: Encoder, start_us: int = 0) -> None:
        self._elapsed = (encoder.t - encoder.t[0]).astype(np.float64)
        self._angle, self._rpm = encoder.angle, encoder.rpm
        self.begin(start_us)

    def begin(self, start_us: int) -> None:
        """Set another start time of the recorded rotation [us]. Only valid before the rotation has begun."""
        self._t = self._elapsed + start_us

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Return the unwrapped prism angles of the recording [rad], see :class:`Rotor`."""
        return np.asarray(np.interp(np.asarray(t_us, np.float64), self._t, self._angle))

    def target_rpm(self, t_us: int) -> float:
        """Return the recording's mean speed [turns/min] while it lasts, else 0."""
        return self._rpm if self._t[0] <= t_us <= self._t[-1] else 0.0

    def set_speed(self, rpm: float, ramp: float, t_us: int) -> bool:
        """Return False: a recorded rotation takes no commands."""
        return False


LASTING_FAULTS = {
    "garbage": 0.5, "truncate": 0.5, "crc": 0.5, "drop": 0.5, "missed-index": 0.5, "stall": 2.0, "reverse": 1.0,
    "unplug": 1.0,
}  # fmt: skip
"""Faults of the emulated controller that last, with their default duration [s].

``garbage``, ``truncate``, ``crc`` and ``drop`` insert bytes, cut frames, flip a bit and remove a byte, each in half of
the frames at random. ``missed-index`` suppresses index pulses, ``stall`` freezes the count, ``reverse`` reverses the
motor and ``unplug`` pulls out the cable.
"""
INSTANT_FAULTS = ("slip", "reset", "clock-jump")
"""Faults of the emulated controller without a duration: lost counts, a reboot, and a jump of the clock."""
SLIP_TURNS, JUMP_US = 0.05, 60_000_000
"""Counts that the fault ``slip`` loses [turns], and jump of the clock by the fault ``clock-jump`` [us]."""
STEP_US = 10_000
"""Interval between checks of whether the status must be sent [us]."""
BATCH_US = 5_000
"""Longest time for which encoder samples are collected before they are sent [us]."""
MOST_RPM = 6000.0
"""Largest speed that a command may set [turns/min]; higher speeds are refused."""
LEAST_RPM = 2.0**-17
"""Smallest speed that is not taken for 0 [turns/min]: firmware counts in 1/65536 of a turn per minute."""
HOST_TIMEOUT_US = 3_000_000
"""Time without a frame from the host after which the controller reports that the host is lost [us]."""
MOST_OUT_BYTES = 1 << 20
"""Largest number of bytes that wait to be fetched. Further output is lost, as on any serial line without flow control.
"""
STOP_RAMP = 2000.0
"""Deceleration of a stop command by default, and acceleration of the fault ``reverse`` [rpm/s]."""
IDENTITY = protocol.Identity(1, 1, 0, b"emulated".ljust(protocol.BOARD_BYTES, b"\0"))
"""Firmware and board that the emulated controller says it is."""
SETTINGS = {
    "counts-per-turn": 4096, "most-rpm": int(MOST_RPM), "most-ramp": 5000, "stop-ramp": int(STOP_RAMP), "kp": 5120,
    "ki": 25_600, "friction": 600, "no-load-rpm": 4000, "rise-ms": 150, "host-timeout": 0, "undervoltage": 9000,
    "overvoltage": 15_000,
}  # fmt: skip
"""Settings at the start, by name. Those of the control loop have no effect: the emulated motor needs none."""
REST_US = 100_000
"""Time for which the prism must have been at rest before settings may change [us]."""


@dataclass(frozen=True, slots=True)
class EmulatedFault:
    """Fault of the emulated controller (a name in :data:`LASTING_FAULTS` or :data:`INSTANT_FAULTS`) at a given time."""

    name: str
    """Name of the fault, from :data:`LASTING_FAULTS` or :data:`INSTANT_FAULTS`."""
    start_s: float
    """Emulation time at which it begins [s]."""
    duration_s: float = 0.0
    """Duration of the fault [s]; 0 for instant faults."""

    @classmethod
    def parse(cls, text: str) -> EmulatedFault:
        """Parse a fault given as ``NAME@SECONDS`` or ``NAME@SECONDS+DURATION``.

        Raises :class:`AmiwarpError` for any other text.
        """
        match = re.fullmatch(r"([a-z-]+)@(\d+(?:\.\d*)?)(?:\+(\d+(?:\.\d*)?))?", text)
        if match is None or match[1] not in (*LASTING_FAULTS, *INSTANT_FAULTS):
            names = ", ".join((*LASTING_FAULTS, *INSTANT_FAULTS))
            raise AmiwarpError(f"fault {text!r}: give NAME@SECONDS or NAME@SECONDS+DURATION, NAME one of {names}")
        if match[1] in INSTANT_FAULTS and match[3]:
            raise AmiwarpError(f"fault {text!r}: {match[1]} happens at once and has no duration; omit it")
        return cls(match[1], float(match[2]), float(match[3] or LASTING_FAULTS.get(match[1], 0.0)))


class Controller:
    """Emulates a controller's firmware, see ``docs/reference/link-protocol.md``. The caller supplies the time [us].

    ``drift_ppm``: rate error of the controller's clock. ``clock_start``: clock reading at power-on, at the emulation
    time ``start_us``. ``supply_mv``: voltage of the motor's supply [mV]; None: not sensed.
    Raises :class:`AmiwarpError` for the fault ``reverse`` with a recorded rotation.
    """

    def __init__(
        self,
        rotor: Rotor,
        *,
        counts_per_turn: int = 4096,
        sample_hz: float = 1000.0,
        drift_ppm: float = 0.0,
        clock_start: int = 0,
        sync_hz: float | None = None,
        start_us: int = 0,
        faults: Iterable[EmulatedFault] = (),
        supply_mv: int | None = None,
        seed: int = 0,
    ) -> None:
        faults = tuple(faults)
        if isinstance(rotor, Played) and any(fault.name == "reverse" for fault in faults):
            raise AmiwarpError("fault reverse: a recorded rotation cannot be reversed; remove this fault")
        self.rotor = rotor
        self.supply_mv = supply_mv
        """Voltage of the motor's supply [mV]; None: not sensed. Its limits do not stop the emulated motor."""
        self._built = SETTINGS | {"counts-per-turn": counts_per_turn}
        self._saved: dict[str, int] | None = None
        self.plugged = True
        """Whether the cable is plugged in. The controller keeps running while it is unplugged."""
        self.pulses: deque[tuple[int, int]] = deque(maxlen=1000)
        """Latest sync pulses, each with its number and emulation time [us]."""
        self._rate = 1.0 + drift_ppm * 1e-6
        self._sample_us, self._sync_hz = 1e6 / sample_hz, sync_hz
        self._batch_size = min(max(int(BATCH_US / self._sample_us), 1), protocol.MOST_SAMPLES)
        self._rng = random.Random(seed)
        self._pulse_rng = random.Random(seed)
        due = [(edge, fault, on) for fault in faults for edge, on in _edges_of(fault, start_us)]
        self._fault_edges = sorted(due, key=itemgetter(0))
        self._active_faults: list[str] = []
        self._decoder = protocol.FrameDecoder(lines=False)
        self._heard_us = self._now = start_us
        self._out = bytearray()
        self._boot(clock_start)
        self._apply_faults()

    def advance(self, now_us: int) -> bytes:
        """Run the controller until an emulation time [us] and return the bytes that it sends; none while unplugged."""
        self._advance_to(now_us)
        out = bytes(self._out)
        self._out.clear()
        return out

    def feed(self, data: bytes, now_us: int) -> None:
        """Give received bytes to the controller at an emulation time [us].

        The next :meth:`advance` returns the answers.
        """
        self._advance_to(now_us)
        for sequence, message in self._decoder.units(data) if self.plugged else ():
            if sequence is not None:
                self._heard_us = self._now
                self._execute(sequence, message)

    @property
    def counts_per_turn(self) -> int:
        """Encoder counts per turn of the prism."""
        return self.settings["counts-per-turn"]

    def clock(self, now_us: float) -> int:
        """Return the reading of the controller's clock at an emulation time, without wrap [us]."""
        return self._clock_start + math.floor((now_us - self._boot_us) * self._rate)

    def time_at(self, clock_us: ArrayLike) -> NDArray[np.float64]:
        """Return the emulation times [us] of readings of the controller's clock (without wrap) [us], same shape."""
        return self._boot_us + (np.asarray(clock_us) - self._clock_start) / self._rate

    def _boot(self, clock_start: int) -> None:
        self._boot_us, self._clock_start, self._sequence = self._now, clock_start, 0
        self.settings = dict(self._saved or self._built)
        self._batch: list[tuple[int, int]] = []
        self._before = self._now, float(self.rotor.angle(self._now))
        self._count_offset = math.floor(self._position())  # the reported count is the position minus this offset
        self._frozen_count: int | None = None
        self._sent_status: tuple[int, int, float, int] | None = None
        self._checked_us = self._turned_us = self._now
        self._host_stops, self._stopped_for_host = 0, False
        self._pulse_number, self._next_pulse_us = 0, self._pulse_interval_us()

    def _pulse_interval_us(self) -> float:
        """Return the time until the next sync pulse: irregular as that of a controller, or by ``sync_hz`` [us]."""
        if self._sync_hz is not None:
            return 1e6 / self._sync_hz
        return 1000.0 * self._pulse_rng.randint(*protocol.PULSE_INTERVAL_MS)

    def _position(self) -> float:
        """Return the encoder's position in counts since the index pulse of turn 0."""
        return float(self.rotor.angle(self._now)) * self.counts_per_turn / math.tau

    def _count(self, whole: int) -> int:
        return self._frozen_count if self._frozen_count is not None else whole - self._count_offset

    def _advance_to(self, now_us: int) -> None:
        while self._now < now_us:
            until = min(now_us, self._now + STEP_US, *(edge for edge, *_ in self._fault_edges[:1]))
            self._emit(until)
            self._now = until
            self._apply_faults()
            if self._now - self._checked_us >= STEP_US or self._sent_status is None:
                self._send_status()

    def _emit(self, until: int) -> None:
        """Send the samples, pulses and status that are due between now and ``until``, in order of time."""
        first, last = ((t - self._boot_us) * self._rate for t in (self._now, until))
        sampled = np.arange(math.floor(first / self._sample_us) + 1, math.floor(last / self._sample_us) + 1)
        elapsed = sampled * self._sample_us
        time_us = self._boot_us + elapsed / self._rate
        angle = self.rotor.angle(time_us)
        whole = np.floor(angle * (self.counts_per_turn / math.tau)).astype(np.int64)
        due: list[tuple[float, protocol.Message | int]] = list(zip(elapsed.tolist(), whole.tolist(), strict=True))
        due += self._index_pulses(np.append(self._before[0], time_us), np.append(self._before[1], angle))
        if len(time_us):
            self._before = time_us[-1], angle[-1]
        while self._next_pulse_us <= last:
            at = self._next_pulse_us
            self.pulses.append((self._pulse_number, round(self._boot_us + at / self._rate)))
            due.append((at, protocol.Sync(self._t(at), self._pulse_number % WRAP)))
            self._pulse_number += 1
            self._next_pulse_us += self._pulse_interval_us()
        for at, what in sorted(due, key=itemgetter(0)):
            if isinstance(what, int):
                self._batch.append((self._t(at), _int32(self._count(what))))
                if len(self._batch) >= self._batch_size:
                    self._flush()
            else:
                self._send(what)
        if math.floor(last / 1e6) > math.floor(first / 1e6):
            self._sent_status = None  # send the status again, once per second

    def _index_pulses(
        self, time_us: NDArray[np.float64], angle: NDArray[np.float64]
    ) -> list[tuple[float, protocol.Message | int]]:
        """Return the index pulses between samples, each with its clock reading."""
        turns = np.floor(angle / math.tau).astype(np.int64)
        found: list[tuple[float, protocol.Message | int]] = []
        for k in np.flatnonzero(np.diff(turns)) if "missed-index" not in self._active_faults else ():
            turn = int(max(turns[k : k + 2]))
            share = (turn * math.tau - angle[k]) / (angle[k + 1] - angle[k])
            at = (time_us[k] + share * (time_us[k + 1] - time_us[k]) - self._boot_us) * self._rate
            found.append((at, protocol.Index(self._t(at), _int32(self._count(turn * self.counts_per_turn)))))
        return found

    def _t(self, elapsed: float) -> int:
        return (self._clock_start + math.floor(elapsed)) % WRAP

    def _apply_faults(self) -> None:
        """Begin and end the faults whose times have come."""
        while self._fault_edges and self._fault_edges[0][0] <= self._now:
            _, fault, on = self._fault_edges.pop(0)
            if fault.name in LASTING_FAULTS:
                (self._active_faults.append if on else self._active_faults.remove)(fault.name)
            if fault.name == "slip":
                self._count_offset += round(SLIP_TURNS * self.counts_per_turn)
            elif fault.name == "reset":
                self._boot(0)
            elif fault.name == "clock-jump":
                self._flush()
                self._clock_start += JUMP_US
            elif fault.name == "stall":
                whole = math.floor(self._position())
                if on:
                    self._frozen_count = whole - self._count_offset
                elif self._frozen_count is not None:
                    self._count_offset, self._frozen_count = whole - self._frozen_count, None
            elif fault.name == "reverse":
                self.rotor.set_speed(-self.rotor.target_rpm(self._now), STOP_RAMP, self._now)
        self.plugged = "unplug" not in self._active_faults

    def _state(self) -> tuple[int, float, float]:
        """Return the state, the speed of the last 20 ms and the commanded speed [turns/min]."""
        early = max(self._now - 20_000, self._boot_us)
        turned = float(self.rotor.angle(self._now)) - float(self.rotor.angle(early))
        rpm = turned / math.tau * 60e6 / max(self._now - early, 1)
        target = self.rotor.target_rpm(self._now)
        return (
            0 if target == 0 and abs(rpm) < 1 else 1 if abs(rpm - target) <= 0.03 * abs(target) + 1 else 2,
            rpm,
            target,
        )

    def _watch_host(self) -> None:
        """Stop the motor if the host has been silent for too long, and the settings say so."""
        timeout_us = 1_000_000 * self.settings["host-timeout"]
        silent = timeout_us and self._now - self._heard_us >= timeout_us
        if silent and self.rotor.target_rpm(self._now) and self._brake():
            self._stopped_for_host = True
            self._host_stops = min(self._host_stops + 1, 0xFFFF)

    def _brake(self) -> bool:
        return self.rotor.set_speed(0.0, float(self.settings["stop-ramp"]), self._now)

    def _send_status(self) -> None:
        """Send the status if it has changed."""
        self._checked_us = self._now
        self._watch_host()
        state, rpm, target = self._state()
        if state != 0:
            self._turned_us = self._now
        faults = {
            "host lost": self._now - self._heard_us > HOST_TIMEOUT_US,
            "stopped for lost host": self._stopped_for_host,
        }
        fault_bits = sum(1 << protocol.FAULTS.index(name) for name, on in faults.items() if on)
        sent = state, fault_bits, target, self.counts_per_turn
        if sent != self._sent_status:
            self._sent_status = sent
            t = self.clock(self._now) % WRAP
            self._send(protocol.ControllerStatus(t, state, fault_bits, rpm, target, self.counts_per_turn))

    def _execute(self, sequence: int, message: protocol.Message | None) -> None:
        refused = 0
        if isinstance(message, protocol.Ping):
            self._send_status()
            self._send(protocol.Pong(message.number, self.clock(self._now) % WRAP))
            return
        if isinstance(message, protocol.SetSpeed):
            fits = abs(message.rpm) <= self.settings["most-rpm"] and 0 < message.ramp < math.inf
            rpm = message.rpm if abs(message.rpm) >= LEAST_RPM else 0.0
            refused = 2 if not fits else 0 if self.rotor.set_speed(rpm, message.ramp, self._now) else 3
            self._stopped_for_host &= refused != 0
        elif isinstance(message, protocol.Stop):
            refused = 0 if self._brake() else 3
            self._stopped_for_host &= refused != 0
        elif isinstance(message, protocol.SetCounts):
            refused = self._set_counts(message.per_turn)
        elif isinstance(message, protocol.Ask):
            refused = self._tell(message)
        elif isinstance(message, protocol.SetSetting):
            refused = self._set_setting(message)
        elif isinstance(message, protocol.SaveSettings | protocol.RestoreSettings):
            refused = self._keep_settings(save=isinstance(message, protocol.SaveSettings))
        else:
            refused = 1
        self._send(protocol.Answer(sequence, refused))
        self._send_status()

    def _set_counts(self, per_turn: int) -> int:
        """Change the counts per turn, unless the prism turns; return the reason for a refusal."""
        if per_turn == self.counts_per_turn:
            return 0
        if not 0 < per_turn < 1 << 24:
            return 2
        if self._state()[0] != 0:
            return 3
        self._change({"counts-per-turn": per_turn})
        return 0

    def _change(self, settings: dict[str, int]) -> None:
        """Use other settings, while the prism rests."""
        self._flush()
        count = self._count(math.floor(self._position()))
        self.settings |= settings
        self._count_offset = math.floor(self._position()) - count  # the count goes on

    def _rests(self) -> bool:
        return self._state()[0] == 0 and self._now - self._turned_us >= REST_US

    def _tell(self, asked: protocol.Ask) -> int:
        """Send the message that is asked for; return the reason for a refusal."""
        if asked.kind == protocol.Identity.KIND:
            self._send(IDENTITY)
        elif asked.kind == protocol.Condition.KIND:
            supply = protocol.UNKNOWN_MV if self.supply_mv is None else self.supply_mv
            timeout, stored = self.settings["host-timeout"], int(self._saved is not None)
            t = self.clock(self._now) % WRAP
            self._send(protocol.Condition(t, supply, timeout, self._host_stops, stored))
        elif asked.kind == protocol.Setting.KIND and asked.key < len(protocol.SETTINGS):
            self._send(protocol.Setting(asked.key, self.settings[protocol.SETTINGS[asked.key].name]))
        else:
            return 2
        return 0

    def _set_setting(self, wanted: protocol.SetSetting) -> int:
        """Change a setting, unless the prism turns; return the reason for a refusal."""
        found = protocol.SETTINGS[wanted.key] if wanted.key < len(protocol.SETTINGS) else None
        if found is None or not found.contains(wanted.value):
            return 2
        if self.settings[found.name] == wanted.value:
            return 0
        if not self._rests():
            return 3
        self._change({found.name: wanted.value})
        return 0

    def _keep_settings(self, *, save: bool) -> int:
        """Save the settings, or restore those of the start, unless the prism turns; return the reason for a refusal."""
        if not self._rests():
            return 3
        if save:
            self._saved = dict(self.settings)
        else:
            self._change(self._built)
        return 0

    def _flush(self) -> None:
        batch, self._batch = self._batch, []
        if batch:
            self._send(protocol.Samples(tuple(t for t, _ in batch), tuple(count for _, count in batch)))

    def _send(self, message: protocol.Message) -> None:
        if not isinstance(message, protocol.Samples):
            self._flush()
        frame = protocol.encode(message, self._sequence)
        self._sequence = (self._sequence + 1) % (1 << 16)
        if self.plugged and len(self._out) < MOST_OUT_BYTES:
            self._out += self._corrupt(bytearray(frame))

    def _corrupt(self, frame: bytearray) -> bytearray:
        """Damage a frame as the active transmission faults demand."""
        for name in self._active_faults:
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


def _edges_of(fault: EmulatedFault, start_us: int) -> list[tuple[int, bool]]:
    """Return the times [us] at which a fault begins (True) and, if it lasts, ends (False)."""
    first = start_us + round(fault.start_s * 1e6)
    ends = [(first + round(fault.duration_s * 1e6), False)] if fault.name in LASTING_FAULTS else []
    return [(first, True), *ends]


def _int32(count: int) -> int:
    return (count + (1 << 31)) % WRAP - (1 << 31)


# Pseudo-terminal that offers an emulated controller as a serial port.

STEP_S = 1e-3
"""Interval between updates of the emulated controller [s]."""
RETRY_S = 0.2
"""Interval between attempts to open a pseudo-terminal after a failure [s]."""


class PseudoTerminal(BackgroundLoop):
    """Pseudo-terminal that runs an emulated controller in real time, in a background thread, until closed.

    ``path``: symbolic link to the port. It exists while the emulated cable is plugged in, and points to the new port
    after a reconnection, so that programs find it under the same name. ``now_us``: emulation time [us]; default: time
    since the creation of this object. Raises :class:`AmiwarpError` if ``path`` exists or its folder does not,
    or if the system has no pseudo-terminals.
    """

    def __init__(
        self, controller: Controller, path: str | os.PathLike[str] | None = None,
        *, now_us: Callable[[], int] | None = None,
    ) -> None:  # fmt: skip
        if not hasattr(os, "openpty"):
            raise AmiwarpError("this system has no pseudo-terminals; the emulator needs Linux or macOS")
        self._path = None if path is None else Path(path)
        # A dangling link is the remnant of a killed process and may be replaced.
        if self._path is not None and self._path.exists():
            raise AmiwarpError(
                f"{path}: this file already exists; give another path for the link to the port, or remove the file"
            )
        if self._path is not None and not self._path.parent.is_dir():
            raise AmiwarpError(
                f"{path}: there is no folder {self._path.parent}; make it, or give another path for the port's link"
            )
        origin = monotonic_us()
        self._now_us = now_us or (lambda: monotonic_us() - origin)
        self._controller = controller
        self._master: int | None = None
        self._open()
        self._start_thread("amiwarp-emulator")

    @property
    def name(self) -> str:
        """Name under which programs open the port: the symbolic link if there is one, else the pseudo-terminal."""
        return self._port if self._path is None else str(self._path)

    def close(self) -> None:
        """Stop the background thread, and remove the port and the symbolic link."""
        try:
            super().close()
        finally:
            self._close()

    def _run(self) -> None:
        while not self._ended.is_set():
            data = self._read(self._master)
            now = self._now_us()
            self._controller.feed(data, now)
            out = self._controller.advance(now)
            if self._controller.plugged and self._master is None:
                try:
                    self._open()
                except OSError:  # no free file descriptor: try again later
                    self._ended.wait(RETRY_S)
            elif not self._controller.plugged and self._master is not None:
                self._close()
            # Without a reader, or with a slow one, bytes are lost, as on any serial line without flow control.
            if out and self._master is not None and not self._without_peer(self._master):
                with contextlib.suppress(OSError):
                    os.write(self._master, out)

    def _read(self, master: int | None) -> bytes:
        """Return the bytes that the program at the other end sent, after waiting for at most :data:`STEP_S`."""
        if master is None or self._without_peer(master):
            self._ended.wait(STEP_S)
            return b""
        poll = select.poll()
        poll.register(master, select.POLLIN)
        if not poll.poll(round(1e3 * STEP_S)):
            return b""
        with contextlib.suppress(OSError):
            return os.read(master, 4096)
        return b""

    def _without_peer(self, master: int) -> bool:
        poll = select.poll()
        poll.register(master, 0)
        return any(event & select.POLLHUP for _, event in poll.poll(0))

    def _open(self) -> None:
        import tty

        master, port = os.openpty()
        try:
            self._port = os.ttyname(port)
            tty.setraw(port)
            os.set_blocking(master, False)
        except BaseException:
            os.close(master)
            raise
        finally:
            os.close(port)
        self._master = master
        if self._path is not None:
            self._remove_link()
            self._path.symlink_to(self._port)

    def _remove_link(self) -> None:
        if self._path is not None and self._path.is_symlink():  # leave a file that replaced the link
            self._path.unlink()

    def _close(self) -> None:
        self._remove_link()
        if self._master is not None:
            os.close(self._master)
            self._master = None
