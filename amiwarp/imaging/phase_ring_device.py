"""A ring of the last turn of a stream on a GPU: events are counted there, and sums and what moved stay there.

What differs from picture to picture is copied to the device at once, so that the launches of a picture can be captured.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.imaging.phase import BINS, RANDOM_CHANGE
from amiwarp.imaging.phase_ring import (
    LEAST_EVENTS,
    WEIGHT_OF_PRIOR,
    PhaseRing,
    square_of_event,
    unmixing,
)
from amiwarp.imaging.phase_tables import EXTREME
from amiwarp.kernels import phase_ring_device as kernels
from amiwarp.kernels.launch import RepeatedLaunches
from amiwarp.kernels.phase_misfit import AROUND


class DeviceRing(PhaseRing):
    """The events of the last turn as :class:`PhaseRing` has them, and the sums up to the last picture, on a device.

    Tests run it on a CPU, too.
    """

    def __init__(self, width: int, height: int, harmonics: int, device: Any) -> None:
        self.device = wp.get_device(device)
        super().__init__(width, height, harmonics=harmonics)
        pixels = width * height
        groups = -(-harmonics // kernels.AT_ONCE)
        self.values = self._empty((harmonics, height, width), wp.vec2)
        """Sums up to the last picture."""
        self.values.zero_()
        self.known = self._empty((height, width), wp.uint8)
        """1 for pixels with a sum."""
        self.misfit = self._empty((height, width), float)
        """Share of the newest brightness around a pixel that the sums before did not lead to expect, 0 to 1."""
        self._expected = self._empty((harmonics, pixels), wp.vec2)
        self._counts = self._empty((3, pixels), int)
        self._squares = self._empty((2, groups * pixels), float)
        self._of_pixels = self._empty(pixels, wp.vec2)
        rows = BINS + 2 * harmonics
        table = int(kernels.TABLE)
        self._given = wp.zeros(table + 2 * harmonics * rows, dtype=float, device=self.device)
        self._tables: dict[tuple[int, int, bool, int], tuple[NDArray[np.float32], float]] = {}
        self.ratio = 1.0
        """OFF threshold divided by the ON threshold, of the sums."""
        self.events = 0
        """Number of events of the newest part."""
        self._launch = RepeatedLaunches(self.device)

    def _empty(self, shape: Any, dtype: Any) -> wp.array:
        """Return an array on the device, without values."""
        return wp.empty(shape, dtype=dtype, device=self.device)

    def _make_planes(self) -> None:
        pixels = self.width * self.height
        self._words = wp.zeros((self._slots, pixels), dtype=int, device=self.device)

    def _clear_plane(self, slot: int) -> None:
        self._words[slot].zero_()

    def _add_to_plane(self, slot: int, events: Events) -> None:
        pixels = events.y.astype(np.int32) * self.width + events.x
        words = wp.array(2 * pixels + (events.p != 0), dtype=int, device=self.device)
        count = len(events)
        # On a CPU two threads must not add to one word
        self._launch(kernels.add_words, count, [words, slot], [self._words], smallest=count)

    def give(self, bins: int, *, first: bool) -> None:
        """Say which of the last bins are summed next. ``first`` forgets the sums before, for a whole turn."""
        numbers = self._last_bins(bins / BINS)
        table, noise = self._table_of(numbers, first)
        self.ratio = self._off_ratio()
        slots = numbers % self._slots
        self.events = int(self._on[slots].sum() + self._off[slots].sum())
        given = np.zeros(len(self._given), np.float32)
        given[kernels.RATIO] = self.ratio
        given[kernels.USED] = bins
        given[kernels.NOISE] = noise
        # Nothing has moved before there is something to compare with
        given[kernels.LEAST] = np.inf if first else noise * LEAST_EVENTS
        given[kernels.EXTREME] = EXTREME
        given[kernels.OF_CHANGE] = RANDOM_CHANGE
        chosen = self._with_earlier(numbers)
        given[kernels.EARLIER] = len(chosen) - bins
        given[kernels.SLOTS : kernels.SLOTS + len(chosen)] = chosen % self._slots
        given[kernels.TABLE :] = table
        self._given.assign(given)

    def _table_of(
        self, numbers: NDArray[np.int64], first: bool
    ) -> tuple[NDArray[np.float32], float]:
        """Return the table for bins, and the square that an event at a random angle adds. Each is made once."""
        key = (int(numbers[0]) % BINS, len(numbers), first, self.direction)
        if key not in self._tables:
            weight = 0.0 if first else WEIGHT_OF_PRIOR
            factors, expected = unmixing(self._angles(numbers), self.harmonics, weight)
            table = np.zeros((BINS + 2 * self.harmonics, self.harmonics), np.complex64)
            table[: len(numbers)] = self.direction * factors.T
            table[BINS:] = expected.T
            flat = np.ascontiguousarray(table).view(np.float32).ravel()
            self._tables[key] = flat, square_of_event(factors)
        return self._tables[key]

    def sum_given(self) -> None:
        """Update the sums by the bins that were given, and find how much of them was not expected."""
        shape = (self.harmonics, self.width * self.height)
        values = self.values.reshape(shape)
        wp.copy(self._expected, values)
        inputs = [self._words, self._given, self._expected]
        outputs = [values, self._counts, self.known.flatten(), self._squares]
        self._launch(kernels.sum_bins, self._squares.shape[1], inputs, outputs)
        inputs = [self._squares, self._counts, self._given]
        self._launch(kernels.without_noise, shape[1], inputs, [self._of_pixels])
        inputs = [self._of_pixels, self._given, AROUND // 2]
        self._launch(kernels.misfit_around, shape[1], inputs, [self.misfit])
