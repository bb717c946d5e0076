"""Events in Warp arrays on a CPU or a GPU, shared with other array libraries through DLPack."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_columns import THREADS, cast, event_column
from amiwarp.events.recording import (
    DEFAULT_BLOCK,
    Events,
    EventSource,
    check_coordinates,
    check_events,
    check_window,
    described,
    regroup,
    slice_bounds,
    wrong_polarity,
)
from amiwarp.events.recording import check_order as check_events_order
from amiwarp.kernels import events as kernels
from amiwarp.kernels.event_times import find_ranges, find_times, take_times
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.validation import TIME_LIMIT, check_slice, instance, shown, whole

NAMES = ("x", "y", "t", "p")
"""Names of the columns."""
COORDINATES = (("uint16", "uint16"), ("float32", "float32"))
"""Types of x and y: of a sensor, or compensated."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class DeviceEvents:
    """A block of events as four Warp arrays on one device.

    PyTorch, CuPy and JAX read the arrays through DLPack without a copy: ``torch.from_dlpack(events.x)``.

    Raises
    ------
    AmiwarpError
        If the arrays differ in length or device, or have other types than those below.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.array([10, 11], np.uint16)
    >>> events = amiwarp.DeviceEvents.from_arrays(x=x, y=[5, 5], t=[0, 100], p=[1, -1])
    >>> len(events), events.p.numpy().tolist()
    (2, [1, 0])
    >>> events.x.ptr == x.ctypes.data  # not copied
    True
    """

    x: wp.array
    """Column [px], shape ``(n,)``: uint16 from a sensor, float32 once compensated."""
    y: wp.array
    """Row [px], shape ``(n,)``, of the type of ``x``."""
    t: wp.array
    """Time [us], shape ``(n,)``, int64."""
    p: wp.array
    """Polarity, shape ``(n,)``, uint8: 1 is ON, 0 is OFF."""
    _limits: list[int] = field(default_factory=list, repr=False, init=False)

    def __post_init__(self) -> None:
        arrays = {
            name: instance(getattr(self, name), wp.array, f"events' {name}") for name in NAMES
        }
        shapes = {name: array.shape for name, array in arrays.items()}
        if any(shape != (self.t.size,) for shape in shapes.values()):
            raise AmiwarpError(f"event arrays have shapes {shapes}; expected one length (n,)")
        devices = {name: str(array.device) for name, array in arrays.items()}
        if len(set(devices.values())) > 1:
            raise AmiwarpError(f"event arrays are on devices {devices}; put them on one device")
        types = {name: array.dtype.__name__ for name, array in arrays.items()}
        coordinates = (types["x"], types["y"])
        if coordinates not in COORDINATES or (types["t"], types["p"]) != ("int64", "uint8"):
            wanted = "x and y both uint16 (whole pixels) or both float32, t int64, p uint8"
            raise AmiwarpError(f"event arrays have types {types}; expected {wanted}")
        if any(array.size and not array.is_contiguous for array in arrays.values()):
            raise AmiwarpError(
                "event arrays have gaps between their values; DeviceEvents.from_arrays copies them"
            )

    @classmethod
    def from_arrays(
        cls,
        x: Any,
        y: Any,
        t: Any,
        p: Any,
        *,
        t_unit: Literal["us", "s"] = "us",
        device: Any = None,
    ) -> DeviceEvents:
        """Create events from arrays of NumPy, Warp, PyTorch, CuPy, JAX or any other library with DLPack.

        Arrays with the types of :class:`DeviceEvents`, and truth values as ``p``, are used without a copy if they have
        no gaps and are on the device. Others are copied and checked. Arrays are not modified. They are kept alive, and
        must not be changed while the events are used.

        Parameters
        ----------
        x, y : array
            Pixel coordinates [px], shape (n,). Integers become uint16. Floating values become float32 and mark
            compensated events; NaN marks a compensated event without a position.
        t : array
            Times [us], shape (n,), in ascending order. Floating times must be whole.
        p : array
            Polarities, shape (n,): truth values, 0 and 1, or -1 and 1. ON is true or 1.
        t_unit : {"us", "s"}, default "us"
            Unit of ``t``. Times in seconds are rounded to microseconds.
        device : str or warp.Device, optional
            Device to put the events on. By default, they stay where the arrays are.

        Returns
        -------
        DeviceEvents
            The events.

        Raises
        ------
        AmiwarpError
            If the arrays differ in length or device; or for values that :meth:`Events.from_arrays` refuses.
        """
        events = cls(
            event_column("x", x, device, t_unit),
            event_column("y", y, device, t_unit),
            event_column("t", t, device, t_unit),
            event_column("p", p, device, t_unit),
        )
        if not len(events):
            return events
        first, last, right, bottom, polarity, _ = limits(events)
        if not -TIME_LIMIT < first <= last < TIME_LIMIT:
            raise AmiwarpError(
                f"times span {first} .. {last} us; expected microseconds within {TIME_LIMIT} us of 0"
            )
        if max(right, bottom) >= int(kernels.BEYOND):
            raise AmiwarpError("events' x or y holds an infinite coordinate; drop that event")
        check_order(events)
        if polarity > 1:
            raise wrong_polarity(events.p.numpy())
        return events

    @classmethod
    def concatenate(cls, blocks: Sequence[DeviceEvents]) -> DeviceEvents:
        """Join blocks on one device in the given order.

        Parameters
        ----------
        blocks : sequence of DeviceEvents
            The blocks, at least one. A single block is returned without a copy.

        Returns
        -------
        DeviceEvents
            All events. If some are compensated, all coordinates are float32.
        """
        if not blocks:
            raise AmiwarpError("there are no blocks of events to join; give at least one")
        if len(blocks) == 1:
            return blocks[0]
        pixels = wp.uint16 if all(block.whole_pixels for block in blocks) else wp.float32
        events = cls(
            join([cast(block.x, pixels) for block in blocks]),
            join([cast(block.y, pixels) for block in blocks]),
            join([block.t for block in blocks]),
            join([block.p for block in blocks]),
        )
        wait(events.device)
        return events

    @property
    def device(self) -> Any:
        """The device that holds the arrays, a ``warp.Device``."""
        return self.t.device

    @property
    def whole_pixels(self) -> bool:
        """Whether the coordinates are a sensor's, not compensated."""
        return self.x.dtype is wp.uint16

    @property
    def t_first(self) -> int:
        """Time of the earliest event [us]. Raises :class:`AmiwarpError` if there are no events."""
        return limits(self).t_first

    @property
    def t_last(self) -> int:
        """Time of the latest event [us]. Raises :class:`AmiwarpError` if there are no events."""
        return limits(self).t_last

    def to_host(self) -> Events:
        """Return the events in NumPy arrays: copies from a GPU, views on a CPU.

        Returns
        -------
        Events
            The events.
        """
        return Events(self.x.numpy(), self.y.numpy(), self.t.numpy(), self.p.numpy())

    def __len__(self) -> int:
        return int(self.t.size)

    def __getitem__(self, which: slice) -> DeviceEvents:
        """Return the events of a slice without steps, as views."""
        start, stop = slice_bounds(which, len(self))
        return DeviceEvents(*(part(getattr(self, name), start, stop) for name in NAMES))

    def __repr__(self) -> str:
        facts = [f"on {self.device}"]
        if not self.whole_pixels:
            facts.append("compensated")
        span = None
        count = len(self)
        if count:
            first = int(part(self.t, 0, 1).numpy()[0])
            last = int(part(self.t, count - 1, count).numpy()[0])
            span = (first, last)
        return described("DeviceEvents", *facts, span=span, count=count)


class EventRange(NamedTuple):
    """Part of events on a device: where it begins, its number of events, and the times of its first and last event."""

    first: int
    number: int
    first_us: int
    last_us: int


def part(values: wp.array, start: int, stop: int) -> wp.array:
    """Return the values with ``0 <= start <= index < stop``: a view, unless it is empty, which Warp does not allow."""
    if start < stop:
        return values[start:stop]
    return wp.empty(0, dtype=values.dtype, device=values.device)


def join(arrays: Sequence[wp.array]) -> wp.array:
    """Return one array of the values of several arrays on one device, of which there is at least one."""
    if len(arrays) == 1:
        return arrays[0]
    count = sum(len(values) for values in arrays)
    out = wp.empty(count, dtype=arrays[0].dtype, device=arrays[0].device)
    place = 0
    for values in arrays:
        if len(values):
            wp.copy(out, values, dest_offset=place)
        place += len(values)
    return out


class Limits(NamedTuple):
    """Extremes of events on a device."""

    t_first: int
    """Time of the first event [us]."""
    t_last: int
    """Time of the last event [us]."""
    right: int
    """Largest x [px]; 0 for compensated events."""
    bottom: int
    """Largest y [px]; 0 for compensated events."""
    polarity: int
    """Largest p."""
    decreases: int
    """1 if times decrease anywhere, else 0."""


def limits(events: DeviceEvents) -> Limits:
    """Return the extremes of events.

    They are found once. For a part of :class:`DeviceMemoryEvents`, all
    but the times are limits of all its events. Raises :class:`AmiwarpError` if there are no events.
    """
    if not len(events):
        raise AmiwarpError(
            "there are no events, so there is no first or last time; check len() first"
        )
    if events._limits:
        return Limits(*events._limits)
    device = events.device
    none = np.array([2**63 - 1, -(2**63), 0, 0, 0, 0])
    extremes = wp.array(none, dtype=wp.int64, device=device)
    threads = min(len(events), THREADS) if device.is_cuda else 1
    inputs = [events.x, events.y, events.t, events.p, threads]
    wp.launch(kernels.find_limits, threads, inputs=inputs, outputs=[extremes], device=device)
    events._limits.extend(extremes.numpy().tolist())
    return Limits(*events._limits)


def check_order(events: Events | DeviceEvents, first_index: int = 0) -> None:
    """Raise :class:`AmiwarpError` if an event is earlier than the one before. ``first_index``: of the first event."""
    if isinstance(events, Events):
        check_events_order(events, where="events", first_index=first_index)
    elif len(events) and limits(events).decreases:
        check_order(events.to_host(), first_index)  # it names the event


def check_inside(events: Events | DeviceEvents, width: int, height: int) -> None:
    """Raise :class:`AmiwarpError` with the first event of a sensor outside its frame; compensated ones may be there."""
    if not len(events) or not events.whole_pixels:
        return
    if isinstance(events, DeviceEvents):
        _, _, right, bottom, _, _ = limits(events)
        if right < width and bottom < height:
            return
        events = events.to_host()  # it names the event; the limits may be of more events
    check_coordinates(events, width, height, where="events")


def check_sensor(events: Events | DeviceEvents) -> None:
    """Raise :class:`AmiwarpError` for compensated events; events from a sensor have uint16 coordinates."""
    if not events.whole_pixels:
        raise AmiwarpError(
            "event coordinates are float32, already compensated; give events from a sensor (uint16)"
        )


def time_span(events: Events | DeviceEvents) -> tuple[int, int]:
    """Return the times of the first and the last of sorted events, of which there is at least one [us]."""
    if isinstance(events, DeviceEvents):
        return events.t_first, events.t_last
    return int(events.t[0]), int(events.t[-1])


def times_at(events: Events | DeviceEvents, indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the times of a few events [us]."""
    times = _times_on_host(events)
    if times is not None:
        return times[indices]
    return _look_up(take_times, events.t, indices)


def first_and_last_time(events: Events | DeviceEvents) -> tuple[int, int]:
    """Return the times of the first and the last event, of which there is at least one [us]."""
    times = _times_on_host(events)
    if times is None:
        times = times_at(events, np.array([0, len(events) - 1]))
    return int(times[0]), int(times[-1])


def find_indices(events: Events | DeviceEvents, times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of the first event at or after each time."""
    on_host = _times_on_host(events)
    if on_host is not None:
        return np.searchsorted(on_host, times).astype(np.int64)
    return _look_up(find_times, events.t, times)


def _times_on_host(events: Events | DeviceEvents) -> NDArray[np.int64] | None:
    """Return the times [us] if they are in memory of the host, without a copy; None if they are on a GPU."""
    if isinstance(events, Events):
        return events.t
    if events.device.is_cpu:
        return np.asarray(events.t.numpy())
    return None


def _look_up(kernel: Any, t: wp.array, given: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return what a kernel finds in the times of events on a device for each given number."""
    if not len(given):
        return given.copy()
    # The kernel replaces the numbers by what it finds.
    shared = host_numbers(len(given), wp.int64, t.device)
    shared.numpy()[: len(given)] = given
    launch(kernel, len(given), [t, shared], [shared], device=t.device)
    wait(t.device)
    indices = shared.numpy()[: len(given)].copy()
    idle_numbers[t.device.is_cpu, wp.int64].append(shared)
    return indices


idle_numbers: defaultdict[tuple[bool, Any], list[wp.array]] = defaultdict(list)
"""Memory of the host that a later call uses again, by whether it is for a CPU, and type. GPUs read it and write to it,
so it is page-locked for them. Locking takes longer than many calls. What is not used is 0 in arrays of int32."""


def host_numbers(n: int, dtype: Any, device: Any) -> wp.array:
    """Return at least ``n`` numbers in memory of the host that the device, too, reads and writes.

    A caller that has waited for the device puts it back to ``idle_numbers``.
    """
    free_numbers = idle_numbers[device.is_cpu, dtype]
    while free_numbers:
        with contextlib.suppress(IndexError):  # another thread took it
            numbers = free_numbers.pop()
            if len(numbers) >= n:
                return numbers
    return wp.zeros(max(n, 64), dtype=dtype, device="cpu", pinned=device.is_cuda)


def device_for(events: Events | DeviceEvents, device: Any) -> Any:
    """Return the device to compute on: where the events are if they are on a device, else ``device``, "cpu" if None.

    Raises :class:`AmiwarpError` if events are on another device than ``device``.
    """
    if not isinstance(events, DeviceEvents):
        if not isinstance(events, Events):
            raise AmiwarpError(f"events is {shown(events)}; expected Events or DeviceEvents")
        return wp.get_device("cpu" if device is None else device)
    if device is not None and wp.get_device(device) != events.device:
        raise AmiwarpError(f"events are on {events.device}, device is {device}; leave device out")
    return events.device


def wait(device: Any) -> None:
    """Wait until a device has finished the work of Warp's current stream.

    Public functions call it before they return arrays on a device. The caller may then change or release its
    arrays, and read the results on any stream, also with libraries that ignore streams.
    """
    if device.is_cuda:
        _keep_memory(device.alias)
        wp.synchronize_stream(device)


@cache
def _keep_memory(name: str) -> None:
    """Let Warp keep memory that a call gave back, unless a limit is set: at most a GiB, or a sixteenth of the GPU's.

    Otherwise each wait returns it to the driver, and the next call takes up to a millisecond to get it again.
    """
    device = wp.get_device(name)
    if device.is_mempool_enabled and not wp.get_mempool_release_threshold(device):
        wp.set_mempool_release_threshold(device, min(1 << 30, device.total_memory // 16))


@guarded
class DeviceMemoryEvents(EventSource):
    """Source of events that are held on a device, for recordings.

    Every function that takes a recording takes one with this source. :func:`reconstruct` reads the events on the
    device. All others read copies in NumPy arrays, which the methods of :class:`EventSource` return here. A slice
    ``source[start:stop]`` stays on the device, like :meth:`slice_on_device`.

    Parameters
    ----------
    events : DeviceEvents
        The events, sorted by time.
    width, height : int
        Sensor size [px].

    Raises
    ------
    AmiwarpError
        If an event lies outside the frame or is out of order, a polarity is neither 0 nor 1, or the size is not in
        1 .. 65536 px.

    Examples
    --------
    >>> events = amiwarp.DeviceEvents.from_arrays(x=[1, 2, 3], y=[0, 0, 0], t=[0, 10, 20], p=[1, 0, 1])
    >>> source = amiwarp.DeviceMemoryEvents(events, width=4, height=4)
    >>> source.between_on_device(5, 20).x.numpy().tolist()
    [2]
    """

    def __init__(self, events: DeviceEvents, width: int, height: int) -> None:
        instance(events, DeviceEvents, "events on a device")
        width = whole(width, "frame size", 1, LARGEST_SIZE, " pixels")
        height = whole(height, "frame size", 1, LARGEST_SIZE, " pixels")
        if len(events):
            _, _, right, bottom, polarity, decreases = limits(events)
            outside = right >= width or bottom >= height
            if outside or polarity > 1 or decreases:
                # The check on the host names the event.
                where = "events on a device"
                check_events(events.to_host(), width, height, where=where, allow_nan=True)
        self._events = events
        self._size = (width, height)

    def __len__(self) -> int:
        return len(self._events)

    @property
    def t_first(self) -> int:
        return self._events.t_first

    @property
    def t_last(self) -> int:
        return self._events.t_last

    @property
    def size(self) -> tuple[int, int]:
        return self._size

    @property
    def device(self) -> Any:
        """The device that holds the events, a ``warp.Device``."""
        return self._events.device

    def __getitem__(self, which: slice) -> DeviceEvents:  # type: ignore[override]
        """Return the events of a slice without steps where they are: as views on the device."""
        start, stop = slice_bounds(which, len(self))
        if start >= stop:
            return self._part(EventRange(start, 0, 0, 0))
        ends = times_at(self._events, np.array([start, stop - 1])).tolist()
        return self._part(EventRange(start, stop - start, *ends))

    def _part(self, which: EventRange) -> DeviceEvents:
        """Return a part of the events where they are, with its limits."""
        found = self._events[which.first : which.first + which.number]
        if which.number:
            ends = [which.first_us, which.last_us]
            found._limits.extend([*ends, *limits(self._events)[2:]])
        return found

    def slice(self, start: int, stop: int) -> Events:
        return self.slice_on_device(start, stop).to_host()

    def slice_on_device(self, start: int, stop: int) -> DeviceEvents:
        """Return the events with ``start <= index < stop``, as views on the device.

        Parameters
        ----------
        start, stop : int
            First index, and index after the last, at least 0. Both are clipped to the existing events.

        Returns
        -------
        DeviceEvents
            The events.

        Raises
        ------
        AmiwarpError
            If an index is negative.
        """
        check_slice(start, stop)
        return self[start:stop]

    def find(self, t: int) -> int:
        return int(find_indices(self._events, np.array([t]))[0])

    def between(self, t_start: int, t_end: int) -> Events:
        return self.between_on_device(t_start, t_end).to_host()

    def between_on_device(self, t_start: int, t_end: int) -> DeviceEvents:
        """Return the events with ``t_start <= t < t_end``, as views on the device.

        Parameters
        ----------
        t_start, t_end : int
            Start and end of the window [us].

        Returns
        -------
        DeviceEvents
            The events.

        Raises
        ------
        AmiwarpError
            If the end is before the start.
        """
        check_window(t_start, t_end)
        (found,) = ranges_between(self, [(t_start, t_end)])
        return self._part(found)

    def blocks(
        self, *, count: int | None = None, duration_us: int | None = None
    ) -> Iterator[Events]:
        starts = range(0, len(self), DEFAULT_BLOCK)
        chunks = (self.slice(start, start + DEFAULT_BLOCK) for start in starts)
        return regroup(chunks, count=count, duration_us=duration_us)


def all_events(source: DeviceMemoryEvents) -> DeviceEvents:
    """Return all events of a source, the same object each time."""
    return source._events


def ranges_between(
    source: DeviceMemoryEvents, windows: Sequence[tuple[int, int]]
) -> list[EventRange]:
    """Return the part of the events in each window, from its start to before its end [us]; waits for the device once.

    It waits for the current stream only. Events do not change, so any stream may look them up.
    """
    t = source._events.t
    count = len(windows)
    shared = host_numbers(4 * count, wp.int64, t.device)
    numbers = shared.numpy()[: 4 * count].reshape(count, 4)
    numbers[:, :2] = windows
    launch(find_ranges, count, [t, shared], [shared], device=t.device)
    wait(t.device)
    found = [EventRange(*row) for row in numbers.tolist()]
    idle_numbers[t.device.is_cpu, wp.int64].append(shared)
    return found


class DeviceValues:
    """Array on a device with one row per event, which slices copy to NumPy arrays (:class:`EventValues`)."""

    def __init__(self, values: wp.array) -> None:
        self._values = values

    def __getitem__(self, which: slice, /) -> NDArray[Any]:
        start, stop = slice_bounds(which, len(self._values), "values")
        return np.asarray(part(self._values, start, stop).numpy())


def device_of(source: EventSource, device: Any) -> Any:
    """Return the device to compute on, as :func:`device_for` does for events."""
    if isinstance(source, DeviceMemoryEvents):
        return device_for(source.slice_on_device(0, len(source)), device)
    return wp.get_device("cpu" if device is None else device)


def read_between(source: EventSource, t_start: int, t_end: int) -> Events | DeviceEvents:
    """Return the events of a time window [us] where they are: on the device, or in NumPy arrays."""
    if isinstance(source, DeviceMemoryEvents):
        return source.between_on_device(t_start, t_end)
    return source.between(t_start, t_end)
