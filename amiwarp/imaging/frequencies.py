"""Frequency with which the light at each pixel changes: vibrating edges, rotors and lamps."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events

SLOWEST_HZ, FASTEST_HZ = 1.0, 20_000.0
"""Lowest and highest frequency that is found [Hz]."""
BIN = math.log(1.05)
"""Width of the bins of a pixel's histogram of periods, on a logarithmic scale: 5 %."""
FEWEST_PERIODS = 4
"""Smallest number of periods in the peak of a histogram that makes a frequency."""
LEAST_SHARE = 0.5
"""Smallest share of a pixel's periods that the peak must hold. Of events at random times, it holds about a sixth."""


def pixel_frequencies(
    events: Events, size: tuple[int, int], *, starts: NDArray[np.int64] | None = None
) -> NDArray[np.float32]:
    """Return the dominant frequency of each pixel [Hz], shape ``(height, width)``; NaN where there is none.

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
    found = np.full(height * width, np.nan, np.float32)
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.argsort(pixel, kind="stable")  # each pixel's events stay in the order of time
    pixel, t, p = pixel[order], events.t[order], events.p[order]
    run = np.zeros(len(t), np.int64) if starts is None else np.searchsorted(starts, t, side="right")
    joined = (pixel[1:] == pixel[:-1]) & (run[1:] == run[:-1])
    rises = np.flatnonzero(joined & (p[1:] == 1) & (p[:-1] == 0)) + 1
    pixel, run, t = pixel[rises], run[rises], t[rises]
    whole = (pixel[1:] == pixel[:-1]) & (run[1:] == run[:-1])
    pixel, periods = pixel[1:][whole], np.diff(t)[whole].astype(np.float64)
    counts = np.bincount(pixel, minlength=height * width)
    possible = (periods >= 1e6 / FASTEST_HZ) & (periods <= 1e6 / SLOWEST_HZ)
    pixel, periods = pixel[possible], periods[possible]
    if not len(pixel):
        return found.reshape(height, width)
    bins = np.floor(np.log(periods * (FASTEST_HZ * 1e-6)) / BIN).astype(np.int64) + 1
    row = math.ceil(math.log(FASTEST_HZ / SLOWEST_HZ) / BIN) + 3  # with an empty bin between two pixels
    keys, inverse, full = np.unique(pixel * row + bins, return_inverse=True, return_counts=True)
    total = np.bincount(inverse, periods)
    n_peak, t_peak = full.copy(), total.copy()
    adjacent = np.flatnonzero(np.diff(keys) == 1)
    for own, other in ((adjacent, adjacent + 1), (adjacent + 1, adjacent)):
        n_peak[own] += full[other]
        t_peak[own] += total[other]
    at = keys // row
    order = np.lexsort((n_peak, at))
    best = order[np.append(at[order][1:] != at[order][:-1], True)]  # the fullest peak of each pixel
    clear = (n_peak[best] >= FEWEST_PERIODS) & (n_peak[best] >= LEAST_SHARE * counts[at[best]])
    best = best[clear]
    found[at[best]] = 1e6 * n_peak[best] / t_peak[best]
    return found.reshape(height, width)


def strongest(frequencies: NDArray[np.float32], most: int) -> list[tuple[float, int]]:
    """Return the frequencies that most pixels have [Hz], with the number of these pixels, the most frequent first.

    Frequencies within 5 % count as one. ``most``: largest number of them.
    """
    left = frequencies[np.isfinite(frequencies)].astype(np.float64)
    found: list[tuple[float, int]] = []
    while len(left) and len(found) < most:
        groups = np.floor(np.log(left) / BIN)
        numbers, counts = np.unique(groups, return_counts=True)
        hz = float(np.median(left[groups == numbers[np.argmax(counts)]]))
        near = np.abs(np.log(left / hz)) <= BIN
        found.append((hz, int(np.count_nonzero(near))))
        left = left[~near]
    return sorted(found, key=lambda each: -each[1])
