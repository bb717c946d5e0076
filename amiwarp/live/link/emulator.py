"""Emulated controller: clock, encoder, index pulse, commands and injected faults, without a port or a thread."""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Iterable
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.live.link import protocol
from amiwarp.live.link.clocks import WRAP
from amiwarp.live.link.emulated_faults import LASTING_FAULTS, EmulatedFault, fault_edges
from amiwarp.live.link.rotors import Played, Rotor

SLIP_TURNS = 0.05
JUMP_US = 60_000_000
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
    "counts-per-turn": 4096,
    "most-rpm": int(MOST_RPM),
    "most-ramp": 5000,
    "stop-ramp": int(STOP_RAMP),
    "kp": 5120,
    "ki": 25_600,
    "friction": 600,
    "no-load-rpm": 4000,
    "rise-ms": 150,
    "host-timeout": 0,
    "undervoltage": 9000,
    "overvoltage": 15_000,
}
"""Settings at the start, by name. Settings of the control loop have no effect: the emulated motor needs none."""
REST_US = 100_000
"""Time for which the prism must have been at rest before settings may change [us]."""


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
            raise AmiwarpError(
                "fault reverse: a recorded rotation cannot be reversed; remove this fault"
            )
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
        self._sample_us = 1e6 / sample_hz
        self._sync_hz = sync_hz
        self._batch_size = min(max(int(BATCH_US / self._sample_us), 1), protocol.MOST_SAMPLES)
        self._rng = random.Random(seed)
        self._pulse_rng = random.Random(seed)
        edges = [
            (edge_us, fault, on) for fault in faults for edge_us, on in fault_edges(fault, start_us)
        ]
        self._fault_edges = sorted(edges, key=itemgetter(0))
        self._active_faults: list[str] = []
        self._decoder = protocol.FrameDecoder(lines=False)
        self._heard_us = start_us
        self._now = start_us
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
        if not self.plugged:
            return
        for sequence, message in self._decoder.units(data):
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
        self._boot_us = self._now
        self._clock_start = clock_start
        self._sequence = 0
        self.settings = dict(self._saved or self._built)
        self._batch: list[tuple[int, int]] = []
        self._before = self._now, float(self.rotor.angle(self._now))
        # The reported count is the position minus this offset
        self._count_offset = math.floor(self._position())
        self._frozen_count: int | None = None
        self._sent_status: tuple[int, int, float, int] | None = None
        self._checked_us = self._now
        self._turned_us = self._now
        self._host_stops = 0
        self._stopped_for_host = False
        self._pulse_number = 0
        self._next_pulse_us = self._pulse_interval_us()

    def _pulse_interval_us(self) -> float:
        """Return the time until the next sync pulse: irregular as a controller's, or by ``sync_hz`` [us]."""
        if self._sync_hz is not None:
            return 1e6 / self._sync_hz
        return 1000.0 * self._pulse_rng.randint(*protocol.PULSE_INTERVAL_MS)

    def _position(self) -> float:
        """Return the encoder's position in counts since the index pulse of turn 0."""
        return float(self.rotor.angle(self._now)) * self.counts_per_turn / math.tau

    def _count(self, whole: int) -> int:
        """Return the reported count at a position [whole counts]."""
        if self._frozen_count is not None:
            return self._frozen_count
        return whole - self._count_offset

    def _advance_to(self, now_us: int) -> None:
        while self._now < now_us:
            until = min(now_us, self._now + STEP_US)
            if self._fault_edges:
                next_edge_us, *_ = self._fault_edges[0]
                until = min(until, next_edge_us)
            self._emit(until)
            self._now = until
            self._apply_faults()
            if self._now - self._checked_us >= STEP_US or self._sent_status is None:
                self._send_status()

    def _emit(self, until: int) -> None:
        """Send the samples, pulses and status that are due between now and ``until``, in order of time."""
        # Elapsed times are on the controller's clock, since it was booted.
        first = (self._now - self._boot_us) * self._rate
        last = (until - self._boot_us) * self._rate
        first_sample = math.floor(first / self._sample_us) + 1
        last_sample = math.floor(last / self._sample_us)
        elapsed = np.arange(first_sample, last_sample + 1) * self._sample_us
        time_us = self._boot_us + elapsed / self._rate
        angle = self.rotor.angle(time_us)
        whole = np.floor(angle * (self.counts_per_turn / math.tau)).astype(np.int64)
        due: list[tuple[float, protocol.Message | int]] = list(
            zip(elapsed.tolist(), whole.tolist(), strict=True)
        )
        last_time_us, last_angle = self._before
        due += self._index_pulses(np.append(last_time_us, time_us), np.append(last_angle, angle))
        if len(time_us):
            self._before = time_us[-1], angle[-1]
        while self._next_pulse_us <= last:
            pulse_us = self._next_pulse_us
            self.pulses.append((self._pulse_number, round(self._boot_us + pulse_us / self._rate)))
            due.append((pulse_us, protocol.Sync(self._t(pulse_us), self._pulse_number % WRAP)))
            self._pulse_number += 1
            self._next_pulse_us += self._pulse_interval_us()
        for pulse_us, what in sorted(due, key=itemgetter(0)):
            if isinstance(what, int):
                self._batch.append((self._t(pulse_us), _int32(self._count(what))))
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
        if "missed-index" in self._active_faults:
            return []
        turns = np.floor(angle / math.tau).astype(np.int64)
        found: list[tuple[float, protocol.Message | int]] = []
        for k in np.flatnonzero(np.diff(turns)):
            turn = int(max(turns[k : k + 2]))
            share = (turn * math.tau - angle[k]) / (angle[k + 1] - angle[k])
            pulse_us = time_us[k] + share * (time_us[k + 1] - time_us[k])
            at = (pulse_us - self._boot_us) * self._rate
            count = _int32(self._count(turn * self.counts_per_turn))
            found.append((at, protocol.Index(self._t(at), count)))
        return found

    def _t(self, elapsed: float) -> int:
        """Return what the controller's clock shows at a time since it was booted [us]."""
        return (self._clock_start + math.floor(elapsed)) % WRAP

    def _apply_faults(self) -> None:
        """Begin and end the faults whose times have come."""
        while self._fault_edges and self._fault_edges[0][0] <= self._now:
            _, fault, on = self._fault_edges.pop(0)
            if fault.name in LASTING_FAULTS:
                if on:
                    self._active_faults.append(fault.name)
                else:
                    self._active_faults.remove(fault.name)
            if fault.name == "slip":
                _, rpm, _ = self._state()
                lost = round(SLIP_TURNS * self.counts_per_turn)
                self._count_offset += -lost if rpm < 0 else lost
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
                    self._count_offset = whole - self._frozen_count
                    self._frozen_count = None
            elif fault.name == "reverse":
                self.rotor.set_speed(-self.rotor.target_rpm(self._now), STOP_RAMP, self._now)
        self.plugged = "unplug" not in self._active_faults

    def _state(self) -> tuple[int, float, float]:
        """Return the state, the speed of the last 20 ms and the commanded speed [turns/min]."""
        early = max(self._now - 20_000, self._boot_us)
        turned = float(self.rotor.angle(self._now)) - float(self.rotor.angle(early))
        rpm = turned / math.tau * 60e6 / max(self._now - early, 1)
        target = self.rotor.target_rpm(self._now)
        if target == 0 and abs(rpm) < 1:
            state = 0  # at rest
        elif abs(rpm - target) <= 0.03 * abs(target) + 1:
            state = 1  # at the commanded speed
        else:
            state = 2  # on the way to it
        return state, rpm, target

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
        if sent == self._sent_status:
            return
        self._sent_status = sent
        t = self.clock(self._now) % WRAP
        self._send(
            protocol.ControllerStatus(t, state, fault_bits, rpm, target, self.counts_per_turn)
        )

    def _execute(self, sequence: int, message: protocol.Message | None) -> None:
        refused = 0
        if isinstance(message, protocol.Ping):
            self._send_status()
            self._send(protocol.Pong(message.number, self.clock(self._now) % WRAP))
            return
        if isinstance(message, protocol.SetSpeed):
            refused = self._set_speed(message)
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

    def _set_speed(self, wanted: protocol.SetSpeed) -> int:
        """Change the motor's speed; return the reason for a refusal."""
        fits = abs(wanted.rpm) <= self.settings["most-rpm"] and 0 < wanted.ramp < math.inf
        if not fits:
            return 2
        rpm = wanted.rpm if abs(wanted.rpm) >= LEAST_RPM else 0.0
        return 0 if self.rotor.set_speed(rpm, wanted.ramp, self._now) else 3

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
            timeout = self.settings["host-timeout"]
            stored = int(self._saved is not None)
            t = self.clock(self._now) % WRAP
            self._send(protocol.Condition(t, supply, timeout, self._host_stops, stored))
        elif asked.kind == protocol.Setting.KIND and asked.key < len(protocol.SETTINGS):
            name = protocol.SETTINGS[asked.key].name
            self._send(protocol.Setting(asked.key, self.settings[name]))
        else:
            return 2
        return 0

    def _set_setting(self, wanted: protocol.SetSetting) -> int:
        """Change a setting, unless the prism turns; return the reason for a refusal."""
        if wanted.key >= len(protocol.SETTINGS):
            return 2
        found = protocol.SETTINGS[wanted.key]
        if not found.contains(wanted.value):
            return 2
        if self.settings[found.name] == wanted.value:
            return 0
        if not self._rests():
            return 3
        self._change({found.name: wanted.value})
        return 0

    def _keep_settings(self, *, save: bool) -> int:
        """Save the settings, or restore the first ones, unless the prism turns; return the reason for a refusal."""
        if not self._rests():
            return 3
        if save:
            self._saved = dict(self.settings)
        else:
            self._change(self._built)
        return 0

    def _flush(self) -> None:
        """Send the samples of the batch."""
        batch = self._batch
        self._batch = []
        if batch:
            times, counts = zip(*batch, strict=True)
            self._send(protocol.Samples(times, counts))

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
            if name not in ("garbage", "truncate", "crc", "drop") or self._rng.random() >= 0.5:
                continue
            byte = self._rng.randrange(1, len(frame))
            if name == "garbage":
                length = self._rng.randrange(1, 40)
                frame = bytearray(self._rng.randbytes(length)) + frame
            elif name == "truncate":
                del frame[byte:]
            elif name == "crc":
                frame[byte] ^= 1 << self._rng.randrange(8)
            else:
                del frame[byte]
        return frame


def _int32(count: int) -> int:
    return (count + (1 << 31)) % WRAP - (1 << 31)
