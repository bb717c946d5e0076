"""Arrays of any library as Warp arrays, through DLPack: without a copy if the type allows, else with a checked copy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import as_coordinate, as_polarity, as_times
from amiwarp.kernels import event_arrays as kernels
from amiwarp.validation import on_gpu

HOST: dict[str, Callable[[str, Any], Any]] = {
    "x": as_coordinate,
    "y": as_coordinate,
    "t": lambda _, values: as_times(values),
    "p": lambda _, values: as_polarity(values),
}
"""Conversion of each column of events in host memory, from its name and its values."""


def event_column(name: str, values: Any, device: Any) -> Any:
    """Return the column ``x``, ``y``, ``t`` or ``p`` of events as a contiguous Warp array of the type that it needs.

    ``device``: where to put it; None for where the values are.
    """
    if on_gpu(values):
        found = converted(name, import_array(values, f"events' {name}"))
    else:
        host = np.ascontiguousarray(HOST[name](name, values))
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


def converted(name: str, values: Any) -> Any:
    """Return a column in the type that events need, as a checked copy if it has another type."""
    integers = wp.types.type_is_int(values.dtype)
    if name == "t":
        if integers:
            return cast(values, wp.int64)
        return _checked(kernels.round_times, values, wp.float64, wp.int64, "t is not finite or beyond 2**62 us of 0")
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


def cast(values: Any, dtype: Any) -> Any:
    """Return the values in another type, without a copy if they have it."""
    if values.dtype is dtype:
        return values
    out = wp.empty(values.shape, dtype=dtype, device=values.device)
    if values.size:
        wp.utils.array_cast(values, out)
    return out


def _checked(kernel: Any, values: Any, wide: Any, dtype: Any, what: str) -> Any:
    """Return a converted copy. Raises :class:`AmiwarpError` if the kernel finds a bad value."""
    if values.ndim != 1:  # the caller names the shapes
        return wp.empty(values.shape, dtype=dtype, device=values.device)
    out, bad = wp.empty(values.shape, dtype=dtype, device=values.device), wp.zeros(1, dtype=int, device=values.device)
    wp.launch(kernel, len(values), inputs=[cast(values, wide)], outputs=[out, bad], device=values.device)
    if bad.numpy()[0]:
        raise AmiwarpError(f"events' {what}")
    return out
