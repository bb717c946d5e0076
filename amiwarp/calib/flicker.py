"""Pixels that see a flickering lamp.

It makes the event rates of many neighbouring pixels oscillate together, at a frequency that appears as an isolated line
in their spectrum.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL = 16
"""Side of the square cells whose event rate is searched for flicker [px]."""
BIN_US = 1000
"""Length of the time bins in which flicker is detected [us]: 1 ms resolves up to 500 Hz."""
LONGEST_US = 1_000_000
"""Longest duration, around the middle of the events, that is searched for flicker [us]."""
SLOWEST_HZ = 40.0
"""Lowest detected flicker frequency [Hz]. Slower changes of the light cannot be distinguished from motion of the scene.
"""
FEWEST_CYCLES = 6
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
FEWEST_NEAR = 5
"""Smallest number of frequencies on either side to which a lamp's power is compared."""
SPECTRUM_REFINEMENT = 8
"""How much finer the spectrum is in which the lamp's frequency is found."""
SAME_LAMP_HZ = 1.0
"""Smallest difference of two lamps' frequencies [Hz]; below it, they are two estimates for one lamp."""
LOWEST_SHARE = 0.5
"""Smallest summed amplitude of a lamp's lowest frequency, as a share of the largest at any frequency. Overtones may be
nearly as strong."""
FEWEST_EVENTS = 100
"""Smallest number of events of a cell whose spectrum is analysed."""
LEAST_SIGMA = 4.0
"""Smallest amplitude of a flickering pixel's oscillation, in standard deviations expected for random events."""
MOST_LAMPS = 3
"""Largest number of flicker frequencies that are searched for."""
SMOOTHING = 5
"""Side of the square of pixels over which each pixel's oscillation is summed [px]."""


def flickering_pixels(
    events: Events,
    pixel: NDArray[np.int32],
    encoder: Encoder,
    hot: Mask,
) -> tuple[Mask, tuple[float, ...]]:
    """Return the pixels that see a lamp, shape (height, width), and the lamps' frequencies [Hz]."""
    found = np.zeros(hot.shape, np.bool_)
    lamps: list[float] = []
    if not len(events):
        return found, ()

    middle = (int(events.t[0]) + int(events.t[-1])) // 2
    begin = middle - LONGEST_US // 2
    end = middle + LONGEST_US // 2
    first, last = np.searchsorted(events.t, [begin, end]).tolist()
    events = events[first:last]
    pixel = pixel[first:last]
    if not len(events):
        return found, ()

    turns_hz = abs(encoder.rpm) / 60.0
    for _ in range(MOST_LAMPS):
        lamp = _find_lamp(events, pixel, turns_hz, hot | found)
        if lamp is None:
            break
        hz, cells = lamp
        patch = _region_of_lamp(events, pixel, hz, cells, hot) & ~found
        if not patch.any():
            break
        found |= patch
        # A second search may find more pixels of the same lamp.
        known = any(abs(hz - other) < SAME_LAMP_HZ for other in lamps)
        if not known:
            lamps.append(hz)
    return found, tuple(lamps)


def _find_lamp(
    events: Events,
    pixel: NDArray[np.int32],
    turns_hz: float,
    ignored: Mask,
) -> tuple[float, Mask] | None:
    """Return the frequency [Hz] of the strongest lamp and the cells that see it, shape (rows, columns)."""
    signed, count, rows = _signals(events, pixel, ignored)
    bins = signed.shape[1]
    amplitude = np.abs(np.fft.rfft(signed, axis=1))
    hz = np.fft.rfftfreq(bins, BIN_US * 1e-6)
    reach_bins = FEWEST_NEAR
    if bins > 1:
        reach_bins = max(FEWEST_NEAR, round(NEAR_TURNS * turns_hz / hz[1]))

    # At which frequencies each cell sees a lamp.
    count_of_cell = count[:, None]
    duration_us = bins * BIN_US
    slowest_hz = max(SLOWEST_HZ, FEWEST_CYCLES * 1e6 / duration_us)
    sees = amplitude**2 >= LEAST_RATIO * _largest_near(amplitude, reach_bins) ** 2
    sees &= amplitude >= LEAST_SHARE * count_of_cell
    sees &= count_of_cell >= FEWEST_EVENTS
    sees[:, hz < slowest_hz] = False
    if not sees.any():
        return None

    seen = np.where(sees, amplitude, 0.0).sum(axis=0)
    strong = seen >= LOWEST_SHARE * seen.max()
    lowest = int(np.argmax(strong))
    cells = sees[:, lowest - 1 : lowest + 2].any(axis=1)
    lamp_hz = _finer_hz(signed[cells], lowest)
    return lamp_hz, cells.reshape(rows, -1)


def _finer_hz(signed: Vector, nearest: int) -> float:
    """Return the frequency of a lamp between the bins next to the bin ``nearest`` of the spectrum [Hz]."""
    fine_bins = SPECTRUM_REFINEMENT * signed.shape[1]
    spectrum = np.fft.rfft(signed, fine_bins, axis=1)
    power = (np.abs(spectrum) ** 2).sum(axis=0)
    first = SPECTRUM_REFINEMENT * (nearest - 1)
    last = SPECTRUM_REFINEMENT * (nearest + 1)
    peak = first + int(np.argmax(power[first : last + 1]))
    return peak * 1e6 / (fine_bins * BIN_US)


def _signals(
    events: Events,
    pixel: NDArray[np.int32],
    ignored: Mask,
) -> tuple[Vector, Vector, int]:
    """Return ON minus OFF events, shape (cells, bins), the events per cell, shape (cells,), and the rows of cells."""
    height, width = ignored.shape
    rows = math.ceil(height / CELL)
    columns = math.ceil(width / CELL)
    cells = rows * columns
    begin = int(events.t[0])
    bins = int(events.t[-1] - events.t[0]) // BIN_US + 1

    # masked pixels are counted in an extra cell at the end
    y, x = np.indices(ignored.shape, np.int32)
    cell = np.where(ignored, cells, y // CELL * columns + x // CELL)
    first_slot = cell.astype(np.int32) * np.int32(bins)

    edges = begin + np.arange(bins + 1) * BIN_US
    events_of_bin = np.diff(np.searchsorted(events.t, edges))
    time_bin = np.repeat(np.arange(bins, dtype=np.int32), events_of_bin)
    slot = first_slot.ravel()[pixel] + time_bin

    def counted(weights: NDArray[np.uint8] | None) -> NDArray[Any]:
        """Return the sums of the events' weights, or their numbers, shape (cells, bins)."""
        counts = np.bincount(slot, weights, minlength=(cells + 1) * bins)
        return counts.reshape(cells + 1, bins)[:-1]

    count = counted(None)
    on = counted(events.p)
    count_of_cell = count.sum(axis=1).astype(np.float64)
    return 2.0 * on - count, count_of_cell, rows


def _largest_near(amplitude: Vector, reach_bins: int) -> Vector:
    """Return the largest amplitude at 2 to ``reach_bins`` bins away: a spectral line is up to two bins wide."""
    from scipy.ndimage import maximum_filter1d

    window = (reach_bins - 1) | 1  # odd, so that it has a middle
    off = 2 + window // 2
    largest = maximum_filter1d(amplitude, window, axis=1, mode="constant")
    padded = np.pad(largest, ((0, 0), (off, off)))
    bins = amplitude.shape[1]
    below = padded[:, :bins]
    above = padded[:, 2 * off : 2 * off + bins]
    return np.maximum(below, above)


def _region_of_lamp(
    events: Events,
    pixel: NDArray[np.int32],
    hz: float,
    cells: Mask,
    ignored: Mask,
) -> Mask:
    """Return the connected region of pixels that oscillate at ``hz`` [Hz], grown from the cells that see the lamp."""
    from scipy import ndimage

    height, width = ignored.shape

    def around(weights: Vector | None) -> Vector:
        """Return the sums of the events' weights, or their numbers, in the square about each pixel."""
        of_pixel = np.bincount(pixel, weights, minlength=height * width)
        image = np.where(ignored, 0.0, of_pixel.reshape(height, width))
        mean = ndimage.uniform_filter(image, SMOOTHING, mode="mirror")
        sums = mean * SMOOTHING**2
        if weights is None:
            return np.rint(sums)
        return np.asarray(sums)

    elapsed = events.t - events.t[0]
    angle = (elapsed * (hz * math.tau * 1e-6)).astype(np.float32)
    sign = 2.0 * events.p - 1.0
    cosine = around(sign * np.cos(angle))
    sine = around(sign * np.sin(angle))
    oscillating = np.hypot(cosine, sine)
    count = around(None)
    sees = oscillating >= LEAST_SHARE * count
    sees &= oscillating >= LEAST_SIGMA * np.sqrt(count)
    sees &= count > 0.5

    pixels_of_cell = np.ones((CELL, CELL), np.bool_)
    begin = np.kron(cells, pixels_of_cell)[:height, :width]
    patch = ndimage.binary_propagation(begin & sees, mask=sees)
    return np.asarray(ndimage.binary_fill_holes(patch))
