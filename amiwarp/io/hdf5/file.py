"""Access to an HDF5 file of events, which a separate process opens.

Files of amiwarp have a checksum on each chunk. Their chunks are read and decoded in this process, on all cores. HDF5
in the reading process reads files of other layouts or filters, and all that is read once when a file is opened. A
recording of amiwarp takes one request: a request costs more than reading some 10,000 events.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.hdf5.stored_column import StoredColumn
from amiwarp.io.inputs import input_path
from amiwarp.io.reading_process import Allowance, ReadingProcess, borrow, give_back

PIECE = 1 << 20
"""Number of elements that the reading process reads per request."""

FIRST_SHARE = 0.6
"""Share of the processor time for the first attempt to open a file. If it fails, the rest is for naming the reason."""

SERVER = "amiwarp.io.hdf5.server"
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
        self._process: list[ReadingProcess] = []
        """At most one process. The finalizer has the same list."""
        self._allowance = Allowance(path)
        self._opened = False
        handle = os.open(input_path(path), os.O_RDONLY | getattr(os, "O_BINARY", 0))
        self.close = weakref.finalize(self, _close, handle, self._process)
        status = os.fstat(handle)
        self._identity = [status.st_dev, status.st_ino]
        about, at_once = self._find_or_recall(status)
        self.attributes: Mapping[str, Mapping[str, Any]] = about["attributes"]
        """Attributes of the groups that the file has, by the name of the group."""
        self.layout = str(about["layout"])
        """Layout of the file: native, m3ed, mvsec, ecf or columns."""
        self.group = str(about["group"])
        """Group of its events."""
        self.unfinished = bool(about["unfinished"])
        """Whether the file is still being written, or the program that wrote it was interrupted."""
        self.columns = {
            name: Column(self, handle, name, column, at_once)
            for name, column in about["columns"].items()
        }
        """Datasets of the file by name. They refer to the file weakly, so a reader must keep the file."""

    def ask(self, function: str, *arguments: Any) -> list[NDArray[Any]]:
        """Call a function in the reading process, which is restarted after Ctrl-C and in a fork of this process."""
        with self._lock:
            if not self._process or not self._process[0].usable:
                self._start(again=True)
            found = self._process[0].call(
                f"{SERVER}:{function}", *arguments, allowance=self._allowance
            )[1]
            if self._opened:
                self._allowance.renew()
            return found

    def opened(self) -> None:
        """End the opening of the file, for all of which the allowance is: from now on it is for each request."""
        self._opened = True
        self._allowance.renew()

    def _find_or_recall(self, status: os.stat_result) -> Found:
        """Return what an earlier opening found in the file, or else let the reading process find it."""
        changed_ns = max(status.st_mtime_ns, status.st_ctime_ns)
        state = (
            self._topic,
            *self._identity,
            status.st_size,
            status.st_mtime_ns,
            status.st_ctime_ns,
        )
        found = _remembered.get(state)
        if found is not None:
            return found
        try:
            found = self._find()
            if not found[0]["open"]:
                _give_back(self._process)
                if time.time_ns() - changed_ns > UNCHANGED_NS:
                    _remember(state, found)
            return found
        except BaseException:
            self.close()
            raise

    def _find(self) -> Found:
        """Let the reading process open the file for the first time."""
        try:
            return self._start(again=False, share=FIRST_SHARE)
        except AmiwarpError:
            if self._process[0].usable:
                raise
        # A dataset that crashed HDF5 is named when it is read alone.
        return self._start(again=True)

    def _start(self, *, again: bool, share: float = 1.0) -> Found:
        """Let a reading process open the file. Its ``share`` of the allowance is for this request."""
        self._process[:] = [borrow()]
        found = self._process[0].call(
            f"{SERVER}:open_file",
            str(self._absolute),
            self._topic,
            again,
            allowance=self._allowance,
            share=share,
        )
        if found[0]["identity"] != self._identity:
            raise AmiwarpError(
                "was replaced by another file while it was read; open the file again",
                ErrorCode.FILE_UNREADABLE,
            )
        return found


Found: TypeAlias = tuple[Any, list[NDArray[Any]]]
"""What the reading process found in a file: its description, and the values of the datasets that it has read."""

REMEMBERED = 1024
"""Largest number of files that are remembered."""

REMEMBERED_BYTES = 1 << 16
"""Largest size of what was found in a file that is remembered [bytes]. To read a larger file takes longer than to open
it."""

PLACE_BYTES = 150
"""Size of a chunk's place in memory [bytes]."""

UNCHANGED_NS = 2 * 10**9
"""Time without a change after which a file is remembered [ns]: two changes in close succession have the same time."""


_remembered: dict[tuple[Any, ...], Found] = {}
"""What was found in files, by their state, so that a training opens each file only in its first epoch."""


def _remember(state: tuple[Any, ...], found: Found) -> None:
    """Remember what was found in a small file. If there are too many, forget the file that was remembered first."""
    places = sum(len(column["places"] or ()) for column in found[0]["columns"].values())
    size = PLACE_BYTES * places + sum(values.nbytes for values in found[1])
    if size > REMEMBERED_BYTES:
        return
    _remembered[state] = found
    if len(_remembered) > REMEMBERED:
        # Another thread may have changed it.
        with contextlib.suppress(KeyError, RuntimeError):
            del _remembered[next(iter(_remembered))]


class Column:
    """Dataset that is read by rows: of numbers, or of arrays of one shape."""

    def __init__(
        self,
        file: Hdf5File,
        handle: int,
        name: str,
        about: Mapping[str, Any],
        at_once: Sequence[NDArray[Any]],
    ) -> None:
        """Take what the reading process found: ``about`` this dataset, and the values of all that it has read."""
        self._file = weakref.proxy(file)
        self.name = name
        """Name of the dataset in the file."""
        self._count = int(about["count"])
        self._filters = ", ".join(about["filters"]) or "no filter"
        self.dtype = np.dtype(about["dtype"])
        self.row = tuple(int(size) for size in about["row"])
        """Shape of a row: empty for numbers."""
        self._stored: StoredColumn | None = None
        """The stored chunks, if this process can read them."""
        if about["places"] is not None:
            places = about["places"]
            self._stored = StoredColumn(handle, self.dtype, self._count, places, self.row)
        self._values: NDArray[Any] | None = None
        """All values, if the reading process has sent them, until they are read once."""
        if "at_once" in about:
            self._values = at_once[about["at_once"]]

    def __len__(self) -> int:
        return self._count

    def encoded(self, start: int, stop: int) -> list[bytes] | None:
        """Return the stored chunks of the elements with ``start <= index < stop``, which begin a chunk; None if HDF5
        reads them."""
        if self._stored is None:
            return None
        return [self._stored.encoded(row // CHUNK) for row in range(start, stop, CHUNK)]

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return the elements with ``start <= index < stop``. Raises :class:`AmiwarpError` for damaged data."""
        if start >= stop:
            return np.empty((0, *self.row), self.dtype)
        if self._stored is not None:
            values = self._stored.read(start, stop)
            if values is None:
                raise AmiwarpError(
                    f"dataset '{self.name}' has a damaged chunk: its checksum is wrong; copy the file again",
                    ErrorCode.FILE_DAMAGED,
                )
            return values
        values = self._values
        self._values = None
        if values is not None and (start, stop) == (0, self._count):
            return self._rows(values.copy(), start, stop)
        rows = max(1, PIECE // max(1, math.prod(self.row)))
        parts = [self._ask(row, min(row + rows, stop)) for row in range(start, stop, rows)]
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
            raise AmiwarpError(
                f"dataset '{self.name}' changed while it was read; open the file again",
                ErrorCode.FILE_UNREADABLE,
            )
        return values.reshape(stop - start, *self.row)


def _close(handle: int, process: list[ReadingProcess]) -> None:
    os.close(handle)
    _give_back(process)


def _give_back(process: list[ReadingProcess]) -> None:
    if process:
        give_back(process.pop())
