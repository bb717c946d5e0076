"""Pieces of a file, and times of a counter that wraps around."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.inputs import open_input

Integers = NDArray[np.int64]

RECORD_BYTES = 8
"""Size of a record of two 32-bit words."""


def read_pieces(path: Path, offset: int, size: int, notes: dict[str, int]) -> Iterator[bytes]:
    """Yield pieces of ``size`` bytes of a file from ``offset`` on, and note how much of it was read."""
    notes["total"] = path.stat().st_size
    with open_input(path) as file:
        file.seek(offset)
        while data := file.read(size):
            notes["read"] = file.tell()
            yield data


def read_words(
    path: Path,
    offset: int,
    dtype: str,
    count: int,
    notes: dict[str, int],
) -> Iterator[NDArray[Any]]:
    """Yield ``count`` records of two 32-bit words at a time, shape ``(n, 2)``. A record that is cut off is noted."""
    for data in read_pieces(path, offset, RECORD_BYTES * count, notes):
        records, rest = divmod(len(data), RECORD_BYTES)
        if rest:
            notes["truncated_bytes"] = rest
        words = np.frombuffer(data, dtype, records * 2)
        yield words.reshape(-1, 2)


def nearest(value: int, bits: int, estimate: int) -> int:
    """Return the value of a counter of ``bits`` bits with the number of wraps that brings it nearest to an estimate."""
    size = 1 << bits
    wraps = (estimate - value + size // 2) // size
    return value + wraps * size


def unwrapped(values: Integers, bits: int, before: int | None = None) -> Integers:
    """Return the values of a counter of ``bits`` bits, from 0 on, without its wraps.

    ``before`` is the unwrapped value that they continue. A step of more than half the range is a wrap of the counter,
    forwards or backwards. A smaller step backwards is a value out of order.
    """
    if not values.size:
        return values
    size = 1 << bits
    start = int(values[0]) if before is None else before
    step = np.diff(values, prepend=start % size)
    forwards = (step < -(size // 2)).astype(np.int64)
    backwards = step > size // 2
    wraps = start // size + np.cumsum(forwards - backwards)
    return values + wraps * size


def last_word(path: Path, offset: int, dtype: str, estimate: int) -> int | None:
    """Return the 32-bit time of the last record of 8 bytes in a file, unwrapped next to an estimate, or None.

    ``offset`` is the position of the first record. The time is the first word of ``dtype`` "<u4", the second of ">u4".
    """
    records = (path.stat().st_size - offset) // RECORD_BYTES
    if not records:
        return None
    with open_input(path) as file:
        file.seek(offset + RECORD_BYTES * (records - 1))
        first, second = np.frombuffer(file.read(RECORD_BYTES), dtype).tolist()
    time = first if dtype == "<u4" else second
    return nearest(time, 32, estimate)
