"""A recording along its time: where a moment is, what a window holds, how many events come; nothing else is read."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events import Events

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events import EventSource

RUNS = 64
"""Stretches, evenly spaced, of which a window is read that holds more events than asked for."""
POINTS = 256
SECONDS = 0.5
"""For the event rate, about: where reading is slow it is drawn of fewer points."""


@dataclass(frozen=True)
class Span:
    """Events of a window."""

    start_us: int
    """On the events' clock."""
    length_us: int
    count: int
    """True number of events, read or not."""
    events: Events
    """All of them, or evenly spaced runs."""


def index_of(source: EventSource, t: int) -> int:
    """Of the first event at or after ``t`` [us]; by bisection, reading one event at a time."""
    low, high = 0, len(source)
    while low < high:
        middle = (low + high) // 2
        if int(source.slice(middle, middle + 1).t[0]) < t:
            low = middle + 1
        else:
            high = middle
    return low


def read_span(source: EventSource, start_us: int, length_us: int, most: int) -> Span:
    """Events of ``start_us <= t < start_us + length_us``: all, or about ``most`` of them in evenly spaced runs."""
    first, stop = (index_of(source, t) for t in (start_us, start_us + length_us))
    count = stop - first
    if count <= most:
        return Span(start_us, length_us, count, source.slice(first, stop))
    starts = first + np.arange(RUNS) * count // RUNS
    parts = [source.slice(int(k), int(k) + most // RUNS) for k in starts]
    return Span(start_us, length_us, count, Events.concatenate(parts))


def event_rate(source: EventSource) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Times [us], shape (n + 1,), and the rate between each two [1/s], shape (n,): of evenly spaced events."""
    began, n, last = time.perf_counter(), 1, len(source) - 1
    times = {0: source.t_first, last: source.t_last}
    while n < min(POINTS, last) and time.perf_counter() - began < SECONDS / 4:
        n *= 2
        for k in (last * np.arange(1, n, 2) // n).tolist():
            times[k] = times[k] if k in times else int(source.slice(k, k + 1).t[0])
    index = np.array(sorted(times), np.int64)
    t = np.array([times[int(k)] for k in index], np.int64)
    return t, np.diff(index) / np.maximum(np.diff(t), 1) * 1e6
