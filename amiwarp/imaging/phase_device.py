"""Sums in phase of events on a GPU, which stay there: nothing is copied until it is asked for.

The arrays of one size are made once. So launches can be captured that read the sums.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.device_events import DeviceEvents, time_span
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.phase_tables import (
    EXTREME,
    LEAST_RATIO,
    MOST_EVENTS,
    angle_pairs,
    ratio_of_counts,
    scales_of,
)
from amiwarp.imaging.uploaded_events import upload_events
from amiwarp.kernels import phase_pixels as kernels
from amiwarp.kernels.encoder_pieces import encoder_params
from amiwarp.kernels.launch import RepeatedLaunches

COUNTING_THREADS = 1 << 14
"""Number of threads that count the ON events on CUDA."""


class DeviceSums:
    """Sums in phase of each pixel, and its numbers of events, on a device, from the last :meth:`sum`.

    Tests run it on a CPU, too.
    """

    def __init__(
        self, width: int, height: int, harmonics: int, bins: int, device: Any, *, extremes: bool
    ) -> None:
        self.device = wp.get_device(device)
        self.extremes = extremes
        """Whether the extremes of the brightness are added."""
        self.turns = 1.0
        """Number of turns over which the events were summed."""
        self.width = width
        self.height = height
        pixels = width * height
        self.values = wp.empty((harmonics, height, width), dtype=wp.vec2, device=self.device)
        """Sums A_1, A_2, … [thresholds], for a single turn."""
        self.counts = wp.empty((3, height, width), dtype=int, device=self.device)
        """Numbers of OFF events, ON events and changes of polarity."""
        self.known = wp.empty((height, width), dtype=wp.uint8, device=self.device)
        """1 for pixels with events."""
        self.count = 0
        """Number of events that were summed."""
        self._marks = wp.zeros(kernels.MARKS, dtype=int, device=self.device)
        self._ratio = wp.empty(1, dtype=wp.float64, device=self.device)
        self._given_ratio: float | None = None
        self._extreme = EXTREME if extremes else 0.0
        pairs = np.ascontiguousarray(angle_pairs(bins, harmonics).transpose(1, 0, 2))
        self._pairs = wp.array(pairs, dtype=wp.vec2d, device=self.device)
        self._table = wp.empty((harmonics, 4 * bins), dtype=wp.vec2i, device=self.device)
        self._scales = wp.empty(harmonics, dtype=float, device=self.device)
        self._scaled_for: tuple[float, int] | None = None
        self._starts = wp.empty(pixels + 1, dtype=int, device=self.device)
        self._keys = wp.empty(0, dtype=int, device=self.device)
        self._rows = wp.empty(0, dtype=int, device=self.device)
        self._encoder: Encoder | None = None
        self._pieces: Any = None
        self._launch = RepeatedLaunches(self.device)

    @property
    def harmonics(self) -> int:
        """Number of harmonics."""
        return int(self.values.shape[0])

    @property
    def bins(self) -> int:
        """Number of bins of a turn."""
        return int(self._pairs.shape[1])

    def sum(
        self,
        events: Events | DeviceEvents,
        angles: Encoder | NDArray[np.float64],
        *,
        turns: float,
        direction: int,
        off_ratio: float | None = None,
    ) -> None:
        """Sum sorted events inside the sensor. The parameters are as in :func:`phase_sums`, already checked."""
        self.turns = turns
        self.count = len(events)
        self._given_ratio = off_ratio
        self._scale(turns, direction)
        pieces = None
        if self.count and isinstance(angles, Encoder):
            pieces = self._pieces_of(angles, events)
        uploaded = upload_events(events, angles, self.device, pieces=pieces).arrays
        self._marks.zero_()
        if off_ratio is None:
            self._count_on(uploaded.layer)
        self._weigh_table()
        self._order(uploaded)
        pixels = len(self._starts) - 1
        counts = self.counts.reshape((3, pixels))
        values = self.values.reshape((self.harmonics, pixels))
        inputs = [self._rows, self._starts, self._table, self._scales]
        self._launch(kernels.sum_pixels, self.harmonics * pixels, inputs, [counts, values])
        inputs = [counts, self._ratio, MOST_EVENTS]
        outputs = [self.known.flatten(), self._marks]
        self._launch(kernels.known_pixels, pixels, inputs, outputs)

    def notes(self) -> tuple[float, bool]:
        """Return the OFF threshold over the ON threshold, and whether a pixel has too many events for its sums."""
        marks = self._marks.numpy()
        full = bool(marks[kernels.FULL])
        if self._given_ratio is not None:
            return self._given_ratio, full
        on = int(marks[kernels.ON])
        return ratio_of_counts(on, self.count - on), full

    def _pieces_of(self, encoder: Encoder, events: Events | DeviceEvents) -> Any:
        """Return the whole encoder on the device, which is made once. It covers the events, or raises."""
        first_us, last_us = encoder.coverage
        span = time_span(events)
        if span[0] < first_us or span[1] > last_us:
            encoder.angle_at(np.array(span))
        if self._encoder is not encoder:
            self._pieces = encoder_params(encoder, first_us, last_us, self.device)
            self._encoder = encoder
        return self._pieces

    def _scale(self, turns: float, direction: int) -> None:
        """Set the factors of the integers, if they are other ones than before."""
        if self._scaled_for != (turns, direction):
            scales = scales_of(self.harmonics, self.bins, turns, direction)
            self._scales.assign(scales.astype(np.float32))
            self._scaled_for = turns, direction

    def _count_on(self, polarity: wp.array) -> None:
        """Count the ON events."""
        threads = min(max(self.count, 1), COUNTING_THREADS) if self.device.is_cuda else 1
        inputs = [polarity, threads, self.count]
        wp.launch(kernels.count_on, threads, inputs, [self._marks], device=self.device)

    def _weigh_table(self) -> None:
        """Make the table of what an event adds to its pixel, with the ratio of the thresholds."""
        given = 0.0 if self._given_ratio is None else self._given_ratio
        inputs = [self._pairs, self._marks, self.count, given, LEAST_RATIO, self._extreme]
        rows = 2 * self.bins * self.harmonics
        self._launch(kernels.weigh_table, rows, inputs, [self._table, self._ratio])

    def _order(self, arrays: Any) -> None:
        """Order the events by pixels, and find the first of each pixel."""
        count = self.count
        pixels = len(self._starts) - 1
        if len(self._keys) < 2 * count:  # the sort needs twice the room
            self._keys = wp.empty(2 * count, dtype=int, device=self.device)
            self._rows = wp.empty(2 * count, dtype=int, device=self.device)
        inputs = [arrays, self.width, self.bins]
        self._launch(kernels.pixel_words, count, inputs, [self._keys, self._rows])
        if count:
            wp.utils.radix_sort_pairs(self._keys, self._rows, count, end_bit=pixels.bit_length())
        self._launch(kernels.first_words, pixels + 1, [self._keys, count], [self._starts])
