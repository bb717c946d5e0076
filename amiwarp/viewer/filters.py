"""Filters of the inspector: which events are shown, and how many each step of ``amiwarp filter`` leaves."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.imaging.filters import NAMES, PARTS, EventFilter, RunningFilter, is_given
from amiwarp.imaging.regions import Region, inside


@dataclass(frozen=True)
class Selection:
    """Conditions for the events that are shown: all parts of an :class:`amiwarp.EventFilter` but the time."""

    polarity: int | None = None
    """Polarity of the shown events: 1 for only ON, 0 for only OFF, None for both."""
    region: Region | None = None
    """Region of the image: left, top, right and bottom [px], right and bottom exclusive. None: the whole image."""
    hide_hot: bool = False
    """Whether the events of hot pixels are left out."""
    noise_us: int | None = None
    """Time within which an earlier event at a neighbouring pixel must support an event [us]; None: no noise filter."""
    refractory_us: int = 0
    """Time after a kept event in which further events of its pixel are left out [us]; 0 keeps all."""
    most_per_s: float = 0.0
    """Largest rate [events/s]; 0 keeps all."""
    every: int = 1
    """Of the events that are left, every n-th is shown."""

    def event_filter(self, hot: NDArray[np.bool_] | None, region: Region | None) -> EventFilter:
        """Return the selection as ``amiwarp filter`` applies it, with another region.

        ``hot``: pixels whose events are left out, shape ``(height, width)``.
        """
        return EventFilter(
            region=region,
            polarity=self.polarity,
            hot_pixels=hot,
            refractory_us=self.refractory_us,
            background_us=self.noise_us or 0,
            most_per_s=self.most_per_s,
            every=self.every,
        )


@dataclass(frozen=True)
class FilterStep:
    """What one part of a filter leaves of the events of a region."""

    name: str
    """Name of the part, as ``amiwarp filter`` prints it."""
    before: int
    """Number of events before the part."""
    after: int
    """Number of events that it keeps."""


@dataclass
class SelectedEvents:
    """A selection that runs over the events of a time window, which may arrive in blocks.

    Each part runs on its own, so that the events which it leaves can be counted in the region alone: compensation may
    move events into the region from around it, and these are kept too.
    """

    selection: Selection
    """What is kept."""
    size: tuple[int, int]
    """Size of the sensor (width, height) [px]."""
    reach: Region
    """Region with the pixels around it from which events are kept [px]."""
    hot: NDArray[np.bool_] | None = None
    """Hot pixels, shape ``(height, width)``, if their events are left out."""
    times: tuple[int, int] | None = None
    """First and last time of which the prism angle is known [us]; None if all events are kept."""
    _counts: dict[str, list[int]] = field(init=False)
    _parts: dict[str, RunningFilter] = field(init=False)

    def __post_init__(self) -> None:
        width, height = self.size
        left, top, right, bottom = self.reach
        reach: Region | None = None
        if self.selection.region is not None:
            reach = max(left, 0), max(top, 0), min(right, width), min(bottom, height)
        chosen = self.selection.event_filter(self.hot, reach)
        self._parts = {}
        self._counts = {}
        for name in PARTS:
            if is_given(chosen, name):
                alone = EventFilter(**{name: getattr(chosen, name)})
                self._parts[name] = RunningFilter(alone, self.size)
                self._counts[name] = [0, 0]

    def keep(self, events: Events) -> NDArray[np.bool_]:
        """Return which events are kept, where the events follow the events of the last call, bool, shape ``(n,)``."""
        keep = np.ones(len(events), np.bool_)
        if self.times is not None:
            first, last = self.times
            keep &= (events.t >= first) & (events.t <= last)
        for name, part in self._parts.items():
            candidates = np.flatnonzero(keep)
            reached = events[candidates]
            wanted = part.keep(reached)
            keep[candidates[~wanted]] = False
            self._count(name, reached, wanted)
        return keep

    def _count(self, name: str, events: Events, kept: NDArray[np.bool_]) -> None:
        """Count the events of the region before and after a part. Before the part "region", all events count."""
        region = self.selection.region
        within = np.ones(len(events), np.bool_) if region is None else inside(events, region)
        before = len(events) if name == "region" else int(np.count_nonzero(within))
        self._counts[name][0] += before
        self._counts[name][1] += int(np.count_nonzero(within & kept))

    @property
    def steps(self) -> tuple[FilterStep, ...]:
        """Numbers of events before and after each part so far, in the order in which the parts are applied."""
        return tuple(
            FilterStep(NAMES[name], before, after) for name, (before, after) in self._counts.items()
        )


@dataclass(frozen=True)
class HotPixel:
    """Pixel that fires far more often than the pixels around it."""

    x: int
    """Column [px]."""
    y: int
    """Row [px]."""
    rate: float
    """Rate of its events [events/s]."""
    share: float
    """Share of all events that are its events, 0 to 1."""


def list_hot_pixels(events: Events, hot: NDArray[np.bool_]) -> tuple[HotPixel, ...]:
    """Return the hot pixels of a mask, shape ``(height, width)``, the busiest first."""
    if not len(events):
        return ()
    counts = np.bincount(events.y.astype(np.int64) * hot.shape[1] + events.x, minlength=hot.size)
    rows, columns = np.nonzero(hot)
    found = counts.reshape(hot.shape)[rows, columns]
    seconds = 1e-6 * float(events.t[-1] - events.t[0] + 1)
    pixels = []
    for k in np.argsort(-found, kind="stable"):
        rate = float(found[k] / seconds)
        share = float(found[k] / len(events))
        pixels.append(HotPixel(int(columns[k]), int(rows[k]), rate, share))
    return tuple(pixels)


PREFIXES = ((1e6, "M"), (1e3, "k"), (1.0, ""))
"""Sizes and prefixes of the units of rates, the largest first."""


def unit_of(rate: float) -> tuple[float, str]:
    """Return size and prefix of the unit in which a rate has at most three digits before the point."""
    for size, prefix in PREFIXES:
        if rate >= 0.9995 * size:
            return size, prefix
    return PREFIXES[-1]


def rate_text(events_per_s: float) -> str:
    """Return a rate as text, such as ``1.2 Mev/s``."""
    size, prefix = unit_of(events_per_s)
    return f"{events_per_s / size:.3g} {prefix}ev/s"


def step_rows(steps: tuple[FilterStep, ...], read_us: float) -> list[list[str]]:
    """Return a row of texts for each step: its name, rates before and after, and numbers of events.

    ``read_us``: time of which the events were read [us].
    """
    rows = []
    for step in steps:
        before = 1e6 * step.before / read_us
        after = 1e6 * step.after / read_us
        size, prefix = unit_of(before)
        rates = f"{before / size:.3g} → {after / size:.3g} {prefix}ev/s"
        share = 100.0 * (1.0 - step.after / max(step.before, 1))
        numbers = f"{step.before:,} → {step.after:,} events (−{share:.3g} %)"
        rows.append([step.name, rates, numbers])
    return rows
