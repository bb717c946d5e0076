"""A source of events that are held on a device."""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.checks import check_events
from amiwarp.events.device_events import DeviceEvents, device_for, limits, part
from amiwarp.events.events import DEFAULT_BLOCK, Events, EventSource, regroup
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import guarded, instance, whole


@guarded
class DeviceMemoryEvents(EventSource):
    """Source of events that are held on a device, for recordings.

    Every function that takes a recording takes one with this source. :func:`reconstruct` reads the events on the
    device. All others read copies in NumPy arrays, which the methods of :class:`EventSource` return here.

    Parameters
    ----------
    events : DeviceEvents
        The events, sorted by time.
    width, height : int
        Sensor size [px].

    Raises
    ------
    AmiwarpError
        If an event lies outside the frame or is out of order, or if the size is not in 1 .. 65536 px.

    Examples
    --------
    >>> events = amiwarp.DeviceEvents.from_arrays(x=[1, 2, 3], y=[0, 0, 0], t=[0, 10, 20], p=[1, 0, 1])
    >>> source = amiwarp.DeviceMemoryEvents(events, width=4, height=4)
    >>> source.between_on_device(5, 20).x.numpy().tolist()
    [2]
    """

    def __init__(self, events: DeviceEvents, width: int, height: int) -> None:
        instance(events, DeviceEvents, "events on a device")
        width, height = (whole(size, "frame size", 1, LARGEST_SIZE, " pixels") for size in (width, height))
        if len(events):
            _, _, right, bottom, _, decreases = limits(events)
            if right >= width or bottom >= height or decreases:  # the check on the host names the event
                check_events(events.to_host(), width, height, where="events on a device", allow_nan=True)
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

    def slice(self, start: int, stop: int) -> Events:
        return self.slice_on_device(start, stop).to_host()

    def slice_on_device(self, start: int, stop: int) -> DeviceEvents:
        """Return the events with ``start <= index < stop``, as views on the device.

        Parameters
        ----------
        start, stop : int
            First index, and index after the last. Both are clipped to the existing events.

        Returns
        -------
        DeviceEvents
            The events.
        """
        return self._events[max(start, 0) : max(stop, 0)]

    def find(self, t: int) -> int:
        times = self._events.t
        return bisect.bisect_left(range(len(self)), t, key=lambda index: int(times[index : index + 1].numpy()[0]))

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
        """
        return self._events[self.find(t_start) : self.find(t_end)]

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        chunks = (self.slice(start, start + DEFAULT_BLOCK) for start in range(0, len(self), DEFAULT_BLOCK))
        return regroup(chunks, count=count, duration_us=duration_us)


class DeviceValues:
    """Array on a device with one row per event, which slices copy to NumPy arrays (:class:`EventValues`)."""

    def __init__(self, values: wp.array) -> None:
        self._values = values

    def __getitem__(self, which: slice, /) -> NDArray[Any]:
        start, stop, _ = which.indices(len(self._values))
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
