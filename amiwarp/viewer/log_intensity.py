"""Log intensity of the shown region, reconstructed within about a second."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.reconstruction.picture import reconstruct
from amiwarp.viewer.timeline import read_span

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.imager import Region
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.parameters import Knobs
    from amiwarp.viewer.window import LoadedWindow

MOST_PIXELS = 30_000
"""Largest number of pixels that are all reconstructed. Of a larger region, every second column and row is used."""
MOST_EVENTS = 4_000_000
"""Largest number of events that are read. Of a fuller window, the middle is used."""


@dataclass(frozen=True, eq=False)
class LogIntensity:
    """Log intensity of a region."""

    log: NDArray[np.float32]
    """Log intensity [ON thresholds], shape ``(height, width)`` of the region."""
    known: NDArray[np.bool_]
    """Whether events determine each pixel, same shape."""
    note: str
    """Number of equations, their residual, and what limits the picture."""


def log_intensity(inspector: Inspector, window: LoadedWindow, knobs: Knobs) -> LogIntensity:
    """Reconstruct the log intensity of a window's region with given parameters.

    Raises :class:`AmiwarpError` if no pixel fires twice.
    """
    left, top, right, bottom = _wide(inspector, window)
    step = 1 if (right - left) * (bottom - top) <= MOST_PIXELS else 2
    events, start_us, length_us = _events(inspector, window, (left, top, right, bottom), step)
    width, height = -(-(right - left) // step), -(-(bottom - top) // step)
    c = inspector.camera
    camera = replace(
        c, width=width, height=height, fx=c.fx / step, fy=c.fy / step, cx=(c.cx - left) / step, cy=(c.cy - top) / step
    )  # fmt: skip
    if knobs.focal_length is not None:
        knobs = replace(knobs, focal_length=knobs.focal_length / step)
    picture = reconstruct(
        Recording(MemoryEvents(events, width, height), name=inspector.recording.name),
        model=inspector.model_of(knobs, camera), encoder=inspector.encoder_of(knobs), start_us=start_us,
        length_us=length_us, device=inspector.device,
    )  # fmt: skip
    rows, columns = (np.arange(window.region[k], window.region[k + 2]) for k in (1, 0))
    part = np.ix_((rows - top) // step, (columns - left) // step)
    limits = [f"{100 // step**2} % of the pixels"] if step > 1 else []
    if length_us < window.span.length_us:
        limits.append(f"{length_us * 1e-3:.3g} ms in the middle")
    note = "; ".join([f"{picture.pairs:,} pairs, residual {picture.residual:.2f}", *limits])
    return LogIntensity(picture.log[part], picture.known[part], note)


def _wide(inspector: Inspector, window: LoadedWindow) -> Region:
    """Return the part of the image whose events the prism may move into the region."""
    left, top, right, bottom = window.region
    width, height = inspector.recording.events.size
    m = inspector.margin_px
    return max(left - m, 0), max(top - m, 0), min(right + m, width), min(bottom + m, height)


def _events(inspector: Inspector, window: LoadedWindow, part: Region, step: int) -> tuple[Events, int, int]:
    """Return the events of every ``step``-th column and row of a part, and their time window [us].

    Their coordinates count from 0 on. The window is at most one turn in the middle of the shown one.
    """
    span, events = window.span, window.events
    share = min(1.0, inspector.turn_us / span.length_us)
    share = min(share, MOST_EVENTS / max(span.count, 1))
    length_us = max(1, math.ceil(share * span.length_us))
    start_us = span.start_us + (span.length_us - length_us) // 2
    if span.count > len(span.events):  # the window was read in runs
        events = inspector.select(read_span(inspector.recording.events, start_us, length_us, most_events=span.count))
    first, stop = np.searchsorted(events.t, (start_us, start_us + length_us))
    events = events[first:stop]
    left, top, right, bottom = part
    x, y = events.x.astype(np.int64) - left, events.y.astype(np.int64) - top
    kept = (x >= 0) & (x < right - left) & (y >= 0) & (y < bottom - top) & (x % step == 0) & (y % step == 0)
    x, y = ((each[kept] // step).astype(np.uint16) for each in (x, y))
    return Events(x, y, events.t[kept], events.p[kept]), start_us, length_us
