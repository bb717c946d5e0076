"""Event source for files without an index: a first pass counts, checks and repairs; later uses read the file again.

Two faults of real recordings are repaired and counted, in all formats alike. An event that is earlier than one before
it is moved to the largest time so far. An event outside the frame is dropped, unless it is compensated. If more than
1 % of the events have one of these faults, the file is refused, because then its format, size or order must be wrong;
but steps back of at most a millisecond are always repaired.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import (
    DEFAULT_BLOCK,
    Events,
    EventSource,
    ImuSamples,
    MetadataValue,
    as_coordinate,
    as_polarity,
    check_window,
    regroup,
)
from amiwarp.events.truth import Instants
from amiwarp.io.files import errors_name, open_input, register_reader
from amiwarp.io.reading_process import packets
from amiwarp.optics.camera import LARGEST_SIZE, check_size
from amiwarp.validation import check_slice, guarded, rounded_times

Columns: TypeAlias = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
"""Arrays x, y [px], t [us], p of events; or channel, 0, t [us] and 1 for a rising edge, of triggers."""


@dataclass(frozen=True, slots=True)
class Surveyed:
    """Events whose decoder has also noted what blocks of them hold."""

    events: Events
    surveys: NDArray[Any] | None
    """What each block holds, see :class:`amiwarp.kernels.event_order.Survey`; None if the events have been changed."""

    @property
    def is_in_order(self) -> bool:
        """Whether no event is earlier than the one before it."""
        if self.surveys is None:
            return not bool((self.events.t[1:] < self.events.t[:-1]).any())
        first = self.surveys["first"]
        return not self.surveys["falls"].any() and bool((first[1:] >= self.surveys["latest"][:-1]).all())


Packet: TypeAlias = Columns | Events | Surveyed
"""Packet of events: arrays x, y [px], t [us] and p (ON if positive) as stored in the file: integers or booleans of one
shape ``(n,)``. x and y of compensated events are floating. Events of a sensor, whose arrays nobody else holds, are
checked by a kernel, in less than a tenth of the time."""

SMALL_STEP_US = 1000
"""Largest repair of a time that any number of events may need [us]: cameras send groups of events out of order."""
CHECKED_EVENTS = 1 << 15
"""Number of events that one thread checks."""

KEEP_EVENTS = 1 << 22
"""Largest recording that stays in memory after the first pass [events], 55 MB."""

SORT_EVENTS = 1 << 25
"""Largest recording that is sorted by time [events], for which 1.2 GB of memory are needed."""

SENSORS = (
    (128, 128),  # DVS128; it also holds the events of the SciDVS (126x112)
    (132, 104),  # DVS132S
    (240, 180),  # DAVIS240
    (304, 240),  # ATIS
    (320, 240),  # DVXplorer Lite
    (346, 260),  # DAVIS346
    (320, 320),  # Prophesee GenX320
    (640, 480),  # Prophesee Gen3.1, DVXplorer, DAVIS640
    (640, 512),
    (1280, 720),  # Prophesee Gen4.1, IMX636, IMX646
    (1280, 800),  # CeleX-V
    (1280, 960),  # Samsung DVS-Gen4
)
"""Sizes of known sensors (width, height) [px], for files that do not state a size: the first that holds all
events is taken."""


def smallest_sensor(x_max: int, y_max: int, sensors: tuple[tuple[int, int], ...] = SENSORS) -> tuple[int, int]:
    """Return the size of the smallest known sensor with pixel (x_max, y_max), or the smallest frame that holds it."""
    for width, height in sensors:
        if x_max < width and y_max < height:
            return width, height
    return x_max + 1, y_max + 1


ASSUMED = "assumed_"
"""Prefix of the names of assumptions in the metadata of a recording."""

ASSUMED_SIZE = ASSUMED + "size"
"""Name of the assumption of a sensor size."""


@dataclass(frozen=True, slots=True)
class Assumption:
    """Property of a file that the file does not state."""

    what: str
    """Name of the property, such as "time unit"."""
    value: str
    """Value that is assumed."""
    why: str
    """Reason for it."""
    option: str
    """Option of the command line that overrides it."""

    @property
    def entry(self) -> tuple[str, str]:
        """Name and text of the assumption in the metadata of a recording."""
        return ASSUMED + self.what.replace(" ", "_"), f"{self.value}: {self.why}; {self.option}"


def assumed_texts(metadata: Mapping[str, MetadataValue]) -> list[str]:
    """Return for each assumption in the metadata of a recording what is assumed, and the option that overrides it."""
    return [f"{each.what} {each.value} ({each.option})" for each in assumptions_of(metadata)]


def assumptions_of(metadata: Mapping[str, MetadataValue]) -> list[Assumption]:
    """Return the assumptions in the metadata of a recording."""
    found = []
    for name, text in metadata.items():
        if name.startswith(ASSUMED):
            value, _, rest = str(text).partition(": ")
            why, _, option = rest.rpartition("; ")
            found.append(Assumption(name.removeprefix(ASSUMED).replace("_", " "), value, why, option))
    return found


@dataclass(frozen=True, slots=True)
class GivenSource:
    """What the user says of an event source."""

    size: tuple[int, int] | None = None
    """Sensor size (width, height) [px], which replaces the size in the file; or None."""
    sort: bool = False
    """Whether the events are sorted by time."""


_given: ContextVar[GivenSource | None] = ContextVar("given", default=None)
"""What the user says of the sources that are opened, or None."""


@contextlib.contextmanager
def given_source(given: GivenSource) -> Iterator[None]:
    """Apply what the user says to the sources that are opened in the block."""
    token = _given.set(given)
    try:
        yield
    finally:
        _given.reset(token)


def given_size() -> tuple[int, int] | None:
    """Return the size of :func:`given_source`, or None."""
    given = _given.get()
    return None if given is None else given.size


def assumed_size(size: tuple[int, int], sensors: Iterable[tuple[int, int]] = SENSORS) -> Assumption:
    """Return the assumption of a sensor size."""
    holds = "the smallest known sensor" if size in sensors else "the smallest frame"
    return Assumption("size", f"{size[0]}x{size[1]}", f"the file does not state it; {holds} with all events", "--size")


_head: ContextVar[int | None] = ContextVar("head", default=None)
"""Number of events after which the first pass ends, or None."""


@contextlib.contextmanager
def head_only(count: int) -> Iterator[None]:
    """Let the sources that are opened in the block read only about their first ``count`` events.

    Their length is then that of this part, and :attr:`FileEvents.share` tells how much of the file it is.
    """
    token = _head.set(count)
    try:
        yield
    finally:
        _head.reset(token)


def head_limit() -> int | None:
    """Return the number of events of :func:`head_only`, or None outside it."""
    return _head.get()


RECORDS = ("triggers", "frames", "imu_samples")
"""Names of the counts of other records than events. They are shown, but are no repairs."""

PROGRESS = ("read", "total")
"""Names of the counts of what a pass has read so far, and of all there is, in any unit."""


def whole_pixels(values: NDArray[Any]) -> NDArray[np.int64]:
    """Return floating coordinates as integers. NaN and values beyond 32 bits become -1, which lies outside.

    Raises :class:`AmiwarpError` for a fraction, which would be lost.
    """
    known = np.where(np.abs(values) < 2**31, values, -1)
    whole = known.astype(np.int64)
    if not np.array_equal(whole, known):
        given = known[whole != known][0]
        raise AmiwarpError(
            f"a coordinate is {given:g}; expected whole pixels (compensated events: amiwarp's .h5 or .npz)"
        )
    return whole


def microseconds(seconds: NDArray[Any]) -> NDArray[np.int64]:
    """Return times in seconds as whole microseconds. Raises :class:`AmiwarpError` if one is not finite."""
    with np.errstate(over="ignore"):
        times = seconds.astype(np.float64) * 1e6
    if not (np.abs(times) < 2**62).all():
        raise AmiwarpError("a time is not finite or beyond int64; the file is damaged")
    return np.rint(times).astype(np.int64)


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

    def position(self) -> str:
        """Return the current position of the pass, for messages."""
        return f"after {self.count} events (t = {self.t_last} us)" if self.count else "before the first event"


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

        Without a ``size``, that of the smallest of ``sensors`` with all events is taken. ``last_time`` returns the time
        of the last event [us] from the end of the file, given an estimate; it is used if only the head is read.
        """
        size = given_size() or size
        if size is not None:
            check_size(*size, path)
        self.path = path
        self._sensors = sensors
        given = _given.get()
        self._packets = _sorted_packets(path, packets) if given is not None and given.sort else packets
        self._size = size
        self.size_is_known = size is not None
        """Whether the file stores the sensor size. Otherwise the smallest known sensor that contains all events is
        assumed."""
        self._kept: list[Events] | None = []
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
        """Read all blocks, or those up to ``limit`` events if the reader notes how much of the file they are."""
        began: tuple[float, int] | None = None
        for block in blocks:
            if self._kept is not None:
                self._kept.append(block)
                self._kept = self._kept if self._counts.count <= KEEP_EVENTS or limit is not None else None
            read, total = (self._counts.notes.get(name, 0) for name in PROGRESS)
            # The time before the first block starts processes, and does not grow with the file.
            began = began or (time.perf_counter(), read)
            if limit is not None and self._counts.count >= limit and 0 < read < total:
                self.share = read / total
                if read > began[1]:
                    self.seconds = (time.perf_counter() - began[0]) * total / (read - began[1])
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
        frame = "the {}x{} frame".format(*self._size) if self._size else f"pixels 0 .. {LARGEST_SIZE - 1}"
        damaged = "the file is damaged or mislabelled"
        unsorted = f"{damaged}; if its events are in the order of pixels, sort them by time with --sort"
        faults = (
            (counts.outside, f"lie outside {frame}", damaged),
            (late, "are out of order", unsorted),
        )
        for bad, what, remedy in faults:
            if bad * 100 > total:
                raise AmiwarpError(f"{self.path}: {bad} of {total} events {what}; {remedy}")
        if not counts.count:
            raise AmiwarpError(f"{self.path}: holds no events; give another recording")

    @property
    def repairs(self) -> dict[str, int]:
        """Number of repairs and other findings by name; names with the number 0 are left out."""
        repairs = {
            "repaired_time_events": self._counts.late,
            "largest_time_repair_us": self._counts.late_us,
            "dropped_outside_events": self._counts.outside,
        }
        notes = {name: count for name, count in self._counts.notes.items() if name not in (*RECORDS, *PROGRESS)}
        return {name: count for name, count in {**repairs, **notes}.items() if count}

    @property
    def records(self) -> dict[str, int]:
        """Number of other records by name: triggers, frames and IMU samples, without zeros."""
        return {name: self._counts.notes[name] for name in RECORDS if self._counts.notes.get(name)}

    @property
    def metadata(self) -> dict[str, MetadataValue]:
        """Counts for the metadata of a recording: other records and repairs; and the size, if it is assumed."""
        assumed = () if self.size_is_known else (assumed_size(self.size, self._sensors).entry,)
        return {**self.records, **self.repairs, **dict(assumed)}

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
        found: list[Events] = []
        seen = 0
        for block in self._all():
            if seen >= stop:
                break
            found.append(block[max(start - seen, 0) : max(stop - seen, 0)])
            seen += len(block)
        return _copied([block for block in found if len(block)])

    def find(self, t: int) -> int:
        """Return the index of the first event at or after ``t`` [us]."""
        seen = 0
        for block in self._all():
            if block.t[-1] >= t:
                return seen + int(np.searchsorted(block.t, t))
            seen += len(block)
        return seen

    def between(self, t_start: int, t_end: int) -> Events:
        """Return the events with ``t_start <= t < t_end`` [us]."""
        check_window(t_start, t_end)
        found: list[Events] = []
        for block in self._all():
            if block.t[0] >= t_end:
                break
            start, stop = np.searchsorted(block.t, [t_start, t_end])
            if stop > start:
                found.append(block[start:stop])
        return _copied(found)

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """Return all events in blocks, as :meth:`amiwarp.EventSource.blocks`."""
        blocks = self._all()
        if self._kept is not None:
            blocks = (_copied([block]) for block in blocks)
        return regroup(blocks, count=count, duration_us=duration_us)

    def _all(self) -> Iterator[Events]:
        return iter(self._kept) if self._kept is not None else self._pass(PassCounts())

    def _pass(self, counts: PassCounts) -> Generator[Events, None, None]:
        with errors_name(self.path, counts.position):
            for packet in self._packets(counts.notes):
                surveys = None
                if isinstance(packet, Surveyed):
                    surveys = packet.surveys
                    packet = packet.events
                if isinstance(packet, Events) and self._order(packet, counts, surveys):
                    yield from (packet[k : k + DEFAULT_BLOCK] for k in range(0, len(packet), DEFAULT_BLOCK))
                    continue
                if isinstance(packet, Events):  # some lie outside
                    packet = packet.x, packet.y, packet.t, packet.p
                # Large packets are cut, so that copies stay small even if one packet holds the whole file.
                for start in range(0, len(packet[2]), DEFAULT_BLOCK):
                    x, y, t, p = (array[start : start + DEFAULT_BLOCK] for array in packet)
                    block = self._repair(x, y, t, p, counts)
                    if len(block):
                        yield block

    def _order(self, events: Events, counts: PassCounts, surveys: NDArray[Any] | None) -> bool:
        """Raise times that are out of order, in place, and count the events. Return False if some lie outside.

        It does the same as :meth:`_repair`, which takes those that lie outside. ``surveys``: what the events hold, if
        it is known.
        """
        if not len(events):
            return True
        found = _surveys(events) if surveys is None else surveys
        right = int(found["right"].max())
        bottom = int(found["bottom"].max())
        width, height = self._size or (LARGEST_SIZE, LARGEST_SIZE)
        if right >= width or bottom >= height:
            return False
        rounded_times(found["latest"])  # which refuses times beyond its limit
        rounded_times(found["first"])
        before = counts.t_last if counts.count else int(found["first"][0])
        floors = np.maximum.accumulate(np.concatenate([[before], found["latest"][:-1]]))
        if found["falls"].any() or (found["first"] < floors).any():
            late, late_us = _raise_times(events, before)
            counts.late += late
            counts.late_us = max(counts.late_us, late_us)
        counts.t_first = counts.t_first if counts.count else int(events.t[0])
        counts.t_last = int(events.t[-1])
        counts.count += len(events)
        counts.x_max = max(counts.x_max, right)
        counts.y_max = max(counts.y_max, bottom)
        return True

    def _repair(self, x: NDArray[Any], y: NDArray[Any], t: NDArray[Any], p: NDArray[Any], counts: PassCounts) -> Events:
        # Sensor coordinates are uint16. Larger values would wrap around.
        width, height = self._size or (LARGEST_SIZE, LARGEST_SIZE)
        compensated = x.dtype.kind == "f"
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        if not compensated and not inside.all():
            counts.outside += int(inside.size - np.count_nonzero(inside))
            x, y, t, p, inside = x[inside], y[inside], t[inside], p[inside], inside[inside]
        if not t.size:
            return Events.empty()
        times = rounded_times(t)
        floor = counts.t_last if counts.count else int(times[0])
        ordered = np.maximum(np.maximum.accumulate(times), floor)
        raised = ordered - times
        counts.late += int(np.count_nonzero(raised))
        counts.late_us = max(counts.late_us, int(raised.max()))
        counts.t_first = counts.t_first if counts.count else int(ordered[0])
        counts.t_last, counts.count = int(ordered[-1]), counts.count + ordered.size
        if inside.any():
            counts.x_max = max(counts.x_max, int(np.rint(x[inside].max())))
            counts.y_max = max(counts.y_max, int(np.rint(y[inside].max())))
        x, y = (
            as_coordinate(name, values) if compensated else values.astype(np.uint16)
            for name, values in (("x", x), ("y", y))
        )
        return Events(x, y, ordered, np.array(as_polarity(p)))


def _surveys(events: Events) -> NDArray[Any]:
    """Return what blocks of some events hold, see :class:`amiwarp.kernels.event_order.Survey`."""
    import warp as wp

    from amiwarp.kernels.event_order import Survey, survey_events
    from amiwarp.kernels.launch import launch, start_once

    start_once()
    x, y, t = (wp.array(each, device="cpu", copy=False) for each in (events.x, events.y, events.t))
    blocks = -(-len(events) // CHECKED_EVENTS)
    surveys = wp.empty(blocks, dtype=Survey, device="cpu")
    launch(survey_events, blocks, [x, y, t, CHECKED_EVENTS], [surveys], device="cpu", smallest=1)
    return np.asarray(surveys.numpy())


def _raise_times(events: Events, before: int) -> tuple[int, int]:
    """Raise each time to the largest so far, ``before`` the events [us]. Return how many were, and by how much most."""
    import warp as wp

    from amiwarp.kernels.event_order import raise_times
    from amiwarp.kernels.launch import launch

    latest = _surveys(events)["latest"]
    floors = np.maximum.accumulate(np.concatenate([[before], latest[:-1]]))
    t = wp.array(events.t, device="cpu", copy=False)
    raised = wp.empty(latest.size, dtype=int, device="cpu")
    furthest = wp.empty(latest.size, dtype=wp.int64, device="cpu")
    inputs = [CHECKED_EVENTS, wp.array(floors, dtype=wp.int64, device="cpu")]
    launch(raise_times, latest.size, inputs, [t, raised, furthest], device="cpu", smallest=1)
    return int(raised.numpy().sum()), int(furthest.numpy().max())


def _sorted_packets(
    path: Path, packets: Callable[[dict[str, int]], Iterator[Packet]]
) -> Callable[[dict[str, int]], Iterator[Packet]]:
    """Return a function that starts a pass over the events in the order of time. They are all kept in memory.

    Events of equal times keep their order. Raises :class:`AmiwarpError` for more than :data:`SORT_EVENTS` events.
    """
    counts: dict[str, int] = {}
    parts: list[tuple[NDArray[Any], ...]] = []
    count = 0
    with errors_name(path, lambda: f"after {count} events"):
        for packet in packets(counts):
            if isinstance(packet, Surveyed):
                packet = packet.events
            columns = (packet.x, packet.y, packet.t, packet.p) if isinstance(packet, Events) else packet
            parts.append(columns)
            count += len(columns[2])
            if count > SORT_EVENTS:
                raise AmiwarpError(f"holds over {SORT_EVENTS:,} events, too many to sort; sort the file by time")
        if not parts:
            return lambda notes: iter(())
        x, y, t, p = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        parts.clear()
        times = rounded_times(t)
        order = np.argsort(times, kind="stable")
        counts["sorted_events"] = int(np.count_nonzero(order != np.arange(order.size)))
        in_order = x[order], y[order], times[order], p[order]

    def start(notes: dict[str, int]) -> Iterator[Packet]:
        notes.update(counts)
        yield in_order

    return start


def _copied(blocks: list[Events]) -> Events:
    """Return the events of some blocks in new arrays, which a caller may change: the blocks may be those kept.

    Read-only views would do without a copy, but PyTorch warns of them.
    """
    return Events.concatenate([Events.empty(), *blocks])


# Pieces of a file, and times of a counter that wraps around.


def read_pieces(path: Path, offset: int, size: int, notes: dict[str, int]) -> Iterator[bytes]:
    """Yield pieces of ``size`` bytes of a file from ``offset`` on, and note how much of it was read."""
    notes["total"] = path.stat().st_size
    with open_input(path) as file:
        file.seek(offset)
        while data := file.read(size):
            notes["read"] = file.tell()
            yield data


def read_words(path: Path, offset: int, dtype: str, count: int, notes: dict[str, int]) -> Iterator[NDArray[Any]]:
    """Yield ``count`` records of two 32-bit words at a time, shape ``(n, 2)``. A record that is cut off is noted."""
    for data in read_pieces(path, offset, 8 * count, notes):
        if len(data) % 8:
            notes["truncated_bytes"] = len(data) % 8
        yield np.frombuffer(data, dtype, len(data) // 8 * 2).reshape(-1, 2)


def nearest(value: int, bits: int, estimate: int) -> int:
    """Return the value of a counter of ``bits`` bits with the number of wraps that brings it nearest to an estimate."""
    return value + ((estimate - value + (1 << bits >> 1)) >> bits << bits)


def unwrapped(values: NDArray[np.int64], bits: int, before: int | None = None) -> NDArray[np.int64]:
    """Return the values of a counter of ``bits`` bits, from 0 on, without its wraps.

    ``before`` is the unwrapped value that they continue. A step of more than half the range is a wrap of the counter,
    forwards or backwards. A smaller step backwards is a value out of order.
    """
    if not values.size:
        return values
    size = 1 << bits
    start = int(values[0]) if before is None else before
    step = np.diff(values, prepend=start % size)
    wraps = np.cumsum((step < -(size // 2)).astype(np.int64) - (step > size // 2))
    return values + (start // size + wraps) * size


def last_word(path: Path, offset: int, dtype: str, estimate: int) -> int | None:
    """Return the 32-bit time of the last record of 8 bytes in a file, unwrapped next to an estimate, or None.

    ``offset`` is the position of the first record. The time is the first word of ``dtype`` "<u4", the second of ">u4".
    """
    count = (path.stat().st_size - offset) // 8
    if not count:
        return None
    with open_input(path) as file:
        file.seek(offset + 8 * (count - 1))
        words = np.frombuffer(file.read(8), dtype)
    return nearest(int(words[0 if dtype == "<u4" else 1]), 32, estimate)


# IMU samples and frames of files that are read only from their start.
#
# They are read after the events, and only if the file is read completely: of the first part of a large file, which
# ``amiwarp info`` reads, they are only counted.

GRAVITY = 9.80665
"""Standard gravity [m/s^2], the unit g of acceleration."""

Packets = Iterator[tuple[NDArray[Any], ...]]
"""Packets of arrays from the reading process."""

Kept = TypeVar("Kept")


def imu_of(path: Path, columns: Packets) -> ImuSamples:
    """Return the samples in packets of seven columns, ordered by time.

    The columns hold the time [us], the angular velocity around x, y, z [rad/s] and the acceleration along x, y, z
    [m/s^2].
    """
    with errors_name(path, lambda: "IMU samples"):
        found = list(columns)
        if not found:
            return ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        t, *values = (np.concatenate(parts) for parts in zip(*found, strict=True))
        times = rounded_times(t)
        order = np.argsort(times, kind="stable")
        rows = np.stack(values, axis=1).astype(np.float64)[order]
        return ImuSamples(times[order], rows[:, :3].copy(), rows[:, 3:].copy())


class StreamedImages(Instants[NDArray[Any]]):
    """Frames of a file without an index, read on demand.

    Frames that are read in order take one pass over the file. An earlier frame starts a new pass.
    """

    def __init__(self, path: Path, heads: Packets, pixels: Callable[[], Packets]) -> None:
        """Take the time [us], width, height and bytes per pixel of each frame, and a function that starts a pass.

        Raises :class:`AmiwarpError` if the frames differ in size or data type.
        """
        self._path, self._pixels = path, pixels
        with errors_name(path, lambda: "frames"):
            found = list(heads)
            t, width, height, depth = (np.concatenate(parts) for parts in zip(*found, strict=True))
            kinds = set(zip(width.tolist(), height.tolist(), depth.tolist(), strict=True))
            if len(kinds) != 1 or (np.diff(t) < 0).any():
                raise AmiwarpError("frames differ in size or bits, or their times decrease")
        super().__init__(rounded_times(t))
        self._size, self._dtype = (int(width[0]), int(height[0])), np.dtype(f"u{int(depth[0])}")
        self._lock = threading.Lock()
        self._pass: Generator[NDArray[Any], None, None] | None = None
        self._next = 0

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""
        return self._size

    def _read(self, index: int) -> NDArray[Any]:
        with self._lock, errors_name(self._path, lambda: f"frame {index}"):
            if self._pass is None or index < self._next:
                self.close()
                self._pass = self._images()
            for image in self._pass:
                self._next += 1
                if self._next == index + 1:
                    if self._next == len(self.t):
                        self.close()
                    return image
            raise AmiwarpError("the file holds fewer frames than when it was opened; open it again")

    def close(self) -> None:
        """End the pass over the file."""
        if self._pass is not None:
            self._pass.close()
        self._pass, self._next = None, 0

    def _images(self) -> Generator[NDArray[Any], None, None]:
        """Yield all frames. Packets hold whole frames as bytes."""
        width, height = self._size
        count = width * height * self._dtype.itemsize
        running = self._pixels()
        with contextlib.closing(running) if isinstance(running, Generator) else contextlib.nullcontext():
            for (packet,) in running:
                for start in range(0, packet.size, count):
                    yield packet[start : start + count].view(self._dtype).reshape(height, width)


def sensors_of(
    path: Path, counts: Mapping[str, MetadataValue], start: Callable[[str], Packets]
) -> tuple[ImuSamples | None, StreamedImages | None, dict[str, MetadataValue]]:
    """Return the IMU samples and frames that were counted, and for those that cannot be read a note that says why.

    ``start`` starts a pass over the file, with the name of what it yields: ``read_imu``, ``read_heads`` or
    ``read_images``.
    """
    notes: dict[str, MetadataValue] = {}
    if head_limit() is not None:
        return None, None, notes
    imu = frames = None
    if counts.get("imu_samples"):
        imu = _if_readable(path, "imu", lambda: imu_of(path, start("read_imu")), notes)
    if counts.get("frames"):
        images = partial(start, "read_images")
        frames = _if_readable(path, "frames", lambda: StreamedImages(path, start("read_heads"), images), notes)
    return imu, frames, notes


def read_sensors(
    path: Path, counts: Mapping[str, MetadataValue], module: str, *arguments: Any
) -> tuple[ImuSamples | None, StreamedImages | None, dict[str, MetadataValue]]:
    """Return what :func:`sensors_of` returns, read in the reading process.

    ``module`` is the name of the module with the functions that are started. They get the absolute path and
    ``arguments``.
    """
    return sensors_of(path, counts, lambda name: packets(f"{module}:{name}", path.absolute(), *arguments, {}))


def only_counted(counts: Mapping[str, MetadataValue], *names: str) -> dict[str, MetadataValue]:
    """Return notes that the records ``imu_samples`` or ``frames`` are not read, for those that were counted."""
    return {
        f"{name.partition('_')[0]}_note": "only counted: amiwarp does not read them from this format"
        for name in names
        if counts.get(name)
    }


def _if_readable(path: Path, name: str, read: Callable[[], Kept], notes: dict[str, MetadataValue]) -> Kept | None:
    """Return what a function reads; None if it raises :class:`AmiwarpError`, which is then noted."""
    try:
        return read()
    except AmiwarpError as error:
        why = str(error).removeprefix(f"{path}: ").partition(": ")[2]
        notes[f"{name}_note"] = f"only counted: {why or error}"
        return None
