"""The prism's encoder: samples of the prism angle over time, which give every event its angle.

Angles are in radians and unwrapped, so they grow past 2 pi. Their positive direction is that of the optics. The
encoder may have its own clock: event time ``t`` corresponds to encoder time ``t + clock_offset_us``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.validation import TIME_LIMIT, array, as_times, check_ascending, guarded, instance, real, vector, whole

# Unwrap an encoder's counts and angles: find the period at which they wrap, and reject ambiguous samples.
#
# Each step between neighbouring samples is compared with the step that the preceding speed predicts. The difference is
# the step's residual. With the right period the residuals are small at every wrap. A period that is wrong by more than
# the noise shows in the mean residual at the wraps.

WIDTHS = tuple(range(8, 33))
"""Widths of hardware counters that are recognised automatically in encoder counts [bits]."""
WIDEST = 64
"""Largest width of a hardware counter that a caller may give [bits]."""
EXACT_BITS = 53
"""Largest width of numbers that float64 holds exactly [bits]."""
ONCE_A_TURN = 0
"""Value of ``counter_bits`` for a counter that restarts each turn."""
SHORTEST_PERIOD = 3
"""Shortest period of a counter that wraps [counts]. With fewer states the direction of rotation is unobservable."""
SPEED_STEPS = 5
"""Number of preceding steps between samples whose median speed predicts the next step."""
FEWEST_SAMPLES = 20
"""Smallest number of samples from which the width of a counter is found. Fewer samples could come from a swinging
prism."""
GAP = 3.0
"""Ratio to the typical sample interval above which an interval is a gap."""
LARGEST_RESIDUAL = 0.25
"""Largest difference of a step from its prediction, as a fraction of the period. Above it the number of wraps is
ambiguous."""
DECISIVE_RATIO = 3.0
"""Factor by which unwrapping at a period must reduce the steps' differences from prediction for the period to be
accepted."""
ROUNDING_COUNTS = 2.0
"""Difference of a step from its prediction that rounding to whole counts explains [counts]."""
ROUNDING_TURNS = 1.0 / 64.0
"""Difference of a step from its prediction that the resolution of angles explains [turns]."""


class UnwrapError(AmiwarpError):
    """Raised for encoder samples that cannot be unwrapped."""

    sample: int = 0
    """Index of the first sample that shows the problem."""
    problem: str = ""
    """Description of the problem with the samples, and its remedy."""

    @classmethod
    def at(cls, sample: int, problem: str) -> UnwrapError:
        """Return the error for the encoder sample with index ``sample``."""
        error = cls(f"encoder sample {sample}: {problem}")
        error.sample, error.problem = sample, problem
        return error


@dataclass(frozen=True)
class _Steps:
    """Steps between neighbouring encoder samples, unwrapped at one period."""

    period: float
    """Period at which the values wrap, in the samples' unit; 0 without unwrapping."""
    step: NDArray[np.float64]
    """Unwrapped steps, in the samples' unit, shape ``(m - 1,)``."""
    wraps: NDArray[np.float64]
    """Number of periods added to each step, shape ``(m - 1,)``."""
    expected: NDArray[np.float64]
    """Steps that the preceding speed predicts, in the samples' unit, shape ``(m - 1,)``."""

    @property
    def residual(self) -> NDArray[np.float64]:
        """Difference of each step from its prediction, in the samples' unit."""
        return np.asarray(self.step - self.expected)

    @property
    def cost(self) -> float:
        """Sum of the absolute differences between steps and their predictions."""
        return float(np.abs(self.residual).sum())


@dataclass(frozen=True)
class _Samples:
    """Encoder samples to unwrap, with the words that describe them in error messages."""

    t: NDArray[np.int64]
    """Times of the samples [us], shape ``(m,)``."""
    value: NDArray[np.float64]
    """Values of the samples: counts, or angles [rad], shape ``(m,)``."""
    turn: float
    """One turn in the unit of ``value``."""
    rounding: float
    """Difference of a step from its prediction that rounding explains, in the unit of ``value``."""
    noun: str
    """Name of the values in error messages: count or angle."""
    unit: float
    """Factor from the unit of ``value`` to the unit in error messages."""
    remedy: str
    """Remedy for the user in error messages."""

    @property
    def interval(self) -> NDArray[np.float64]:
        """Times between neighbouring samples [us], shape ``(m - 1,)``."""
        return np.diff(self.t).astype(np.float64)

    @property
    def gap(self) -> NDArray[np.bool_]:
        """Whether each interval between samples is a gap."""
        return np.asarray(self.interval > GAP * np.median(self.interval))

    def shown(self, value: float) -> str:
        """Format a value in the unit of error messages."""
        return f"{value * self.unit:,.6g}"

    def steps(self, period: float) -> _Steps:
        """Return the steps unwrapped at ``period``: each nearest to its prediction from the median speed."""
        raw = np.diff(self.value)
        step = raw
        if period:
            near = raw - period * np.round(raw / period)
            steady = np.median(near / self.interval) * self.interval
            step = near + period * np.round((steady - near) / period)
        wraps = np.round((step - raw) / period) if period else np.zeros_like(raw)
        return _Steps(period, step, wraps, expected_steps(step, self.interval))


def check_direction(direction: int) -> None:
    """Raise :class:`AmiwarpError` if a direction is neither 1 nor -1."""
    if direction not in (1, -1):
        raise AmiwarpError(f"direction = {direction}; expected 1 or -1")


def unwrap_counts(
    t: NDArray[np.int64], count: NDArray[np.float64], counts_per_turn: int, counter_bits: int | None = None
) -> NDArray[np.float64]:
    """Return unwrapped counts. The counter may keep counting, restart each turn, or wrap at its width.

    ``counter_bits`` is that width, 0 for a counter that restarts each turn, or None to find it from the samples.
    Raises :class:`UnwrapError` for samples that do not determine the rotation.
    """
    remedy = "give the counter's width as counter_bits (--counter-bits; 0 if it restarts each turn)"
    samples = _Samples(t, count, float(counts_per_turn), ROUNDING_COUNTS, "count", 1.0, remedy)
    if counter_bits is not None and counter_bits != ONCE_A_TURN and not WIDTHS[0] <= counter_bits <= WIDEST:
        raise AmiwarpError(f"counter_bits = {counter_bits}; give {WIDTHS[0]} to {WIDEST}, or 0 for one turn")
    if not _can_wrap(samples):
        return count
    if counter_bits is None:
        return _accumulate(samples, _find(samples, _count_periods(samples)))
    period = float(counts_per_turn if counter_bits == ONCE_A_TURN else 2**counter_bits)
    if not _fits(count, period, signed=counter_bits != ONCE_A_TURN):
        low, high = int(np.argmin(count)), int(np.argmax(count))
        span = f"counts {samples.shown(count[low])} .. {samples.shown(count[high])}"
        what = f"{span} do not fit in {_period_name(samples, period)}"
        raise UnwrapError.at(max(low, high), f"{what}; {samples.remedy}")
    return _accumulate(samples, _checked(samples, samples.steps(period)))


def unwrap_angles(t: NDArray[np.int64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unwrapped angles [rad]. The angles may be unwrapped already, or wrap at a whole number of turns.

    Raises :class:`UnwrapError` for samples that do not determine the rotation.
    """
    turn = 2.0 * math.pi
    remedy = "sample the encoder more often, or unwrap the angles beforehand"
    samples = _Samples(t, angle, turn, ROUNDING_TURNS * turn, "angle", 180.0 / math.pi, remedy)
    if not _can_wrap(samples):
        return angle
    turns = {1, max(1, round(float(np.abs(samples.steps(0.0).residual).max()) / turn))}
    return _accumulate(samples, _find(samples, [k * turn for k in turns if np.ptp(angle) <= k * turn * (1.0 + 1e-9)]))


def expected_steps(step: NDArray[np.float64], interval: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the steps predicted by the median speed of preceding steps, or of following ones at the start."""
    speed = step / interval
    n = speed.size
    if n < 2 * SPEED_STEPS:
        others = [np.median(np.delete(speed, k)) if n > 1 else speed[0] for k in range(n)]
        return np.asarray(np.array(others) * interval)
    from scipy.ndimage import median_filter

    middle = median_filter(speed, size=SPEED_STEPS, mode="nearest")
    away = SPEED_STEPS // 2 + 1
    at = np.arange(n)
    return np.asarray(middle[np.where(at < SPEED_STEPS, at + away, at - away)] * interval)


def _can_wrap(samples: _Samples) -> bool:
    """Return whether there is a step to unwrap. Raises :class:`AmiwarpError` for bad shapes and values."""
    if samples.value.shape != samples.t.shape or samples.value.ndim != 1:
        raise AmiwarpError(
            f"encoder t has shape {samples.t.shape}, its values {samples.value.shape}; expected one length"
        )
    if not np.isfinite(samples.value).all():
        at = int(np.argmin(np.isfinite(samples.value)))
        raise AmiwarpError(f"encoder sample {at} is {samples.value[at]}; expected a finite number")
    # Encoder checks the order of the samples itself.
    return samples.value.size > 1 and bool((samples.interval > 0).all())


def _count_periods(samples: _Samples) -> Iterator[float]:
    """Yield the periods at which counts in the given range can wrap."""
    if samples.turn >= SHORTEST_PERIOD and np.ptp(samples.value) <= samples.turn:
        yield samples.turn
    yield from (2.0**bits for bits in WIDTHS if _fits(samples.value, 2.0**bits, signed=True))


def _fits(count: NDArray[np.float64], period: float, *, signed: bool) -> bool:
    """Return whether the range of the counts fits into a period of the counter."""
    low, high = float(count.min()), float(count.max())
    if not signed:
        return high - low <= period
    return (low >= 0.0 and high < period) or (low >= -period / 2.0 and high < period / 2.0)


def _period_name(samples: _Samples, period: float) -> str:
    """Return a name for a period, for error messages."""
    if period == samples.turn:
        return "one turn"
    bits = math.log2(period)
    return f"{bits:.0f} bits" if samples.noun == "count" and bits.is_integer() else f"{period / samples.turn:.6g} turns"


def _find(samples: _Samples, periods: Iterable[float]) -> _Steps:
    """Return the steps unwrapped at the only period that fits, or the plain steps if nothing wraps."""
    plain = samples.steps(0.0)
    wrapped = [found for found in map(samples.steps, sorted({*periods})) if found.wraps.any()]
    best = min([plain, *wrapped], key=lambda found: found.cost)
    if best is not plain:
        at = best.wraps != 0.0
        few = samples.noun == "count" and samples.value.size < FEWEST_SAMPLES
        cost, best_cost = np.abs(plain.residual[at]).sum(), np.abs(best.residual[at]).sum()
        if few or not cost > DECISIVE_RATIO * best_cost + samples.rounding:
            raise UnwrapError.at(int(np.argmax(at)) + 1, _ambiguous(samples, best))
        _check_period(samples, best, [found.period for found in wrapped])
        return _checked(samples, best)
    rival = next((found for found in wrapped if found.cost <= DECISIVE_RATIO * plain.cost + samples.rounding), None)
    if rival is not None:
        at = int(np.argmax(rival.wraps != 0.0)) + 1
        raise UnwrapError.at(at, _ambiguous(samples, rival))
    # A wrap jumps from one end of the range to the other. A step of the prism does not.
    least = min(samples.turn, 2.0 ** WIDTHS[0]) / 2.0
    largest = max(0.5 * float(np.ptp(samples.value)), least)
    plausible = np.maximum(largest, np.where(samples.gap, np.abs(plain.expected), 0.0))
    jump = np.abs(plain.residual) > plausible
    if jump.any():
        at = int(np.argmax(jump))
        raise UnwrapError.at(at + 1, f"{_jump(samples, plain, at)}, at no known period; {samples.remedy}")
    return plain


def _ambiguous(samples: _Samples, found: _Steps) -> str:
    """Return the problem, for an error message, of a wrap that is neither certain nor excluded."""
    period = _period_name(samples, found.period)
    return f"the {samples.noun} may have wrapped here, at {period}, or not; {samples.remedy}"


def _jump(samples: _Samples, found: _Steps, at: int) -> str:
    """Return the problem, for an error message, of a step that differs from its prediction."""
    step, expected = samples.shown(float(found.step[at])), samples.shown(float(found.expected[at]))
    return f"the {samples.noun} changes by {step} where about {expected} was expected"


def _check_period(samples: _Samples, best: _Steps, periods: list[float]) -> None:
    """Raise :class:`UnwrapError` if the wraps contradict the period, or cannot distinguish it from another one."""
    if best.period < 8.0 * samples.rounding:
        return
    weight = float((best.wraps**2).sum())
    error = float((best.wraps * best.residual).sum()) / weight
    scatter = float(np.sqrt(np.mean((best.residual - error * best.wraps) ** 2)))
    # The rounding of the speed accumulates over a gap.
    rounding = samples.rounding * np.maximum(1.0, samples.interval / np.median(samples.interval))
    tolerance = float((np.abs(best.wraps) * rounding).sum()) / weight + 3.0 * scatter / math.sqrt(weight)
    at = int(np.argmax(best.wraps != 0.0)) + 1
    seen = best.period - error
    if abs(error) > tolerance or tolerance > LARGEST_RESIDUAL * best.period:
        what = f"the {samples.noun} wraps by about {samples.shown(seen)}, which is no known period"
        raise UnwrapError.at(at, f"{what}; {samples.remedy}")
    others = [p for p in periods if p != best.period and abs(p - seen) <= 2.0 * tolerance]
    if others:
        what = f"the {samples.noun} may wrap at {samples.shown(best.period)} or at {samples.shown(others[0])}"
        raise UnwrapError.at(at, f"{what}; {samples.remedy}")


def _checked(samples: _Samples, found: _Steps) -> _Steps:
    """Return the steps unchanged; raise :class:`UnwrapError` if a step fits another number of wraps as well.

    If the period is a whole number of turns, steps in gaps are not checked: additional turns in a gap change no angle
    outside it.
    """
    whole = found.period % samples.turn == 0.0 or samples.noun == "angle"
    checked = ~samples.gap if whole else np.ones_like(samples.gap)
    largest = max(LARGEST_RESIDUAL * found.period, min(1.0, samples.rounding))
    bad = checked & ((np.abs(found.residual) > largest) | (np.abs(found.residual) >= 0.5 * found.period))
    if bad.any():
        at = int(np.argmax(bad))
        what = f"{_jump(samples, found, at)}, wrapping at {_period_name(samples, found.period)}"
        raise UnwrapError.at(at + 1, f"{what}; {samples.remedy}")
    slow = checked & (np.abs(found.expected) >= 0.5 * found.period)
    if slow.any() and not whole:
        at = int(np.argmax(slow))
        what = f"the counter of {_period_name(samples, found.period)} may have wrapped more than once"
        raise UnwrapError.at(
            at + 1, f"{what} in the {samples.interval[at] / 1e3:.6g} ms since the sample before; sample it more often"
        )
    return found


def _accumulate(samples: _Samples, found: _Steps) -> NDArray[np.float64]:
    """Return the unwrapped values of all samples, summed from the wraps."""
    if not found.wraps.any():
        return samples.value
    # Whole periods are added to the samples themselves, so that rounding does not accumulate.
    return np.asarray(samples.value + found.period * np.concatenate([[0.0], np.cumsum(found.wraps)]))


TWO_PI = 2.0 * math.pi
"""One turn [rad]."""
MOST_SAMPLES = 1 << 28
"""Largest number of samples that :meth:`Encoder.constant_speed` makes: three days at one sample per millisecond."""
LONGEST_BENT_STEP = TWO_PI / 64.0
"""Longest step between samples of an encoder whose error within a turn is corrected [rad]."""
LONGEST_TURN = 0.35
"""Longest step of the angle of a command at the end of a swing that is taken for the way through its largest magnitude
[rad]; longer ones are jumps."""
LARGEST_RATIO = 1e6
"""Largest accepted magnitude of a stream's speed of the second prism relative to the first."""
LARGEST_ANGLE = 1e10
"""Largest accepted magnitude of a prism angle [rad]: 1.6e9 turns. Up to this angle float64 resolves 2e-6 rad."""


def periodic(angle: NDArray[np.float64], factors: Sequence[float]) -> NDArray[np.float64]:
    """Return the sum of cos, sin, cos 2 and sin 2 of the angles [rad], each with its factor."""
    return np.asarray(
        np.array(factors) @ np.stack([np.cos(angle), np.sin(angle), np.cos(2.0 * angle), np.sin(2.0 * angle)])
    )


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
            raise AmiwarpError(f"encoder samples have shapes {shapes}; expected two equal lengths of at least 2")
        if self.t.dtype != np.int64 or self.angle.dtype != np.float64:
            raise AmiwarpError(f"encoder t is {self.t.dtype}, angle is {self.angle.dtype}; expected int64 and float64")
        check_ascending(self.t, "encoder sample")
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
        if self.second is not None:
            instance(self.second, Encoder, "encoder second")
            if self.second.second is not None:
                raise AmiwarpError("the second encoder has a second one itself; a pair has two prisms")
            if self.second.clock_offset_us != self.clock_offset_us:
                object.__setattr__(self, "second", self.second.with_clock_offset(self.clock_offset_us))

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
        check_direction(direction)
        t, counts = as_times(t_us), array(count, "encoder count")
        bits = counter_bits or WIDEST
        if counts.dtype.kind in "iu" and EXACT_BITS < bits <= WIDEST:  # signed, small about 0: float64 is exact there
            unused = WIDEST - bits
            counts = (counts.astype(np.uint64) << np.uint64(unused)).astype(np.int64) >> unused
        counts = unwrap_counts(t, counts.astype(np.float64), counts_per_turn, counter_bits)
        encoder = cls(t, counts * (direction * TWO_PI / counts_per_turn), clock_offset_us)
        return encoder if index_t_us is None else encoder.with_index(index_t_us)

    @classmethod
    def from_command(
        cls, t_us: ArrayLike, command: ArrayLike, *, largest: float | None = None, clock_offset_us: float = 0.0
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
            Largest magnitude of the command, in its unit; by default that of the samples. Give the same one for all
            recordings and streams that share a calibration, because its amplitudes are those of this command.
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
        t, u = _command_samples(t_us, command)
        if len(u) < 2 or not np.ptp(u) > 0.0:
            raise AmiwarpError("command never changes; give the samples of a signal that moves")
        check_ascending(t, "encoder sample")
        return cls(*CommandAngles().take(t, u, float(np.abs(u).max()) if largest is None else largest, end=True),
                   clock_offset_us)  # fmt: skip

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
        check_direction(direction)
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

    def with_second(self, second: Encoder | float) -> Encoder:
        """Return an encoder of a pair of prisms: this one is that of the first prism, next to the camera.

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
            second = Encoder(self.t, self.angle * real(second, "speed of the second prism relative to the first"))
        return dataclasses.replace(self, second=second)

    def with_harmonics(self, harmonics: ArrayLike) -> Encoder:
        """Return an encoder whose angles are corrected by an error that repeats every turn.

        The error of an encoder disc or magnet that is off centre, or of a speed that ripples in each turn where the
        encoder has but an index pulse.

        Parameters
        ----------
        harmonics : array_like
            Factors of cos e, sin e, cos 2e and sin 2e in the correction of the angle e [rad], shape (4,). For a pair
            of prisms or a mirror, the same for the second angle may follow, shape (8,).

        Returns
        -------
        Encoder
            The encoder. Where its samples are further apart than 1/64 turn, samples are added between them.

        Raises
        ------
        AmiwarpError
            If there are not four finite numbers for one or both angles.

        Examples
        --------
        >>> encoder = amiwarp.Encoder.from_angles([0, 1000], [0.0, 1.5])
        >>> encoder.with_harmonics([0.0, 0.1, 0.0, 0.0]).angle_at([1000]).round(4)
        array([1.5997])
        """
        if self.second is not None and np.size(harmonics) == 8:
            first, second = np.split(np.ravel(harmonics), 2)
            return dataclasses.replace(self.with_harmonics(first), second=self.second.with_harmonics(second))
        factors = vector(harmonics, 4, "harmonics", real)
        given, angle = self.t, self.angle
        # added samples must not shorten the intervals by which the angle is extended at both ends
        for end, inner, reach in zip((0, -1), (1, -2), self._reach, strict=True):
            step = self.angle[end] - self.angle[inner]
            if abs(step) > LONGEST_BENT_STEP:
                added = int(reach) * (1 if end else -1)
                place = given.size if end else 0
                given = np.insert(given, place, self.t[end] + added)
                speed = step / (self.t[end] - self.t[inner])
                angle = np.insert(angle, place, self.angle[end] + added * speed)
        parts = np.ceil(np.abs(np.diff(angle)) / LONGEST_BENT_STEP).astype(np.int64)
        parts = np.clip(parts, 1, np.diff(given))
        first = np.repeat(np.arange(parts.size), parts)
        within = np.arange(first.size) - np.repeat(np.cumsum(parts) - parts, parts)
        t = np.append(given[first] + within * np.diff(given)[first] // parts[first], given[-1])
        angle = np.interp(t - given[0], given - given[0], angle)
        return dataclasses.replace(self, t=t, angle=angle + periodic(angle, factors))

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
        return first if self.second is None else np.stack([first, self.second.angle_at(t)], axis=-1)

    @property
    def ratio(self) -> float | None:
        """Mean speed of the second prism relative to the first; None for one prism."""
        return None if self.second is None else self.second.rpm / (self.rpm or math.inf)

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
        """First and last event time with an angle [us]: the samples, and one sample interval before and after.

        For a pair of prisms, both have an angle.
        """
        before, after = self._reach
        first, last = int(self.t[0]), int(self.t[-1])
        start, end = math.ceil(first - before - self.clock_offset_us), math.floor(last + after - self.clock_offset_us)
        if self.second is None:
            return start, end
        return max(start, self.second.coverage[0]), min(end, self.second.coverage[1])

    @property
    def _reach(self) -> tuple[float, float]:
        """Times by which the angle is extended before the first and after the last sample [us].

        If the first or last interval is a gap, that is the mean interval only.
        """
        ends = self.t[1] - self.t[0], self.t[-1] - self.t[-2]
        before, after = (min(float(end), self.interval_us) for end in ends)
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
        return float((self.angle[-1] - self.angle[0]) / TWO_PI * 60e6 / float(self.t[-1] - self.t[0]))

    def __repr__(self) -> str:
        index = "" if self.index_t is None else f", {len(self.index_t):,} index pulses"
        second = "" if self.second is None else f", second {self.second.rpm:.4g} rpm"
        offset = f", clock offset {self.clock_offset_us:.4g} us" if self.clock_offset_us else ""
        times = f"t {self.t[0]} .. {self.t[-1]} us"
        return f"Encoder({self.t.size:,} samples, {times}, {self.rpm:.4g} rpm{second}{index}{offset})"

    def _near(self, t: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the encoder times for event times ``t``, and the times and angles of the samples around them.

        All times are relative to the first of these samples. Only samples near ``t`` are used, so the cost does not
        depend on the recording's length.
        """
        times = _event_times(t)
        low, high = (int(times.min()), int(times.max())) if times.size else self.coverage
        if not self.covers(low, high):
            first, last = self.coverage
            raise AmiwarpError(
                f"events at {low} .. {high} us lie outside the encoder's {first} .. {last} us; give samples that cover "
                "them, or a window inside"
            )
        start = int(np.searchsorted(self.t, math.floor(low + self.clock_offset_us))) - 1
        start = min(max(start, 0), self.t.size - 2)
        stop = max(int(np.searchsorted(self.t, math.ceil(high + self.clock_offset_us))) + 1, start + 2)
        # Subtract as integers: float64 cannot represent fractions of microseconds in times since 1970.
        elapsed = np.subtract(times, self.t[start], out=np.empty(times.shape), dtype=np.int64)
        elapsed += self.clock_offset_us
        sampled = (self.t[start:stop] - self.t[start]).astype(np.float64)
        return elapsed, sampled, self.angle[start:stop]


def _event_times(t: ArrayLike) -> NDArray[np.int64]:
    """Return event times as int64 [us]. Times of :class:`Events` were checked before; others are checked here."""
    return t if type(t) is np.ndarray and t.dtype == np.int64 else as_times(t)


def _wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Wrap angles [rad] to -pi .. pi."""
    return np.asarray(angle - TWO_PI * np.round(angle / TWO_PI))


def check_prisms(encoder: Encoder | EncoderStream, angles: int) -> None:
    """Raise :class:`AmiwarpError` if an encoder is not that of a model with this number of angles."""
    if angles == 1 and encoder.second is not None:
        raise AmiwarpError(
            "the encoder is that of a pair of prisms, the model has one prism; use the model 'risley', or 'mirror'"
        )
    if angles == 2 and encoder.second is None:
        how = "Encoder.with_second, --second-encoder or --second-ratio of 'amiwarp convert'"
        if isinstance(encoder, EncoderStream):
            how = "EncoderStream(second=EncoderStream()) or EncoderStream(second=-0.5)"
        raise AmiwarpError(
            "the model has two prisms, the encoder measures one; add the other one's encoder, or its speed relative to "
            f"the first ({how})"
        )


# Angles of a command signal, for example of a mirror.


def _command_samples(t_us: ArrayLike, command: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return times and commands, of one length; raise :class:`AmiwarpError` for others, and if they are not finite."""
    t, u = as_times(t_us), array(command, "command").astype(np.float64)
    if u.shape != t.shape or t.ndim != 1:
        raise AmiwarpError(f"command has shape {u.shape}, its times {t.shape}; give one value for each time")
    if not np.isfinite(u).all():
        raise AmiwarpError(f"command is {u[~np.isfinite(u)][0]}, which is not finite; leave that sample out")
    return t, u


class CommandAngles:
    """Makes the angles of :meth:`Encoder.from_command` of a command that comes in parts.

    The angle of a sample depends on the direction of the command before and after it. The last sample of each part
    therefore waits for the next part.
    """

    def __init__(self) -> None:
        self._t, self._command = np.zeros(0, np.int64), np.zeros(0)
        """Time [us] and command of the sample that waits, if any."""
        self._before: tuple[int, bool] | None = None
        """Number of swings up to the interval before that sample, and whether the command rose in it."""

    @property
    def last(self) -> int | None:
        """Time of the latest sample [us]; None before the first."""
        return int(self._t[0]) if self._t.size else None

    def take(
        self, t: NDArray[np.int64], command: NDArray[np.float64], largest: float, *, end: bool = False
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Take samples with ascending times [us], shape (n,); return times and angles [rad] of those that are ready.

        ``largest``: largest magnitude of the command. ``end``: whether no part follows. Raises :class:`AmiwarpError`
        for a command beyond ``largest``.
        """
        largest = real(largest, "largest command")
        if not largest > 0.0:
            raise AmiwarpError(f"largest command is {largest:g}; give a number above 0")
        beyond = np.abs(command) > largest
        if beyond.any():
            raise AmiwarpError(
                f"command is {command[beyond][0]:g}, larger than the largest, {largest:g}; give the largest magnitude "
                "that the command ever takes"
            )
        t, u = np.concatenate([self._t, t]), np.concatenate([self._command, command])
        if t.size < 2:
            self._t, self._command = t, u
            return t[:0], u[:0]
        turns, rising = self._swings(u)
        first = self._before or (int(turns[0]), bool(rising[0]))
        kept = t.size if end else t.size - 1
        self._t, self._command, self._before = t[kept:], u[kept:], (int(turns[-1]), bool(rising[-1]))
        turns, rising = np.append(first[0], turns), np.append(first[1], rising)
        angle = np.arccos(u / largest)[:kept]

        def at(interval: slice) -> NDArray[np.float64]:
            turned = np.where(rising[interval][:kept], TWO_PI - angle, angle)
            return np.asarray(TWO_PI * turns[interval][:kept] + turned, np.float64)

        if end:
            turns, rising = np.append(turns, turns[-1]), np.append(rising, rising[-1])
        before, after = at(slice(None)), at(slice(1, None))
        jumps = after - before > LONGEST_TURN
        both = np.where(jumps, before, (before + after) / 2.0)
        times = np.concatenate([t[:kept], t[:kept][jumps] + 1])
        order = np.argsort(times, kind="stable")
        return times[order], np.concatenate([both, after[jumps]])[order]

    def _swings(self, command: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return for each interval between samples the number of swings so far, and whether the command rises in it."""
        turns, rose = self._before or (0, False)
        rises = np.sign(np.diff(command))
        moved = np.maximum.accumulate(np.where(rises != 0.0, np.arange(len(rises)), -1))
        rising = np.where(moved < 0, rose, rises[moved] > 0.0)  # a command that pauses keeps its direction
        peaks = np.append(rose, rising[:-1]) & ~rising
        return turns + np.cumsum(peaks), rising


# Speed of the prism during the events. It differs from the mean of all samples if the motor starts or stops.

LEAST_RPM = 1e-3
"""Speed up to which a prism counts as at rest [turns/min]."""


def rpm_between(encoder: Encoder, t_first: int, t_last: int) -> float:
    """Return the mean speed between two event times [turns/min], negative if the angle decreases.

    Only the part of the time [us] within :attr:`Encoder.coverage` counts; if there is none, all samples count.
    """
    first, last = max(t_first, encoder.coverage[0]), min(t_last, encoder.coverage[1])
    if first >= last:
        return encoder.rpm
    start, end = encoder.angle_at([first, last]).tolist()
    return float((end - start) / TWO_PI * 60e6 / (last - first))


def turn_between(encoder: Encoder, t_first: int, t_last: int) -> float | None:
    """Return the mean duration of a turn between two event times [us]; None if the prism is at rest."""
    rpm = abs(rpm_between(encoder, t_first, t_last))
    return 60e6 / rpm if rpm > LEAST_RPM else None


# Encoder samples of a live rig: a buffer of the latest samples, with extrapolation after the last one.

SAME_COMMAND = 1e-6
"""Largest change of the cosine of an angle, that is of the command, at a jump of a command's angle."""
RESTART_US = 1
"""Time between the extrapolated sample that ends the samples before a restart and the first sample after it [us]."""


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
        self._harmonics = None
        if harmonics is not None:
            both = second is not None and np.size(harmonics) == 8
            self._harmonics = vector(harmonics, 8 if both else 4, "harmonics", real)
        self.clock_offset_us = real(clock_offset_us, "clock_offset_us")
        self.second = _second_stream(second, self.clock_offset_us)
        """Stream of the second encoder, or the speed of the second prism relative to the first; None for one prism."""
        self.dropped = 0
        """Number of samples that were dropped because they were not later than the sample before them."""
        self.sure = True
        """Whether the clock of the samples is known. Until it is, all angles count as estimates."""
        self.cleared = 0
        """How many times :meth:`clear` was called, by which is known whether copies of samples are still good."""
        self._t, self._angle = np.zeros(2 * capacity, np.int64), np.zeros(2 * capacity, np.float64)
        self._stop = 0
        self._gaps: list[tuple[int, int]] = []
        self._restarted = False
        self._commands = CommandAngles()

    def __len__(self) -> int:
        return self._stop

    @property
    def _encoders(self) -> tuple[EncoderStream, ...]:
        """This stream, and that of the second encoder if there is one."""
        return (self, self.second) if isinstance(self.second, EncoderStream) else (self,)

    @property
    def _started(self) -> bool:
        """Whether each encoder has at least two samples."""
        return len(self) >= 2 and (not isinstance(self.second, EncoderStream) or len(self.second) >= 2)

    @property
    def first(self) -> int | None:
        """First event time with an angle [us]: one sample interval before the first sample.

        With two encoders, the first time with both angles. None while an encoder has fewer than two samples.
        """
        if not self._started:
            return None
        return max(math.ceil(int(2 * e._t[0] - e._t[1]) - self.clock_offset_us) for e in self._encoders)

    @property
    def last(self) -> int | None:
        """Last event time that the samples of all encoders cover [us].

        None while an encoder has fewer than two samples.
        """
        if not self._started:
            return None
        return min(math.floor(int(e._t[e._stop - 1]) - self.clock_offset_us) for e in self._encoders)

    def clear(self) -> None:
        """Forget all samples, for example because their times turned out to be on another clock.

        It applies to the second encoder too.
        """
        self.cleared += 1
        for each in self._encoders:
            each._stop, each._gaps = 0, []
            each._restarted, each._commands = False, CommandAngles()

    def restart(self) -> None:
        """Mark that later samples do not continue earlier samples, for example after a reset of the controller.

        It applies to the second encoder too.
        """
        for each in self._encoders:
            each._restarted, each._commands = len(each) > 0, CommandAngles()

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
        if not (good := np.abs(angles) <= LARGEST_ANGLE).all():
            raise AmiwarpError(
                f"encoder angle is {angles[~good][0]}; expected finite numbers within {LARGEST_ANGLE:g} rad of 0"
            )
        before = int(self._t[self._stop - 1]) if len(self) else -(2**62)
        later = _later(t, before)
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
        t, u = _command_samples(t_us, command)
        later = _later(t, self._commands.last)
        t, angle = self._commands.take(t[later], u[later], largest)
        self.dropped += int(np.count_nonzero(~later))
        return self.append(t, angle)

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
        """Speed of the first prism over the latest samples [turns/min], negative if the angle decreases.

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
        times, angles = self._t[: self._stop], self._angle[: self._stop]
        low = int(np.searchsorted(times, math.floor(t_first + self.clock_offset_us), side="right")) - 1
        low = min(max(low, 0), times.size - 2)
        end = math.ceil(t_last + self.clock_offset_us)
        high = min(max(int(np.searchsorted(times, end)) + 1, low + 2), times.size)
        t, angle = times[low:high].copy(), angles[low:high].copy()
        if end > t[-1]:
            t, angle = np.append(t, end + 1), np.append(angle, self._extrapolate(end + 1))
        encoder = Encoder(t, angle, self.clock_offset_us)
        if self.second is not None:
            second = self.second
            encoder = encoder.with_second(second.over(t_first, t_last) if isinstance(second, EncoderStream) else second)
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
            False if an angle of any prism would be extrapolated, or would lie in a gap.
        """
        return self._started and not any(low < t_last and t_first < high for low, high in self._estimated_spans())

    def _estimated_spans(self) -> Iterator[tuple[int, int]]:
        """Yield the spans of event times [us], ends excluded, in which an angle is extrapolated or in a gap."""
        if not self.sure:
            yield -(2**62), 2**62
        for e in self._encoders:
            yield -(2**62), math.ceil(int(e._t[0]) - self.clock_offset_us)
            for begin, end in e._gaps:
                yield math.floor(begin - self.clock_offset_us), math.ceil(end - self.clock_offset_us)
            yield math.floor(int(e._t[e._stop - 1]) - self.clock_offset_us), 2**62

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
        t = _event_times(t)
        if t.ndim != 1:
            raise AmiwarpError(f"t has shape {t.shape}; give shape (n,)")
        out = np.zeros(t.size, np.bool_)
        if not self._started or not t.size:
            return ~out
        for low, high in self._estimated_spans():
            if low < t[-1] and t[0] < high:
                out[int(np.searchsorted(t, low, side="right")) : int(np.searchsorted(t, high))] = True
        return out


def _later(t: NDArray[np.int64], before: int | None) -> NDArray[np.bool_]:
    """Return which times are later than ``before`` and than all times before them, shape (n,)."""
    return np.asarray(t > np.maximum.accumulate(np.append(-(2**62) if before is None else before, t))[:-1])


def _second_stream(second: EncoderStream | float | None, clock_offset_us: float) -> EncoderStream | float | None:
    """Return what describes the second angle of a stream; raise :class:`AmiwarpError` if it is unusable."""
    if second is None:
        return None
    if not isinstance(second, EncoderStream):
        return real(second, "speed of the second prism relative to the first", -LARGEST_RATIO, LARGEST_RATIO)
    if second.second is not None:
        raise AmiwarpError("the second encoder has a second one itself; a pair has two prisms")
    if second.clock_offset_us != clock_offset_us:
        raise AmiwarpError(
            f"the second encoder has a clock offset of {second.clock_offset_us:g} us, the first one of "
            f"{clock_offset_us:g} us; give both the same"
        )
    return second


def starts_of_runs(t: NDArray[np.int64], angle: NDArray[np.float64]) -> list[int]:
    """Return the indices of the first sample, and of those after a gap or a restart of an :class:`EncoderStream`.

    A gap is longer than :attr:`EncoderStream.GAP_US`, and than three usual intervals. ``t``: times [us], shape (n,).
    ``angle``: angles [rad], shape (n,).
    """
    steps, turned = np.diff(t), np.diff(angle)
    longest = max(EncoderStream.GAP_US, 3.0 * float(np.median(steps))) if steps.size else 0.0
    # the angle of a command jumps as fast as at a restart, but forwards, and its cosine stays
    jumps = (turned > LONGEST_TURN) & (turned <= TWO_PI) & (np.abs(np.diff(np.cos(angle))) < SAME_COMMAND)
    breaks = np.flatnonzero((steps > longest) | ((steps <= RESTART_US) & ~jumps))
    return [0, *(breaks + 1).tolist()]
