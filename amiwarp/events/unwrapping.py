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

WIDTHS = tuple(range(8, 33))
"""Widths of hardware counters that are recognised automatically in encoder counts [bits]."""
WIDEST = 64
"""Largest width of a hardware counter that a caller may give [bits]."""
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
