"""Times of a counter that wraps around."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.input_files import open_input


def nearest(value: int, bits: int, estimate: int) -> int:
    """Return the value of a counter of ``bits`` bits with the number of wraps that brings it nearest to an estimate."""
    return value + ((estimate - value + (1 << bits >> 1)) >> bits << bits)


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


def last_word(path: Path, offset: int, dtype: str, estimate: int) -> int | None:
    """Return the 32-bit time of the last record of 8 bytes in a file, unwrapped next to an estimate, or None.

    ``offset`` is the position of the first record. The time is the first word of ``dtype`` "<u4", the second of ">u4".
    """
    count = (path.stat().st_size - offset) // 8
    if not count:
        return None
    with open_input(path) as file:
        file.seek(offset + 8 * (count - 1))
        words = np.frombuffer(file.read(8), dtype)
    return nearest(int(words[0 if dtype == "<u4" else 1]), 32, estimate)
