"""Sums in phase of events on a GPU, which stay there: nothing is copied until it is asked for.

The arrays of one size are made once. So launches can be captured that read the sums.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.device_events import DeviceEvents, EventRange, check_sensor, time_span
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
        self.marks = wp.zeros(kernels.MARKS, dtype=int, device=self.device)
        """Number of ON events, and whether a pixel has too many events: see :meth:`notes_of`."""
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
        # Made once: launches compare arguments by identity
        self._size = wp.vec2i(width, bins)
        self._counts_flat = self.counts.reshape((3, pixels))
        self._values_flat = self.values.reshape((harmonics, pixels))
        self._known_flat = self.known.flatten()
        self._encoder: Encoder | None = None
        self._coverage = (0, 0)
        self._way = 0  # of the encoder, if it never turns back
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
        direction: int = 0,
        off_ratio: float | None = None,
    ) -> None:
        """Sum sorted events inside the sensor. The parameters are as in :func:`phase_sums`, already checked."""
        if isinstance(angles, Encoder):
            there = self._columns(events)
            span = time_span(events) if len(events) else (0, 0)
            part = EventRange(0, len(events), *span)
            self.sum_range(
                there, part, angles, turns=turns, direction=direction, off_ratio=off_ratio
            )
            return
        uploaded = upload_events(events, angles, self.device).arrays
        self._begin(len(events), turns, direction, off_ratio)
        self._count_on(uploaded.layer, 0)
        inputs = [uploaded, self.width, self.bins]
        self._launch(kernels.pixel_words, self.count, inputs, [self._keys, self._rows])
        self._finish()

    def sum_range(
        self,
        events: DeviceEvents,
        part: EventRange,
        encoder: Encoder,
        *,
        turns: float,
        direction: int = 0,
        off_ratio: float | None = None,
    ) -> None:
        """Sum a part of events that are on the device, as :meth:`sum` does. No array is made.

        By default the direction is that from the first event to the last one.
        """
        check_sensor(events)
        pieces = self._pieces_of(encoder, part)
        direction = direction or self._direction(encoder, part)
        self._begin(part.number, turns, direction, off_ratio)
        self._count_on(events.p, part.first)
        inputs = [events.x, events.y, events.t, events.p, pieces, part.first, self._size]
        self._launch(kernels.timed_words, self.count, inputs, [self._keys, self._rows])
        self._finish()

    def _columns(self, events: Events | DeviceEvents) -> DeviceEvents:
        """Return events on the device, without a check of their values."""
        check_sensor(events)
        if isinstance(events, DeviceEvents):
            return events
        types = {"x": wp.uint16, "y": wp.uint16, "t": wp.int64, "p": wp.uint8}
        return DeviceEvents(
            **{
                name: wp.array(getattr(events, name), dtype=kind, device=self.device)
                for name, kind in types.items()
            }
        )

    def _begin(self, count: int, turns: float, direction: int, off_ratio: float | None) -> None:
        """Note what is summed, and make room for the words of the events."""
        self.turns = turns
        self.count = count
        self._given_ratio = off_ratio
        self._scale(turns, direction)
        self.marks.zero_()
        if len(self._keys) < 2 * count:  # the sort needs twice the room
            self._keys = wp.empty(2 * count, dtype=int, device=self.device)
            self._rows = wp.empty(2 * count, dtype=int, device=self.device)

    def _finish(self) -> None:
        """Sum the events of all pixels, by their words."""
        self._weigh_table()
        self._order()
        pixels = len(self._starts) - 1
        inputs = [self._rows, self._starts, self._table, self._scales]
        threads = math.ceil(self.harmonics / kernels.AT_ONCE) * pixels
        self._launch(kernels.sum_pixels, threads, inputs, [self._counts_flat, self._values_flat])
        inputs = [self._counts_flat, self._ratio, MOST_EVENTS]
        outputs = [self._known_flat, self.marks]
        self._launch(kernels.known_pixels, pixels, inputs, outputs)

    def notes(self) -> tuple[float, bool]:
        """Return the OFF threshold over the ON threshold, and whether a pixel has too many events for its sums."""
        off_ratio, full = self.notes_of(self.marks.numpy(), self.count)
        if self._given_ratio is not None:
            return self._given_ratio, full
        return off_ratio, full

    @staticmethod
    def notes_of(marks: NDArray[np.int32], count: int) -> tuple[float, bool]:
        """Return what :meth:`notes` does, by a copy of :attr:`marks`, if the ratio was not given."""
        on = int(marks[kernels.ON])
        return ratio_of_counts(on, count - on), bool(marks[kernels.FULL])

    def _pieces_of(self, encoder: Encoder, part: EventRange) -> Any:
        """Return the whole encoder on the device, which is made once. It covers the events, or raises."""
        if self._encoder is not encoder:
            self._coverage = encoder.coverage
            self._pieces = encoder_params(encoder, *self._coverage, self.device)
            self._encoder = encoder
            steps = np.sign(np.diff(encoder.angle))
            self._way = int(steps[0]) if (steps == steps[0]).all() else 0
        first_us, last_us = self._coverage
        if part.number and (part.first_us < first_us or part.last_us > last_us):
            encoder.angle_at(np.array([part.first_us, part.last_us]))
        return self._pieces

    def _direction(self, encoder: Encoder, part: EventRange) -> int:
        """Return the direction in which the optic turns from the first event to the last one, 1 without a turn."""
        if part.first_us == part.last_us:
            return 1
        if self._way:
            return self._way
        before, after = encoder.angle_at(np.array([part.first_us, part.last_us]))
        return 1 if after >= before else -1

    def _scale(self, turns: float, direction: int) -> None:
        """Set the factors of the integers, if they are other ones than before."""
        if self._scaled_for != (turns, direction):
            scales = scales_of(self.harmonics, self.bins, turns, direction)
            self._scales.assign(scales.astype(np.float32))
            self._scaled_for = turns, direction

    def _count_on(self, polarity: wp.array, first: int) -> None:
        """Count the ON events, from ``first`` on, unless the ratio of the thresholds is given."""
        if self._given_ratio is not None or not self.count:
            return
        threads = min(self.count, COUNTING_THREADS) if self.device.is_cuda else 1
        inputs = [polarity, first, threads, self.count]
        self._launch(kernels.count_on, threads, inputs, [self.marks])

    def _weigh_table(self) -> None:
        """Make the table of what an event adds to its pixel, with the ratio of the thresholds."""
        given = 0.0 if self._given_ratio is None else self._given_ratio
        inputs = [self._pairs, self.marks, self.count, given, LEAST_RATIO, self._extreme]
        rows = 2 * self.bins * self.harmonics
        self._launch(kernels.weigh_table, rows, inputs, [self._table, self._ratio])

    def _order(self) -> None:
        """Order the words of the events by pixels, and find the first of each pixel."""
        count = self.count
        pixels = len(self._starts) - 1
        if count:
            wp.utils.radix_sort_pairs(self._keys, self._rows, count, end_bit=pixels.bit_length())
        self._launch(kernels.first_words, pixels + 1, [self._keys, count], [self._starts])
