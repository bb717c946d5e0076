"""Timestamps of a counter that wraps around."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def unwrapped(values: NDArray[np.int64], bits: int, before: int | None = None) -> NDArray[np.int64]:
    """Return the values of a counter of ``bits`` bits, from 0 on, without its wraps.

    ``before`` is the unwrapped value that they continue. A step of more than half the range is a wrap of the counter,
    forwards or backwards. A smaller step backwards is a value out of order.
    """
    if not values.size:
        return values
    size = 1 << bits
    start = int(values[0]) if before is None else before
    step = np.diff(values, prepend=start % size)
    wraps = np.cumsum((step < -(size // 2)).astype(np.int64) - (step > size // 2))
    return values + (start // size + wraps) * size
