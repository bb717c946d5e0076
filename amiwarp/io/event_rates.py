"""Rates of ON and OFF events over a recording at any zoom, counted once in bounded memory."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events, EventSource
from amiwarp.io.file_scan import FileEvents

Integers = NDArray[np.int64]

MOST_BINS = 1 << 19
"""Largest number of time bins in which the events of the whole recording are counted."""

MOST_EXACT = 1_000_000
"""Largest number of events that are read to count them in finer bins."""

LEAST_BINS = 4.0
"""Number of the recording's bins in a bin of a curve below which events are read and counted anew."""


class EventRates:
    """Counts of a recording's events over time. Call :meth:`fill` until it returns True, in one thread.

    Another thread may call :meth:`curve` meanwhile.
    """

    def __init__(self, source: EventSource) -> None:
        self._source = source
        self._first = source.t_first
        self._stop = source.t_last + 1
        duration_us = self._stop - self._first
        bins = min(MOST_BINS, duration_us)
        fraction_at_edge = np.arange(bins + 1, dtype=np.float64) / bins
        elapsed = np.rint(fraction_at_edge * duration_us)
        self._edges = self._first + elapsed.astype(np.int64)
        self._counts = np.zeros((2, bins), np.int64)
        self._blocks: Iterator[Events] = iter(source.blocks())
        self._is_broken = False
        nothing = np.zeros((2, bins + 1), np.int64)
        self._progress = (nothing, self._first)
        """Number of OFF and ON events before each edge, and the time up to which events are read [us]. They are one
        value, because another thread reads them."""

    @property
    def share(self) -> float:
        """Share of the recording's duration that is counted, 0 to 1."""
        _, read_us = self._progress
        duration_us = self._stop - self._first
        return (read_us - self._first) / duration_us

    @property
    def ended(self) -> bool:
        """Whether nothing is left to count: all was counted, or the source had an error."""
        return self._is_broken or self.share >= 1.0

    def fill(self, seconds: float) -> bool:
        """Count events for about ``seconds`` [s], at least one block. Return whether nothing is left to count.

        Raises the error of the source, once: what comes after it is not counted.
        """
        if self._is_broken:
            return True
        until = time.perf_counter() + seconds
        _, read_us = self._progress
        failure: Exception | None = None
        try:
            for block in self._blocks:
                if len(block):
                    self._count(block)
                    read_us = int(block.t[-1])
                if time.perf_counter() >= until:
                    break
            else:
                read_us = self._stop
        except Exception as error:
            self._is_broken = True
            failure = error
        sums = np.zeros((2, len(self._edges)), np.int64)
        np.cumsum(self._counts, axis=1, out=sums[:, 1:])
        self._progress = sums, read_us
        if failure is not None:
            raise failure
        return read_us == self._stop

    def _count(self, block: Events) -> None:
        """Count the events of a block in the bins."""
        ends = [block.t[0], block.t[-1]]
        first_bin, last_bin = np.searchsorted(self._edges, ends, side="right") - 1
        edges = self._edges[first_bin : last_bin + 2]
        self._counts[:, first_bin : last_bin + 1] += counts_by_polarity(block, edges)

    def curve(
        self,
        start_us: int,
        end_us: int,
        bins: int,
    ) -> tuple[Integers, NDArray[np.float64]]:
        """Return the rates of OFF and ON events between two times in about ``bins`` bins of equal length, or nearly so.

        Returns edges of the bins on the events' clock [us], shape ``(n + 1,)``, and rates [1/s], shape ``(2, n)``, NaN
        where the recording is not read yet.
        Bins finer than the bins of the whole recording are counted if the time between holds few events: up to
        :data:`MOST_EXACT` are then read from the source. Otherwise, the curve has fewer bins. Times outside the
        recording have rate 0.
        """
        start_us = int(start_us)
        end_us = max(int(end_us), start_us + 1)
        index = np.arange(bins + 1, dtype=np.int64)
        duration_us = end_us - start_us
        edges = np.unique(start_us + duration_us * index // bins)

        finest_us = (self._stop - self._first) / (len(self._edges) - 1)
        bin_us = edges[1] - edges[0]
        is_fine = bin_us < LEAST_BINS * finest_us and finest_us > 1.0
        if is_fine:
            counts = self._counts_from_source(edges)
            if counts is not None:
                return edges, counts / np.diff(edges) * 1e6
            edges = self._edges_within(start_us, end_us, bins)
        return edges, self._counts_from_sums(edges) / np.diff(edges) * 1e6

    def _edges_within(self, start_us: int, end_us: int, bins: int) -> Integers:
        """Return edges of about ``bins`` bins that are edges of the whole recording's bins, except the two ends."""
        within = (self._edges > start_us) & (self._edges < end_us)
        edges = np.concatenate([[start_us], self._edges[within], [end_us]])
        last = len(edges) - 1
        step = max(1, len(edges) // bins)
        kept = [*range(0, last, step), last]
        return edges[np.unique(kept)]

    def _counts_from_sums(self, edges: Integers) -> NDArray[np.float64]:
        """Return the numbers of OFF and ON events in bins, from what was counted; NaN where nothing was read."""
        sums, read_us = self._progress
        # A bin of the recording belongs to where it begins.
        before = np.searchsorted(self._edges, edges)
        last = sums.shape[1] - 1
        sums_at_edges = sums[:, np.minimum(before, last)]
        counts = np.diff(sums_at_edges, axis=1).astype(np.float64)
        if read_us < self._stop:
            unread = edges[1:] > read_us
            counts[:, unread] = np.nan
        return counts

    def _counts_from_source(self, edges: Integers) -> Integers | None:
        """Return the numbers of OFF and ON events in bins, read from the source; None if there are too many."""
        # Such a file would be read from its start.
        if isinstance(self._source, FileEvents):
            return None
        first = self._source.find(int(edges[0]))
        stop = self._source.find(int(edges[-1]))
        if stop - first > MOST_EXACT:
            return None
        events = self._source.slice(first, stop)
        return counts_by_polarity(events, edges)


def counts_by_polarity(events: Events, edges: Integers) -> Integers:
    """Return the numbers of OFF and ON events in time bins, shape ``(2, n)``."""
    event_at_edge = np.searchsorted(events.t, edges)
    on_until = np.cumsum(events.p, dtype=np.int64)
    on_before = np.concatenate([[0], on_until])
    both = np.diff(event_at_edge)
    on = np.diff(on_before[event_at_edge])
    return np.array([both - on, on])
