"""Events in Warp arrays on a CPU or a GPU, shared with other array libraries through DLPack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.events import checks
from amiwarp.events.checks import TIME_LIMIT
from amiwarp.events.device_arrays import event_column, positive
from amiwarp.events.events import Events
from amiwarp.kernels import event_arrays as kernels
from amiwarp.validation import guarded, instance

THREADS = 1 << 15
"""Number of CUDA threads that look for the limits of events."""
NAMES = ("x", "y", "t", "p")
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
        arrays = {name: instance(getattr(self, name), wp.array, f"events' {name}") for name in NAMES}
        shapes = {name: array.shape for name, array in arrays.items()}
        if any(shape != (self.t.size,) for shape in shapes.values()):
            raise AmiwarpError(f"event arrays have shapes {shapes}; expected one length (n,)")
        devices = {name: str(array.device) for name, array in arrays.items()}
        if len(set(devices.values())) > 1:
            raise AmiwarpError(f"event arrays are on devices {devices}; put them on one device")
        types = {name: array.dtype.__name__ for name, array in arrays.items()}
        if (types["t"], types["p"]) != ("int64", "uint8") or (types["x"], types["y"]) not in COORDINATES:
            wanted = "x and y both uint16 (whole pixels) or both float32, t int64, p uint8"
            raise AmiwarpError(f"event arrays have types {types}; expected {wanted}")
        if any(array.size and not array.is_contiguous for array in arrays.values()):
            raise AmiwarpError("event arrays have gaps between their values; DeviceEvents.from_arrays copies them")

    @classmethod
    def from_arrays(
        cls, x: Any, y: Any, t: Any, p: Any, *, t_unit: Literal["us", "s"] = "us", device: Any = None
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
            Polarities, shape (n,): ON if above 0 or true, else OFF.
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
        given = {"x": x, "y": y, "t": t, "p": p}
        events = cls(*(event_column(name, values, device, t_unit) for name, values in given.items()))
        if not len(events):
            return events
        first, last, right, bottom, polarity, _ = limits(events)
        if not -TIME_LIMIT < first <= last < TIME_LIMIT:
            raise AmiwarpError(f"times span {first} .. {last} us; expected microseconds within {TIME_LIMIT} us of 0")
        if max(right, bottom) >= int(kernels.BEYOND):
            raise AmiwarpError("events' x or y holds an infinite coordinate; drop that event")
        check_order(events)
        return cls(events.x, events.y, events.t, positive(events.p)) if polarity > 1 else events

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
            All events.
        """
        if not blocks:
            raise AmiwarpError("there are no blocks of events to join; give at least one")
        if len(blocks) == 1:
            return blocks[0]
        events = cls(*(join([getattr(block, name) for block in blocks]) for name in NAMES))
        wait(events.device)
        return events

    @property
    def device(self) -> Any:
        """The device that holds the arrays, a ``warp.Device``."""
        return self.t.device

    @property
    def whole_pixels(self) -> bool:
        """Whether the coordinates are those of a sensor, not compensated."""
        return self.x.dtype is wp.uint16

    @property
    def t_first(self) -> int:
        """Time of the earliest event [us]. Raises :class:`AmiwarpError` if there are no events."""
        return limits(self)[0]

    @property
    def t_last(self) -> int:
        """Time of the latest event [us]. Raises :class:`AmiwarpError` if there are no events."""
        return limits(self)[1]

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
        start, stop, step = instance(which, slice, "index of events on a device").indices(len(self))
        if step != 1:
            raise AmiwarpError(f"events are sliced in steps of {step}; on a device, slice without steps")
        return DeviceEvents(*(part(getattr(self, name), start, stop) for name in NAMES))


def part(values: wp.array, start: int, stop: int) -> wp.array:
    """Return the values with ``0 <= start <= index < stop``: a view, unless it is empty, which Warp does not allow."""
    return values[start:stop] if start < stop else wp.empty(0, dtype=values.dtype, device=values.device)


def join(arrays: Sequence[wp.array]) -> wp.array:
    """Return one array of the values of several arrays on one device, of which there is at least one."""
    if len(arrays) == 1:
        return arrays[0]
    out = wp.empty(sum(map(len, arrays)), dtype=arrays[0].dtype, device=arrays[0].device)
    at = 0
    for values in filter(len, arrays):
        wp.copy(out, values, dest_offset=at)
        at += len(values)
    return out


def limits(events: DeviceEvents) -> list[int]:
    """Return first and last time [us], largest x and y [px], largest p, and 1 if times decrease anywhere.

    Largest x and y are 0 for compensated events. Found once. Raises :class:`AmiwarpError` if there are no events.
    """
    if not len(events):
        raise AmiwarpError("there are no events, so there is no first or last time; check len() first")
    if not events._limits:
        found = wp.array(np.array([2**63 - 1, -(2**63), 0, 0, 0, 0]), dtype=wp.int64, device=events.device)
        threads = min(len(events), THREADS) if events.device.is_cuda else 1
        inputs = [events.x, events.y, events.t, events.p, threads]
        wp.launch(kernels.find_limits, threads, inputs=inputs, outputs=[found], device=events.device)
        events._limits.extend(found.numpy().tolist())
    return events._limits


def check_order(events: Events | DeviceEvents) -> None:
    """Raise :class:`AmiwarpError` if an event is earlier than the one before."""
    if isinstance(events, Events):
        checks.check_order(events, where="events")
    elif len(events) and limits(events)[5]:
        checks.check_order(events.to_host(), where="events")  # it names the event


def time_span(events: Events | DeviceEvents) -> tuple[int, int]:
    """Return the times of the first and the last of sorted events, of which there is at least one [us]."""
    if isinstance(events, DeviceEvents):
        return events.t_first, events.t_last
    return int(events.t[0]), int(events.t[-1])


def device_for(events: Events | DeviceEvents, device: Any) -> Any:
    """Return the device to compute on: that of events on a device, else ``device``, "cpu" if it is None.

    Raises :class:`AmiwarpError` if events are on another device than ``device``.
    """
    if not isinstance(events, DeviceEvents):
        instance(events, Events, "events")
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
        wp.synchronize_stream(device)
