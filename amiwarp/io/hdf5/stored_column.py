"""Column of a native file whose chunks threads read in parallel, without HDF5."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.hdf5.chunks import CHUNK, decode

_kept_memory = threading.local()


def _padded_chunk(dtype: np.dtype[Any], row: tuple[int, ...]) -> NDArray[Any]:
    """Return memory of this thread for a chunk, until the next call: new memory takes as long as decoding."""
    size = CHUNK * dtype.itemsize * math.prod(row)
    memory: NDArray[np.uint8] = getattr(_kept_memory, "bytes", np.empty(0, np.uint8))
    if memory.size < size:
        memory = np.empty(size, np.uint8)
        _kept_memory.bytes = memory
    return memory[:size].view(dtype).reshape(CHUNK, *row)


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
        self._handle = handle
        self._dtype = dtype
        self._count = count
        self._places = places
        self._row = row
        self._last: tuple[int, NDArray[Any]] | None = None

    def read(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return the elements with ``start <= index < stop``, at least one, or None if a chunk is damaged."""
        first = start // CHUNK
        last = (stop - 1) // CHUNK
        within = slice(start - first * CHUNK, stop - first * CHUNK)

        # More reads of the same chunk may follow, unless it is read to its end.
        kept = self._last
        is_part = stop - start < CHUNK and stop != self._count
        is_kept = kept is not None and kept[0] == first
        if first == last and (is_part or is_kept):
            chunk = self._chunk(first)
            return None if chunk is None else chunk[within].copy()

        out = self._decoded(first, last)
        return None if out is None else out[within]

    def _chunk(self, chunk: int) -> NDArray[Any] | None:
        """Return a whole chunk, or None if it is damaged. The latest chunk is kept, for searches within it."""
        # Another thread may replace it meanwhile.
        latest = self._last
        if latest is not None and latest[0] == chunk:
            return latest[1]
        out = self._decoded(chunk, chunk)
        if out is not None:
            self._last = chunk, out
        return out

    def encoded(self, chunk: int) -> bytes:
        """Return the stored bytes of chunk ``at``."""
        offset, size = self._places[chunk]
        return os.pread(self._handle, size, offset)

    def _decoded(self, first: int, last: int) -> NDArray[Any] | None:
        """Return the elements of the chunks from ``first`` to ``last``, or None if one of the chunks is damaged."""
        stored = [self.encoded(number) for number in range(first, last + 1)]
        count = min((last + 1) * CHUNK, self._count) - first * CHUNK
        out = np.empty((count, *self._row), self._dtype)
        # The last chunk of the column is padded, and does not fit into the result.
        rest = count % CHUNK
        if rest:
            chunk = _padded_chunk(self._dtype, self._row)
            if not decode([stored.pop()], chunk):
                return None
            out[-rest:] = chunk[:rest]
        if stored and not decode(stored, out[: count - rest]):
            return None
        return out
