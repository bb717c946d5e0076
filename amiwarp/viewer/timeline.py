"""Timeline: event rates over a recording at any zoom, and reading of one time window."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events, EventSource
from amiwarp.events.truth import EventValues
from amiwarp.io.file_scan import FileEvents

# Rates of ON and OFF events over a recording at any zoom, counted once in bounded memory.

MOST_BINS = 1 << 19
"""Largest number of time bins in which the events of the whole recording are counted."""
MOST_EXACT = 1_000_000
"""Largest number of events that are read to count them in bins finer than those of the whole recording."""


@dataclass(frozen=True, eq=False)
class RateCurve:
    """Rates of ON and OFF events in time bins of equal length, or nearly so."""

    edges_us: NDArray[np.int64]
    """Edges of the bins on the events' clock [us], shape ``(n + 1,)``."""
    on: NDArray[np.float64]
    """Rate of ON events [1/s], shape ``(n,)``; NaN where the recording is not read yet."""
    off: NDArray[np.float64]
    """Rate of OFF events [1/s], shape ``(n,)``; NaN where the recording is not read yet."""


class EventRates:
    """Counts of a recording's events over time. Call :meth:`fill` until it returns True, in one thread.

    Another thread may call :meth:`curve` meanwhile.
    """

    def __init__(self, source: EventSource) -> None:
        self._source = source
        self._first, self._stop = source.t_first, source.t_last + 1
        bins = min(MOST_BINS, self._stop - self._first)
        share = np.arange(bins + 1, dtype=np.float64) / bins
        self._edges = self._first + np.rint(share * (self._stop - self._first)).astype(np.int64)
        self._counts = np.zeros((2, bins), np.int64)
        self._blocks: Iterator[Events] = iter(source.blocks())
        self._read = (np.zeros((2, bins + 1), np.int64), self._first)  # number of events before each edge; time read

    @property
    def share(self) -> float:
        """Share of the recording's duration that is counted, 0 to 1."""
        return (self._read[1] - self._first) / (self._stop - self._first)

    def fill(self, seconds: float) -> bool:
        """Count events for about ``seconds`` [s], at least one block. Return whether all events are counted."""
        until, read_us = time.perf_counter() + seconds, self._read[1]
        while read_us < self._stop:
            block = next(self._blocks, None)
            if block is None:
                read_us = self._stop
                break
            if len(block):
                self._count(block)
                read_us = int(block.t[-1])
            if time.perf_counter() >= until:
                break
        sums = np.zeros((2, len(self._edges)), np.int64)
        np.cumsum(self._counts, axis=1, out=sums[:, 1:])
        self._read = sums, read_us
        return read_us == self._stop

    def curve(self, start_us: int, end_us: int, bins: int) -> RateCurve:
        """Return the rates between two times in about ``bins`` bins.

        Bins finer than those of the whole recording are counted if the time between holds few events. Otherwise, the
        curve has fewer bins. Times outside the recording have rate 0.
        """
        start_us, end_us = int(start_us), max(int(end_us), int(start_us) + 1)
        edges = start_us + (end_us - start_us) * np.arange(bins + 1, dtype=np.int64) // bins
        edges = np.unique(edges)
        finest = (self._stop - self._first) / (len(self._edges) - 1)
        if edges[1] - edges[0] < 4.0 * finest and finest > 1.0:
            exact = self._exact(edges)
            if exact is not None:
                return _curve(edges, exact)
            within = (self._edges > start_us) & (self._edges < end_us)
            edges = np.concatenate([[start_us], self._edges[within], [end_us]])
            edges = edges[np.unique(np.r_[0 : len(edges) - 1 : max(1, len(edges) // bins), len(edges) - 1])]
        sums, read_us = self._read
        before = np.searchsorted(self._edges, edges)  # a bin of the recording belongs to where it begins
        counts = np.diff(sums[:, np.minimum(before, sums.shape[1] - 1)], axis=1).astype(np.float64)
        if read_us < self._stop:
            counts[:, edges[1:] > read_us] = np.nan
        return _curve(edges, counts)

    def _count(self, block: Events) -> None:
        low, high = np.searchsorted(self._edges, (block.t[0], block.t[-1]), side="right") - 1
        edges = np.searchsorted(block.t, self._edges[low + 1 : high + 1])
        on = np.concatenate([[0], np.cumsum(block.p, dtype=np.int64)])
        at = np.concatenate([[0], edges, [len(block)]])
        ons = np.diff(on[at])
        self._counts[1, low : high + 1] += ons
        self._counts[0, low : high + 1] += np.diff(at) - ons

    def _exact(self, edges: NDArray[np.int64]) -> NDArray[np.float64] | None:
        """Return the numbers of OFF and ON events in bins, read from the source; None if there are too many."""
        if isinstance(self._source, FileEvents):  # would be read from its start
            return None
        first, stop = (self._source.find(int(t)) for t in (edges[0], edges[-1]))
        if stop - first > MOST_EXACT:
            return None
        events = self._source.slice(first, stop)
        return np.array([np.diff(np.searchsorted(events.t[events.p == p], edges)) for p in (0, 1)], np.float64)


def _curve(edges: NDArray[np.int64], counts: NDArray[np.float64]) -> RateCurve:
    rates = counts / np.diff(edges) * 1e6
    return RateCurve(edges, rates[1], rates[0])


# Events of a time window, read without loading the other events.

RUNS = 64
"""Number of evenly spaced runs of events that are read from a window with too many events."""


@dataclass(frozen=True)
class Span:
    """Events of a time window."""

    first_us: int
    """Time of the recording's first event, from which all shown times count [us]."""
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

    @property
    def start_ms(self) -> float:
        """Start of the time window after the recording's first event [ms]."""
        return (self.start_us - self.first_us) * 1e-3

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
        return Span(source.t_first, start_us, length_us, count, source.slice(first, stop), (slice(first, stop),))
    starts, length = (first + np.arange(RUNS) * count // RUNS).tolist(), most_events // RUNS
    runs = tuple(slice(k, k + length) for k in starts)
    events = Events.concatenate(list(_runs(source, starts, length)))
    return Span(source.t_first, start_us, length_us, count, events, runs)


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
