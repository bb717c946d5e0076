"""Rates of ON and OFF events over a recording at any zoom, counted once in bounded memory."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events, EventSource
from amiwarp.io.file_scan import FileEvents

MOST_BINS = 1 << 19
"""Largest number of time bins in which the events of the whole recording are counted."""
MOST_EXACT = 1_000_000
"""Largest number of events that are read to count them in bins finer than those of the whole recording."""


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
        for block in self._blocks:
            if len(block):
                low, high = np.searchsorted(self._edges, (block.t[0], block.t[-1]), side="right") - 1
                self._counts[:, low : high + 1] += counted(block, self._edges[low : high + 2])
                read_us = int(block.t[-1])
            if time.perf_counter() >= until:
                break
        else:
            read_us = self._stop
        sums = np.zeros((2, len(self._edges)), np.int64)
        np.cumsum(self._counts, axis=1, out=sums[:, 1:])
        self._read = sums, read_us
        return read_us == self._stop

    def curve(self, start_us: int, end_us: int, bins: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the rates of OFF and ON events between two times in about ``bins`` bins of equal length, or nearly so.

        Returns edges of the bins on the events' clock [us], shape ``(n + 1,)``, and rates [1/s], shape ``(2, n)``, NaN
        where the recording is not read yet.
        Bins finer than those of the whole recording are counted if the time between holds few events. Otherwise, the
        curve has fewer bins. Times outside the recording have rate 0.
        """
        start_us, end_us = int(start_us), max(int(end_us), int(start_us) + 1)
        edges = np.unique(start_us + (end_us - start_us) * np.arange(bins + 1, dtype=np.int64) // bins)
        finest = (self._stop - self._first) / (len(self._edges) - 1)
        fine = edges[1] - edges[0] < 4.0 * finest and finest > 1.0
        counts = self._exact(edges) if fine else None
        if fine and counts is None:
            within = (self._edges > start_us) & (self._edges < end_us)
            edges = np.concatenate([[start_us], self._edges[within], [end_us]])
            edges = edges[np.unique(np.r_[0 : len(edges) - 1 : max(1, len(edges) // bins), len(edges) - 1])]
        if counts is None:
            sums, read_us = self._read
            before = np.searchsorted(self._edges, edges)  # a bin of the recording belongs to where it begins
            counts = np.diff(sums[:, np.minimum(before, sums.shape[1] - 1)], axis=1).astype(np.float64)
            if read_us < self._stop:
                counts[:, edges[1:] > read_us] = np.nan
        return edges, counts / np.diff(edges) * 1e6

    def _exact(self, edges: NDArray[np.int64]) -> NDArray[np.int64] | None:
        """Return the numbers of OFF and ON events in bins, read from the source; None if there are too many."""
        if isinstance(self._source, FileEvents):  # would be read from its start
            return None
        first, stop = (self._source.find(int(t)) for t in (edges[0], edges[-1]))
        return None if stop - first > MOST_EXACT else counted(self._source.slice(first, stop), edges)


def counted(events: Events, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers of OFF and ON events in time bins, shape ``(2, n)``."""
    at = np.searchsorted(events.t, edges)
    on = np.diff(np.concatenate([[0], np.cumsum(events.p, dtype=np.int64)])[at])
    return np.array([np.diff(at) - on, on])
