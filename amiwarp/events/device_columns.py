"""Arrays of any library as columns of events in Warp arrays, through DLPack.

They are not copied if they have the type that events need; else they are copied and checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp import validation
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import as_coordinate, as_polarity, wrong_polarity
from amiwarp.kernels import events as kernels
from amiwarp.kernels.event_times import find_beyond
from amiwarp.validation import as_times, on_gpu, one_of, packed


def event_column(name: str, values: Any, device: Any, t_unit: str) -> Any:
    """Return the column ``x``, ``y``, ``t`` or ``p`` of events as a contiguous Warp array of the type that it needs.

    ``device``: where to put it; None for where the values are. ``t_unit``: unit of times, in ``TIME_UNITS``.
    """
    if on_gpu(values):
        column = converted(name, import_array(values, f"events' {name}"), t_unit)
    else:
        host = packed(_on_host(name, values, t_unit))
        column = wp.array(host, dtype=wp.dtype_from_numpy(host.dtype), device="cpu", copy=False)
    if device is None:
        return column
    return column.to(device)


def _on_host(name: str, values: Any, t_unit: str) -> NDArray[Any]:
    """Return a column of values in memory of the host in the type that events need."""
    if name == "t":
        return as_times(values, unit=t_unit)
    if name == "p":
        return as_polarity(values)
    return as_coordinate(name, values)


def import_array(values: Any, what: str) -> Any:
    """Return a contiguous Warp array of the values; truth values become uint8.

    The array that owns the memory is kept alive. Work on it that its library has not finished yet is awaited by Warp's
    current stream, as DLPack says. Raises :class:`AmiwarpError` if the values cannot be read so.
    """
    try:
        array = values if isinstance(values, wp.array) else wp.from_dlpack(values)
    except Exception as error:  # every library has its own
        raise AmiwarpError(f"{what} cannot be read through DLPack: {error}") from error
    if array.size and not array.is_contiguous:
        array = array.contiguous()
    if array.dtype is wp.bool:
        array = array.view(wp.uint8)
    if not wp.types.type_is_scalar(array.dtype):
        raise AmiwarpError(
            f"{what} has values of type {wp.types.type_repr(array.dtype)}; expected numbers"
        )
    return array


def converted(name: str, values: Any, t_unit: str = "us") -> Any:
    """Return a column in the type that events need, as a checked copy if it has another type."""
    integers = wp.types.type_is_int(values.dtype)
    if name == "t":
        units = validation.TIME_UNITS
        return _times(values, units[one_of(t_unit, units, "t_unit")], integers)
    if name == "p":
        if values.dtype is wp.uint8:
            return values  # the caller checks that it is 0 or 1
        return polarities(values)
    if values.dtype in (wp.uint16, wp.float32):
        return values
    if integers:
        what = f"{name} holds a coordinate outside 0 .. 65535 px"
        return _checked(kernels.narrow_integers, values, wp.int64, wp.uint16, what)
    what = f"{name} holds a coordinate that float32 cannot hold; drop that event"
    return _checked(kernels.narrow_floats, values, wp.float64, wp.float32, what)


def polarities(values: Any) -> Any:
    """Return polarities as uint8, checked as by :func:`amiwarp.events.recording.as_polarity`."""
    out = wp.empty(values.shape, dtype=wp.uint8, device=values.device)
    if values.ndim != 1 or not values.size:  # the caller names the shapes
        return out
    # The index of the first -1, 0 and other value; the number of values if there is none.
    count = len(values)
    first = wp.full(3, count, dtype=int, device=values.device)
    inputs = [cast(values, wp.float64)]
    outputs = [out, first]
    kernel = kernels.narrow_polarities
    wp.launch(kernel, count, inputs=inputs, outputs=outputs, device=values.device)
    minus, zero, other = first.numpy().tolist()
    mixed = minus < count and zero < count
    if other < count or mixed:  # the check on the host names the value
        raise wrong_polarity(values.numpy())
    return out


def _times(values: Any, scale: float, integers: bool) -> Any:
    """Return times as int64 [us], checked as by :func:`amiwarp.events.recording.as_times`."""
    if scale == 1.0 and integers:
        if values.dtype is wp.uint64:
            what = "t is beyond 2**62 us of 0"
            return _checked(kernels.narrow_times, values, wp.uint64, wp.int64, what)
        return cast(values, wp.int64)
    dtype = np.dtype(wp.dtype_to_numpy(values.dtype))
    largest = validation.largest_exact_time(dtype)
    faults = {
        3: "t is not finite or beyond 2**62 us of 0",
        2: f"t holds fractions: {validation.FRACTION_OF_US}",
        1: f"t reaches beyond {largest:g} us, and {dtype} {validation.COARSE_TIMES}",
    }
    inputs = [scale, largest]
    return _checked(kernels.round_times, values, wp.float64, wp.int64, faults, inputs)


def cast(values: Any, dtype: Any) -> Any:
    """Return the values in another type, without a copy if they have it."""
    if values.dtype is dtype:
        return values
    out = wp.empty(values.shape, dtype=dtype, device=values.device)
    if values.size:
        wp.utils.array_cast(values, out)
    return out


def _checked(
    kernel: Any,
    values: Any,
    wide: Any,
    dtype: Any,
    what: str | dict[int, str],
    inputs: Sequence[float] = (),
) -> Any:
    """Return a converted copy. Raises :class:`AmiwarpError` if the kernel finds a bad value.

    ``what``: what is wrong, by the kernel's number of the fault if it finds several. ``inputs``: more inputs of the
    kernel.
    """
    device = values.device
    out = wp.empty(values.shape, dtype=dtype, device=device)
    if values.ndim != 1:  # the caller names the shapes
        return out
    bad = wp.zeros(1, dtype=int, device=device)
    given = [cast(values, wide), *inputs]
    wp.launch(kernel, len(values), inputs=given, outputs=[out, bad], device=device)
    fault = int(bad.numpy()[0])
    if fault:
        reason = what if isinstance(what, str) else what[fault]
        raise AmiwarpError(f"events' {reason}")
    return out


THREADS = 1 << 15
"""Number of CUDA threads that look for the limits of events, or for a bad value."""


def first_beyond(values: Any, most: float) -> int:
    """Return the index of the first value of a flat float32 array that is NaN or not within ``most`` of 0.

    The result is the number of values if there is none.
    """
    count = values.size
    if not count:
        return 0
    first = wp.full(1, count, dtype=int, device=values.device)
    threads = min(count, THREADS) if values.device.is_cuda else 1
    inputs = [values, most, threads]
    wp.launch(find_beyond, threads, inputs=inputs, outputs=[first], device=values.device)
    return int(first.numpy()[0])
