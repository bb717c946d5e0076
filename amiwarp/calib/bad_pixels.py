"""Bad pixels, which calibration masks: hot pixels, and pixels that see a flickering lamp."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.flicker import flickering_pixels
from amiwarp.calib.hot_pixels import outliers, unrepeated_counts
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, EventSource
from amiwarp.schema.calls import guarded

MOST_TURNS = 8
"""Largest number of the prism's turns that are searched for bad pixels. A longer part reveals slower hot pixels, but
costs time."""
LEAST_TURNS = 2
"""Smallest number of turns that are searched, however many events they have."""
MOST_EVENTS = 2_500_000
"""Number of events above which fewer than :data:`MOST_TURNS` turns are searched."""
TURNS_BEYOND = 0.05
"""Part of a turn that is searched beyond whole turns, so that every angle occurs in each of them."""


@dataclass(frozen=True, slots=True)
class BadPixelSummary:
    """Numbers of hot and of flickering pixels in a recording. As text, a warning for the user."""

    hot: int
    """Number of hot pixels, which fire at random."""
    flickering: int
    """Number of pixels that see a flickering lamp."""
    lamps_hz: tuple[float, ...]
    """Frequencies of flickering lamps, the strongest lamp first [Hz]."""
    share: float
    """Share of all events that lie on bad pixels, 0 to 1."""

    def __str__(self) -> str:
        """Return, for example, ``12 hot pixels and 3400 that flicker at 100 Hz left out, 41 % of the events``."""
        kinds = []
        if self.hot:
            kinds.append(f"{self.hot} hot pixel{'s' if self.hot > 1 else ''}")
        if self.flickering:
            frequencies = ", ".join(f"{hz:.0f}" for hz in self.lamps_hz)
            is_one = self.flickering == 1
            noun = "pixel" if is_one else "pixels"
            verb = "flickers" if is_one else "flicker"
            subject = f"{self.flickering} that" if self.hot else f"{self.flickering} {noun} that"
            kinds.append(f"{subject} {verb} at {frequencies} Hz")
        if not kinds:
            return ""
        return f"{' and '.join(kinds)} left out, {100.0 * self.share:.0f} % of the events"


def searched_part(source: EventSource, encoder: Encoder) -> Events:
    """Return all events of some whole turns in the middle of a recording; of a very slow prism, of less than a turn.

    Thinned events would not repeat by turn.
    """
    first_us = source.t_first
    whole_us = source.t_last + 1 - source.t_first
    turn_us = 60e6 / max(abs(encoder.rpm), 1e-6)
    affordable_turns = MOST_EVENTS * whole_us / (len(source) * turn_us)
    turns = min(max(affordable_turns, LEAST_TURNS), MOST_TURNS)
    # Two turns may hold more than MOST_EVENTS, but turns of a very slow prism must not load a whole file.
    most_us = min(whole_us, 4.0 * MOST_EVENTS * whole_us / len(source))
    length_us = math.ceil(min((math.floor(turns) + TURNS_BEYOND) * turn_us, most_us))
    start_us = first_us + (whole_us - length_us) // 2
    return source.between(start_us, start_us + length_us)


def find_bad_pixels(
    events: Events, encoder: Encoder, size: tuple[int, int]
) -> tuple[NDArray[np.bool_], BadPixelSummary]:
    """Find hot pixels and pixels that see a flickering lamp.

    Hot pixels are found by their event rate and, from two turns on, by events that do not repeat from turn to turn. The
    second test fails while the camera rotates fast.

    Parameters
    ----------
    events : Events
        A sensor's events (uint16) in the order of time. Use all events of some turns, see :func:`searched_part`;
        thinned events reveal less.
    encoder : Encoder
        Encoder that covers the events.
    size : (int, int)
        Width and height of the sensor [px].

    Returns
    -------
    mask : ndarray
        True for bad pixels, shape ``(height, width)``.
    summary : BadPixelSummary
        Numbers of bad pixels.
    """
    width, height = size
    pixel = events.y.astype(np.int32) * np.int32(width) + events.x
    count = np.bincount(pixel, minlength=width * height)
    hot = outliers(count.reshape(height, width).astype(np.float64))
    unrepeated = unrepeated_counts(events, pixel, encoder, size)
    if unrepeated is not None:
        hot |= outliers(unrepeated)
    flickering, lamps = flickering_pixels(events, pixel, encoder, hot)

    mask = hot | flickering
    left_out = int(count[mask.ravel()].sum())
    summary = BadPixelSummary(
        hot=int((hot & ~flickering).sum()),
        flickering=int(flickering.sum()),
        lamps_hz=lamps,
        share=left_out / max(len(events), 1),
    )
    return mask, summary


def without_pixels(events: Events, mask: NDArray[np.bool_]) -> Events:
    """Return the events outside the masked pixels; ``mask`` is True for masked pixels, shape (height, width)."""
    return events[~mask[events.y, events.x]] if mask.any() else events


@guarded
@dataclass(frozen=True, eq=False, repr=False)
class MaskedEventSource(EventSource):
    """Event source that drops the events of masked pixels on reading. ``len`` still counts them."""

    source: EventSource
    """Event source whose events are read and masked."""
    mask: NDArray[np.bool_]
    """Mask of bad pixels: True for pixels whose events are dropped, shape ``(height, width)``."""

    def __len__(self) -> int:
        return len(self.source)

    @property
    def t_first(self) -> int:
        return self.source.t_first

    @property
    def t_last(self) -> int:
        return self.source.t_last

    @property
    def size(self) -> tuple[int, int]:
        return self.source.size

    def slice(self, start: int, stop: int) -> Events:
        """Return the events with ``start <= index < stop`` of the source that lie outside the mask."""
        return without_pixels(self.source.slice(start, stop), self.mask)

    def find(self, t: int) -> int:
        return self.source.find(t)

    def between(self, t_start: int, t_end: int) -> Events:
        return without_pixels(self.source.between(t_start, t_end), self.mask)

    def blocks(
        self, *, count: int | None = None, duration_us: int | None = None
    ) -> Iterator[Events]:
        """Yield, for each block of the source's events, those that lie outside the mask."""
        return (
            without_pixels(block, self.mask)
            for block in self.source.blocks(count=count, duration_us=duration_us)
        )
