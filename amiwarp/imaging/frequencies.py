"""Frequency with which the light at each pixel changes: vibrating edges, rotors and lamps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events

Integers = NDArray[np.int64]

SLOWEST_HZ = 1.0
FASTEST_HZ = 20_000.0
"""Lowest and highest frequency that is found [Hz]."""
BIN = math.log(1.05)
"""Width of the bins of a pixel's histogram of periods, on a logarithmic scale: 5 %."""
FEWEST_PERIODS = 4
"""Smallest number of periods in the peak of a histogram that makes a frequency."""
LEAST_SHARE = 0.5
"""Smallest share of a pixel's periods that the peak must hold. Of events at random times, it holds about a sixth."""


def pixel_frequencies(
    events: Events,
    size: tuple[int, int],
    *,
    starts: Integers | None = None,
) -> NDArray[np.float32]:
    """Return the dominant frequency of each pixel [Hz], shape ``(height, width)``; NaN if it has none.

    A period of a pixel is the time between two changes from OFF to ON: from an ON event that follows an OFF event to
    the next such event. The frequency is the inverse of the mean period in the peak of the histogram of the pixel's
    periods: the fullest bin of 5 % and the bins next to it. There is none if the peak holds fewer than
    :data:`FEWEST_PERIODS` periods, or less than the share :data:`LEAST_SHARE` of all.

    So the lowest frequency is about four periods in the time of the events, and the highest one follows from the dead
    time of the pixels. Both polarities are needed. An edge that swings over a pixel has one change from OFF to ON in
    each period; a bar that swings over it may have two.

    ``size``: width and height of the sensor [px]. ``starts``: times at which runs of events begin, if there are gaps
    between them [us], shape ``(n,)``. Nothing is counted over a gap.
    """
    width, height = size
    frequency = np.full(height * width, np.nan, np.float32)
    pixel, periods = _periods(events, width, starts)
    counts = np.bincount(pixel, minlength=height * width)
    shortest_us = 1e6 / FASTEST_HZ
    longest_us = 1e6 / SLOWEST_HZ
    possible = (periods >= shortest_us) & (periods <= longest_us)
    if not possible.any():
        return frequency.reshape(height, width)

    peaks = _fullest_peaks(pixel[possible], periods[possible])
    many = peaks.numbers >= FEWEST_PERIODS
    most = peaks.numbers >= LEAST_SHARE * counts[peaks.pixel]
    clear = many & most
    frequencies = 1e6 * peaks.numbers[clear] / peaks.sums[clear]
    frequency[peaks.pixel[clear]] = frequencies
    return frequency.reshape(height, width)


def _periods(
    events: Events,
    width: int,
    starts: Integers | None,
) -> tuple[Integers, NDArray[np.float64]]:
    """Return the pixel and the length [us] of each period, in the order of the pixels."""
    # The changes from OFF to ON of each pixel.
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.argsort(pixel, kind="stable")  # each pixel's events stay in the order of time
    pixel = pixel[order]
    t = events.t[order]
    p = events.p[order]
    run = np.zeros(len(t), np.int64)
    if starts is not None:
        run = np.searchsorted(starts, t, side="right")
    joined = (pixel[1:] == pixel[:-1]) & (run[1:] == run[:-1])
    turns_on = (p[1:] == 1) & (p[:-1] == 0)
    rises = np.flatnonzero(joined & turns_on) + 1

    # The periods between them.
    pixel = pixel[rises]
    run = run[rises]
    whole = (pixel[1:] == pixel[:-1]) & (run[1:] == run[:-1])
    periods = np.diff(t[rises])
    return pixel[1:][whole], periods[whole].astype(np.float64)


class _Peaks(NamedTuple):
    """Fullest peak in the histogram of the periods of each pixel."""

    pixel: Integers
    """The pixel."""
    numbers: Integers
    """Number of periods in the peak."""
    sums: NDArray[np.float64]
    """Their sum [us]."""


def _fullest_peaks(pixel: Integers, periods: NDArray[np.float64]) -> _Peaks:
    """Return the fullest peak of each pixel that has periods [us]."""
    # The histogram of each pixel, of its bins that are not empty: number and sum of their periods.
    over_shortest = periods * (FASTEST_HZ * 1e-6)
    bins = np.floor(np.log(over_shortest) / BIN).astype(np.int64) + 1
    # With an empty bin between two pixels
    bins_of_pixel = math.ceil(math.log(FASTEST_HZ / SLOWEST_HZ) / BIN) + 3
    keys, inverse, numbers = np.unique(
        pixel * bins_of_pixel + bins,
        return_inverse=True,
        return_counts=True,
    )
    sums = np.bincount(inverse, periods)

    # Each bin with those next to it.
    peak_numbers = numbers.copy()
    peak_sums = sums.copy()
    adjacent = np.flatnonzero(np.diff(keys) == 1)
    following = adjacent + 1
    peak_numbers[adjacent] += numbers[following]
    peak_sums[adjacent] += sums[following]
    peak_numbers[following] += numbers[adjacent]
    peak_sums[following] += sums[adjacent]

    # The last of each pixel, in the order of their numbers.
    pixel_of_key = keys // bins_of_pixel
    order = np.lexsort((peak_numbers, pixel_of_key))
    is_last_of_pixel = np.append(np.diff(pixel_of_key[order]) != 0, True)
    best = order[is_last_of_pixel]
    return _Peaks(pixel_of_key[best], peak_numbers[best], peak_sums[best])


def strongest(frequencies: NDArray[np.float32], most: int) -> list[tuple[float, int]]:
    """Return the frequencies that most pixels have [Hz], with the number of these pixels, the most frequent first.

    Frequencies within 5 % count as one. ``most``: largest number of them.
    """
    known = np.isfinite(frequencies)
    left = frequencies[known].astype(np.float64)
    strongest_first: list[tuple[float, int]] = []
    while len(left) and len(strongest_first) < most:
        groups = np.floor(np.log(left) / BIN)
        numbers, counts = np.unique(groups, return_counts=True)
        fullest = numbers[np.argmax(counts)]
        hz = float(np.median(left[groups == fullest]))
        near = np.abs(np.log(left / hz)) <= BIN
        strongest_first.append((hz, int(np.count_nonzero(near))))
        left = left[~near]
    return sorted(strongest_first, key=lambda frequency: -frequency[1])
