"""New HDF5 file whose encoded chunks several threads write at the same time.

HDF5 uses one thread at a time, and h5py holds Python's lock while HDF5 writes. Here HDF5 only finds the place of a
chunk in the file; the thread that encoded the chunk writes it there.

HDF5 crashes the process, at the latest when the process ends, if it cannot write a file that it closes. So HDF5 never
learns of a full disk: :class:`ChunkFile` notes the error and raises it outside HDF5.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.file_access import read_at, write_at
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.tasks import interrupts_later


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
    def of(
        cls, name: str, start: int, column: NDArray[Any], parts: Iterable[Sequence[bytes]]
    ) -> list[EncodedChunk]:
        """Return the chunks of a column from element ``start`` on, whose encoded bytes are ``parts``."""
        chunks = []
        for index, part in enumerate(parts):
            offset = index * CHUNK
            chunks.append(cls(name, start + offset, column[offset : offset + CHUNK], part))
        return chunks


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
        self._failed = math.inf
        """The lowest turn whose work failed."""
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
                raise AmiwarpError("an earlier part could not be written", ErrorCode.OUTPUT_FAILED)
            yield
            self._turn += 1
            self._turns.notify_all()

    @contextlib.contextmanager
    def stopping(self, turn: int) -> Iterator[None]:
        """If the work for a turn in the ``with`` block fails, end the waiting of all later turns.

        Earlier turns go on, so that the first error in order comes from the work which failed.
        """
        try:
            yield
        except BaseException:
            with self._turns:
                self._failed = min(self._failed, turn)
                self._turns.notify_all()
            raise

    def write(
        self,
        turn: int,
        chunks: Sequence[EncodedChunk],
        dataset_of: Callable[[EncodedChunk], Any],
        before: Callable[[], None] = lambda: None,
    ) -> None:
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
        for offset, parts in placed:
            if offset is not None:
                self.output.write_at(parts, offset)
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
        offset = self.output.place_of(sum(map(len, chunk.parts)), write)
        if offset is None:
            write(b"".join(chunk.parts))
        return offset

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

    HDF5's writes never fail. If one cannot be done, its data and the data of all later writes stay in memory.
    """

    def __init__(self, path: Path) -> None:
        binary = getattr(os, "O_BINARY", 0)
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | binary, 0o666)
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
        self._sought = size
        self._found = None
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
            except BaseException as error:
                # An interrupt must not reach HDF5 either.
                self.failure = error
        self._unwritten.append((self._position, bytes(data)))

    def readinto(self, buffer: Any) -> int:
        count = read_at(self._handle, buffer, self._position)
        view = memoryview(buffer).cast("B")
        for place, data in self._unwritten:
            offset = place - self._position
            first = max(offset, 0)
            last = min(offset + len(data), len(view))
            if first < last:
                view[first:last] = data[first - offset : last - offset]
                count = max(count, last)
        return count

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            ends = [place + len(data) for place, data in self._unwritten]
            offset += max(os.fstat(self._handle).st_size, *ends, 0)
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
        # Without a handle, the file could not be created.
        if not self.closed and hasattr(self, "_handle"):
            os.close(self._handle)
        super().close()
