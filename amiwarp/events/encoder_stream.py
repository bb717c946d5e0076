"""Encoder samples of a live rig: a buffer of the latest samples, with extrapolation after the last one."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TWO_PI, Encoder
from amiwarp.events.events import as_times
from amiwarp.validation import array, guarded, real, vector, whole

RESTART_US = 1
"""Time between the extrapolated sample that ends the samples before a restart and the first sample after it [us]."""


@guarded
class EncoderStream:
    """Buffer of the latest samples of a live encoder. Angles after the last sample are extrapolated.

    The buffer is allocated once.

    Parameters
    ----------
    clock_offset_us : float, default 0.0
        Encoder time minus event time [us].
    harmonics : array_like, optional
        Correction of the angles by an error that repeats every turn, as in :meth:`Encoder.with_harmonics`.
    capacity : int, default 65536
        Number of samples that are always kept, at least 16.

    Raises
    ------
    AmiwarpError
        If the capacity is below 16.

    Examples
    --------
    >>> stream = amiwarp.EncoderStream()
    >>> t, angle = stream.append([0, 1000, 2000], [0.0, 0.1, 0.2])
    >>> stream.over(500, 3000).angle_at([1500, 3000]).round(3)
    array([0.15, 0.3 ])
    >>> stream.knows(0, 2000), stream.knows(0, 3000)
    (True, False)
    """

    SPEED_WINDOW_US = 50_000
    """Duration before the last sample whose mean speed extrapolates the angles after it [us]."""
    GAP_US = 20_000
    """Longest time between two samples that is not a gap [us]. Angles in a gap are regarded as estimates."""
    MAX_GAPS = 64
    """Number of latest gaps that are remembered."""

    def __init__(
        self, clock_offset_us: float = 0.0, *, harmonics: ArrayLike | None = None, capacity: int = 1 << 16
    ) -> None:
        capacity = whole(capacity, "capacity", 16, 1 << 28, " samples")
        self._harmonics = None if harmonics is None else vector(harmonics, 4, "harmonics", real)
        self.clock_offset_us = real(clock_offset_us, "clock_offset_us")
        self.dropped = 0
        """Number of samples that were dropped because they were not later than the sample before them."""
        self._t, self._angle = np.zeros(2 * capacity, np.int64), np.zeros(2 * capacity, np.float64)
        self._stop = 0
        self._gaps: list[tuple[int, int]] = []
        self._restarted = False

    def __len__(self) -> int:
        return self._stop

    @property
    def first(self) -> int | None:
        """First event time with an angle [us]: one sample interval before the first sample.

        None with fewer than two samples.
        """
        if len(self) < 2:
            return None
        return math.ceil(int(2 * self._t[0] - self._t[1]) - self.clock_offset_us)

    @property
    def last(self) -> int | None:
        """Last event time that samples cover [us]; None with fewer than two samples."""
        return None if len(self) < 2 else math.floor(int(self._t[self._stop - 1]) - self.clock_offset_us)

    def restart(self) -> None:
        """Mark that later samples do not continue earlier samples, for example after a reset of the controller."""
        self._restarted = len(self) > 0

    def append(self, t_us: ArrayLike, angle: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Append samples. Samples that are not later than the sample before them are dropped.

        Parameters
        ----------
        t_us : array_like
            Sample times on the encoder's clock [us], shape (n,).
        angle : array_like
            Unwrapped prism angles [rad], shape (n,).

        Returns
        -------
        tuple of numpy.ndarray
            Times and angles of the samples that were stored. After :meth:`restart` an additional extrapolated sample
            ends the earlier ones.

        Raises
        ------
        AmiwarpError
            If the shapes differ or an angle is not finite.
        """
        t, angles = as_times(t_us), array(angle, "encoder angle").astype(np.float64)
        if not t.size and not angles.size:
            return t, angles
        if t.shape != angles.shape or t.ndim != 1:
            raise AmiwarpError(f"encoder samples have shapes t {t.shape}, angle {angles.shape}; expected one length")
        if not np.isfinite(angles).all():
            raise AmiwarpError(f"encoder angle is {angles[~np.isfinite(angles)][0]}; expected finite numbers")
        before = int(self._t[self._stop - 1]) if len(self) else -(2**62)
        later = t > np.maximum.accumulate(np.concatenate([[before], t]))[:-1]
        if not later.all():
            self.dropped += int(np.count_nonzero(~later))
            t, angles = t[later], angles[later]
        if not t.size:
            return t, angles
        inner = np.flatnonzero(np.diff(t) > self.GAP_US)
        gaps = [(int(t[i]), int(t[i + 1])) for i in inner]
        if len(self) and (self._restarted or int(t[0]) - before > self.GAP_US):
            gaps.insert(0, (before, int(t[0])))
            if self._restarted and int(t[0]) - RESTART_US > before:
                last = self._extrapolate(int(t[0]) - RESTART_US)
                t, angles = np.append(t[:1] - RESTART_US, t), np.append(last, angles)
        self._restarted = False
        self._store(t, angles)
        self._gaps = [*self._gaps, *gaps][-self.MAX_GAPS :]
        return t, angles

    def _store(self, t: NDArray[np.int64], angle: NDArray[np.float64]) -> None:
        capacity = self._t.size // 2
        t, angle = t[-capacity:], angle[-capacity:]
        if self._stop + t.size > self._t.size:  # the buffer is full: move the latest samples to its beginning
            kept = capacity - t.size
            for column in (self._t, self._angle):
                column[:kept] = column[self._stop - kept : self._stop]
            self._stop = kept
            self._gaps = [gap for gap in self._gaps if kept and gap[1] > self._t[0]]
        self._t[self._stop : self._stop + t.size] = t
        self._angle[self._stop : self._stop + t.size] = angle
        self._stop += t.size

    @property
    def rpm(self) -> float | None:
        """Speed of the prism over the latest samples [turns/min], negative if the angle decreases.

        None with fewer than two samples.
        """
        return None if len(self) < 2 else self._speed() * 60e6 / TWO_PI

    def _speed(self) -> float:
        """Return the mean speed of the latest samples [rad/us]."""
        times, angles = self._t[: self._stop], self._angle[: self._stop]
        begins = max([int(times[-1]) - self.SPEED_WINDOW_US, *(end for _, end in self._gaps[-1:])])
        since = min(int(np.searchsorted(times, begins)), times.size - 1)
        span = float(times[-1] - times[since])
        return float(angles[-1] - angles[since]) / span if span else 0.0

    def _extrapolate(self, t: int) -> float:
        """Return the angle [rad] at encoder time ``t`` [us] after the last sample, at the latest mean speed."""
        return float(self._angle[self._stop - 1]) + self._speed() * float(t - self._t[self._stop - 1])

    def over(self, t_first: int, t_last: int) -> Encoder:
        """Return an encoder with the samples around a span of event times.

        Parameters
        ----------
        t_first, t_last : int
            First and last event time [us].

        Returns
        -------
        Encoder
            The encoder. If no sample is later than ``t_last``, an extrapolated sample is added.

        Raises
        ------
        AmiwarpError
            If there are fewer than two samples.
        """
        if len(self) < 2:
            raise AmiwarpError(
                "the encoder stream has fewer than two samples so far; append at least two samples first"
            )
        times, angles = self._t[: self._stop], self._angle[: self._stop]
        low = int(np.searchsorted(times, math.floor(t_first + self.clock_offset_us), side="right")) - 1
        low = min(max(low, 0), times.size - 2)
        end = math.ceil(t_last + self.clock_offset_us)
        high = min(max(int(np.searchsorted(times, end)) + 1, low + 2), times.size)
        t, angle = times[low:high].copy(), angles[low:high].copy()
        if end > t[-1]:
            t, angle = np.append(t, end + 1), np.append(angle, self._extrapolate(end + 1))
        encoder = Encoder(t, angle, self.clock_offset_us)
        return encoder if self._harmonics is None else encoder.with_harmonics(self._harmonics)

    def knows(self, t_first: int, t_last: int) -> bool:
        """Return whether samples determine all angles of a span of event times.

        Parameters
        ----------
        t_first, t_last : int
            First and last event time [us].

        Returns
        -------
        bool
            False if an angle would be extrapolated, or would lie in a gap.
        """
        return len(self) >= 2 and not any(low < t_last and t_first < high for low, high in self._estimated_spans())

    def _estimated_spans(self) -> Iterator[tuple[int, int]]:
        """Yield the spans of event times [us], ends excluded, in which angles are extrapolated or in a gap."""
        yield -(2**62), math.ceil(int(self._t[0]) - self.clock_offset_us)
        for begin, end in self._gaps:
            yield math.floor(begin - self.clock_offset_us), math.ceil(end - self.clock_offset_us)
        yield math.floor(int(self._t[self._stop - 1]) - self.clock_offset_us), 2**62

    def guessed(self, t: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which event times have an estimated angle.

        Parameters
        ----------
        t : numpy.ndarray
            Event times [us], shape (n,), sorted.

        Returns
        -------
        numpy.ndarray
            True for times in a gap, before the first sample or after the last, shape (n,).
        """
        if t.ndim != 1:
            raise AmiwarpError(f"t has shape {t.shape}; give shape (n,)")
        out = np.zeros(t.size, np.bool_)
        if len(self) < 2 or not t.size:
            return ~out
        for low, high in self._estimated_spans():
            if low < t[-1] and t[0] < high:
                out[int(np.searchsorted(t, low, side="right")) : int(np.searchsorted(t, high))] = True
        return out


def start_of_last_run(t: NDArray[np.int64]) -> int:
    """Return the index of the first sample after the last gap or restart in samples of an :class:`EncoderStream`.

    A gap is longer than :attr:`EncoderStream.GAP_US`, and than three usual intervals. ``t``: times [us], shape (n,).
    """
    steps = np.diff(t)
    longest = max(EncoderStream.GAP_US, 3.0 * float(np.median(steps))) if steps.size else 0.0
    breaks = np.flatnonzero((steps > longest) | (steps <= RESTART_US))
    return int(breaks[-1]) + 1 if breaks.size else 0
