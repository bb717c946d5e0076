"""Corners among events: eFAST and Arc*."""

from __future__ import annotations

from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.choices import CornerMethod
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import (
    DeviceEvents,
    check_inside,
    check_sensor,
    device_for,
    limits,
    wait,
)
from amiwarp.events.recording import Events, check_events
from amiwarp.kernels import corners as kernels
from amiwarp.kernels.event_arrays import EventArrays
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.tasks import cpu_threads
from amiwarp.validation import TIME_LIMIT, choice, vector, whole

REDUNDANT_US = 50_000
"""Time after which an event of Arc* is no longer redundant [us], from the paper."""
MOST_PIXELS = 1 << 29
"""Largest number of pixels of a sensor: the surfaces of both polarities are indexed by int32, with room for bands."""
PIECE = 1 << 24
"""Largest number of events that are sorted at a time on a GPU."""
LEAST_SHARED = 1 << 13
"""Smallest number of events for which several CPU threads are worth their start."""
WIDEST_BAND = 5
NARROWEST_BAND = 3
"""Largest and smallest size of a band of rows for several CPU threads, as a power of 2."""


@overload
def detect_corners(
    events: Events, size: tuple[int, int], *, detector: CornerMethod = ..., device: Any = ...
) -> NDArray[np.bool_]: ...
@overload
def detect_corners(
    events: DeviceEvents, size: tuple[int, int], *, detector: CornerMethod = ..., device: Any = ...
) -> wp.array: ...
@guarded
def detect_corners(
    events: Events | DeviceEvents,
    size: tuple[int, int],
    *,
    detector: CornerMethod = CornerMethod.ARC,
    device: Any = None,
) -> NDArray[np.bool_] | wp.array:
    """Find the events that are corners, by eFAST or Arc*.

    For streams and long recordings use :class:`CornerDetector`, which keeps its state between packets.

    Parameters
    ----------
    events : Events or DeviceEvents
        Events from a sensor, sorted by time.
    size : tuple of int
        Sensor size (width, height) [px].
    detector : CornerMethod, optional
        The method.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device are tested there, without a copy.

    Returns
    -------
    ndarray or warp.array
        Whether each event is a corner, bool, shape ``(n,)``. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If the events are compensated, out of order or outside the sensor, or on another device than ``device``.

    Notes
    -----
    eFAST: Mueggler et al., "Fast event-based corner detection", BMVC 2017. Arc*: Alzugaray and Chli, "Asynchronous
    corner detection and tracking for event cameras in real time", IEEE RA-L 2018. An event is tested against all
    earlier events of its polarity. Events closer than 4 px to the border are no corners. The result does not depend on
    the device or the number of threads.

    Examples
    --------
    >>> x, y = [13, 13, 13, 13, 14, 14, 14, 10], [9, 10, 11, 12, 9, 10, 11, 10]  # the last is left of a short bar
    >>> events = amiwarp.Events.from_arrays(x, y, range(8), [1] * 8)
    >>> amiwarp.detect_corners(events, (32, 32), detector="efast")
    array([False, False, False, False, False, False, False,  True])
    """
    return CornerDetector(size, detector=detector, device=device_for(events, device)).detect(events)


@guarded
class CornerDetector:
    """Finds corners among the events of a stream, packet by packet.

    The result is the same as for all packets at once.

    Parameters
    ----------
    size : tuple of int
        Sensor size (width, height) [px].
    detector : CornerMethod, optional
        The method.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU.

    Raises
    ------
    AmiwarpError
        If the size or the method is not usable.

    Examples
    --------
    >>> detector = amiwarp.CornerDetector((64, 48))
    >>> for t in (0, 1000):
    ...     packet = amiwarp.Events.from_arrays([10, 11], [20, 20], [t, t + 10], [1, 1])
    ...     print(detector.detect(packet))
    [False False]
    [False False]
    """

    def __init__(
        self,
        size: tuple[int, int],
        *,
        detector: CornerMethod = CornerMethod.ARC,
        device: Any = None,
    ) -> None:
        self._width, self._height = (
            int(side) for side in vector(size, 2, "size of the sensor", sensor_side)
        )
        if self._width * self._height > MOST_PIXELS:
            raise AmiwarpError(
                f"a sensor of {self._width}x{self._height} has more than {MOST_PIXELS} pixels; crop it"
            )
        self._method = choice(CornerMethod, detector, "detector")
        self._device = wp.get_device("cpu" if device is None else device)
        given = (self._width, self._height, self._method, self._device)
        self._pass: PassInOrder | PassInLists
        if self._device.is_cpu:
            self._pass = PassInOrder(*given)
        else:
            self._pass = PassInLists(*given)
        self._last_us: int | None = None

    @overload
    def detect(self, events: Events) -> NDArray[np.bool_]: ...
    @overload
    def detect(self, events: DeviceEvents) -> wp.array: ...
    def detect(self, events: Events | DeviceEvents) -> NDArray[np.bool_] | wp.array:
        """Find the corners among the next events of the stream.

        Parameters
        ----------
        events : Events or DeviceEvents
            Events from a sensor, sorted by time, none earlier than those before.

        Returns
        -------
        ndarray or warp.array
            Whether each event is a corner, bool, shape ``(n,)``. A Warp array on the same device for
            :class:`DeviceEvents`.

        Raises
        ------
        AmiwarpError
            If the events are compensated, out of order, outside the sensor or on another device. The detector then is
            as before.
        """
        device_for(events, self._device)
        check_sensor(events)
        corner = wp.empty(len(events), dtype=wp.bool, device=self._device)
        if len(events):
            moved = self._checked(events)
            for start in range(0, len(events), PIECE):
                stop = min(start + PIECE, len(events))
                self._pass.detect(moved[start:stop], corner[start:stop])
            wait(self._device)
        return corner if isinstance(events, DeviceEvents) else corner.numpy()

    def _checked(self, events: Events | DeviceEvents) -> DeviceEvents:
        """Check events, note the time of the last, and return them on the device."""
        if isinstance(events, DeviceEvents):
            self._check_limits(events)
            self._last_us = events.t_last
            return events
        check_events(events, self._width, self._height, where="events", after_t=self._last_us)
        self._last_us = int(events.t[-1])
        copy = not self._device.is_cpu
        columns = [
            wp.array(np.ascontiguousarray(column), device=self._device, copy=copy)
            for column in (events.x, events.y, events.t, events.p)
        ]
        return DeviceEvents(*columns)

    def _check_limits(self, events: DeviceEvents) -> None:
        """Check events on the device."""
        check_inside(events, self._width, self._height)
        first, last, _, _, polarity, decreases = limits(events)
        if decreases:
            raise AmiwarpError("events are not in the order of their times; sort by time")
        if self._last_us is not None and first < self._last_us:
            raise AmiwarpError(
                f"events start at {first} us, earlier than the event before ({self._last_us} us); sort by time"
            )
        if not -TIME_LIMIT < first <= last < TIME_LIMIT or polarity > 1:
            raise AmiwarpError(
                f"events have times in {first} .. {last} us and polarities up to {polarity}; use from_arrays"
            )


class PassInOrder:
    """Tests events in their order on CPU threads, each of which takes some bands of rows."""

    def __init__(self, width: int, height: int, method: CornerMethod, device: Any) -> None:
        self._threads = cpu_threads()
        bits = WIDEST_BAND
        while bits > NARROWEST_BAND and height >> bits < 4 * self._threads:
            bits -= 1
        if self._threads == 1:  # one band
            bits = height.bit_length()
        bands = ((height - 1) >> bits) + 1
        shared_rows = 2 * int(kernels.REACH) * bands
        self._surface = _surface(width, height, height + shared_rows, method, device)
        self._surface.band_bits = bits
        self._rule = _rule(method)
        thread_of_band = np.arange(bands) % self._threads
        self._owner = wp.array(thread_of_band, dtype=int, device=device)

    def detect(self, events: DeviceEvents, corner: wp.array) -> None:
        """Write to ``corner`` whether each event is one, and update the surfaces."""
        threads = self._threads
        launch(
            kernels.detect_in_order,
            threads,
            [_columns(events), self._surface, self._rule, self._owner],
            [corner],
            device=events.device,
            smallest=1 if len(events) >= LEAST_SHARED else threads,
        )


class PassInLists:
    """Tests all events of a block at once. Events are sorted into lists, one for each polarity and pixel."""

    def __init__(self, width: int, height: int, method: CornerMethod, device: Any) -> None:
        self._device = device
        self._filters = method is CornerMethod.ARC
        self._surface = _surface(width, height, height, method, device)
        self._rule = _rule(method)
        self._lists = 2 * width * height

    def detect(self, events: DeviceEvents, corner: wp.array) -> None:
        """Write to ``corner`` whether each event is one, and update the surfaces."""
        columns = _columns(events)
        every = self._sorted(events)
        lists = every
        if self._filters:
            lists = self._without_redundant(columns, every, len(events))
        corner.zero_()
        inputs = [columns, self._surface, lists, self._rule]
        self._run(kernels.detect_in_lists, len(events), inputs, [corner])
        self._run(kernels.store_lists, self._lists, [columns, lists], [self._surface])
        if self._filters:
            pixels = self._lists // 2
            self._run(kernels.store_last, pixels, [columns, every], [self._surface])

    def _sorted(self, events: DeviceEvents) -> Any:
        """Return the lists of all events."""
        n = len(events)
        keys = self._empty(2 * n)
        order = self._empty(2 * n)
        inputs = [_columns(events), self._surface]
        self._run(kernels.key_events, n, inputs, [keys, order])
        wp.utils.radix_sort_pairs(keys, order, n)
        edges = self._lists + 1
        lists = kernels.Lists()
        lists.order = order
        lists.first = self._empty(edges)
        self._run(kernels.find_lists, edges, [keys, n], [lists.first])
        return lists

    def _without_redundant(self, columns: Any, lists: Any, n: int) -> Any:
        """Return the lists without redundant events."""
        fresh = wp.zeros(n + 1, dtype=int, device=self._device)
        place = self._empty(n + 1)
        inputs = [columns, self._surface, lists, self._rule]
        self._run(kernels.mark_fresh, n, inputs, [fresh])
        wp.utils.array_scan(fresh, place, inclusive=False)
        edges = self._lists + 1
        kept = kernels.Lists()
        kept.order = self._empty(n)
        kept.first = self._empty(edges)
        self._run(kernels.keep_fresh, n, [lists, fresh, place], [kept.order])
        self._run(kernels.move_lists, edges, [lists, place], [kept.first])
        return kept

    def _empty(self, n: int) -> wp.array:
        return wp.empty(n, dtype=int, device=self._device)

    def _run(
        self,
        kernel: Any,
        n: int,
        inputs: list[Any],
        outputs: list[Any],
    ) -> None:
        launch(kernel, n, inputs, outputs, device=self._device)


def sensor_side(value: object, what: str) -> int:
    """Return the width or the height of a sensor [px]."""
    return whole(value, what, 1, LARGEST_SIZE, " pixels")


def _surface(
    width: int,
    height: int,
    rows: int,
    method: CornerMethod,
    device: Any,
) -> Any:
    """Return empty surfaces of ``rows`` rows, which include those that bands share."""
    pixels = width * rows
    filtered = pixels if method is CornerMethod.ARC else 0
    never = wp.int64(kernels.NEVER)
    no_polarity = int(kernels.NO_POLARITY)
    surface = kernels.Surface()
    surface.width = width
    surface.height = height
    surface.pixels = pixels
    surface.time = wp.full(2 * pixels, never, dtype=wp.int64, device=device)
    surface.last = wp.zeros(filtered, dtype=wp.int64, device=device)
    surface.polarity = wp.full(filtered, no_polarity, dtype=wp.uint8, device=device)
    return surface


def _rule(method: CornerMethod) -> Any:
    """Return the rule of a method."""
    rule = kernels.Rule()
    rule.complement = int(method is CornerMethod.ARC)
    rule.redundant_us = REDUNDANT_US if method is CornerMethod.ARC else 0
    return rule


def _columns(events: DeviceEvents) -> Any:
    """Return the columns of events as the struct that the kernels take."""
    columns = EventArrays()
    columns.x = events.x
    columns.y = events.y
    columns.t = events.t
    columns.p = events.p
    return columns
