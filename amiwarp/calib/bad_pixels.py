"""Bad pixels, which calibration masks: hot pixels, and pixels that see a flickering lamp.

Behind a rotating prism an edge triggers events at the same prism angles in every turn. If the events of a pixel are
summed over turns with alternating signs, they cancel. Those of a hot pixel, which fires at random, do not. A flickering
lamp makes the event rates of many neighbouring pixels oscillate together, at a frequency that appears as an isolated
line in their spectrum.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder import TWO_PI, Encoder
from amiwarp.events.recording import Events, EventSource
from amiwarp.validation import guarded

MOST_TURNS, LEAST_TURNS, MOST_EVENTS = 8, 2, 2_500_000
"""Limits of the part of a recording that is searched for bad pixels: most turns of the prism, fewest turns, most
events. A longer part reveals slower hot pixels, but costs time."""
BINS = 8
"""Number of angle bins per turn of the prism in which events are counted."""
HARMONICS = 2
"""Number of harmonics of the prism angle used to count the events of a pixel that do not repeat from turn to turn. Low
harmonics tolerate small delays of an edge."""
BLOCKS = 4
"""Number of groups of successive turns in which unrepeated events are counted separately before the counts are added.
More groups reduce the noise of the count, but cost time."""
NEIGHBOURS = 2
"""Half width of the square of neighbouring pixels with whose event counts a pixel's event count is compared [px]."""
LEAST_LOW = 19
"""Smallest number of the 24 neighbours that must have far fewer events than a pixel before it counts as hot. Pixels of
corners and thin lines have fewer such neighbours."""
CELL = 16
"""Side of the square cells whose event rate is searched for flicker [px]."""
BIN_US = 1000
"""Length of the time bins in which flicker is detected [us]: 1 ms resolves up to 500 Hz."""
LONGEST_US = 1_000_000
"""Longest duration, around the middle of the events, that is searched for flicker [us]."""
SLOWEST_HZ = 40.0
"""Lowest detected flicker frequency [Hz]. Slower changes of the light cannot be distinguished from motion of the scene.
"""
LAMP_CYCLES = 6
"""Smallest number of cycles of a lamp during the events from which its frequency can be determined."""
LEAST_SHARE = 0.3
"""Smallest share of a cell's or a pixel's events that must oscillate with the lamp for it to count as flickering.
Texture alone reaches 0.2."""
LEAST_RATIO = 4.0
"""Smallest ratio of a lamp's power to the power of nearby frequencies (see :data:`NEAR_TURNS`). Texture alone reaches
3."""
NEAR_TURNS = 2.6
"""Distance of the frequencies to which a lamp's power is compared, in multiples of the prism's rotation frequency. The
range then contains harmonics of the prism's rotation."""
FEWEST_EVENTS = 100
"""Smallest number of events of a cell whose spectrum is analysed."""
LEAST_SIGMA = 4.0
"""Smallest amplitude of a flickering pixel's oscillation, in standard deviations expected for random events."""
MOST_LAMPS = 3
"""Largest number of flicker frequencies that are searched for."""
SMOOTHING = 5
"""Side of the square of pixels over which each pixel's oscillation is summed [px]."""


@dataclass(frozen=True, slots=True)
class BadPixelSummary:
    """Numbers of hot and of flickering pixels in a recording. As text, a warning for the user."""

    hot: int
    """Number of hot pixels, which fire at random."""
    flickering: int
    """Number of pixels that see a flickering lamp."""
    lamps_hz: tuple[float, ...]
    """Frequencies of flickering lamps, the strongest lamp first [Hz]."""
    share: float
    """Share of all events that lie on bad pixels, 0 to 1."""

    def __str__(self) -> str:
        """Return, for example, ``12 hot pixels and 3400 that flicker at 100 Hz left out, 41 % of the events``."""
        kinds = []
        if self.hot:
            kinds.append(f"{self.hot} hot pixel{'s' if self.hot > 1 else ''}")
        if self.flickering:
            at = " and ".join(f"{hz:.0f}" for hz in self.lamps_hz)
            kinds.append(f"{self.flickering} that flicker at {at} Hz")
        return f"{' and '.join(kinds)} left out, {100.0 * self.share:.0f} % of the events" if kinds else ""


def stretch(source: EventSource, encoder: Encoder) -> Events:
    """Return all events of some whole turns in the middle of a recording. Thinned events would not repeat by turn."""
    first, whole = source.t_first, source.t_last + 1 - source.t_first
    turn = 60e6 / max(abs(encoder.rpm), 1e-6)
    turns = min(max(MOST_EVENTS * whole / (len(source) * turn), LEAST_TURNS), MOST_TURNS)
    # two turns may hold more than MOST_EVENTS, but turns of a very slow prism must not load a whole file
    most = min(whole, 4.0 * MOST_EVENTS * whole / len(source))
    length = math.ceil(min((math.floor(turns) + 0.05) * turn, most))
    start = first + (whole - length) // 2
    return source.between(start, start + length)


def strange_pixels(
    events: Events, encoder: Encoder, size: tuple[int, int]
) -> tuple[NDArray[np.bool_], BadPixelSummary]:
    """Find hot pixels and pixels that see a flickering lamp.

    Hot pixels are found by their event rate and, from two turns on, by events that do not repeat from turn to turn. The
    second test fails while the camera rotates fast.

    Parameters
    ----------
    events : Events
        A sensor's events (uint16) in the order of time. Use all events of some turns, see :func:`stretch`; thinned
        events reveal less.
    encoder : Encoder
        Encoder that covers the events.
    size : (int, int)
        Width and height of the sensor [px].

    Returns
    -------
    mask : ndarray
        True for bad pixels, shape ``(height, width)``.
    summary : BadPixelSummary
        Numbers of bad pixels.
    """
    width, height = size
    pixel = events.y.astype(np.int32) * np.int32(width) + events.x
    count = np.bincount(pixel, minlength=width * height)
    hot = outliers(count.reshape(height, width).astype(np.float64))
    unrepeated = unrepeated_counts(events, pixel, encoder, size)
    if unrepeated is not None:
        hot |= outliers(unrepeated)
    flickering, lamps = _flickering(events, pixel, encoder, hot)
    mask = hot | flickering
    left_out = int(count[mask.ravel()].sum())
    share = left_out / max(len(events), 1)
    return mask, BadPixelSummary(int((hot & ~flickering).sum()), int(flickering.sum()), lamps, share)


def without_pixels(events: Events, mask: NDArray[np.bool_]) -> Events:
    """Return the events outside the masked pixels; ``mask`` is True for masked pixels, shape (height, width)."""
    return events[~mask[events.y, events.x]] if mask.any() else events


@guarded
@dataclass(frozen=True, eq=False, repr=False)
class MaskedEventSource(EventSource):
    """Event source that drops the events of masked pixels on reading. ``len`` still counts them."""

    source: EventSource
    """Event source whose events are read and masked."""
    mask: NDArray[np.bool_]
    """Mask of bad pixels: True for pixels whose events are dropped, shape ``(height, width)``."""

    def __len__(self) -> int:
        return len(self.source)

    @property
    def t_first(self) -> int:
        return self.source.t_first

    @property
    def t_last(self) -> int:
        return self.source.t_last

    @property
    def size(self) -> tuple[int, int]:
        return self.source.size

    def slice(self, start: int, stop: int) -> Events:
        """Return the events with ``start <= index < stop`` of the source that lie outside the mask."""
        return without_pixels(self.source.slice(start, stop), self.mask)

    def find(self, t: int) -> int:
        return self.source.find(t)

    def between(self, t_start: int, t_end: int) -> Events:
        return without_pixels(self.source.between(t_start, t_end), self.mask)

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """Yield, for each block of the source's events, those that lie outside the mask."""
        return (without_pixels(block, self.mask) for block in self.source.blocks(count=count, duration_us=duration_us))


# -- hot pixels


def outliers(count: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the pixels with far more events than at least :data:`LEAST_LOW` of their 24 neighbours.

    Far more than a neighbour's n means more than 3 n + 5 √n + 8: beyond Poisson statistics and a picture's contrast. A
    few neighbours may count as much, so adjacent hot pixels do not hide each other.
    """
    height, width = count.shape
    own = np.pad(count, NEIGHBOURS, mode="symmetric")
    enough = (3.0 * own + 5.0 * np.sqrt(own) + 8.0).astype(np.float32)
    own = count.astype(np.float32)
    low = np.zeros(count.shape, np.int8)
    for i in range(2 * NEIGHBOURS + 1):
        for j in range(2 * NEIGHBOURS + 1):
            if (i, j) != (NEIGHBOURS, NEIGHBOURS):
                low += own > enough[i : i + height, j : j + width]
    return low >= LEAST_LOW


def unrepeated_counts(
    events: Events, pixel: NDArray[np.int32], encoder: Encoder, size: tuple[int, int]
) -> NDArray[np.float64] | None:
    """Estimate how many events of each pixel do not repeat from turn to turn, shape (height, width).

    Turns get signs that sum to zero, so repeated events cancel. The expected square of the sum of random events is
    their number. The squares are averaged over low harmonics of the angle and summed over both polarities and up to
    :data:`BLOCKS` spans of turns. None for less than two turns.
    """
    edges = bin_times(events, encoder)
    pairs = (len(edges) - 1) // BINS // 2
    if not pairs:
        return None
    at = np.searchsorted(events.t, edges)
    channels = 2 * size[0] * size[1]
    total = np.zeros(channels)
    for turns in np.array_split(np.arange(2 * pairs).reshape(-1, 2), min(pairs, BLOCKS)):
        marks = at[turns[0, 0] * BINS : (turns[-1, 1] + 1) * BINS + 1]
        span, lengths = slice(int(marks[0]), int(marks[-1])), np.diff(marks)
        # Thue-Morse signs: a response that alternates between two states cancels too
        sign = 1.0 - 2.0 * (np.bitwise_count(np.arange(turns.size)) & 1)
        slots = np.repeat(np.tile(np.arange(BINS, dtype=np.int32) * np.int32(channels), turns.size), lengths)
        key = slots + pixel[span] * np.int32(2) + events.p[span]
        folded = np.bincount(key, np.repeat(np.repeat(sign, BINS), lengths), minlength=BINS * channels)
        total += ((harmonics() @ folded.reshape(BINS, channels)) ** 2).mean(axis=0)
    return np.asarray(total.reshape(size[1], size[0], 2).sum(axis=2))


def harmonics() -> NDArray[np.float64]:
    """Return a constant, cosines and sines of the angle at the bin centres, shape (harmonics, BINS).

    Each has the mean square 1.
    """
    phase = np.outer(np.arange(1, HARMONICS + 1), (np.arange(BINS) + 0.5) * (TWO_PI / BINS))
    return np.concatenate([np.ones((1, BINS)), math.sqrt(2.0) * np.cos(phase), math.sqrt(2.0) * np.sin(phase)])


def bin_times(events: Events, encoder: Encoder) -> NDArray[np.int64]:
    """Return the times [us] at which the prism enters each angle bin, for whole turns from the first event on."""
    if not len(events):
        return np.zeros(1, np.int64)
    # encoder noise may step back, but interpolating time over angle needs rising angles
    sign = 1.0 if encoder.rpm >= 0.0 else -1.0
    angle = np.maximum.accumulate(sign * (encoder.angle - encoder.angle[0]))
    elapsed = (encoder.t - encoder.t[0]).astype(np.float64) - encoder.clock_offset_us
    ends = np.array([int(events.t[0]) - int(encoder.t[0]), int(events.t[-1]) + 1 - int(encoder.t[0])])
    first, last = np.interp(ends, elapsed, angle)
    bins = int((last - first) / TWO_PI + 1e-3) * BINS
    marks = np.interp(first + np.arange(bins + 1) * (TWO_PI / BINS), angle, elapsed)
    return np.rint(marks).astype(np.int64) + encoder.t[0]


# -- flicker


def _flickering(
    events: Events, pixel: NDArray[np.int32], encoder: Encoder, hot: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], tuple[float, ...]]:
    """Return the pixels that see a lamp, shape (height, width), and the lamps' frequencies [Hz]."""
    found = np.zeros(hot.shape, np.bool_)
    lamps: list[float] = []
    middle = (int(events.t[0]) + int(events.t[-1])) // 2 if len(events) else 0
    first, last = np.searchsorted(events.t, [middle - LONGEST_US // 2, middle + LONGEST_US // 2])
    events, pixel = events[int(first) : int(last)], pixel[int(first) : int(last)]
    for _ in range(MOST_LAMPS if len(events) else 0):
        lamp = _find_lamp(events, pixel, abs(encoder.rpm) / 60.0, hot | found)
        if lamp is None:
            break
        hz, cells = lamp
        patch = _patch(events, pixel, hz, cells, hot) & ~found
        if not patch.any():
            break
        found |= patch
        if all(round(hz) != round(other) for other in lamps):  # a second search may find more pixels of the same lamp
            lamps.append(hz)
    return found, tuple(lamps)


def _find_lamp(
    events: Events, pixel: NDArray[np.int32], turns_hz: float, without: NDArray[np.bool_]
) -> tuple[float, NDArray[np.bool_]] | None:
    """Return the frequency [Hz] of the strongest lamp and the cells that see it, shape (rows, columns)."""
    signed, count, rows = _signals(events, pixel, without)
    bins = signed.shape[1]
    amplitude = np.abs(np.fft.rfft(signed, axis=1))
    hz = np.fft.rfftfreq(bins, BIN_US * 1e-6)
    reach = max(5, round(NEAR_TURNS * turns_hz / hz[1])) if bins > 1 else 5
    sees = amplitude**2 >= LEAST_RATIO * _largest_near(amplitude, reach) ** 2
    sees &= (amplitude >= LEAST_SHARE * count[:, None]) & (count[:, None] >= FEWEST_EVENTS)
    sees[:, hz < max(SLOWEST_HZ, LAMP_CYCLES * 1e6 / (bins * BIN_US))] = False
    if not sees.any():
        return None
    seen = np.where(sees, amplitude, 0.0).sum(axis=0)
    best = int(np.argmax(seen >= 0.5 * seen.max()))  # the lowest frequency: overtones may be nearly as strong
    cells = sees[:, best - 1 : best + 2].any(axis=1)
    fine = 8 * bins
    power = (np.abs(np.fft.rfft(signed[cells], fine, axis=1)) ** 2).sum(axis=0)[8 * best - 8 : 8 * best + 9]
    return (8 * best - 8 + int(np.argmax(power))) * 1e6 / (fine * BIN_US), cells.reshape(rows, -1)


def _signals(
    events: Events, pixel: NDArray[np.int32], without: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return ON minus OFF events, shape (cells, bins), the events per cell, shape (cells,), and the rows of cells."""
    height, width = without.shape
    rows, columns = -(-height // CELL), -(-width // CELL)
    bins = int(events.t[-1] - events.t[0]) // BIN_US + 1
    at = np.searchsorted(events.t, int(events.t[0]) + np.arange(bins + 1) * BIN_US)
    y, x = np.indices(without.shape, np.int32)
    # masked pixels are counted in an extra cell at the end
    cell = np.where(without, rows * columns, y // CELL * columns + x // CELL).astype(np.int32) * np.int32(bins)
    key = cell.ravel()[pixel] + np.repeat(np.arange(bins, dtype=np.int32), np.diff(at))
    shape = (rows * columns + 1, bins)
    count = np.bincount(key, minlength=shape[0] * bins).reshape(shape)[:-1]
    on = np.bincount(key, events.p, minlength=shape[0] * bins).reshape(shape)[:-1]
    return 2.0 * on - count, count.sum(axis=1).astype(np.float64), rows


def _largest_near(amplitude: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Return the largest amplitude at 2 to ``reach`` frequency bins away: a spectral line is up to two bins wide."""
    from scipy.ndimage import maximum_filter1d

    window = (reach - 1) | 1  # odd, so that it has a middle
    off = 2 + window // 2
    padded = np.pad(maximum_filter1d(amplitude, window, axis=1, mode="constant"), ((0, 0), (off, off)))
    n = amplitude.shape[1]
    return np.maximum(padded[:, :n], padded[:, 2 * off : 2 * off + n])


def _patch(
    events: Events, pixel: NDArray[np.int32], hz: float, cells: NDArray[np.bool_], without: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the connected region of pixels that oscillate at ``hz`` [Hz], grown from the cells that see the lamp."""
    from scipy import ndimage

    height, width = without.shape

    def around(weights: NDArray[np.float64] | None) -> NDArray[np.float64]:
        counted = np.bincount(pixel, weights, minlength=height * width).reshape(height, width)
        smooth = ndimage.uniform_filter(np.where(without, 0.0, counted), SMOOTHING, mode="mirror")
        return np.asarray(np.rint(smooth * SMOOTHING**2) if weights is None else smooth * SMOOTHING**2)

    angle = ((events.t - events.t[0]) * (hz * TWO_PI * 1e-6)).astype(np.float32)
    sign = 2.0 * events.p - 1.0
    together, count = np.hypot(around(sign * np.cos(angle)), around(sign * np.sin(angle))), around(None)
    sees = (together >= LEAST_SHARE * count) & (together >= LEAST_SIGMA * np.sqrt(count)) & (count > 0.5)
    begin = np.kron(cells, np.ones((CELL, CELL), np.bool_))[:height, :width]
    patch = ndimage.binary_propagation(begin & sees, mask=sees)
    return np.asarray(ndimage.binary_fill_holes(patch))
