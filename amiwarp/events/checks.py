"""Conversion and checks of event arrays: types, time limits, frame and order."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import array as as_numbers
from amiwarp.validation import one_of

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents
    from amiwarp.events.events import Events

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


def check_sensor(events: Events | DeviceEvents) -> None:
    """Raise :class:`AmiwarpError` for compensated events; events from a sensor have uint16 coordinates."""
    if not events.whole_pixels:
        raise AmiwarpError("event coordinates are float32, already compensated; give events from a sensor (uint16)")


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
