"""Files without an index as event sources: one pass to count, check and repair, then packets again for every reading.

Two faults that real recordings have are repaired and counted, in each format alike: an event earlier than one before it
is moved to the largest time so far, an event outside the frame is dropped. Where over 1 % of the events need either,
the file is refused: then the format, the size or the order is wrong, not the event.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import DEFAULT_BLOCK, Events, as_times, regroup
from amiwarp.io.files import errors_name, register_reader

Packet: TypeAlias = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
"""x, y [px], t [us] and p (non-zero is ON) as the file has them, integers or booleans of one shape ``(n,)``."""

KEEP = 1 << 22
"""Recordings of up to so many events (55 MB) stay in memory after the first pass."""

SENSORS = ((128, 128), (240, 180), (304, 240), (320, 240), (346, 260), (640, 480), (1280, 720))
"""Sizes of sensors in use, for files that do not tell theirs."""


def smallest_sensor(x_max: int, y_max: int) -> tuple[int, int]:
    """Size of the smallest sensor in use that has pixel (x_max, y_max), or that pixel's own frame beyond them."""
    for width, height in SENSORS:
        if x_max < width and y_max < height:
            return width, height
    return x_max + 1, y_max + 1


@dataclass(slots=True)
class Tally:
    """What a pass over a file has met so far."""

    count: int = 0
    t_first: int = 0
    t_last: int = 0
    x_max: int = 0
    y_max: int = 0
    late: int = 0
    outside: int = 0
    notes: dict[str, int] = field(default_factory=dict)

    def place(self) -> str:
        """Where the pass is, for a message."""
        return f"after {self.count} events (t = {self.t_last} us)" if self.count else "before the first event"


class FileEvents:
    """Events of a file that can only be read from its beginning; opening it makes the first pass.

    ``slice`` and ``between`` of more than :data:`KEEP` events scan the file each time; converting it once to the native
    format makes them fast. Raises :class:`AmiwarpError` for a damaged file and for one without events.
    """

    def __init__(
        self,
        path: Path,
        packets: Callable[[dict[str, int]], Iterator[Packet]],
        *,
        size: tuple[int, int] | None,
    ) -> None:
        """``packets`` starts a new pass and counts oddities into the dictionary given; ``size`` None is found out."""
        if size is not None and not (1 <= size[0] <= 65536 and 1 <= size[1] <= 65536):
            raise AmiwarpError(f"{path}: tells a size of {size[0]}x{size[1]}; expected 1 .. 65536 pixels each way")
        self.path = path
        self._packets = packets
        self._size = size
        self.size_is_known = size is not None
        """Whether the file told the sensor's size; else it is the smallest in use that holds all events."""
        self._kept: list[Events] | None = []
        self._tally = Tally()
        for block in self._pass(self._tally):
            if self._kept is not None:
                self._kept.append(block)
                self._kept = self._kept if self._tally.count <= KEEP else None
        self._judge()
        self._size = size or smallest_sensor(self._tally.x_max, self._tally.y_max)
        register_reader(self, self.path)

    def _judge(self) -> None:
        tally = self._tally
        for bad, what in ((tally.outside, f"lie outside the frame {self._size}"), (tally.late, "are out of order")):
            if bad * 100 > tally.count + tally.outside:
                total = tally.count + tally.outside
                raise AmiwarpError(f"{self.path}: {bad} of {total} events {what}; the file is damaged or mislabelled")
        if not tally.count:
            raise AmiwarpError(f"{self.path}: holds no events")

    @property
    def repairs(self) -> dict[str, int]:
        """Counts of what was repaired or noticed, by name; nothing where there was nothing."""
        counts = {"repaired_time_events": self._tally.late, "dropped_outside_events": self._tally.outside}
        return {name: count for name, count in {**counts, **self._tally.notes}.items() if count}

    def __len__(self) -> int:
        return self._tally.count

    @property
    def t_first(self) -> int:
        """Time of the first event [us]."""
        return self._tally.t_first

    @property
    def t_last(self) -> int:
        """Time of the last event [us]."""
        return self._tally.t_last

    @property
    def size(self) -> tuple[int, int]:
        """Sensor's (width, height) [px]."""
        assert self._size is not None
        return self._size

    def slice(self, start: int, stop: int) -> Events:
        """Events ``start <= index < stop``."""
        found: list[Events] = []
        seen = 0
        for block in self._all():
            if seen >= stop:
                break
            found.append(block[max(start - seen, 0) : max(stop - seen, 0)])
            seen += len(block)
        return Events.concatenate([block for block in found if len(block)])

    def find(self, t: int) -> int:
        """See :meth:`amiwarp.events.events.EventSource.find`."""
        seen = 0
        for block in self._all():
            if block.t[-1] >= t:
                return seen + int(np.searchsorted(block.t, t))
            seen += len(block)
        return seen

    def between(self, t_start: int, t_end: int) -> Events:
        """Events with ``t_start <= t < t_end`` [us]."""
        found: list[Events] = []
        for block in self._all():
            if block.t[0] >= t_end:
                break
            start, stop = np.searchsorted(block.t, [t_start, t_end])
            if stop > start:
                found.append(block[start:stop])
        return Events.concatenate(found)

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """See :meth:`amiwarp.events.events.EventSource.blocks`."""
        return regroup(self._all(), count=count, duration_us=duration_us)

    def _all(self) -> Iterator[Events]:
        return iter(self._kept) if self._kept is not None else self._pass(Tally())

    def _pass(self, tally: Tally) -> Iterator[Events]:
        with errors_name(self.path, tally.place):
            for packet in self._packets(tally.notes):
                # Cut large packets, so that one array of a whole file still goes through in bounded copies.
                for start in range(0, len(packet[2]), DEFAULT_BLOCK):
                    x, y, t, p = (array[start : start + DEFAULT_BLOCK] for array in packet)
                    block = self._repair(x, y, t, p, tally)
                    if len(block):
                        yield block

    def _repair(self, x: NDArray[Any], y: NDArray[Any], t: NDArray[Any], p: NDArray[Any], tally: Tally) -> Events:
        # Sensors' pixels fit 16 bits: anything else would wrap around when stored.
        width, height = self._size or (65536, 65536)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        if not inside.all():
            tally.outside += int(inside.size - np.count_nonzero(inside))
            x, y, t, p = x[inside], y[inside], t[inside], p[inside]
        if not t.size:
            return Events.empty()
        times = as_times(t)
        floor = tally.t_last if tally.count else int(times[0])
        ordered = np.maximum(np.maximum.accumulate(times), floor)
        tally.late += int(np.count_nonzero(ordered != times))
        tally.t_first = tally.t_first if tally.count else int(ordered[0])
        tally.t_last, tally.count = int(ordered[-1]), tally.count + ordered.size
        tally.x_max, tally.y_max = max(tally.x_max, int(x.max())), max(tally.y_max, int(y.max()))
        return Events(x.astype(np.uint16), y.astype(np.uint16), ordered, (p > 0).astype(np.uint8))
