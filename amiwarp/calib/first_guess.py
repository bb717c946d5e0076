"""First guess of the prism's speed from the events alone: the events of a still scene repeat in every turn."""

import math
from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording

CELL = 8
"""Side of the cells in which events are counted [px]."""
ANGLE_RANGES = 24
"""Number of ranges of prism angles per turn in which events of successive turns are compared."""
BIN_US = 1000
"""Length of the time bins in which events are counted, unless another one is given [us]."""
LONGEST_US = 3_000_000
"""Longest duration from the start of the recording that is analysed [us]."""
FASTEST_BINS = 5
"""Shortest detectable period [time bins]: five bins of 1 ms are 12,000 rpm."""
MOST_BINS = 5000
"""Largest number of time bins."""
LEAST_CORRELATION = 0.1
"""Smallest autocorrelation of event counts at which the events are considered to repeat."""
UNLIKE = 0.2
"""Correlation below which the events of two angles are not alike."""
ANGLE_BINS = 96
"""Number of angle bins per turn for the check of an encoder's scale."""
MOST_TURNS = 24
"""Largest number of turns for the check of an encoder's scale."""


def estimate_rpm(recording: Recording, bin_us: int = BIN_US, mover: str = "prism") -> float:
    """Return the speed [1/min], without its sign, from the autocorrelation of signed event counts per cell.

    ``bin_us`` is the length of a time bin [us], a fifth of the shortest turn; ``mover`` names what turns or vibrates.
    Raises :class:`AmiwarpError` if the events do not repeat or the recording has less than two turns.
    """
    counts = signed_counts(recording, bin_us)
    if len(counts) < 2 * FASTEST_BINS:
        raise AmiwarpError(
            f"{recording.name}: the events last {len(counts) * bin_us * 1e-3:g} ms, which is too short to estimate the "
            f"{mover}'s speed; record two turns or more, or give rpm or an encoder",
            ErrorCode.CALIBRATION_REFUSED,
        )
    # in short bins, chance is a larger share of the counts
    least = LEAST_CORRELATION * bin_us / BIN_US
    period = _period(autocorrelation(counts), recording.name, mover, least)
    return 60e6 / (period * bin_us)


def encoder_turns_per_period(recording: Recording, encoder: Encoder) -> float:
    """Return the encoder turns after which the events of a still scene repeat: 1 if the encoder's scale is right.

    Raises :class:`AmiwarpError` if the events do not repeat or the recording has less than two turns.
    """
    first, last = _analysed_span(recording)
    covered = encoder.coverage
    first = max(first, covered[0])
    longest = int(MOST_TURNS * 60e6 / max(abs(encoder.rpm), 1.0))
    last = min(last, covered[1], first + longest)
    begin = float(encoder.angle_at(first))

    def bin_of(t: NDArray[np.int64]) -> NDArray[np.int64]:
        return (np.abs(encoder.angle_at(t) - begin) * (ANGLE_BINS / math.tau)).astype(np.int64)

    counts = count_signed(recording, first, last, bin_of)
    correlation = autocorrelation(counts)
    # if the encoder counts too much, many bins are like their neighbours: these are no period
    correlation[: int(np.argmax(correlation < UNLIKE))] = -1.0
    return _period(correlation, recording.name) / ANGLE_BINS


def signed_counts(recording: Recording, bin_us: int) -> NDArray[np.float32]:
    """Return ON minus OFF events per time bin of a length [us] and cell, shape (bins, cells)."""
    first, last = _analysed_span(recording)
    last = min(last, first + MOST_BINS * bin_us - 1)
    return count_signed(recording, first, last, lambda t: (t - first) // bin_us)


def _analysed_span(recording: Recording) -> tuple[int, int]:
    """Return the first and the last time of the events that are analysed [us]."""
    first = recording.events.t_first
    return first, min(recording.events.t_last, first + LONGEST_US - 1)


def count_signed(
    recording: Recording,
    first: int,
    last: int,
    bin_of: Callable[[NDArray[np.int64]], NDArray[np.int64]],
) -> NDArray[np.float32]:
    """Return ON minus OFF events between two times [us], shape (bins, cells); ``bin_of`` maps times to bins."""
    width, height = recording.events.size
    columns = -(-width // CELL)
    rows = -(-height // CELL)
    bins = int(bin_of(np.array([last]))[0]) + 1
    counts = np.zeros(bins * rows * columns, dtype=np.float32)
    for start in range(first, last + 1, 100 * BIN_US):
        events = recording.events.between(start, min(start + 100 * BIN_US, last + 1))
        cell = (events.y // CELL).astype(np.int64) * columns + events.x // CELL
        # if the prism turns back, events may map beyond the last bin
        flat = np.minimum(bin_of(events.t), bins - 1) * (rows * columns) + cell
        of_block = np.bincount(flat, weights=2.0 * events.p - 1.0, minlength=len(counts))
        counts += of_block.astype(np.float32)
    return counts.reshape(bins, rows * columns)


def autocorrelation(counts: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the unbiased autocorrelation of event counts, summed over cells.

    It is 1 at lag 0; the lags reach 3/4 of the duration.
    """
    bins, cells = counts.shape
    power = np.zeros(bins + 1)
    # In parts, because spectra take much memory.
    for part in np.array_split(counts - counts.mean(axis=0), max(1, cells // 512), axis=1):
        spectrum = np.fft.rfft(part, 2 * bins, axis=0)
        power += (np.abs(spectrum) ** 2).sum(axis=1)
    raw = np.fft.irfft(power)[: max(2, 3 * bins // 4)]
    unbiased = raw / (bins - np.arange(len(raw)))
    return cast("NDArray[np.float64]", unbiased / max(unbiased[0], 1e-30))


def _period(
    correlation: NDArray[np.float64],
    name: str,
    mover: str = "prism",
    least: float = LEAST_CORRELATION,
) -> float:
    """Return the period of a correlation [bins]: its first strong peak, refined at multiples of the period."""
    period = _first_period(correlation, name, mover, least)
    multiple = 1
    while 2 * multiple * period < 0.6 * len(correlation):
        multiple *= 2
        period = _peak_near(correlation, multiple * period, 0.1 * period) / multiple
    return period


def _first_period(correlation: NDArray[np.float64], name: str, mover: str, least: float) -> float:
    """Return the first peak of a correlation that is nearly as high as the highest one [bins]."""
    inner = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inner > correlation[:-2]) & (inner >= correlation[2:]))
    peaks = peaks[peaks >= FASTEST_BINS]
    if not len(peaks) or correlation[peaks].max() < least:
        raise AmiwarpError(
            f"{name}: the events do not repeat, so the {mover}'s speed cannot be estimated (the scene moves, or the "
            "recording has less than two turns); give rpm or an encoder",
            ErrorCode.CALIBRATION_REFUSED,
        )
    strong = peaks[correlation[peaks] >= 0.7 * correlation[peaks].max()]
    first = strong[0]
    return _peak_near(correlation, float(first), 1.0)


def _peak_near(correlation: NDArray[np.float64], lag: float, reach: float) -> float:
    """Return the lag of the largest correlation within ``reach`` bins of ``lag``, refined by a parabola.

    The top of a parabola through a peak is within half a bin; at the end of the range there may be no peak.
    """
    low = max(1, int(np.floor(lag - reach)))
    high = min(len(correlation) - 2, int(np.ceil(lag + reach)))
    k = low + int(np.argmax(correlation[low : high + 1]))
    before, here, after = correlation[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    if not bend < 0.0:
        return float(k)
    return float(k + np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
