"""Arrays of any library as Warp arrays, through DLPack: without a copy if the type allows, else with a checked copy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import (
    COARSE_TIMES,
    FRACTION_OF_US,
    TIME_UNITS,
    as_coordinate,
    as_polarity,
    as_times,
    largest_exact_time,
)
from amiwarp.kernels import event_arrays as kernels
from amiwarp.validation import on_gpu, one_of

HOST: dict[str, Callable[[str, Any, str], Any]] = {
    "x": lambda name, values, _: as_coordinate(name, values),
    "y": lambda name, values, _: as_coordinate(name, values),
    "t": lambda _, values, unit: as_times(values, unit=unit),
    "p": lambda _, values, __: as_polarity(values),
}
"""Conversion of each column of events in host memory, from its name, its values and the unit of times."""


def event_column(name: str, values: Any, device: Any, t_unit: str) -> Any:
    """Return the column ``x``, ``y``, ``t`` or ``p`` of events as a contiguous Warp array of the type that it needs.

    ``device``: where to put it; None for where the values are. ``t_unit``: unit of times, in ``TIME_UNITS``.
    """
    if on_gpu(values):
        found = converted(name, import_array(values, f"events' {name}"), t_unit)
    else:
        host = np.require(HOST[name](name, values, t_unit), requirements=["C", "A"])
        found = wp.array(host, dtype=wp.dtype_from_numpy(host.dtype), device="cpu", copy=False)
    return found if device is None else found.to(device)


def import_array(values: Any, what: str) -> Any:
    """Return a contiguous Warp array of the values; truth values become uint8.

    The array that owns the memory is kept alive. Work on it that its library has not finished yet is awaited by Warp's
    current stream, as DLPack says. Raises :class:`AmiwarpError` if the values cannot be read so.
    """
    try:
        found = values if isinstance(values, wp.array) else wp.from_dlpack(values)
    except Exception as error:  # every library has its own
        raise AmiwarpError(f"{what} cannot be read through DLPack: {error}") from error
    found = found if found.is_contiguous or not found.size else found.contiguous()
    found = found.view(wp.uint8) if found.dtype is wp.bool else found
    if not wp.types.type_is_scalar(found.dtype):
        raise AmiwarpError(f"{what} has values of type {wp.types.type_repr(found.dtype)}; expected numbers")
    return found


def converted(name: str, values: Any, t_unit: str = "us") -> Any:
    """Return a column in the type that events need, as a checked copy if it has another type."""
    integers = wp.types.type_is_int(values.dtype)
    if name == "t":
        return _times(values, TIME_UNITS[one_of(t_unit, TIME_UNITS, "t_unit")], integers)
    if name == "p":
        if values.dtype is wp.uint8:
            return values  # the caller checks that it is 0 or 1
        return _checked(kernels.mark_positive, values, wp.float64, wp.uint8, "p holds NaN; expected 1 for ON, else 0")
    if values.dtype in (wp.uint16, wp.float32):
        return values
    if integers:
        what = f"{name} holds a coordinate outside 0 .. 65535 px"
        return _checked(kernels.narrow_integers, values, wp.int64, wp.uint16, what)
    what = f"{name} holds a coordinate that float32 cannot hold; drop that event"
    return _checked(kernels.narrow_floats, values, wp.float64, wp.float32, what)


def positive(values: Any) -> Any:
    """Return polarities as uint8: 1 if positive, else 0."""
    return _checked(kernels.mark_positive, values, wp.float64, wp.uint8, "p holds NaN")


def _times(values: Any, scale: float, integers: bool) -> Any:
    """Return times as int64 [us], checked as by :func:`amiwarp.events.checks.as_times`."""
    if scale == 1.0 and integers:
        if values.dtype is wp.uint64:
            return _checked(kernels.narrow_times, values, wp.uint64, wp.int64, "t is beyond 2**62 us of 0")
        return cast(values, wp.int64)
    dtype = np.dtype(wp.dtype_to_numpy(values.dtype))
    what = {
        3: "t is not finite or beyond 2**62 us of 0",
        2: f"t holds fractions: {FRACTION_OF_US}",
        1: f"t reaches beyond {largest_exact_time(dtype):g} us, and {dtype} {COARSE_TIMES}",
    }
    inputs = [scale, largest_exact_time(dtype)]
    return _checked(kernels.round_times, values, wp.float64, wp.int64, what, inputs)


def cast(values: Any, dtype: Any) -> Any:
    """Return the values in another type, without a copy if they have it."""
    if values.dtype is dtype:
        return values
    out = wp.empty(values.shape, dtype=dtype, device=values.device)
    if values.size:
        wp.utils.array_cast(values, out)
    return out


def _checked(
    kernel: Any, values: Any, wide: Any, dtype: Any, what: str | dict[int, str], inputs: Sequence[float] = ()
) -> Any:
    """Return a converted copy. Raises :class:`AmiwarpError` if the kernel finds a bad value.

    ``what``: what is wrong, by the kernel's number of the fault if it finds several. ``inputs``: more inputs of the
    kernel.
    """
    if values.ndim != 1:  # the caller names the shapes
        return wp.empty(values.shape, dtype=dtype, device=values.device)
    out, bad = wp.empty(values.shape, dtype=dtype, device=values.device), wp.zeros(1, dtype=int, device=values.device)
    wp.launch(kernel, len(values), inputs=[cast(values, wide), *inputs], outputs=[out, bad], device=values.device)
    fault = int(bad.numpy()[0])
    if fault:
        raise AmiwarpError(f"events' {what if isinstance(what, str) else what[fault]}")
    return out
