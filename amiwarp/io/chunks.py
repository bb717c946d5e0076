"""Chunks of the native layout, coded here in place of inside HDF5: there one thread at a time works, here all do.

A stored chunk is a Blosc frame (version 1, as HDF5's filter 32001 keeps it) followed by HDF5's Fletcher-32 of it.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.kernels.cores import cpu_threads

Result = TypeVar("Result")

CHUNK = 1 << 18
"""Events per HDF5 chunk. With Blosc's LZ4 and bit shuffle it writes and reads faster than no compression does."""

BLOSC, FLETCHER32 = 32001, 3
"""Numbers of the filters in HDF5."""

BLOSC_HEAD = 16
"""Bytes of a Blosc frame's header."""

MOST_THREADS = 16
"""More would wait for each other in Python, and each holds events in memory."""

AHEAD = 4
"""Jobs beyond one a thread that may be done or under way: what was done out of turn waits in memory."""

ROW = 256
"""Words of a checksum that are summed at a time."""


def in_order(jobs: Iterable[Callable[[], Result]]) -> Generator[Result, None, None]:
    """Run jobs on all cores, a bounded number ahead; their results come in the order of the jobs.

    A job's exception is raised in its place. When the iterator is closed, jobs that wait are dropped and those that run
    are waited for.
    """
    threads = min(cpu_threads(), MOST_THREADS)
    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(threads, thread_name_prefix="amiwarp-io")
    try:
        for job in jobs:
            waiting.append(pool.submit(job))
            if len(waiting) > threads + AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@cache
def _blosc() -> Any:
    from numcodecs.blosc import Blosc

    return Blosc(cname="lz4", clevel=1, shuffle=Blosc.BITSHUFFLE)


def encode(values: NDArray[Any]) -> bytes:
    """A chunk's stored bytes; a shorter array is filled up with zeros, as HDF5 does."""
    whole = values if values.size == CHUNK else np.concatenate([values, np.zeros(CHUNK - values.size, values.dtype)])
    frame = _blosc().encode(np.ascontiguousarray(whole))
    return b"".join((frame, checksum(frame).to_bytes(4, "little")))


def decode(stored: bytes, out: NDArray[Any]) -> bool:
    """Whether the stored bytes are sound; ``out``, a chunk long, then holds what they say."""
    if len(stored) < BLOSC_HEAD + 4:
        return False
    frame = memoryview(stored)[:-4]
    # Blosc's header: four bytes, then the bytes before and after compression; it would read and write as told.
    sizes = [int.from_bytes(frame[at : at + 4], "little") for at in (4, 12)]
    if sizes != [out.nbytes, len(frame)] or checksum(frame).to_bytes(4, "little") != stored[-4:]:
        return False
    try:
        _blosc().decode(frame, out=out)
    except RuntimeError:  # what Blosc raises for a frame that it cannot decode
        return False
    return True


def checksum(data: bytes | memoryview) -> int:
    """Fletcher-32 as HDF5 computes it: big-endian 16-bit words, modulo 65535; a last odd byte is a word's upper half.

    Words are summed as little-endian ones: modulo 65535, to swap a word's bytes is to multiply it by 256.
    """
    count = len(data) // 2
    words = np.frombuffer(data, np.dtype("<u2"), count)
    table = words[: count - count % ROW].reshape(-1, ROW).astype(np.uint32)
    # Word i counts once in the first sum and count - i times in the second.
    columns, rows = table.sum(axis=0, dtype=np.uint32), table.sum(axis=1, dtype=np.uint32)
    rest = words[count - count % ROW :].astype(np.int64)
    first = int(columns.sum(dtype=np.int64))
    second = count * first - _moment(columns) - ROW * _moment(rows) + int(rest @ np.arange(rest.size, 0, -1))
    first, second = 256 * (first + int(rest.sum())), 256 * second
    if len(data) % 2:
        first += data[-1] << 8
        second += first
    return _folded(second) << 16 | _folded(first)


def _moment(sums: NDArray[np.uint32]) -> int:
    return int(sums.astype(np.int64) @ np.arange(sums.size))


def _folded(total: int) -> int:
    """Modulo 65535, with 65535 in place of 0 for all but 0: so do sums whose carries are added back end."""
    return (total - 1) % 65535 + 1 if total else 0


class StoredColumn:
    """A dataset of the native layout whose chunks threads read past HDF5, each on its own."""

    def __init__(self, handle: int, dtype: np.dtype[Any], count: int, places: Sequence[Sequence[int]]) -> None:
        """``handle``: of the open file. ``places``: offset and size of each chunk [bytes]."""
        self._handle, self._dtype, self._count, self._places = handle, dtype, count, places
        self._last: tuple[int, NDArray[Any]] | None = None

    def read(self, start: int, stop: int) -> NDArray[Any] | None:
        """Elements ``start <= index < stop``, at least one; None where a chunk is damaged."""
        first, last = start // CHUNK, (stop - 1) // CHUNK
        if first == last and (stop - start < CHUNK and stop != self._count):
            chunk = self._chunk(first)
            return None if chunk is None else chunk[start - first * CHUNK : stop - first * CHUNK].copy()
        out = np.empty((last + 1 - first) * CHUNK, self._dtype)
        for at in range(first, last + 1):
            if not self._decode(at, out[(at - first) * CHUNK : (at + 1 - first) * CHUNK]):
                return None
        return out[start - first * CHUNK : stop - first * CHUNK]

    def _chunk(self, at: int) -> NDArray[Any] | None:
        """A whole chunk; the last one is kept, because a search reads many times within one."""
        if self._last is not None and self._last[0] == at:
            return self._last[1]
        out = np.empty(CHUNK, self._dtype)
        if not self._decode(at, out):
            return None
        self._last = at, out
        return out

    def _decode(self, at: int, out: NDArray[Any]) -> bool:
        offset, size = self._places[at]
        return decode(os.pread(self._handle, size, offset), out)


def append_chunk(dataset: Any, start: int, stored: bytes, count: int) -> None:
    """Add a chunk of ``count`` elements, encoded, to a dataset of ``start``, a whole number of chunks."""
    dataset.id.set_extent((start + count,))
    dataset.id.write_direct_chunk((start,), stored)
