"""amiwarp's native recording format: reader, and writers of whole files and of live recordings.

The format is described in ``docs/reference/recording-format.md``. DSEC and M3ED store events alike, and are read here.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import recording as checks
from amiwarp.events import truth as ground_truth
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import DEFAULT_BLOCK, Events, EventSource, ImuSamples, MetadataValue, Recording, regroup
from amiwarp.events.truth import (
    EVENT_COLUMNS,
    MAPS,
    EventTruth,
    FrameTruth,
    Instants,
    Poses,
    Truth,
    WorldLabels,
    check_truth,
)
from amiwarp.io import hdf5_files, served_columns
from amiwarp.io.column_options import GivenLayout
from amiwarp.io.column_units import are_microseconds
from amiwarp.io.columns import SAMPLE, is_plain_polarity
from amiwarp.io.file_scan import ASSUMED_SIZE, assumed_size, given_size, head_limit, smallest_sensor
from amiwarp.io.files import NewFile, allocate, check_output, errors_name, link_new, put_in_place, register_reader
from amiwarp.io.formats import MAX_MS, Codec, Outline, check_native
from amiwarp.io.hdf5_files import CHUNK, ChunkFile, Column, EncodedChunk, Hdf5File
from amiwarp.io.json_files import LARGEST_INTEGER
from amiwarp.optics.camera import (
    CAMERA_NUMBERS,
    COEFFICIENTS,
    DISTORTIONS,
    LARGEST_SIZE,
    Camera,
    camera_to_json,
    check_size,
)
from amiwarp.optics.prism import FlatSide, NominalPrism, Plate, Prism, UnsizedPrism, as_wedge
from amiwarp.tasks import Progress, Result, in_order
from amiwarp.validation import array as as_numbers
from amiwarp.validation import (
    as_times,
    check_slice,
    choice,
    guarded,
    instance,
    one_of,
    real,
    rounded_times,
    shown,
    whole,
)

# Layout of the file.

FORMAT = "amiwarp-recording"
"""Value of the attribute ``format`` of native recordings."""

FORMAT_VERSION = 1
"""Newest version of the format that is read, and the version that is written."""

EVENTS = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.uint8}
"""Types of the datasets of events. Coordinates of compensated events are float32."""

FLAGS = ("inside", "extrapolated")
"""Names of the flags of compensated events, uint8."""

ENCODERS = ("encoder/", "encoder/second_")
"""Beginnings of the names of the datasets of an encoder, and of those of the second encoder."""

POSE_TABLES = {
    "joints": ("truth/joints/names", "truth/joints/position", 3),
    "bodies": ("truth/poses/body_names", "truth/poses/bodies", 7),
}
"""Datasets of the names and of the values of what moves, and the length of a value."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Arrays of a block of events, by the names of their datasets in the file."""


# Camera and prism as attributes of an HDF5 group, or of a JSON object in a stream.


def attribute(attributes: Mapping[str, Any], where: str, name: str, kind: type[Any], default: Any = None) -> Any:
    """Return an attribute as type ``kind``; raise :class:`AmiwarpError` if it is missing or of another type."""
    if name not in attributes and default is None:
        raise AmiwarpError(f"{where} has no attribute '{name}'; add this attribute")
    value = attributes.get(name, default)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    what = f"{where} attribute '{name}'"
    if kind is int:
        return whole(value, what, -LARGEST_INTEGER, LARGEST_INTEGER)
    if kind is float:
        return real(value, what)
    try:
        text = value.decode() if isinstance(value, bytes) else value
    except UnicodeDecodeError:
        text = value
    return instance(text, kind, what)


def camera_attributes(camera: Camera) -> dict[str, Any]:
    """Return a camera as attributes of an HDF5 group, by name."""
    attributes = camera_to_json(camera)
    lens = attributes.pop("distortion", {"kind": "none"})
    attributes["distortion_model"] = lens.pop("kind")
    if lens:
        attributes["distortion"] = [float(value) for value in lens.values()]
    return attributes


def read_camera(attributes: Mapping[str, Any], where: str) -> Camera:
    """Return the camera stored in the attributes of a file or stream.

    Raises :class:`AmiwarpError` if an attribute is missing or unusable.
    """
    model = one_of(attribute(attributes, where, "distortion_model", str, "none"), (*DISTORTIONS, "none"),
                   f"{where} attribute 'distortion_model'")  # fmt: skip
    distortion = None
    if model in DISTORTIONS:
        lens, lengths = DISTORTIONS[model], COEFFICIENTS[model]
        k = as_numbers(attributes.get("distortion", ()), f"{where} attribute 'distortion'")
        if k.ndim != 1 or len(k) not in lengths:
            expected = " or ".join(map(str, lengths))
            raise AmiwarpError(f"camera distortion is {shown(k)}; expected {expected} numbers for {model}")
        distortion = lens(*k.tolist())
    kinds = dict(zip(CAMERA_NUMBERS, (int, int, float, float, float, float), strict=True))
    numbers = {name: attribute(attributes, where, name, kind) for name, kind in kinds.items()}
    return Camera(**numbers, distortion=distortion)


def prism_attributes(prism: NominalPrism) -> dict[str, float | str]:
    """Return the attributes of a nominal prism, without ``apex`` if that is unknown, or those of a plate."""
    if isinstance(prism, Plate):
        return {"thickness": prism.thickness, "tilt": prism.tilt, "index": prism.index}
    known: dict[str, float | str] = {"apex": prism.apex} if isinstance(prism, Prism) else {}
    known |= {"index": prism.index, "flat_side": prism.flat_side.value}
    if isinstance(prism, Prism) and prism.second is not None:
        known |= {f"second_{name}": value for name, value in prism_attributes(prism.second).items()}
    return known


def read_prism(attributes: Mapping[str, Any], where: str) -> NominalPrism:
    """Return the nominal prism stored in attributes. The apex angle is unknown if ``apex`` is missing.

    A plate has a ``thickness``.
    """
    if "thickness" in attributes:
        return Plate(*(attribute(attributes, where, name, float) for name in ("thickness", "tilt", "index")))
    side = attribute(attributes, where, "flat_side", str, FlatSide.SCENE.value)
    prism = UnsizedPrism(attribute(attributes, where, "index", float), side)
    if "apex" not in attributes:
        return prism
    second = {name: attributes[f"second_{name}"] for name in ("apex", "index", "flat_side")
              if f"second_{name}" in attributes}  # fmt: skip
    behind = as_wedge(read_prism(second, f"{where} second prism")) if second else None
    if isinstance(behind, UnsizedPrism):
        raise AmiwarpError(f"{where} has a second prism without 'second_apex'; add this attribute")
    return dataclasses.replace(prism.with_apex(attribute(attributes, where, "apex", float)), second=behind)


# Opening of a recording.


def open_hdf5(path: Path, topic: str | None, given: GivenLayout) -> Recording:
    """Open a native recording, or a file of another layout. ``topic`` chooses among several cameras.

    Raises :class:`AmiwarpError` for other files.
    """
    with errors_name(path, lambda: "opening HDF5"):
        file = Hdf5File(path, topic)
        try:
            ours = file.attributes.get("/", {}).get("format") == FORMAT
            if ours and given != GivenLayout():
                raise AmiwarpError(f"{path}: is amiwarp's own format, whose layout is fixed; leave out {given.options}")
            if file.layout == "columns" or given != GivenLayout() or _has_other_values(file):
                file.close()
                return served_columns.open_hdf5_columns(path, given)
            if file.layout in ("mvsec", "ecf"):
                file.close()
                return hdf5_files.open_rows(path, file.layout, file.group)
            recording = _read_recording(path, file)
            file.opened()
            return recording
        except BaseException:
            file.close()
            raise


def _has_other_values(file: Hdf5File) -> bool:
    """Return whether a file of another program has other polarities or another unit of time than the native layout.

    The first polarities are then not 1 for ON, 0 or -1 for OFF, or the first times can be no microseconds. With an
    index of the milliseconds, as in DSEC's files, the unit is known.
    """
    if file.attributes.get("/", {}).get("format") == FORMAT or file.unfinished:
        return False
    p, t = file.columns.get("events/p"), file.columns.get("events/t")
    if p is not None and not is_plain_polarity(p.read(0, min(len(p), CHUNK))):
        return True
    if t is None or "ms_to_idx" in file.columns or file.layout != "native":
        return False
    return not are_microseconds(t.read(0, min(len(t), SAMPLE)))


def _read_recording(path: Path, file: Hdf5File) -> Recording:
    root = file.attributes.get("/", {})
    version = attribute(root, f"{path}: /", "format_version", int, FORMAT_VERSION)
    if version > FORMAT_VERSION:
        raise AmiwarpError(f"{path}: format_version {version} is newer than {FORMAT_VERSION}; update amiwarp")
    events = NativeEvents(path, file)
    metadata: dict[str, MetadataValue] = {
        name: value if isinstance(value, (str, int, float, bool)) else str(value)
        for name, value in file.attributes.get("metadata", {}).items()
    }
    metadata["format"] = "native" if attribute(root, f"{path}: /", "format", str, "") == FORMAT else "dsec"
    if file.layout == "m3ed":
        metadata |= {"format": "m3ed", "topic": file.group}
    if given_size() is not None:
        metadata.pop(ASSUMED_SIZE, None)
    elif not events.size_is_stored:
        metadata |= [assumed_size(events.size).entry]
    events.size_is_known = ASSUMED_SIZE not in metadata
    camera, prism = file.attributes.get("camera"), file.attributes.get("prism")
    found = None if camera is None else read_camera(camera, f"{path}: /camera")
    if found is not None and (found.width, found.height) != events.size:
        raise AmiwarpError(
            f"{path}: camera is {found.width}x{found.height}, events are {events.size}; both must have the same size"
        )
    return Recording(
        events=events,
        camera=found,
        encoder=_read_encoder(path, file) if "encoder" in file.attributes else None,
        prism=None if prism is None else read_prism(prism, f"{path}: /prism"),
        truth=read_truth(path, file, len(events), events.size) if "truth" in file.attributes else None,
        metadata=metadata,
        name=path.stem,
        imu=read_imu(path, file),
        frames=read_frames(path, file),
    )


def _column(file: Hdf5File, name: str, count: int | None = None, row: tuple[int, ...] | None = None) -> Column:
    """Return a dataset; raise :class:`AmiwarpError` if the dataset is missing or does not have the expected shape.

    ``count``: expected number of rows; ``row``: expected shape of a row. None accepts any.
    """
    if name not in file.columns:
        raise AmiwarpError(f"no dataset '{name}'; the file is incomplete")
    column = file.columns[name]
    shape = (len(column), *column.row)
    expected = (len(column) if count is None else count, *(column.row if row is None else row))
    if shape != expected:
        raise AmiwarpError(f"dataset '{name}' has shape {shape}; expected {expected}; the file is damaged")
    return column


def _read_encoder(path: Path, file: Hdf5File) -> Encoder | None:
    samples = _read_samples(file, ENCODERS[0])
    if samples is None:
        return None
    t, angle = samples
    pulses = file.columns.get("encoder/index_t")
    index_t = None if pulses is None else rounded_times(pulses.read(0, len(pulses)))
    if file.unfinished and index_t is not None:
        index_t = index_t[(index_t >= t[0]) & (index_t <= t[-1])]
    second = _read_samples(file, ENCODERS[1]) if "encoder/second_t" in file.columns else None
    offset = attribute(file.attributes["encoder"], f"{path}: /encoder", "clock_offset_us", float, 0.0)
    return Encoder(t, angle, offset, index_t, None if second is None else Encoder(*second))


def _read_samples(file: Hdf5File, name: str) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Return times [us] and angles [rad] of an encoder whose datasets begin with ``name``; None without samples."""
    columns = [_column(file, name + column) for column in ("t", "angle")]
    t, angle = (column.read(0, len(column)) for column in columns)
    t, angle = rounded_times(t), angle.astype(np.float64)
    if file.unfinished:
        count = min(t.size, angle.size)
        t, angle = t[:count], angle[:count]
    # A live recording has datasets for an encoder before it is known whether an encoder is connected.
    if t.size < 2 and (file.unfinished or t.size == angle.size == 0):
        return None
    return t, angle


# Events of native recordings and of files of DSEC and M3ED, whose layouts are alike.

DSEC_SIZE = (640, 480)
"""Size of DSEC's sensors [px], which its files do not store."""


@guarded
class NativeEvents(EventSource):
    """Events of an HDF5 recording, read on demand. Raises :class:`AmiwarpError` for a damaged file."""

    def __init__(self, path: Path, file: Hdf5File) -> None:
        """Open the events of a file. If the file is unfinished, these are the events that are complete now."""
        self.path = path
        self._file = file
        self._columns = {name: _column(file, f"events/{name}") for name in ("t", "p", "x", "y")}
        for name in FLAGS:
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
        stored = given_size() or self._stored_size()
        self.size_is_stored = stored is not None
        """Whether the file or the user states the sensor size."""
        self.size_is_known = self.size_is_stored
        """Whether the size is neither taken from the events, nor was in the file that the recording was made from."""
        self._size = stored or self._smallest_size()
        self._ends = [self.slice(at, at + 1).t for at in (0, self._count - 1)] if self._count else []
        register_reader(self, self.path)

    def _stored_size(self) -> tuple[int, int] | None:
        """Return the stored sensor size [px], or None."""
        attributes = self._file.attributes.get("/", {})
        if "width" not in attributes or "height" not in attributes:
            return None
        width, height = (attribute(attributes, f"{self.path}: /", name, int) for name in ("width", "height"))
        check_size(width, height, self.path)
        return width, height

    def _smallest_size(self) -> tuple[int, int]:
        """Return the smallest known sensor size that holds all events, but at least that of DSEC [px]."""
        largest = [0, 0]
        for start in range(0, min(self._count, head_limit() or self._count), DEFAULT_BLOCK):
            for axis, name in enumerate(("x", "y")):
                values = self._read(name, start, min(start + DEFAULT_BLOCK, self._count))
                if values.dtype.kind == "f":  # compensated events may lie far outside, or have no coordinates
                    values = np.rint(values[(values >= 0) & (values < LARGEST_SIZE)])
                largest[axis] = max(largest[axis], int(values.max(initial=0)))
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
        check_slice(start, stop)
        stop = min(max(stop, start), self._count)
        with errors_name(self.path, lambda: f"events {start} .. {stop}"):
            x, y, p = (self._read(name, start, stop) for name in ("x", "y", "p"))
            t = self._read("t", start, stop)
            # check_events finds times beyond the limit among sorted int64, also if adding the offset overflows.
            t = self._since_zero(t if t.dtype == np.int64 else rounded_times(t))
            events = Events(checks.as_coordinate("x", x), checks.as_coordinate("y", y), t, checks.as_polarity(p))
            nan = "inside" in self._columns
            checks.check_events(events, *self._size, where=str(self.path), first_index=start, allow_nan=nan)
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
        checks.check_window(t_start, t_end)
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
        root = self._file.attributes.get("/", {})
        if root.get("format") != FORMAT or self._file.unfinished or self._offset != self.t_first:
            return {}
        chunks = {n: self._columns[n].encoded(start, min(stop, self._count)) for n in ("t", "p")}
        return {f"events/{n}": c for n, c in chunks.items() if c is not None and self._columns[n].dtype == EVENTS[n]}

    def _pieces_in_order(self) -> Iterator[Events]:
        start, last = 0, None
        with contextlib.closing(in_order(self.pieces(CHUNK))) as pieces:
            for piece in pieces:  # whose own order is checked
                checks.check_events(piece[:1], *self._size, where=str(self.path), first_index=start, allow_nan=True,
                                    after_t=last)  # fmt: skip
                start, last = start + len(piece), int(piece.t[-1])
                yield piece

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


# Rows and images that are read on demand. The columns refer to their file weakly, so these objects keep it.


class _StoredRows:
    """Rows of one or several datasets that are read on demand."""

    def __init__(self, path: Path, name: str, count: int, read: Callable[[int, int], Any], file: Hdf5File) -> None:
        self._path, self._name, self._count, self._read, self._file = path, name, count, read, file

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, which: slice, /) -> Any:
        with errors_name(self._path, lambda: self._name):
            start, stop = checks.slice_bounds(which, self._count, "rows")
        with errors_name(self._path, lambda: f"{self._name} {start} .. {stop}"):
            return self._read(start, stop)


class _StoredImages(Instants[Any]):
    """Images, or ground truth of all pixels, at several times, read on demand."""

    def __init__(
        self, path: Path, name: str, t: NDArray[np.int64], size: tuple[int, int], read: Callable[[int], Any],
        file: Hdf5File,
    ) -> None:  # fmt: skip
        super().__init__(t)
        self._path, self._name, self._image, self._file = path, name, read, file
        self.size = size
        """Size (width, height) of the images [px]."""

    def _read(self, index: int) -> Any:
        with errors_name(self._path, lambda: f"{self._name} {index}"):
            return self._image(index)


# IMU samples and frames of native recordings.


def read_imu(path: Path, file: Hdf5File) -> ImuSamples | None:
    """Return the IMU samples of a file, or None if it has none."""
    if "imu/t" not in file.columns:
        return None
    with errors_name(path, lambda: "imu"):
        count = len(file.columns["imu/t"])
        values = [_column(file, f"imu/{name}", count, (3,)) for name in ("angular_velocity", "acceleration")]
        t = rounded_times(file.columns["imu/t"].read(0, count))
        return ImuSamples(t, *(column.read(0, count).astype(np.float64, copy=False) for column in values))


def read_frames(path: Path, file: Hdf5File) -> _StoredImages | None:
    """Return the frames of a file, or None if it has none."""
    if "frames/t" not in file.columns:
        return None
    with errors_name(path, lambda: "frames"):
        times = file.columns["frames/t"]
        image = _column(file, "frames/image", len(times))
        if image.dtype not in (np.uint8, np.uint16) or not all(image.row):
            raise AmiwarpError(f"frames are {image.dtype} of shape {image.row}; expected uint8 or uint16")
        t = rounded_times(times.read(0, len(times)))
        if (t[1:] < t[:-1]).any():
            raise AmiwarpError("frames/t decreases; the file is damaged")
        height, width = image.row
        return _StoredImages(path, "frames", t, (width, height), lambda at: image.read(at, at + 1)[0], file)


# Ground truth of native recordings.


def read_truth(path: Path, file: Hdf5File, count: int, size: tuple[int, int]) -> Truth:
    """Return the ground truth of a file with ``count`` events.

    ``size``: width and height of the sensor [px].
    """
    attributes = file.attributes["truth"]
    values = {name: _event_values(path, file, name, count) for name in EVENT_COLUMNS}
    return Truth(
        {name: attribute(attributes, f"{path}: /truth", name, float) for name in attributes},
        stored_points=_points(path, file, count),
        stored_causes=values["cause"],
        stored_instances=values["instance"],
        stored_depths=values["depth"],
        stored_places=values["place"],
        labels=_labels(path, file),
        frames=_frames(path, file, size),
        poses=_poses(path, file),
        known=_masks(path, file, size),
    )


def _points(path: Path, file: Hdf5File, count: int) -> _StoredRows | None:
    """Return the true points of the events, or None if they are not stored."""
    if "truth/x" not in file.columns:
        return None
    columns = [_column(file, f"truth/{name}", count) for name in ("x", "y")]

    def read(start: int, stop: int) -> NDArray[np.float32]:
        return np.stack([_read_as(column, np.float32, start, stop) for column in columns], axis=1)

    return _StoredRows(path, "truth", count, read, file)


def _event_values(path: Path, file: Hdf5File, name: str, count: int) -> _StoredRows | None:
    """Return the values of the dataset ``truth/events/name``, or None if the dataset is missing."""
    stored, (dtype, row) = f"truth/events/{name}", EVENT_COLUMNS[name]
    if stored not in file.columns:
        return None
    return _StoredRows(path, stored, count, partial(_read_as, _column(file, stored, count, row), dtype), file)


def _read_as(column: Column, dtype: Any, start: int, stop: int) -> NDArray[Any]:
    """Read rows of a dataset as ``dtype``.

    Raises :class:`AmiwarpError` for integers that do not fit, and for values without meaning.
    """
    values = column.read(start, stop)
    check_truth(column.name, values)
    if values.dtype.kind in "iu" and values.size and not np.can_cast(values.dtype, dtype):
        limits = np.iinfo(dtype)
        if values.min() < limits.min or values.max() > limits.max:
            raise AmiwarpError(f"holds numbers outside of {limits.min} .. {limits.max}; the file is damaged")
    return values.astype(dtype, copy=False)


def _labels(path: Path, file: Hdf5File) -> WorldLabels | None:
    """Return the names and classes of the instances, or None if they are not stored."""
    if "truth/world/instances" not in file.columns:
        return None
    name = attribute(file.attributes.get("truth/world", {}), f"{path}: /truth/world", "name", str, "")
    instances, categories = (_names(file, f"truth/world/{what}") for what in ("instances", "categories"))
    with errors_name(path, lambda: "truth/world"):
        return WorldLabels(name, instances, categories or ("",) * len(instances))


def _names(file: Hdf5File, name: str) -> tuple[str, ...]:
    """Return the names in a dataset; an empty tuple if the dataset is missing."""
    column = file.columns.get(name)
    if column is None:
        return ()
    return tuple(bytes(text).decode("utf-8", "replace") for text in column.read(0, len(column)).tolist())


def _rising_times(path: Path, file: Hdf5File, name: str) -> NDArray[np.int64]:
    """Return the times of a dataset [us]. Raises :class:`AmiwarpError` if they do not rise."""
    times = rounded_times(file.columns[name].read(0, len(file.columns[name])))
    if (np.diff(times) <= 0).any():
        raise AmiwarpError(f"{path}: {name} does not increase; the file is damaged")
    return times


def _frames(path: Path, file: Hdf5File, size: tuple[int, int]) -> _StoredImages | None:
    """Return the ground truth of all pixels at several instants, or None if it is not stored."""
    if "truth/frames/t" not in file.columns:
        return None
    t = _rising_times(path, file, "truth/frames/t")
    maps = {
        name: _column(file, f"truth/frames/{name}", len(t), (*size[::-1], *tail)) for name, (_, tail) in MAPS.items()
    }
    poses = _column(file, "truth/frames/pose", len(t), (7,))
    names = _names(file, "truth/joints/names")
    joints = _column(file, "truth/frames/joints", len(t), (len(names), 3)) if names else None

    def read(at: int) -> FrameTruth:
        found = {name: _read_as(maps[name], dtype, at, at + 1)[0] for name, (dtype, _) in MAPS.items()}
        pose = _read_as(poses, np.float64, at, at + 1)[0]
        places = np.zeros((0, 3)) if joints is None else _read_as(joints, np.float64, at, at + 1)[0]
        found |= {"rotation": ground_truth.rotation_of(pose), "position": pose[:3]}
        return FrameTruth(t_us=int(t[at]), **found, joints=dict(zip(names, places, strict=True)))

    return _StoredImages(path, "truth/frames", t, size, read, file)


def _masks(path: Path, file: Hdf5File, size: tuple[int, int]) -> _StoredImages | None:
    """Return the masks of known pixels, or None if they are not stored."""
    if "truth/known/t" not in file.columns:
        return None
    t = _rising_times(path, file, "truth/known/t")
    masks = _column(file, "truth/known/mask", len(t), size[::-1])
    return _StoredImages(path, "truth/known", t, size, lambda at: masks.read(at, at + 1)[0] != 0, file)


def _poses(path: Path, file: Hdf5File) -> _StoredRows | None:
    """Return the poses of camera, bodies and joints, or None if they are not stored."""
    if "truth/poses/t" not in file.columns:
        return None
    t = file.columns["truth/poses/t"]
    camera = _column(file, "truth/poses/camera", len(t), (7,))
    tables = {}
    for what, (listed, table, width) in POSE_TABLES.items():
        names = _names(file, listed)
        if names and table in file.columns:
            tables[what] = names, _column(file, table, len(t), (len(names), width))

    def read(start: int, stop: int) -> Poses:
        named = {
            what: dict(zip(names, np.moveaxis(_read_as(column, np.float64, start, stop), 1, 0), strict=True))
            for what, (names, column) in tables.items()
        }
        return Poses(rounded_times(t.read(start, stop)), _read_as(camera, np.float64, start, stop), **named)

    return _StoredRows(path, "truth/poses", len(t), read, file)


# Header, columns and millisecond index of a file that is written.


def check_frame(path: Path, width: int, height: int, camera: Camera | None) -> None:
    """Raise :class:`AmiwarpError` for an impossible sensor size, or a size that differs from the camera's."""
    check_size(width, height, path)
    if camera is not None and (camera.width, camera.height) != (width, height):
        given = f"camera is {camera.width}x{camera.height}, the recording {width}x{height}"
        raise AmiwarpError(f"{path}: {given}; give both the same size")


def ms_entries(t: NDArray[np.int64], t_offset: int, first_ms: int, before: int) -> Iterator[NDArray[np.int64]]:
    """Yield entries of the millisecond index ms_to_idx from entry ``first_ms`` on.

    ``t`` are the times of new events [us], which follow ``before`` earlier events.
    """
    last_ms = (int(t[-1]) - t_offset) // 1000
    if last_ms > MAX_MS:
        span = f"{t_offset} .. {int(t[-1])} us"
        raise AmiwarpError(f"events span {span}, beyond {MAX_MS // 3_600_000} h; a timestamp is damaged")
    for first in range(first_ms, last_ms + 1, 1 << 20):
        ms = np.arange(first, min(first + (1 << 20), last_ms + 1), dtype=np.int64)
        yield np.searchsorted(t, ms * 1000 + t_offset) + before


def filled(chunk: Columns, start: int, columns: Columns) -> Columns:
    """Return a chunk with a copy of columns from element ``start`` on; a new chunk if this is its first element.

    Callers may change their arrays before the chunk is written.
    """
    if not start:
        chunk = {name: np.empty((CHUNK, *column.shape[1:]), column.dtype) for name, column in columns.items()}
    for name, column in columns.items():
        chunk[name][start : start + len(column)] = column
    return chunk


def write_header(
    file: Any,
    size: tuple[int, int],
    camera: Camera | None,
    prism: NominalPrism | None,
    metadata: Mapping[str, MetadataValue],
) -> None:
    """Write the parts of a file that are known before the first event: format, size, camera, prism and metadata."""
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["width"], file.attrs["height"] = size
    if camera is not None:
        file.create_group("camera").attrs.update(camera_attributes(camera))
    if prism is not None:
        file.create_group("prism").attrs.update(prism_attributes(prism))
    group = file.create_group("metadata")
    for name, item in metadata.items():
        group.attrs[name] = item


def encoder_columns(encoder: Encoder) -> Columns:
    """Return times [us], angles [rad] and index pulses [us] of an encoder and of its second one as datasets."""
    columns = {f"{ENCODERS[0]}{name}": getattr(encoder, name) for name in ("t", "angle", "index_t")}
    if encoder.second is not None:
        columns |= {f"{ENCODERS[1]}{name}": getattr(encoder.second, name) for name in ("t", "angle")}
    return {name: values for name, values in columns.items() if values is not None}


def event_columns(events: Events, truth: EventTruth, **flags: ArrayLike | None) -> Columns:
    """Return events, their flags and their ground truth as datasets, without the times.

    Raises :class:`AmiwarpError` for arrays of another length or shape, and for values without meaning.
    """
    count = len(events)
    columns: Columns = {"events/x": events.x, "events/y": events.y, "events/p": events.p}
    columns |= {f"events/{name}": np.asarray(flag).astype(np.uint8) for name, flag in flags.items() if flag is not None}
    for name, column in columns.items():
        if column.shape != (count,):
            raise AmiwarpError(f"{name} has shape {column.shape}; expected ({count},)")
    if truth.points is not None:
        points = np.asarray(truth.points, np.float32)
        if points.shape != (count, 2):
            raise AmiwarpError(f"truth points have shape {points.shape}; expected ({count}, 2)")
        columns["truth/x"], columns["truth/y"] = points[:, 0], points[:, 1]
    for name, (dtype, row) in EVENT_COLUMNS.items():
        given = getattr(truth, name)
        if given is not None:
            values = np.asarray(given, dtype)
            if values.shape != (count, *row):
                raise AmiwarpError(f"truth of {name} has shape {values.shape}; expected {(count, *row)}")
            columns[f"truth/events/{name}"] = values
    for name, values in columns.items():
        if name.startswith("truth/"):
            check_truth(name, values)
    return columns


# Writer of a whole recording or none.

ROWS = 1024
"""Number of rows per HDF5 chunk in datasets of small rows, such as poses."""

FlaggedEvents: TypeAlias = tuple[Events, NDArray[np.uint8], Mapping[str, Sequence[bytes]]]
"""Compensated events with flags of shape ``(n,)``: 1 if the event lies inside the image; and chunks of their columns
that are encoded already, by the name of the dataset."""


@guarded
class RecordingWriter:
    """Writer that streams a recording into a native HDF5 file.

    Use it in a ``with`` block. The file appears under its name when the block ends without an exception. After an
    exception nothing remains.

    Parameters
    ----------
    path : str or path-like
        The file to write, which ends in ``.h5`` or ``.hdf5``.
    width, height : int
        Sensor size [px].
    camera : Camera, optional
        The camera, of the same size.
    prism : Prism or UnsizedPrism, optional
        The nominal prism.
    encoder : Encoder, optional
        The encoder. :meth:`set_encoder` can replace it later.
    truth_parameters : mapping of str to float, optional
        True parameters of a synthetic recording.
    truth_labels : WorldLabels, optional
        Names in the world of a synthetic recording.
    metadata : mapping, optional
        Other information: text, numbers and truth values by name.
    overwrite : bool, default False
        Whether an existing file may be replaced.
    codec : Codec or str, default "blosc"
        Compression. Programs without HDF5's Blosc filter read ``"gzip"``.

    Raises
    ------
    AmiwarpError
        If the path has another extension, cannot be written, is being read, or exists without ``overwrite``; or if
        events are unsorted or outside the frame.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> with amiwarp.RecordingWriter("short.h5", width=4, height=4) as writer:
    ...     writer.append(events)
    >>> len(amiwarp.open_recording("short.h5").events)
    2
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        width: int,
        height: int,
        camera: Camera | None = None,
        prism: NominalPrism | None = None,
        encoder: Encoder | None = None,
        truth_parameters: Mapping[str, float] | None = None,
        truth_labels: WorldLabels | None = None,
        metadata: Mapping[str, MetadataValue] | None = None,
        overwrite: bool = False,
        codec: Codec | str = Codec.BLOSC,
    ) -> None:
        self.path, self._overwrite = Path(path), overwrite
        check_native(self.path)
        self._codec = choice(Codec, codec, f"{self.path}: codec")
        check_frame(self.path, width, height, camera)
        self._size = (int(width), int(height))
        self._camera, self._prism, self._encoder = camera, prism, encoder
        self._truth_parameters, self._truth_labels = truth_parameters, truth_labels
        self._metadata = dict(metadata or {})
        self._chunks: Any = None
        self._open = False
        self._datasets: dict[str, Any] = {}
        self._given: dict[str, tuple[str, ...]] = {}  # names that all calls must give: of datasets, bodies and joints
        self._turns = itertools.count()
        self._new: NewFile | None = None
        self._pending: Columns = {}
        self._written = self._pending_count = 0
        self._columns: dict[str, np.dtype[Any]] = {}
        self._t_offset = self._next_ms = self._ms_count = 0
        self._t_last: int | None = None
        self._ms: list[NDArray[np.int64]] = []

    def __len__(self) -> int:
        return self._written + self._pending_count

    def __enter__(self) -> RecordingWriter:
        self._new = NewFile(self.path, overwrite=self._overwrite)
        try:
            with errors_name(self.path, lambda: "making the file"):
                self._chunks = ChunkFile(self._new.part)
                self._open = True
                write_header(self._chunks.hdf5, self._size, self._camera, self._prism, self._metadata)
                self._write_truth_header()
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None or self._new is None:
            self._discard()
            return
        try:
            with errors_name(self.path, lambda: f"finishing after {len(self)} events"):
                self._finish()
                self._close()
                self._new.commit()
        except BaseException:
            self._discard()
            raise

    def append(
        self,
        events: Events,
        *,
        truth_points: ArrayLike | None = None,
        truth: EventTruth | None = None,
        inside: ArrayLike | None = None,
        extrapolated: ArrayLike | None = None,
    ) -> None:
        """Append events. All calls must give the same optional arrays.

        Parameters
        ----------
        events : Events
            The events, not earlier than those before.
        truth_points : array_like, optional
            Pixels of the scene points without the prism [px], shape (n, 2).
        truth : EventTruth, optional
            All ground truth of the events, the scene points included; then ``truth_points`` is not used.
        inside : array_like, optional
            For compensated events: whether each lies inside the image, shape (n,). Required if coordinates are NaN.
        extrapolated : array_like, optional
            For compensated events: whether the prism angle was extrapolated beyond the encoder's samples, shape (n,).

        Raises
        ------
        AmiwarpError
            If events are unsorted or outside the frame, or the arrays differ from those of the first call.
        """
        self._check_open()
        self._check(events, len(self), allow_nan=inside is not None, after_t=self._t_last)
        if not len(events):
            return
        with errors_name(self.path, lambda: f"after {len(self)} events"):
            known = truth or EventTruth(points=None if truth_points is None else np.asarray(truth_points, np.float32))
            columns = event_columns(events, known, inside=inside, extrapolated=extrapolated)
            dtypes = {name: column.dtype for name, column in columns.items()}
            if not len(self):
                self._columns = dtypes
                self._t_offset = int(events.t[0])
            elif dtypes != self._columns:
                given, before = (", ".join(f"{n} {dtype}" for n, dtype in c.items()) for c in (dtypes, self._columns))
                raise AmiwarpError(f"events come with {given}, those before with {before}; give the same arrays")
            self._index(events.t, len(self))
            columns["events/t"] = events.t - self._t_offset
            self._store(columns, len(events))

    def fill(
        self,
        pieces: Iterable[Callable[[], FlaggedEvents]],
        *,
        count: int,
        t_first: int,
        done: Callable[[Events, NDArray[np.uint8]], None],
    ) -> None:
        """Write a whole recording of compensated events, with pieces computed and written in parallel on all cores.

        Parameters
        ----------
        pieces : iterable of callable
            Functions that return events, their ``inside`` flags, and encoded chunks of columns by name, in order.
            Threads call them. If the codec is Blosc, encoded chunks are stored unchanged; the rest is encoded. If times
            and polarities are both encoded, they are not checked, nor are positions whose flag is 1.
        count : int
            Number of events of each piece: a whole number of chunks. Only the last piece may be shorter.
        t_first : int
            Time of the first event [us].
        done : callable
            Called with each written piece, in order and in the calling thread.

        Raises
        ------
        AmiwarpError
            If other events were written before, or events are unsorted or outside the frame.
        """
        self._check_open()
        if len(self) or count % CHUNK:
            given = f"fill() was called after {len(self)} events, for pieces of {count}"
            raise AmiwarpError(f"{self.path}: {given}; call it before append(), for a multiple of {CHUNK}")
        self._t_offset = t_first
        jobs = (partial(self._write_piece, piece, k * count, next(self._turns)) for k, piece in enumerate(pieces))
        with self._results(jobs) as written:
            for events, inside in written:
                with errors_name(self.path, lambda: f"after {len(self)} events"):
                    if self._written % count:
                        raise AmiwarpError(f"a piece before the last ends within a chunk; give {count} events each")
                    self._written += len(events)
                done(events, inside)

    def _write_piece(
        self, piece: Callable[[], FlaggedEvents], start: int, turn: int
    ) -> tuple[Events, NDArray[np.uint8]]:
        """Compute, encode and write a piece whose first event is event ``start``. Runs in a thread."""
        with self._chunks.stopping(turn):
            if not callable(piece):
                raise AmiwarpError(f"{self.path}: a piece is {shown(piece)}; expected a function")
            events, inside, known = piece()
            known = known if self._codec is Codec.BLOSC else {}
            with errors_name(self.path, lambda: f"after {start} events"):
                self._check_piece(events, inside, start, known)
                # only the size of an encoded column counts
                t = events.t if "events/t" in known else events.t - self._t_offset
                columns = {"events/x": events.x, "events/y": events.y, "events/t": t}
                columns |= {"events/p": events.p, "events/inside": inside}
                chunks: list[EncodedChunk] = []
                for name, column in columns.items():
                    stored: Sequence[Sequence[bytes]] = [(part,) for part in known.get(name, ())]
                    if len(stored) * CHUNK < len(column):
                        stored = hdf5_files.encode_parts(column, self._codec)
                    chunks += EncodedChunk.of(name, start, column, stored)
                self._chunks.write(turn, chunks, self._dataset_of, lambda: self._follow(events, start))
        return events, inside

    def _check_piece(self, events: Events, inside: NDArray[np.uint8], start: int, known: Collection[str]) -> None:
        """Check a piece. The reader has checked encoded times and polarities. A position whose flag is 1 is finite."""
        outside = np.flatnonzero(inside == 0)
        if not {"events/t", "events/p"}.issubset(known):
            self._check(events, start, allow_nan=True)
        elif events.whole_pixels or np.isinf(events.x[outside]).any() or np.isinf(events.y[outside]).any():
            checks.check_coordinates(events, *self._size, where=str(self.path), first_index=start, allow_nan=True)

    def _follow(self, events: Events, start: int) -> None:
        """Check that a piece is not earlier than the one before, and extend the index. Called in turn."""
        self._check(events[:1], start, allow_nan=True, after_t=self._t_last)
        self._index(events.t, start)

    def _check(self, events: Events, first_index: int, **how: Any) -> None:
        checks.check_events(events, *self._size, where=str(self.path), first_index=first_index, **how)

    def append_frame(self, frame: FrameTruth) -> None:
        """Append the ground truth of an instant.

        Parameters
        ----------
        frame : FrameTruth
            Ground truth of all pixels, at a later time than the frame before. All frames have the same joints.
        """
        with self._appending(lambda: f"truth of the instant {frame.t_us} us"):
            maps: Columns = {}
            for name, (dtype, tail) in MAPS.items():
                values, expected = np.asarray(getattr(frame, name), dtype), (*self._size[::-1], *tail)
                if values.shape != expected:
                    what = f"{name} of the instant {frame.t_us} us has shape {values.shape}"
                    raise AmiwarpError(f"{self.path}: {what}; expected {expected}")
                maps[f"truth/frames/{name}"] = values[None]
            pose = ground_truth.as_poses(frame.rotation, frame.position)[None]
            rows = {"truth/frames/t": np.array([frame.t_us], np.int64), "truth/frames/pose": pose}
            joints = {name: at[None] for name, at in frame.joints.items()}
            self._append(rows, maps, {"truth/joints/names": ("truth/frames/joints", joints)})

    def append_known(self, t_us: int, mask: NDArray[np.bool_]) -> None:
        """Append a mask of the pixels whose scene is known.

        Parameters
        ----------
        t_us : int
            Time from which the mask holds [us], later than that of the mask before.
        mask : numpy.ndarray
            Whether the scene at each pixel without the prism is known, shape ``(height, width)``.
        """
        with self._appending(lambda: f"mask at {t_us} us"):
            if mask.shape != self._size[::-1]:
                what = f"mask at {t_us} us has shape {mask.shape}"
                raise AmiwarpError(f"{self.path}: {what}; expected {self._size[::-1]}")
            if mask.dtype != np.bool_:
                raise AmiwarpError(f"{self.path}: mask at {t_us} us is {mask.dtype}; give truth values (bool)")
            rows = {"truth/known/t": np.array([t_us], np.int64)}
            self._append(rows, {"truth/known/mask": np.asarray(mask, np.uint8)[None]})

    def append_poses(self, poses: Poses) -> None:
        """Append true poses of camera, bodies and joints.

        Parameters
        ----------
        poses : Poses
            Poses at later times than those before, of the same bodies and joints.
        """
        with self._appending(lambda: "true poses"):
            rows = {"truth/poses/t": np.asarray(poses.t, np.int64)}
            rows["truth/poses/camera"] = np.asarray(poses.camera, np.float64)
            named = {listed: (table, getattr(poses, what)) for what, (listed, table, _) in POSE_TABLES.items()}
            if len(poses):
                self._append(rows, named=named)

    def append_imu(self, samples: ImuSamples) -> None:
        """Append samples of an inertial measurement unit.

        Parameters
        ----------
        samples : ImuSamples
            Samples, not earlier than those before.
        """
        with self._appending(lambda: "IMU samples"):
            self._append({f"imu/{name}": getattr(samples, name) for name in ("t", "angular_velocity", "acceleration")})

    def append_image(self, t_us: int, image: NDArray[Any]) -> None:
        """Append a frame.

        Parameters
        ----------
        t_us : int
            Time of the frame [us], not earlier than that of the frame before.
        image : numpy.ndarray
            Grey levels, uint8 or uint16, shape ``(height, width)``, as those of the frames before.
        """
        with self._appending(lambda: f"frame at {t_us} us"):
            stored = self._datasets.get("frames/image")
            shape, dtype = (image.shape, image.dtype) if stored is None else (stored.shape[1:], stored.dtype)
            try:
                checks.check_image(image, shape, dtype)
            except AmiwarpError as error:
                raise AmiwarpError(f"{self.path}: {error}") from error
            self._append({"frames/t": np.array([t_us], np.int64)}, {"frames/image": image[None]})

    @contextlib.contextmanager
    def _appending(self, place: Callable[[], str]) -> Iterator[None]:
        """Name the file and the place in errors, also in that of a writer that is not open and that of a full disk."""
        with errors_name(self.path, place):
            self._check_open()
            yield
            self._chunks.check()

    def _append(
        self,
        rows: Columns,
        images: Columns | None = None,
        named: Mapping[str, tuple[str, Mapping[str, NDArray[np.float64]]]] | None = None,
    ) -> None:
        """Append records to their datasets, of which the first holds the times [us].

        ``images`` are stored in chunks of one row. ``named`` are arrays by name, which are stored side by side in a
        dataset, if there are any: by the dataset of the names, that of the values and the arrays. Records that are
        refused leave the file as it was.
        """
        times, *_ = rows
        names: dict[str, tuple[str, ...]] = {}
        for where, (name, arrays) in (named or {}).items():
            if arrays:
                names[where] = tuple(arrays)
                rows[name] = np.stack(list(arrays.values()), axis=1).astype(np.float64)
        columns = rows | (images or {})
        self._check_later(times, rows[times])
        given = {times: tuple(columns), **names}
        for where, found in given.items():
            before = self._given.get(where, found)
            if found != before:
                change = f"{where} comes with {shown(found)}, before with {shown(before)}"
                raise AmiwarpError(f"{self.path}: {change}; append the same in each call")
        for name, values in columns.items():
            if name.startswith("truth/"):
                check_truth(name, values)
            row = self._datasets[name].shape[1:] if name in self._datasets else values.shape[1:]
            if values.shape[1:] != row:
                raise AmiwarpError(f"{self.path}: rows of {name} have shape {values.shape[1:]}; expected {row}")
        for where, found in names.items():
            if where not in self._given:
                self._write_names(where, found)
        self._given |= given
        for name, values in columns.items():
            self._extend(name, values, ROWS if name in rows else 1)

    def _check_later(self, name: str, t: NDArray[np.int64]) -> None:
        """Raise :class:`AmiwarpError` if times [us] do not follow the last time in a dataset.

        Only times of the ground truth must be later.
        """
        stored = self._datasets.get(name)
        if stored is not None and len(stored) and len(t) and t[0] < int(stored[-1]) + name.startswith("truth/"):
            raise AmiwarpError(
                f"{self.path}: {name} {t[0]} us does not follow {int(stored[-1])} us; append in order of time"
            )

    def _write_names(self, name: str, names: tuple[str, ...]) -> None:
        """Write names to a dataset of UTF-8 strings."""
        import h5py

        encoded = [text.encode("utf-8", "replace") for text in names]
        kind = h5py.string_dtype("utf-8", max([1, *(len(text) for text in encoded)]))
        self._chunks.hdf5.create_dataset(name, data=np.array(encoded, kind))

    def _write_truth_header(self) -> None:
        """Write the true parameters of a simulation, and the names of a world's instances and their classes."""
        if self._truth_parameters is not None:
            group = self._chunks.hdf5.create_group("truth")
            for name, value in self._truth_parameters.items():
                group.attrs[name] = float(value)
        if self._truth_labels is not None:
            self._chunks.hdf5.require_group("truth/world").attrs["name"] = self._truth_labels.name
            for what in ("instances", "categories"):
                self._write_names(f"truth/world/{what}", getattr(self._truth_labels, what))

    def _dataset(self, name: str, dtype: np.dtype[Any], row: tuple[int, ...] = (), chunk_rows: int = CHUNK) -> Any:
        """Return a dataset, which is created at the first call."""
        if name not in self._datasets:
            self._datasets[name] = hdf5_files.make_dataset(self._chunks.hdf5, name, dtype, row, chunk_rows, self._codec)
        return self._datasets[name]

    def _extend(self, name: str, values: NDArray[Any], chunk_rows: int = CHUNK) -> None:
        """Append rows to a dataset through HDF5."""
        dataset = self._dataset(name, values.dtype, values.shape[1:], chunk_rows)
        start = dataset.shape[0]
        dataset.resize(start + len(values), axis=0)
        dataset[start:] = values

    def _check_open(self) -> None:
        if not self._open:
            given = "the writer is used outside its 'with' block, before or after it, or after it failed"
            raise AmiwarpError(f"{self.path}: {given}; append inside the block of a new writer")

    @contextlib.contextmanager
    def _results(self, jobs: Iterable[Callable[[], Result]]) -> Iterator[Iterator[Result]]:
        """Run jobs that write chunks, and give their results in order. After an error the writer cannot go on."""
        try:
            with contextlib.closing(in_order(jobs)) as results:
                yield results
        except BaseException:
            self._open = False
            raise

    def set_encoder(self, encoder: Encoder) -> None:
        """Set or replace the encoder, which is written at the end.

        Parameters
        ----------
        encoder : Encoder
            The encoder.

        Raises
        ------
        AmiwarpError
            If the file is finished.
        """
        if self._new is not None:
            self._check_open()
        self._encoder = encoder

    def _index(self, t: NDArray[np.int64], start: int) -> None:
        """Extend the index ms_to_idx by the events from event ``start`` on.

        Its entry m is the index of the first event at or after m milliseconds.
        """
        for entries in ms_entries(t, self._t_offset, self._next_ms, start):
            self._ms.append(entries)
            self._ms_count += entries.size
            self._next_ms += entries.size
            self._write_index(CHUNK)
        self._t_last = int(t[-1])

    def _write_index(self, least: int) -> None:
        if self._ms_count >= least:
            self._extend("ms_to_idx", np.concatenate(self._ms))
            self._ms, self._ms_count = [], 0

    def _store(self, columns: Columns, count: int) -> None:
        """Write the chunks that are full with new events, and keep the other events."""
        full: list[Columns] = []
        start = 0
        while start < count:
            stop = min(start + CHUNK - self._pending_count, count)
            part = {name: column[start:stop] for name, column in columns.items()}
            if stop - start < CHUNK:
                part = self._pending = filled(self._pending, self._pending_count, part)
            self._pending_count = (self._pending_count + stop - start) % CHUNK
            full += [] if self._pending_count else [part]
            start = stop
        if full:
            self._write(full)

    def _write(self, chunks: Sequence[Columns]) -> None:
        """Write chunks of events, of which only the last of a recording is not full. Each is compressed once."""
        jobs = (
            partial(self._write_chunk, name, self._written + k * CHUNK, chunk[name], next(self._turns))
            for name in chunks[0]
            for k, chunk in enumerate(chunks)
        )
        with self._results(jobs) as written:
            deque(written, maxlen=0)
        self._written += sum(len(chunk["events/t"]) for chunk in chunks)

    def _write_chunk(self, name: str, start: int, values: NDArray[Any], turn: int) -> None:
        """Encode and write the values of a chunk that begins at element ``start``. Runs in a thread."""
        with self._chunks.stopping(turn):
            chunks = EncodedChunk.of(name, start, values, hdf5_files.encode_parts(values, self._codec))
            self._chunks.write(turn, chunks, self._dataset_of)

    def _dataset_of(self, chunk: EncodedChunk) -> Any:
        return self._dataset(chunk.name, chunk.values.dtype, chunk.values.shape[1:])

    def _finish(self) -> None:
        self._check_open()
        if self._pending_count:
            self._write([{name: column[: self._pending_count] for name, column in self._pending.items()}])
            self._pending_count = 0
        self._ms.append(np.array([len(self)], np.int64))
        self._write_index(0)
        for name, dtype in EVENTS.items():
            self._extend(f"events/{name}", np.zeros(0, self._columns.get(f"events/{name}", np.dtype(dtype))))
        self._chunks.hdf5["t_offset"] = np.int64(self._t_offset)
        if self._encoder is not None:
            group = self._chunks.hdf5.create_group("encoder")
            group.attrs["clock_offset_us"] = float(self._encoder.clock_offset_us)
            for name, values in encoder_columns(self._encoder).items():
                self._extend(name, values)

    def _close(self) -> None:
        self._open = False
        if self._chunks is not None:
            self._chunks.close()
        self._datasets, self._given = {}, {}

    def _discard(self) -> None:
        # The file is removed even if it cannot be closed.
        with contextlib.suppress(Exception):
            self._close()
        if self._new is not None:
            self._new.discard()


# Writer of HDF5 files with the layout of DSEC: events/x, y, t, p, t_offset and ms_to_idx, and no other dataset.
#
# DSEC's files do not hold the sensor size. It is added as attributes, which DSEC's programs ignore.

DSEC = EVENTS | {"t": np.uint32}
"""Types of DSEC's datasets."""


def write_dsec(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events, one chunk of each dataset at a time."""
    with contextlib.closing(ChunkFile(part, libver=None)) as chunks:
        file = chunks.hdf5
        file.attrs["width"], file.attrs["height"] = about.width, about.height
        file["t_offset"] = np.int64(about.t_first)
        create = partial(hdf5_files.make_dataset, file, codec=about.codec)
        datasets = {name: create(f"events/{name}", dtype) for name, dtype in DSEC.items()}
        index = [np.zeros(0, np.int64)]
        written = ms = 0
        for events in regroup(blocks, count=CHUNK):
            for entries in ms_entries(events.t, about.t_first, ms, written):
                index.append(entries)
                ms += entries.size
            columns = {"x": events.x, "y": events.y, "t": events.t - about.t_first, "p": events.p}
            for name, dtype in DSEC.items():
                hdf5_files.append_values(datasets[name], written, columns[name].astype(dtype), about.codec)
            written += len(events)
            chunks.check()
        stored = create("ms_to_idx", np.uint64)
        found = np.concatenate(index).astype(np.uint64)
        for start in range(0, ms, CHUNK):
            hdf5_files.append_values(stored, start, found[start : start + CHUNK], about.codec)


# Copy of a recording into a native file.

POSE_BLOCK = 1 << 16
"""Number of poses that are copied at a time."""


def write_recording(
    path: str | os.PathLike[str], recording: Recording, size: tuple[int, int], *,
    codec: Codec = Codec.BLOSC, progress: Progress | None = None, overwrite: bool = False,
) -> None:  # fmt: skip
    """Write a recording to a native file. ``size`` is that of the image [px]."""
    truth = recording.truth
    parameters, labels = (None, None) if truth is None else (truth.parameters, truth.labels)
    with RecordingWriter(
        path, width=size[0], height=size[1], camera=recording.camera, prism=recording.prism, encoder=recording.encoder,
        metadata=recording.metadata, overwrite=overwrite, codec=codec,
        truth_parameters=parameters, truth_labels=labels,
    ) as writer:  # fmt: skip
        _copy_events(recording, writer, size, progress)
        copy_records(recording, writer)
        if recording.frames is not None:
            for index, t in enumerate(recording.frames.t.tolist()):
                writer.append_image(t, recording.frames[index])


def _copy_events(
    recording: Recording, writer: RecordingWriter, size: tuple[int, int], progress: Progress | None
) -> None:
    """Append all events of a recording to a writer, with their ground truth and flags.

    ``size`` is that of the image [px]. Flags that a source of compensated events does not have follow from it.
    """
    source, truth = recording.events, recording.truth
    flags = {name: getattr(source, name, None) for name in FLAGS}
    start = 0
    for block in source.blocks():
        stop = start + len(block)
        known = None if truth is None else truth.of_events(start, stop)
        marks = {name: None if flag is None else flag(start, stop) for name, flag in flags.items()}
        if marks["inside"] is None and not block.whole_pixels:
            marks["inside"] = checks.inside_image(block.x, block.y, *size)
        writer.append(block, truth=known, **marks)
        start = stop
        if progress is not None:
            progress("writing events", start / len(source))


def copy_records(recording: Recording, writer: RecordingWriter) -> None:
    """Append to a writer a recording's IMU samples, ground truth of instants, masks of known pixels, and poses."""
    truth = recording.truth
    if recording.imu is not None:
        writer.append_imu(recording.imu)
    if truth is None:
        return
    if truth.known is not None:
        for index, t in enumerate(truth.known.t.tolist()):
            writer.append_known(t, truth.known[index])
    if truth.frames is not None:
        for index in range(len(truth.frames.t)):
            writer.append_frame(truth.frames[index])
    if truth.poses is not None:
        for start in range(0, len(truth.poses), POSE_BLOCK):
            writer.append_poses(truth.poses[start : start + POSE_BLOCK])


@guarded
def save_recording(path: str | os.PathLike[str], recording: Recording, *, overwrite: bool = False) -> None:
    """Write a recording to a native HDF5 file.

    Parameters
    ----------
    path : str or path-like
        The file to write, which ends in ``.h5`` or ``.hdf5``. :func:`convert` writes other formats.
    recording : Recording
        The recording.
    overwrite : bool, default False
        Whether an existing file may be replaced.

    Raises
    ------
    AmiwarpError
        If the path has another extension, cannot be written, is being read, or exists without ``overwrite``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> amiwarp.save_recording("short.h5", recording)
    """
    write_recording(path, recording, recording.events.size, overwrite=overwrite)


# Writer of a live recording, which stays readable at any time and loses at most its last second in a crash.
#
# HDF5's single-writer mode orders all writes so that the file is consistent after each. The last chunk is usually not
# full. Every flush writes it again at another place, so that the version which a reader or a crashed file refers to
# stays intact. HDF5 fails badly on a full disk, so the space to finish the file is reserved before events are accepted.
# The file gets its name after that mode has begun: HDF5 cannot open a file whose creation was cut off.

SMALL_CHUNK = 4096
"""Number of elements per chunk of the small datasets. They are not compressed, so that they grow in place."""

END_ADDRESS_OFFSET = 28
"""Offset of the end-of-file address in an HDF5 file's header [bytes]. Bytes after that address are unused."""

FINISH_BYTES = 1 << 19
"""Disk space that is reserved to finish a file in addition to its data [bytes]: for HDF5's structures and partial
chunks."""

MOST_WAITING = 1 << 24
"""Largest amount of encoder samples that wait for the next flush [bytes]. More samples are written immediately."""

MOST_PULSES = 1 << 16
"""Largest number of index pulses that wait for encoder samples. If there are more, the oldest are dropped."""

MAX_WASTE_BYTES = 1 << 24
"""Largest size of superseded chunks in a finished file [bytes]. With more, the file is copied without these chunks."""


class LiveWriter:
    """Writer that streams a live recording into ``NAME.part.h5`` next to ``path``, and renames it to ``path``.

    The file is finished and renamed in every case: after an exception and on a full disk it keeps the events appended
    so far, and the error gives their number. Only if there are neither events nor encoder samples at an exception, such
    as that of a second output, no file is left. ``compensated`` recordings hold float32 coordinates and flags.
    Recordings of a pair of prisms or of a mirror have two ``encoders``. All events are in the file after ``flush_s``
    [s] at the latest, if :meth:`append` or :meth:`tick` is called that often. Use it in one thread.

    Raises :class:`AmiwarpError` for a path that does not end in .h5 or .hdf5, cannot be written or exists (unless
    ``overwrite``), for an existing part file, and for events that are unsorted or outside the frame. After bad events
    the recording can continue.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        width: int,
        height: int,
        camera: Camera | None = None,
        prism: NominalPrism | None = None,
        metadata: Mapping[str, MetadataValue] | None = None,
        compensated: bool = False,
        encoders: int = 1,
        clock_offset_us: float = 0.0,
        flush_s: float = 0.5,
        overwrite: bool = False,
    ) -> None:
        """Prepare the writer. The times of written encoder samples are shifted by ``clock_offset_us``."""
        self.path, self._overwrite = Path(path), overwrite
        check_native(self.path)
        check_frame(self.path, width, height, camera)
        self.part = self.path.resolve().with_name(f"{self.path.stem}.part.h5")
        self._size = (int(width), int(height))
        self._camera, self._prism, self._metadata = camera, prism, dict(metadata or {})
        self._compensated, self._flush_s, self._clock_offset_us = compensated, flush_s, clock_offset_us
        self._file: Any = None
        self._columns: dict[str, Any] = {}
        self._small: dict[str, _GrowingDataset] = {}
        self._pending: Columns = {}
        self._pending_count = 0
        self._written = 0  # number of events in full chunks
        self._stored = 0  # number of events in the file, including those of the last, partial chunk
        self._flushed_at = 0.0  # [s], monotonic
        self._reserved = 0  # [bytes]
        self._t_offset = 0
        self._t_last: int | None = None
        self._next_ms = 0
        self._names = ENCODERS[:encoders]
        self._spans: dict[str, tuple[int, int]] = {}  # times of the first and the last sample of each encoder [us]
        self._pulses = np.zeros(0, np.int64)  # index pulses later than the last encoder sample
        self._encoder: Encoder | None = None

    def __len__(self) -> int:
        return self._written + self._pending_count

    def __enter__(self) -> LiveWriter:
        import h5py

        check_output(self.path, overwrite=self._overwrite)
        if os.path.lexists(self.part):
            raise self._part_exists()
        new = NewFile(self.part)
        try:
            try:
                with open(new.part, "xb") as file:
                    allocate(file.fileno(), 0, self._to_finish())
            except OSError as error:
                what = f"cannot be created: {error.strerror}; choose another place"
                raise AmiwarpError(f"{self.path}: {what}") from error
            with errors_name(self.path, lambda: "making the file"):
                self._file = h5py.File(new.part, "w", libver=("v110", "v110"))
                self._allocate()
                self._create_datasets()
                self._file.swmr_mode = True
                self._file.flush()
                try:
                    link_new(new.part, self.part)
                except FileExistsError as error:
                    raise self._part_exists() from error
        except BaseException:
            self._close()
            raise
        finally:
            new.discard()
        self._flushed_at = time.monotonic()
        return self

    def _part_exists(self) -> AmiwarpError:
        what = "is being written, or was left by an interrupted recording; it can be opened like any recording"
        return AmiwarpError(f"{self.part}: {what}; rename or delete this file")

    def _create_datasets(self) -> None:
        """Create all datasets, because none can be added in single-writer mode."""
        file = self._file
        write_header(file, self._size, self._camera, self._prism, self._metadata)
        dtypes: dict[str, Any] = {name: EVENTS[name] for name in "xypt"}
        if self._compensated:
            dtypes |= dict.fromkeys("xy", np.float32) | dict.fromkeys(FLAGS, np.uint8)
        self._columns = {
            f"events/{name}": hdf5_files.make_dataset(file, f"events/{name}", dtype) for name, dtype in dtypes.items()
        }
        file["t_offset"] = np.int64(0)
        small: dict[str, Any] = {"ms_to_idx": np.int64, "encoder/index_t": np.int64}
        for name in self._names:
            small |= {f"{name}t": np.int64, f"{name}angle": np.float64}
        for name, kind in small.items():
            dataset = file.create_dataset(name, shape=(0,), maxshape=(None,), chunks=(SMALL_CHUNK,), dtype=kind)
            self._small[name] = _GrowingDataset(dataset)
        file["encoder"].attrs["clock_offset_us"] = self._clock_offset_us

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is None:  # writing failed before, and the file is finished
            return
        if error is not None and not len(self) and not self._spans:  # nothing arrived before the error
            self._close()
            self.part.unlink()
            return
        self._finish(tidy=True)
        if error is not None:
            error.add_note(f"{self.path}: holds the {len(self)} events before the error")

    def append(self, events: Events, *, inside: ArrayLike | None = None, extrapolated: ArrayLike | None = None) -> None:
        """Append events. Compensated events need the flags ``inside`` and may have ``extrapolated``, shape ``(n,)``."""
        self._check_open("append")
        with errors_name(self.path, lambda: f"after {len(self)} events"):
            columns = self._as_columns(events, inside, extrapolated)
            checks.check_events(events, *self._size, where=str(self.path), first_index=len(self),
                                allow_nan=self._compensated, after_t=self._t_last)  # fmt: skip
            if len(events) and not len(self):
                self._file["t_offset"][()] = self._t_offset = int(events.t[0])
            columns["events/t"] = events.t
            start = 0
            while start < len(events):
                self._reserve()
                stop = min(start + CHUNK - self._pending_count, len(events))
                self._accept({name: column[start:stop] for name, column in columns.items()})
                start = stop
        self.tick()

    def _accept(self, columns: Columns) -> None:
        """Add events to the current chunk, and write it if it is full."""
        t = columns["events/t"]
        for entries in ms_entries(t, self._t_offset, self._next_ms, len(self)):
            self._small["ms_to_idx"].add(entries)
            self._next_ms += entries.size
        new = {**columns, "events/t": t - self._t_offset}
        self._pending = filled(self._pending, self._pending_count, new)
        self._pending_count += t.size
        self._t_last = int(t[-1])
        if self._pending_count == CHUNK:
            self._write()

    def append_encoder(
        self, t_us: ArrayLike, angle: ArrayLike, index_t_us: ArrayLike = (), *, second: bool = False
    ) -> None:
        """Append encoder samples: times on the events' clock [us], unwrapped angles [rad], and index pulses [us].

        ``second``: whether the samples are those of the second encoder, whose index pulses are not stored. Pulses
        before the first sample are dropped. Raises :class:`AmiwarpError` for samples that are not later than those
        before, or not finite.
        """
        self._check_open("append_encoder")
        name = self._names[second]
        offset = round(self._clock_offset_us)
        t, angles = np.atleast_1d(as_times(t_us)) + offset, np.atleast_1d(np.array(angle, np.float64))
        if t.shape != angles.shape or t.ndim != 1 or not np.isfinite(angles).all():
            shapes = f"t {t.shape}, angle {angles.shape}"
            raise AmiwarpError(
                f"{self.path}: encoder samples have shapes {shapes}; expected one length and finite angles"
            )
        if t.size:
            first, last = self._spans.get(name, (int(t[0]), int(t[0]) - 1))
            if t[0] <= last or (t[1:] <= t[:-1]).any():
                raise AmiwarpError(
                    f"{self.path}: encoder samples {t[0]} .. {t[-1]} us do not follow {last} us; append samples in "
                    "order of time"
                )
            self._reserve(2 * t.nbytes)
            self._small[f"{name}t"].add(t)
            self._small[f"{name}angle"].add(angles)
            self._spans[name] = first, int(t[-1])
        if not second and name in self._spans:
            first, last = self._spans[name]
            pulses = np.append(self._pulses, as_times(index_t_us) + offset)
            self._small["encoder/index_t"].add(pulses[(pulses >= first) & (pulses <= last)])
            self._pulses = pulses[pulses > last][-MOST_PULSES:]
        if self._waiting_bytes() > MOST_WAITING:
            with errors_name(self.path, lambda: f"after {len(self)} events"):
                self._flush()
        self.tick()

    def set_encoder(self, encoder: Encoder) -> None:
        """Set the encoder data that the finished file holds instead of the appended encoder samples.

        Raises :class:`AmiwarpError` outside the ``with`` block, and for another number of encoders than the writer has.
        """
        self._check_open("set_encoder")
        given = 1 if encoder.second is None else 2
        if given != len(self._names):
            raise AmiwarpError(f"{self.path}: the encoder has {given} prisms; make the writer with encoders={given}")
        self._encoder = encoder

    def tick(self) -> None:
        """Flush if the flush interval has passed. Call this method while no events arrive."""
        if self._file is not None and time.monotonic() - self._flushed_at >= self._flush_s:
            with errors_name(self.path, lambda: f"after {len(self)} events"):
                self._flush()

    def _check_open(self, what: str) -> None:
        if self._file is None:
            given = f"{what}() was called outside the writer's 'with' block, or after it failed"
            raise AmiwarpError(f"{self.path}: {given}; use a new writer")

    def _as_columns(self, events: Events, inside: ArrayLike | None, extrapolated: ArrayLike | None) -> Columns:
        if len(events) and events.x.dtype != self._columns["events/x"].dtype:
            wanted = self._columns["events/x"].dtype
            raise AmiwarpError(f"{self.path}: events come with {events.x.dtype} coordinates; expected {wanted}")
        if (inside is not None) != self._compensated or (extrapolated is not None and not self._compensated):
            raise AmiwarpError(
                f"{self.path}: compensated events need the flags inside, events from a sensor take no flags"
            )
        if self._compensated and extrapolated is None:
            extrapolated = np.zeros(len(events))
        return event_columns(events, EventTruth(), inside=inside, extrapolated=extrapolated)

    def _to_finish(self) -> int:
        """Return the space that finishing the file may take [bytes]: one whole chunk and the waiting samples."""
        event = 19 if self._compensated else 13
        return FINISH_BYTES + event * CHUNK + event * CHUNK // 64 + self._waiting_bytes()

    def _waiting_bytes(self) -> int:
        return sum(small.waiting_bytes for small in self._small.values())

    def _reserve(self, extra: int = 0) -> None:
        """Reserve disk space to finish the file, and ``extra`` bytes.

        If the disk is full, finish the file and raise :class:`AmiwarpError`.
        """
        try:
            self._allocate(extra)
        except OSError as error:
            self._finish(tidy=False)
            what = f"{error.strerror} after {len(self)} events, which the file holds"
            raise AmiwarpError(f"{self.path}: {what}; make room, or write to another disk") from error

    def _allocate(self, extra: int = 0) -> None:
        """Reserve disk space to finish the file, and ``extra`` bytes. Raises OSError if the disk is full."""
        end = self._file.id.get_filesize() + self._to_finish() + extra
        if end > self._reserved:
            allocate(self._file.id.get_vfd_handle(), self._reserved, end - self._reserved)
            self._reserved = end

    def _write(self) -> None:
        """Write the pending events of the current chunk. Start a new chunk if the chunk is full."""
        count = self._pending_count
        with contextlib.closing(
            in_order(partial(hdf5_files.encode, column[:count]) for column in self._pending.values())
        ) as encoded:
            for name, stored in zip(self._pending, encoded, strict=True):
                hdf5_files.append_chunk(self._columns[name], self._written, stored, count)
        self._stored = self._written + count
        if count == CHUNK:  # one statement, so that Ctrl-C cannot interrupt it halfway
            self._written, self._pending_count = self._stored, 0

    def _flush(self) -> None:
        if self._stored < len(self):
            self._write()
        for small in self._small.values():
            small.write()
        self._file.flush()
        self._flushed_at = time.monotonic()

    def _finish(self, *, tidy: bool) -> None:
        """Write the remaining data and rename the part file to ``path``.

        If the part file has many superseded chunks, it is copied to ``path`` without them instead.
        """
        with errors_name(self.path, lambda: f"finishing after {len(self)} events; {self.part} holds all but the last"):
            for name, (first, last) in self._spans.items():
                if first == last:  # a single sample, which gives no angle, and which readers refuse
                    for column in ("t", "angle"):
                        self._small[name + column].replace(np.zeros(0))
            if tidy and self._encoder is not None:
                self._replace_encoder(self._encoder)
            self._small["ms_to_idx"].add(np.array([len(self)], np.int64))
            self._flush()
            stored = sum(int(dataset.id.get_storage_size()) for dataset in self._columns.values())
            stored += sum(small.stored_bytes for small in self._small.values())
            self._close()
            with open(self.part, "r+b") as file:
                file.seek(END_ADDRESS_OFFSET)
                file.truncate(int.from_bytes(file.read(8), "little"))
            if tidy and os.path.getsize(self.part) > 2 * stored + MAX_WASTE_BYTES:
                with contextlib.suppress(AmiwarpError):  # if the disk is full, the part itself is renamed
                    tidied = dataclasses.replace(open_hdf5(self.part, None, GivenLayout()), metadata=self._metadata)
                    save_recording(self.path, tidied, overwrite=self._overwrite)
                    self.part.unlink()
                    return
            put_in_place(self.part, self.path, overwrite=self._overwrite)

    def _replace_encoder(self, encoder: Encoder) -> None:
        columns = {"encoder/index_t": np.zeros(0, np.int64), **encoder_columns(encoder)}
        self._reserve(2 * sum(values.nbytes for values in columns.values()))
        self._file["encoder"].attrs["clock_offset_us"] = float(encoder.clock_offset_us)
        for name, values in columns.items():
            self._small[name].replace(values)

    def _close(self) -> None:
        file, self._file = self._file, None
        self._columns, self._small = {}, {}
        if file is not None:
            file.close()


class _GrowingDataset:
    """Small dataset whose new values wait in memory until they are written."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._waiting: list[NDArray[Any]] = []
        self._written = 0
        self.waiting_bytes = 0

    def add(self, values: NDArray[Any]) -> None:
        self._waiting.append(values)
        self.waiting_bytes += values.nbytes

    def replace(self, values: NDArray[Any]) -> None:
        self._waiting, self._written, self.waiting_bytes = [values], 0, values.nbytes

    @property
    def stored_bytes(self) -> int:
        return int(self._dataset.id.get_storage_size())

    def write(self) -> None:
        if self._waiting:
            values = np.concatenate(self._waiting)
            end = self._written + values.size
            self._dataset.resize(end, axis=0)
            self._dataset[self._written : end] = values
            self._waiting, self._written, self.waiting_bytes = [], end, 0
