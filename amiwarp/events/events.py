"""Events and their sources.

Times are int64 microseconds. Pixel coordinates are defined in :class:`amiwarp.Camera`. A source returns events in
blocks, so that recordings of any length are processed in constant memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import array as as_numbers
from amiwarp.validation import guarded, instance, one_of, whole

# Conversion and checks of event arrays: types, time limits, frame and order.

TIME_LIMIT = 2**62
"""Limit of the magnitude of times of events, encoder samples and index pulses [us]: 146,000 years.

The difference and the sum of any two times then fit int64.
"""

TIME_UNITS = {"us": 1.0, "s": 1e6}
"""Microseconds in each unit of times that arrays may have."""

FRACTION_OF_US = "times are whole microseconds; for seconds, give t_unit='s' (events) or np.rint(t * 1e6)"
"""Message for floating times with a fraction."""
COARSE_TIMES = "does not resolve 1 us there; give float64 or int64 from the start"
"""Message for floating times that were rounded before."""

SENSOR_DTYPE = np.dtype(np.uint16)
"""Data type of pixel coordinates from a sensor. Compensated events have float32 coordinates instead."""


def as_coordinate(name: str, values: ArrayLike) -> NDArray[Any]:
    """Return coordinates [px] as uint16 if they are integers, as float32 if they are floating."""
    array = as_numbers(values, f"events' {name}")
    if not array.size:
        return array.astype(array.dtype if array.dtype in (np.uint16, np.float32) else np.uint16)
    if array.dtype.kind == "f":
        with np.errstate(over="ignore"):
            short = array.astype(np.float32, copy=False)
        if np.isinf(short).any():
            raise AmiwarpError(f"events' {name} holds a coordinate that is too large for float32; drop that event")
        return short
    if array.dtype == np.uint16:
        return array
    if array.size and not (array.min() >= 0 and array.max() < LARGEST_SIZE):
        given = f"events' {name} spans {array.min()} .. {array.max()}"
        raise AmiwarpError(f"{given}; expected pixels in 0 .. {LARGEST_SIZE - 1}")
    return array.astype(np.uint16)


def as_polarity(values: ArrayLike) -> NDArray[np.uint8]:
    """Return polarities as uint8: 1 if positive or true, else 0. Truth values, and 0 and 1 as uint8, are not copied."""
    array = as_numbers(values, "events' p", "iufb")
    if array.dtype == np.bool_:
        return array.view(np.uint8)
    if array.dtype == np.uint8 and array.size and array.max() <= 1:
        return array
    if array.dtype.kind == "f" and np.isnan(array).any():
        raise AmiwarpError("events' p holds NaN; expected 1 for ON, 0 or -1 for OFF")
    return (array > 0).astype(np.uint8)


def as_times(values: ArrayLike, what: str = "times", unit: str = "us") -> NDArray[np.int64]:
    """Return times given in Python, of any numeric type and in one of :data:`TIME_UNITS`, as int64 [us].

    Times in seconds are rounded. Floating times in microseconds must be whole: others are likely in seconds. Raises
    :class:`AmiwarpError`, also for a time that is not finite, beyond :data:`TIME_LIMIT`, or too late for its type.
    """
    array = as_numbers(values, what)
    scale = TIME_UNITS[one_of(unit, TIME_UNITS, "t_unit")]
    if scale == 1.0 and array.dtype.kind != "f":
        return rounded_times(array, what)
    limit = largest_exact_time(array.dtype)
    with np.errstate(over="ignore"):
        scaled = array.astype(np.float64) * scale
    times = rounded_times(scaled, what)
    if scale == 1.0 and not np.array_equal(times, scaled):
        at = int(np.argmax(times != scaled))
        raise AmiwarpError(f"{what} hold {scaled.flat[at]:.9g} (number {at}): {FRACTION_OF_US}")
    if times.size and max(-int(times.min()), int(times.max())) > limit:
        raise AmiwarpError(f"{what} reach {np.abs(times).max()} us, and {array.dtype} {COARSE_TIMES}")
    return times


def largest_exact_time(dtype: np.dtype[Any]) -> float:
    """Return the largest time whose neighbours in a type are at most 1 us away [us]."""
    return 2.0 / float(np.finfo(dtype).eps) if dtype.kind == "f" else TIME_LIMIT


def rounded_times(values: ArrayLike, what: str = "times") -> NDArray[np.int64]:
    """Return times of a file, of any numeric type, as int64 [us], rounded.

    Raises :class:`AmiwarpError` for a time that is not finite or beyond :data:`TIME_LIMIT`.
    """
    array = as_numbers(values, what)
    if array.size and not (array.min() > -TIME_LIMIT and array.max() < TIME_LIMIT):
        given = f"{what} span {array.min()} .. {array.max()} us: not finite or beyond int64"
        raise AmiwarpError(f"{given}; expected microseconds within {TIME_LIMIT} us of 0")
    return np.asarray(np.rint(array) if array.dtype.kind == "f" else array, np.int64)


def check_order(events: Events, *, where: str, first_index: int = 0) -> None:
    """Raise :class:`AmiwarpError` if an event is earlier than the one before."""
    falls = events.t[1:] < events.t[:-1]
    if falls.any():
        falls = np.concatenate([[False], falls])
        _fail(events, where, first_index, falls, "is earlier than the one before; sort by time")


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
    """Check one block of events: coordinates, as :func:`check_coordinates`, order, time limits and polarities.

    ``after_t`` is the time of the last event before the block [us].
    """
    if not len(events):
        return
    check_coordinates(events, width, height, where=where, first_index=first_index, allow_nan=allow_nan)
    fail = partial(_fail, events, where, first_index)
    check_order(events, where=where, first_index=first_index)
    if after_t is not None and events.t[0] < after_t:
        fail(np.ones(1, np.bool_), f"is earlier than the one before ({after_t} us); sort by time")
    if not (events.t[0] > -TIME_LIMIT and events.t[-1] < TIME_LIMIT):  # the times are sorted here
        fail(np.abs(events.t.astype(np.float64)) >= TIME_LIMIT, f"has a time beyond {TIME_LIMIT} us; drop this event")
    if int(events.p.max()) > 1:
        fail(events.p > 1, "has a polarity that is neither 0 nor 1")


def check_coordinates(
    events: Events, width: int, height: int, *, where: str, first_index: int = 0, allow_nan: bool = False
) -> None:
    """Check the coordinates of one block of at least one event.

    Sensor coordinates (uint16) must lie in the frame. Compensated coordinates (float32) may lie outside it, but must be
    finite. With ``allow_nan``, NaN is allowed too: it marks a compensated event without a position. Raises
    :class:`AmiwarpError`, which gives ``where`` and the index of the first bad event, counted from ``first_index``.
    """
    fail = partial(_fail, events, where, first_index)
    if events.x.dtype == np.uint16:
        if int(events.x.max()) >= width or int(events.y.max()) >= height:
            fail((events.x >= width) | (events.y >= height), f"lies outside the {width}x{height} frame; check the size")
    elif allow_nan and bool(np.isinf(events.x).any() or np.isinf(events.y).any()):
        fail(np.isinf(events.x) | np.isinf(events.y), "has an infinite coordinate; drop it")
    elif not allow_nan and not bool(np.isfinite(events.x).all() and np.isfinite(events.y).all()):
        fail(~(np.isfinite(events.x) & np.isfinite(events.y)), "has a coordinate that is not finite; drop it")


def inside_image(x: NDArray[Any], y: NDArray[Any], width: int, height: int) -> NDArray[np.bool_]:
    """Return which points lie on a pixel of the image; NaN does not."""
    return np.asarray((x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5))


def _fail(events: Events, where: str, first_index: int, bad: NDArray[np.bool_], what: str) -> None:
    index = int(np.argmax(bad))
    x, y, t = events.x[index], events.y[index], events.t[index]
    raise AmiwarpError(f"{where}: event {first_index + index} (x={x}, y={y}, t={t} us) {what}")


DEFAULT_BLOCK = 1 << 20
"""Default number of events per block."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """A block of events as four arrays.

    Raises
    ------
    AmiwarpError
        If the arrays differ in length, or have other types than those below.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[10, 11], y=[5, 5], t=[0, 100], p=[1, -1])
    >>> len(events), events.p.tolist()
    (2, [1, 0])
    """

    x: NDArray[Any]
    """Column [px], shape ``(n,)``: uint16 from a sensor, float32 once compensated."""
    y: NDArray[Any]
    """Row [px], shape ``(n,)``, of the type of ``x``."""
    t: NDArray[np.int64]
    """Time of each event [us], shape ``(n,)``."""
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
    def from_arrays(
        cls, x: ArrayLike, y: ArrayLike, t: ArrayLike, p: ArrayLike, *, t_unit: Literal["us", "s"] = "us"
    ) -> Events:
        """Create events from arrays of any numeric type, of any library, in host memory.

        Arrays of NumPy, Warp, PyTorch, JAX and others with DLPack are used without a copy if they have the types of
        :class:`Events`, or truth values as ``p``, and no gaps between their values. Others are copied. For arrays on a
        GPU, use :class:`amiwarp.DeviceEvents`.

        Parameters
        ----------
        x, y : array_like
            Pixel coordinates [px], shape (n,). Integers become uint16. Floating values become float32 and mark
            compensated events; NaN marks a compensated event without a position.
        t : array_like
            Times [us], shape (n,), in ascending order. Floating times must be whole.
        p : array_like
            Polarities, shape (n,): ON if above 0 or true, else OFF. Both 0/1 and -1/1 are understood.
        t_unit : {"us", "s"}, default "us"
            Unit of ``t``. Times in seconds are rounded to microseconds.

        Returns
        -------
        Events
            The events.

        Raises
        ------
        AmiwarpError
            If a coordinate does not fit its type; if a time has a fraction of a microsecond, is not finite, beyond
            2**62 us, earlier than the one before, or floating and too late for its type to resolve 1 us; if a polarity
            is NaN; or if an array has masked values.

        Examples
        --------
        >>> amiwarp.Events.from_arrays(x=[10, 11], y=[5, 5], t=[0.5, 0.6], p=[1, 0], t_unit="s").t.tolist()
        [500000, 600000]
        """
        columns = as_coordinate("x", x), as_coordinate("y", y), as_times(t, unit=t_unit), as_polarity(p)
        events = cls(*(np.require(column, requirements=["C", "A"]) for column in columns))
        check_order(events, where="events")
        return events

    @classmethod
    def empty(cls) -> Events:
        """Return a block without events, with the types of a sensor.

        Returns
        -------
        Events
            Zero events.
        """
        none = np.zeros(0, np.uint16)
        return cls(none, none, np.zeros(0, np.int64), np.zeros(0, np.uint8))

    @classmethod
    def concatenate(cls, blocks: Sequence[Events]) -> Events:
        """Join blocks of events in the given order.

        Parameters
        ----------
        blocks : sequence of Events
            The blocks. A single block is returned without a copy.

        Returns
        -------
        Events
            All events.
        """
        if len(blocks) == 1:
            return blocks[0]
        if not blocks:
            return cls.empty()
        x, y, t, p = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("x", "y", "t", "p"))
        return cls(x, y, t, p)

    @property
    def whole_pixels(self) -> bool:
        """Whether the coordinates are those of a sensor, not compensated."""
        return bool(self.x.dtype == SENSOR_DTYPE)

    def __len__(self) -> int:
        return int(self.t.size)

    def __getitem__(self, which: slice | NDArray[Any]) -> Events:
        """Return the events at a slice (views), or at an index or boolean array (copies)."""
        return Events(self.x[which], self.y[which], self.t[which], self.p[which])


@runtime_checkable
class EventSource(Protocol):
    """Source of sorted events: arrays in memory, an indexed file, or a file that is read from its start."""

    def __len__(self) -> int: ...

    @property
    def t_first(self) -> int:
        """Time of the first event [us]. Raises :class:`AmiwarpError` if there are no events."""

    @property
    def t_last(self) -> int:
        """Time of the last event [us]. Raises :class:`AmiwarpError` if there are no events."""

    @property
    def size(self) -> tuple[int, int]:
        """Size of the sensor (width, height) [px]."""

    def slice(self, start: int, stop: int) -> Events:
        """Return the events with ``start <= index < stop``.

        Parameters
        ----------
        start, stop : int
            First index, and index after the last. Both are clipped to the existing events.

        Returns
        -------
        Events
            The events.
        """

    def find(self, t: int) -> int:
        """Return the index of the first event at or after a time.

        Parameters
        ----------
        t : int
            Time [us].

        Returns
        -------
        int
            The index, or the number of events if none is that late.
        """

    def between(self, t_start: int, t_end: int) -> Events:
        """Return the events with ``t_start <= t < t_end``.

        Parameters
        ----------
        t_start, t_end : int
            Start and end of the window [us].

        Returns
        -------
        Events
            The events.
        """

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """Return all events in order, in blocks of equal count or equal duration.

        Parameters
        ----------
        count : int, optional
            Events per block; ``1 << 20`` by default.
        duration_us : int, optional
            Length of a block's window [us]. Windows start at ``t_first + k * duration_us``. Empty windows are left out.

        Returns
        -------
        iterator of Events
            The blocks.
        """


@guarded
class MemoryEvents(EventSource):
    """Source of events that are held in memory. Its methods return views where they can.

    Parameters
    ----------
    events : Events
        The events, sorted by time.
    width, height : int
        Sensor size [px].

    Raises
    ------
    AmiwarpError
        If an event lies outside the frame, is out of order or has an unusable value, or if the size is not in
        1 .. 65536 px.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2, 3], y=[0, 0, 0], t=[0, 10, 20], p=[1, 0, 1])
    >>> source = amiwarp.MemoryEvents(events, width=4, height=4)
    >>> source.between(5, 20).x.tolist()
    [2]
    """

    def __init__(self, events: Events, width: int, height: int) -> None:
        instance(events, Events, "events in memory")
        width, height = (whole(size, "frame size", 1, LARGEST_SIZE, " pixels") for size in (width, height))
        # NaN marks compensated events without a position. Only compensated events are float32.
        check_events(events, width, height, where="events in memory", allow_nan=True)
        self._events = events
        self._size = (width, height)

    def __len__(self) -> int:
        return len(self._events)

    @property
    def t_first(self) -> int:
        return int(self._nonempty().t[0])

    @property
    def t_last(self) -> int:
        return int(self._nonempty().t[-1])

    @property
    def size(self) -> tuple[int, int]:
        return self._size

    def slice(self, start: int, stop: int) -> Events:
        return self._events[max(start, 0) : max(stop, 0)]

    def find(self, t: int) -> int:
        return int(np.searchsorted(self._events.t, t))

    def between(self, t_start: int, t_end: int) -> Events:
        start, stop = np.searchsorted(self._events.t, [t_start, t_end])
        return self._events[start:stop]

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        return regroup([self._events], count=count, duration_us=duration_us)

    def _nonempty(self) -> Events:
        if not len(self._events):
            raise AmiwarpError("the recording holds no events, so it has no first or last time; check len() first")
        return self._events


def regroup(chunks: Iterable[Events], *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
    """Regroup successive chunks of events into blocks of equal count or equal duration.

    At most one block is in memory. Raises :class:`AmiwarpError` if both ``count`` and ``duration_us`` are given or one
    is below 1.
    """
    if count is not None and duration_us is not None:
        raise AmiwarpError("blocks have both count and duration_us; give one of them")
    if duration_us is not None:
        return _by_duration(chunks, whole(duration_us, "duration_us", 1, TIME_LIMIT, " us per block"))
    count = DEFAULT_BLOCK if count is None else count
    return _by_count(chunks, whole(count, "count", 1, TIME_LIMIT, " events per block"))


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


EVENT_BYTES = 13
"""Memory of an event from a sensor [bytes]."""


OVERHEAD = 1024
"""Memory of a packet's Python objects in addition to its arrays [bytes]."""


def held_bytes(events: Events | Sized) -> int:
    """Return the memory of a waiting packet of events [bytes], including its Python objects."""
    if not isinstance(events, Events):  # on a device
        return OVERHEAD + EVENT_BYTES * len(events)
    return OVERHEAD + events.x.nbytes + events.y.nbytes + events.t.nbytes + events.p.nbytes
