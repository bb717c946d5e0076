"""Burst of events at the first time stamps, which some event cameras emit when they start.

These events show no edge of the scene. Without an encoder they also look like turns of the prism in no time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import (
    Events,
    EventSource,
    MemoryEvents,
    Recording,
    check_window,
    regroup,
)
from amiwarp.schema.calls import guarded
from amiwarp.validation import check_slice

FEWEST_EVENTS = 200
"""Smallest number of events at the first time stamp that may be a burst."""
LEAST_RATIO = 10
"""Smallest ratio of the number of events at the first time stamp to the number at any later one that is compared.
Where many events share each time stamp because a clock is coarse, the first one has no more than the others."""
COMPARED = 4
"""Number of later events that are compared, as a multiple of the events at the first time stamp."""
MOST_COMPARED = 1 << 20
"""Largest number of later events that are compared."""
WINDOWS_US = (20, 200, 2000)
"""Lengths of a burst that is spread over several time stamps, or that falls on a tick of a coarse clock [us]."""
FEWEST_IN_WINDOW = 1000
"""Smallest number of events of a burst that is spread over several time stamps."""
LEAST_WINDOW_RATIO = 2.0
"""Smallest ratio of the events of such a burst to the number in any later window of that length. The rate of a still
scene changes by less, and slowly."""
FEWEST_WINDOWS = 50
"""Smallest number of later windows with events to which such a burst is compared."""
LARGEST_TAIL = 0.2
"""Largest share of what such a burst has beyond the usual number of events in a window that the next window has. A
burst ends. Pixels that begin at their references give many events at first too, which grow fewer slowly."""


def without_start_burst(recording: Recording) -> tuple[Recording, tuple[str, ...]]:
    """Return the recording without a burst at its first time stamps, and a warning that says so.

    Without such a burst, these are the recording itself and no warning.
    """
    source = recording.events
    count = burst_size(source)
    if not count:
        return recording, ()
    later: EventSource = LaterEvents(source, count)
    if isinstance(source, MemoryEvents):
        later = MemoryEvents(later[:], *source.size)
    last = int(source.slice(count - 1, count).t[0])
    clause = f"carry the first time stamp ({source.t_first} us), far more than any later one"
    if last > source.t_first:
        clause = f"came in the first {last - source.t_first} us (from {source.t_first} us on), far more than later"
    warning = f"{count:,} events {clause}, as cameras emit when they start: they were left out of the calibration"
    # The ground truth has a value for each event of the whole recording. Calibration does not use it.
    return replace(recording, events=later, truth=None), (warning,)


def burst_size(source: EventSource) -> int:
    """Return the number of events at the first time stamps if there are far more than at later ones, else 0."""
    if not len(source):
        return 0
    count = source.find(source.t_first + 1)
    if count >= FEWEST_EVENTS:
        t = source.slice(count, count + min(COMPARED * count, MOST_COMPARED)).t
        if len(t) and count >= LEAST_RATIO * int(_runs(t).max()):
            return count
    for window_us in WINDOWS_US:
        size = _size_within(source, window_us)
        if size:
            return size
    return 0


def _size_within(source: EventSource, window_us: int) -> int:
    """Return the number of events in the first ``window_us`` if there are far more than in later ones, else 0."""
    first = source.t_first
    count = source.find(first + window_us)
    if count < FEWEST_IN_WINDOW:
        return 0
    t = source.slice(count, count + MOST_COMPARED).t
    # Windows without events do not count. The last window may not be whole, which makes it smaller.
    later = _runs((t - first) // window_us)
    if len(later) < FEWEST_WINDOWS or count < LEAST_WINDOW_RATIO * int(later.max()):
        return 0
    usual = float(np.median(later))
    tail = (float(later[0]) - usual) / (count - usual)
    return count if tail <= LARGEST_TAIL else 0


def _runs(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how often each of some ascending values occurs, shape (k,)."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1, [len(values)]])
    return np.diff(starts)


def reaching_back(path: Encoder, t: int) -> Encoder:
    """Return a path of the prism's angle that also covers the time ``t`` [us] before it, at the speed of its start."""
    first = int(path.t[0])
    if t >= first:
        return path
    speed = (path.angle[1] - path.angle[0]) / (path.t[1] - path.t[0])
    angle = path.angle[0] - speed * (first - t)
    return replace(
        path, t=np.concatenate([[t], path.t]), angle=np.concatenate([[angle], path.angle])
    )


@guarded
@dataclass(frozen=True, eq=False, repr=False)
class LaterEvents(EventSource):
    """Events of a source from an index on. All earlier events have earlier times."""

    source: EventSource
    """Source of which these are the later events."""
    first: int
    """Index of the first of these events in the source."""

    def __len__(self) -> int:
        return len(self.source) - self.first

    @cached_property
    def t_first(self) -> int:  # reading it may take a pass over a file
        return int(self.source.slice(self.first, self.first + 1).t[0])

    @property
    def t_last(self) -> int:
        return self.source.t_last

    @property
    def size(self) -> tuple[int, int]:
        return self.source.size

    def slice(self, start: int, stop: int) -> Events:
        check_slice(start, stop)
        return self.source.slice(self.first + start, self.first + stop)

    def find(self, t: int) -> int:
        return max(self.source.find(t) - self.first, 0)

    def between(self, t_start: int, t_end: int) -> Events:
        check_window(t_start, t_end)
        later = self.t_first
        return self.source.between(max(t_start, later), max(t_end, later))

    def blocks(
        self, *, count: int | None = None, duration_us: int | None = None
    ) -> Iterator[Events]:
        return regroup(self._chunks(), count=count, duration_us=duration_us)

    def _chunks(self) -> Iterator[Events]:
        left = self.first
        for block in self.source.blocks():
            yield block[min(left, len(block)) :]
            left = max(left - len(block), 0)
