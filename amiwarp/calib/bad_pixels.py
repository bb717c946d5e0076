"""Pixels whose events have nothing to do with the prism, for calibration to leave out: hot ones, and flickering ones.

An edge under a turning prism fires at the same angles every turn. So the events of a pixel, folded over the angle with
signs that change from turn to turn, cancel; those of a hot pixel, which fires at random, do not. A flickering lamp
makes a whole patch of pixels rise and fall together, at a frequency that stands alone in the patch's spectrum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.encoder import TURN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events, EventSource

MOST_TURNS, LEAST_TURNS, MOST_EVENTS = 8, 2, 2_500_000
"""Of the stretch of a recording that is looked at: more show slower hot pixels, and cost time."""
BINS = 8
"""Of the angle, per turn."""
HARMONICS = 2
"""Of the angle, that the folded events are measured by: low ones, which an edge that comes a little late cancels in."""
BLOCKS = 4
"""Spans of turns whose events are folded apart: more make the measure less a matter of chance, and cost time."""
AROUND = 2
"""Pixels each way with which a pixel is compared."""
LEAST_LOW = 19
"""So many of the 24 around must be too low for what a pixel fires: a corner or a thin line is not alone."""
CELL = 16
"""Side of the cells in which a lamp is sought [px]."""
BIN_US = 1000
"""Of time, in which a lamp is sought [us]: up to 500 Hz."""
LONGEST_US = 1_000_000
"""So much of the events, in their middle, is looked at for a lamp."""
SLOWEST_HZ = 40.0
"""Slower changes are not told from the scene's own."""
LAMP_CYCLES = 6
"""Fewer say nothing of a frequency."""
LEAST_SHARE = 0.3
"""Of a cell's, or a pixel's, events that rise and fall together with the lamp; texture alone reaches 0.2."""
LEAST_RATIO = 4.0
"""Of the power at the lamp's frequency to any within :data:`NEAR_TURNS`; texture alone reaches 3."""
NEAR_TURNS = 2.6
"""Frequencies compared with, as multiples of the prism's: its own harmonics are among them."""
FEWEST_EVENTS = 100
"""Of a cell whose spectrum is believed."""
LEAST_SIGMA = 4.0
"""By which the events about a pixel rise and fall together more than chance makes them."""
MOST_LAMPS = 3
"""Of different frequencies."""
SMOOTHING = 5
"""Side of the square of pixels that are asked together whether they flicker."""


@dataclass(frozen=True, slots=True)
class StrangeSummary:
    """How many pixels were found, for a warning."""

    hot: int
    """Pixels that fire at random."""
    flickering: int
    """Pixels that see a lamp flicker."""
    lamps_hz: tuple[float, ...]
    """Frequencies at which they do, the strongest first."""
    share: float
    """Of the events that lie on either."""

    def __str__(self) -> str:
        """``12 hot pixels and 3400 that flicker at 100 Hz left out, 41 % of the events``."""
        what = []
        if self.hot:
            what.append(f"{self.hot} hot pixel{'s' if self.hot > 1 else ''}")
        if self.flickering:
            at = " and ".join(f"{hz:.0f}" for hz in self.lamps_hz)
            what.append(f"{self.flickering} that flicker at {at} Hz")
        return f"{' and '.join(what)} left out, {100.0 * self.share:.0f} % of the events" if what else ""


def stretch(source: EventSource, encoder: Encoder) -> Events:
    """Events of some whole turns in the middle of a recording, all of them: thinned, they no longer repeat."""
    first, whole = source.t_first, source.t_last + 1 - source.t_first
    turn = 60e6 / max(abs(encoder.rpm), 1e-6)
    turns = min(max(MOST_EVENTS * whole / (len(source) * turn), LEAST_TURNS), MOST_TURNS)
    # two turns may hold more than asked for, but a prism that hardly turns must not load a whole file
    most = min(whole, 4.0 * MOST_EVENTS * whole / len(source))
    length = math.ceil(min((math.floor(turns) + 0.05) * turn, most))
    start = first + (whole - length) // 2
    return source.between(start, start + length)


def strange_pixels(events: Events, encoder: Encoder, size: tuple[int, int]) -> tuple[NDArray[np.bool_], StrangeSummary]:
    """Pixels to leave out, True, shape (height, width), and how many of which kind.

    ``events`` are a sensor's (uint16), in order of time, and the ``encoder`` covers them; ``size`` is the sensor's
    (width, height) [px]. All that fired for some turns (see :func:`stretch`) say more than a thinned selection; under
    two turns, or while the camera turns fast, only rates can tell that a pixel is hot.
    """
    width, height = size
    pixel = events.y.astype(np.int32) * np.int32(width) + events.x
    count = np.bincount(pixel, minlength=width * height)
    hot = stands_out(count.reshape(height, width).astype(np.float64))
    unlocked = unlocked_counts(events, pixel, encoder, size)
    if unlocked is not None:
        hot |= stands_out(unlocked)
    flickering, lamps = _flickering(events, pixel, encoder, hot)
    mask = hot | flickering
    left_out = int(count[mask.ravel()].sum())
    share = left_out / max(len(events), 1)
    return mask, StrangeSummary(int((hot & ~flickering).sum()), int(flickering.sum()), lamps, share)


def keep(events: Events, mask: NDArray[np.bool_]) -> Events:
    """Events of the pixels that ``mask``, shape (height, width), does not leave out; as they are if it leaves none."""
    return events[~mask[events.y, events.x]] if mask.any() else events


@dataclass(frozen=True, slots=True, eq=False)
class Masked:
    """A source without the events of some pixels, left out as they are read; ``len`` counts them still."""

    source: EventSource
    mask: NDArray[np.bool_]

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
        """Of those ``start <= index < stop`` of the source, what is left."""
        return keep(self.source.slice(start, stop), self.mask)

    def find(self, t: int) -> int:
        return self.source.find(t)

    def between(self, t_start: int, t_end: int) -> Events:
        return keep(self.source.between(t_start, t_end), self.mask)

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """Blocks of the source, what is left of each."""
        return (keep(block, self.mask) for block in self.source.blocks(count=count, duration_us=duration_us))


# -- hot pixels


def stands_out(count: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels that count far more than most around them, which other hot pixels among these do not hide.

    Against one of n: more than 3 n + 5 √n + 8, far outside of Poisson's statistics and of a picture's contrast.
    """
    height, width = count.shape
    own = np.pad(count, AROUND, mode="symmetric")
    enough = (3.0 * own + 5.0 * np.sqrt(own) + 8.0).astype(np.float32)
    own = count.astype(np.float32)
    low = np.zeros(count.shape, np.int8)
    for i in range(2 * AROUND + 1):
        for j in range(2 * AROUND + 1):
            if (i, j) != (AROUND, AROUND):
                low += own > enough[i : i + height, j : j + width]
    return low >= LEAST_LOW


def unlocked_counts(
    events: Events, pixel: NDArray[np.int32], encoder: Encoder, size: tuple[int, int]
) -> NDArray[np.float64] | None:
    """How many events of each pixel do not repeat from turn to turn, shape (height, width); None under two turns.

    Signs by turn that add up to nothing make what repeats vanish. Events at random leave a sum whose square is, in the
    mean, their number: taken over low harmonics of the angle, both polarities and up to :data:`BLOCKS` spans of turns.
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
        # Thue and Morse's signs: two states that a pixel takes in turns cancel too
        sign = 1.0 - 2.0 * (np.bitwise_count(np.arange(turns.size)) & 1)
        slots = np.repeat(np.tile(np.arange(BINS, dtype=np.int32) * np.int32(channels), turns.size), lengths)
        key = slots + pixel[span] * np.int32(2) + events.p[span]
        folded = np.bincount(key, np.repeat(np.repeat(sign, BINS), lengths), minlength=BINS * channels)
        total += ((waves() @ folded.reshape(BINS, channels)) ** 2).mean(axis=0)
    return np.asarray(total.reshape(size[1], size[0], 2).sum(axis=2))


def waves() -> NDArray[np.float64]:
    """Low harmonics of the angle at the middle of its bins, each of mean square 1, shape (waves, BINS)."""
    phase = np.outer(np.arange(1, HARMONICS + 1), (np.arange(BINS) + 0.5) * (TURN / BINS))
    return np.concatenate([np.ones((1, BINS)), math.sqrt(2.0) * np.cos(phase), math.sqrt(2.0) * np.sin(phase)])


def bin_times(events: Events, encoder: Encoder) -> NDArray[np.int64]:
    """Times [us] between which the prism turns by one bin, of whole turns from the first event on, shape (n,)."""
    if not len(events):
        return np.zeros(1, np.int64)
    # noise of the encoder may step back; its angle must rise to be turned round
    way = 1.0 if encoder.rpm >= 0.0 else -1.0
    angle = np.maximum.accumulate(way * (encoder.angle - encoder.angle[0]))
    elapsed = (encoder.t - encoder.t[0]).astype(np.float64) - encoder.clock_offset_us
    ends = np.array([int(events.t[0]) - int(encoder.t[0]), int(events.t[-1]) + 1 - int(encoder.t[0])])
    first, last = np.interp(ends, elapsed, angle)
    bins = int((last - first) / TURN + 1e-3) * BINS
    marks = np.interp(first + np.arange(bins + 1) * (TURN / BINS), angle, elapsed)
    return np.rint(marks).astype(np.int64) + encoder.t[0]


# -- flicker


def _flickering(
    events: Events, pixel: NDArray[np.int32], encoder: Encoder, hot: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], tuple[float, ...]]:
    """Pixels that see a lamp, shape (height, width), and the lamps' frequencies [Hz]."""
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
        if all(round(hz) != round(other) for other in lamps):  # what is left of one that was found may be found anew
            lamps.append(hz)
    return found, tuple(lamps)


def _find_lamp(
    events: Events, pixel: NDArray[np.int32], turns_hz: float, without: NDArray[np.bool_]
) -> tuple[float, NDArray[np.bool_]] | None:
    """Frequency [Hz] of the strongest lamp, and the cells that see it, shape (rows, columns)."""
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
    best = int(np.argmax(seen >= 0.5 * seen.max()))  # a lamp's overtones may be nearly as strong
    cells = sees[:, best - 1 : best + 2].any(axis=1)
    fine = 8 * bins
    power = (np.abs(np.fft.rfft(signed[cells], fine, axis=1)) ** 2).sum(axis=0)[8 * best - 8 : 8 * best + 9]
    return (8 * best - 8 + int(np.argmax(power))) * 1e6 / (fine * BIN_US), cells.reshape(rows, -1)


def _signals(
    events: Events, pixel: NDArray[np.int32], without: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """ON minus OFF events by cell and time, (cells, bins), number of events by cell, (cells,), and rows of cells."""
    height, width = without.shape
    rows, columns = -(-height // CELL), -(-width // CELL)
    bins = int(events.t[-1] - events.t[0]) // BIN_US + 1
    at = np.searchsorted(events.t, int(events.t[0]) + np.arange(bins + 1) * BIN_US)
    y, x = np.indices(without.shape, np.int32)
    # pixels left out count to a cell of their own, the last
    cell = np.where(without, rows * columns, y // CELL * columns + x // CELL).astype(np.int32) * np.int32(bins)
    key = cell.ravel()[pixel] + np.repeat(np.arange(bins, dtype=np.int32), np.diff(at))
    shape = (rows * columns + 1, bins)
    count = np.bincount(key, minlength=shape[0] * bins).reshape(shape)[:-1]
    on = np.bincount(key, events.p, minlength=shape[0] * bins).reshape(shape)[:-1]
    return 2.0 * on - count, count.sum(axis=1).astype(np.float64), rows


def _largest_near(amplitude: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """The largest of the spectrum two bins off to ``reach`` bins off, either way: a line alone is two bins wide."""
    from scipy.ndimage import maximum_filter1d

    window = (reach - 1) | 1  # odd, so that it has a middle
    off = 2 + window // 2
    padded = np.pad(maximum_filter1d(amplitude, window, axis=1, mode="constant"), ((0, 0), (off, off)))
    n = amplitude.shape[1]
    return np.maximum(padded[:, :n], padded[:, 2 * off : 2 * off + n])


def _patch(
    events: Events, pixel: NDArray[np.int32], hz: float, cells: NDArray[np.bool_], without: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Pixels whose events rise and fall at a frequency [Hz], where the cells that see the lamp begin it."""
    from scipy import ndimage

    height, width = without.shape

    def around(weights: NDArray[np.float64] | None) -> NDArray[np.float64]:
        counted = np.bincount(pixel, weights, minlength=height * width).reshape(height, width)
        smooth = ndimage.uniform_filter(np.where(without, 0.0, counted), SMOOTHING, mode="mirror")
        return np.asarray(np.rint(smooth * SMOOTHING**2) if weights is None else smooth * SMOOTHING**2)

    angle = ((events.t - events.t[0]) * (hz * TURN * 1e-6)).astype(np.float32)
    sign = 2.0 * events.p - 1.0
    together, count = np.hypot(around(sign * np.cos(angle)), around(sign * np.sin(angle))), around(None)
    sees = (together >= LEAST_SHARE * count) & (together >= LEAST_SIGMA * np.sqrt(count)) & (count > 0.5)
    begin = np.kron(cells, np.ones((CELL, CELL), np.bool_))[:height, :width]
    patch = ndimage.binary_propagation(begin & sees, mask=sees)
    return np.asarray(ndimage.binary_fill_holes(patch))
