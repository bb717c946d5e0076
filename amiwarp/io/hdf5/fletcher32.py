"""Fletcher-32 checksums, as HDF5 stores them behind its chunks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

CHECKSUM_ROW = 2048
"""Number of 16-bit words that the checksum sums at a time."""


def checksum(data: bytes | memoryview) -> int:
    """Return the Fletcher-32 checksum as HDF5 computes it.

    HDF5 sums big-endian 16-bit words modulo 65535. A last odd byte is the upper half of a word. Here the words are
    summed as little-endian: modulo 65535, swapping the bytes of a word multiplies it by 256.
    """
    count = len(data) // 2
    words = np.frombuffer(data, np.dtype("<u2"), count)
    in_table = count - count % CHECKSUM_ROW
    table = words[:in_table].reshape(-1, CHECKSUM_ROW)
    rest = words[in_table:].astype(np.int64)

    # uint32 holds the sums of up to 65,537 rows of words: 256 MiB, the largest chunk that is read.
    # Word i is counted once in the first sum, and count - i times in the second.
    columns = table.sum(axis=0, dtype=np.uint32)
    rows = table.sum(axis=1, dtype=np.uint32)
    first = int(columns.sum(dtype=np.int64))
    second = count * first - _moment(columns) - CHECKSUM_ROW * _moment(rows)
    second += int(rest @ np.arange(rest.size, 0, -1))
    first += int(rest.sum())

    # The bytes of the words are swapped.
    first *= 256
    second *= 256
    if len(data) % 2:
        first += data[-1] << 8
        second += first
    return _fold_carries(second) << 16 | _fold_carries(first)


def _moment(sums: NDArray[np.uint32]) -> int:
    """Return the sum of each value times its index."""
    return int(sums.astype(np.int64) @ np.arange(sums.size))


def _fold_carries(total: int) -> int:
    """Return a sum modulo 65535 as end-around carries give it: 65535 for every multiple of 65535 except 0."""
    if not total:
        return 0
    return (total - 1) % 65535 + 1


def _checksums_by_numpy(parts: Sequence[bytes | memoryview]) -> list[int]:
    """Return the checksum of each block of bytes."""
    return [checksum(part) for part in parts]


_current: Callable[[Sequence[bytes | memoryview]], list[int]] = _checksums_by_numpy
"""Function that computes checksums: with a kernel after :func:`compile_checksums`."""


def checksums(parts: Sequence[bytes | memoryview]) -> list[int]:
    """Return the checksum of each block of bytes: by a kernel after :func:`compile_checksums`, else by NumPy."""
    return _current(parts)


def compile_checksums() -> None:
    """Compute all later checksums with one of Warp's kernels, in less time and without Python's lock.

    For programs that run Warp's kernels. Others do not load Warp for it. Call it before threads use Warp.
    """
    global _current
    if _current is _checksums_by_numpy:
        from amiwarp.kernels.checksum import Checksums

        _current = Checksums()
