"""Time at which the camera is calmest: there the events of one turn repeat the events of the turn before."""

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.first_guess import ANGLE_RANGES, BIN_US, LONGEST_US, count_signed
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording

Vector = NDArray[np.float64]
Counts = NDArray[np.float32]

CALM_TURNS = 2.15
"""Length of a calm span [turns]: a little more than a camera's rotation is calibrated from."""
LEAST_REPETITION = 0.5
"""Smallest correlation of the events of successive turns in a calm span. It is 0.9 for a still camera, and near 0
for a scene that moves by a cell in a turn."""
LEAST_CALM = 0.7
"""Correlation below which the camera may be in fast motion even in the calmest span: a calm hand has it."""
MOST_CALM_TURNS = 96
"""Largest number of turns that are examined, which limits the memory."""
LESS_CALM = 0.75
"""Largest correlation in the middle of a recording for which a calmer span replaces it, as a share of the span's. In a
hand it was 0.91 at least."""


def calmest_span(recording: Recording, encoder: Encoder) -> tuple[float, tuple[int, int] | None]:
    """Return how well the events of successive turns repeat where the camera moves least, and that time span [us].

    The first is their correlation. The span is None if the camera does not become clearly calmer than in the middle of
    the recording. Of a long recording :data:`LONGEST_US` about its middle are examined, and at most
    :data:`MOST_CALM_TURNS`.
    """
    first, last = _examined(recording, encoder)
    begin = float(encoder.angle_at(first))

    def bins_turned(t: NDArray[np.int64]) -> Vector:
        turned = np.abs(encoder.angle_at(t) - begin)
        return np.asarray(turned * (ANGLE_RANGES / math.tau))

    def bin_of(t: NDArray[np.int64]) -> NDArray[np.int64]:
        return bins_turned(t).astype(np.int64)

    counts = count_signed(recording, first, last, bin_of)
    counts -= counts.mean(axis=0)
    span = round(CALM_TURNS * ANGLE_RANGES)
    if len(counts) <= span:
        return 1.0, None

    repetition = _repetition(counts)
    calmest = int(np.argmax(repetition))
    most = float(repetition[calmest])

    # A calmer span is worth it only if the middle, which is used otherwise, is clearly worse.
    samples = max(2, (last - first) // BIN_US)
    times = np.linspace(first, last, samples).astype(np.int64)
    bin_of_time = np.maximum.accumulate(bins_turned(times))
    middle = (first + last) // 2
    bin_of_middle = int(np.interp(middle, times, bin_of_time))
    start_about_middle = max(0, bin_of_middle - span // 2)
    last_start = len(repetition) - 1
    in_middle = repetition[min(last_start, start_about_middle)]
    if most < LEAST_REPETITION or in_middle > LESS_CALM * most:
        return most, None
    ends = [calmest, calmest + span]
    start, stop = np.interp(ends, bin_of_time, times).tolist()
    return most, (int(start), int(stop))


def _examined(recording: Recording, encoder: Encoder) -> tuple[int, int]:
    """Return the times between which a recording is examined [us]."""
    first_covered, last_covered = encoder.coverage
    first = max(recording.events.t_first, first_covered)
    last = min(recording.events.t_last, last_covered)
    middle = (first + last) // 2
    rpm = max(abs(encoder.rpm), 1.0)
    longest = min(LONGEST_US, int(MOST_CALM_TURNS * 60e6 / rpm))
    first = max(first, middle - longest // 2)
    last = min(last, middle + longest // 2)
    return first, last


def _repetition(counts: Counts) -> Vector:
    """Return the correlation of successive turns in a calm span that begins at each bin.

    ``counts`` are the counts of each bin of the angle and cell, without their mean, shape (bins, cells).
    """
    pairs = round((CALM_TURNS - 1.0) * ANGLE_RANGES)

    def over_span(a: Counts, b: Counts) -> Vector:
        """Return the sums of products over ``pairs`` bins, from each bin on."""
        products = np.einsum("ij,ij->i", a, b)
        until = np.cumsum(products, dtype=np.float64)
        total = np.concatenate([[0.0], until])
        return np.asarray(total[pairs:] - total[:-pairs])

    here = counts[:-ANGLE_RANGES]
    later = counts[ANGLE_RANGES:]
    energy = np.sqrt(over_span(here, here) * over_span(later, later))
    correlation = over_span(here, later) / np.maximum(energy, 1e-30)
    return np.asarray(correlation)
