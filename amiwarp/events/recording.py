"""Events and their sources, and the recording that holds them with encoder, camera, prism and ground truth.

Times are int64 microseconds. Pixel coordinates are defined in :class:`amiwarp.Camera`. A source returns events in
blocks, so that recordings of any length are processed in constant memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.other_sensors import ImageStore, ImuSamples
from amiwarp.events.truth import Truth
from amiwarp.optics.camera import LARGEST_SIZE, Camera
from amiwarp.optics.prism import NominalPrism
from amiwarp.schema.calls import guarded
from amiwarp.schema.type_names import not_called
from amiwarp.validation import (
    INT64,
    TIME_LIMIT,
    as_times,
    check_slice,
    instance,
    packed,
    shown,
    whole,
)
from amiwarp.validation import array as as_numbers

SENSOR_DTYPE = np.dtype(np.uint16)
"""Data type of pixel coordinates from a sensor. Compensated events have float32 coordinates instead."""


def as_coordinate(name: str, values: ArrayLike) -> NDArray[Any]:
    """Return coordinates [px] as uint16 if they are integers, as float32 if they are floating."""
    array = as_numbers(values, f"events' {name}")
    if not array.size:
        usable = array.dtype in (np.uint16, np.float32)
        return array.astype(array.dtype if usable else np.uint16)
    if array.dtype.kind == "f":
        with np.errstate(over="ignore"):
            short = array.astype(np.float32, copy=False)
        if np.isinf(short).any():
            raise AmiwarpError(
                f"events' {name} holds a coordinate that is too large for float32; drop that event"
            )
        return short
    if array.dtype == np.uint16:
        return array
    if array.size and not (array.min() >= 0 and array.max() < LARGEST_SIZE):
        given = f"events' {name} spans {array.min()} .. {array.max()}"
        raise AmiwarpError(f"{given}; expected pixels in 0 .. {LARGEST_SIZE - 1}")
    return array.astype(np.uint16)


def as_polarity(values: ArrayLike) -> NDArray[np.uint8]:
    """Return polarities as uint8: 1 if 1 or true, 0 if 0, -1 or false. Truth values, and uint8, are not copied.

    Raises :class:`AmiwarpError` for any other value, and for 0 and -1 in one array.
    """
    array = as_numbers(values, "events' p", "iufb")
    if array.dtype == np.bool_:
        return array.view(np.uint8)
    if not array.size:
        return array.astype(np.uint8)
    if array.dtype == np.uint8 and array.max() <= 1:
        return array
    on = array == 1
    off = -1 if array.min() == -1 else 0
    if np.count_nonzero(on) + np.count_nonzero(array == off) < array.size:
        raise wrong_polarity(array)
    return on.view(np.uint8)


def wrong_polarity(values: NDArray[Any]) -> AmiwarpError:
    """Return the error for an array that holds other polarities than 0 and 1, or -1 and 1. It names the first one."""
    bad = ~np.isin(values, (-1, 0, 1))
    mixed = not bad.any()
    if mixed:
        # Both 0 and -1 stand for OFF: the one that comes second is wrong.
        first_off = values.flat[int(np.argmax(values != 1))]
        other_off = 0 if first_off == -1 else -1
        bad = values == other_off
    first_bad = int(np.argmax(bad))
    value = values.flat[first_bad]
    given = f"events' p holds {shown(value.item())} (number {first_bad})"
    if mixed:
        other = "0" if value == -1 else "-1"
        return AmiwarpError(f"{given}, but also {other}; OFF is either 0 or -1")
    hint = "; if ON is 255 and OFF is 0, give p > 0" if value == 255 else ""
    return AmiwarpError(f"{given}; expected 1 for ON, and 0 or -1 for OFF{hint}")


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
    """Check one block of events: coordinates, as :func:`check_coordinates`, order and time limits.

    ``after_t`` is the time of the last event before the block [us].
    """
    if not len(events):
        return
    check_coordinates(
        events, width, height, where=where, first_index=first_index, allow_nan=allow_nan
    )
    fail = partial(_fail, events, where, first_index)
    check_order(events, where=where, first_index=first_index)
    if after_t is not None and events.t[0] < after_t:
        fail(np.ones(1, np.bool_), f"is earlier than the one before ({after_t} us); sort by time")
    if not (events.t[0] > -TIME_LIMIT and events.t[-1] < TIME_LIMIT):  # the times are sorted here
        beyond = np.abs(events.t.astype(np.float64)) >= TIME_LIMIT
        fail(beyond, f"has a time beyond {TIME_LIMIT} us; drop this event")


def check_coordinates(
    events: Events,
    width: int,
    height: int,
    *,
    where: str,
    first_index: int = 0,
    allow_nan: bool = False,
) -> None:
    """Check the coordinates of one block of at least one event.

    Sensor coordinates (uint16) must lie in the frame. Compensated coordinates (float32) may lie outside it, but must be
    finite. With ``allow_nan``, NaN is allowed too: it marks a compensated event without a position. Raises
    :class:`AmiwarpError`, which gives ``where`` and the index of the first bad event, counted from ``first_index``.
    """
    fail = partial(_fail, events, where, first_index)
    if events.x.dtype == np.uint16:
        right = int(events.x.max())
        bottom = int(events.y.max())
        if right >= width or bottom >= height:
            remedy = "check the size"
            if right < height and bottom < width:
                remedy = f"give width {height} and height {width}, if they are swapped"
            outside = (events.x >= width) | (events.y >= height)
            fail(outside, f"lies outside the {width}x{height} frame; {remedy}")
    elif allow_nan:
        if np.isinf(events.x).any() or np.isinf(events.y).any():
            infinite = np.isinf(events.x) | np.isinf(events.y)
            fail(infinite, "has an infinite coordinate; drop it")
    elif not (np.isfinite(events.x).all() and np.isfinite(events.y).all()):
        finite = np.isfinite(events.x) & np.isfinite(events.y)
        fail(~finite, "has a coordinate that is not finite; drop it")


def inside_image(x: NDArray[Any], y: NDArray[Any], width: int, height: int) -> NDArray[np.bool_]:
    """Return which points lie on a pixel of the image; NaN does not."""
    return np.asarray((x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5))


def _fail(events: Events, where: str, first_index: int, bad: NDArray[np.bool_], what: str) -> None:
    index = int(np.argmax(bad))
    x = events.x[index]
    y = events.y[index]
    t = events.t[index]
    raise AmiwarpError(f"{where}: event {first_index + index} (x={x}, y={y}, t={t} us) {what}")


DEFAULT_BLOCK = 1 << 20
"""Default number of events per block."""


def slice_bounds(which: object, length: int, what: str = "events") -> tuple[int, int]:
    """Return the start and stop of a slice without steps of ``length`` events: ``0 <= start <= stop <= length``.

    Raises :class:`AmiwarpError` for anything else, such as the index of one event. Python's own iteration over an
    object with an index ends in this error, too. ``what`` is the name of other items than events.
    """
    if isinstance(which, int | np.integer):
        single = "[-1:]" if which == -1 else f"[{which}:{which + 1}]"
        remedy = f"give a slice, such as {single} for one"
        if what == "events":
            remedy += " event, and iterate over a recording's events by blocks(count=...) or blocks(duration_us=...)"
        raise AmiwarpError(f"{what} are indexed by the number {which}; {remedy}")
    chosen = instance(which, slice, f"index of {what}")
    for end in (chosen.start, chosen.stop):
        if end is not None:
            whole(end, f"index of {what}", *INT64)
    start, stop, step = chosen.indices(length)
    if step != 1:
        raise AmiwarpError(
            f"{what} are sliced in steps of {step}; slice without steps, then NumPy arrays with them"
        )
    return start, max(start, stop)


def check_window(t_start: int, t_end: int) -> None:
    """Raise :class:`AmiwarpError` for a time window [us] that ends before its start."""
    if t_end < t_start:
        raise AmiwarpError(
            f"between({t_start}, {t_end}) ends before its start; give the start, then the end, in whole microseconds"
        )


def described(kind: str, *facts: str, span: tuple[int, int] | None, count: int) -> str:
    """Return a representation of at most one line of events: their number, ``facts``, time span and mean rate."""
    events = "event" if count == 1 else "events"
    facts = (f"{count:,} {events}", *facts)
    if span is not None:
        first, last = span
        facts = (*facts, f"t {first} .. {last} us")
        if last > first:
            facts = (*facts, f"{count / (last - first):.3g} Mev/s")
    return f"{kind}({', '.join(facts)})"


COLUMNS = ("x", "y", "t", "p")
"""Names of the columns of events, also in structured arrays."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """A block of events as four arrays.

    Raises
    ------
    AmiwarpError
        If the arrays differ in length, or have other types than those below, or if a polarity is neither 0 nor 1.

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
        columns: tuple[NDArray[Any], ...] = (self.x, self.y, self.t, self.p)
        shape = (np.size(self.t),)
        if not all(isinstance(column, np.ndarray) and column.shape == shape for column in columns):
            for name, column in zip(COLUMNS, columns, strict=True):
                instance(column, np.ndarray, f"events' {name}")
            shapes = {name: column.shape for name, column in zip(COLUMNS, columns, strict=True)}
            raise AmiwarpError(f"event arrays have shapes {shapes}; expected one length (n,)")
        if self.t.dtype != np.int64 or self.p.dtype != np.uint8:
            raise AmiwarpError(
                f"events' t is {self.t.dtype}, p is {self.p.dtype}; expected int64 and uint8, to which "
                "amiwarp.Events.from_arrays converts"
            )
        of_pixels = (np.dtype(np.uint16), np.dtype(np.float32))
        if self.x.dtype != self.y.dtype or self.x.dtype not in of_pixels:
            raise AmiwarpError(
                f"events' x is {self.x.dtype}, y is {self.y.dtype}; expected both uint16, or both float32 for "
                "compensated events, of which NaN marks those without a position"
            )
        if self.p.size and self.p.max() > 1:
            raise wrong_polarity(self.p)

    @classmethod
    def from_arrays(
        cls,
        x: ArrayLike,
        y: ArrayLike,
        t: ArrayLike,
        p: ArrayLike,
        *,
        t_unit: Literal["us", "s"] = "us",
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
            Polarities, shape (n,): truth values, 0 and 1, or -1 and 1. ON is true or 1.
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
            is another number, such as 255, or 0 and -1 both occur; or if an array has masked values.

        Examples
        --------
        >>> amiwarp.Events.from_arrays(x=[10, 11], y=[5, 5], t=[0.5, 0.6], p=[1, 0], t_unit="s").t.tolist()
        [500000, 600000]
        """
        events = cls(
            packed(as_coordinate("x", x)),
            packed(as_coordinate("y", y)),
            packed(as_times(t, unit=t_unit)),
            packed(as_polarity(p)),
        )
        check_order(events, where="events")
        return events

    @classmethod
    def from_structured(cls, array: Any, *, t_unit: Literal["us", "s"] = "us") -> Events:
        """Create events from a structured array with the fields ``x``, ``y``, ``t`` and ``p`` in any order.

        tonic, Prophesee's Metavision and other libraries hold events in such arrays. Other fields are ignored. The
        values are copied.

        Parameters
        ----------
        array : ndarray
            Structured array, shape (n,), with values as in :meth:`from_arrays`.
        t_unit : {"us", "s"}, default "us"
            Unit of ``t``. Times in seconds are rounded to microseconds.

        Returns
        -------
        Events
            The events.

        Raises
        ------
        AmiwarpError
            If the array is not structured or lacks a field; or for values that :meth:`from_arrays` refuses.

        Examples
        --------
        >>> import numpy as np
        >>> rows = [(0, 10, 5, 1), (100, 11, 5, -1)]
        >>> array = np.array(rows, dtype=[("t", "i8"), ("x", "i2"), ("y", "i2"), ("p", "i1")])
        >>> amiwarp.Events.from_structured(array).x.tolist()
        [10, 11]
        """
        fields = instance(array, np.ndarray, "structured array").dtype.names
        missing = [name for name in COLUMNS if name not in (fields or ())]
        if fields is None or missing:
            given = f"type {array.dtype} without fields"
            if fields:
                given = f"fields {', '.join(fields)}"
            raise AmiwarpError(
                f"structured array has {given}; field {missing[0]} is missing: give x, y, t and p"
            )
        return cls.from_arrays(*(array[name] for name in COLUMNS), t_unit=t_unit)

    def to_structured(self, dtype: Any = None) -> NDArray[Any]:
        """Return the events as a structured array, as tonic, Prophesee's Metavision and other libraries take them.

        Parameters
        ----------
        dtype : dtype, optional
            Structured data type with the fields ``x``, ``y``, ``t`` and ``p`` in any order and of any numeric types,
            such as ``tonic.io.events_struct`` or ``metavision_sdk_base.EventCD``. By default, these fields in this
            order, with the types of the events' arrays.

        Returns
        -------
        ndarray
            A copy of the events, shape (n,). ``t`` is in microseconds, ``p`` is 1 or 0.

        Raises
        ------
        AmiwarpError
            If ``dtype`` has other fields, or its types cannot hold the values.

        Examples
        --------
        >>> events = amiwarp.Events.from_arrays(x=[10, 11], y=[5, 6], t=[0, 100], p=[1, 0])
        >>> events.to_structured([("t", "i8"), ("x", "i2"), ("y", "i2"), ("p", "?")])[0].item()
        (0, 10, 5, True)
        """
        own_types = [(name, getattr(self, name).dtype) for name in COLUMNS]
        try:
            wanted = np.dtype(own_types if dtype is None else dtype)
        except Exception as error:  # any that converting an unknown object raises
            raise AmiwarpError(
                f"dtype is {shown(dtype)}; give a NumPy data type with the fields x, y, t, p"
            ) from error
        if wanted.names is None or sorted(wanted.names) != sorted(COLUMNS):
            raise AmiwarpError(
                f"dtype is {shown(wanted)}; give one with the fields x, y, t, p and no other"
            )
        out = np.empty(len(self), wanted)
        for name in COLUMNS:
            values = getattr(self, name)
            kind = out[name].dtype
            if kind.kind not in "iufb" or out[name].ndim > 1:
                raise AmiwarpError(
                    f"dtype has {name} of type {kind}; give an integer, floating or boolean type"
                )
            with np.errstate(invalid="ignore", over="ignore"):
                out[name] = values
            both_floating = values.dtype.kind == "f" and kind.kind == "f"
            if not np.array_equal(out[name], values, equal_nan=both_floating):
                first_lossy = int(np.argmax(out[name] != values))
                raise AmiwarpError(
                    f"dtype has {name} of type {kind}, which cannot hold {values[first_lossy]}; give a wider type"
                )
        return out

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
            All events. If some are compensated, all coordinates are float32.
        """
        if len(blocks) == 1:
            return blocks[0]
        if not blocks:
            return cls.empty()
        return cls(
            np.concatenate([block.x for block in blocks]),
            np.concatenate([block.y for block in blocks]),
            np.concatenate([block.t for block in blocks]),
            np.concatenate([block.p for block in blocks]),
        )

    @property
    def whole_pixels(self) -> bool:
        """Whether the coordinates are a sensor's, not compensated."""
        return bool(self.x.dtype == SENSOR_DTYPE)

    def __len__(self) -> int:
        return int(self.t.size)

    def __getitem__(self, which: slice | NDArray[Any]) -> Events:
        """Return the events at a slice (views), or at an index or boolean array (copies)."""
        t = self.t[which]
        if np.ndim(t) == 0:
            slice_bounds(which, len(self))  # raises the error with the remedy
        return Events(self.x[which], self.y[which], t, self.p[which])

    def __repr__(self) -> str:
        facts = () if self.whole_pixels else ("compensated",)
        span = (int(self.t[0]), int(self.t[-1])) if len(self) else None
        return described("Events", *facts, span=span, count=len(self))


@not_called("wrap events as amiwarp.MemoryEvents(events, width, height)")
@runtime_checkable
class EventSource(Protocol):
    """Source of sorted events: arrays in memory, an indexed file, or a file that is read from its start.

    A slice ``source[start:stop]`` gives its events in memory: ``source[:]`` all, ``source[-1000:]`` the last thousand.
    :meth:`between` gives the events of a time window, :meth:`blocks` iterates over all by count or by time. Own sources
    derive from this class.
    """

    def __len__(self) -> int: ...

    def __getitem__(self, which: slice) -> Events:
        """Return the events of a slice without steps, whose negative indices count from the end."""
        return self.slice(*slice_bounds(which, len(self)))

    if not TYPE_CHECKING:  # for type checkers, a source has no other attributes than those below

        def __getattr__(self, name: str) -> Any:
            """Raise AttributeError, which says where the arrays of events are."""
            hint = ""
            if name in COLUMNS:
                hint = (
                    f": its events are read on demand; give some, such as events[:].{name} for all, "
                    f"events[:1000].{name} for the first, or events.between(t_start, t_end).{name}"
                )
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'{hint}")

    def __repr__(self) -> str:
        span = (self.t_first, self.t_last) if len(self) else None
        return described(
            type(self).__name__, "{}x{} px".format(*self.size), span=span, count=len(self)
        )

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
            First index, and index after the last, at least 0. Both are clipped to the existing events.

        Returns
        -------
        Events
            The events.

        Raises
        ------
        AmiwarpError
            If an index is negative or no whole number.
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

        Raises
        ------
        AmiwarpError
            If a time is no whole number, such as one in seconds, or the end is before the start.
        """

    def blocks(
        self, *, count: int | None = None, duration_us: int | None = None
    ) -> Iterator[Events]:
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
        width = whole(width, "frame size", 1, LARGEST_SIZE, " pixels")
        height = whole(height, "frame size", 1, LARGEST_SIZE, " pixels")
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
        check_slice(start, stop)
        return self._events[start:stop]

    def find(self, t: int) -> int:
        return int(np.searchsorted(self._events.t, t))

    def between(self, t_start: int, t_end: int) -> Events:
        check_window(t_start, t_end)
        start, stop = np.searchsorted(self._events.t, [t_start, t_end])
        return self._events[start:stop]

    def blocks(
        self, *, count: int | None = None, duration_us: int | None = None
    ) -> Iterator[Events]:
        return regroup([self._events], count=count, duration_us=duration_us)

    def _nonempty(self) -> Events:
        if not len(self._events):
            raise AmiwarpError(
                "the recording holds no events, so it has no first or last time; check len() first",
                ErrorCode.CONTENT_MISSING,
            )
        return self._events


def regroup(
    chunks: Iterable[Events], *, count: int | None = None, duration_us: int | None = None
) -> Iterator[Events]:
    """Regroup successive chunks of events into blocks of equal count or equal duration.

    At most one block is in memory. Raises :class:`AmiwarpError` if both ``count`` and ``duration_us`` are given or one
    is below 1.
    """
    if count is not None and duration_us is not None:
        raise AmiwarpError("blocks have both count and duration_us; give one of them")
    if duration_us is not None:
        duration_us = whole(duration_us, "duration_us", 1, TIME_LIMIT, " us per block")
        return _by_duration(chunks, duration_us)
    if count is None:
        count = DEFAULT_BLOCK
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
            held = []
            missing = count
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
        if origin is None:
            origin = int(chunk.t[0])
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


MetadataValue: TypeAlias = str | int | float | bool
"""Type of a value in a recording's metadata."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Events with the encoder, camera and prism that recorded them.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4), name="example")
    >>> len(recording.events), recording.camera
    (2, None)
    >>> amiwarp.Recording(events, amiwarp.Camera.from_fov(4, 4, 1.0)).events.size
    (4, 4)
    """

    events: EventSource
    """Events of the recording, in order of time. :class:`amiwarp.Events` may be given with a camera, for their size."""
    camera: Camera | None = None
    """Camera intrinsics, or None if unknown."""
    encoder: Encoder | None = None
    """Encoder, which gives the prism angle over time, or None if there is none."""
    prism: NominalPrism | None = None
    """The nominal prism of the data sheet, not the calibrated one, or None if unknown. Its apex may be unknown."""
    truth: Truth | None = None
    """Ground truth of a synthetic recording, else None."""
    metadata: dict[str, MetadataValue] = field(default_factory=dict)
    """Other information by name, such as the file format, repairs made while reading, and the simulator's seed."""
    name: str = "recording"
    """Short name of the recording in messages and titles: the file name without its extension."""
    imu: ImuSamples | None = None
    """Samples of the camera's inertial measurement unit, or None."""
    frames: ImageStore | None = None
    """Frames that the camera recorded with the events, read on demand, or None."""
    depth: ImageStore | None = None
    """Depth maps that the camera recorded [m], read on demand, or None. A depth camera with frames has both at the same
    times."""

    def __init__(
        self,
        events: EventSource | Events,
        camera: Camera | None = None,
        encoder: Encoder | None = None,
        prism: NominalPrism | None = None,
        truth: Truth | None = None,
        metadata: dict[str, MetadataValue] | None = None,
        name: str = "recording",
        imu: ImuSamples | None = None,
        frames: ImageStore | None = None,
        depth: ImageStore | None = None,
    ) -> None:
        """Store the fields. Events in memory become :class:`amiwarp.MemoryEvents` of the camera's size."""
        if isinstance(events, Events):
            if camera is None:
                raise AmiwarpError(
                    "Recording: events have no sensor size; give the camera too, or wrap them as "
                    "amiwarp.MemoryEvents(events, width, height)"
                )
            events = MemoryEvents(events, camera.width, camera.height)
        metadata = {} if metadata is None else metadata
        values = (events, camera, encoder, prism, truth, metadata, name, imu, frames, depth)
        for own_field, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, own_field.name, value)

    def __repr__(self) -> str:
        others = ("camera", "encoder", "prism", "truth", "imu", "frames", "depth")
        held = [name for name in others if getattr(self, name) is not None]
        parts = f"with {', '.join(held)}" if held else "events only"
        return f"Recording({self.name!r}, {self.events!r}, {parts})"
