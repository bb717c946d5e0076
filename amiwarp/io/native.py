"""Reading the native HDF5 recording and the DSEC event files whose layout it extends (docs/recording-format.md)."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.encoder import Encoder
from amiwarp.errors import AmiwarpError
from amiwarp.events import DEFAULT_BLOCK, Events, MetadataValue, Recording, Truth, as_times, check_events, regroup
from amiwarp.io.attributes import attribute, read_camera, read_prism
from amiwarp.io.chunks import BLOSC, CHUNK, FLETCHER32, StoredColumn, in_order
from amiwarp.io.files import errors_name, register_reader
from amiwarp.io.native_writer import FORMAT, FORMAT_VERSION
from amiwarp.io.scan import smallest_sensor

ATTEMPTS = 24
"""To read what is being written: from 1 ns between two on, each twice as long, 17 ms in all."""

DSEC_SIZE = (640, 480)
"""Size of DSEC's sensors [px]; its files do not tell."""


class NativeEvents:
    """Events of an HDF5 recording, read only where asked for. Raises :class:`AmiwarpError` for a damaged file."""

    def __init__(self, path: Path, file: Any, *, unfinished: bool = False) -> None:
        """``unfinished``: its writer is at work, or was cut off; the events that are whole now are taken."""
        self.path = path
        self._file = file
        self._columns = {name: _dataset(file, f"events/{name}", "iub") for name in ("t", "p")}
        self._columns |= {name: _dataset(file, f"events/{name}", "iuf") for name in ("x", "y")}
        for name in ("inside", "extrapolated"):
            if name in file["events"]:
                self._columns[name] = _dataset(file, f"events/{name}", "iub")
        lengths = {name: _length(column, unfinished) for name, column in self._columns.items()}
        if len(set(lengths.values())) != 1 and not unfinished:
            raise AmiwarpError(f"{path}: events differ in length: {lengths}; the file is damaged")
        self._count = min(lengths.values())
        self._stored = {name: StoredColumn.of(column) for name, column in self._columns.items()}
        self._offset = as_times(file["t_offset"][()]).item() if "t_offset" in file else 0
        # Of an unfinished file it may end anywhere: bisection does without.
        self._ms_to_idx = _dataset(file, "ms_to_idx", "iu") if "ms_to_idx" in file and not unfinished else None
        self._size = self._find_size()
        self._ends = [self.slice(at, at + 1).t for at in (0, self._count - 1)] if self._count else []
        register_reader(self, self.path)

    def _find_size(self) -> tuple[int, int]:
        attributes = self._file.attrs
        if "width" in attributes and "height" in attributes:
            width, height = int(attributes["width"]), int(attributes["height"])
            if not (1 <= width <= 65536 and 1 <= height <= 65536):
                raise AmiwarpError(f"{self.path}: size {width}x{height}; expected 1 .. 65536 pixels each way")
            return width, height
        largest = [0, 0]
        for start in range(0, self._count, DEFAULT_BLOCK):
            for axis, name in enumerate(("x", "y")):
                largest[axis] = max(largest[axis], int(self._columns[name][start : start + DEFAULT_BLOCK].max()))
        width, height = smallest_sensor(*largest)
        return max(width, DSEC_SIZE[0]), max(height, DSEC_SIZE[1])

    def __len__(self) -> int:
        return self._count

    @property
    def t_first(self) -> int:
        """Time of the first event [us]."""
        return self._end(0)

    @property
    def t_last(self) -> int:
        """Time of the last event [us]."""
        return self._end(-1)

    def _end(self, which: int) -> int:
        if not self._ends:
            raise AmiwarpError(f"{self.path}: holds no events, so it has no first or last time")
        return int(self._ends[which][0])

    @property
    def size(self) -> tuple[int, int]:
        """Sensor's (width, height) [px]."""
        return self._size

    def slice(self, start: int, stop: int) -> Events:
        """Events ``start <= index < stop``; they are checked as they are read. Threads may call it at once."""
        start, stop = max(start, 0), min(max(stop, start, 0), self._count)
        with errors_name(self.path, lambda: f"events {start} .. {stop}"):
            x, y, p = (self._read(name, start, stop) for name in ("x", "y", "p"))
            events = Events.from_arrays(x, y, self._times(start, stop), p)
            nan = "inside" in self._columns
            check_events(events, *self._size, where=str(self.path), first_index=start, allow_nan=nan)
        return events

    def inside(self, start: int, stop: int) -> NDArray[np.bool_] | None:
        """Of compensated events, which lie on the picture: shape ``(n,)``, or None where the file does not tell."""
        return self._flags("inside", start, stop)

    def extrapolated(self, start: int, stop: int) -> NDArray[np.bool_] | None:
        """Of events compensated live, which had an angle beyond the encoder's samples, as :meth:`inside`."""
        return self._flags("extrapolated", start, stop)

    def _flags(self, name: str, start: int, stop: int) -> NDArray[np.bool_] | None:
        if name not in self._columns:
            return None
        with errors_name(self.path, lambda: f"events/{name} {start} .. {stop}"):
            return np.asarray(self._read(name, max(start, 0), min(max(stop, 0), self._count)), np.bool_)

    def find(self, t: int) -> int:
        """See :meth:`amiwarp.events.EventSource.find`; the file's millisecond index helps."""
        if not self._count or t <= self.t_first:
            return 0
        if t > self.t_last:
            return self._count
        low, high = self._bracket(t)
        at = low + int(np.searchsorted(self._times(low, high), t))
        around = self._times(at - 1, at + 1) if 0 < at < self._count else np.zeros(0, np.int64)
        if around.size != 2 or not around[0] < t <= around[1]:
            raise AmiwarpError(f"{self.path}: events/t is not sorted near {t} us, or ms_to_idx disagrees with it")
        return at

    def between(self, t_start: int, t_end: int) -> Events:
        """Events with ``t_start <= t < t_end`` [us]; the file's millisecond index finds them."""
        with errors_name(self.path, lambda: f"events between {t_start} and {t_end} us"):
            return self.slice(self.find(t_start), self.find(t_end))

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """See :meth:`amiwarp.events.EventSource.blocks`."""
        return regroup(self._pieces_in_order(), count=count, duration_us=duration_us)

    def pieces(self, count: int) -> Iterator[Callable[[], Events]]:
        """The same, each yet to be read, by any thread; ``count`` is best a number of whole chunks."""
        for start in range(0, self._count, count):
            yield partial(self.slice, start, start + count)

    def _pieces_in_order(self) -> Iterator[Events]:
        with contextlib.closing(in_order(self.pieces(CHUNK))) as pieces:
            yield from pieces

    def _times(self, start: int, stop: int) -> NDArray[np.int64]:
        return as_times(self._read("t", start, stop)) + self._offset

    def _read(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """A part of a column; whole chunks of our own layout past HDF5, which lets one thread at a time read."""
        stored = self._stored[name]
        if stored is not None and start < stop and start % CHUNK == 0 and (stop % CHUNK == 0 or stop == self._count):
            values = stored.read(start, stop)
            if values is not None:
                return values
        # HDF5 reads any layout, and says what is wrong with a damaged one.
        return np.asarray(self._columns[name][start:stop])

    def _bracket(self, t: int) -> tuple[int, int]:
        """A short range of indices in which ``t`` falls: from the index, or by bisection without one."""
        ms = (t - self._offset) // 1000
        if self._ms_to_idx is not None and 0 <= ms < self._ms_to_idx.shape[0]:
            ends = self._ms_to_idx[ms : ms + 2].tolist()
            return max(0, min(ends[0], self._count)), max(
                0, min(ends[1] if len(ends) > 1 else self._count, self._count)
            )
        low, high = 0, self._count
        while high - low > 1024:
            middle = (low + high) // 2
            low, high = (middle, high) if int(self._times(middle, middle + 1)[0]) < t else (low, middle)
        return low, high


class _StoredPoints:
    """truth/x and truth/y as one ``(n, 2)`` array, read where asked for."""

    def __init__(self, path: Path, x: Any, y: Any) -> None:
        self._path, self._x, self._y = path, x, y

    def __getitem__(self, which: slice, /) -> NDArray[np.float32]:
        with errors_name(self._path, lambda: f"truth {which.start} .. {which.stop}"):
            return np.stack([self._x[which], self._y[which]], axis=1).astype(np.float32, copy=False)


def open_native(path: Path) -> Recording:
    """Open a native recording or a DSEC event file. Raises :class:`AmiwarpError` for anything else."""
    with errors_name(path, lambda: "opening HDF5"):
        file, unfinished = _open(path)
        try:
            return _read_recording(path, file, unfinished)
        except BaseException:
            file.close()
            raise


def _open(path: Path) -> tuple[Any, bool]:
    """The file, and whether its writer is still at work or was cut off: HDF5 opens only a live recording then."""
    # Imported for its effect: it registers the Blosc filter.
    import h5py
    import hdf5plugin  # noqa: F401

    try:
        return h5py.File(path, "r"), False
    except OSError:
        access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
        access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
        # HDF5 reads what does not match its checksum again, after twice the time: 100 times, for ever. h5py has no name
        # for this setting.
        with contextlib.suppress(AttributeError):
            attempts = ctypes.CDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
            attempts(ctypes.c_int64(access.id), ctypes.c_uint(ATTEMPTS))
        with contextlib.suppress(OSError):
            how = h5py.h5f.ACC_RDONLY | h5py.h5f.ACC_SWMR_READ
            return h5py.File(h5py.h5f.open(os.fsencode(path), how, fapl=access)), True
        raise


def _read_recording(path: Path, file: Any, unfinished: bool) -> Recording:
    import h5py

    version = _attribute(file, "format_version", int, FORMAT_VERSION)
    if version > FORMAT_VERSION:
        raise AmiwarpError(f"{path}: format_version {version} is newer than {FORMAT_VERSION}; update amiwarp")
    if not isinstance(file.get("events"), h5py.Group):
        raise AmiwarpError(f"{path}: HDF5 without a group 'events'; expected events/x, y, t, p")
    events = NativeEvents(path, file, unfinished=unfinished)
    stored = file["metadata"].attrs.items() if "metadata" in file else ()
    metadata: dict[str, MetadataValue] = {name: _plain(value) for name, value in stored}
    metadata["format"] = "native" if _attribute(file, "format", str, "") == FORMAT else "dsec"
    camera = read_camera(file["camera"].attrs, _named(file["camera"])) if "camera" in file else None
    if camera is not None and (camera.width, camera.height) != events.size:
        raise AmiwarpError(f"{path}: camera is {camera.width}x{camera.height}, events are {events.size}; give one size")
    return Recording(
        events=events,
        camera=camera,
        encoder=_read_encoder(file, unfinished) if "encoder" in file else None,
        prism=read_prism(file["prism"].attrs, _named(file["prism"])) if "prism" in file else None,
        truth=_read_truth(path, file, len(events)) if "truth" in file else None,
        metadata=metadata,
        name=path.stem,
    )


def _length(column: Any, unfinished: bool) -> int:
    """Elements of a column; of one that was growing those whose chunks are there."""
    count = int(column.shape[0])
    return min(count, column.id.get_num_chunks() * column.chunks[0]) if unfinished and column.chunks else count


def _dataset(file: Any, name: str, kinds: str) -> Any:
    import h5py

    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1:
        raise AmiwarpError(f"{file.filename}: no one-dimensional dataset '{name}'; the file is incomplete")
    if dataset.dtype.kind not in kinds:
        raise AmiwarpError(f"{file.filename}: dataset '{name}' is {dataset.dtype}; see docs/recording-format.md")
    if dataset.chunks is not None and _chunks_are_damaged(dataset):
        raise AmiwarpError(f"{file.filename}: dataset '{name}' has a damaged chunk; copy the file anew")
    return dataset


def _chunks_are_damaged(dataset: Any) -> bool:
    """Whether HDF5 or its Blosc filter would read beyond a chunk: neither looks, and the process would die of it."""
    creation = dataset.id.get_create_plist()
    filters = [creation.get_filter(at) for at in range(creation.get_nfilters())]
    chunk_bytes = dataset.chunks[0] * dataset.dtype.itemsize
    for code, _, values, _ in filters:
        # The filter's parameters: two versions, bytes per element, bytes per chunk.
        if code == BLOSC and tuple(values[2:4]) != (dataset.dtype.itemsize, chunk_bytes):
            return True
    if not filters or filters[0][0] != BLOSC:
        return False
    file_bytes = os.path.getsize(dataset.file.filename)
    damaged = False
    with open(dataset.file.filename, "rb") as raw:

        def visit(chunk: Any) -> None:
            nonlocal damaged
            raw.seek(chunk.byte_offset)
            header = raw.read(16)
            if chunk.filter_mask == 1:  # Blosc, the first filter, left out what it could not shorten
                plain = chunk_bytes + 4 * (FLETCHER32 in [code for code, *_ in filters])
                damaged |= chunk.byte_offset + plain > file_bytes or chunk.size != plain
                return
            # Blosc's header: four bytes, then the bytes before and after decompression, little-endian.
            fits = chunk.byte_offset + chunk.size <= file_bytes and len(header) == 16
            damaged |= not fits or int.from_bytes(header[4:8], "little") != chunk_bytes or chunk.filter_mask != 0

        dataset.id.chunk_iter(visit)
    return damaged


def _attribute(group: Any, name: str, kind: type[Any], default: Any = None) -> Any:
    return attribute(group.attrs, _named(group), name, kind, default)


def _named(group: Any) -> str:
    return f"{group.file.filename}: {group.name}"


def _plain(value: Any) -> MetadataValue:
    plain = value.item() if isinstance(value, np.generic) else value
    plain = plain.decode(errors="replace") if isinstance(plain, bytes) else plain
    return plain if isinstance(plain, (str, int, float, bool)) else str(plain)


def _read_encoder(file: Any, unfinished: bool) -> Encoder | None:
    t = as_times(_dataset(file, "encoder/t", "iu")[:])
    angle = _dataset(file, "encoder/angle", "f")[:].astype(np.float64)
    index_t = as_times(_dataset(file, "encoder/index_t", "iu")[:]) if "index_t" in file["encoder"] else None
    if unfinished:
        count = min(t.size, angle.size)
        t, angle = t[:count], angle[:count]
        index_t = index_t[(index_t >= t[0]) & (index_t <= t[-1])] if index_t is not None and count else None
    # A live recording has room for an encoder before it is known whether there is one.
    if t.size < 2 and (unfinished or t.size == angle.size == 0):
        return None
    return Encoder(t, angle, _attribute(file["encoder"], "clock_offset_us", float, 0.0), index_t)


def _read_truth(path: Path, file: Any, count: int) -> Truth:
    group = file["truth"]
    parameters = {name: _attribute(group, name, float) for name in group.attrs}
    if "x" not in group:
        return Truth(parameters)
    x, y = (_dataset(file, f"truth/{name}", "f") for name in ("x", "y"))
    if x.shape != (count,) or y.shape != (count,):
        raise AmiwarpError(f"{path}: truth has {x.shape[0]} and {y.shape[0]} points for {count} events")
    return Truth(parameters, _StoredPoints(path, x, y))
