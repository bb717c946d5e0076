"""Part of the image and of the time window of the inspector, as a recording of a smaller camera."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.regions import Region, inside
from amiwarp.io.spans import read_span
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.shown_window import LoadedWindow

MOST_EVENTS = 4_000_000
"""Largest number of events that are read. Of a fuller window, the middle is used."""


def select_part(
    inspector: Inspector,
    window: LoadedWindow,
    part: Region,
    *,
    most: float = math.inf,
    longest_us: float = math.inf,
) -> tuple[Recording, int, int, int]:
    """Return the selected events of a part of the image, without gaps in time, as a recording of a smaller camera.

    Returns the recording, with coordinates in the part, its camera, and the encoder of the whole recording; start and
    length of its time window [us]; and the distance between the used columns, and between the used rows [px].

    ``most``: largest number of events and pixels together; of a larger part, every second (third, ...) column and row
    is used. ``longest_us``: longest duration [us]; of a longer window, and of one with too many events, the middle is
    used.
    """
    # The middle of the window, without gaps.
    span = window.span
    events = window.counted
    share = min(1.0, longest_us / span.length_us, MOST_EVENTS / max(span.count, 1))
    length_us = max(1, math.ceil(share * span.length_us))
    start_us = span.start_us + (span.length_us - length_us) // 2
    if span.count > len(span.events):  # the window was read in runs with gaps
        span = read_span(inspector.recording.events, start_us, length_us, most_events=span.count)
        events = inspector.select(span, inspector.selection).counted
    first, stop = np.searchsorted(events.t, (start_us, start_us + length_us))
    events = events[first:stop]

    # Leave out columns and rows until events and pixels together are at most ``most``.
    left, top, right, bottom = part
    work = float(np.count_nonzero(inside(events, part))) + (right - left) * (bottom - top)
    step = max(1, math.ceil(math.sqrt(work / most)))
    whole = inspector.recording
    whole_width, whole_height = whole.events.size
    columns = np.zeros(whole_width, np.bool_)
    columns[left:right:step] = True
    rows = np.zeros(whole_height, np.bool_)
    rows[top:bottom:step] = True
    kept = np.flatnonzero(columns[events.x] & rows[events.y])

    # The smaller camera, and the events at its pixels.
    width = -(-(right - left) // step)  # rounded up
    height = -(-(bottom - top) // step)
    x = ((events.x[kept] - left) // step).astype(np.uint16)
    y = ((events.y[kept] - top) // step).astype(np.uint16)
    source = MemoryEvents(Events(x, y, events.t[kept], events.p[kept]), width, height)
    camera = inspector.camera
    smaller = replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=(camera.cx - left) / step,
        cy=(camera.cy - top) / step,
    )
    recording = Recording(source, smaller, whole.encoder, whole.prism, name=whole.name)
    return recording, start_us, length_us, step
