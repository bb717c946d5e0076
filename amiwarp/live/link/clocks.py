"""Clocks: unwrapping of a 32-bit clock, and linear maps between two clocks.

A map is fitted to pulses that both clocks recorded, or to round trips of messages.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError

WRAP = 1 << 32
"""Period of the controller's 32-bit clock [us]."""
MOST_ROUNDS = 10
"""Largest number of fits, each without the outliers of the one before."""
FEWEST_PAIRS = 3
"""Smallest number of pairs of times to which a clock map is fitted."""
OUTLIER_STD = 4.0
"""Distance from the fitted line beyond which a pair of times is rejected [robust standard deviations]. Such a pair may
combine two different pulses."""
SHORT_TRIP = 2.0
"""Longest used round trip, as a multiple of the shortest one. The messages of longer round trips were delayed."""


def monotonic_us() -> int:
    """Return the time of the host's monotonic clock [us]."""
    return time.monotonic_ns() // 1000


class UnwrappedClock:
    """Converts the times of a 32-bit clock [us] to times without wrap."""

    def __init__(self) -> None:
        self.last: int | None = None
        """Latest unwrapped time so far [us]."""

    def difference(self, t: int) -> int:
        """Return the signed distance from the latest time to ``t`` [us], across a wrap if that is shorter."""
        return 0 if self.last is None else (t - self.last + WRAP // 2) % WRAP - WRAP // 2

    def __call__(self, t: int) -> int:
        """Return the unwrapped time of ``t`` that is closest to the latest one; it may be earlier [us]."""
        now = t if self.last is None else self.last + self.difference(t)
        self.last = now if self.last is None else max(self.last, now)
        return now


@dataclass(frozen=True, slots=True)
class ClockMap:
    """Linear map from one clock ("own") to another one: other = own + offset + drift · (own − ``at_us``)."""

    at_us: int
    """Reference time of the map on the own clock [us]: the mean time of the fitted pairs."""
    offset_us: float
    """Time of the other clock minus time of the own clock at :attr:`at_us` [us]."""
    drift: float
    """Relative difference between the rates of the clocks: 1e-6 is one microsecond per second."""
    offset_std_us: float
    """Standard deviation of the offset at :attr:`at_us` [us]."""
    drift_std: float
    """Standard deviation of the relative rate difference."""
    pairs: int
    """Number of pairs used by the fit, outliers excluded."""

    def __call__(self, own_us: ArrayLike) -> NDArray[np.int64]:
        """Return the other clock's times for times ``own_us`` of the own clock [us], rounded, same shape."""
        own_pulses = np.asarray(own_us, np.int64)
        return own_pulses + np.rint(self.offset_us + self.drift * (own_pulses - self.at_us)).astype(
            np.int64
        )

    def inverse(self, other_us: float) -> float:
        """Return the own clock's time for a time of the other clock [us]."""
        return self.at_us + (other_us - self.offset_us - self.at_us) / (1.0 + self.drift)


def fit_to_pulses(own_us: ArrayLike, other_us: ArrayLike, sigma_us: float = 1.0) -> ClockMap:
    """Fit a clock map to pulses that both clocks recorded.

    ``own_us``, ``other_us``: times of the same pulses [us], shape ``(n,)`` each. ``sigma_us``: smallest standard
    deviation of a time stamp. The fit is a least-squares line without pairs beyond :data:`OUTLIER_STD`. Raises
    :class:`AmiwarpError` for fewer than three pairs, or different lengths.
    """
    own_pulses = np.asarray(own_us, np.int64)
    other = np.asarray(other_us, np.int64)
    if own_pulses.shape != other.shape or own_pulses.ndim != 1 or len(own_pulses) < FEWEST_PAIRS:
        expected = f"give the times of the same pulses on both clocks, at least {FEWEST_PAIRS}"
        raise AmiwarpError(f"clock map: {own_pulses.size} and {other.size} pulses; {expected}")
    return _fit_line(own_pulses, other, np.full(len(own_pulses), sigma_us))


def fit_to_round_trips(sent_us: ArrayLike, other_us: ArrayLike, received_us: ArrayLike) -> ClockMap:
    """Fit a clock map to requests and their answers.

    ``sent_us``, ``received_us``: own times of request and answer [us]; ``other_us``: time in the answer on the other
    clock [us]; shape ``(n,)`` each. An answer is placed at the middle of its round trip; its error is uniform over the
    round trip. Raises :class:`AmiwarpError` for fewer than three round trips, or an answer before its request.
    """
    sent = np.asarray(sent_us, np.int64)
    other = np.asarray(other_us, np.int64)
    received = np.asarray(received_us, np.int64)
    duration = (received - sent).astype(np.float64)
    if len(duration) < FEWEST_PAIRS or (duration < 0).any():
        shortest = duration.min(initial=0.0)
        raise AmiwarpError(
            f"{len(duration)} round trips, the shortest {shortest:g} us; give {FEWEST_PAIRS} or more, none negative"
        )
    # The short round trips, or the three shortest.
    third_shortest = np.partition(duration, FEWEST_PAIRS - 1)[FEWEST_PAIRS - 1]
    short = duration <= max(SHORT_TRIP * duration.min(), third_shortest)
    middle = sent + (received - sent) // 2
    sigma = np.maximum(duration[short], 1.0) / math.sqrt(12.0)  # of a uniform error
    return _fit_line(middle[short], other[short], sigma)


def _fit_line(
    own_pulses: NDArray[np.int64], other: NDArray[np.int64], sigma: NDArray[np.float64]
) -> ClockMap:
    """Fit a line to pairs of times, weighted by ``sigma`` [us], and reject outliers iteratively."""
    difference = (other - own_pulses).astype(np.float64)
    kept = np.ones(len(own_pulses), np.bool_)
    for rounds in range(MOST_ROUNDS):
        # A weighted least-squares line about the mean time; about a median, so that float64 keeps microseconds.
        weight = sigma[kept] ** -2.0
        shift = int(np.rint(np.average(own_pulses[kept] - own_pulses[0], weights=weight))) + int(
            own_pulses[0]
        )
        x = (own_pulses - shift).astype(np.float64)
        base = float(np.median(difference[kept]))
        offset = float(np.average(difference[kept] - base, weights=weight))
        rest = difference[kept] - base - offset
        slope_weight = float(np.sum(weight * x[kept] ** 2))
        drift = float(np.sum(weight * x[kept] * rest) / max(slope_weight, 1e-300))

        # Pairs far from the line, by a standard deviation that outliers hardly change, are left out.
        residual = (difference - base - offset - drift * x) / sigma
        spread = max(1.0, 1.4826 * float(np.median(np.abs(residual[kept]))))
        near = np.abs(residual) <= OUTLIER_STD * spread
        is_last = rounds == MOST_ROUNDS - 1
        if is_last or near.sum() < FEWEST_PAIRS or np.array_equal(near, kept):
            break  # the line is of the pairs that are kept
        kept = near
    scale = max(1.0, math.sqrt(float(np.mean(residual[kept] ** 2))))
    std = scale / math.sqrt(float(np.sum(weight)))
    drift_std = scale / math.sqrt(max(slope_weight, 1e-300))
    return ClockMap(
        at_us=shift,
        offset_us=base + offset,
        drift=drift,
        offset_std_us=std,
        drift_std=drift_std,
        pairs=int(kept.sum()),
    )
