"""Chunks of native recordings, which parallel threads encode, decode, read and write. HDF5 itself uses one thread.

A stored chunk is a Blosc frame (version 1, as written by HDF5's filter 32001) or deflated bytes, followed by its
Fletcher-32 checksum. HDF5 itself reads the deflated chunks of :attr:`Codec.GZIP`.
"""

from __future__ import annotations

import contextlib
import io
import os
import threading
import zlib
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.cpu_threads import cpu_threads
from amiwarp.errors import AmiwarpError
from amiwarp.io.atomic_output import interrupts_later
from amiwarp.io.formats import Codec

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


def make_dataset(
    file: Any,
    name: str,
    dtype: Any,
    row: tuple[int, ...] = (),
    chunk_rows: int = CHUNK,
    codec: Codec = Codec.BLOSC,
) -> Any:
    """Create an empty dataset of the native layout, whose rows have the shape ``row``."""
    import hdf5plugin

    blosc = {"compression": hdf5plugin.Blosc(cname="lz4", clevel=1, shuffle=blosc_shuffle(np.dtype(dtype)))}
    gzip = {"compression": "gzip", "compression_opts": GZIP_LEVEL, "shuffle": True}
    # The checksum covers the compressed bytes. Its cost is too small to measure. LZ4 alone misses most damage.
    return file.create_dataset(
        name,
        shape=(0, *row),
        maxshape=(None, *row),
        chunks=(chunk_rows, *row),
        dtype=dtype,
        fletcher32=True,
        **(blosc if codec is Codec.BLOSC else gzip),
    )


def append_chunk(dataset: Any, start: int, stored: bytes, count: int) -> None:
    """Append an encoded chunk of ``count`` elements to a dataset of ``start`` elements, a whole number of chunks."""
    row = dataset.shape[1:]
    dataset.id.set_extent((start + count, *row))
    dataset.id.write_direct_chunk((start, *(0 for _ in row)), stored)


def append_values(dataset: Any, start: int, values: NDArray[Any], codec: Codec) -> None:
    """Append the values of a chunk, as :func:`append_chunk`."""
    append_chunk(dataset, start, encode(values, codec), len(values))


# A new HDF5 file whose encoded chunks several threads write at the same time.
#
# HDF5 uses one thread at a time, and h5py holds Python's lock while HDF5 writes. Here HDF5 only finds the place of a
# chunk in the file; the thread that encoded the chunk writes it there.
#
# HDF5 crashes the process, at the latest when the process ends, if it cannot write a file that it closes. So HDF5 never
# learns of a full disk: :class:`ChunkFile` notes the error and raises it outside HDF5.


class EncodedChunk(NamedTuple):
    """Chunk of a column."""

    name: str
    """Name of the column."""
    start: int
    """Index of its first element."""
    values: NDArray[Any]
    """Its values."""
    parts: Sequence[bytes]
    """Its encoded bytes, in one or several parts."""

    @classmethod
    def of(cls, name: str, start: int, column: NDArray[Any], parts: Iterable[Sequence[bytes]]) -> list[EncodedChunk]:
        """Return the chunks of a column from element ``start`` on, whose encoded bytes are ``parts``."""
        return [cls(name, start + k * CHUNK, column[k * CHUNK : (k + 1) * CHUNK], part) for k, part in enumerate(parts)]


class ChunkFile:
    """HDF5 file that is being written. Threads write chunks of its datasets at places that they get in turn.

    Data that HDF5 could not write wait in memory. Call :meth:`check` regularly, so that they stay few.
    """

    def __init__(self, path: Path, libver: tuple[str, str] | None = ("v110", "v110")) -> None:
        """Create the file. ``libver`` are h5py's bounds of the format. Raises OSError if the file exists."""
        import h5py

        self._columns: dict[str, ChunkedColumn] = {}
        self._turns = threading.Condition()
        self._turn = 0
        self._stopped = False
        with contextlib.ExitStack() as undo:
            with interrupts_later():
                self.output = _Output(path)
                undo.callback(self.output.close)
                # From HDF5 1.10 on, the file's structure has checksums, so that damage is detected.
                self.hdf5 = h5py.File(self.output, "w", libver=libver)
                """The file as h5py gives it."""
                undo.callback(self.hdf5.close)
            undo.pop_all()

    @contextlib.contextmanager
    def turn(self, number: int) -> Iterator[None]:
        """Wait until all lower numbers, from 0 on, had their turn, and keep out other turns.

        Chunks get their places in turn, so the bytes of a file do not depend on the speed of the threads. Raises
        :class:`AmiwarpError` if another thread failed.
        """
        with self._turns:
            self._turns.wait_for(lambda: self._turn == number or self._stopped)
            if self._stopped:
                raise AmiwarpError("another thread could not write its part")
            yield
            self._turn += 1
            self._turns.notify_all()

    @contextlib.contextmanager
    def stopping(self) -> Iterator[None]:
        """If the work of a thread in the ``with`` block fails, end the waiting of the others."""
        try:
            yield
        except BaseException:
            with self._turns:
                self._stopped = True
                self._turns.notify_all()
            raise

    def write(
        self, turn: int, chunks: Sequence[EncodedChunk], dataset_of: Callable[[EncodedChunk], Any],
        before: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        """Write encoded chunks at places that they get in turn.

        ``dataset_of`` makes the dataset of a column's first chunk. ``before`` is called first in turn.
        """
        rows = {chunk.name: chunk.start + len(chunk.values) for chunk in chunks}
        placed = []
        with self.turn(turn):
            before()
            for chunk in chunks:
                if chunk.name not in self._columns:
                    self._columns[chunk.name] = ChunkedColumn(self, dataset_of(chunk))
                column = self._columns[chunk.name]
                placed.append((column.place(chunk.start, chunk.parts, rows[chunk.name]), chunk.parts))
        for at, parts in placed:
            if at is not None:
                self.output.write_at(parts, at)
        self.check()

    def check(self) -> None:
        """Raise the error of the first write of HDF5 that failed, such as OSError for a full disk."""
        if self.output.failure is not None:
            raise self.output.failure

    def close(self) -> None:
        """Close the file, after all threads have written their chunks. Raises an error as :meth:`check` does."""
        try:
            self.hdf5.close()
        finally:
            self.output.close()
        self.check()


class ChunkedColumn:
    """Dataset of a :class:`ChunkFile`, whose chunks are written in any order."""

    def __init__(self, file: ChunkFile, dataset: Any) -> None:
        self._output, self._id = file.output, dataset.id
        self._rows, *self._row = dataset.shape

    def place(self, start: int, stored: Sequence[bytes], rows: int) -> int | None:
        """Return the place in the file [bytes] of an encoded chunk from element ``start`` on.

        ``stored`` are the bytes of the chunk, in one or several parts. A dataset of fewer than ``rows`` elements grows
        to this number. If the place cannot be found, the chunk is written at once and None is returned. Call this
        method in turn.
        """
        size, offset = sum(map(len, stored)), (start, *(0 for _ in self._row))
        if self._rows < rows:
            self._rows = rows
            self._id.set_extent((self._rows, *self._row))
        at = self._output.place_of(size, partial(self._id.write_direct_chunk, offset))
        if at is None:
            self._id.write_direct_chunk(offset, b"".join(stored))
        return at


class _Output(io.RawIOBase):
    """File that HDF5 writes through, which can find the place of data instead of writing them.

    HDF5's writes never fail. If one cannot be done, its data and those of all later ones stay in memory.
    """

    def __init__(self, path: Path) -> None:
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        self._position = 0
        self._token = os.urandom(16)
        self._stand_in = memoryview(self._token)
        self._sought: int | None = None
        self._found: int | None = None
        self.failure: BaseException | None = None
        """Error of the first write that failed."""
        self._unwritten: list[tuple[int, bytes]] = []
        """Data that could not be written, with their places [bytes]."""

    def place_of(self, size: int, write: Callable[[Any], Any]) -> int | None:
        """Return the place [bytes] at which ``write(data)`` writes ``size`` bytes in one piece, without writing them.

        The data are a random token and zeros. Returns None if HDF5 writes them in another way. Anything else that it
        writes meanwhile is written.
        """
        if len(self._stand_in) < size:
            self._stand_in = memoryview(self._token + bytes(size))
        self._sought, self._found = size, None
        try:
            write(self._stand_in[:size])
        finally:
            self._sought = None
        return self._found

    def write_at(self, parts: Iterable[Any], place: int) -> None:
        """Write data in several parts, one after the other, at a place [bytes]. Any thread may call it."""
        rest = [memoryview(part) for part in parts]
        while rest:
            done = os.pwritev(self._handle, rest, place)
            place += done
            while rest and done >= len(rest[0]):
                done -= len(rest.pop(0))
            if done:
                rest[0] = rest[0][done:]

    def write(self, data: Any) -> int:
        size = len(data)
        if size == self._sought and memoryview(data)[: len(self._token)] == self._token[:size]:
            self._found = self._position
        else:
            self._write_or_keep(data)
        self._position += size
        return size

    def _write_or_keep(self, data: Any) -> None:
        """Write data at the position, or keep them in memory if that or an earlier write failed."""
        if self.failure is None:
            try:
                self.write_at([data], self._position)
                return
            except BaseException as error:  # an interrupt too must not reach HDF5
                self.failure = error
        self._unwritten.append((self._position, bytes(data)))

    def readinto(self, buffer: Any) -> int:
        count = os.preadv(self._handle, [buffer], self._position)
        view = memoryview(buffer).cast("B")
        for at, data in self._unwritten:
            first, last = max(at - self._position, 0), min(at - self._position + len(data), len(view))
            if first < last:
                view[first:last] = data[first + self._position - at : last + self._position - at]
                count = max(count, last)
        return count

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            offset += max(os.fstat(self._handle).st_size, *(at + len(data) for at, data in self._unwritten), 0)
        self._position = offset
        return self._position

    def tell(self) -> int:
        return self._position

    def truncate(self, size: int | None = None) -> int:
        size = self._position if size is None else size
        try:
            os.ftruncate(self._handle, size)
        except OSError as error:
            self.failure = self.failure or error
        return size

    def close(self) -> None:
        if not self.closed:
            os.close(self._handle)
        super().close()
