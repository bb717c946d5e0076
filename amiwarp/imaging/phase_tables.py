"""What an event adds to the sums in phase of its pixel: tables of integers, and what the integers are worth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.kernels import phase as kernels

MOST_EVENTS = ((1 << 31) - 1) // (2 * kernels.UNIT)
"""Largest number of events of one pixel, with OFF events in units of the ON threshold: more could overflow its sums, in
which an event counts twice at most."""
EXTREME = 0.4
"""What an extreme of the brightness adds to the events before and after it [thresholds]. On average it lies half a
threshold beyond them; a smooth extreme, in whose place a plateau between them is taken, adds a third."""
LEAST_RATIO = 0.1
"""Smallest ratio of the OFF threshold to the ON threshold, and one over the largest."""


def ratio_of_counts(on: int, off: int) -> float:
    """Return the number of ON events divided by the number of OFF events, within limits; 1 without either."""
    if not on or not off:
        return 1.0
    return float(np.clip(on / off, LEAST_RATIO, 1.0 / LEAST_RATIO))


def bin_attenuation(orders: NDArray[np.int64], bins: int) -> NDArray[np.float64]:
    """Return by how much bins attenuate sums of some orders: an angle spreads evenly within its bin."""
    return np.asarray(np.sinc(orders / bins))


def scales_of(harmonics: int, bins: int, turns: float, direction: int) -> NDArray[np.float64]:
    """Return the factor of the integers of each harmonic."""
    attenuation = bin_attenuation(np.arange(1, harmonics + 1), bins)
    return direction / (math.tau * kernels.UNIT * turns * attenuation)


def angle_table(bins: int, harmonics: int, off_ratio: float) -> NDArray[np.int32]:
    """Return what an event of each polarity and bin adds to its pixel, shape (2 bins, 2 + 2 harmonics).

    The first rows are for OFF events. The columns are the numbers of OFF and ON events, then cosine and sine of each
    harmonic of the angle at the middle of the bin [1/UNIT], for OFF events times the negative ``off_ratio``.
    """
    pairs = angle_pairs(bins, harmonics).reshape(bins, 2 * harmonics)
    counts = np.zeros((2 * bins, int(kernels.COUNTS)))
    counts[:bins, 0] = 1.0
    counts[bins:, 1] = 1.0
    sums = np.concatenate([-off_ratio * pairs, pairs])
    return np.rint(np.hstack([counts, sums])).astype(np.int32)


def angle_pairs(bins: int, harmonics: int) -> NDArray[np.float64]:
    """Return cosine and sine of each harmonic at the middle of each bin [1/UNIT], shape (bins, harmonics, 2)."""
    middles = (np.arange(bins) + 0.5) * (math.tau / bins)
    turned = np.outer(middles, np.arange(1, harmonics + 1))
    return kernels.UNIT * np.stack([np.cos(turned), np.sin(turned)], axis=2)


def extreme_table(table: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return what an event beside an extreme adds once more, shaped as the table that :func:`angle_table` gives."""
    further = np.rint(EXTREME * table).astype(np.int32)
    further[:, : int(kernels.COUNTS)] = 0
    return further
