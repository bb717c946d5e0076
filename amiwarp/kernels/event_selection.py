"""Selection of events on the device."""

from typing import Any

import warp as wp

from amiwarp.kernels.camera_keys import CAMERA_LOW_BITS
from amiwarp.kernels.event_keys import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel(module="unique", module_options=OPTIONS)
def mark_first_of_pixel(keys: wp.array(dtype=wp.int64), start: int, kept: wp.array(dtype=int)):
    """Mark the first of the successive keys with the same camera, time and pixel with 1, the others with 0.

    The keys have a lag.
    """
    i = start + wp.tid()
    before = keys[wp.max(i - 1, 0)] >> CAMERA_LOW_BITS
    kept[i] = wp.where(i == 0 or before != keys[i] >> CAMERA_LOW_BITS, 1, 0)


@wp.kernel(module="unique", module_options=OPTIONS)
def mark_transmitted(stamp: wp.array(dtype=wp.int64), start: int, kept: wp.array(dtype=int)):
    """Mark the events that the bus transmits with 1, the lost ones with 0."""
    i = start + wp.tid()
    kept[i] = wp.where(stamp[i] >= wp.int64(0), 1, 0)


@wp.kernel(module="unique", module_options=OPTIONS)
def keep_marked(
    values: wp.array(dtype=Any), ends: wp.array(dtype=int), start: int, out: wp.array(dtype=Any)
):
    """Copy the values that are marked. ``ends``: number of marked values up to and including each one."""
    i = start + wp.tid()
    before = int(0)
    if i > 0:
        before = ends[i - 1]
    if ends[i] > before:
        out[before] = values[i]


@wp.kernel(module="unique", module_options=OPTIONS)
def count_before(ends: wp.array(dtype=int), start: int, index: wp.array(dtype=int)):
    """Replace indices of values by the number of marked values before them; see :func:`keep_marked`."""
    k = start + wp.tid()
    at = index[k]
    before = int(0)
    if at > 0:
        before = ends[at - 1]
    index[k] = before


for _dtype in (wp.uint8, wp.uint16, wp.int64):
    wp.overload(keep_marked, {"values": wp.array(dtype=_dtype), "out": wp.array(dtype=_dtype)})
