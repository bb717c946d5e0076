"""Speed of the prism from the events alone: the events of a still scene repeat in every turn."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.recording import Recording

CELL = 8
"""Side of the cells in which events are counted [px]."""
BIN_US = 1000
"""Length of the time bins in which events are counted [us]."""
LONGEST_US = 3_000_000
"""Longest duration from the start of the recording that is analysed [us]."""
FASTEST_BINS = 5
"""Shortest detectable period of the prism [time bins]: five bins of 1 ms are 12,000 rpm."""
LEAST_CORRELATION = 0.1
"""Smallest autocorrelation of event counts at which the events are considered to repeat."""
ANGLE_BINS, MOST_TURNS = 96, 24
"""Angle bins per turn and largest number of turns for the check of an encoder's scale."""


def estimate_rpm(recording: Recording) -> float:
    """Return the prism's speed [1/min], without its sign, from the autocorrelation of signed event counts per cell.

    Raises :class:`AmiwarpError` if the events do not repeat or the recording has less than two turns.
    """
    counts = signed_counts(recording)
    if len(counts) < 2 * FASTEST_BINS:
        raise AmiwarpError(
            f"{recording.name}: the events last {len(counts) * BIN_US * 1e-3:g} ms, which is too short to estimate the "
            "prism's speed; record two turns or more, or give rpm or an encoder"
        )
    return 60e6 / (_period(autocorrelation(counts), recording.name) * BIN_US)


def encoder_turns_per_period(recording: Recording, encoder: Encoder) -> float:
    """Return the encoder turns after which the events of a still scene repeat: 1 if the encoder's scale is right.

    Raises :class:`AmiwarpError` if the events do not repeat or the recording has less than two turns.
    """
    first, last = _analysed_span(recording)
    covered = encoder.coverage
    first, last = max(first, covered[0]), min(last, covered[1])
    last = min(last, first + int(MOST_TURNS * 60e6 / max(abs(encoder.rpm), 1.0)))
    begin = float(encoder.angle_at(first))

    def bin_of(t: NDArray[np.int64]) -> NDArray[np.int64]:
        return (np.abs(encoder.angle_at(t) - begin) * (ANGLE_BINS / math.tau)).astype(np.int64)

    counts = _signed_counts(recording, first, last, bin_of)
    return _period(autocorrelation(counts), recording.name) / ANGLE_BINS


def signed_counts(recording: Recording) -> NDArray[np.float32]:
    """Return ON minus OFF events per time bin and cell, shape (bins, cells)."""
    first, last = _analysed_span(recording)
    return _signed_counts(recording, first, last, lambda t: (t - first) // BIN_US)


def _analysed_span(recording: Recording) -> tuple[int, int]:
    first = recording.events.t_first
    return first, min(recording.events.t_last, first + LONGEST_US - 1)


def _signed_counts(
    recording: Recording, first: int, last: int, bin_of: Callable[[NDArray[np.int64]], NDArray[np.int64]]
) -> NDArray[np.float32]:
    """Return ON minus OFF events between two times [us], shape (bins, cells); ``bin_of`` maps times to bins."""
    width, height = recording.events.size
    columns, rows = -(-width // CELL), -(-height // CELL)
    bins = int(bin_of(np.array([last]))[0]) + 1
    counts = np.zeros(bins * rows * columns, dtype=np.float32)
    for start in range(first, last + 1, 100 * BIN_US):
        e = recording.events.between(start, min(start + 100 * BIN_US, last + 1))
        cell = (e.y // CELL).astype(np.int64) * columns + e.x // CELL
        # if the prism turns back, events may map beyond the last bin
        flat = np.minimum(bin_of(e.t), bins - 1) * (rows * columns) + cell
        counts += np.bincount(flat, weights=2.0 * e.p - 1.0, minlength=len(counts)).astype(np.float32)
    return counts.reshape(bins, rows * columns)


def autocorrelation(counts: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the unbiased autocorrelation of event counts, summed over cells.

    It is 1 at lag 0; the lags reach 3/4 of the duration.
    """
    n = len(counts)
    power = np.zeros(n + 1)
    for part in np.array_split(counts - counts.mean(axis=0), max(1, counts.shape[1] // 512), axis=1):
        power += (np.abs(np.fft.rfft(part, 2 * n, axis=0)) ** 2).sum(axis=1)
    raw = np.fft.irfft(power)[: max(2, 3 * n // 4)]
    unbiased = raw / (n - np.arange(len(raw)))
    return cast("NDArray[np.float64]", unbiased / max(unbiased[0], 1e-30))


def _period(correlation: NDArray[np.float64], name: str) -> float:
    """Return the period of a correlation [bins]: its first strong peak, refined at multiples of the period."""
    period = _first_period(correlation, name)
    multiple = 1
    while 2 * multiple * period < 0.6 * len(correlation):
        multiple *= 2
        period = _peak_near(correlation, multiple * period, 0.1 * period) / multiple
    return period


def _first_period(correlation: NDArray[np.float64], name: str) -> float:
    inner = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inner > correlation[:-2]) & (inner >= correlation[2:]))
    peaks = peaks[peaks >= FASTEST_BINS]
    if not len(peaks) or correlation[peaks].max() < LEAST_CORRELATION:
        raise AmiwarpError(
            f"{name}: the events do not repeat, so the prism's speed cannot be estimated (the scene moves, or the "
            "recording has less than two turns); give rpm or an encoder"
        )
    first = peaks[correlation[peaks] >= 0.7 * correlation[peaks].max()][0]
    return _peak_near(correlation, float(first), 1.0)


def _peak_near(correlation: NDArray[np.float64], lag: float, reach: float) -> float:
    """Return the lag of the largest correlation within ``reach`` bins of ``lag``, refined by a parabola."""
    low = max(1, int(np.floor(lag - reach)))
    high = min(len(correlation) - 2, int(np.ceil(lag + reach)))
    k = low + int(np.argmax(correlation[low : high + 1]))
    before, here, after = correlation[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    return float(k + (0.5 * (before - after) / bend if bend < 0.0 else 0.0))
