"""Statistics of the selected events of a time window: rates, and intervals between the events of a pixel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.imaging.regions import inside
from amiwarp.viewer.shown_window import LoadedWindow

INTERVALS_US = np.logspace(0, 6, 49)
"""Edges of the bins of the histogram of intervals [us]: eight bins per decade, from 1 us to 1 s."""


def window_statistics(window: LoadedWindow) -> dict[str, Any]:
    """Return the statistics of the selected events of a time window, for page and window.

    They are rows of name and value, and the shares [%] and the median of the intervals between successive events of a
    pixel, over the logarithm of the interval [us]. Intervals between runs are not counted. Those under 1 us are in the
    first bin, those over 1 s in the last one.
    """
    left, top, right, bottom = window.region
    area = (right - left) * (bottom - top)
    events = window.counted[inside(window.counted, window.region)]
    pixel = _pixel_and_run(window, events)
    intervals_us = _intervals(events, pixel)

    known = bool(len(intervals_us))
    counts, _ = np.histogram(np.clip(intervals_us, 1, 999_999), INTERVALS_US)
    decades = np.log10(INTERVALS_US)
    median_us = float(np.median(intervals_us)) if known else math.nan
    pixels = len(np.unique(pixel % area))
    rows = [
        ("rate", f"{len(events) / window.read_us * 1e6:,.0f} events/s"),
        ("events per pixel", f"{len(events) / area:.3g}"),
        ("ON", f"{100.0 * events.p.mean():.1f} %"),
        ("pixels with events", f"{100.0 * pixels / area:.1f} %"),
        ("median interval of a pixel", f"{median_us:,.0f} µs" if known else "–"),
    ]
    return {
        "rows": [list(row) for row in rows],
        "x": (0.5 * (decades[1:] + decades[:-1])).tolist() if known else [],
        "y": (100.0 * counts / max(1, counts.sum())).tolist(),
        "median": math.log10(max(median_us, 1.0)) if known else None,
    }


def _pixel_and_run(window: LoadedWindow, events: Events) -> NDArray[np.int64]:
    """Return a number for the pixel of each event in the run of the window that holds the event, shape ``(n,)``.

    Modulo the number of pixels of the region, it is the number of the pixel.
    """
    left, top, right, bottom = window.region
    width = right - left
    height = bottom - top
    run = np.searchsorted(window.span.run_starts, events.t, side="right")
    row = events.y.astype(np.int64) - top
    return (run * height + row) * width + events.x - left


def _intervals(events: Events, pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the intervals between successive events with the same number of pixel and run [us], shape ``(m,)``."""
    order = np.argsort(
        pixel, kind="stable"
    )  # the events of a pixel stay in the order of their times
    same_pixel = np.diff(pixel[order]) == 0
    return np.diff(events.t[order])[same_pixel]
