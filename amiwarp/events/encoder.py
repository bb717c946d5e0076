"""The prism's encoder: samples of the prism angle over time, which give every event its angle.

Angles are in radians and unwrapped, so they grow past 2 pi. They grow in the positive direction of the
optics. The encoder may have its own clock: event time ``t`` corresponds to encoder time ``t + clock_offset_us``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.command_signal import CommandAngles, command_samples
from amiwarp.events.unwrapping import (
    EXACT_BITS,
    WIDEST,
    check_direction,
    unwrap_angles,
    unwrap_counts,
)
from amiwarp.schema.calls import guarded
from amiwarp.validation import (
    TIME_LIMIT,
    array,
    as_times,
    check_ascending,
    instance,
    real,
    shown,
    vector,
    whole,
)

MOST_SAMPLES = 1 << 28
"""Largest number of samples that :meth:`Encoder.constant_speed` makes: three days at one sample per millisecond."""
Integers = NDArray[np.int64]
Vector = NDArray[np.float64]

GAP_INTERVALS = 5
"""Number of median sample intervals above which the time between two samples is reported as a gap."""
LONGEST_BENT_STEP = math.tau / 64.0
"""Longest step between samples of an encoder whose error within a turn is corrected [rad]."""
LARGEST_ANGLE = 1e10
"""Largest accepted magnitude of a prism angle [rad]: 1.6e9 turns. Up to this angle float64 resolves 2e-6 rad."""


FACTORS = (4, 6, 8)
"""Numbers of factors of an angle's error: a cosine and a sine for each of two, three or four harmonics."""


def periodic(angle: Vector, factors: Sequence[float]) -> Vector:
    """Return the sum of cos e, sin e, cos 2e, sin 2e, and so on, of the angles e [rad], each with its factor."""
    waves: list[Vector] = []
    for harmonic in range(1, len(factors) // 2 + 1):
        multiple = harmonic * angle
        waves += [np.cos(multiple), np.sin(multiple)]
    return np.asarray(np.array(factors) @ np.stack(waves))


def factors_by_angle(harmonics: ArrayLike, angles: int) -> list[tuple[float, ...]]:
    """Return the factors of an error that repeats every turn, of each angle that has one.

    For two angles, four factors belong to the first one. Raises :class:`AmiwarpError` for another number of factors.
    """
    count = 0
    if isinstance(harmonics, np.ndarray):
        count = harmonics.size
    elif isinstance(harmonics, list | tuple):
        count = len(harmonics)
    sharing = angles if count > FACTORS[0] else 1
    counts = {FACTORS[0], *(angles * each for each in FACTORS)}
    if count not in counts:
        *others, last = sorted(counts)
        raise AmiwarpError(
            f"harmonics is {shown(harmonics)}; expected {', '.join(map(str, others))} or {last} numbers"
        )
    factors = vector(harmonics, count, "harmonics", real)
    of_angle = count // sharing
    return [factors[first : first + of_angle] for first in range(0, count, of_angle)]


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
    second: Encoder | None = None
    """Encoder of the second prism of a pair, on the same clock; None for one prism."""

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.t.shape != self.angle.shape or self.t.size < 2:
            shapes = f"t {self.t.shape}, angle {self.angle.shape}"
            raise AmiwarpError(
                f"encoder samples have shapes {shapes}; expected two equal lengths of at least 2"
            )
        if self.t.dtype != np.int64 or self.angle.dtype != np.float64:
            raise AmiwarpError(
                f"encoder t is {self.t.dtype}, angle is {self.angle.dtype}; expected int64 and float64"
            )
        check_ascending(self.t, "encoder sample")
        if not (self.t[0] > -TIME_LIMIT and self.t[-1] < TIME_LIMIT):
            span = f"{self.t[0]} .. {self.t[-1]} us"
            raise AmiwarpError(
                f"encoder samples span {span}, beyond {TIME_LIMIT} us from 0; times are damaged"
            )
        good = np.abs(self.angle) <= LARGEST_ANGLE  # NaN fails
        if not good.all():
            first_bad = int(np.argmin(good))
            given = f"encoder sample {first_bad} has angle {self.angle[first_bad]}"
            raise AmiwarpError(
                f"{given}; expected a finite number within {LARGEST_ANGLE:g} rad of 0"
            )
        limit = TIME_LIMIT / 2
        offset = real(self.clock_offset_us, "encoder clock_offset_us", -limit, limit, " us")
        object.__setattr__(self, "clock_offset_us", offset)
        if self.index_t is not None:
            self._check_index(self.index_t)
        if self.second is None:
            return
        second = instance(self.second, Encoder, "encoder second")
        if second.second is not None:
            raise AmiwarpError("the second encoder has a second one itself; a pair has two prisms")
        if second.clock_offset_us != offset:
            object.__setattr__(self, "second", second.with_clock_offset(offset))

    def _check_index(self, index_t: Integers) -> None:
        """Raise :class:`AmiwarpError` for index pulses of another form, or outside the samples."""
        index_t = instance(index_t, np.ndarray, "encoder index_t")
        if index_t.ndim != 1 or index_t.dtype != np.int64:
            raise AmiwarpError(
                f"encoder index_t is {index_t.dtype} of shape {index_t.shape}; expected int64 (k,)"
            )
        first = self.t[0]
        last = self.t[-1]
        inside = (index_t >= first) & (index_t <= last)
        if not inside.all():
            bad = index_t[int(np.argmin(inside))]
            raise AmiwarpError(
                f"index pulse at {bad} us lies outside the encoder's {first} .. {last} us"
            )

    @classmethod
    def from_angles(
        cls, t_us: ArrayLike, angle: ArrayLike, *, clock_offset_us: float = 0.0
    ) -> Encoder:
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
        angles = array(angle, "encoder angle").astype(np.float64)
        return cls(t, unwrap_angles(t, angles), clock_offset_us)

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
        check_direction(direction)
        t = as_times(t_us)
        counts = array(count, "encoder count")
        if counts.dtype.kind in ("i", "u"):
            counts = _exact_in_float64(counts, counter_bits or WIDEST)
        counts = unwrap_counts(t, counts.astype(np.float64), counts_per_turn, counter_bits)
        encoder = cls(t, counts * (direction * math.tau / counts_per_turn), clock_offset_us)
        if index_t_us is None:
            return encoder
        return encoder.with_index(index_t_us)

    @classmethod
    def from_command(
        cls,
        t_us: ArrayLike,
        command: ArrayLike,
        *,
        largest: float | None = None,
        clock_offset_us: float = 0.0,
    ) -> Encoder:
        """Create an encoder from a command signal that swings to and fro, such as one of a mirror.

        The command is described as the cosine of an angle, times its largest magnitude. The angle grows by half a turn
        at each swing; where a swing does not reach the largest magnitude, it jumps within a microsecond.

        Parameters
        ----------
        t_us : array_like
            Sample times on the encoder's clock [us], shape (m,), strictly increasing. Twenty samples in each swing or
            more describe it well.
        command : array_like
            Command in any unit, or a measured tilt, shape (m,): zero where the mirror is at rest.
        largest : float, optional
            Largest magnitude of the command, in its unit; by default the largest of the samples. Give the same one for
            all recordings and streams that share a calibration, because its amplitudes belong to this command.
        clock_offset_us : float, default 0.0
            Encoder time minus event time [us].

        Returns
        -------
        Encoder
            The encoder, whose angle's cosine is the command relative to its largest magnitude.

        Raises
        ------
        AmiwarpError
            If the samples are unusable, or the command never changes or exceeds ``largest``.

        Examples
        --------
        >>> import numpy as np
        >>> t = np.arange(0, 100_000, 500)
        >>> first, second = np.sin(4e-4 * t), 0.3 * np.cos(5e-4 * t)
        >>> encoder = amiwarp.Encoder.from_command(t, first).with_second(amiwarp.Encoder.from_command(t, second))
        >>> np.cos(encoder.angles_at([50_000])).round(3)  # sin(20), cos(25)
        array([[0.913, 0.991]])
        """
        t, commands = command_samples(t_us, command)
        if len(commands) < 2 or not np.ptp(commands) > 0.0:
            raise AmiwarpError("command never changes; give the samples of a signal that moves")
        check_ascending(t, "encoder sample")
        if largest is None:
            largest = float(np.abs(commands).max())
        t, angle = CommandAngles().take(t, commands, largest, end=True)
        return cls(t, angle, clock_offset_us)

    @classmethod
    def constant_speed(
        cls,
        rpm: float,
        t_first: int,
        t_last: int,
        *,
        direction: int = 1,
        interval_us: int = 1000,
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
        check_direction(direction)
        for t, what in ((t_first, "t_first"), (t_last, "t_last")):
            whole(t, f"constant speed: {what}", -TIME_LIMIT + 1, TIME_LIMIT - 1, " us")
        whole(interval_us, "constant speed: interval_us", 1, TIME_LIMIT, " us")
        if not 0 <= (t_last - t_first) // interval_us < MOST_SAMPLES:
            given = f"from {t_first} to {t_last} us every {interval_us} us"
            raise AmiwarpError(
                f"constant speed {given}; expected t_last >= t_first and up to {MOST_SAMPLES} samples"
            )
        end = t_last - t_first + 2 * interval_us
        elapsed = np.arange(0, end, interval_us, dtype=np.int64)
        rad_per_us = direction * rpm * math.tau / 60e6
        angle = elapsed.astype(np.float64) * rad_per_us
        return cls(elapsed + t_first, angle)

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

    def with_second(self, second: Encoder | float) -> Encoder:
        """Return an encoder of a pair of prisms: this one belongs to the first prism, next to the camera.

        Parameters
        ----------
        second : Encoder or float
            Encoder of the second prism, on the same clock. Or the speed of the second prism relative to the first, if
            both are geared; their angles are then 0 together.

        Returns
        -------
        Encoder
            The encoder. Its clock offset holds for both.

        Examples
        --------
        >>> encoder = amiwarp.Encoder.from_angles([0, 1000], [0.0, 1.5]).with_second(-0.5)
        >>> encoder.angles_at([1000])
        array([[ 1.5 , -0.75]])
        """
        if not isinstance(second, Encoder):
            ratio = real(second, "speed of the second prism relative to the first")
            second = Encoder(self.t, self.angle * ratio)
        return dataclasses.replace(self, second=second)

    def with_harmonics(self, harmonics: ArrayLike) -> Encoder:
        """Return an encoder whose angles are corrected by an error that repeats every turn.

        The error of an encoder disc or magnet that is off centre, or of a speed that ripples in each turn where the
        encoder has but an index pulse.

        Parameters
        ----------
        harmonics : array_like
            Factors of cos e, sin e, cos 2e, sin 2e, and so on up to 4e, in the correction of the angle e [rad], shape
            (4,), (6,) or (8,). For a pair of prisms or a mirror, as many for the second angle may follow, shape (8,),
            (12,) or (16,).

        Returns
        -------
        Encoder
            The encoder. Where its samples are further apart than 1/64 turn, samples are added between them.

        Raises
        ------
        AmiwarpError
            If there are not four, six or eight finite numbers for one or both angles.

        Examples
        --------
        >>> encoder = amiwarp.Encoder.from_angles([0, 1000], [0.0, 1.5])
        >>> encoder.with_harmonics([0.0, 0.1, 0.0, 0.0]).angle_at([1000]).round(4)
        array([1.5997])
        """
        angles = 1 if self.second is None else 2
        first, *of_second = factors_by_angle(harmonics, angles)
        t, angle = _in_short_steps(*self._extended())
        second = self.second
        if second is not None and of_second:
            second = second.with_harmonics(of_second[0])
        return dataclasses.replace(self, t=t, angle=angle + periodic(angle, first), second=second)

    def _extended(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the samples, with one more at each end whose step is to be divided.

        The samples that divide it would else shorten the interval by which the angle is extended at that end.
        """
        t = self.t
        angle = self.angle
        before, after = self._reach
        step = self.angle[0] - self.angle[1]
        if abs(step) > LONGEST_BENT_STEP:
            added = -int(before)
            speed = step / (self.t[0] - self.t[1])
            t = np.insert(t, 0, self.t[0] + added)
            angle = np.insert(angle, 0, self.angle[0] + added * speed)
        step = self.angle[-1] - self.angle[-2]
        if abs(step) > LONGEST_BENT_STEP:
            added = int(after)
            speed = step / (self.t[-1] - self.t[-2])
            t = np.append(t, self.t[-1] + added)
            angle = np.append(angle, self.angle[-1] + added * speed)
        return t, angle

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
            raise AmiwarpError(
                "index_t_us contains no pulse; leave index_t_us out if the encoder has no index pulse"
            )
        self._check_index(index_t)
        at_pulse = self._angles_at_pulses(index_t)
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
        return self._angles_at_pulses(self.index_t)

    def _angles_at_pulses(self, index_t: Integers) -> Vector:
        """Return the unwrapped angles [rad] at times of the encoder's clock within the samples [us]."""
        origin = self.t[0]
        angles = np.interp(index_t - origin, self.t - origin, self.angle)
        return np.asarray(angles)

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
        # Before the first and after the last sample, the angle goes on as between the two samples at that end.
        for first_of_two, outside in ((0, elapsed < 0), (-2, elapsed > sampled[-1])):
            if outside.any():
                t_0 = sampled[first_of_two]
                t_1 = sampled[first_of_two + 1]
                angle_0 = angle[first_of_two]
                angle_1 = angle[first_of_two + 1]
                slope = (angle_1 - angle_0) / (t_1 - t_0)
                extended = angle_0 + slope * (elapsed - t_0)
                result = np.where(outside, extended, result)
        return np.asarray(result, np.float64)

    def angles_at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the angles of all prisms at event times, as the methods of optical models take them.

        Parameters
        ----------
        t : array_like
            Event times [us], shape (n,).

        Returns
        -------
        numpy.ndarray
            Unwrapped angles [rad]: shape (n,) for one prism, (n, 2) for a pair.

        Raises
        ------
        AmiwarpError
            If a time is outside :attr:`coverage`, or not a whole number.
        """
        first = self.angle_at(t)
        if self.second is None:
            return first
        return np.stack([first, self.second.angle_at(t)], axis=-1)

    @property
    def ratio(self) -> float | None:
        """Mean speed of the second prism relative to the first; None for one prism."""
        if self.second is None:
            return None
        return self.second.rpm / (self.rpm or math.inf)

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
        before = np.searchsorted(sampled, elapsed, side="right") - 1
        piece = np.clip(before, 0, sampled.size - 2)
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
        """First and last event time with an angle [us]: the samples, and one sample interval before and after.

        For a pair of prisms, both have an angle.
        """
        before, after = self._reach
        start = math.ceil(int(self.t[0]) - before - self.clock_offset_us)
        end = math.floor(int(self.t[-1]) + after - self.clock_offset_us)
        if self.second is None:
            return start, end
        second_start, second_end = self.second.coverage
        return max(start, second_start), min(end, second_end)

    @property
    def _reach(self) -> tuple[float, float]:
        """Times by which the angle is extended before the first and after the last sample [us].

        If the first or last interval is a gap, that is the mean interval only.
        """
        mean = self.interval_us
        before = min(float(self.t[1] - self.t[0]), mean)
        after = min(float(self.t[-1] - self.t[-2]), mean)
        return before, after

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
        turns = (self.angle[-1] - self.angle[0]) / math.tau
        return float(turns * 60e6 / float(self.t[-1] - self.t[0]))

    def __repr__(self) -> str:
        facts = [
            f"{self.t.size:,} samples",
            f"t {self.t[0]} .. {self.t[-1]} us",
            f"{self.rpm:.4g} rpm",
        ]
        if self.second is not None:
            facts.append(f"second {self.second.rpm:.4g} rpm")
        if self.index_t is not None:
            facts.append(f"{len(self.index_t):,} index pulses")
        if self.clock_offset_us:
            facts.append(f"clock offset {self.clock_offset_us:.4g} us")
        return f"Encoder({', '.join(facts)})"

    def _near(self, t: ArrayLike) -> tuple[Vector, Vector, Vector]:
        """Return the encoder times for event times ``t``, and the times and angles of the samples around them.

        All times are relative to the first of these samples. Only samples near ``t`` are used, so the cost does not
        depend on the recording's length.
        """
        times = event_times(t)
        if times.size:
            low = int(times.min())
            high = int(times.max())
        else:
            low, high = self.coverage
        if not self.covers(low, high):
            first, last = self.coverage
            raise AmiwarpError(
                f"events at {low} .. {high} us lie outside the encoder's {first} .. {last} us; give samples that cover "
                "them, or a window inside"
            )
        low_of_encoder = math.floor(low + self.clock_offset_us)
        high_of_encoder = math.ceil(high + self.clock_offset_us)
        start = int(np.searchsorted(self.t, low_of_encoder)) - 1
        start = min(max(start, 0), self.t.size - 2)
        stop = int(np.searchsorted(self.t, high_of_encoder)) + 1
        stop = max(stop, start + 2)
        # Subtract as integers: float64 cannot represent fractions of microseconds in times since 1970.
        origin = self.t[start]
        elapsed = np.subtract(times, origin, out=np.empty(times.shape), dtype=np.int64)
        elapsed += self.clock_offset_us
        sampled = (self.t[start:stop] - origin).astype(np.float64)
        return elapsed, sampled, self.angle[start:stop]


def each_encoder(encoder: Encoder) -> tuple[Encoder, ...]:
    """Return an encoder for each angle of the optic, in their order: the encoder itself if there is one angle."""
    if encoder.second is None:
        return (encoder,)
    return dataclasses.replace(encoder, second=None), encoder.second


def together(encoders: Sequence[Encoder]) -> Encoder:
    """Return the encoder of an optic from the encoders of its angles. Inverse of :func:`each_encoder`."""
    first, *others = encoders
    for second in others:
        first = first.with_second(second)
    return first


class HasSecond(Protocol):
    """Encoder of a recording or of a stream, with or without the encoder of a second angle (protocol)."""

    @property
    def second(self) -> object:
        """Encoder of the second angle; None without one."""


def check_prisms(encoder: HasSecond, angles: int) -> None:
    """Raise :class:`AmiwarpError` if an encoder does not measure this number of angles of a model."""
    if angles == 1 and encoder.second is not None:
        raise AmiwarpError(
            "the encoder belongs to a pair of prisms, the model has one prism; use the model 'risley', or 'mirror'"
        )
    if angles == 2 and encoder.second is None:
        raise AmiwarpError(
            "the model has two prisms, the encoder measures one; add the other one's encoder, or its speed relative to "
            "the first (Encoder.with_second, --second-encoder or --second-ratio of 'amiwarp convert'; of a stream, "
            "EncoderStream(second=EncoderStream()) or EncoderStream(second=-0.5))"
        )


def event_times(t: ArrayLike) -> NDArray[np.int64]:
    """Return event times as int64 [us]. Times of :class:`Events` were checked before; others are checked here."""
    if type(t) is np.ndarray and t.dtype == np.int64:
        return t
    return as_times(t)


def _wrap(angle: Vector) -> Vector:
    """Wrap angles [rad] to -pi .. pi."""
    turns = np.round(angle / math.tau)
    return np.asarray(angle - math.tau * turns)


def _exact_in_float64(counts: NDArray[Any], bits: int) -> NDArray[Any]:
    """Return integer counts of a counter with this width [bits] so that float64 holds them exactly.

    Counts of wide counters are taken as signed: they are small on both sides of 0.
    """
    if not EXACT_BITS < bits <= WIDEST:
        return counts
    unused = WIDEST - bits
    shifted = counts.astype(np.uint64) << np.uint64(unused)
    return np.asarray(shifted.astype(np.int64) >> unused)


def _in_short_steps(t: Integers, angle: Vector) -> tuple[Integers, Vector]:
    """Return samples with others between them, so that no step is longer than :data:`LONGEST_BENT_STEP`.

    Times remain whole, so a step of few microseconds may be longer.
    """
    interval = np.diff(t)
    parts = np.ceil(np.abs(np.diff(angle)) / LONGEST_BENT_STEP).astype(np.int64)
    parts = np.clip(parts, 1, interval)
    step = np.repeat(np.arange(parts.size), parts)
    first_of_step = np.cumsum(parts) - parts
    within = np.arange(step.size) - np.repeat(first_of_step, parts)
    starts = t[step] + within * interval[step] // parts[step]
    dense_t = np.append(starts, t[-1])
    origin = t[0]
    return dense_t, np.interp(dense_t - origin, t - origin, angle)
