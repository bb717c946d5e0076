"""Two clocks: a 32-bit one made whole, and how one runs beside another, from common pulses or from round trips."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

WRAP = 1 << 32
FEWEST = 3
OUTLIER = 4.0
"""Robust standard deviations beyond which a pair is left out: a pulse that was taken for another."""
QUICK = 2.0
"""Round trips up to so many times the shortest tell the offset; in the longer ones something waited."""


def monotonic_us() -> int:
    """The host's clock [us]."""
    return time.monotonic_ns() // 1000


class Unwrapped:
    """A clock of 32 bits [us] as one that goes on."""

    def __init__(self) -> None:
        self.last: int | None = None
        """The latest so far [us]."""

    def ahead(self, t: int) -> int:
        """By how much a time is after the last [us], over a wrap too; negative for one that comes late."""
        return 0 if self.last is None else (t - self.last + WRAP // 2) % WRAP - WRAP // 2

    def __call__(self, t: int) -> int:
        """The time that is nearest to the last: forwards over a wrap, backwards for what comes late."""
        now = t if self.last is None else self.last + self.ahead(t)
        self.last = now if self.last is None else max(self.last, now)
        return now


@dataclass(frozen=True, slots=True)
class Clock:
    """Another clock beside one's own: other = own + offset + drift · (own − ``at_us``)."""

    at_us: int
    """Of one's own clock, in the middle of what it was found from."""
    offset_us: float
    """There."""
    drift: float
    """Relative: 1e-6 is a microsecond a second."""
    offset_std_us: float
    drift_std: float
    pairs: int
    """That agree with it."""

    def __call__(self, own_us: ArrayLike) -> NDArray[np.int64]:
        """The other clock's times [us], rounded."""
        own = np.asarray(own_us, np.int64)
        return own + np.rint(self.offset_us + self.drift * (own - self.at_us)).astype(np.int64)

    def std_us(self, own_us: float) -> float:
        """Standard deviation at a time of one's own clock [us]: it grows with the distance from :attr:`at_us`."""
        return math.hypot(self.offset_std_us, self.drift_std * (own_us - self.at_us))


def from_pulses(own_us: ArrayLike, other_us: ArrayLike, sigma_us: float = 1.0) -> Clock:
    """From pulses that both clocks saw, shape (n,) each [us]; ``sigma_us``: least deviation of a time stamp.

    A line by least squares, pairs further than :data:`OUTLIER` from it left out. Raises :class:`AmiwarpError` for under
    three pairs, or different numbers of them.
    """
    own, other = (np.asarray(t, np.int64) for t in (own_us, other_us))
    if own.shape != other.shape or own.ndim != 1 or len(own) < FEWEST:
        raise AmiwarpError(f"{own.size} and {other.size} pulses; give {FEWEST} or more that both clocks saw")
    return _line(own, other, np.full(len(own), sigma_us))


def from_round_trips(sent_us: ArrayLike, other_us: ArrayLike, received_us: ArrayLike) -> Clock:
    """From questions sent and answered, own time of both, the other's between, shape (n,) each [us].

    The answer was somewhere between: its middle, uncertain by half of the way (uniform). Raises :class:`AmiwarpError`
    for under three, or an answer before its question.
    """
    sent, other, received = (np.asarray(t, np.int64) for t in (sent_us, other_us, received_us))
    way = (received - sent).astype(np.float64)
    if len(way) < FEWEST or (way < 0).any():
        raise AmiwarpError(f"{len(way)} round trips, the shortest {way.min(initial=0.0):g} us; give {FEWEST} or more")
    quick = way <= max(QUICK * way.min(), np.partition(way, FEWEST - 1)[FEWEST - 1])
    middle = sent + (received - sent) // 2
    return _line(middle[quick], other[quick], np.maximum(way[quick], 1.0) / math.sqrt(12.0))


def _line(own: NDArray[np.int64], other: NDArray[np.int64], sigma: NDArray[np.float64]) -> Clock:
    ahead = (other - own).astype(np.float64)
    kept = np.ones(len(own), np.bool_)
    for _ in range(10):
        at = int(np.rint(np.average(own[kept] - own[0], weights=sigma[kept] ** -2.0))) + int(own[0])
        x = (own - at).astype(np.float64)
        base = float(np.median(ahead[kept]))
        weight = sigma[kept] ** -2.0
        slope_weight = float(np.sum(weight * x[kept] ** 2))
        offset = float(np.average(ahead[kept] - base, weights=weight))
        drift = float(np.sum(weight * x[kept] * (ahead[kept] - base - offset)) / max(slope_weight, 1e-300))
        left = (ahead - base - offset - drift * x) / sigma
        spread = max(1.0, 1.4826 * float(np.median(np.abs(left[kept]))))
        again = np.abs(left) <= OUTLIER * spread
        if again.sum() < FEWEST or np.array_equal(again, kept):
            break
        kept = again
    scale = max(1.0, math.sqrt(float(np.mean(left[kept] ** 2))))
    std = scale / math.sqrt(float(np.sum(weight)))
    return Clock(at, base + offset, drift, std, scale / math.sqrt(max(slope_weight, 1e-300)), int(kept.sum()))
