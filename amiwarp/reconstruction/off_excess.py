"""Ratio of the thresholds of a sensor, from the numbers of its events."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.device_events import read_between
from amiwarp.events.recording import EventSource

FEWEST_EVENTS = 1000
"""Number of events from which their counts tell the ratio."""
LEAST_EXCESS = -0.7
"""Smallest ratio of the thresholds, minus 1, that is believed."""
LARGEST_EXCESS = 2.0
"""Largest ratio of the thresholds, minus 1, that is believed."""


def off_excess_by_counts(
    source: EventSource, turn_us: float | None, start_us: int, length_us: int
) -> float:
    """Return the ratio of the OFF to the ON threshold, minus 1, from event counts over whole turns near the window.

    After a whole turn, a pixel is back at its brightness. So the number of ON events times the ON threshold equals the
    number of OFF events times the OFF threshold. This does not hold in the first turn of a recording: before a pixel
    fires, its reference is not the brightness that an event left. So later turns are counted; in a recording of less
    than two turns, the first event of each pixel is not counted.
    """
    first = source.t_first
    last = source.t_last
    if turn_us is None or last - first < turn_us:
        return 0.0

    turns = (last - first) / turn_us
    wanted_turns = length_us / turn_us
    whole_turns = max(1, math.floor(min(wanted_turns, turns - 1.0)))
    length = whole_turns * turn_us
    start = min(max(start_us, first + turn_us), last - length)
    stop = round(start + length)
    settled = start >= first + turn_us
    if settled:
        polarity = _on_host(read_between(source, round(start), stop).p)
    else:
        # From the beginning, so that the first event of each pixel is known.
        events = read_between(source, round(first), stop)
        width, _ = source.size
        first_events = first_of_each_pixel(_on_host(events.x), _on_host(events.y), width)
        counted = _on_host(events.t) >= start
        counted[first_events] = False
        polarity = _on_host(events.p)[counted]

    if len(polarity) < FEWEST_EVENTS:
        return 0.0
    on = int(polarity.sum())
    off = len(polarity) - on
    return float(np.clip(on / max(off, 1) - 1.0, LEAST_EXCESS, LARGEST_EXCESS))


def _on_host(column: NDArray[Any] | wp.array) -> NDArray[Any]:
    return column if isinstance(column, np.ndarray) else column.numpy()


def first_of_each_pixel(x: NDArray[Any], y: NDArray[Any], width: int) -> NDArray[np.int64]:
    """Return the index of the first event of each pixel that fires, for events in time order, shape (pixels,)."""
    pixel = y.astype(np.int64) * width + x
    _, index = np.unique(pixel, return_index=True)
    return np.asarray(index, np.int64)
