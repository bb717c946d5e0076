"""Motion in a simulation: of the prism, of the camera, and the encoder that measures the prism."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TWO_PI, Encoder
from amiwarp.optics.prism import check_angles, check_phase
from amiwarp.validation import INT64, array, guarded, real, whole

ROTATION_INTERVAL = 1e-3
"""Interval of the steps in which a changing angular velocity is integrated [s]."""
LARGEST_SPEED = 1e9
"""Largest accepted speed of a prism [turns/min] and of a camera's rotation [rad/s]; higher values are mistakes."""
LONGEST_S = 86400.0
"""Longest duration of a simulation [s]."""
LARGEST_OFFSET_US = 1e7
"""Largest clock offset of a simulated encoder [us]. The encoder is sampled for this much longer before and after the
events."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class PrismMotion:
    """Motion of the prism: its tilt azimuth is ``phase + angle(t)``, with ``angle(0) = 0``.

    Examples
    --------
    >>> motion = amiwarp.PrismMotion(600.0)
    >>> motion.angle([0.0, 50_000.0]).round(4)
    array([0.    , 3.1416])
    """

    rpm: float | ArrayLike = 720.0
    """Speed of the prism [turns/min], negative for backward rotation.

    Or a table of rows (time [s], speed), interpolated linearly and constant outside, shape (n, 2).
    """
    phase: float = 0.0
    """Azimuth of the prism's tilt at encoder angle 0, θ_b [rad]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Tilt of the axis of rotation about the camera's x and y axes [rad], as in :class:`amiwarp.ExactModel`."""
    cylinder: tuple[float, float] = (0.0, 0.0)
    """Cylinder power of the tilted face, which turns with the prism [rad], as in :class:`amiwarp.ExactModel`."""
    wobble: tuple[float, float] = (0.0, 0.0)
    """Wobble of the prism about the axis of rotation [rad], as in :class:`amiwarp.ExactModel`."""

    def __post_init__(self) -> None:
        _check_table("prism speed", self._table())
        object.__setattr__(self, "phase", check_phase(self.phase, "prism phase"))
        for name in ("tilt", "cylinder", "wobble"):
            object.__setattr__(self, name, check_angles(getattr(self, name), name))

    @classmethod
    def from_function(
        cls,
        rpm: Callable[[NDArray[np.float64]], ArrayLike],
        duration_s: float,
        *,
        phase: float = 0.0,
        tilt: tuple[float, float] = (0.0, 0.0),
    ) -> PrismMotion:
        """Create a motion by sampling a function of time that gives the speed.

        Parameters
        ----------
        rpm : callable
            Function of times [s], shape ``(n,)``, that returns speeds [turns/min].
        duration_s : float
            Duration [s]; samples extend from 0 to just past it, one per millisecond.
        phase : float, optional
            Azimuth at angle 0 [rad].
        tilt : tuple of float, optional
            Tilt of the axis of rotation about the camera's x and y axes [rad].

        Returns
        -------
        PrismMotion
            Motion with a table of speeds.

        Raises
        ------
        AmiwarpError
            If the function returns another shape.
        """
        duration_s = real(duration_s, "duration_s", 0.0, LONGEST_S, " s")
        t = np.arange(math.ceil(duration_s * 1e3) + 2, dtype=np.float64) * 1e-3
        speed = array(rpm(t), "prism speed")
        if speed.shape not in ((), t.shape):
            raise AmiwarpError(f"prism speed has shape {speed.shape}; return one number, or one per time, {t.shape}")
        return cls(np.column_stack([t, np.broadcast_to(speed, t.shape)]), phase, tilt)

    def _table(self) -> NDArray[np.float64]:
        """Return the speed as a table of rows (time [s], speed [rad/s])."""
        rpm = array(self.rpm, "prism speed").astype(np.float64)
        table = np.array([[0.0, rpm], [1.0, rpm]]) if rpm.ndim == 0 else rpm
        return table * np.array([1.0, TWO_PI / 60.0]) if table.ndim == 2 and table.shape[1] == 2 else table

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Return the unwrapped angle, the exact integral of the speed.

        Parameters
        ----------
        t_us : array_like
            Times [us], shape ``(n,)``.

        Returns
        -------
        ndarray
            Angles [rad], shape ``(n,)``.
        """
        t_us = array(t_us, "t_us")
        at, speed = self._table().T
        before = np.concatenate([[0.0], np.cumsum(np.diff(at) * (speed[1:] + speed[:-1]) / 2.0)])

        def integral(t: NDArray[np.float64]) -> NDArray[np.float64]:
            inside = np.clip(t, at[0], at[-1])
            i = np.clip(np.searchsorted(at, inside, side="right") - 1, 0, len(at) - 2)
            mean = (speed[i] + np.interp(inside, at, speed)) / 2.0
            return before[i] + mean * (inside - at[i]) + np.interp(t, at, speed) * (t - inside)

        return np.asarray(integral(np.asarray(t_us, np.float64) * 1e-6) - integral(np.zeros(1)))

    @property
    def largest_speed(self) -> float:
        """Largest magnitude of the prism's speed [rad/s]."""
        return float(np.abs(self._table()[:, 1]).max())


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """Rotation of the camera about its own axes. At t = 0 it faces the picture.

    Examples
    --------
    >>> amiwarp.CameraMotion((0.0, 0.5, 0.0)).constant
    True
    """

    rates: ArrayLike = (0.0, 0.0, 0.0)
    """Angular velocity of the camera in its own frame [rad/s], shape (3,).

    Or a table of rows (time [s], ωx, ωy, ωz), interpolated linearly and constant outside, shape (n, 4).
    """

    def __post_init__(self) -> None:
        _check_table("camera rotation", self._table(), columns=4)

    def _table(self) -> NDArray[np.float64]:
        rates = array(self.rates, "camera rotation").astype(np.float64)
        return np.array([[0.0, *rates], [1.0, *rates]]) if rates.shape == (3,) else rates

    @property
    def largest_rates(self) -> NDArray[np.float64]:
        """Largest magnitude of each component [rad/s], shape (3,)."""
        return np.asarray(np.abs(self._table()[:, 1:]).max(axis=0))

    @property
    def constant(self) -> bool:
        """Whether the angular velocity never changes."""
        return bool((self._table()[:, 1:] == self._table()[0, 1:]).all())

    def orientation(self, duration_s: float) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """Return the orientation as a function of time.

        Parameters
        ----------
        duration_s : float
            Duration [s].

        Returns
        -------
        callable
            Function of times [s], 0 to ``duration_s``, shape ``(n,)``. It returns rotation matrices from the camera's
            frame to the picture's, shape ``(n, 3, 3)``.
        """
        from scipy.spatial.transform import Rotation

        table = self._table()
        if self.constant:
            return lambda t: np.asarray(Rotation.from_rotvec(np.outer(t, table[0, 1:])).as_matrix())
        step = ROTATION_INTERVAL
        grid = np.arange(math.ceil(duration_s / step) + 2) * step
        rates = np.stack([np.interp(grid + step / 2.0, table[:, 0], column) for column in table[:, 1:].T], axis=1)
        nodes = [np.eye(3)]
        for matrix in Rotation.from_rotvec(rates * step).as_matrix()[:-1]:
            nodes.append(nodes[-1] @ matrix)
        corners = np.stack(nodes)

        def at(t: NDArray[np.float64]) -> NDArray[np.float64]:
            i = np.clip((t / step).astype(np.int64), 0, len(grid) - 1)
            rest = Rotation.from_rotvec(rates[i] * (t - grid[i])[:, None]).as_matrix()
            return np.asarray(corners[i] @ rest)

        return at


def _check_table(what: str, table: NDArray[np.float64], columns: int = 2) -> None:
    """Raise :class:`AmiwarpError` for a table of wrong shape, with values out of range or unsorted times."""
    if table.ndim != 2 or table.shape[1] != columns or len(table) < 2:
        raise AmiwarpError(f"{what} has shape {table.shape}; give one value, or at least 2 rows of {columns} numbers")
    if not (np.abs(table) <= LARGEST_SPEED).all():  # NaN fails
        worst = table[~(np.abs(table) <= LARGEST_SPEED)][0]
        raise AmiwarpError(f"{what} contains {worst:g}; expected numbers in {-LARGEST_SPEED:g} .. {LARGEST_SPEED:g}")
    if not (np.diff(table[:, 0]) > 0).all():
        raise AmiwarpError(f"{what}: the times of its rows do not increase; sort the rows by time")


@guarded
@dataclass(frozen=True, slots=True)
class EncoderModel:
    """Errors that a simulated encoder makes.

    Raises :class:`AmiwarpError` for values out of range.

    Examples
    --------
    >>> encoder = amiwarp.EncoderModel.ideal().sample(amiwarp.PrismMotion(600.0), duration_us=1000, seed=0)
    >>> encoder.angle_at([500]).round(6)
    array([0.031416])
    """

    counts_per_turn: int | None = 8192
    """Resolution of the encoder [counts/turn]: the angle is rounded to the nearest count; None disables rounding."""
    rate_hz: float = 1000.0
    """Rate of the encoder samples [Hz]."""
    jitter_us: float = 1.0
    """Standard deviation of the time stamp of an encoder sample [us]."""
    clock_offset_us: float = 0.0
    """Offset of the encoder's clock: encoder time minus event time [us]."""
    dropouts_hz: float = 0.0
    """Mean number of drop-outs per second [Hz]."""
    dropout_us: float = 5000.0
    """Duration of a drop-out, in which all encoder samples are lost [us]."""

    def __post_init__(self) -> None:
        if self.counts_per_turn is not None:
            counts = whole(self.counts_per_turn, "encoder counts_per_turn", 1, 2**31, ", or None")
            object.__setattr__(self, "counts_per_turn", counts)
        limits = {"rate_hz": (0.1, 1e6), "jitter_us": (0.0, 1e6), "dropouts_hz": (0.0, 1e5), "dropout_us": (0.0, 1e9),
                  "clock_offset_us": (-LARGEST_OFFSET_US, LARGEST_OFFSET_US)}  # fmt: skip
        for name, (low, high) in limits.items():
            object.__setattr__(self, name, real(getattr(self, name), f"encoder {name}", low, high))

    @classmethod
    def ideal(cls) -> EncoderModel:
        """Return an encoder without rounding and jitter.

        Returns
        -------
        EncoderModel
            The encoder.
        """
        return cls(counts_per_turn=None, jitter_us=0.0)

    def sample(self, motion: PrismMotion, duration_us: int, seed: int) -> Encoder:
        """Sample the encoder from 0 to ``duration_us`` on the camera's clock, with a margin at both ends.

        Parameters
        ----------
        motion : PrismMotion
            Motion of the prism.
        duration_us : int
            Duration [us].
        seed : int
            Seed of the random errors.

        Returns
        -------
        Encoder
            Samples with times on the encoder's clock. Its clock offset is 0: calibration has to find it.
        """
        duration_us = whole(duration_us, "duration_us", 0, round(1e6 * LONGEST_S), " us")
        seed = whole(seed, "seed", 0, INT64[1])
        rng = np.random.default_rng([seed, 0xE2C])  # independent of the pixels' random numbers
        interval = 1e6 / self.rate_hz
        spare = math.ceil((abs(self.clock_offset_us) + 8.0 * self.jitter_us) / interval) + 2
        true_t = np.rint(np.arange(-spare, math.ceil(duration_us / interval) + spare + 1) * interval).astype(np.int64)
        angle = motion.angle(true_t - self.clock_offset_us)
        if self.counts_per_turn is not None:
            angle = np.rint(angle * (self.counts_per_turn / TWO_PI)) * (TWO_PI / self.counts_per_turn)
        stamp = true_t + np.rint(rng.normal(0.0, self.jitter_us, len(true_t))).astype(np.int64)
        kept = np.ones(len(stamp), np.bool_)
        for start in rng.uniform(0.0, duration_us, rng.poisson(self.dropouts_hz * duration_us * 1e-6)):
            kept &= (true_t < start) | (true_t >= start + self.dropout_us)
        kept[[0, -1]] = True
        stamp, angle = stamp[kept], angle[kept]
        rising = np.concatenate([[True], stamp[1:] > np.maximum.accumulate(stamp)[:-1]])
        return Encoder(stamp[rising], angle[rising])
