"""Encoder and decoder of the chunks of native recordings, in parallel threads. HDF5 itself uses one thread at a time.

A stored chunk is a Blosc frame (version 1, as written by HDF5's filter 32001) or deflated bytes, followed by its
Fletcher-32 checksum. HDF5 itself reads the deflated chunks of :attr:`Codec.GZIP`.
"""

from __future__ import annotations

import enum
import os
import zlib
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.cpu_threads import cpu_threads

Result = TypeVar("Result")

CHUNK = 1 << 18
"""Number of events per HDF5 chunk. With Blosc's LZ4 and shuffle, chunks are written and read faster than without
compression."""

BLOSC, FLETCHER32 = 32001, 3
"""Numbers of the Blosc and of the Fletcher-32 filter in HDF5."""

BLOSC_HEADER_BYTES = 16
"""Size of the header of a Blosc frame [bytes]."""

MAX_THREADS = 12
"""Largest number of threads that encode or decode chunks. More hinder each other, because they take turns to hold
Python's lock."""

EXTRA_JOBS = 2
"""Number of encoding or decoding jobs in flight in addition to one per thread. Their results wait in memory for their
turn."""

CHECKSUM_ROW = 2048
"""Number of 16-bit words that the checksum sums at a time."""

BLOCK_BYTES = 1 << 18
"""Size of the blocks that Blosc compresses [bytes]. It decodes these faster than its smaller default."""

GZIP_LEVEL = 1
"""Level of deflate: 1 is the fastest. Higher levels make event files only a few percent smaller."""

_kernel: Callable[[Sequence[bytes | memoryview]], list[int]] | None = None
"""Function that computes checksums with a kernel, after :func:`compile_checksums`."""


class Codec(enum.StrEnum):
    """Compression of native recordings.

    Examples
    --------
    >>> amiwarp.Codec("gzip")
    <Codec.GZIP: 'gzip'>
    """

    BLOSC = "blosc"
    """Blosc (LZ4, shuffle of bits; of bytes for times): fastest. Other programs need HDF5's Blosc filter to read it."""
    GZIP = "gzip"
    """Deflate with byte shuffle, which every HDF5 library reads."""


def in_order(jobs: Iterable[Callable[[], Result]]) -> Generator[Result, None, None]:
    """Run jobs in parallel threads, and yield their results in the order of the jobs.

    A bounded number of jobs is in flight. The exception of a job is raised when its result is due. When the generator
    is closed, waiting jobs are dropped and running jobs are completed.
    """
    threads = min(cpu_threads(), MAX_THREADS)
    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(threads, thread_name_prefix="amiwarp-io")
    try:
        for job in jobs:
            waiting.append(pool.submit(job))
            if len(waiting) > threads + EXTRA_JOBS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@cache
def _blosc() -> Any:
    """Return Blosc's functions, set up for calls in several threads. Its own threads would only add to them.

    The module's functions of the same names also check their arguments, which takes 15 us.
    """
    import blosc

    blosc.set_nthreads(1)
    blosc.set_releasegil(True)
    blosc.set_blocksize(BLOCK_BYTES)
    return blosc.blosc_extension


def blosc_shuffle(dtype: np.dtype[Any]) -> int:
    """Return how Blosc shuffles values: 2 by bits, or 1 by bytes.

    Of times of 8 bytes, bits take twice as long as bytes, and the size changes by -16 to +9 %.
    """
    return 1 if dtype.itemsize == 8 else 2


def encode(values: NDArray[Any], codec: Codec = Codec.BLOSC) -> bytes:
    """Return the stored bytes of a chunk of at least one element. A shorter one is padded with zeros, as by HDF5."""
    return b"".join(encode_parts(values, codec)[0])


def encode_parts(column: NDArray[Any], codec: Codec = Codec.BLOSC) -> list[tuple[bytes, bytes]]:
    """Return the stored bytes of each chunk of a column in two parts, which together are those of :func:`encode`."""
    frames = []
    for at in range(0, len(column), CHUNK):
        values = column[at : at + CHUNK]
        if len(values) < CHUNK:
            values = np.concatenate([values, np.zeros((CHUNK - len(values), *values.shape[1:]), values.dtype)])
        values = np.ascontiguousarray(values)
        frames.append(_compress(values) if codec is Codec.BLOSC else _deflate(values))
    return [(frame, value.to_bytes(4, "little")) for frame, value in zip(frames, checksums(frames), strict=True)]


def _compress(values: NDArray[Any]) -> bytes:
    """Compress the bytes of values as HDF5's Blosc filter does."""
    shuffle, place = blosc_shuffle(values.dtype), values.ctypes.data
    compressed: bytes = _blosc().compress_ptr(place, values.nbytes, values.itemsize, 1, shuffle, "lz4")
    return compressed


def _deflate(values: NDArray[Any]) -> bytes:
    """Compress the bytes of values as HDF5's filters shuffle and deflate do."""
    shuffled = values.view(np.uint8).reshape(-1, values.itemsize).T
    return zlib.compress(shuffled.tobytes(), GZIP_LEVEL)


def decode(stored: Sequence[bytes], out: NDArray[Any]) -> bool:
    """Decode stored chunks, one after the other, into ``out``. Return whether all chunks are undamaged."""
    places = [out[at : at + CHUNK] for at in range(0, len(out), CHUNK)]
    if any(len(chunk) < BLOSC_HEADER_BYTES + 4 for chunk in stored):
        return False
    frames = [memoryview(chunk)[:-4] for chunk in stored]
    if [int.from_bytes(chunk[-4:], "little") for chunk in stored] != checksums(frames):
        return False
    return all(_decompress(frame, place) for frame, place in zip(frames, places, strict=True))


def _decompress(frame: memoryview, out: NDArray[Any]) -> bool:
    """Decompress a Blosc frame into ``out``. Return whether it has the right size and can be decoded."""
    # After four bytes, the header holds the sizes before and after compression. Blosc itself would trust them.
    if [int.from_bytes(frame[at : at + 4], "little") for at in (4, 12)] != [out.nbytes, len(frame)]:
        return False
    try:
        return int(_blosc().decompress_ptr(frame, out.ctypes.data)) == out.nbytes
    except _blosc().error:  # a frame that it cannot decode
        return False


def compile_checksums() -> None:
    """Compute all later checksums with one of Warp's kernels, in less time and without Python's lock.

    For programs that run Warp's kernels. Others do not load Warp for it. Call it before threads use Warp.
    """
    global _kernel
    if _kernel is None:
        from amiwarp.kernels.checksum import Checksums

        _kernel = Checksums()


def checksums(parts: Sequence[bytes | memoryview]) -> list[int]:
    """Return the checksum of each block of bytes."""
    return [checksum(part) for part in parts] if _kernel is None else _kernel(parts)


def checksum(data: bytes | memoryview) -> int:
    """Return the Fletcher-32 checksum as HDF5 computes it.

    HDF5 sums big-endian 16-bit words modulo 65535. A last odd byte is the upper half of a word. Here the words are
    summed as little-endian: modulo 65535, swapping the bytes of a word multiplies it by 256.
    """
    count = len(data) // 2
    words = np.frombuffer(data, np.dtype("<u2"), count)
    table = words[: count - count % CHECKSUM_ROW].reshape(-1, CHECKSUM_ROW)
    # Word i is counted once in the first sum, and count - i times in the second.
    columns, rows = table.sum(axis=0, dtype=np.uint32), table.sum(axis=1, dtype=np.uint32)
    rest = words[count - count % CHECKSUM_ROW :].astype(np.int64)
    first = int(columns.sum(dtype=np.int64))
    second = count * first - _moment(columns) - CHECKSUM_ROW * _moment(rows) + int(rest @ np.arange(rest.size, 0, -1))
    first, second = 256 * (first + int(rest.sum())), 256 * second
    if len(data) % 2:
        first += data[-1] << 8
        second += first
    return _fold_carries(second) << 16 | _fold_carries(first)


def _moment(sums: NDArray[np.uint32]) -> int:
    """Return the sum of each value times its index."""
    return int(sums.astype(np.int64) @ np.arange(sums.size))


def _fold_carries(total: int) -> int:
    """Return a sum modulo 65535 as end-around carries give it: 65535 for every multiple of 65535 except 0."""
    return (total - 1) % 65535 + 1 if total else 0


class StoredColumn:
    """Dataset of the native layout whose chunks threads read in parallel, without HDF5."""

    def __init__(
        self,
        handle: int,
        dtype: np.dtype[Any],
        count: int,
        places: Sequence[Sequence[int]],
        row: tuple[int, ...] = (),
    ) -> None:
        """Take the handle of the open file, and ``places``: the offset and size of each chunk [bytes].

        ``row`` is the shape of an element: empty for numbers.
        """
        self._handle, self._dtype, self._count, self._places, self._row = handle, dtype, count, places, row
        self._last: tuple[int, NDArray[Any]] | None = None

    def read(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return the elements with ``start <= index < stop``, at least one, or None if a chunk is damaged."""
        first, last = start // CHUNK, (stop - 1) // CHUNK
        if first == last and (stop - start < CHUNK and stop != self._count):
            chunk = self._chunk(first)
            return None if chunk is None else chunk[start - first * CHUNK : stop - first * CHUNK].copy()
        out = self._decoded(first, last)
        return None if out is None else out[start - first * CHUNK : stop - first * CHUNK]

    def _chunk(self, at: int) -> NDArray[Any] | None:
        """Return a whole chunk, or None if it is damaged. The latest chunk is kept, for searches within it."""
        last = self._last  # another thread may replace it
        if last is None or last[0] != at:
            out = self._decoded(at, at)
            if out is None:
                return None
            last = self._last = at, out
        return last[1]

    def encoded(self, at: int) -> bytes:
        """Return the stored bytes of chunk ``at``."""
        offset, size = self._places[at]
        return os.pread(self._handle, size, offset)

    def _decoded(self, first: int, last: int) -> NDArray[Any] | None:
        """Return the chunks from ``first`` to ``last``, or None if one of them is damaged."""
        out = np.empty(((last + 1 - first) * CHUNK, *self._row), self._dtype)
        return out if decode([self.encoded(at) for at in range(first, last + 1)], out) else None


def append_chunk(dataset: Any, start: int, stored: bytes, count: int) -> None:
    """Append an encoded chunk of ``count`` elements to a dataset of ``start`` elements, a whole number of chunks."""
    row = dataset.shape[1:]
    dataset.id.set_extent((start + count, *row))
    dataset.id.write_direct_chunk((start, *(0 for _ in row)), stored)
