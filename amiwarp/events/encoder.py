"""The prism's encoder: samples of the prism angle over time, which give every event its angle.

Angles are in radians and unwrapped, so they grow past 2 pi. Their positive direction is that of the optics. The
encoder may have its own clock: event time ``t`` corresponds to encoder time ``t + clock_offset_us``.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import TIME_LIMIT, as_times
from amiwarp.events.unwrapping import unwrap_angles, unwrap_counts
from amiwarp.validation import array, guarded, instance, real, whole

TWO_PI = 2.0 * math.pi
"""One turn [rad]."""
MOST_SAMPLES = 1 << 28
"""Largest number of samples that :meth:`Encoder.constant_speed` makes: three days at one sample per millisecond."""
LARGEST_ANGLE = 1e10
"""Largest accepted magnitude of a prism angle [rad]: 1.6e9 turns. Up to this angle float64 resolves 2e-6 rad."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Encoder:
    """Samples of the prism angle over time.

    Raises
    ------
    AmiwarpError
        If there are fewer than two samples, they are unsorted or not finite, or an index pulse lies outside them.

    Examples
    --------
    >>> encoder = amiwarp.Encoder.from_counts([0, 1000, 2000], [0, 25, 50], counts_per_turn=100)
    >>> encoder.angle_at([0, 500]).round(3)
    array([0.   , 0.785])
    >>> round(encoder.rpm)
    15000
    """

    t: NDArray[np.int64]
    """Sample times on the encoder's clock [us], strictly increasing, shape ``(m,)``."""
    angle: NDArray[np.float64]
    """Unwrapped prism angle theta [rad], shape ``(m,)``."""
    clock_offset_us: float = 0.0
    """Encoder time minus event time [us]."""
    index_t: NDArray[np.int64] | None = None
    """Times of the index pulses on the encoder's clock [us], shape ``(k,)``; None if the encoder has none."""

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.t.shape != self.angle.shape or self.t.size < 2:
            shapes = f"t {self.t.shape}, angle {self.angle.shape}"
            raise AmiwarpError(f"encoder samples have shapes {shapes}; expected two equal lengths of at least 2")
        if self.t.dtype != np.int64 or self.angle.dtype != np.float64:
            raise AmiwarpError(f"encoder t is {self.t.dtype}, angle is {self.angle.dtype}; expected int64 and float64")
        late = self.t[1:] <= self.t[:-1]
        if late.any():
            at = int(np.argmax(late)) + 1
            raise AmiwarpError(f"encoder sample {at} ({self.t[at]} us) is not later than the one before; sort by time")
        if not (self.t[0] > -TIME_LIMIT and self.t[-1] < TIME_LIMIT):
            span = f"{self.t[0]} .. {self.t[-1]} us"
            raise AmiwarpError(f"encoder samples span {span}, beyond {TIME_LIMIT} us from 0; times are damaged")
        good = np.abs(self.angle) <= LARGEST_ANGLE  # NaN fails
        if not good.all():
            at = int(np.argmin(good))
            given = f"encoder sample {at} has angle {self.angle[at]}"
            raise AmiwarpError(f"{given}; expected a finite number within {LARGEST_ANGLE:g} rad of 0")
        offset = real(self.clock_offset_us, "encoder clock_offset_us", -TIME_LIMIT / 2, TIME_LIMIT / 2, " us")
        object.__setattr__(self, "clock_offset_us", offset)
        if self.index_t is not None:
            self._check_index(self.index_t)

    def _check_index(self, index_t: NDArray[np.int64]) -> None:
        if instance(index_t, np.ndarray, "encoder index_t").ndim != 1 or index_t.dtype != np.int64:
            raise AmiwarpError(f"encoder index_t is {index_t.dtype} of shape {index_t.shape}; expected int64 (k,)")
        inside = (index_t >= self.t[0]) & (index_t <= self.t[-1])
        if not inside.all():
            bad = index_t[int(np.argmin(inside))]
            raise AmiwarpError(f"index pulse at {bad} us lies outside the encoder's {self.t[0]} .. {self.t[-1]} us")

    @classmethod
    def from_angles(cls, t_us: ArrayLike, angle: ArrayLike, *, clock_offset_us: float = 0.0) -> Encoder:
        """Create an encoder from samples of the prism angle.

        Parameters
        ----------
        t_us : array_like
            Sample times on the encoder's clock [us], shape (m,), strictly increasing.
        angle : array_like
            Prism angle [rad], shape (m,): unwrapped, or wrapped to one turn or to a whole number of turns.
        clock_offset_us : float, default 0.0
            Encoder time minus event time [us].

        Returns
        -------
        Encoder
            The encoder with unwrapped angles.

        Raises
        ------
        AmiwarpError
            If the samples are unusable, or do not determine how the angle wraps.
        """
        t = as_times(t_us)
        return cls(t, unwrap_angles(t, array(angle, "encoder angle").astype(np.float64)), clock_offset_us)

    @classmethod
    def from_counts(
        cls,
        t_us: ArrayLike,
        count: ArrayLike,
        *,
        counts_per_turn: int,
        counter_bits: int | None = None,
        direction: int = 1,
        index_t_us: ArrayLike | None = None,
        clock_offset_us: float = 0.0,
    ) -> Encoder:
        """Create an encoder from encoder counts.

        The counter may keep counting, restart each turn, or wrap at its width.

        Parameters
        ----------
        t_us : array_like
            Sample times on the encoder's clock [us], shape (m,), strictly increasing.
        count : array_like
            Encoder counts, shape (m,).
        counts_per_turn : int
            Counts in one turn, at least 1.
        counter_bits : int, optional
            Width of the counter [bits]; 0 for a counter that restarts each turn. By default it is found from the
            counts.
        direction : int, default 1
            Use -1 for a counter that counts backwards.
        index_t_us : array_like, optional
            Times of the index pulses on the encoder's clock [us], shape (k,). They make the angle absolute: it is a
            multiple of 2 pi at the median pulse.
        clock_offset_us : float, default 0.0
            Encoder time minus event time [us].

        Returns
        -------
        Encoder
            The encoder with unwrapped angles.

        Raises
        ------
        AmiwarpError
            If an argument is unusable, or the counts do not determine the rotation.
        """
        whole(counts_per_turn, "counts_per_turn", 1, 1 << 40)
        if direction not in (1, -1):
            raise AmiwarpError(f"direction = {direction}; expected 1 or -1")
        t = as_times(t_us)
        counts = unwrap_counts(t, array(count, "encoder count").astype(np.float64), counts_per_turn, counter_bits)
        encoder = cls(t, counts * (direction * TWO_PI / counts_per_turn), clock_offset_us)
        return encoder if index_t_us is None else encoder.with_index(index_t_us)

    @classmethod
    def constant_speed(
        cls, rpm: float, t_first: int, t_last: int, *, direction: int = 1, interval_us: int = 1000
    ) -> Encoder:
        """Create the encoder of a prism that turns at constant speed.

        Parameters
        ----------
        rpm : float
            Speed [turns/min].
        t_first, t_last : int
            Time span [us]. The angle is 0 at ``t_first``; the last sample is at or after ``t_last``.
        direction : int, default 1
            Use -1 for falling angles.
        interval_us : int, default 1000
            Time between samples [us].

        Returns
        -------
        Encoder
            The encoder.

        Raises
        ------
        AmiwarpError
            If a value is unusable, or the span needs more than 2**28 samples.

        Examples
        --------
        >>> amiwarp.Encoder.constant_speed(600.0, 0, 100_000).angle_at([50_000]).round(4)
        array([3.1416])
        """
        rpm = real(rpm, "constant speed", -1e9, 1e9, " turns/min")
        for t, what in ((t_first, "t_first"), (t_last, "t_last")):
            whole(t, f"constant speed: {what}", -TIME_LIMIT + 1, TIME_LIMIT - 1, " us")
        whole(interval_us, "constant speed: interval_us", 1, TIME_LIMIT, " us")
        if not 0 <= (t_last - t_first) // interval_us < MOST_SAMPLES:
            given = f"from {t_first} to {t_last} us every {interval_us} us"
            raise AmiwarpError(f"constant speed {given}; expected t_last >= t_first and up to {MOST_SAMPLES} samples")
        elapsed = np.arange(0, t_last - t_first + 2 * interval_us, interval_us, dtype=np.int64)
        return cls(elapsed + t_first, elapsed.astype(np.float64) * (direction * rpm * TWO_PI / 60e6))

    def with_clock_offset(self, clock_offset_us: float) -> Encoder:
        """Return an encoder with the same samples and another clock offset.

        Parameters
        ----------
        clock_offset_us : float
            Encoder time minus event time [us].

        Returns
        -------
        Encoder
            The encoder.
        """
        return dataclasses.replace(self, clock_offset_us=clock_offset_us)

    def with_index(self, index_t_us: ArrayLike) -> Encoder:
        """Return an encoder with the same samples whose angle is zero at the index pulses.

        Parameters
        ----------
        index_t_us : array_like
            Times of the index pulses on the encoder's clock [us], shape (k,).

        Returns
        -------
        Encoder
            The encoder. Its angle is a multiple of 2 pi at the median pulse.

        Raises
        ------
        AmiwarpError
            If no pulse is given, or one lies outside the samples.
        """
        index_t = np.atleast_1d(as_times(index_t_us))
        if not index_t.size:
            raise AmiwarpError("index_t_us contains no pulse; leave index_t_us out if the encoder has no index pulse")
        self._check_index(index_t)
        at_pulse = np.interp(index_t - self.t[0], self.t - self.t[0], self.angle)
        # The circular mean chooses where to cut the circle. The median around it is robust to spurious pulses.
        mean = float(np.angle(np.exp(1j * at_pulse).mean()))
        zero = mean + float(np.median(_wrap(at_pulse - mean)))
        return dataclasses.replace(self, angle=self.angle - zero, index_t=index_t)

    def slip(self) -> NDArray[np.float64]:
        """Return the angle error at each index pulse: the distance of the angle from a multiple of 2 pi.

        Returns
        -------
        numpy.ndarray
            Angles [rad] in -pi .. pi, shape (k,). All are 0 if no count was lost.
        """
        return _wrap(self.pulse_angles())

    def pulse_angles(self) -> NDArray[np.float64]:
        """Return the unwrapped angle at each index pulse.

        Returns
        -------
        numpy.ndarray
            Angles [rad], shape (k,); empty without pulses.
        """
        if self.index_t is None:
            return np.zeros(0)
        return np.asarray(np.interp(self.index_t - self.t[0], self.t - self.t[0], self.angle))

    def angle_at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the prism angle at event times, interpolated linearly.

        Parameters
        ----------
        t : array_like
            Event times [us], any shape.

        Returns
        -------
        numpy.ndarray
            Unwrapped angle theta [rad], shape of ``t``.

        Raises
        ------
        AmiwarpError
            If a time is outside :attr:`coverage`, or not a whole number.
        """
        elapsed, sampled, angle = self._near(t)
        result = np.interp(elapsed, sampled, angle)
        for end, outside in ((0, elapsed < 0), (-2, elapsed > sampled[-1])):
            if outside.any():
                slope = (angle[end + 1] - angle[end]) / (sampled[end + 1] - sampled[end])
                result = np.where(outside, angle[end] + slope * (elapsed - sampled[end]), result)
        return np.asarray(result, np.float64)

    def speed_at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the prism's speed at event times: the slope of the interpolation of :meth:`angle_at`.

        Parameters
        ----------
        t : array_like
            Event times [us], any shape.

        Returns
        -------
        numpy.ndarray
            Angular speed [rad/s], shape of ``t``.

        Raises
        ------
        AmiwarpError
            If a time is outside :attr:`coverage`, or not a whole number.
        """
        elapsed, sampled, angle = self._near(t)
        piece = np.clip(np.searchsorted(sampled, elapsed, side="right") - 1, 0, sampled.size - 2)
        slope = 1e6 * np.diff(angle) / np.diff(sampled)
        return np.asarray(slope[piece], np.float64)

    def covers(self, t_start: int, t_end: int) -> bool:
        """Return whether all event times of a span have an angle.

        Parameters
        ----------
        t_start, t_end : int
            First and last event time [us].

        Returns
        -------
        bool
            Whether both lie within :attr:`coverage`.
        """
        first, last = self.coverage
        return first <= t_start and t_end <= last

    @property
    def coverage(self) -> tuple[int, int]:
        """First and last event time with an angle [us]: the samples, and one sample interval before and after."""
        # If the first or last interval is a gap, extrapolate by the mean interval only.
        before = min(float(self.t[1] - self.t[0]), self.interval_us)
        after = min(float(self.t[-1] - self.t[-2]), self.interval_us)
        first, last = int(self.t[0]), int(self.t[-1])
        return math.ceil(first - before - self.clock_offset_us), math.floor(last + after - self.clock_offset_us)

    @property
    def interval_us(self) -> float:
        """Mean time between samples [us]."""
        return float(self.t[-1] - self.t[0]) / (self.t.size - 1)

    def gaps(self, max_interval_us: float) -> list[tuple[int, int]]:
        """Return the gaps: intervals between samples that are too long.

        Parameters
        ----------
        max_interval_us : float
            Longest interval that is not a gap [us].

        Returns
        -------
        list of tuple of int
            Sample times before and after each gap, on the encoder's clock [us].
        """
        before = np.flatnonzero(np.diff(self.t) > max_interval_us)
        return [(int(self.t[i]), int(self.t[i + 1])) for i in before]

    @property
    def rpm(self) -> float:
        """Mean speed over all samples [turns/min], negative if the angle decreases."""
        return float((self.angle[-1] - self.angle[0]) / TWO_PI * 60e6 / float(self.t[-1] - self.t[0]))

    def _near(self, t: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the encoder times for event times ``t``, and the times and angles of the samples around them.

        All times are relative to the first of these samples. Only samples near ``t`` are used, so the cost does not
        depend on the recording's length.
        """
        times = t if isinstance(t, np.ndarray) and t.dtype == np.int64 else as_times(t)
        low, high = (int(times.min()), int(times.max())) if times.size else self.coverage
        if not self.covers(low, high):
            first, last = self.coverage
            raise AmiwarpError(
                f"events at {low} .. {high} us lie outside the encoder's {first} .. {last} us; drop these events"
            )
        start = int(np.searchsorted(self.t, math.floor(low + self.clock_offset_us))) - 1
        start = min(max(start, 0), self.t.size - 2)
        stop = max(int(np.searchsorted(self.t, math.ceil(high + self.clock_offset_us))) + 1, start + 2)
        # Subtract as integers: float64 cannot represent fractions of microseconds in times since 1970.
        elapsed = np.subtract(times, self.t[start], out=np.empty(times.shape), dtype=np.int64)
        elapsed += self.clock_offset_us
        sampled = (self.t[start:stop] - self.t[start]).astype(np.float64)
        return elapsed, sampled, self.angle[start:stop]


def _wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Wrap angles [rad] to -pi .. pi."""
    return np.asarray(angle - TWO_PI * np.round(angle / TWO_PI))
