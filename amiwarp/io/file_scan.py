"""Event source for files without an index: a first pass counts, checks and repairs; later uses read the file again.

Two faults of real recordings are repaired and counted, in all formats alike. An event that is earlier than one before
it is moved to the largest time so far. An event outside the frame is dropped, unless it is compensated. If more than
1 % of the events have one of these faults, the file is refused, because then its format, size or order must be wrong;
but steps back of at most a millisecond are always repaired.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import (
    DEFAULT_BLOCK,
    Events,
    EventSource,
    MetadataValue,
    as_coordinate,
    as_polarity,
    check_window,
    regroup,
)
from amiwarp.io.assumptions import SENSORS, assumed_size, smallest_sensor
from amiwarp.io.event_order import raise_late_times, sorted_packets, surveys_of
from amiwarp.io.event_packets import Packet, Surveyed
from amiwarp.io.inputs import errors_name, register_reader
from amiwarp.io.opening import given_size, head_limit, is_sorting
from amiwarp.optics.camera import LARGEST_SIZE, check_size
from amiwarp.schema.calls import guarded
from amiwarp.validation import check_slice, rounded_times

SMALL_STEP_US = 1000
"""Largest repair of a time that any number of events may need [us]: cameras send groups of events out of order."""

KEEP_EVENTS = 1 << 22
"""Largest recording that stays in memory after the first pass [events], 55 MB."""

RECORDS = ("triggers", "frames", "depth_maps", "imu_samples")
"""Names of the counts of other records than events. They are shown, but are no repairs."""

PROGRESS = ("read", "total")
"""Names of the counts of what a pass has read so far, and of all there is, in any unit."""


@dataclass(slots=True)
class PassCounts:
    """Counts of the events that a pass over a file has read so far."""

    count: int = 0
    """Number of events that were kept."""
    t_first: int = 0
    """Time of the first event so far [us]."""
    t_last: int = 0
    """Time of the latest event so far [us]."""
    x_max: int = 0
    """Largest column of an event so far [px]."""
    y_max: int = 0
    """Largest row of an event so far [px]."""
    late: int = 0
    """Number of events that were out of order and moved to a later time."""
    late_us: int = 0
    """Largest such move [us]."""
    outside: int = 0
    """Number of events outside the frame, which were dropped."""
    notes: dict[str, int] = field(default_factory=dict)
    """Counts of other findings of the format's reader, by name of the finding."""

    def add(self, t: NDArray[np.int64]) -> None:
        """Count events that were kept, at least one, with their times [us] in order."""
        if not self.count:
            self.t_first = int(t[0])
        self.t_last = int(t[-1])
        self.count += len(t)

    def position(self) -> str:
        """Return the current position of the pass, for messages."""
        if not self.count:
            return "before the first event"
        return f"after {self.count} events (t = {self.t_last} us)"


@guarded
class FileEvents(EventSource):
    """Events of a file that can be read only from its start. The constructor makes the first pass over the file.

    If the file has more than :data:`KEEP_EVENTS` events, every ``slice`` and ``between`` reads it again. Conversion to
    the native format makes these fast. Raises :class:`AmiwarpError` for a damaged file and for a file without events.
    """

    def __init__(
        self,
        path: Path,
        packets: Callable[[dict[str, int]], Iterator[Packet]],
        *,
        size: tuple[int, int] | None,
        sensors: tuple[tuple[int, int], ...] = SENSORS,
        last_time: Callable[[int], int | None] | None = None,
    ) -> None:
        """Make the first pass. ``packets`` starts a pass and gets a dictionary for counts.

        Without a ``size``, the smallest of ``sensors`` with all events is taken. ``last_time`` returns the time of the
        last event [us] from the end of the file, given an estimate; it is used if only the head is read.
        """
        size = given_size() or size
        if size is not None:
            check_size(*size, path)
        self.path = path
        self._sensors = sensors
        self._packets = sorted_packets(path, packets) if is_sorting() else packets
        self._size = size
        self.size_is_known = size is not None
        """Whether the file stores the sensor size. Otherwise the smallest known sensor that contains all events is
        assumed."""
        self._kept: list[Events] | None = []
        """All events, if they are few enough to stay in memory."""
        self._counts = PassCounts()
        self._last_time = last_time
        self.share: float = 1.0
        """Share of the file that was read: below 1 only within :func:`head_only`."""
        self.seconds: float | None = None
        """Estimate of the time to read the whole file [s], or None if unknown or not needed."""
        with contextlib.closing(self._pass(self._counts)) as blocks:
            self._first_pass(blocks, head_limit())
        self._check_counts()
        self._size = size or smallest_sensor(self._counts.x_max, self._counts.y_max, sensors)
        register_reader(self, self.path)

    def _first_pass(self, blocks: Iterator[Events], limit: int | None) -> None:
        """Read all blocks, or up to ``limit`` events if the reader notes how much of the file they are."""
        began_s: float | None = None
        read_before = 0
        for block in blocks:
            if self._kept is not None:
                self._kept.append(block)
                if limit is None and self._counts.count > KEEP_EVENTS:
                    self._kept = None
            read, total = (self._counts.notes.get(name, 0) for name in PROGRESS)
            # Before the first block, processes are started. That time does not grow with the file.
            if began_s is None:
                began_s = time.perf_counter()
                read_before = read
            if limit is not None and self._counts.count >= limit and 0 < read < total:
                self.share = read / total
                if read > read_before:
                    elapsed_s = time.perf_counter() - began_s
                    self.seconds = elapsed_s * total / (read - read_before)
                return

    def last_time(self) -> int | None:
        """Return the time of the last event [us] if only the head was read, or None if its end does not hold it."""
        if self._last_time is None:
            return None
        elapsed = (self.t_last - self.t_first) / self.share
        return self._last_time(self.t_first + int(elapsed))

    def _check_counts(self) -> None:
        """Raise :class:`AmiwarpError` if the file has no events, or too many faulty events."""
        counts = self._counts
        total = counts.count + counts.outside
        late = counts.late if counts.late_us > SMALL_STEP_US else 0
        damaged = "the file is damaged or mislabelled"
        if counts.outside * 100 > total:
            frame = f"pixels 0 .. {LARGEST_SIZE - 1}"
            if self._size:
                width, height = self._size
                frame = f"the {width}x{height} frame"
            raise AmiwarpError(
                f"{self.path}: {counts.outside} of {total} events lie outside {frame}; {damaged}",
                ErrorCode.FILE_DAMAGED,
            )
        if late * 100 > total:
            remedy = "if its events are in the order of pixels, sort them by time with --sort"
            raise AmiwarpError(
                f"{self.path}: {late} of {total} events are out of order; {damaged}; {remedy}",
                ErrorCode.FILE_DAMAGED,
            )
        if not counts.count:
            raise AmiwarpError(
                f"{self.path}: holds no events; give another recording", ErrorCode.CONTENT_MISSING
            )

    @property
    def repairs(self) -> dict[str, int]:
        """Number of repairs and other findings by name; names with the number 0 are left out."""
        repairs = {
            "repaired_time_events": self._counts.late,
            "largest_time_repair_us": self._counts.late_us,
            "dropped_outside_events": self._counts.outside,
        }
        for name, count in self._counts.notes.items():
            if name not in (*RECORDS, *PROGRESS):
                repairs[name] = count
        return {name: count for name, count in repairs.items() if count}

    @property
    def records(self) -> dict[str, int]:
        """Number of other records by name: triggers, frames and IMU samples, without zeros."""
        return {name: self._counts.notes[name] for name in RECORDS if self._counts.notes.get(name)}

    @property
    def metadata(self) -> dict[str, MetadataValue]:
        """Counts for the metadata of a recording: other records and repairs; and the size, if it is assumed."""
        metadata: dict[str, MetadataValue] = {**self.records, **self.repairs}
        if not self.size_is_known:
            metadata |= [assumed_size(self.size, self._sensors).entry]
        return metadata

    def __len__(self) -> int:
        return self._counts.count

    @property
    def t_first(self) -> int:
        """Time of the first event [us]."""
        return self._counts.t_first

    @property
    def t_last(self) -> int:
        """Time of the last event [us]."""
        return self._counts.t_last

    @property
    def size(self) -> tuple[int, int]:
        """Sensor size (width, height) [px]."""
        assert self._size is not None
        return self._size

    def slice(self, start: int, stop: int) -> Events:
        """Return the events with ``start <= index < stop``."""
        check_slice(start, stop)
        parts: list[Events] = []
        passed = 0
        for block in self._all():
            if passed >= stop:
                break
            parts.append(block[max(start - passed, 0) : max(stop - passed, 0)])
            passed += len(block)
        return _copied([block for block in parts if len(block)])

    def find(self, t: int) -> int:
        """Return the index of the first event at or after ``t`` [us]."""
        passed = 0
        for block in self._all():
            if block.t[-1] >= t:
                return passed + int(np.searchsorted(block.t, t))
            passed += len(block)
        return passed

    def between(self, t_start: int, t_end: int) -> Events:
        """Return the events with ``t_start <= t < t_end`` [us]."""
        check_window(t_start, t_end)
        parts: list[Events] = []
        for block in self._all():
            if block.t[0] >= t_end:
                break
            start, stop = np.searchsorted(block.t, [t_start, t_end])
            if stop > start:
                parts.append(block[start:stop])
        return _copied(parts)

    def blocks(
        self, *, count: int | None = None, duration_us: int | None = None
    ) -> Iterator[Events]:
        """Return all events in blocks, as :meth:`amiwarp.EventSource.blocks`."""
        blocks = self._all()
        if self._kept is not None:
            blocks = (_copied([block]) for block in blocks)
        return regroup(blocks, count=count, duration_us=duration_us)

    def _all(self) -> Iterator[Events]:
        """Return all events in blocks, from memory or from the file."""
        if self._kept is not None:
            return iter(self._kept)
        return self._pass(PassCounts())

    def _pass(self, counts: PassCounts) -> Generator[Events, None, None]:
        """Read the file, and yield its events in blocks, repaired. ``counts`` is kept up to date."""
        with errors_name(self.path, counts.position):
            for packet in self._packets(counts.notes):
                surveys = None
                if isinstance(packet, Surveyed):
                    surveys = packet.surveys
                    packet = packet.events
                if isinstance(packet, Events):
                    if self._order(packet, counts, surveys):
                        for start in range(0, len(packet), DEFAULT_BLOCK):
                            yield packet[start : start + DEFAULT_BLOCK]
                        continue
                    # Some lie outside.
                    packet = packet.x, packet.y, packet.t, packet.p
                # Large packets are cut, so that copies stay small even if one packet holds the whole file.
                for start in range(0, len(packet[2]), DEFAULT_BLOCK):
                    x, y, t, p = (array[start : start + DEFAULT_BLOCK] for array in packet)
                    block = self._repair(x, y, t, p, counts)
                    if len(block):
                        yield block

    def _order(self, events: Events, counts: PassCounts, surveys: NDArray[Any] | None) -> bool:
        """Raise times that are out of order, in place, and count the events. Return False if some lie outside.

        It does the same as :meth:`_repair`, which also takes events that lie outside. ``surveys``: what the events
        hold, if it is known.
        """
        if not len(events):
            return True
        if surveys is None:
            surveys = surveys_of(events)
        right = int(surveys["right"].max())
        bottom = int(surveys["bottom"].max())
        width, height = self._size or (LARGEST_SIZE, LARGEST_SIZE)
        if right >= width or bottom >= height:
            return False

        # This refuses times beyond the limit.
        rounded_times(surveys["latest"])
        rounded_times(surveys["first"])

        before = counts.t_last if counts.count else int(surveys["first"][0])
        floors = np.maximum.accumulate(np.concatenate([[before], surveys["latest"][:-1]]))
        if surveys["decreases"].any() or (surveys["first"] < floors).any():
            late, late_us = raise_late_times(events, before)
            counts.late += late
            counts.late_us = max(counts.late_us, late_us)
        counts.add(events.t)
        counts.x_max = max(counts.x_max, right)
        counts.y_max = max(counts.y_max, bottom)
        return True

    def _repair(
        self, x: NDArray[Any], y: NDArray[Any], t: NDArray[Any], p: NDArray[Any], counts: PassCounts
    ) -> Events:
        """Return a block of events of any type, without events outside and in order, and count them."""
        # Sensor coordinates are uint16. Larger values would wrap around.
        width, height = self._size or (LARGEST_SIZE, LARGEST_SIZE)
        is_compensated = x.dtype.kind == "f"
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        if not is_compensated and not inside.all():
            counts.outside += int(inside.size - np.count_nonzero(inside))
            x = x[inside]
            y = y[inside]
            t = t[inside]
            p = p[inside]
            inside = inside[inside]
        if not t.size:
            return Events.empty()

        times = rounded_times(t)
        floor = counts.t_last if counts.count else int(times[0])
        ordered = np.maximum(np.maximum.accumulate(times), floor)
        raised = ordered - times
        counts.late += int(np.count_nonzero(raised))
        counts.late_us = max(counts.late_us, int(raised.max()))
        counts.add(ordered)

        if inside.any():
            counts.x_max = max(counts.x_max, int(np.rint(x[inside].max())))
            counts.y_max = max(counts.y_max, int(np.rint(y[inside].max())))
        if is_compensated:
            x = as_coordinate("x", x)
            y = as_coordinate("y", y)
        else:
            x = x.astype(np.uint16)
            y = y.astype(np.uint16)
        return Events(x, y, ordered, np.array(as_polarity(p)))


def _copied(blocks: list[Events]) -> Events:
    """Return the events of some blocks in new arrays, which a caller may change: the blocks may stay in memory.

    Read-only views would do without a copy, but PyTorch warns of them.
    """
    return Events.concatenate([Events.empty(), *blocks])
