"""The prism's encoder: samples of an angle over time, from which every event gets its angle.

Angles are radians, unwrapped (they grow past 2 pi), positive in the direction of rotation the optics call positive.
The encoder may run on a clock of its own: an event at time ``t`` belongs to the encoder's time ``t + clock_offset_us``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import TIME_LIMIT, as_times
from amiwarp.events.unwrapping import unwrap_angles, unwrap_counts
from amiwarp.validation import array, instance, real, whole

TURN = 2.0 * math.pi
"""One turn [rad]."""
MOST_SAMPLES = 1 << 28
"""Of a made encoder: three days at a sample per millisecond."""
LARGEST_ANGLE = 1e10
"""Largest magnitude of an angle [rad]: 1.6e9 turns, where float64 still resolves 2e-6 rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Encoder:
    """Encoder samples. Raises :class:`AmiwarpError` for fewer than two, unsorted or non-finite samples."""

    t: NDArray[np.int64]
    """Sample times on the encoder's clock [us], strictly increasing, shape ``(m,)``."""
    angle: NDArray[np.float64]
    """Unwrapped prism angle [rad], shape ``(m,)``."""
    clock_offset_us: float = 0.0
    """Encoder's time minus event's time [us]."""
    index_t: NDArray[np.int64] | None = None
    """Times of the index pulses on the encoder's clock [us], shape ``(k,)``, where there are any."""

    def __post_init__(self) -> None:
        for name in ("t", "angle"):
            instance(getattr(self, name), np.ndarray, f"encoder {name}")
        if self.t.ndim != 1 or self.t.shape != self.angle.shape or self.t.size < 2:
            shapes = f"t {self.t.shape}, angle {self.angle.shape}"
            raise AmiwarpError(f"encoder samples have shapes {shapes}; expected two equal lengths of at least 2")
        if self.t.dtype != np.int64 or self.angle.dtype != np.float64:
            raise AmiwarpError(f"encoder t is {self.t.dtype}, angle is {self.angle.dtype}; expected int64 and float64")
        late = self.t[1:] <= self.t[:-1]
        if late.any():
            at = int(np.argmax(late)) + 1
            raise AmiwarpError(f"encoder sample {at} (t = {self.t[at]} us) is not later than the one before; sort them")
        if not (self.t[0] > -TIME_LIMIT and self.t[-1] < TIME_LIMIT):
            span = f"{self.t[0]} .. {self.t[-1]} us"
            raise AmiwarpError(f"encoder samples span {span}, beyond {TIME_LIMIT} us either way; they are damaged")
        good = np.abs(self.angle) <= LARGEST_ANGLE  # NaN fails
        if not good.all():
            at = int(np.argmin(good))
            given = f"encoder sample {at} has angle {self.angle[at]}"
            raise AmiwarpError(f"{given}; expected a finite number within {LARGEST_ANGLE:g} rad either way")
        offset = real(self.clock_offset_us, "encoder clock_offset_us", -TIME_LIMIT / 2, TIME_LIMIT / 2, " us")
        object.__setattr__(self, "clock_offset_us", offset)
        if self.index_t is not None:
            self._check_index(self.index_t)

    def _check_index(self, index_t: NDArray[np.int64]) -> None:
        if instance(index_t, np.ndarray, "encoder index_t").ndim != 1 or index_t.dtype != np.int64:
            raise AmiwarpError(f"encoder index_t is {index_t.dtype} of shape {index_t.shape}; expected int64, (k,)")
        inside = (index_t >= self.t[0]) & (index_t <= self.t[-1])
        if not inside.all():
            bad = index_t[int(np.argmin(inside))]
            raise AmiwarpError(f"index pulse at {bad} us lies outside the encoder's {self.t[0]} .. {self.t[-1]} us")

    @classmethod
    def from_angles(cls, t_us: ArrayLike, angle: ArrayLike, *, clock_offset_us: float = 0.0) -> Encoder:
        """Samples of an angle [rad], unwrapped, or wrapped to a turn or to whole turns (see :func:`unwrap_angles`)."""
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
        """Samples of a counter that runs on, starts anew each turn, or wraps at its width.

        ``counter_bits``: that width, 0 for a counter that starts anew each turn; without it, the counts tell which of
        these it is, or are refused (see :func:`unwrap_counts`). ``direction``: -1 for a counter that counts backwards.
        Index pulses make the angle absolute: it is a multiple of 2 pi at them (at their median, see :meth:`slip`).
        Raises :class:`AmiwarpError` for a ``counts_per_turn`` below 1, a ``direction`` other than 1 and -1, and counts
        from which the rotation cannot be told.
        """
        whole(counts_per_turn, "counts_per_turn", 1, 1 << 40)
        if direction not in (1, -1):
            raise AmiwarpError(f"direction = {direction}; expected 1 or -1")
        t = as_times(t_us)
        counts = unwrap_counts(t, array(count, "encoder count").astype(np.float64), counts_per_turn, counter_bits)
        encoder = cls(t, counts * (direction * TURN / counts_per_turn), clock_offset_us)
        return encoder if index_t_us is None else encoder.with_index(index_t_us)

    @classmethod
    def constant_speed(
        cls, rpm: float, t_first: int, t_last: int, *, direction: int = 1, interval_us: int = 1000
    ) -> Encoder:
        """A prism turning at ``rpm``, at angle 0 at ``t_first`` [us], sampled every ``interval_us`` past ``t_last``."""
        rpm = real(rpm, "constant speed", hint=" [turns/min]")
        for t, what in ((t_first, "t_first"), (t_last, "t_last")):
            whole(t, f"constant speed: {what}", -TIME_LIMIT + 1, TIME_LIMIT - 1, " us")
        whole(interval_us, "constant speed: interval_us", 1, TIME_LIMIT, " us")
        if not 0 <= (t_last - t_first) // interval_us < MOST_SAMPLES:
            given = f"from {t_first} to {t_last} us every {interval_us} us"
            raise AmiwarpError(f"no constant speed {given}; expected a span of time of up to {MOST_SAMPLES} samples")
        elapsed = np.arange(0, t_last - t_first + 2 * interval_us, interval_us, dtype=np.int64)
        return cls(elapsed + t_first, elapsed.astype(np.float64) * (direction * rpm * TURN / 60e6))

    def with_clock_offset(self, clock_offset_us: float) -> Encoder:
        """The same samples with another clock offset [us]."""
        return dataclasses.replace(self, clock_offset_us=clock_offset_us)

    def with_index(self, index_t_us: ArrayLike) -> Encoder:
        """The same samples, shifted to be at a multiple of 2 pi at the index pulses (encoder's clock, [us])."""
        index_t = np.atleast_1d(as_times(index_t_us))
        if not index_t.size:
            raise AmiwarpError("no index pulse given; leave the index out where there is none")
        self._check_index(index_t)
        at_pulse = np.interp(index_t - self.t[0], self.t - self.t[0], self.angle)
        # The circular mean finds the turn's cut, the median around it withstands a spurious pulse.
        mean = float(np.angle(np.exp(1j * at_pulse).mean()))
        zero = mean + float(np.median(_wrap(at_pulse - mean)))
        return dataclasses.replace(self, angle=self.angle - zero, index_t=index_t)

    def slip(self) -> NDArray[np.float64]:
        """Angle at each index pulse [rad], in -pi .. pi, shape ``(k,)``: 0 throughout where no count was lost."""
        return _wrap(self.pulse_angles())

    def pulse_angles(self) -> NDArray[np.float64]:
        """Unwrapped angle at each index pulse [rad], shape ``(k,)``; empty without pulses."""
        if self.index_t is None:
            return np.zeros(0)
        return np.asarray(np.interp(self.index_t - self.t[0], self.t - self.t[0], self.angle))

    def angle_at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Unwrapped angle [rad] at event times ``t`` [us], any shape, interpolated linearly.

        Raises :class:`AmiwarpError` for a time outside :attr:`coverage`.
        """
        elapsed, sampled, angle = self._near(t)
        result = np.interp(elapsed, sampled, angle)
        for end, outside in ((0, elapsed < 0), (-2, elapsed > sampled[-1])):
            if outside.any():
                slope = (angle[end + 1] - angle[end]) / (sampled[end + 1] - sampled[end])
                result = np.where(outside, angle[end] + slope * (elapsed - sampled[end]), result)
        return np.asarray(result, np.float64)

    def speed_at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Speed [rad/s] at event times ``t`` [us]: the slope of the linear piece that :meth:`angle_at` uses."""
        elapsed, sampled, angle = self._near(t)
        piece = np.clip(np.searchsorted(sampled, elapsed, side="right") - 1, 0, sampled.size - 2)
        slope = 1e6 * np.diff(angle) / np.diff(sampled)
        return np.asarray(slope[piece], np.float64)

    def covers(self, t_start: int, t_end: int) -> bool:
        """Whether :meth:`angle_at` answers for all event times ``t_start`` .. ``t_end`` [us]."""
        first, last = self.coverage
        return first <= t_start and t_end <= last

    @property
    def coverage(self) -> tuple[int, int]:
        """First and last event time [us] with an angle: the samples and one sample interval beyond either end."""
        # Where a gap ends the samples, the mean interval keeps it from being extrapolated over.
        before = min(float(self.t[1] - self.t[0]), self.interval_us)
        after = min(float(self.t[-1] - self.t[-2]), self.interval_us)
        first, last = int(self.t[0]), int(self.t[-1])
        return math.ceil(first - before - self.clock_offset_us), math.floor(last + after - self.clock_offset_us)

    @property
    def interval_us(self) -> float:
        """Mean time between samples [us]."""
        return float(self.t[-1] - self.t[0]) / (self.t.size - 1)

    def gaps(self, max_interval_us: float) -> list[tuple[int, int]]:
        """Pairs of neighbouring sample times (encoder's clock, [us]) more than ``max_interval_us`` apart."""
        before = np.flatnonzero(np.diff(self.t) > max_interval_us)
        return [(int(self.t[i]), int(self.t[i + 1])) for i in before]

    @property
    def rpm(self) -> float:
        """Mean speed over all samples [turns/min], negative where the angle falls."""
        return float((self.angle[-1] - self.angle[0]) / TURN * 60e6 / float(self.t[-1] - self.t[0]))

    def _near(self, t: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Encoder's times of ``t``, and the times and angles of the samples around them; times since the first sample.

        Only those samples: the cost is that of the block asked for, not of the recording.
        """
        times = np.asarray(t, np.int64)
        low, high = (int(times.min()), int(times.max())) if times.size else self.coverage
        if not self.covers(low, high):
            first, last = self.coverage
            raise AmiwarpError(f"events at {low} .. {high} us lie outside the encoder's {first} .. {last} us; cut them")
        start = int(np.searchsorted(self.t, math.floor(low + self.clock_offset_us))) - 1
        start = min(max(start, 0), self.t.size - 2)
        stop = max(int(np.searchsorted(self.t, math.ceil(high + self.clock_offset_us))) + 1, start + 2)
        # Subtracted as integers: float64 has no room for microseconds since 1970 and their fractions.
        elapsed = (times - self.t[start]).astype(np.float64) + self.clock_offset_us
        sampled = (self.t[start:stop] - self.t[start]).astype(np.float64)
        return elapsed, sampled, self.angle[start:stop]


class EncoderStream:
    """Encoder samples as they come, the last of them kept, in memory allocated once; an angle after them is guessed.

    ``clock_offset_us`` as of :class:`Encoder`. Raises :class:`AmiwarpError` for a capacity under 16.
    """

    KEEPS_SPEED_US = 50_000
    """The speed of so much of the last samples goes on where there are none [us]."""
    HOLE_US = 20_000
    """Samples further apart leave a hole: angles in it are guessed, if from both sides [us]."""
    MOST_HOLES = 64
    """That are remembered, the last ones."""

    def __init__(self, clock_offset_us: float = 0.0, *, capacity: int = 1 << 16) -> None:
        if capacity < 16:
            raise AmiwarpError(f"capacity = {capacity} samples; give 16 or more")
        self.clock_offset_us = clock_offset_us
        self.dropped = 0
        """Samples that came late: not after those before."""
        self._t, self._angle = np.zeros(2 * capacity, np.int64), np.zeros(2 * capacity, np.float64)
        self._stop = 0
        self._holes: list[tuple[int, int]] = []
        self._fresh = False

    def __len__(self) -> int:
        return self._stop

    @property
    def first(self) -> int | None:
        """First event time [us] with an angle, an interval before the samples; None while there are fewer than two."""
        if len(self) < 2:
            return None
        return math.ceil(int(2 * self._t[0] - self._t[1]) - self.clock_offset_us)

    @property
    def last(self) -> int | None:
        """Last event time [us] with an angle of the samples; None while there are fewer than two."""
        return None if len(self) < 2 else math.floor(int(self._t[self._stop - 1]) - self.clock_offset_us)

    def restart(self) -> None:
        """What follows does not go on from what came: another zero, after a controller's reset, say."""
        self._fresh = len(self) > 0

    def append(self, t_us: ArrayLike, angle: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Samples, shape ``(n,)`` each [us, rad, unwrapped]; those that are not later than the last are left out.

        Returns what was kept, with one that ends what came before where it began anew.
        """
        t, angles = as_times(t_us), np.asarray(angle, np.float64)
        if not t.size and not angles.size:
            return t, angles
        if t.shape != angles.shape or t.ndim != 1:
            raise AmiwarpError(f"encoder samples have shapes t {t.shape}, angle {angles.shape}; expected one length")
        if not np.isfinite(angles).all():
            raise AmiwarpError(f"encoder angle {angles[~np.isfinite(angles)][0]}; expected finite numbers")
        before = int(self._t[self._stop - 1]) if len(self) else -(2**62)
        later = t > np.maximum.accumulate(np.concatenate([[before], t]))[:-1]
        if not later.all():
            self.dropped += int(np.count_nonzero(~later))
            t, angles = t[later], angles[later]
        if not t.size:
            return t, angles
        inner = np.flatnonzero(np.diff(t) > self.HOLE_US)
        holes = [(int(t[i]), int(t[i + 1])) for i in inner]
        if len(self) and (self._fresh or int(t[0]) - before > self.HOLE_US):
            holes.insert(0, (before, int(t[0])))
            if self._fresh and int(t[0]) - 1 > before:
                last = self._guess(int(t[0]) - 1)
                t, angles = np.append(t[:1] - 1, t), np.append(last, angles)
        self._fresh = False
        self._put(t, angles)
        self._holes = [*self._holes, *holes][-self.MOST_HOLES :]
        return t, angles

    def _put(self, t: NDArray[np.int64], angle: NDArray[np.float64]) -> None:
        capacity = self._t.size // 2
        t, angle = t[-capacity:], angle[-capacity:]
        if self._stop + t.size > self._t.size:  # once in so many samples
            kept = capacity - t.size
            for column in (self._t, self._angle):
                column[:kept] = column[self._stop - kept : self._stop]
            self._stop = kept
            self._holes = [hole for hole in self._holes if kept and hole[1] > self._t[0]]
        self._t[self._stop : self._stop + t.size] = t
        self._angle[self._stop : self._stop + t.size] = angle
        self._stop += t.size

    @property
    def rpm(self) -> float | None:
        """Speed of the last samples [turns/min], negative where the angle falls; None with fewer than two."""
        return None if len(self) < 2 else self._speed() * 60e6 / TURN

    def _speed(self) -> float:
        """[rad/us]"""
        times, angles = self._t[: self._stop], self._angle[: self._stop]
        begins = max([int(times[-1]) - self.KEEPS_SPEED_US, *(end for _, end in self._holes[-1:])])
        since = min(int(np.searchsorted(times, begins)), times.size - 1)
        span = float(times[-1] - times[since])
        return float(angles[-1] - angles[since]) / span if span else 0.0

    def _guess(self, t: int) -> float:
        """The angle after the last sample, at the speed of those before."""
        return float(self._angle[self._stop - 1]) + self._speed() * float(t - self._t[self._stop - 1])

    def over(self, t_first: int, t_last: int) -> Encoder:
        """The samples about the events of ``t_first`` .. ``t_last`` [us]; where none is later, a guess ends them.

        Raises :class:`AmiwarpError` while there are fewer than two samples.
        """
        if len(self) < 2:
            raise AmiwarpError("the encoder has given fewer than two samples yet")
        times, angles = self._t[: self._stop], self._angle[: self._stop]
        low = int(np.searchsorted(times, math.floor(t_first + self.clock_offset_us), side="right")) - 1
        low = min(max(low, 0), times.size - 2)
        end = math.ceil(t_last + self.clock_offset_us)
        high = min(max(int(np.searchsorted(times, end)) + 1, low + 2), times.size)
        t, angle = times[low:high].copy(), angles[low:high].copy()
        if end > t[-1]:
            t, angle = np.append(t, end + 1), np.append(angle, self._guess(end + 1))
        return Encoder(t, angle, self.clock_offset_us)

    def knows(self, t_first: int, t_last: int) -> bool:
        """Whether no angle at the event times ``t_first`` .. ``t_last`` [us] is guessed."""
        return len(self) >= 2 and not any(low < t_last and t_first < high for low, high in self._guesses())

    def _guesses(self) -> Iterator[tuple[int, int]]:
        """Spans of event times [us], ends not included, in which angles are guessed."""
        yield -(2**62), math.ceil(int(self._t[0]) - self.clock_offset_us)
        for begin, end in self._holes:
            yield math.floor(begin - self.clock_offset_us), math.ceil(end - self.clock_offset_us)
        yield math.floor(int(self._t[self._stop - 1]) - self.clock_offset_us), 2**62

    def guessed(self, t: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which event times, sorted, shape ``(n,)`` [us], lie in holes, before the first sample or after the last."""
        out = np.zeros(t.size, np.bool_)
        if len(self) < 2:
            return ~out
        for low, high in self._guesses():
            if low < t[-1] and t[0] < high:
                out[int(np.searchsorted(t, low, side="right")) : int(np.searchsorted(t, high))] = True
        return out


def _wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(angle - TURN * np.round(angle / TURN))
