"""Which events each frame of a film shows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events

MOST_EVENTS = 1 << 26
"""Largest number of events of a frame, which are kept in memory."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of the frames of a film, on the clock of the events."""

    start_us: int
    """Start of the first frame [us]."""
    step_us: float
    """Time from a frame to the next [us]."""
    count: int
    """Number of frames."""

    def end(self, frame: int) -> int:
        """Return the time up to which a frame shows events [us]."""
        return self.start_us + round((frame + 1) * self.step_us)


@dataclass(frozen=True, slots=True)
class Shown:
    """Events that a frame shows."""

    events: Events
    """The events, in order of time."""
    end_us: int
    """Time up to which the frame shows them [us]."""
    new: int
    """Number of events since the frame before."""
    length_us: int
    """Time since the frame before [us]."""


def frames_of_time(
    blocks: Iterable[Events], timing: Timing, reach_us: int | None
) -> Iterator[Shown]:
    """Yield for each frame the events of the last ``reach_us`` before its end, or those since the frame before.

    At most the events of a frame and one block are in memory.
    """
    waiting = iter(blocks)
    held = Events.empty()
    before = timing.start_us
    for frame in range(timing.count):
        end = timing.end(frame)
        low = before if reach_us is None else end - reach_us
        # Blocks are joined once a frame, which may hold the events of many.
        held = held[int(np.searchsorted(held.t, min(low, before))) :]
        parts = [held]
        count = len(held)
        while not len(parts[-1]) or int(parts[-1].t[-1]) < end:
            block = next(waiting, None)
            if block is None:
                break
            parts.append(block)
            count += len(block)
            if count > MOST_EVENTS:
                raise AmiwarpError(
                    f"a frame holds more than {MOST_EVENTS:,} events; give a shorter --frame-ms (frame_us in "
                    "Python), or a lower --speed"
                )
        held = Events.concatenate([part for part in parts if len(part)] or [Events.empty()])
        first, since, stop = np.searchsorted(held.t, (low, before, end)).tolist()
        yield Shown(held[first:stop], end, stop - since, end - before)
        held = held[min(first, since) :]
        before = end


def frames_of_count(blocks: Iterable[Events], start_us: int) -> Iterator[Shown]:
    """Yield a frame for each block of events."""
    before = start_us
    for events in blocks:
        end = int(events.t[-1]) + 1
        yield Shown(events, end, len(events), end - before)
        before = end
