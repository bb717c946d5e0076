"""Events of a time window of any source, read without keeping the other events."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events, EventSource, regroup
from amiwarp.events.truth import EventValues
from amiwarp.io.file_scan import FileEvents

BLOCK = 1 << 20
"""Number of events that are read at a time from a window with too many events."""
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
    places: NDArray[np.float32] | None = None
    """Places of the events of a compensated recording [px], shape ``(n, 2)``; ``events`` has their pixels then."""

    @property
    def start_ms(self) -> float:
        """Start of the time window after the recording's first event [ms]."""
        return (self.start_us - self.first_us) * 1e-3

    @property
    def run_starts(self) -> NDArray[np.int64]:
        """Times of the first events of the runs [us], shape ``(n,)``."""
        lengths = [run.stop - run.start for run in self.runs]
        return np.asarray(self.events.t[np.cumsum([0, *lengths])[:-1]], np.int64)

    def rows(self, values: EventValues) -> NDArray[Any]:
        """Return the rows of ``values`` for :attr:`events`; ``values`` has one row per event of the recording."""
        return np.concatenate([values[run] for run in self.runs])


def read_span(source: EventSource, start_us: int, length_us: int, *, most_events: int) -> Span:
    """Read the events with ``start_us <= t < start_us + length_us``.

    If the window holds more than ``most_events``, read about this number in evenly spaced runs.
    """
    first = source.find(start_us)
    stop = source.find(start_us + length_us)
    count = stop - first
    if count <= most_events:
        events = source.slice(first, stop)
        runs: tuple[slice, ...] = (slice(first, stop),)
    else:
        starts = (first + np.arange(RUNS) * count // RUNS).tolist()
        length = most_events // RUNS
        events = Events.concatenate(list(_runs(source, starts, length)))
        runs = tuple(slice(start, start + length) for start in starts)
    return Span(
        first_us=source.t_first,
        start_us=start_us,
        length_us=length_us,
        count=count,
        events=events,
        runs=runs,
    )


def _runs(source: EventSource, starts: list[int], length: int) -> Iterator[Events]:
    """Yield runs of ``length`` events. A file that can only be read from its start is read in one pass."""
    if not isinstance(source, FileEvents):
        for start in starts:
            yield source.slice(start, start + length)
        return
    passed = 0
    for block in source.blocks():
        for start in starts:
            if start < passed + len(block):
                yield block[max(start - passed, 0) : max(start + length - passed, 0)]
        passed += len(block)
        starts = [start for start in starts if start + length > passed]
        if not starts:
            return


def span_blocks(source: EventSource, span: Span) -> Iterator[Events]:
    """Yield all events of a time window in blocks, also those that were not read."""
    if span.count == len(span.events):
        yield span.events
    else:
        yield from blocks_between(source, span.start_us, span.start_us + span.length_us)


def blocks_between(
    source: EventSource, start_us: int, end_us: int, *, count: int = BLOCK
) -> Iterator[Events]:
    """Yield the events with ``start_us <= t < end_us`` in blocks of ``count``, none of them empty."""
    yield from regroup(_pieces_between(source, start_us, end_us), count=count)


def _pieces_between(source: EventSource, start_us: int, end_us: int) -> Iterator[Events]:
    """Yield the events with ``start_us <= t < end_us`` in pieces as they are read."""
    if isinstance(source, FileEvents):
        # It can only be read from its start.
        for block in source.blocks():
            first, stop = np.searchsorted(block.t, (start_us, end_us))
            yield block[first:stop]
            if stop < len(block):
                return
    else:
        stop = source.find(end_us)
        for start in range(source.find(start_us), stop, BLOCK):
            yield source.slice(start, min(start + BLOCK, stop))
