"""Events and their sources.

Times are int64 microseconds, pixels as in :mod:`amiwarp.optics.camera`. A source returns blocks, so that a recording
of any length is processed in constant memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import array as as_numbers
from amiwarp.validation import instance, whole

DEFAULT_BLOCK = 1 << 20
"""Events per block where nothing else is asked for."""

TIME_LIMIT = 2**62
"""Times of events, encoder samples and index pulses lie within this, either way [us]: 146,000 years.

The difference and the sum of any two then stay within int64.
"""

SENSOR = np.dtype(np.uint16)
"""Type of a sensor's pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """A block of events. Raises :class:`AmiwarpError` where the arrays' lengths or types disagree."""

    x: NDArray[Any]
    """Column [px], shape ``(n,)``: uint16 from a sensor, float32 once compensated."""
    y: NDArray[Any]
    """Row [px], shape ``(n,)``, of the type of ``x``."""
    t: NDArray[np.int64]
    """Time [us], shape ``(n,)``."""
    p: NDArray[np.uint8]
    """Polarity, shape ``(n,)``: 1 is ON, 0 is OFF."""

    def __post_init__(self) -> None:
        for name in ("x", "y", "t", "p"):
            instance(getattr(self, name), np.ndarray, f"events' {name}")
        shapes = {name: getattr(self, name).shape for name in ("x", "y", "t", "p")}
        if any(shape != (self.t.size,) for shape in shapes.values()):
            raise AmiwarpError(f"event arrays have shapes {shapes}; expected one length (n,)")
        if self.t.dtype != np.int64 or self.p.dtype != np.uint8:
            raise AmiwarpError(f"events' t is {self.t.dtype}, p is {self.p.dtype}; expected int64 and uint8")
        if self.x.dtype != self.y.dtype or self.x.dtype not in (np.dtype(np.uint16), np.dtype(np.float32)):
            raise AmiwarpError(
                f"events' x is {self.x.dtype}, y is {self.y.dtype}; expected both uint16 or both float32"
            )

    @classmethod
    def from_arrays(cls, x: ArrayLike, y: ArrayLike, t: ArrayLike, p: ArrayLike) -> Events:
        """Convert arrays of any numeric type: floating x, y become float32, integers uint16; times are rounded.

        Polarity is ON where ``p`` is above 0 (or true), else OFF: 0 and 1 as well as -1 and 1. NaN in ``x`` or ``y``
        marks a compensated event without a place. Raises :class:`AmiwarpError` where an integer coordinate does not fit
        uint16 or a floating one float32, a time is not finite or not within :data:`TIME_LIMIT`, or a polarity is NaN.
        """
        return cls(_coordinate("x", x), _coordinate("y", y), as_times(t), _polarity(p))

    @classmethod
    def empty(cls) -> Events:
        """No events, with a sensor's types."""
        none = np.zeros(0, np.uint16)
        return cls(none, none, np.zeros(0, np.int64), np.zeros(0, np.uint8))

    @classmethod
    def concatenate(cls, blocks: Sequence[Events]) -> Events:
        """Join blocks in the order given; a single block is returned as it is."""
        if len(blocks) == 1:
            return blocks[0]
        if not blocks:
            return cls.empty()
        x, y, t, p = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("x", "y", "t", "p"))
        return cls(x, y, t, p)

    def __len__(self) -> int:
        return int(self.t.size)

    def __getitem__(self, which: slice | NDArray[Any]) -> Events:
        """Events at a slice (views) or at an index or boolean array (copies)."""
        return Events(self.x[which], self.y[which], self.t[which], self.p[which])


def _coordinate(name: str, values: ArrayLike) -> NDArray[Any]:
    array = as_numbers(values, f"events' {name}")
    if not array.size:
        return array.astype(array.dtype if array.dtype in (np.uint16, np.float32) else np.uint16)
    if array.dtype.kind == "f":
        with np.errstate(over="ignore"):
            short = array.astype(np.float32, copy=False)
        if np.isinf(short).any():
            raise AmiwarpError(f"events' {name} holds a coordinate that float32 cannot hold; drop that event")
        return short
    if array.dtype == np.uint16:
        return array
    if array.size and not (array.min() >= 0 and array.max() <= 65535):
        raise AmiwarpError(f"events' {name} spans {array.min()} .. {array.max()}; expected pixels in 0 .. 65535")
    return array.astype(np.uint16)


def _polarity(values: ArrayLike) -> NDArray[np.uint8]:
    array = as_numbers(values, "events' p", "iufb")
    if array.dtype.kind == "f" and np.isnan(array).any():
        raise AmiwarpError("events' p holds NaN; expected 1 for ON, 0 or -1 for OFF")
    return (array > 0).astype(np.uint8)


def as_times(values: ArrayLike) -> NDArray[np.int64]:
    """Times of any numeric type as int64 [us], rounded.

    Raises :class:`AmiwarpError` for a time that is not finite or not within :data:`TIME_LIMIT`.
    """
    array = as_numbers(values, "times")
    if array.size and not (array.min() > -TIME_LIMIT and array.max() < TIME_LIMIT):
        raise AmiwarpError(f"times span {array.min()} .. {array.max()} us: not finite or beyond int64")
    return np.asarray(np.rint(array) if array.dtype.kind == "f" else array, np.int64)


def check_sensor(events: Events) -> None:
    """Raises :class:`AmiwarpError` for events that are no sensor's (uint16): compensated ones."""
    if events.x.dtype != SENSOR:
        raise AmiwarpError(
            f"event coordinates are {events.x.dtype}, already compensated; give events from a sensor (uint16)"
        )


def check_events(
    events: Events,
    width: int,
    height: int,
    *,
    where: str,
    first_index: int = 0,
    allow_nan: bool = False,
    after_t: int | None = None,
) -> None:
    """Check one block: in the frame (uint16), finite (float32), sorted, within :data:`TIME_LIMIT`, p in {0, 1}.

    ``allow_nan`` takes NaN, not infinity, for compensated events without a place. Compensated (float32) coordinates may
    lie outside the frame. ``after_t`` is the time of the event before the block.
    Raises :class:`AmiwarpError` naming ``where`` and the index of the first bad event (``first_index`` + its place).
    """
    if not len(events):
        return

    def fail(bad: NDArray[np.bool_], what: str) -> None:
        index = int(np.argmax(bad))
        x, y, t = events.x[index], events.y[index], events.t[index]
        raise AmiwarpError(f"{where}: event {first_index + index} (x={x}, y={y}, t={t} us) {what}")

    if events.x.dtype == np.uint16:
        if int(events.x.max()) >= width or int(events.y.max()) >= height:
            fail((events.x >= width) | (events.y >= height), f"lies outside the {width}x{height} frame; check the size")
    elif allow_nan and bool(np.isinf(events.x).any() or np.isinf(events.y).any()):
        fail(np.isinf(events.x) | np.isinf(events.y), "has a coordinate that is infinite; drop it")
    elif not allow_nan and not bool(np.isfinite(events.x).all() and np.isfinite(events.y).all()):
        fail(~(np.isfinite(events.x) & np.isfinite(events.y)), "has a coordinate that is not finite; drop it")
    if bool((events.t[1:] < events.t[:-1]).any()):
        fail(np.concatenate([[False], events.t[1:] < events.t[:-1]]), "is earlier than the one before; sort by time")
    if after_t is not None and events.t[0] < after_t:
        fail(np.ones(1, np.bool_), f"is earlier than the one before ({after_t} us); sort by time")
    if not (events.t[0] > -TIME_LIMIT and events.t[-1] < TIME_LIMIT):  # they are sorted
        fail(np.abs(events.t.astype(np.float64)) >= TIME_LIMIT, f"has a time beyond {TIME_LIMIT} us; it is damaged")
    if int(events.p.max()) > 1:
        fail(events.p > 1, "has a polarity that is neither 0 nor 1")


@runtime_checkable
class EventSource(Protocol):
    """Where events come from: memory, a file, a stream that was scanned. Times never decrease."""

    def __len__(self) -> int: ...

    @property
    def t_first(self) -> int:
        """Time of the first event [us]; :class:`AmiwarpError` where there is none."""

    @property
    def t_last(self) -> int:
        """Time of the last event [us]; :class:`AmiwarpError` where there is none."""

    @property
    def size(self) -> tuple[int, int]:
        """Sensor's (width, height) [px]."""

    def slice(self, start: int, stop: int) -> Events:
        """Events ``start <= index < stop``, clipped to those there are."""

    def find(self, t: int) -> int:
        """Index of the first event at or after ``t`` [us]; ``len`` where there is none."""

    def between(self, t_start: int, t_end: int) -> Events:
        """Events with ``t_start <= t < t_end`` [us]."""

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """All events in order: ``count`` at a time (default ``1 << 20``), or by windows of ``duration_us``.

        Windows start at ``t_first + k * duration_us``; those without events are left out.
        """


class MemoryEvents:
    """Events in memory as a source.

    Raises :class:`AmiwarpError` where they fail :func:`check_events`, or for a size not in 1 .. 65536 pixels.
    """

    def __init__(self, events: Events, width: int, height: int) -> None:
        instance(events, Events, "events in memory")
        width, height = (whole(size, "frame size", 1, LARGEST_SIZE, " pixels") for size in (width, height))
        # NaN marks compensated events without a place; only they are float32.
        check_events(events, width, height, where="events in memory", allow_nan=True)
        self._events = events
        self._size = (width, height)

    def __len__(self) -> int:
        return len(self._events)

    @property
    def t_first(self) -> int:
        """Time of the first event [us]."""
        return int(self._nonempty().t[0])

    @property
    def t_last(self) -> int:
        """Time of the last event [us]."""
        return int(self._nonempty().t[-1])

    @property
    def size(self) -> tuple[int, int]:
        """Sensor's (width, height) [px]."""
        return self._size

    def slice(self, start: int, stop: int) -> Events:
        """Events ``start <= index < stop``, as views."""
        return self._events[max(start, 0) : max(stop, 0)]

    def find(self, t: int) -> int:
        """See :meth:`EventSource.find`."""
        return int(np.searchsorted(self._events.t, t))

    def between(self, t_start: int, t_end: int) -> Events:
        """Events with ``t_start <= t < t_end`` [us], as views."""
        start, stop = np.searchsorted(self._events.t, [t_start, t_end])
        return self._events[start:stop]

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """See :meth:`EventSource.blocks`."""
        return regroup([self._events], count=count, duration_us=duration_us)

    def _nonempty(self) -> Events:
        if not len(self._events):
            raise AmiwarpError("the recording holds no events, so it has no first or last time")
        return self._events


def regroup(chunks: Iterable[Events], *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
    """Cut sequential chunks anew, by count or by duration; at most one block is held.

    Raises :class:`AmiwarpError` where both are given or one is below 1.
    """
    if count is not None and duration_us is not None:
        raise AmiwarpError("blocks are cut by count or by duration_us; give one of them")
    if duration_us is not None:
        if duration_us < 1:
            raise AmiwarpError(f"blocks of duration_us = {duration_us}; expected at least 1 us")
        return _by_duration(chunks, int(duration_us))
    count = DEFAULT_BLOCK if count is None else count
    if count < 1:
        raise AmiwarpError(f"blocks of count = {count}; expected at least 1 event")
    return _by_count(chunks, int(count))


def _by_count(chunks: Iterable[Events], count: int) -> Iterator[Events]:
    held: list[Events] = []
    missing = count
    for chunk in chunks:
        start = 0
        while len(chunk) - start >= missing:
            held.append(chunk[start : start + missing])
            start += missing
            yield Events.concatenate(held)
            held, missing = [], count
        if start < len(chunk):
            held.append(chunk[start:])
            missing -= len(chunk) - start
    if held:
        yield Events.concatenate(held)


def _by_duration(chunks: Iterable[Events], duration_us: int) -> Iterator[Events]:
    held: list[Events] = []
    held_window = 0
    origin: int | None = None
    for chunk in chunks:
        if not len(chunk):
            continue
        origin = int(chunk.t[0]) if origin is None else origin
        window = (chunk.t - origin) // duration_us
        edges = [0, *(np.flatnonzero(window[1:] != window[:-1]) + 1).tolist(), len(chunk)]
        for start, stop in itertools.pairwise(edges):
            if held and window[start] != held_window:
                yield Events.concatenate(held)
                held = []
            held.append(chunk[start:stop])
            held_window = int(window[start])
    if held:
        yield Events.concatenate(held)
