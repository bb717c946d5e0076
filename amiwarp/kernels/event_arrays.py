"""Arrays of decoded events, which all decoders write."""

from typing import Any

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class EventArrays:
    """Decoded events."""

    x: wp.array(dtype=wp.uint16)
    """Columns [px]."""
    y: wp.array(dtype=wp.uint16)
    """Rows [px]."""
    t: wp.array(dtype=wp.int64)
    """Times [us]."""
    p: wp.array(dtype=wp.uint8)
    """Polarities: 1 is ON."""


def new_event_arrays(count: int, device: Any) -> Any:
    """Return :class:`EventArrays` for a number of events, without values, on a device."""

    def empty(dtype: Any) -> Any:
        if not wp.get_device(device).is_cpu:
            return wp.empty(count, dtype=dtype, device=device)
        # NumPy asks for large pages, with which memory is there in half of the time.
        values = np.empty(count, wp.dtype_to_numpy(dtype))
        return wp.array(values, dtype=dtype, device=device, copy=False)

    arrays = EventArrays()
    arrays.x = empty(wp.uint16)
    arrays.y = empty(wp.uint16)
    arrays.t = empty(wp.int64)
    arrays.p = empty(wp.uint8)
    return arrays


@wp.func_native("""
    ((uint16_t*)events.x.data)[i] = column;
    ((uint16_t*)events.y.data)[i] = row;
    ((int64_t*)events.t.data)[i] = now;
    ((uint8_t*)events.p.data)[i] = polarity;
""")
def store_event(
    events: EventArrays,
    i: int,
    column: wp.uint16,
    row: wp.uint16,
    now: wp.int64,
    polarity: wp.uint8,
):
    """Store event ``i`` in contiguous arrays."""
