"""A recording along its time: what a window holds, how many events come when; nothing else is read."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.events import Events
from amiwarp.io.scan import FileEvents

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.events import EventSource

RUNS = 64
"""Stretches, evenly spaced, of which a window is read that holds more events than asked for."""
POINTS = 128
"""Of the event rate, at most."""
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


def read_span(source: EventSource, start_us: int, length_us: int, most: int) -> Span:
    """Events of ``start_us <= t < start_us + length_us``: all, or about ``most`` of them in evenly spaced runs."""
    first, stop = (source.find(t) for t in (start_us, start_us + length_us))
    count = stop - first
    if count <= most:
        return Span(start_us, length_us, count, source.slice(first, stop))
    starts, length = (first + np.arange(RUNS) * count // RUNS).tolist(), most // RUNS
    return Span(start_us, length_us, count, Events.concatenate(list(_runs(source, starts, length))))


def _runs(source: EventSource, starts: list[int], length: int) -> Iterator[Events]:
    """Runs of events; a file that can only be read from its beginning is read once."""
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
    """Times [us], shape (n + 1,), evenly spaced over the recording, and the rate between each two [1/s], shape (n,)."""
    began, n, (first, last) = time.perf_counter(), 1, (source.t_first, source.t_last + 1)
    index = {0.0: 0, 1.0: len(source)}
    while n < min(POINTS, last - first) and time.perf_counter() - began < SECONDS / 3:
        n *= 2
        for k in range(1, n, 2):
            index[k / n] = source.find(first + (last - first) * k // n)
    shares = sorted(index)
    t = first + np.array([round((last - first) * share) for share in shares], np.int64)
    return t, np.diff([index[share] for share in shares]) / np.maximum(np.diff(t), 1) * 1e6
