"""Compensation of pieces of events on a GPU, through page-locked buffers that threads share."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.kernels.compensation import Columns, LaunchPlan
from amiwarp.kernels.launch import RecordedLaunch
from amiwarp.kernels.page_locked_memory import page_locked

INPUTS = {"x": wp.uint16, "y": wp.uint16, "t": wp.int64}
"""Types of the columns that the kernel reads."""
RESULTS = {"out_x": wp.float32, "out_y": wp.float32, "inside": wp.uint8}
"""Types of the columns that the kernel writes."""
BUFFERS = 3
"""Number of pieces that threads process on the GPU at a time. Page-locking the memory of a piece takes 5 ms."""
PIECE = 4 * CHUNK
"""Number of events that a thread reads, compensates and writes at a time. With fewer, threads wait more often for
Python's lock; more events need more memory."""


class PieceBuffers:
    """Page-locked memory and memory on a GPU for one piece of events."""

    def __init__(self, capacity: int, plan: LaunchPlan, encoder: Any, device: Any) -> None:
        """Allocate memory for ``capacity`` events."""
        self.room = capacity
        self._plan = plan
        self._encoder = encoder
        self._device = device
        self._done = wp.Event(device)
        self._columns = Columns()
        self._locked = {}
        self._host = {}
        for name, dtype in (INPUTS | RESULTS).items():
            on_device = wp.empty(capacity, dtype=dtype, device=device)
            setattr(self._columns, name, on_device)
            locked = page_locked(self, (capacity,), dtype, device, written_by_host=name in INPUTS)
            self._locked[name] = locked
            self._host[name] = locked.numpy()
        self._launches: dict[bool, RecordedLaunch] = {}

    def put(self, events: Events) -> None:
        """Copy events to the page-locked memory."""
        count = len(events)
        for name in INPUTS:
            self._host[name][:count] = getattr(events, name)

    def start(self, n: int, outside: bool) -> None:
        """Start the compensation of ``n`` events. ``outside``: whether events may lie outside the sensor."""
        for name in INPUTS:
            wp.copy(getattr(self._columns, name), self._locked[name], count=n)
        compensate = self._launches.get(outside)
        if compensate is None:
            inputs = self._plan.inputs(self._encoder, self._columns, outside=outside)
            compensate = RecordedLaunch(self._plan.kernel, [*inputs, 0], [], device=self._device)
            self._launches[outside] = compensate
        compensate(0, n)
        for name in RESULTS:
            wp.copy(self._locked[name], getattr(self._columns, name), count=n)
        self._device.stream.record_event(self._done)

    def take(self, results: list[NDArray[Any]]) -> None:
        """Wait for the GPU, and store x and y [px] and 1 for each event inside the image in arrays."""
        wp.synchronize_event(self._done)
        for name, values in zip(RESULTS, results, strict=True):
            values[:] = self._host[name][: len(values)]


class GpuPieces:
    """Compensation of pieces of events on a GPU. Any thread may call it."""

    def __init__(self, plan: LaunchPlan, encoder: Any, device: Any) -> None:
        self._plan = plan
        self._encoder = encoder
        self._device = device
        self._free = threading.Semaphore(BUFFERS)
        self._idle: list[PieceBuffers] = []
        self.one_thread = threading.Lock()
        """Lock for launches and copies, because Warp's bookkeeping on CUDA allows one thread at a time."""

    def __call__(self, events: Events) -> list[NDArray[Any]]:
        """Return compensated x and y [px] and 1 for each event inside the image, shape ``(n,)``."""
        count = len(events)
        largest_x = int(events.x.max())
        largest_y = int(events.y.max())
        outside = self._plan.any_outside(largest_x, largest_y)
        results = []
        for dtype in RESULTS.values():
            results.append(np.empty(count, wp.dtype_to_numpy(dtype)))
        for first in range(0, count, PIECE):
            piece = slice(first, first + PIECE)
            self._run(events[piece], outside, [column[piece] for column in results])
        return results

    def _run(self, events: Events, outside: bool, results: list[NDArray[Any]]) -> None:
        """Compensate one piece, and store its columns in ``results``."""
        with self._free:
            buffers = self._buffers(len(events))
            buffers.put(events)
            with self.one_thread:
                buffers.start(len(events), outside)
            buffers.take(results)
            self._idle.append(buffers)

    def _buffers(self, n: int) -> PieceBuffers:
        """Return idle or new buffers for ``n`` events; idle ones that are too small are dropped."""
        with self.one_thread:
            while self._idle:
                buffers = self._idle.pop()
                if buffers.room >= n:
                    return buffers
            # A power of two, so that blocks of growing size seldom need new buffers.
            capacity = 1 << (n - 1).bit_length()
            return PieceBuffers(capacity, self._plan, self._encoder, self._device)
