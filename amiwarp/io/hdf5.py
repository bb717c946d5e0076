"""Access to HDF5 files of events, which a separate process opens.

Files of amiwarp have a checksum on each chunk. Their chunks are read and decoded in this process, on all cores. HDF5 in
the reading process reads files of other layouts or filters, and everything that is read once when a file is opened.
"""

from __future__ import annotations

import math
import os
import threading
import weakref
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.chunks import CHUNK, StoredColumn
from amiwarp.io.file_scan import FileEvents, Packet, read_sensors
from amiwarp.io.input_files import input_path
from amiwarp.io.reading_process import ReadingProcess, borrow, give_back, packets, run

PIECE = 1 << 20
"""Number of elements that the reading process reads per request."""

READ_ON_DEMAND = ("events/", "truth/x", "truth/y", "truth/events/", "ms_to_idx")
"""Prefixes of the datasets that are read repeatedly after a file was opened."""

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
        handle = os.open(input_path(path), os.O_RDONLY | getattr(os, "O_BINARY", 0))
        self.close = weakref.finalize(self, _close, handle, self._process)
        found = os.fstat(handle)
        self._identity = [found.st_dev, found.st_ino]
        try:
            about = self._start()
        except BaseException:
            self.close()
            raise
        self._attributes = about["attributes"]
        self.layout, self.group = str(about["layout"]), str(about["group"])
        """Layout of the file (native, m3ed, mvsec or ecf), and the group of its events."""
        self.unfinished = bool(about["unfinished"])
        """Whether the file is still being written, or the program that wrote it was interrupted."""
        self.columns = {name: Column(self, handle, name, column) for name, column in about["columns"].items()}
        """Datasets of the file by name. They refer to the file weakly, so a reader must keep the file."""

    def attributes(self, group: str) -> Mapping[str, Any] | None:
        """Return the attributes of a group, or None if the file has no such group."""
        found: Mapping[str, Any] | None = self._attributes.get(group)
        return found

    def settle(self) -> None:
        """Finish opening the file: give the reading process back unless datasets that are read repeatedly need it."""
        if all(column.is_stored for name, column in self.columns.items() if name.startswith(READ_ON_DEMAND)):
            with self._lock:
                _give_back(self._process)

    def ask(self, function: str, *arguments: Any) -> list[NDArray[Any]]:
        """Call a function in the reading process, which is restarted after Ctrl-C and in a fork of this process."""
        with self._lock:
            if not self._process or not self._process[0].usable:
                self._start()
            return self._process[0].call(f"{SERVER}:{function}", *arguments)[1]

    def _start(self) -> Any:
        self._process[:] = [borrow()]
        about, _ = self._process[0].call(f"{SERVER}:open_file", self._absolute, self._topic)
        if about["identity"] != self._identity:
            raise AmiwarpError("was replaced by another file while it was read; open the file again")
        return about


class Column:
    """Dataset that is read by rows: of numbers, or of arrays of one shape."""

    def __init__(self, file: Hdf5File, handle: int, name: str, about: Mapping[str, Any]) -> None:
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

    def __len__(self) -> int:
        return self._count

    @property
    def is_stored(self) -> bool:
        """Whether the dataset's chunks are read without HDF5."""
        return self._stored is not None

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
        piece = max(1, PIECE // max(1, math.prod(self.row)))
        parts = [self._ask(at, min(at + piece, stop)) for at in range(start, stop, piece)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _ask(self, start: int, stop: int) -> NDArray[Any]:
        try:
            (values,) = self._file.ask("read", self.name, start, stop)
        except AmiwarpError as error:
            where = f"dataset '{self.name}' ({self._filters}), elements {start} .. {stop}"
            raise AmiwarpError(f"{where}: {error}") from error
        if values.size != (stop - start) * math.prod(self.row) or values.dtype != self.dtype:
            raise AmiwarpError(f"dataset '{self.name}' changed while it was read; open the file again")
        return values.reshape(stop - start, *self.row)


def _close(handle: int, process: list[ReadingProcess]) -> None:
    os.close(handle)
    _give_back(process)


def _give_back(process: list[ReadingProcess]) -> None:
    if process:
        give_back(process.pop())


# Reader of HDF5 files that store one row per event: MVSEC's and Prophesee's. They are read from the beginning.

def open_rows(path: Path, layout: str, group: str) -> Recording:
    """Open the events of a group, which :func:`amiwarp.io.hdf5_server.find_layout` has found."""
    source = path.absolute()
    about = run(f"{SERVER}:read_head", source, group)
    events = FileEvents(path, partial(packets, f"{SERVER}:read_rows", source, f"{group}/events"), size=_size(about["size"]))
    imu, frames, notes = read_sensors(path, about["counts"], SERVER, group)
    metadata = {"format": layout, "topic": group, **about["counts"], **events.metadata, **notes}
    return Recording(events=events, metadata=metadata, name=path.stem, imu=imu, frames=frames)


def _size(given: list[int] | None) -> tuple[int, int] | None:
    return None if given is None else (given[0], given[1])


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges of the external triggers in Prophesee's file."""
    return packets(f"{SERVER}:read_rows", path.absolute(), "EXT_TRIGGER/events", {})
