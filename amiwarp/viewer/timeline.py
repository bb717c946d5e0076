"""Events of a time window, and the event rate over a recording, read without loading the other events."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.events.events import Events
from amiwarp.io.file_scan import FileEvents

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.events import EventSource
    from amiwarp.events.truth import EventValues

RUNS = 64
"""Number of evenly spaced runs of events that are read from a window with too many events."""
RATE_POINTS = 128
"""Largest number of points at which the event rate is measured."""
RATE_SECONDS = 0.5
"""Approximate time to measure the event rate [s]. If reading is slow, the rate has fewer points."""


@dataclass(frozen=True)
class Span:
    """Events of a time window."""

    start_us: int
    """Start of the time window on the events' clock [us]."""
    length_us: int
    """Length of the time window [us]."""
    count: int
    """Number of events in the time window, including those that are not read."""
    events: Events
    """All events of the window, or evenly spaced runs of them."""
    runs: tuple[slice, ...]
    """Indices of these events in the recording."""

    def rows(self, values: EventValues) -> NDArray[Any]:
        """Return the rows of ``values`` for :attr:`events`; ``values`` has one row per event of the recording."""
        return np.concatenate([values[run] for run in self.runs])


def read_span(source: EventSource, start_us: int, length_us: int, *, most_events: int) -> Span:
    """Read the events with ``start_us <= t < start_us + length_us``.

    If the window holds more than ``most_events``, read about this number in evenly spaced runs.
    """
    first, stop = (source.find(t) for t in (start_us, start_us + length_us))
    count = stop - first
    if count <= most_events:
        return Span(start_us, length_us, count, source.slice(first, stop), (slice(first, stop),))
    starts, length = (first + np.arange(RUNS) * count // RUNS).tolist(), most_events // RUNS
    runs = tuple(slice(k, k + length) for k in starts)
    return Span(start_us, length_us, count, Events.concatenate(list(_runs(source, starts, length))), runs)


def _runs(source: EventSource, starts: list[int], length: int) -> Iterator[Events]:
    """Yield runs of ``length`` events. A file that can only be read from its start is read in one pass."""
    if not isinstance(source, FileEvents):
        yield from (source.slice(k, k + length) for k in starts)
        return
    seen = 0
    for block in source.blocks():
        yield from (block[max(k - seen, 0) : max(k + length - seen, 0)] for k in starts if k < seen + len(block))
        seen += len(block)
        starts = [k for k in starts if k + length > seen]
        if not starts:
            return


def event_rate(source: EventSource) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the event rate over the recording.

    The result is evenly spaced times [us], shape ``(n + 1,)``, and the rate in each interval between them [1/s], shape
    ``(n,)``.
    """
    start_s, n, (first, last) = time.perf_counter(), 1, (source.t_first, source.t_last + 1)
    index = {0.0: 0, 1.0: len(source)}
    while n < min(RATE_POINTS, last - first) and time.perf_counter() - start_s < RATE_SECONDS / 3:
        n *= 2
        for k in range(1, n, 2):
            index[k / n] = source.find(first + (last - first) * k // n)
    shares = sorted(index)
    t = first + np.array([round((last - first) * share) for share in shares], np.int64)
    return t, np.diff([index[share] for share in shares]) / np.maximum(np.diff(t), 1) * 1e6
