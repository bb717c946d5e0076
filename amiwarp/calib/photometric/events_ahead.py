"""Events of time spans, copied to a GPU in the background while the sharpness stage runs."""

from __future__ import annotations

from concurrent.futures import wait
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.events.device_events import NAMES, DeviceEvents
from amiwarp.kernels.launch import pool

if TYPE_CHECKING:
    from types import TracebackType

    from amiwarp.events.events import Events, MemoryEvents

TYPES = (wp.uint16, wp.uint16, wp.int64, wp.uint8)


class EventsAhead:
    """Events of the first of some time spans, which a thread copies to a GPU. Closed by ``with``."""

    def __init__(self, source: MemoryEvents, spans: list[tuple[int, int]], most: int, device: Any) -> None:
        """Start to copy the events of the first of ``spans`` [us], at most ``most`` events in all."""
        self._device = wp.get_device(device)
        self._parts: list[Events] = []
        self._first = [0]
        for part in (source.between(*span) for span in spans):
            if self._first[-1] + len(part) > most:
                break
            self._parts.append(part)
            self._first.append(self._first[-1] + len(part))
        self._spans, n = spans[: len(self._parts)], self._first[-1]
        self._events = DeviceEvents(*(wp.empty(n, dtype=dtype, device=self._device) for dtype in TYPES))
        self._stream = wp.Stream(self._device)  # Warp's own one may be recording a graph
        self._stream.wait_stream(self._device.stream)  # which allocated the arrays
        self._copied = pool().submit(self._copy)

    def _copy(self) -> None:
        for name in NAMES:
            out = getattr(self._events, name)
            for first, part in zip(self._first, self._parts, strict=False):
                values = np.ascontiguousarray(getattr(part, name))
                if len(values):
                    host = wp.array(values, dtype=out.dtype, device="cpu", copy=False)
                    wp.copy(out, host, dest_offset=first, stream=self._stream)

    def take(self, spans: list[tuple[int, int]]) -> DeviceEvents | None:
        """Return the events of successive ``spans``, joined; None if not all of them were copied."""
        if not {*spans} <= {*self._spans}:
            return None
        self._wait()
        if self._copied.exception() is not None:
            return None
        first = self._spans.index(spans[0])
        return self._events[self._first[first] : self._first[first + len(spans)]]

    def _wait(self) -> None:
        wait([self._copied])
        self._device.stream.wait_stream(self._stream)

    def __enter__(self) -> EventsAhead:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._wait()  # the memory must not be freed before
