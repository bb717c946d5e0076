"""New HDF5 file whose encoded chunks several threads write at the same time.

HDF5 uses one thread at a time, and h5py holds Python's lock while HDF5 writes. Here HDF5 only finds the place of a
chunk in the file; the thread that encoded the chunk writes it there.
"""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any


class ChunkFile:
    """HDF5 file that is being written. Any thread may write chunks of its datasets."""

    def __init__(self, path: Path) -> None:
        """Create the file. Raises OSError if it exists."""
        import h5py

        self.output = _Output(path)
        self.lock = threading.Lock()
        try:
            # From HDF5 1.10 on, the file's structure has checksums, so that damage is detected.
            self.hdf5 = h5py.File(self.output, "w", libver=("v110", "v110"))
            """The file as h5py gives it."""
        except BaseException:
            self.output.close()
            raise

    def close(self) -> None:
        """Close the file, after all threads have written their chunks."""
        try:
            self.hdf5.close()
        finally:
            self.output.close()


class ChunkedColumn:
    """Dataset of a :class:`ChunkFile`. Any thread may write its chunks, in any order."""

    def __init__(self, file: ChunkFile, dataset: Any) -> None:
        self._file, self._id = file, dataset.id
        self._rows, *self._row = dataset.shape

    def write(self, start: int, stored: Sequence[bytes], rows: int) -> None:
        """Write an encoded chunk of ``rows`` elements, which starts at element ``start``.

        ``stored`` are the bytes of the chunk, in one or several parts. The dataset grows if it is too short.
        """
        size = sum(map(len, stored))
        place = (start, *(0 for _ in self._row))
        with self._file.lock:
            if self._rows < start + rows:
                self._rows = start + rows
                self._id.set_extent((self._rows, *self._row))
            at = self._file.output.place_of(size, partial(self._id.write_direct_chunk, place))
            if at is None:
                self._id.write_direct_chunk(place, b"".join(stored))
                return
        for part in stored:
            self._file.output.write_at(part, at)
            at += len(part)


class _Output(io.RawIOBase):
    """File that HDF5 writes through, which can find the place of data instead of writing them."""

    def __init__(self, path: Path) -> None:
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        self._position = 0
        self._token = os.urandom(16)
        self._stand_in = memoryview(self._token)
        self._sought: int | None = None
        self._found: int | None = None

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

    def write_at(self, data: Any, place: int) -> None:
        """Write data at a place [bytes]. Any thread may call it."""
        rest = memoryview(data)
        while rest:
            done = os.pwrite(self._handle, rest, place)
            rest, place = rest[done:], place + done

    def write(self, data: Any) -> int:
        size = len(data)
        if size == self._sought and memoryview(data)[: len(self._token)] == self._token[:size]:
            self._found = self._position
        else:
            self.write_at(data, self._position)
        self._position += size
        return size

    def readinto(self, buffer: Any) -> int:
        return os.preadv(self._handle, [buffer], self._position)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._position = offset + (os.fstat(self._handle).st_size if whence == os.SEEK_END else 0)
        return self._position

    def tell(self) -> int:
        return self._position

    def truncate(self, size: int | None = None) -> int:
        size = self._position if size is None else size
        os.ftruncate(self._handle, size)
        return size

    def close(self) -> None:
        if not self.closed:
            os.close(self._handle)
        super().close()
