"""Selected events of the inspector's window as a recording of a smaller camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.viewer.timeline import read_span
from amiwarp.viewer.window_loading import inside

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
    step: int
    """Distance between the used columns, and between the used rows [px]."""


def select_part(
    inspector: Inspector, window: LoadedWindow, part: Region, *, most: float = math.inf, longest_us: float = math.inf
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
    most : float
        Largest number of events and pixels together. For a larger part, every second (third, ...) column and row is
        used.
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
    work = float(np.count_nonzero(inside(events, part))) + (right - left) * (bottom - top)
    step = max(1, math.ceil(math.sqrt(work / most)))
    columns, rows = (np.zeros(size, np.bool_) for size in inspector.recording.events.size)
    columns[left:right:step] = rows[top:bottom:step] = True
    kept = np.flatnonzero(columns[events.x] & rows[events.y])
    x, y = (((each[kept] - least) // step).astype(np.uint16) for each, least in ((events.x, left), (events.y, top)))
    width, height = -(-(right - left) // step), -(-(bottom - top) // step)
    c = inspector.camera
    camera = replace(
        c, width=width, height=height, fx=c.fx / step, fy=c.fy / step, cx=(c.cx - left) / step, cy=(c.cy - top) / step
    )
    source = MemoryEvents(Events(x, y, events.t[kept], events.p[kept]), width, height)
    whole = inspector.recording
    recording = Recording(source, camera, whole.encoder, whole.prism, name=whole.name)
    return SelectedPart(recording, start_us, length_us, step)
