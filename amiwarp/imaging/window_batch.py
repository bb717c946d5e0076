"""Events and windows of a representation's arguments, checked, on the device, and compensated if there is a model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import (
    NAMES,
    DeviceEvents,
    check_sensor,
    device_for,
    find_indices,
    first_and_last_time,
    host_numbers,
    idle_numbers,
    limits,
    wait,
)
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.recording import Events, check_coordinates
from amiwarp.imaging.windows import Windows, check_window_order, collate, on_device
from amiwarp.kernels import tensors as kernels
from amiwarp.kernels.compensation import LaunchPlan
from amiwarp.kernels.encoder_pieces import encoder_params
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.optics.models.base import Model
from amiwarp.validation import packed, whole

LONGEST = (1 << 63) - 1
"""Largest length of a window that an integer holds [us]."""
MOST_EVENTS = (1 << 31) - 1
"""Largest number of events, and of pixels in all images of a window, that kernels can address."""


@dataclass(frozen=True, slots=True)
class WindowBatch:
    """Events on a device and their windows, as the kernels take them."""

    events: Events | DeviceEvents
    columns: tuple[Any, ...]
    """Arrays of the events, without gaps: of NumPy on a CPU, else of Warp."""
    device: Any
    windows: Windows
    single: bool
    """Whether the result has no axis of windows."""
    on_host: bool
    """Whether the result is a NumPy array."""
    size: tuple[int, int]
    """Width and height of the images [px]."""
    faults: wp.array
    """Faults of the events by number, 1 if they occur. Memory of the host, which the device writes to."""

    def device_columns(self) -> list[wp.array]:
        """Return the arrays of the events as Warp arrays."""
        if not self.device.is_cpu:
            return list(self.columns)
        return [wp.array(values, device=self.device, copy=False) for values in self.columns]

    def empty(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Return an array for the result, shape (windows, *shape)."""
        every_shape = self._every_shape(shape)
        if not self.device.is_cpu or not len(self.windows):
            return wp.empty(every_shape, dtype=dtype, device=self.device)
        # NumPy asks for large pages of memory, which are there in less time.
        values = np.empty(every_shape, wp.dtype_to_numpy(dtype))
        return wp.array(values, dtype=dtype, device=self.device, copy=False)

    def zeros(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """Return zeros for the result on a CPU, shape (windows, *shape)."""
        return np.zeros(self._every_shape(shape), dtype)

    def _every_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of a result, of which each window has a part of the given shape."""
        if math.prod(shape) > MOST_EVENTS:
            raise AmiwarpError(
                f"a tensor has shape {shape}, more than {MOST_EVENTS} elements; give fewer bins"
            )
        return (len(self.windows), *shape)

    def finish(self, out: wp.array | NDArray[Any]) -> Any:
        """Return the result of a public function: a Warp array, unless the events came in NumPy arrays.

        Raises :class:`AmiwarpError` if times decrease in a window, or an event of a sensor lies outside the image.
        """
        wait(self.device)
        found_faults = self.faults.numpy()
        if found_faults[kernels.DESCENDING] or found_faults[kernels.OUTSIDE]:
            events = self.events
            on_host = events if isinstance(events, Events) else events.to_host()
            _check_windows(on_host, self.windows, self.size)
        idle_numbers[self.device.is_cpu, wp.int32].append(self.faults)
        result = out
        if self.on_host:
            result = out if isinstance(out, np.ndarray) else out.numpy()
        elif isinstance(out, np.ndarray):
            result = wp.array(out, device=self.device, copy=False)
        return result[0] if self.single else result


def window_rows(cut: Windows, device: Any) -> tuple[wp.array, int]:
    """Return windows as the array that kernels take, on a device, and the number of their blocks."""
    rows, blocks = table_of_windows(cut)
    return wp.array(rows, dtype=wp.int64, device=device, copy=not device.is_cpu), blocks


def table_of_windows(cut: Windows) -> tuple[NDArray[np.int64], int]:
    """Return windows as the array that kernels take, and the number of their blocks."""
    if len(cut) == 1:  # in less time
        start, stop = cut.start.item(), cut.stop.item()
        t_start, t_end = cut.t_start.item(), cut.t_end.item()
        length = min(max(t_end - t_start, 1), LONGEST)
        row = (start, stop, 0, t_start, length, t_end)
        return np.array([row], np.int64), -(-(stop - start) // int(kernels.BLOCK))
    blocks = -(-(cut.stop - cut.start) // int(kernels.BLOCK))  # rounded up
    ends = np.cumsum(blocks)
    rows = np.empty((len(cut), 6), np.int64)
    rows[:, 0] = cut.start
    rows[:, 1] = cut.stop
    rows[0, 2] = 0
    rows[1:, 2] = ends[:-1]
    rows[:, 3] = cut.t_start
    lengths = cut.t_end - cut.t_start
    rows[:, 4] = np.where(
        (lengths < 0) & (cut.t_end > cut.t_start), LONGEST, np.maximum(lengths, 1)
    )
    rows[:, 5] = cut.t_end
    return rows, int(ends[-1])


def _check_windows(events: Events, cut: Windows, size: tuple[int, int]) -> None:
    """Raise :class:`AmiwarpError` for the first event that is earlier than the one before, or outside the sensor."""
    for start, stop in zip(cut.start.tolist(), cut.stop.tolist(), strict=True):
        if stop > start:
            check_window_order(events[start:stop], start)
            check_coordinates(
                events[start:stop], *size, where="events", first_index=start, allow_nan=True
            )


def batch_of(
    events: Any,
    size: tuple[int, int],
    cut: Windows | None,
    t_start: int | None,
    t_end: int | None,
    model: Model | None,
    encoder: Encoder | None,
    device: Any,
) -> WindowBatch:
    """Return the events and windows of a public function's arguments, compensated if there is a model."""
    if (model is None) != (encoder is None):
        raise AmiwarpError(
            "only one of model and encoder is given; give both a model and an encoder, or neither"
        )
    several = isinstance(events, list | tuple)
    single = cut is None and not several
    on_host = isinstance(events[0] if several and events else events, Events)
    if several:
        if cut is not None:
            raise AmiwarpError(
                "events are a batch of recordings and windows are given; join them by amiwarp.collate"
            )
        events, cut = collate(events, device=device)
    if cut is not None and not (t_start is None and t_end is None):
        raise AmiwarpError(
            "t_start or t_end is given for several windows; the windows have times of their own"
        )
    count = len(events)
    target = device_for(events, device)
    if count > MOST_EVENTS:
        raise AmiwarpError(f"there are {count} events; give at most {MOST_EVENTS} at a time")
    if cut is None:
        cut = _window(events, t_start, t_end)
    if len(cut) and int(cut.stop.max()) > count:
        raise AmiwarpError(
            f"windows reach to event {int(cut.stop.max())} of {count}; "
            "give the events that were cut"
        )
    width = whole(size[0], "width", 1, LARGEST_SIZE, " pixels")
    height = whole(size[1], "height", 1, LARGEST_SIZE, " pixels")
    if model is not None and encoder is not None:
        on_target = on_device(events, target)
        events = _compensated(on_target, (width, height), cut, model, encoder)
    columns = _columns(events, target)
    faults = host_numbers(2, wp.int32, target)
    return WindowBatch(events, columns, target, cut, single, on_host, (width, height), faults)


def _columns(events: Events | DeviceEvents, target: Any) -> tuple[Any, ...]:
    """Return the arrays of events without gaps: of NumPy on a CPU, else of Warp on the device."""
    if isinstance(events, Events) and target.is_cpu:
        return tuple(packed(getattr(events, name)) for name in NAMES)
    events = on_device(events, target)
    columns = (getattr(events, name) for name in NAMES)
    return tuple(values.numpy() if target.is_cpu else values for values in columns)


def _window(events: Events | DeviceEvents, t_start: int | None, t_end: int | None) -> Windows:
    """Return one window, from ``t_start`` to ``t_end``, both included [us]; None for the first or the last event."""
    limits: list[Any] = events._limits if isinstance(events, DeviceEvents) else []
    first = 0
    last = 0
    if limits and not limits[5]:  # known, and the times ascend
        first, last = limits[:2]
    elif len(events):
        first, last = first_and_last_time(events)
    low = first if t_start is None else t_start
    high = last if t_end is None else t_end
    if high < low:
        if t_start is not None and t_end is not None:
            raise AmiwarpError(
                f"t_end is {t_end} us, before t_start, {t_start} us; give t_start <= t_end"
            )
        if t_start is not None:
            high = low
        elif t_end is not None:
            low = high
        else:  # not in order, which the kernels find
            low, high = high, low

    start = 0
    stop = len(events)
    if len(events) and (t_start is not None or t_end is not None):
        start, stop = find_indices(events, np.array([low, high + 1])).tolist()
    return Windows(*(np.array([value], np.int64) for value in (start, stop, low, high)))


def _compensated(
    events: DeviceEvents, size: tuple[int, int], cut: Windows, model: Model, encoder: Encoder
) -> DeviceEvents:
    """Return events at their positions without the optic. ``size``: of the images, which the recorded events fit."""
    check_sensor(events)
    check_prisms(encoder, model.ANGLES)
    if not len(events):
        return events
    if events.device.is_cpu:
        t = events.t.numpy()
        t_first = int(t.min())
        t_last = int(t.max())
        right = int(events.x.numpy().max())
        bottom = int(events.y.numpy().max())
    else:
        t_first, t_last, right, bottom, _, _ = limits(events)
    width, height = size
    if right >= width or bottom >= height:
        _check_windows(events.to_host(), cut, size)
    plan = LaunchPlan(model, events.device)
    params = encoder_params(encoder, t_first, t_last, str(events.device))
    columns = plan.run(plan.device_columns(events), params, right, bottom)
    count = len(events)
    return DeviceEvents(columns.out_x[:count], columns.out_y[:count], events.t, events.p)
