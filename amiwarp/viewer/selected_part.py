"""Selected events of the inspector's window as a recording of a smaller camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.viewer.timeline import read_span

if TYPE_CHECKING:
    from amiwarp.viewer.imager import Region
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.window import LoadedWindow

MOST_EVENTS = 4_000_000
"""Largest number of events that are read. Of a fuller window, the middle is used."""


@dataclass(frozen=True, eq=False)
class SelectedPart:
    """Events of a part of the image without gaps in time, with the camera that sees only this part."""

    recording: Recording
    """The events, with coordinates in the part, and its camera; the encoder is that of the whole recording."""
    start_us: int
    """Start of the time window [us]."""
    length_us: int
    """Length of the time window [us]."""


def select_part(
    inspector: Inspector, window: LoadedWindow, part: Region, *, step: int = 1, longest_us: float = math.inf
) -> SelectedPart:
    """Return the selected events of a part of the image.

    Parameters
    ----------
    inspector : Inspector
        The inspector.
    window : LoadedWindow
        Its window.
    part : tuple of int
        Left, top, right and bottom of the part [px]; right and bottom are exclusive.
    step : int
        Use every ``step``-th column and row.
    longest_us : float
        Longest duration [us]. Of a longer window, and of one with too many events, the middle is used.

    Returns
    -------
    SelectedPart
        The part.
    """
    span, events = window.span, window.events
    share = min(1.0, longest_us / span.length_us, MOST_EVENTS / max(span.count, 1))
    length_us = max(1, math.ceil(share * span.length_us))
    start_us = span.start_us + (span.length_us - length_us) // 2
    if span.count > len(span.events):  # the window was read in runs with gaps
        events = inspector.select(read_span(inspector.recording.events, start_us, length_us, most_events=span.count))
    first, stop = np.searchsorted(events.t, (start_us, start_us + length_us))
    events = events[first:stop]
    left, top, right, bottom = part
    x, y = events.x.astype(np.int64) - left, events.y.astype(np.int64) - top
    kept = (x >= 0) & (x < right - left) & (y >= 0) & (y < bottom - top) & (x % step == 0) & (y % step == 0)
    x, y = ((each[kept] // step).astype(np.uint16) for each in (x, y))
    width, height = -(-(right - left) // step), -(-(bottom - top) // step)
    c = inspector.camera
    camera = replace(
        c, width=width, height=height, fx=c.fx / step, fy=c.fy / step, cx=(c.cx - left) / step, cy=(c.cy - top) / step
    )
    source = MemoryEvents(Events(x, y, events.t[kept], events.p[kept]), width, height)
    whole = inspector.recording
    return SelectedPart(
        Recording(source, camera, whole.encoder, whole.prism, name=whole.name), start_us, length_us
    )  # fmt: skip
