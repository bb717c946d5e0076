"""The smallest of many values."""

import math
from typing import Any

import warp as wp

from amiwarp.kernels.launch import launch

SPAN = wp.constant(256)
"""Number of values of a thread."""


@wp.kernel
def find_lowest(values: wp.array(dtype=float), start: int, lowest: wp.array(dtype=float)):
    """Find the smallest of :data:`SPAN` values, in each thread."""
    span = start + wp.tid()
    first = span * SPAN
    found = values[first]
    for i in range(first + 1, wp.min(first + SPAN, values.shape[0])):
        found = wp.min(found, values[i])
    lowest[span] = found


def lowest_value(values: Any) -> float:
    """Return the smallest value of a contiguous array of float32 on a device, of one value or more."""
    flat = values.flatten()
    spans = math.ceil(flat.size / int(SPAN))
    lowest: Any = wp.empty(spans, dtype=float, device=values.device)
    launch(find_lowest, spans, [flat], [lowest], device=values.device)
    return float(lowest.numpy().min())
