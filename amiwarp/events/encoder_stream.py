"""Encoder samples of a live rig: a buffer of the latest samples, with extrapolation after the last one."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.command_signal import LONGEST_TURN, CommandAngles, command_samples
from amiwarp.events.encoder import LARGEST_ANGLE, Encoder, event_times, factors_by_angle
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, as_times, real, whole

LARGEST_RATIO = 1e6
"""Largest accepted magnitude of a stream's speed of the second prism relative to the first."""
SAME_COMMAND = 1e-6
"""Largest change of the cosine of an angle, that is of the command, at a jump of a command's angle."""
RESTART_US = 1
"""Time between the extrapolated sample that ends the samples before a restart and the first sample after it [us]."""
BEFORE_ALL = -(2**62)
"""Time before all times [us]."""
AFTER_ALL = 2**62
"""Time after all times [us]."""


@guarded
class EncoderStream:
    """Buffer of the latest samples of a live encoder. Angles after the last sample are extrapolated.

    The buffer is allocated once. The stream of a pair of prisms, or of a mirror with two tilts, has a second encoder,
    whose samples may have other times.

    Parameters
    ----------
    clock_offset_us : float, default 0.0
        Encoder time minus event time [us].
    second : EncoderStream or float, optional
        Stream of the second encoder, with the same clock offset; the caller appends to both. Or the speed of the second
        prism relative to the first, as in :meth:`Encoder.with_second`.
    harmonics : array_like, optional
        Correction of the angles by an error that repeats every turn, as in :meth:`Encoder.with_harmonics`.
    capacity : int, default 65536
        Number of samples that are always kept, at least 16.

    Raises
    ------
    AmiwarpError
        If the capacity is below 16, or ``second`` has another clock offset or a second encoder itself.

    Examples
    --------
    >>> stream = amiwarp.EncoderStream()
    >>> t, angle = stream.append([0, 1000, 2000], [0.0, 0.1, 0.2])
    >>> stream.over(500, 3000).angle_at([1500, 3000]).round(3)
    array([0.15, 0.3 ])
    >>> stream.knows(0, 2000), stream.knows(0, 3000)
    (True, False)

    Two encoders cover the times that both cover:

    >>> second = amiwarp.EncoderStream()
    >>> stream = amiwarp.EncoderStream(second=second)
    >>> _ = stream.append([0, 1000, 2000], [0.0, 0.1, 0.2])
    >>> _ = second.append([0, 700, 1400], [0.0, -0.07, -0.14])
    >>> stream.last, stream.over(0, 1400).angles_at([700]).round(3)
    (1400, array([[ 0.07, -0.07]]))
    """

    SPEED_WINDOW_US = 50_000
    """Duration before the last sample whose mean speed extrapolates the angles after it [us]."""
    GAP_US = 20_000
    """Longest time between two samples that is not a gap [us]. Angles in a gap are regarded as estimates."""
    MAX_GAPS = 64
    """Number of latest gaps that are remembered."""

    def __init__(
        self,
        clock_offset_us: float = 0.0,
        *,
        second: EncoderStream | float | None = None,
        harmonics: ArrayLike | None = None,
        capacity: int = 1 << 16,
    ) -> None:
        capacity = whole(capacity, "capacity", 16, 1 << 28, " samples")
        self._harmonics = harmonics
        if harmonics is not None:
            factors_by_angle(harmonics, 1 if second is None else 2)
        self.clock_offset_us = real(clock_offset_us, "clock_offset_us")
        self.second = _second_stream(second, self.clock_offset_us)
        """Stream of the second encoder, or the speed of the second prism relative to the first; None for one prism."""
        self.dropped = 0
        """Number of samples that were dropped because they were not later than the sample before them."""
        self.sure = True
        """Whether the clock of the samples is known. Until it is, all angles count as estimates."""
        self.cleared = 0
        """How many times :meth:`clear` was called. A copy of the samples is good until this number changes."""
        # The samples are the first _stop of each column. Twice the capacity, so that they are rarely moved.
        self._t = np.zeros(2 * capacity, np.int64)
        self._angle = np.zeros(2 * capacity, np.float64)
        self._stop = 0
        # Sample times before and after each gap, on the encoder's clock [us].
        self._gaps: list[tuple[int, int]] = []
        self._restarted = False
        self._commands = CommandAngles()

    def __len__(self) -> int:
        return self._stop

    @property
    def _encoders(self) -> tuple[EncoderStream, ...]:
        """This stream, and the stream of the second encoder if there is one."""
        if isinstance(self.second, EncoderStream):
            return self, self.second
        return (self,)

    @property
    def _started(self) -> bool:
        """Whether each encoder has at least two samples."""
        return all(len(encoder) >= 2 for encoder in self._encoders)

    @property
    def _first_event_time(self) -> int:
        """First event time with an angle by this encoder [us]: one sample interval before the first sample."""
        return math.ceil(int(2 * self._t[0] - self._t[1]) - self.clock_offset_us)

    @property
    def _last_event_time(self) -> int:
        """Last event time that the samples of this encoder cover [us]."""
        return math.floor(int(self._t[self._stop - 1]) - self.clock_offset_us)

    @property
    def first(self) -> int | None:
        """First event time with an angle [us]: one sample interval before the first sample.

        With two encoders, the first time with both angles. None while an encoder has fewer than two samples.
        """
        if not self._started:
            return None
        return max(encoder._first_event_time for encoder in self._encoders)

    @property
    def last(self) -> int | None:
        """Last event time that the samples of all encoders cover [us].

        None while an encoder has fewer than two samples.
        """
        if not self._started:
            return None
        return min(encoder._last_event_time for encoder in self._encoders)

    def clear(self) -> None:
        """Forget all samples, for example because their times turned out to be on another clock.

        It applies to the second encoder too.
        """
        self.cleared += 1
        for encoder in self._encoders:
            encoder._stop = 0
            encoder._gaps = []
            encoder._restarted = False
            encoder._commands = CommandAngles()

    def restart(self) -> None:
        """Mark that later samples do not continue earlier samples, for example after a reset of the controller.

        It applies to the second encoder too.
        """
        for encoder in self._encoders:
            encoder._restarted = len(encoder) > 0
            encoder._commands = CommandAngles()

    def append(
        self, t_us: ArrayLike, angle: ArrayLike
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
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
        t = as_times(t_us)
        angles = array(angle, "encoder angle").astype(np.float64)
        if not t.size and not angles.size:
            return t, angles
        if t.shape != angles.shape or t.ndim != 1:
            raise AmiwarpError(
                f"encoder samples have shapes t {t.shape}, angle {angles.shape}; expected one length"
            )
        good = np.abs(angles) <= LARGEST_ANGLE  # NaN fails
        if not good.all():
            raise AmiwarpError(
                f"encoder angle is {angles[~good][0]}; expected finite numbers within {LARGEST_ANGLE:g} rad of 0"
            )
        before = int(self._t[self._stop - 1]) if len(self) else BEFORE_ALL
        later = _later(t, before)
        if not later.all():
            self.dropped += int(np.count_nonzero(~later))
            t = t[later]
            angles = angles[later]
        if not t.size:
            return t, angles

        starts = np.flatnonzero(np.diff(t) > self.GAP_US)
        gaps = [(int(t[i]), int(t[i + 1])) for i in starts]
        first = int(t[0])
        if len(self) and (self._restarted or first - before > self.GAP_US):
            gaps.insert(0, (before, first))
            # After a restart the angle jumps: end the samples before it just before the first new one.
            end = first - RESTART_US
            if self._restarted and end > before:
                angles = np.append(self._extrapolate(end), angles)
                t = np.append(t[:1] - RESTART_US, t)
        self._restarted = False
        self._store(t, angles)
        self._gaps = [*self._gaps, *gaps][-self.MAX_GAPS :]
        return t, angles

    def append_command(
        self, t_us: ArrayLike, command: ArrayLike, *, largest: float
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Append samples of a command signal, such as one of a mirror, as :meth:`Encoder.from_command` takes them.

        The last sample is kept back until the next one shows in which direction the command goes on. Samples that are
        not later than the sample before them are dropped.

        Parameters
        ----------
        t_us : array_like
            Sample times on the encoder's clock [us], shape (n,).
        command : array_like
            Command in any unit, shape (n,).
        largest : float
            Largest magnitude of the command, the same as for the recording that was calibrated.

        Returns
        -------
        tuple of numpy.ndarray
            Times and angles of the samples that were stored, as :meth:`append` returns them.

        Raises
        ------
        AmiwarpError
            If the shapes differ, or a command is not finite or beyond ``largest``. Nothing is stored then.

        Examples
        --------
        >>> import numpy as np
        >>> t, stream = np.arange(0, 100_000, 500), amiwarp.EncoderStream()
        >>> for part in (slice(0, 120), slice(120, None)):
        ...     _ = stream.append_command(t[part], 5.0 * np.sin(4e-4 * t[part]), largest=5.0)
        >>> np.cos(stream.over(50_000, 50_000).angle_at([50_000])).round(3)  # sin(20)
        array([0.913])
        """
        t, commands = command_samples(t_us, command)
        last = self._commands.last
        later = _later(t, BEFORE_ALL if last is None else last)
        t, angle = self._commands.take(t[later], commands[later], largest)
        self.dropped += int(np.count_nonzero(~later))
        return self.append(t, angle)

    def _store(self, t: NDArray[np.int64], angle: NDArray[np.float64]) -> None:
        capacity = self._t.size // 2
        t = t[-capacity:]
        angle = angle[-capacity:]
        if self._stop + t.size > self._t.size:
            # The buffer is full: move the latest samples to its beginning.
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
        """Speed of the first prism over the latest samples [turns/min], negative if the angle decreases.

        None with fewer than two samples.
        """
        if len(self) < 2:
            return None
        return self._speed() * 60e6 / math.tau

    def _speed(self) -> float:
        """Return the mean speed of the latest samples [rad/us]."""
        times = self._t[: self._stop]
        angles = self._angle[: self._stop]
        start = int(times[-1]) - self.SPEED_WINDOW_US
        if self._gaps:
            _, gap_end = self._gaps[-1]
            start = max(start, gap_end)
        since = min(int(np.searchsorted(times, start)), times.size - 1)
        span = float(times[-1] - times[since])
        if not span:
            return 0.0
        return float(angles[-1] - angles[since]) / span

    def _extrapolate(self, t: int) -> float:
        """Return the angle [rad] at encoder time ``t`` [us] after the last sample, at the latest mean speed."""
        last = self._stop - 1
        return float(self._angle[last]) + self._speed() * float(t - self._t[last])

    def over(self, t_first: int, t_last: int) -> Encoder:
        """Return an encoder with the samples around a span of event times.

        Parameters
        ----------
        t_first, t_last : int
            First and last event time [us].

        Returns
        -------
        Encoder
            The encoder, with the second one if there is one. If no sample is later than ``t_last``, an extrapolated
            sample is added.

        Raises
        ------
        AmiwarpError
            If an encoder has fewer than two samples.
        """
        if len(self) < 2:
            raise AmiwarpError(
                "the encoder stream has fewer than two samples so far; append at least two samples first"
            )
        times = self._t[: self._stop]
        angles = self._angle[: self._stop]
        begin = math.floor(t_first + self.clock_offset_us)
        end = math.ceil(t_last + self.clock_offset_us)
        low = int(np.searchsorted(times, begin, side="right")) - 1
        low = min(max(low, 0), times.size - 2)
        high = int(np.searchsorted(times, end)) + 1
        high = min(max(high, low + 2), times.size)
        t = times[low:high].copy()
        angle = angles[low:high].copy()
        if end > t[-1]:
            t = np.append(t, end + 1)
            angle = np.append(angle, self._extrapolate(end + 1))
        encoder = Encoder(t, angle, self.clock_offset_us)
        if isinstance(self.second, EncoderStream):
            encoder = encoder.with_second(self.second.over(t_first, t_last))
        elif self.second is not None:
            encoder = encoder.with_second(self.second)
        if self._harmonics is not None:
            encoder = encoder.with_harmonics(self._harmonics)
        return encoder

    def knows(self, t_first: int, t_last: int) -> bool:
        """Return whether samples determine all angles of a span of event times.

        Parameters
        ----------
        t_first, t_last : int
            First and last event time [us].

        Returns
        -------
        bool
            False if an angle of any prism would be extrapolated, or would lie in a gap.
        """
        if not self._started:
            return False
        return not any(low < t_last and t_first < high for low, high in self._estimated_spans())

    def _estimated_spans(self) -> Iterator[tuple[int, int]]:
        """Yield the spans of event times [us], ends excluded, in which an angle is extrapolated or in a gap."""
        offset = self.clock_offset_us
        if not self.sure:
            yield BEFORE_ALL, AFTER_ALL
        for encoder in self._encoders:
            yield BEFORE_ALL, math.ceil(int(encoder._t[0]) - offset)
            for begin, end in encoder._gaps:
                yield math.floor(begin - offset), math.ceil(end - offset)
            yield encoder._last_event_time, AFTER_ALL

    def guessed(self, t: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which event times have an estimated angle.

        Parameters
        ----------
        t : numpy.ndarray
            Event times [us], shape (n,), sorted.

        Returns
        -------
        numpy.ndarray
            True for times in a gap, before the first sample or after the last, or for all if the clock is not
            :attr:`sure`, shape (n,).
        """
        t = event_times(t)
        if t.ndim != 1:
            raise AmiwarpError(f"t has shape {t.shape}; give shape (n,)")
        if not self._started or not t.size:
            return np.ones(t.size, np.bool_)
        guessed = np.zeros(t.size, np.bool_)
        for low, high in self._estimated_spans():
            if low < t[-1] and t[0] < high:
                first = int(np.searchsorted(t, low, side="right"))
                stop = int(np.searchsorted(t, high))
                guessed[first:stop] = True
        return guessed


def _later(t: NDArray[np.int64], before: int) -> NDArray[np.bool_]:
    """Return which times are later than ``before`` and than all times before them, shape (n,)."""
    latest = np.maximum.accumulate(np.append(before, t))
    return np.asarray(t > latest[:-1])


def _second_stream(
    second: EncoderStream | float | None, clock_offset_us: float
) -> EncoderStream | float | None:
    """Return what describes the second angle of a stream; raise :class:`AmiwarpError` if it is unusable."""
    if second is None:
        return None
    if not isinstance(second, EncoderStream):
        what = "speed of the second prism relative to the first"
        return real(second, what, -LARGEST_RATIO, LARGEST_RATIO)
    if second.second is not None:
        raise AmiwarpError("the second encoder has a second one itself; a pair has two prisms")
    if second.clock_offset_us != clock_offset_us:
        raise AmiwarpError(
            f"the second encoder has a clock offset of {second.clock_offset_us:g} us, the first one of "
            f"{clock_offset_us:g} us; give both the same"
        )
    return second


def starts_of_runs(t: NDArray[np.int64], angle: NDArray[np.float64]) -> list[int]:
    """Return the indices of the first sample, and of each after a gap or a restart of an :class:`EncoderStream`.

    A gap is longer than :attr:`EncoderStream.GAP_US`, and than three usual intervals. ``t``: times [us], shape (n,).
    ``angle``: angles [rad], shape (n,).
    """
    interval = np.diff(t)
    if not interval.size:
        return [0]
    longest = max(EncoderStream.GAP_US, 3.0 * float(np.median(interval)))
    # The angle of a command jumps as fast as at a restart, but forwards, and its cosine stays.
    turned = np.diff(angle)
    forwards = (turned > LONGEST_TURN) & (turned <= math.tau)
    jumps = forwards & (np.abs(np.diff(np.cos(angle))) < SAME_COMMAND)
    breaks = np.flatnonzero((interval > longest) | ((interval <= RESTART_US) & ~jumps))
    return [0, *(breaks + 1).tolist()]
