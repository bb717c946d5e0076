"""What turns behind an emulated controller: a motor, or a rotation that was recorded."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from amiwarp.events.encoder import Encoder

MOST_PIECES = 1024
"""Of a motor's past that are kept: speeds it was set to. What came before them is taken for even."""
RPM = math.tau / 60.0
"""A turn a minute [rad/s]."""


class Rotor(Protocol):
    """Turns; the index is at whole turns. All times are the world's [us]."""

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Unwrapped angle [rad], any shape; of the future as if no command came."""

    def target_rpm(self, t_us: int) -> float:
        """The speed it is to have."""

    def set_speed(self, rpm: float, ramp: float, t_us: int) -> bool:
        """From now on to a speed, by ``ramp`` [rpm/s]; whether it can."""


@dataclass(frozen=True, slots=True)
class _Piece:
    """From a time on: the wanted speed is a line, the motor follows it with a lag. Seconds, rad, rad/s."""

    start: float
    angle: float
    speed: float
    wanted: float
    slope: float


class Motor:
    """A motor whose speed follows the ramped target with the lag ``inertia_s``; angle 0 at t = 0.

    ``ripple``: share of the speed by which it changes within each turn (once and six times: poles); ``noise``: share,
    rms, by which friction changes it at random, seeded. Both depend on the angle: a motor at rest stays at rest. The
    angle is a formula, not integrated: any time can be asked for in any order.
    """

    def __init__(
        self, rpm: float = 0.0, *, inertia_s: float = 0.15, ripple: float = 0.01, noise: float = 0.003, seed: int = 0
    ) -> None:
        rng = np.random.default_rng(seed)
        self._inertia = inertia_s
        self._often = np.concatenate([[1.0, 6.0], np.exp(rng.uniform(math.log(0.05), math.log(3.0), 8))])
        share = np.concatenate([np.full(2, ripple / 2.0), np.full(8, noise * 0.5)])
        self._swing, self._phase = share / self._often, rng.uniform(0.0, math.tau, 10)
        self._pieces = [_Piece(0.0, 0.0, rpm * RPM, rpm * RPM, 0.0)]

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """See :class:`Rotor`; constant speed before t = 0."""
        t = np.asarray(t_us, np.float64) * 1e-6
        even = np.empty(t.shape)
        at = np.maximum(np.searchsorted([p.start for p in self._pieces], t, side="right") - 1, 0)
        for k in np.unique(at):
            even[at == k] = self._moved(self._pieces[k], t[at == k])[0]
        swing = np.sin(even[..., None] * self._often + self._phase) - np.sin(self._phase)
        return np.asarray(even + swing @ self._swing, np.float64)

    def target_rpm(self, t_us: int) -> float:
        """See :class:`Rotor`."""
        last = self._pieces[-1]
        return last.wanted / RPM

    def set_speed(self, rpm: float, ramp: float, t_us: int) -> bool:
        """See :class:`Rotor`."""
        t = t_us * 1e-6
        before = self._pieces[max(bisect.bisect_right([p.start for p in self._pieces], t) - 1, 0)]
        self._pieces = [p for p in self._pieces if p.start <= t][-MOST_PIECES:]
        wanted = before.wanted + before.slope * (t - before.start)
        slope = math.copysign(ramp * RPM, rpm * RPM - wanted)
        angle, speed = self._moved(before, np.asarray(t))
        ramped = _Piece(t, float(angle), float(speed), wanted, slope)
        end = t + (rpm * RPM - wanted) / slope
        angle, speed = self._moved(ramped, np.asarray(end))
        self._pieces += [ramped, _Piece(end, float(angle), float(speed), rpm * RPM, 0.0)]
        return True

    def _moved(self, piece: _Piece, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Angle and speed without ripple at times of a piece [s]."""
        elapsed, lag = t - piece.start, self._inertia
        behind = piece.speed - piece.wanted + piece.slope * lag
        # before the first piece nothing decays: its speed is the wanted one
        decay = behind * np.exp(-np.maximum(elapsed, 0.0) / lag)
        angle = piece.angle + elapsed * (piece.wanted - piece.slope * lag + piece.slope * elapsed / 2.0)
        return angle + lag * (behind - decay), piece.wanted + piece.slope * (elapsed - lag) + decay


class Played:
    """A recorded rotation, its first sample at the world's time ``start_us``; at rest before and after it."""

    def __init__(self, encoder: Encoder, start_us: int = 0) -> None:
        self._elapsed = (encoder.t - encoder.t[0]).astype(np.float64)
        self._angle, self._rpm = encoder.angle, encoder.rpm
        self.begin(start_us)

    def begin(self, start_us: int) -> None:
        """Begins at another time: of one that has not begun."""
        self._t = self._elapsed + start_us

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """See :class:`Rotor`."""
        return np.asarray(np.interp(np.asarray(t_us, np.float64), self._t, self._angle))

    def target_rpm(self, t_us: int) -> float:
        """Its mean speed while it lasts."""
        return self._rpm if self._t[0] <= t_us <= self._t[-1] else 0.0

    def set_speed(self, rpm: float, ramp: float, t_us: int) -> bool:
        """It cannot."""
        return False
