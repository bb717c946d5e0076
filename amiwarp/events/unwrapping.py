"""Unwrap an encoder's counts and angles: find the period at which they wrap, and refuse samples that do not tell it.

A step between neighbouring samples is compared with the one that the speed just before predicts. At the right period
the two agree at every wrap; a period that is wrong by more than the noise shows in their mean difference.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

WIDTHS = tuple(range(8, 33))
"""Widths of hardware counters that are recognised [bits]."""
WIDEST = 64
ONCE_A_TURN = 0
"""As a counter's width: it starts anew each turn."""
SHORTEST_PERIOD = 3
"""Of a counter that wraps [counts]: with fewer states the direction cannot be seen."""
BEFORE = 5
"""Steps whose median speed predicts the next."""
FEWEST_SAMPLES = 20
"""From fewer, no width of a counter is found: a swinging prism could make the same counts."""
GAP = 3.0
"""Intervals longer than this multiple of the typical one are gaps."""
LARGEST_SURPRISE = 0.25
"""Of the period: a step that differs from its prediction by more could belong to another number of wraps."""
CLEARLY = 3.0
"""Factor by which the differences from the prediction must be smaller for one period than without it."""
GRAIN = 2.0
"""Difference from the prediction that rounding to whole counts explains [counts]."""
GRAIN_TURNS = 1.0 / 64.0
"""The same of angles [turns]."""


class UnwrapError(AmiwarpError):
    """Samples that cannot be unwrapped: ``sample`` is the first that shows it, ``problem`` says why."""

    sample: int = 0
    problem: str = ""

    @classmethod
    def at(cls, sample: int, problem: str) -> UnwrapError:
        """The error of one sample."""
        error = cls(f"encoder sample {sample}: {problem}")
        error.sample, error.problem = sample, problem
        return error


@dataclass(frozen=True)
class _Steps:
    """Steps between neighbouring samples, unwrapped by one period."""

    period: float
    """0: not unwrapped."""
    step: NDArray[np.float64]
    wraps: NDArray[np.float64]
    """Periods added to each step."""
    expected: NDArray[np.float64]
    """Each step as the speed before predicts it."""

    @property
    def off(self) -> NDArray[np.float64]:
        """Each step less its prediction."""
        return np.asarray(self.step - self.expected)

    @property
    def surprise(self) -> float:
        """Sum of the differences from the prediction."""
        return float(np.abs(self.off).sum())


@dataclass(frozen=True)
class _Log:
    """Samples to unwrap, with the words for their errors."""

    t: NDArray[np.int64]
    value: NDArray[np.float64]
    turn: float
    """One turn in the values' unit."""
    grain: float
    noun: str
    unit: float
    """The values' unit over that of messages."""
    remedy: str

    @property
    def interval(self) -> NDArray[np.float64]:
        return np.diff(self.t).astype(np.float64)

    @property
    def gap(self) -> NDArray[np.bool_]:
        """Which intervals are gaps."""
        return np.asarray(self.interval > GAP * np.median(self.interval))

    def shown(self, value: float) -> str:
        """A value in the unit of messages."""
        return f"{value * self.unit:,.6g}"

    def steps(self, period: float) -> _Steps:
        """Steps unwrapped by ``period``: each the one nearest to what the median speed predicts."""
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
    """Unwrap counts that run on, start anew each turn, or wrap at the width of a hardware counter.

    ``counter_bits``: that width; 0 for a counter that starts anew each turn; None to find it in the samples.
    Raises :class:`UnwrapError` for samples from which the rotation cannot be told.
    """
    remedy = "give the counter's width as counter_bits (--counter-bits; 0: it starts anew each turn)"
    log = _Log(t, count, float(counts_per_turn), GRAIN, "count", 1.0, remedy)
    if counter_bits is not None and counter_bits != ONCE_A_TURN and not WIDTHS[0] <= counter_bits <= WIDEST:
        raise AmiwarpError(f"counter_bits = {counter_bits}; give {WIDTHS[0]} to {WIDEST}, or 0 for one turn")
    if not _can_wrap(log):
        return count
    if counter_bits is None:
        return _accumulate(log, _find(log, _count_periods(log)))
    period = float(counts_per_turn if counter_bits == ONCE_A_TURN else 2**counter_bits)
    if not _fits(count, period, signed=counter_bits != ONCE_A_TURN):
        low, high = int(np.argmin(count)), int(np.argmax(count))
        what = f"counts {log.shown(count[low])} .. {log.shown(count[high])} do not fit in {_named(log, period)}"
        raise UnwrapError.at(max(low, high), f"{what}; {log.remedy}")
    return _accumulate(log, _checked(log, log.steps(period)))


def unwrap_angles(t: NDArray[np.int64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unwrap angles [rad] that run on, or wrap at a turn or at a whole number of turns.

    Raises :class:`UnwrapError` for samples from which the rotation cannot be told.
    """
    turn = 2.0 * math.pi
    remedy = "sample the encoder more often, or unwrap the angles beforehand"
    log = _Log(t, angle, turn, GRAIN_TURNS * turn, "angle", 180.0 / math.pi, remedy)
    if not _can_wrap(log):
        return angle
    turns = {1, max(1, round(float(np.abs(log.steps(0.0).off).max()) / turn))}
    return _accumulate(log, _find(log, [k * turn for k in turns if np.ptp(angle) <= k * turn * (1.0 + 1e-9)]))


def expected_steps(step: NDArray[np.float64], interval: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each step as the median speed of the steps before predicts it, or, for the first ones, of those after."""
    speed = step / interval
    n = speed.size
    if n < 2 * BEFORE:
        others = [np.median(np.delete(speed, k)) if n > 1 else speed[0] for k in range(n)]
        return np.asarray(np.array(others) * interval)
    from scipy.ndimage import median_filter

    middle = median_filter(speed, size=BEFORE, mode="nearest")
    away = BEFORE // 2 + 1
    at = np.arange(n)
    return np.asarray(middle[np.where(at < BEFORE, at + away, at - away)] * interval)


def _can_wrap(log: _Log) -> bool:
    """Whether there is a step to judge; raises for shapes that differ and values that are not finite."""
    if log.value.shape != log.t.shape or log.value.ndim != 1:
        raise AmiwarpError(f"encoder t has shape {log.t.shape}, its values {log.value.shape}; expected one length")
    if not np.isfinite(log.value).all():
        at = int(np.argmin(np.isfinite(log.value)))
        raise AmiwarpError(f"encoder sample {at} is {log.value[at]}; expected a finite number")
    # samples out of order are named by Encoder's own check
    return log.value.size > 1 and bool((log.interval > 0).all())


def _count_periods(log: _Log) -> Iterator[float]:
    """Periods that the range of the counts allows."""
    if log.turn >= SHORTEST_PERIOD and np.ptp(log.value) <= log.turn:
        yield log.turn
    yield from (2.0**bits for bits in WIDTHS if _fits(log.value, 2.0**bits, signed=True))


def _fits(count: NDArray[np.float64], period: float, *, signed: bool) -> bool:
    low, high = float(count.min()), float(count.max())
    if not signed:
        return high - low <= period
    return (low >= 0.0 and high < period) or (low >= -period / 2.0 and high < period / 2.0)


def _named(log: _Log, period: float) -> str:
    if period == log.turn:
        return "one turn"
    bits = math.log2(period)
    return f"{bits:.0f} bits" if log.noun == "count" and bits.is_integer() else f"{period / log.turn:.6g} turns"


def _find(log: _Log, periods: Iterable[float]) -> _Steps:
    """The steps under the one period that agrees with them; as they are if nothing wraps."""
    plain = log.steps(0.0)
    wrapped = [found for found in map(log.steps, sorted({*periods})) if found.wraps.any()]
    best = min([plain, *wrapped], key=lambda found: found.surprise)
    if best is not plain:
        at = best.wraps != 0.0
        few = best.period % log.turn and log.value.size < FEWEST_SAMPLES
        if few or not np.abs(plain.off[at]).sum() > CLEARLY * np.abs(best.off[at]).sum() + log.grain:
            raise UnwrapError.at(int(np.argmax(at)) + 1, _maybe(log, best))
        _check_period(log, best, [found.period for found in wrapped])
        return _checked(log, best)
    rival = next((found for found in wrapped if found.surprise <= CLEARLY * plain.surprise + log.grain), None)
    if rival is not None:
        at = int(np.argmax(rival.wraps != 0.0)) + 1
        raise UnwrapError.at(at, _maybe(log, rival))
    # a wrap leads from one end of the range to the other; a step of the prism does not
    least = min(log.turn, 2.0 ** WIDTHS[0]) / 2.0
    plausible = np.maximum(max(0.5 * float(np.ptp(log.value)), least), np.where(log.gap, np.abs(plain.expected), 0.0))
    jump = np.abs(plain.off) > plausible
    if jump.any():
        at = int(np.argmax(jump))
        raise UnwrapError.at(at + 1, f"{_jump(log, plain, at)}, at no known period; {log.remedy}")
    return plain


def _maybe(log: _Log, found: _Steps) -> str:
    return f"the {log.noun} may have wrapped here, at {_named(log, found.period)}, or not; {log.remedy}"


def _jump(log: _Log, found: _Steps, at: int) -> str:
    step, expected = log.shown(float(found.step[at])), log.shown(float(found.expected[at]))
    return f"the {log.noun} changes by {step} where about {expected} was expected"


def _check_period(log: _Log, best: _Steps, periods: list[float]) -> None:
    """Refuse a period that the mean difference at the wraps contradicts, or does not tell from another."""
    if best.period < 8.0 * log.grain:
        return
    many = float((best.wraps**2).sum())
    error = float((best.wraps * best.off).sum()) / many
    scatter = float(np.sqrt(np.mean((best.off - error * best.wraps) ** 2)))
    # the rounding of the speed adds up over a gap
    grain = log.grain * np.maximum(1.0, log.interval / np.median(log.interval))
    tolerance = float((np.abs(best.wraps) * grain).sum()) / many + 3.0 * scatter / math.sqrt(many)
    at = int(np.argmax(best.wraps != 0.0)) + 1
    seen = best.period - error
    if abs(error) > tolerance or tolerance > LARGEST_SURPRISE * best.period:
        what = f"the {log.noun} wraps by about {log.shown(seen)}, which is no known period"
        raise UnwrapError.at(at, f"{what}; {log.remedy}")
    others = [p for p in periods if p != best.period and abs(p - seen) <= 2.0 * tolerance]
    if others:
        what = f"the {log.noun} may wrap at {log.shown(best.period)} or at {log.shown(others[0])}"
        raise UnwrapError.at(at, f"{what}; {log.remedy}")


def _checked(log: _Log, found: _Steps) -> _Steps:
    """Refuse steps that could as well belong to another number of wraps.

    Whole turns more or less in a gap change no angle outside of it, so gaps are bridged by the speed if the period is
    a whole number of turns.
    """
    whole = found.period % log.turn == 0.0 or log.noun == "angle"
    judged = ~log.gap if whole else np.ones_like(log.gap)
    most = max(LARGEST_SURPRISE * found.period, min(1.0, log.grain))
    bad = judged & ((np.abs(found.off) > most) | (np.abs(found.off) >= 0.5 * found.period))
    if bad.any():
        at = int(np.argmax(bad))
        raise UnwrapError.at(at + 1, f"{_jump(log, found, at)}, wrapping at {_named(log, found.period)}; {log.remedy}")
    slow = judged & (np.abs(found.expected) >= 0.5 * found.period)
    if slow.any() and not whole:
        at = int(np.argmax(slow))
        what = f"the counter of {_named(log, found.period)} may have wrapped more than once"
        raise UnwrapError.at(
            at + 1, f"{what} in the {log.interval[at] / 1e3:.6g} ms since the sample before; sample it more often"
        )
    return found


def _accumulate(log: _Log, found: _Steps) -> NDArray[np.float64]:
    if not found.wraps.any():
        return log.value
    # whole periods added to the samples themselves: no rounding adds up
    return np.asarray(log.value + found.period * np.concatenate([[0.0], np.cumsum(found.wraps)]))
