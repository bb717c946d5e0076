"""Unwrap an encoder's counts and angles: find the period at which they wrap, and reject ambiguous samples.

Each step between neighbouring samples is compared with the step that the preceding speed predicts. The difference is
the step's residual. With the right period the residuals are small at every wrap. A period that is wrong by more than
the noise shows in the mean residual at the wraps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

Vector = NDArray[np.float64]

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
        error.sample = sample
        error.problem = problem
        return error


@dataclass(frozen=True)
class _Steps:
    """Steps between neighbouring encoder samples, unwrapped at one period."""

    period: float
    """Period at which the values wrap, in the samples' unit; 0 without unwrapping."""
    step: Vector
    """Unwrapped steps, in the samples' unit, shape ``(m - 1,)``."""
    wraps: Vector
    """Number of periods added to each step, shape ``(m - 1,)``."""
    expected: Vector
    """Steps that the preceding speed predicts, in the samples' unit, shape ``(m - 1,)``."""

    @property
    def residual(self) -> Vector:
        """Difference of each step from its prediction, in the samples' unit."""
        return np.asarray(self.step - self.expected)

    @property
    def cost(self) -> float:
        """Sum of the absolute differences between steps and their predictions."""
        return float(np.abs(self.residual).sum())

    @property
    def first_wrap(self) -> int:
        """Index of the first sample after a wrap."""
        return int(np.argmax(self.wraps != 0.0)) + 1


@dataclass(frozen=True)
class _Samples:
    """Encoder samples to unwrap, with the words that describe them in error messages."""

    t: NDArray[np.int64]
    """Times of the samples [us], shape ``(m,)``."""
    value: Vector
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
    def interval(self) -> Vector:
        """Times between neighbouring samples [us], shape ``(m - 1,)``."""
        return np.diff(self.t).astype(np.float64)

    @property
    def gap(self) -> NDArray[np.bool_]:
        """Whether each interval between samples is a gap."""
        return np.asarray(self.interval > GAP * np.median(self.interval))

    def in_words(self, value: float) -> str:
        """Format a value in the unit of error messages."""
        return f"{value * self.unit:,.6g}"

    def steps(self, period: float) -> _Steps:
        """Return the steps unwrapped at ``period``: each nearest to its prediction from the median speed."""
        interval = self.interval
        raw = np.diff(self.value)
        if not period:
            no_wraps = np.zeros_like(raw)
            return _Steps(period, raw, no_wraps, expected_steps(raw, interval))
        near = raw - period * np.round(raw / period)
        steady = np.median(near / interval) * interval
        step = near + period * np.round((steady - near) / period)
        wraps = np.round((step - raw) / period)
        return _Steps(period, step, wraps, expected_steps(step, interval))


def check_direction(direction: int) -> None:
    """Raise :class:`AmiwarpError` if a direction is neither 1 nor -1."""
    if direction not in (1, -1):
        raise AmiwarpError(f"direction = {direction}; expected 1 or -1")


def unwrap_counts(
    t: NDArray[np.int64],
    count: Vector,
    counts_per_turn: int,
    counter_bits: int | None = None,
) -> Vector:
    """Return unwrapped counts. The counter may keep counting, restart each turn, or wrap at its width.

    ``counter_bits`` is that width, 0 for a counter that restarts each turn, or None to find it from the samples.
    Raises :class:`UnwrapError` for samples that do not determine the rotation.
    """
    samples = _Samples(
        t=t,
        value=count,
        turn=float(counts_per_turn),
        rounding=ROUNDING_COUNTS,
        noun="count",
        unit=1.0,
        remedy="give the counter's width as counter_bits (--counter-bits; 0 if it restarts each turn)",
    )
    once_a_turn = counter_bits == ONCE_A_TURN
    if counter_bits is not None and not once_a_turn and not WIDTHS[0] <= counter_bits <= WIDEST:
        raise AmiwarpError(
            f"counter_bits = {counter_bits}; give {WIDTHS[0]} to {WIDEST}, or 0 for one turn"
        )
    if not _can_wrap(samples):
        return count
    if counter_bits is None:
        return _accumulate(samples, _find(samples, _count_periods(samples)))
    period = float(counts_per_turn if once_a_turn else 2**counter_bits)
    if not _fits(count, period, signed=not once_a_turn):
        low = int(np.argmin(count))
        high = int(np.argmax(count))
        span = f"counts {samples.in_words(count[low])} .. {samples.in_words(count[high])}"
        what = f"{span} do not fit in {_period_name(samples, period)}"
        raise UnwrapError.at(max(low, high), f"{what}; {samples.remedy}")
    steps = _checked(samples, samples.steps(period))
    return _accumulate(samples, steps)


def unwrap_angles(t: NDArray[np.int64], angle: Vector) -> Vector:
    """Return unwrapped angles [rad]. The angles may be unwrapped already, or wrap at a whole number of turns.

    Raises :class:`UnwrapError` for samples that do not determine the rotation.
    """
    turn = 2.0 * math.pi
    samples = _Samples(
        t=t,
        value=angle,
        turn=turn,
        rounding=ROUNDING_TURNS * turn,
        noun="angle",
        unit=180.0 / math.pi,
        remedy="sample the encoder more often, or unwrap the angles beforehand",
    )
    if not _can_wrap(samples):
        return angle
    # A wrap is a jump by the period. So the largest residual tells how many turns a period may have.
    plain = samples.steps(0.0)
    largest_jump = float(np.abs(plain.residual).max())
    periods = []
    for turns in {1, max(1, round(largest_jump / turn))}:
        period = turns * turn
        if np.ptp(angle) <= period * (1.0 + 1e-9):
            periods.append(period)
    return _accumulate(samples, _find(samples, periods))


def expected_steps(step: Vector, interval: Vector) -> Vector:
    """Return the steps predicted by the median speed of preceding steps, or of following ones at the start."""
    speed = step / interval
    steps = speed.size
    if steps == 1:
        return np.asarray(speed * interval)
    if steps < 2 * SPEED_STEPS:
        others = [np.median(np.delete(speed, k)) for k in range(steps)]
        return np.asarray(np.array(others) * interval)
    from scipy.ndimage import median_filter

    # The filter's median lies in the middle of its steps: take it so far away that they all precede, or follow.
    median = median_filter(speed, size=SPEED_STEPS, mode="nearest")
    away = SPEED_STEPS // 2 + 1
    place = np.arange(steps)
    middle = np.where(place < SPEED_STEPS, place + away, place - away)
    return np.asarray(median[middle] * interval)


def _can_wrap(samples: _Samples) -> bool:
    """Return whether there is a step to unwrap. Raises :class:`AmiwarpError` for bad shapes and values."""
    values = samples.value
    if values.shape != samples.t.shape or values.ndim != 1:
        raise AmiwarpError(
            f"encoder t has shape {samples.t.shape}, its values {values.shape}; expected one length"
        )
    finite = np.isfinite(values)
    if not finite.all():
        index = int(np.argmin(finite))
        raise AmiwarpError(f"encoder sample {index} is {values[index]}; expected a finite number")
    # Encoder checks the order of the samples itself.
    rises = (samples.interval > 0).all()
    return values.size > 1 and bool(rises)


def _count_periods(samples: _Samples) -> Iterator[float]:
    """Yield the periods at which counts in the given range can wrap."""
    if samples.turn >= SHORTEST_PERIOD and np.ptp(samples.value) <= samples.turn:
        yield samples.turn
    for bits in WIDTHS:
        if _fits(samples.value, 2.0**bits, signed=True):
            yield 2.0**bits


def _fits(count: Vector, period: float, *, signed: bool) -> bool:
    """Return whether the range of the counts fits into a period of the counter."""
    low = float(count.min())
    high = float(count.max())
    if not signed:
        return high - low <= period
    unsigned_fits = low >= 0.0 and high < period
    signed_fits = low >= -period / 2.0 and high < period / 2.0
    return unsigned_fits or signed_fits


def _period_name(samples: _Samples, period: float) -> str:
    """Return a name for a period, for error messages."""
    if period == samples.turn:
        return "one turn"
    bits = math.log2(period)
    if samples.noun == "count" and bits.is_integer():
        return f"{bits:.0f} bits"
    return f"{period / samples.turn:.6g} turns"


def _find(samples: _Samples, periods: Iterable[float]) -> _Steps:
    """Return the steps unwrapped at the only period that fits, or the plain steps if nothing wraps."""
    plain = samples.steps(0.0)
    wrapped = []
    for period in sorted(set(periods)):
        steps = samples.steps(period)
        if steps.wraps.any():
            wrapped.append(steps)
    best = min([plain, *wrapped], key=lambda steps: steps.cost)
    if best is not plain:
        _check_decisive(samples, best, plain)
        _check_period(samples, best, [steps.period for steps in wrapped])
        return _checked(samples, best)
    for rival in wrapped:
        if rival.cost <= DECISIVE_RATIO * plain.cost + samples.rounding:
            raise UnwrapError.at(rival.first_wrap, _ambiguous(samples, rival))
    _check_no_jump(samples, plain)
    return plain


def _check_decisive(samples: _Samples, best: _Steps, plain: _Steps) -> None:
    """Raise :class:`UnwrapError` if the wraps do not make the steps much better predictable."""
    wraps = best.wraps != 0.0
    few = samples.noun == "count" and samples.value.size < FEWEST_SAMPLES
    plain_cost = np.abs(plain.residual[wraps]).sum()
    best_cost = np.abs(best.residual[wraps]).sum()
    if few or not plain_cost > DECISIVE_RATIO * best_cost + samples.rounding:
        raise UnwrapError.at(best.first_wrap, _ambiguous(samples, best))


def _check_no_jump(samples: _Samples, plain: _Steps) -> None:
    """Raise :class:`UnwrapError` if values that wrap at no known period jump.

    A wrap jumps from one end of the range to the other. A step of the prism does not.
    """
    least = min(samples.turn, 2.0 ** WIDTHS[0]) / 2.0
    span = float(np.ptp(samples.value))
    largest = max(0.5 * span, least)
    over_gaps = np.where(samples.gap, np.abs(plain.expected), 0.0)
    jump = np.abs(plain.residual) > np.maximum(largest, over_gaps)
    if jump.any():
        index = int(np.argmax(jump))
        what = f"{_jump(samples, plain, index)}, at no known period"
        raise UnwrapError.at(index + 1, f"{what}; {samples.remedy}")


def _ambiguous(samples: _Samples, steps: _Steps) -> str:
    """Return the problem, for an error message, of a wrap that is neither certain nor excluded."""
    period = _period_name(samples, steps.period)
    return f"the {samples.noun} may have wrapped here, at {period}, or not; {samples.remedy}"


def _jump(samples: _Samples, steps: _Steps, index: int) -> str:
    """Return the problem, for an error message, of a step that differs from its prediction."""
    step = samples.in_words(float(steps.step[index]))
    expected = samples.in_words(float(steps.expected[index]))
    return f"the {samples.noun} changes by {step} where about {expected} was expected"


def _check_period(samples: _Samples, best: _Steps, periods: list[float]) -> None:
    """Raise :class:`UnwrapError` if the wraps contradict the period, or cannot distinguish it from another one."""
    if best.period < 8.0 * samples.rounding:
        return
    # By how much the period is wrong, from the residuals of the steps that wrap.
    weight = float((best.wraps**2).sum())
    error = float((best.wraps * best.residual).sum()) / weight
    unexplained = best.residual - error * best.wraps
    scatter = float(np.sqrt(np.mean(unexplained**2)))
    # The rounding of the speed accumulates over a gap.
    relative_interval = samples.interval / np.median(samples.interval)
    rounding = samples.rounding * np.maximum(1.0, relative_interval)
    of_rounding = float((np.abs(best.wraps) * rounding).sum()) / weight
    tolerance = of_rounding + 3.0 * scatter / math.sqrt(weight)

    index = best.first_wrap
    observed = best.period - error
    if abs(error) > tolerance or tolerance > LARGEST_RESIDUAL * best.period:
        what = f"the {samples.noun} wraps by about {samples.in_words(observed)}, which is no known period"
        raise UnwrapError.at(index, f"{what}; {samples.remedy}")
    for other in periods:
        if other != best.period and abs(other - observed) <= 2.0 * tolerance:
            either = f"{samples.in_words(best.period)} or at {samples.in_words(other)}"
            what = f"the {samples.noun} may wrap at {either}"
            raise UnwrapError.at(index, f"{what}; {samples.remedy}")


def _checked(samples: _Samples, steps: _Steps) -> _Steps:
    """Return the steps unchanged; raise :class:`UnwrapError` if a step fits another number of wraps as well.

    If the period is a whole number of turns, steps in gaps are not checked: additional turns in a gap change no angle
    outside it.
    """
    whole_turns = steps.period % samples.turn == 0.0 or samples.noun == "angle"
    checked = ~samples.gap if whole_turns else np.ones_like(samples.gap)

    largest = max(LARGEST_RESIDUAL * steps.period, min(1.0, samples.rounding))
    distance = np.abs(steps.residual)
    bad = checked & ((distance > largest) | (distance >= 0.5 * steps.period))
    if bad.any():
        index = int(np.argmax(bad))
        what = f"{_jump(samples, steps, index)}, wrapping at {_period_name(samples, steps.period)}"
        raise UnwrapError.at(index + 1, f"{what}; {samples.remedy}")

    fast = checked & (np.abs(steps.expected) >= 0.5 * steps.period)
    if fast.any() and not whole_turns:
        index = int(np.argmax(fast))
        counter = f"the counter of {_period_name(samples, steps.period)}"
        time = f"{samples.interval[index] / 1e3:.6g} ms since the sample before"
        what = f"{counter} may have wrapped more than once in the {time}"
        raise UnwrapError.at(index + 1, f"{what}; sample it more often")
    return steps


def _accumulate(samples: _Samples, steps: _Steps) -> Vector:
    """Return the unwrapped values of all samples, summed from the wraps."""
    if not steps.wraps.any():
        return samples.value
    # Whole periods are added to the samples themselves, so that rounding does not accumulate.
    periods = np.concatenate([[0.0], np.cumsum(steps.wraps)])
    return np.asarray(samples.value + steps.period * periods)
