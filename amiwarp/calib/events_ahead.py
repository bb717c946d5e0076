"""Events of time spans, copied to a GPU in the background while the sharpness stage runs."""

from __future__ import annotations

from concurrent.futures import wait
from contextlib import AbstractContextManager, ExitStack, nullcontext
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.calib.photometric.pair_spans import most_pairs, time_spans
from amiwarp.events.device_events import NAMES, DeviceEvents
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.kernels.workers import pool
from amiwarp.tasks import no_garbage_collection

if TYPE_CHECKING:
    from amiwarp.calib.sharpness_search import Search

EVENTS_PER_PAIR = 10
"""Number of events that are copied ahead for each wanted pair. The tiles hold about a tenth of the events as pairs."""
TYPES = (wp.uint16, wp.uint16, wp.int64, wp.uint8)


def upload_ahead(
    recording: Recording, search: Search
) -> AbstractContextManager[EventsAhead | None]:
    """Start to copy the events that the photometric stage will probably need to a GPU.

    Only events in memory are copied. On a CPU, or without a photometric stage, the context gives None.
    """
    device = wp.get_device(search.device)
    source = recording.events
    settings = search.settings
    if device.is_cpu or "photometric" not in settings.stages:
        return nullcontext()
    if not isinstance(source, MemoryEvents):
        return nullcontext()
    most = EVENTS_PER_PAIR * most_pairs(search)
    return EventsAhead(source, time_spans(recording, search), most, device)


class EventsAhead:
    """Events of the first of some time spans, which a thread copies to a GPU. Closed by ``with``."""

    def __init__(
        self, source: MemoryEvents, spans: list[tuple[int, int]], most: int, device: Any
    ) -> None:
        """Start to copy the events of the first of ``spans`` [us], at most ``most`` events in all."""
        self._device = wp.get_device(device)
        self._parts: list[Events] = []
        self._first = [0]
        for part in (source.between(*span) for span in spans):
            if self._first[-1] + len(part) > most:
                break
            self._parts.append(part)
            self._first.append(self._first[-1] + len(part))
        self._spans = spans[: len(self._parts)]
        n = self._first[-1]
        self._events = DeviceEvents(
            *(wp.empty(n, dtype=dtype, device=self._device) for dtype in TYPES)
        )
        self._stream = wp.Stream(self._device)  # Warp's own one may be recording a graph
        self._stream.wait_stream(self._device.stream)  # which allocated the arrays
        # Warp's recording of a graph fails if another thread frees memory of the GPU, which a collector may do there
        self._copying = ExitStack()
        self._copying.enter_context(no_garbage_collection())
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
        self._copying.close()
        self._device.stream.wait_stream(self._stream)

    def __enter__(self) -> EventsAhead:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._wait()  # the memory must not be freed before
