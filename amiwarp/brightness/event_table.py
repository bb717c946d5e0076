"""From events to pairs, on the device: sort the events by pixel, mark candidates for pairs, write the marked pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.pairs import PairSet, empty_pairs, running_count
from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents, check_sensor, join, time_span
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.kernels import pairs as pair_kernels
from amiwarp.kernels.encoder_pieces import encoder_params
from amiwarp.kernels.launch import launch

LARGEST_KEY = 2**31 - 1
"""Largest sort key of an event: its time span times the number of pixels, plus its pixel."""


class EventTable:
    """Events of one or more time spans on a device, sorted by pixel."""

    def __init__(
        self,
        spans: Sequence[Events | DeviceEvents],
        tile_of: Any,
        device: Any,
        *,
        joined: DeviceEvents | None = None,
    ) -> None:
        """Copy the events of the time spans to the device, without sorting them; a single span on it is not copied.

        ``joined`` gives the events of all spans, if they are on the device already. Only pixels with ``tile_of`` >= 0
        are used: shape (height, width), NumPy or on the device.
        """
        self.device = wp.get_device(device)
        if isinstance(tile_of, np.ndarray):
            tile_of = wp.array(tile_of, dtype=int, device=device)
        self.tile_of = tile_of
        self.spans = [span for span in spans if len(span)]
        given = [joined] if joined else self.spans
        for span in given:
            check_sensor(span)

        rows, columns = tile_of.shape
        # Pixels are sorted square by square, and squares at the border are whole.
        side = int(pair_kernels.SQUARE)
        whole_rows = math.ceil(rows / side) * side
        whole_columns = math.ceil(columns / side) * side
        self.arrays = pair_kernels.Sorted()
        self.arrays.columns = columns
        self.arrays.pixels = rows * columns
        self.arrays.places = whole_rows * whole_columns
        self.arrays.x = _upload([span.x for span in given], wp.uint16, self.device)
        self.arrays.y = _upload([span.y for span in given], wp.uint16, self.device)
        self.arrays.t = _upload([span.t for span in given], wp.int64, self.device)
        self.arrays.p = _upload([span.p for span in given], wp.uint8, self.device)
        self.arrays.count = 0

    @property
    def covers(self) -> tuple[int, int]:
        """Times of the first and the last event [us]."""
        ends = [time_span(span) for span in self.spans]
        return min(first for first, _ in ends), max(last for _, last in ends)

    def sort(self) -> None:
        """Sort the events by time span and pixel; within a pixel, events stay in time order."""
        device = self.device
        table = self.arrays
        events = len(table.x)
        is_inside = wp.empty(events, dtype=int, device=device)
        pixels = [table.x, table.y, self.tile_of]
        launch(pair_kernels.mark_inside, events, pixels, [is_inside], device=device)
        place, count = running_count(is_inside)
        table.count = count
        most_spans = LARGEST_KEY // table.places
        if len(self.spans) > most_spans:
            raise AmiwarpError(
                f"there are {len(self.spans)} time spans of {table.places} pixels; "
                f"their sort keys allow {most_spans}: calibrate from fewer spans"
            )

        # The sort needs twice the room.
        table.key = wp.empty(2 * count, dtype=int, device=device)
        table.order = wp.empty(2 * count, dtype=int, device=device)
        lengths = [len(span) for span in self.spans[:-1]]
        first_of_span = wp.array(np.cumsum([0, *lengths]), dtype=int, device=device)
        launch(
            pair_kernels.fill_keys,
            events,
            [*pixels, place, first_of_span, table.places],
            [table.key, table.order],
            device=device,
        )
        if count:
            largest_key = table.places * max(1, len(self.spans))
            bits = largest_key.bit_length()
            wp.utils.radix_sort_pairs(table.key, table.order, count, end_bit=bits)

    def pairs(
        self,
        encoder: Encoder,
        *,
        longest_gap_us: int,
        shortest_gap_us: float = 0.0,
        sensor: SensorTiming | None = None,
        middle_us: int = 0,
        weak: float = 0.0,
        window: tuple[int, int] | None = None,
        quiet: tuple[NDArray[np.int64], int] | None = None,
    ) -> PairSet:
        """Return pairs of consecutive events of each pixel.

        Their gap is at most ``longest_gap_us`` and more than ``shortest_gap_us``. With a ``window`` (start, stop) [us],
        pairs of open ends and of silence are added, with weight ``weak``:

        - Open ends: from the window's start to each pixel's first event, and from its last event to the stop. At the
          start, the brightness is anywhere within one threshold of the reference, so on average the first event finds
          it one threshold further. After the last event, it stays within one threshold. Without the pairs at the start,
          every edge that enters would look lower than when it leaves, and the map would slope.
        - Silence: ``quiet`` gives the increasing boundaries of time spans [us], and a number n. Used are runs of at
          least n successive spans in which a pixel does not fire. Silence is information: along the pixel's path, the
          brightness changed by no more than about one threshold.
        """
        self.sort()
        sensor = sensor or SensorTiming()
        times = pair_kernels.Window()
        times.start, times.stop = window or (0, 0)
        times.middle = middle_us
        times.longest = longest_gap_us
        times.shortest = shortest_gap_us
        times.late_first = sensor.pause_us - sensor.latency_us
        times.late_second = -sensor.latency_us
        device = self.device
        events = self.arrays.count

        # Mark the candidates: each event for a pair of two events, for one with the window's start and one with its
        # stop, then each pixel in each time span.
        kinds = 1 if window is None else 3
        candidates = kinds * events
        spans = 0
        if quiet is not None:
            edges, at_least = quiet
            spans = len(edges) - 1
        is_pair = wp.empty(candidates + spans * self.arrays.places, dtype=int, device=device)
        launch(pair_kernels.mark_pairs, events, [self.arrays, times], [is_pair], device=device)
        if window is not None:
            launch(pair_kernels.mark_ends, events, [self.arrays], [is_pair], device=device)
        if spans:
            edges_on_device = wp.array(edges, dtype=wp.int64, device=device)
            self._mark_quiet(edges_on_device, at_least, candidates, is_pair)

        # Count them.
        place, count = running_count(is_pair)
        if len(is_pair) == events:
            of_two_events = count
        elif events:
            of_two_events = int(place[events - 1 : events].numpy()[0])
        else:
            of_two_events = 0
        pairs = empty_pairs(count, device, weak=weak)
        if not count:
            return PairSet(pairs, device, 0)

        # Write them.
        t_first, t_last = self.covers
        if window is not None:
            window_start, window_stop = window
            t_first = min(t_first, window_start)
            t_last = max(t_last, window_stop)
        angles = encoder_params(encoder, t_first, t_last, device)
        inputs = [self.arrays, times, angles, self.tile_of, is_pair, place, kinds]
        launch(pair_kernels.write_pairs, events, inputs, [pairs], device=device)
        if spans:
            of_spans = empty_pairs(spans, device)
            inputs = [edges_on_device, times, angles]
            launch(pair_kernels.write_spans, spans, inputs, [of_spans], device=device)
            inputs = [of_spans, self.tile_of, candidates, is_pair, place]
            quiet_candidates = spans * self.arrays.places
            launch(pair_kernels.write_quiet, quiet_candidates, inputs, [pairs], device=device)
        return PairSet(pairs, device, of_two_events)

    def _mark_quiet(self, edges: Any, at_least: int, first: int, is_pair: Any) -> None:
        """Mark the time spans in which pixels are silent, whose candidates start at index ``first`` of ``is_pair``.

        ``edges``: boundaries of the spans [us]; ``at_least``: number of successive spans from which silence counts.
        """
        spans = len(edges) - 1
        fired = wp.zeros(spans * self.arrays.pixels, dtype=wp.uint8, device=self.device)
        launch(
            pair_kernels.mark_spans,
            len(self.arrays.x),
            [self.arrays, edges],
            [fired],
            device=self.device,
        )
        launch(
            pair_kernels.mark_quiet,
            self.arrays.places,
            [fired, self.tile_of, at_least, first],
            [is_pair],
            device=self.device,
        )

    def exclude_hot_pixels(self) -> NDArray[np.int32]:
        """Exclude pixels that fire far more often than the busiest pixels around them, by setting ``tile_of`` to -1.

        Returns the number of events of each pixel, shape (height, width).
        """
        device = self.device
        count = wp.zeros(self.arrays.pixels, dtype=int, device=device)
        events = len(self.arrays.x)
        launch(
            pair_kernels.count_pixels,
            events,
            [self.arrays],
            [count],
            device=device,
            smallest=events + 1,  # One CPU thread only: several would add to the same counters.
        )
        image = count.reshape(self.tile_of.shape)
        tiles = self.tile_of.flatten()
        launch(pair_kernels.mark_hot, len(count), [image, 0], [tiles], device=device)
        counts: NDArray[np.int32] = image.numpy()
        return counts


def _upload(parts: Sequence[NDArray[Any] | wp.array], dtype: Any, device: Any) -> Any:
    """Return the values of arrays as one array on a device. NumPy arrays are joined first: many copies take longer."""
    if not parts:
        return wp.empty(0, dtype=dtype, device=device)
    if isinstance(parts[0], wp.array):
        return join(parts).to(device)
    values = parts[0] if len(parts) == 1 else np.concatenate(parts)
    contiguous = np.ascontiguousarray(values)
    return wp.array(contiguous, dtype=dtype, device=device, copy=False)
