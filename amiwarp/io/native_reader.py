"""Reader of native HDF5 recordings, and of DSEC event files, whose layout the native format extends.

The format is described in ``docs/reference/recording-format.md``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import (
    DEFAULT_BLOCK,
    Events,
    as_coordinate,
    as_polarity,
    check_events,
    regroup,
    rounded_times,
)
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.events.sensors import ImuSamples
from amiwarp.io.camera_files import attribute, read_camera, read_prism
from amiwarp.io.chunks import CHUNK, in_order
from amiwarp.io.file_scan import head_limit, smallest_sensor
from amiwarp.io.hdf5 import Column, Hdf5File, open_rows
from amiwarp.io.input_files import errors_name, register_reader
from amiwarp.io.native_layout import FORMAT, FORMAT_VERSION
from amiwarp.io.native_truth import read_truth
from amiwarp.optics.camera import check_size

# Reader of the IMU samples and frames of native recordings. Frames are read on demand.


def read_imu(path: Path, file: Hdf5File) -> ImuSamples | None:
    """Return the IMU samples of a file, or None if it has none."""
    if "imu/t" not in file.columns:
        return None
    with errors_name(path, lambda: "imu"):
        count = len(file.columns["imu/t"])
        values = [_rows(file, f"imu/{name}", count, (3,)) for name in ("angular_velocity", "acceleration")]
        t = rounded_times(file.columns["imu/t"].read(0, count))
        return ImuSamples(t, *(column.read(0, count).astype(np.float64, copy=False) for column in values))


def _rows(file: Hdf5File, name: str, count: int, row: tuple[int, ...] | None) -> Column:
    """Return a dataset of ``count`` rows of the shape ``row``, or of any shape if it is None."""
    if name not in file.columns:
        raise AmiwarpError(f"dataset '{name}' is missing; the file is incomplete")
    column = file.columns[name]
    if len(column) != count or column.row != (row or column.row):
        shape = (len(column), *column.row)
        raise AmiwarpError(f"dataset '{name}' has shape {shape}, its times are {count}; the file is damaged")
    return column


def read_frames(path: Path, file: Hdf5File) -> StoredImages | None:
    """Return the frames of a file, or None if it has none."""
    if "frames/t" not in file.columns:
        return None
    with errors_name(path, lambda: "frames"):
        return StoredImages(path, file)


class StoredImages:
    """Frames of a native recording, read on demand."""

    def __init__(self, path: Path, file: Hdf5File) -> None:
        self._path, self._file = path, file  # the columns hold only a weak reference to the file
        times = file.columns["frames/t"]
        self._image = _rows(file, "frames/image", len(times), None)
        if self._image.dtype not in (np.uint8, np.uint16) or not all(self._image.row):
            raise AmiwarpError(f"frames are {self._image.dtype} of shape {self._image.row}; expected uint8 or uint16")
        self.t = rounded_times(times.read(0, len(times)))
        """Times of the frames [us], shape ``(k,)``."""
        if (self.t[1:] < self.t[:-1]).any():
            raise AmiwarpError("frames/t decreases; the file is damaged")

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""
        height, width = self._image.row
        return width, height

    def __getitem__(self, index: int, /) -> NDArray[Any]:
        at = range(len(self.t))[index]
        with errors_name(self._path, lambda: f"frames {index}"):
            return self._image.read(at, at + 1)[0]


DSEC_SIZE = (640, 480)
"""Size of DSEC's sensors [px], which its files do not store."""


class NativeEvents:
    """Events of an HDF5 recording, read on demand. Raises :class:`AmiwarpError` for a damaged file."""

    def __init__(self, path: Path, file: Hdf5File) -> None:
        """Open the events of a file. If the file is unfinished, these are the events that are complete now."""
        self.path = path
        self._file = file
        self._columns = {name: _column(file, f"events/{name}") for name in ("t", "p", "x", "y")}
        for name in ("inside", "extrapolated"):
            if f"events/{name}" in file.columns:
                self._columns[name] = file.columns[f"events/{name}"]
        lengths = {name: len(column) for name, column in self._columns.items()}
        if len(set(lengths.values())) != 1 and not file.unfinished:
            raise AmiwarpError(f"{path}: datasets of events differ in length: {lengths}; the file is damaged")
        self._count = min(lengths.values())
        offset = file.columns.get("t_offset")
        self._offset = 0 if offset is None else rounded_times(offset.read(0, 1)).item()
        # The index of an unfinished file may be incomplete. Bisection is used instead.
        self._ms_to_idx = None if file.unfinished else file.columns.get("ms_to_idx")
        self._size = self._find_size()
        self._ends = [self.slice(at, at + 1).t for at in (0, self._count - 1)] if self._count else []
        register_reader(self, self.path)

    def _find_size(self) -> tuple[int, int]:
        """Return the stored sensor size, or else the smallest known sensor that holds all events [px]."""
        attributes = self._file.attributes("/") or {}
        if "width" in attributes and "height" in attributes:
            width, height = (attribute(attributes, f"{self.path}: /", name, int) for name in ("width", "height"))
            check_size(width, height, self.path)
            return width, height
        largest = [0, 0]
        for start in range(0, min(self._count, head_limit() or self._count), DEFAULT_BLOCK):
            for axis, name in enumerate(("x", "y")):
                values = self._read(name, start, min(start + DEFAULT_BLOCK, self._count))
                largest[axis] = max(largest[axis], int(values.max()))
        width, height = smallest_sensor(largest[0], largest[1])
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
        """Sensor size (width, height) [px]."""
        return self._size

    def slice(self, start: int, stop: int) -> Events:
        """Return the events with ``start <= index < stop``, and check them. Threads may call it in parallel."""
        start, stop = max(start, 0), min(max(stop, start, 0), self._count)
        with errors_name(self.path, lambda: f"events {start} .. {stop}"):
            x, y, p = (self._read(name, start, stop) for name in ("x", "y", "p"))
            t = self._read("t", start, stop)
            # check_events finds times beyond the limit among sorted int64, also if adding the offset overflows.
            t = self._since_zero(t if t.dtype == np.int64 else rounded_times(t))
            events = Events(as_coordinate("x", x), as_coordinate("y", y), t, as_polarity(p))
            nan = "inside" in self._columns
            check_events(events, *self._size, where=str(self.path), first_index=start, allow_nan=nan)
        return events

    def inside(self, start: int, stop: int) -> NDArray[np.bool_] | None:
        """Return whether each compensated event lies inside the image, shape ``(n,)``; None if this is not stored."""
        return self._flags("inside", start, stop)

    def extrapolated(self, start: int, stop: int) -> NDArray[np.bool_] | None:
        """Return whether each event's angle was extrapolated, shape ``(n,)``; None if the file does not store it."""
        return self._flags("extrapolated", start, stop)

    def _flags(self, name: str, start: int, stop: int) -> NDArray[np.bool_] | None:
        if name not in self._columns:
            return None
        with errors_name(self.path, lambda: f"events/{name} {start} .. {stop}"):
            return np.asarray(self._read(name, max(start, 0), min(max(stop, 0), self._count)), np.bool_)

    def find(self, t: int) -> int:
        """Return the index of the first event at or after ``t`` [us], found with the file's millisecond index."""
        if not self._count or t <= self.t_first:
            return 0
        if t > self.t_last:
            return self._count
        low, high = self._bracket(t)
        at = low + int(np.searchsorted(self._times(low, high), t))
        around = self._times(at - 1, at + 1) if 0 < at < self._count else np.zeros(0, np.int64)
        if around.size != 2 or not around[0] < t <= around[1]:
            raise AmiwarpError(
                f"{self.path}: events/t is not sorted near {t} us, or ms_to_idx disagrees with it; the file is damaged"
            )
        return at

    def between(self, t_start: int, t_end: int) -> Events:
        """Return the events with ``t_start <= t < t_end`` [us], found with the file's millisecond index."""
        with errors_name(self.path, lambda: f"events between {t_start} and {t_end} us"):
            return self.slice(self.find(t_start), self.find(t_end))

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Iterator[Events]:
        """Return all events in blocks, as :meth:`amiwarp.EventSource.blocks`."""
        return regroup(self._pieces_in_order(), count=count, duration_us=duration_us)

    def pieces(self, count: int) -> Iterator[Callable[[], Events]]:
        """Yield functions that read ``count`` events each, in any thread. Whole chunks are read fastest."""
        for start in range(0, self._count, count):
            yield partial(self.slice, start, start + count)

    def encoded_times_and_polarities(self, start: int, stop: int) -> dict[str, list[bytes]]:
        """Return the stored chunks of times and polarities with ``start <= index < stop``, by name of the dataset.

        A recording of the same events from the first one on holds the same chunks. ``start`` begins a chunk. Empty for
        files of other formats, unfinished files, and times that do not start at the first event.
        """
        root = self._file.attributes("/") or {}
        if root.get("format") != FORMAT or self._file.unfinished or self._offset != self.t_first:
            return {}
        chunks = {n: self._columns[n].encoded(start, min(stop, self._count)) for n in ("t", "p")}
        dtypes = {"t": np.dtype(np.int64), "p": np.dtype(np.uint8)}
        return {f"events/{n}": c for n, c in chunks.items() if c is not None and self._columns[n].dtype == dtypes[n]}

    def _pieces_in_order(self) -> Iterator[Events]:
        with contextlib.closing(in_order(self.pieces(CHUNK))) as pieces:
            yield from pieces

    def _times(self, start: int, stop: int) -> NDArray[np.int64]:
        return self._since_zero(rounded_times(self._read("t", start, stop)))

    def _since_zero(self, t: NDArray[np.int64]) -> NDArray[np.int64]:
        """Add the file's offset to times, in the same array if it can be written."""
        return np.add(t, self._offset, out=t if t.flags.writeable else None) if self._offset else t

    def _read(self, name: str, start: int, stop: int) -> NDArray[Any]:
        return self._columns[name].read(start, stop)

    def _bracket(self, t: int) -> tuple[int, int]:
        """Return a short range of event indices around time ``t`` [us], from the millisecond index or by bisection."""
        ms = (t - self._offset) // 1000
        if self._ms_to_idx is not None and 0 <= ms < len(self._ms_to_idx):
            ends = self._ms_to_idx.read(ms, min(ms + 2, len(self._ms_to_idx))).tolist()
            return max(0, min(ends[0], self._count)), max(
                0, min(ends[1] if len(ends) > 1 else self._count, self._count)
            )
        low, high = 0, self._count
        while high - low > 1024:
            middle = (low + high) // 2
            low, high = (middle, high) if int(self._times(middle, middle + 1)[0]) < t else (low, middle)
        return low, high


def open_native(path: Path, topic: str | None = None) -> Recording:
    """Open a native recording, or a file of another layout. ``topic`` chooses among several cameras.

    Raises :class:`AmiwarpError` for other files.
    """
    with errors_name(path, lambda: "opening HDF5"):
        file = Hdf5File(path, topic)
        try:
            if file.layout in ("mvsec", "ecf"):
                file.close()
                return open_rows(path, file.layout, file.group)
            return _read_recording(path, file)
        except BaseException:
            file.close()
            raise


def _read_recording(path: Path, file: Hdf5File) -> Recording:
    root = _attributes(file, "/")
    version = attribute(root, f"{path}: /", "format_version", int, FORMAT_VERSION)
    if version > FORMAT_VERSION:
        raise AmiwarpError(f"{path}: format_version {version} is newer than {FORMAT_VERSION}; update amiwarp")
    events = NativeEvents(path, file)
    metadata: dict[str, MetadataValue] = {
        name: value if isinstance(value, (str, int, float, bool)) else str(value)
        for name, value in _attributes(file, "metadata").items()
    }
    metadata["format"] = "native" if attribute(root, f"{path}: /", "format", str, "") == FORMAT else "dsec"
    if file.layout == "m3ed":
        metadata |= {"format": "m3ed", "topic": file.group}
    camera, prism = file.attributes("camera"), file.attributes("prism")
    found = None if camera is None else read_camera(camera, f"{path}: /camera")
    if found is not None and (found.width, found.height) != events.size:
        raise AmiwarpError(
            f"{path}: camera is {found.width}x{found.height}, events are {events.size}; both must have the same size"
        )
    recording = Recording(
        events=events,
        camera=found,
        encoder=None if file.attributes("encoder") is None else _read_encoder(path, file),
        prism=None if prism is None else read_prism(prism, f"{path}: /prism"),
        truth=None if file.attributes("truth") is None else read_truth(path, file, len(events), events.size),
        metadata=metadata,
        name=path.stem,
        imu=read_imu(path, file),
        frames=read_frames(path, file),
    )
    file.settle()
    return recording


def _attributes(file: Hdf5File, group: str) -> Mapping[str, Any]:
    return file.attributes(group) or {}


def _column(file: Hdf5File, name: str) -> Column:
    if name not in file.columns:
        raise AmiwarpError(f"no dataset '{name}'; the file is incomplete")
    return file.columns[name]


def _read_encoder(path: Path, file: Hdf5File) -> Encoder | None:
    columns = {name: _column(file, f"encoder/{name}") for name in ("t", "angle")}
    t, angle = (column.read(0, len(column)) for column in columns.values())
    t, angle = rounded_times(t), angle.astype(np.float64)
    pulses = file.columns.get("encoder/index_t")
    index_t = None if pulses is None else rounded_times(pulses.read(0, len(pulses)))
    if file.unfinished:
        count = min(t.size, angle.size)
        t, angle = t[:count], angle[:count]
        index_t = index_t[(index_t >= t[0]) & (index_t <= t[-1])] if index_t is not None and count else None
    # A live recording has datasets for an encoder before it is known whether an encoder is connected.
    if t.size < 2 and (file.unfinished or t.size == angle.size == 0):
        return None
    offset = attribute(_attributes(file, "encoder"), f"{path}: /encoder", "clock_offset_us", float, 0.0)
    return Encoder(t, angle, offset, index_t)
