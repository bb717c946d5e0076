"""HDF5 files of any layout: their chunks, access to their datasets, and events in rows as of MVSEC and Prophesee."""

from __future__ import annotations

import contextlib
import io
import math
import os
import threading
import time
import weakref
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io import ecf
from amiwarp.io.file_scan import FileEvents, Packet, read_sensors
from amiwarp.io.files import input_path, read_at, write_at
from amiwarp.io.formats import Codec
from amiwarp.io.reading_process import Allowance, ReadingProcess, borrow, give_back, packets, run
from amiwarp.tasks import interrupts_later

# Chunks of amiwarp's files, which parallel threads encode, decode, read and write. HDF5 itself uses one thread.
#
# A stored chunk is a Blosc frame (version 1, as written by HDF5's filter 32001) or deflated bytes, followed by its
# Fletcher-32 checksum. HDF5 itself reads the deflated chunks of :attr:`Codec.GZIP`.

CHUNK = 1 << 18
"""Number of events per HDF5 chunk. With Blosc's LZ4 and shuffle, chunks are written and read faster than without
compression."""

BLOSC, FLETCHER32 = 32001, 3
"""Numbers of the Blosc and of the Fletcher-32 filter in HDF5."""

CHECKSUM_ROW = 2048
"""Number of 16-bit words that the checksum sums at a time."""

BLOCK_BYTES = 1 << 18
"""Size of the blocks that Blosc compresses [bytes]. It decodes these faster than its smaller default."""

GZIP_LEVEL = 1
"""Level of deflate: 1 is the fastest. Higher levels make event files only a few percent smaller."""

_kernel: Callable[[Sequence[bytes | memoryview]], list[int]] | None = None
"""Function that computes checksums with a kernel, after :func:`compile_checksums`."""


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
    frames = [memoryview(chunk)[:-4] for chunk in stored]
    if [int.from_bytes(chunk[-4:], "little") for chunk in stored] != checksums(frames):
        return False
    return all(_decompress(frame, place) for frame, place in zip(frames, places, strict=True))


def _decompress(frame: memoryview, out: NDArray[Any]) -> bool:
    """Decompress a Blosc frame into ``out``. Return whether it has the right size and can be decoded."""
    # After four bytes, the header of 16 bytes holds the sizes before and after compression. Blosc itself
    # would trust them. A frame that is shorter than its header disagrees with them.
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


_kept_memory = threading.local()


def _padded_chunk(dtype: np.dtype[Any], row: tuple[int, ...]) -> NDArray[Any]:
    """Return memory of this thread for a chunk, until the next call: new memory takes as long as decoding."""
    size = CHUNK * dtype.itemsize * math.prod(row)
    found: NDArray[np.uint8] = getattr(_kept_memory, "bytes", np.empty(0, np.uint8))
    if found.size < size:
        found = _kept_memory.bytes = np.empty(size, np.uint8)
    return found[:size].view(dtype).reshape(CHUNK, *row)


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
        kept = self._last
        if first == last and ((stop - start < CHUNK and stop != self._count) or (kept and kept[0] == first)):
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
        """Return the elements of the chunks from ``first`` to ``last``, or None if one of the chunks is damaged."""
        stored = [self.encoded(at) for at in range(first, last + 1)]
        out = np.empty((min((last + 1) * CHUNK, self._count) - first * CHUNK, *self._row), self._dtype)
        if rest := len(out) % CHUNK:  # of the padded last chunk
            chunk = _padded_chunk(self._dtype, self._row)
            if not decode([stored.pop()], chunk):
                return None
            out[-rest:] = chunk[:rest]
        return out if not stored or decode(stored, out[: len(out) - rest]) else None


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

        self._datasets: dict[str, Any] = {}
        self._turns = threading.Condition()
        self._turn = 0
        self._failed = math.inf  # the lowest turn whose work failed
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
        :class:`AmiwarpError` if the work of a lower turn failed.
        """
        with self._turns:
            self._turns.wait_for(lambda: self._turn == number or self._failed < number)
            if self._failed < number:
                raise AmiwarpError("an earlier part could not be written")
            yield
            self._turn += 1
            self._turns.notify_all()

    @contextlib.contextmanager
    def stopping(self, turn: int) -> Iterator[None]:
        """If the work for a turn in the ``with`` block fails, end the waiting of all later turns.

        Earlier ones go on, so that the first error in order is that of the work which failed.
        """
        try:
            yield
        except BaseException:
            with self._turns:
                self._failed = min(self._failed, turn)
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
                if chunk.name not in self._datasets:
                    self._datasets[chunk.name] = dataset_of(chunk)
                placed.append((self._place(chunk, rows[chunk.name]), chunk.parts))
        for at, parts in placed:
            if at is not None:
                self.output.write_at(parts, at)
        self.check()

    def _place(self, chunk: EncodedChunk, rows: int) -> int | None:
        """Return the place of a chunk in the file [bytes]. A dataset of fewer than ``rows`` elements grows to these.

        If the place cannot be found, the chunk is written at once and None is returned. Called in turn.
        """
        dataset = self._datasets[chunk.name]
        held, *row = dataset.shape
        if held < rows:
            dataset.id.set_extent((rows, *row))
        write = partial(dataset.id.write_direct_chunk, (chunk.start, *(0 for _ in row)))
        at = self.output.place_of(sum(map(len, chunk.parts)), write)
        if at is None:
            write(b"".join(chunk.parts))
        return at

    def check(self) -> None:
        """Raise the error of the first write of HDF5 that failed, such as OSError for a full disk."""
        if self.output.failure is not None:
            raise self.output.failure

    def close(self) -> None:
        """Close the file, after all threads have written their chunks. Raises an error as :meth:`check` does."""
        with contextlib.closing(self.output), self.hdf5:
            if self.hdf5:
                self.hdf5.visititems(_flush)
        self.check()


def _flush(name: str, item: Any) -> None:
    """Write what HDF5 holds of a dataset in its caches.

    HDF5 would do so when nothing refers to the dataset any more. In a thread that closes another file, h5py refers to
    all datasets, so their order in the file would depend on the speed of the threads.
    """
    import h5py

    if isinstance(item, h5py.Dataset):
        item.flush()


class _Output(io.RawIOBase):
    """File that HDF5 writes through, which can find the place of data instead of writing them.

    HDF5's writes never fail. If one cannot be done, its data and those of all later ones stay in memory.
    """

    def __init__(self, path: Path) -> None:
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
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
            done = write_at(self._handle, rest, place)
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
        count = read_at(self._handle, buffer, self._position)
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
        if not self.closed and hasattr(self, "_handle"):  # without it, the file could not be created
            os.close(self._handle)
        super().close()


# Access to the file, which a separate process opens.
#
# Files of amiwarp have a checksum on each chunk. Their chunks are read and decoded in this process, on all cores. HDF5
# in the reading process reads files of other layouts or filters, and all that is read once when a file is opened. A
# recording of amiwarp takes one request: a request costs more than reading some 10,000 events.

PIECE = 1 << 20
"""Number of elements that the reading process reads per request."""

FIRST_SHARE = 0.6
"""Share of the processor time for the first attempt to open a file. If it fails, the rest is for naming the reason."""

SERVER = "amiwarp.io.hdf5_server"
"""Name of the module that runs in the reading process."""


class Hdf5File:
    """An open HDF5 file of events. Threads may read its columns in parallel.

    Raises :class:`AmiwarpError` for a file that cannot be opened, refers to other files, or declares more data than it
    holds.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        """Open a file. ``topic`` chooses among several cameras."""
        self._topic = topic
        self._absolute = path.absolute()
        self._lock = threading.Lock()
        self._process: list[ReadingProcess] = []  # at most one; the finalizer has the same list
        self._allowance, self._opened = Allowance(path), False
        handle = os.open(input_path(path), os.O_RDONLY | getattr(os, "O_BINARY", 0))
        self.close = weakref.finalize(self, _close, handle, self._process)
        file = os.fstat(handle)
        self._identity = [file.st_dev, file.st_ino]
        state = (topic, *self._identity, file.st_size, file.st_mtime_ns, file.st_ctime_ns)
        found = _remembered.get(state)
        if found is None:
            try:
                found = self._find()
                if not found[0]["open"]:
                    _give_back(self._process)
                    if time.time_ns() - max(file.st_mtime_ns, file.st_ctime_ns) > UNCHANGED_NS:
                        _remember(state, found)
            except BaseException:
                self.close()
                raise
        about, at_once = found
        self.attributes: Mapping[str, Mapping[str, Any]] = about["attributes"]
        """Attributes of the groups that the file has, by the name of the group."""
        self.layout, self.group = str(about["layout"]), str(about["group"])
        """Layout of the file (native, m3ed, mvsec or ecf), and the group of its events."""
        self.unfinished = bool(about["unfinished"])
        """Whether the file is still being written, or the program that wrote it was interrupted."""
        self.columns = {name: Column(self, handle, name, column, at_once) for name, column in about["columns"].items()}
        """Datasets of the file by name. They refer to the file weakly, so a reader must keep the file."""

    def ask(self, function: str, *arguments: Any) -> list[NDArray[Any]]:
        """Call a function in the reading process, which is restarted after Ctrl-C and in a fork of this process."""
        with self._lock:
            if not self._process or not self._process[0].usable:
                self._start(again=True)
            found = self._process[0].call(f"{SERVER}:{function}", *arguments, allowance=self._allowance)[1]
            if self._opened:
                self._allowance.renew()
            return found

    def opened(self) -> None:
        """End the opening of the file, for all of which the allowance is: from now on it is for each request."""
        self._opened = True
        self._allowance.renew()

    def _find(self) -> Found:
        """Let the reading process open the file for the first time."""
        try:
            return self._start(again=False, share=FIRST_SHARE)
        except AmiwarpError:
            if self._process[0].usable:
                raise
        return self._start(again=True)  # a dataset that crashed HDF5 is named when it is read alone

    def _start(self, *, again: bool, share: float = 1.0) -> Found:
        self._process[:] = [borrow()]
        function, name = f"{SERVER}:open_file", str(self._absolute)
        found = self._process[0].call(function, name, self._topic, again, allowance=self._allowance, share=share)
        if found[0]["identity"] != self._identity:
            raise AmiwarpError("was replaced by another file while it was read; open the file again")
        return found


Found: TypeAlias = tuple[Any, list[NDArray[Any]]]
"""What the reading process found in a file: its description, and the values of the datasets that it has read."""

REMEMBERED, REMEMBERED_BYTES, PLACE_BYTES = 1024, 1 << 16, 150
"""Largest number of files that are remembered, largest size of one in memory, and that of a chunk's place [bytes]. To
read a larger file takes longer than to open it."""

UNCHANGED_NS = 2 * 10**9
"""Time without a change after which a file is remembered [ns]: two changes in close succession have the same time."""

_remembered: dict[tuple[Any, ...], Found] = {}
"""What was found in files, by their state, so that a training opens each file only in its first epoch."""


def _remember(state: tuple[Any, ...], found: Found) -> None:
    """Remember what was found in a small file. If there are too many, forget the file that was remembered first."""
    places = sum(len(column["places"] or ()) for column in found[0]["columns"].values())
    if PLACE_BYTES * places + sum(values.nbytes for values in found[1]) <= REMEMBERED_BYTES:
        _remembered[state] = found
        if len(_remembered) > REMEMBERED:
            with contextlib.suppress(KeyError, RuntimeError):  # another thread has changed it
                del _remembered[next(iter(_remembered))]


class Column:
    """Dataset that is read by rows: of numbers, or of arrays of one shape."""

    def __init__(
        self, file: Hdf5File, handle: int, name: str, about: Mapping[str, Any], at_once: Sequence[NDArray[Any]]
    ) -> None:
        """Take what the reading process found: ``about`` this dataset, and the values of all that it has read."""
        self._file = weakref.proxy(file)
        self.name = name
        """Name of the dataset in the file."""
        self._count = int(about["count"])
        self._filters = ", ".join(about["filters"]) or "no filter"
        self.dtype = np.dtype(about["dtype"])
        places = about["places"]
        self.row = tuple(int(size) for size in about["row"])
        """Shape of a row: empty for numbers."""
        self._stored = None if places is None else StoredColumn(handle, self.dtype, self._count, places, self.row)
        self._values = at_once[about["at_once"]] if "at_once" in about else None

    def __len__(self) -> int:
        return self._count

    def encoded(self, start: int, stop: int) -> list[bytes] | None:
        """Return the stored chunks of the elements with ``start <= index < stop``, which begin a chunk; None if HDF5
        reads them."""
        if self._stored is None:
            return None
        return [self._stored.encoded(at // CHUNK) for at in range(start, stop, CHUNK)]

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return the elements with ``start <= index < stop``. Raises :class:`AmiwarpError` for damaged data."""
        if start >= stop:
            return np.empty((0, *self.row), self.dtype)
        if self._stored is not None:
            values = self._stored.read(start, stop)
            if values is None:
                raise AmiwarpError(
                    f"dataset '{self.name}' has a damaged chunk: its checksum is wrong; copy the file again"
                )
            return values
        values, self._values = self._values, None  # they are read once
        if values is not None and (start, stop) == (0, self._count):
            return self._rows(values.copy(), start, stop)
        piece = max(1, PIECE // max(1, math.prod(self.row)))
        parts = [self._ask(at, min(at + piece, stop)) for at in range(start, stop, piece)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _ask(self, start: int, stop: int) -> NDArray[Any]:
        try:
            (values,) = self._file.ask("read", self.name, start, stop)
        except AmiwarpError as error:
            where = f"dataset '{self.name}' ({self._filters}), elements {start} .. {stop}"
            raise AmiwarpError(f"{where}: {error}") from error
        return self._rows(values, start, stop)

    def _rows(self, values: NDArray[Any], start: int, stop: int) -> NDArray[Any]:
        """Return values from the reading process in the shape of rows."""
        if values.size != (stop - start) * math.prod(self.row) or values.dtype != self.dtype:
            raise AmiwarpError(f"dataset '{self.name}' changed while it was read; open the file again")
        return values.reshape(stop - start, *self.row)


def _close(handle: int, process: list[ReadingProcess]) -> None:
    os.close(handle)
    _give_back(process)


def _give_back(process: list[ReadingProcess]) -> None:
    if process:
        give_back(process.pop())


# Files of MVSEC and Prophesee, which hold one row per event. They are read from the beginning.


def open_rows(path: Path, layout: str, group: str) -> Recording:
    """Open the events of a group, which :func:`amiwarp.io.hdf5_server.find_layout` has found."""
    source = path.absolute()
    about = run(f"{SERVER}:read_head", source, group)
    size = about["size"] and tuple(about["size"])
    name = f"{group}/events"
    read = partial(packets, f"{SERVER}:read_rows", source, name)
    if about["coded"]:
        read = partial(ecf.event_packets, SERVER, source, name)
    events = FileEvents(path, read, size=size)
    imu, frames, notes = read_sensors(path, about["counts"], SERVER, group)
    metadata = {"format": layout, "topic": group, **about["counts"], **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu, frames=frames)


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges of the external triggers in Prophesee's file."""
    return packets(f"{SERVER}:read_rows", path.absolute(), "EXT_TRIGGER/events", {})
