"""A source of events that are held on a device."""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from typing import Any

from amiwarp.events.checks import check_events
from amiwarp.events.device_events import DeviceEvents, limits
from amiwarp.events.events import DEFAULT_BLOCK, Events, EventSource, regroup
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import instance, whole


class DeviceMemoryEvents:
    """Source of events that are held on a device, for recordings.

    Every function that takes a recording takes one with this source. :func:`reconstruct` reads the events on the
    device. All others read copies in NumPy arrays.

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
        """Time of the first event [us]."""
        return self._events.t_first

    @property
    def t_last(self) -> int:
        """Time of the last event [us]."""
        return self._events.t_last

    @property
    def size(self) -> tuple[int, int]:
        """Sensor size (width, height) [px]."""
        return self._size

    @property
    def device(self) -> Any:
        """The device that holds the events, a ``warp.Device``."""
        return self._events.device

    def slice(self, start: int, stop: int) -> Events:
        """Return the events with ``start <= index < stop`` in NumPy arrays.

        Parameters
        ----------
        start, stop : int
            First index, and index after the last. Both are clipped to the existing events.

        Returns
        -------
        Events
            The events.
        """
        return self._events[max(start, 0) : max(stop, 0)].to_host()

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
        times = self._events.t
        return bisect.bisect_left(range(len(self)), t, key=lambda index: int(times[index : index + 1].numpy()[0]))

    def between(self, t_start: int, t_end: int) -> Events:
        """Return the events with ``t_start <= t < t_end`` in NumPy arrays.

        Parameters
        ----------
        t_start, t_end : int
            Start and end of the window [us].

        Returns
        -------
        Events
            The events.
        """
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
        """Return all events in order, in NumPy arrays, in blocks of equal count or equal duration.

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
        chunks = (self.slice(start, start + DEFAULT_BLOCK) for start in range(0, len(self), DEFAULT_BLOCK))
        return regroup(chunks, count=count, duration_us=duration_us)


def read_between(source: EventSource, t_start: int, t_end: int) -> Events | DeviceEvents:
    """Return the events of a time window [us] where they are: on the device, or in NumPy arrays."""
    if isinstance(source, DeviceMemoryEvents):
        return source.between_on_device(t_start, t_end)
    return source.between(t_start, t_end)
