"""Buffer on the device for the events that pixels generate, as sortable keys."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import event_keys, pixels, workers

CPU_RUN = 8192
"""Number of consecutive pixels per task of a CPU thread."""
CUDA_SEGMENTS = 1024
"""Number of event buffers on CUDA; buffer k gets the events of pixels k, k + 1024, k + 2048, …"""
CACHE_LINE = 64
"""Distance between the event counters of CPU threads in memory [bytes].

Threads whose counters share a cache line would slow each other down.
"""
EVENTS_PER_PIXEL = 128
"""Initial capacity of the event buffer of a chunk [events per pixel]. The buffer grows if necessary."""


class KeyBuffer:
    """Buffer for the event keys of a chunk, in segments of pixels. The buffer grows if a chunk has more events."""

    def __init__(self, count: int, device: Any, per_pixel: int | None = None) -> None:
        """Allocate the buffer for ``count`` pixels, with room for ``per_pixel`` events of each, or the default."""
        self._pixels = count
        self._device = device
        self._sink = pixels.Sink()
        if device.is_cpu:
            self._segments = -(-count // CPU_RUN)
            self._sink.run = CPU_RUN
            columns = CACHE_LINE // 4
        else:
            self._segments = min(CUDA_SEGMENTS, count)
            self._sink.run = 1
            columns = 1
        self._sink.count = wp.zeros((self._segments, columns), dtype=int, device=device)
        of_segment = -(-count // self._segments)
        self._reserve((per_pixel or EVENTS_PER_PIXEL) * of_segment)
        self._before: list[wp.array] = []
        """The pixels' state before a chunk, from which it runs again if the buffer was too small."""

    def _reserve(self, capacity: int) -> None:
        """Allocate room for ``capacity`` keys per segment."""
        self._capacity = capacity
        self._sink.keys = wp.empty((self._segments, capacity), dtype=wp.int64, device=self._device)

    def run(
        self, kernel: Any, inputs: list[Any], state: list[wp.array], carry: wp.array
    ) -> wp.array:
        """Simulate the pixels over a chunk and return the keys of their events, unsorted, with ``carry`` appended.

        The kernel gets the ``inputs``, then the pixels' ``state``. The array has twice the needed length, because
        sorting on CUDA needs scratch memory behind the keys.
        """
        if len(self._before) != len(state):
            self._before = [wp.empty_like(values) for values in state]
        while True:
            self._sink.count.zero_()
            self._launch(kernel, inputs, state)
            counts = self._sink.count.numpy()[:, 0]
            if counts.max() <= self._capacity:
                return self._pack(counts, carry)

            # The buffer was too small: run again from the same state.
            for values, copy in zip(state, self._before, strict=True):
                wp.copy(values, copy)
            self._reserve(int(counts.max()) * 5 // 4)

    def _pack(self, counts: NDArray[np.int32], carry: wp.array) -> wp.array:
        """Join the segments' keys and ``carry`` without gaps."""
        ends = np.cumsum(counts, dtype=np.int64)
        n = int(ends[-1]) + len(carry)
        keys = wp.empty(2 * n, dtype=wp.int64, device=self._device)
        if self._device.is_cpu:
            rows = self._sink.keys.numpy()
            parts = [row[:count] for row, count in zip(rows, counts.tolist(), strict=True)]
            np.concatenate([*parts, carry.numpy()], out=keys.numpy()[:n])
            return keys
        offset = wp.array((ends - counts).astype(np.int32), dtype=int, device=self._device)
        wp.launch(
            event_keys.pack,
            dim=(self._segments, int(counts.max())),
            inputs=[self._sink, offset, keys],
            device=self._device,
        )
        if len(carry):
            wp.copy(keys, carry, dest_offset=int(ends[-1]))
        return keys

    def _launch(self, kernel: Any, inputs: list[Any], state: list[wp.array]) -> None:
        """Keep the state of all pixels, and launch the kernel that simulates them."""

        def run(start: int, stop: int) -> None:
            given = [*inputs, *state, start, self._sink]
            wp.launch(kernel, dim=stop - start, inputs=given, device=self._device)

        if not self._device.is_cpu:
            for values, copy in zip(state, self._before, strict=True):
                wp.copy(copy, values)
            run(0, self._pixels)
            return
        values_in_bytes = [_in_bytes(values) for values in state]
        copies_in_bytes = [_in_bytes(values) for values in self._before]

        def keep_and_run(start: int, stop: int) -> None:
            """Keep the state of some pixels, which then lies in the core's cache, and run them."""
            for values, copy in zip(values_in_bytes, copies_in_bytes, strict=True):
                copy[start:stop] = values[start:stop]
            run(start, stop)

        starts = range(0, self._pixels, CPU_RUN)
        stops = [min(start + CPU_RUN, self._pixels) for start in starts]
        list(workers.pool().map(keep_and_run, starts, stops))


def _in_bytes(values: wp.array) -> NDArray[np.uint8]:
    """Return the memory of an array on the CPU, one row of bytes for each element."""
    return values.numpy().view(np.uint8).reshape(len(values), -1)


def sort_keys(keys: wp.array, total: int, lowest: int, top: int) -> None:
    """Sort the first ``total`` keys by their bits from ``lowest`` to below ``top``.

    Without a row scan, no two events of a pixel share a microsecond, so that bits below the pixel's need no sorting.
    """
    if keys.device.is_cpu:
        keys.numpy()[:total].sort()  # shares the memory of keys
        return
    order = wp.empty(2 * total, dtype=wp.int32, device=keys.device)
    wp.utils.radix_sort_pairs(keys, order, total, begin_bit=lowest, end_bit=top)
