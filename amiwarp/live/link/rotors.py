"""Rotation of the emulated prism: by a simulated motor, or as in a recording."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.events.encoder import Encoder

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
        self,
        rpm: float = 0.0,
        *,
        inertia_s: float = 0.15,
        ripple: float = 0.01,
        noise: float = 0.003,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        self._inertia = inertia_s
        self._frequency = np.concatenate(
            [[1.0, 6.0], np.exp(rng.uniform(math.log(0.05), math.log(3.0), 8))]
        )
        amplitude = np.concatenate([np.full(2, ripple / 2.0), np.full(8, noise * 0.5)])
        self._amplitude = amplitude / self._frequency
        self._phase = rng.uniform(0.0, math.tau, 10)
        self._segments = [
            _Segment(start=0.0, angle=0.0, speed=rpm * RPM, target=rpm * RPM, slope=0.0)
        ]

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Return the unwrapped prism angles [rad], see :class:`Rotor`. The speed is constant before time 0."""
        t = np.asarray(t_us, np.float64) * 1e-6
        smooth = np.empty(t.shape)
        starts = [segment.start for segment in self._segments]
        index = np.maximum(np.searchsorted(starts, t, side="right") - 1, 0)
        for k in np.unique(index):
            within = index == k
            smooth[within], _ = self._state_at(self._segments[k], t[within])
        # The ripple is 0 at the angle 0.
        phases = smooth[..., None] * self._frequency + self._phase
        ripple = np.sin(phases) - np.sin(self._phase)
        return np.asarray(smooth + ripple @ self._amplitude, np.float64)

    def target_rpm(self, t_us: int) -> float:
        """Return the commanded speed [turns/min], see :class:`Rotor`."""
        last = self._segments[-1]
        return last.target / RPM

    def set_speed(self, rpm: float, ramp: float, t_us: int) -> bool:
        """Change to a speed at a constant rate from now on, see :class:`Rotor`."""
        t = t_us * 1e-6
        starts = [segment.start for segment in self._segments]
        current = self._segments[max(bisect.bisect_right(starts, t) - 1, 0)]
        # The command replaces what was planned for later times.
        begun = [segment for segment in self._segments if segment.start <= t]
        self._segments = begun[-MOST_SEGMENTS:]

        target = current.target + current.slope * (t - current.start)
        slope = math.copysign(ramp * RPM, rpm * RPM - target)
        ramped = self._follow(current, t, target, slope)
        end = t + (rpm * RPM - target) / slope
        final = self._follow(ramped, end, rpm * RPM, 0.0)
        self._segments += [ramped, final]
        return True

    def _follow(self, before: _Segment, start: float, target: float, slope: float) -> _Segment:
        """Return a segment that continues angle and speed of the segment before at a time [s]."""
        angle, speed = self._state_at(before, np.asarray(start))
        return _Segment(
            start=start, angle=float(angle), speed=float(speed), target=target, slope=slope
        )

    def _state_at(
        self, segment: _Segment, t: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return angle [rad] and speed [rad/s], both without ripple, at times of a segment [s]."""
        elapsed = t - segment.start
        lag = self._inertia
        behind = segment.speed - segment.target + segment.slope * lag
        # Before the first segment nothing decays: its speed equals its target.
        decay = behind * np.exp(-np.maximum(elapsed, 0.0) / lag)
        mean_speed = segment.target - segment.slope * lag + segment.slope * elapsed / 2.0
        angle = segment.angle + elapsed * mean_speed
        speed = segment.target + segment.slope * (elapsed - lag)
        return angle + lag * (behind - decay), speed + decay


class Played:
    """Rotation played from a recording.

    The first sample is at ``start_us``; the prism is at rest before and after it.
    """

    def __init__(self, encoder: Encoder, start_us: int = 0) -> None:
        self._elapsed = (encoder.t - encoder.t[0]).astype(np.float64)
        self._angle = encoder.angle
        self._rpm = encoder.rpm
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
