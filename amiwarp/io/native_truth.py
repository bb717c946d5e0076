"""Ground truth in native recordings: writer and reader of events' truth, instants and poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import rounded_times
from amiwarp.events.recording import Truth
from amiwarp.events.truth import (
    MAPS,
    EventTruth,
    EventValues,
    FrameTruth,
    Poses,
    WorldLabels,
    as_poses,
    check_truth,
    rotation_of,
)
from amiwarp.io.camera_files import attribute
from amiwarp.io.chunks import Codec
from amiwarp.io.hdf5 import Column, Hdf5File
from amiwarp.io.input_files import errors_name
from amiwarp.io.native_layout import ROWS, Columns, RowWriter

# Writer of a simulated world's ground truth into native recordings: of each event, of chosen instants, and poses.
#
# ``docs/reference/recording-format.md`` describes the format.

EVENT_COLUMNS: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "cause": (np.uint8, ()),
    "instance": (np.uint16, ()),
    "depth": (np.float32, ()),
    "place": (np.float32, (3,)),
}
"""Names of the datasets in ``truth/events``, with the data type and the shape of a row."""


def event_columns(truth: EventTruth, count: int) -> Columns:
    """Return the ground truth of ``count`` events as datasets.

    Raises :class:`AmiwarpError` for arrays of another length or shape, and for values without meaning.
    """
    columns: Columns = {}
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
        check_truth(name, values)
    return columns


class TruthWriter(RowWriter):
    """Writer of labels, instants and poses into an open HDF5 file.

    All instants must have the same joints. All tables of poses must have the same bodies and joints.
    """

    def __init__(self, file: Any, path: Path, size: tuple[int, int], codec: Codec) -> None:
        """Set up the writer; ``size`` is the width and height of the sensor [px]."""
        super().__init__(file, path, codec)
        self._size = size
        self._names: dict[str, tuple[str, ...]] = {}

    def write_header(self, parameters: Mapping[str, float] | None, labels: WorldLabels | None) -> None:
        """Write the true parameters of a simulation, and the names of a world's instances and their classes."""
        if parameters is not None:
            group = self._file.create_group("truth")
            for name, value in parameters.items():
                group.attrs[name] = float(value)
        if labels is None:
            return
        self._file.require_group("truth/world").attrs["name"] = labels.name
        self._write_names("truth/world/instances", labels.instances)
        self._write_names("truth/world/categories", labels.categories)

    def append_frame(self, frame: FrameTruth) -> None:
        """Append the ground truth of an instant, which must be later than the previous instants."""
        width, height = self._size
        rows: dict[str, NDArray[Any]] = {}
        for name, (dtype, tail) in MAPS.items():
            rows[name] = np.asarray(getattr(frame, name), dtype)
            if rows[name].shape != (height, width, *tail):
                raise AmiwarpError(
                    f"{self._path}: {name} of the instant {frame.t_us} us has shape {rows[name].shape}; "
                    f"expected {(height, width, *tail)}"
                )
        self._check_later("truth/frames/t", frame.t_us)
        self._append("truth/frames/t", np.array([frame.t_us], np.int64), ROWS)
        self._append("truth/frames/pose", as_poses(frame.rotation, frame.position)[None], ROWS)
        self._append_joints("truth/frames/joints", {name: at[None] for name, at in frame.joints.items()})
        for name, values in rows.items():
            self._append(f"truth/frames/{name}", values[None], 1)

    def append_poses(self, poses: Poses) -> None:
        """Append a table of poses, which must be later than the previous poses."""
        if not len(poses):
            return
        self._check_later("truth/poses/t", int(poses.t[0]))
        self._append("truth/poses/t", np.asarray(poses.t, np.int64), ROWS)
        self._append("truth/poses/camera", np.asarray(poses.camera, np.float64), ROWS)
        self._append_joints("truth/joints/position", poses.joints)
        if poses.bodies:
            self._keep_names("truth/poses/body_names", poses.bodies)
            self._append("truth/poses/bodies", np.stack(list(poses.bodies.values()), axis=1), ROWS)

    def append_known(self, t_us: int, mask: NDArray[np.bool_]) -> None:
        """Append a mask of known pixels, which holds from a time later than those before."""
        width, height = self._size
        if mask.shape != (height, width):
            raise AmiwarpError(f"{self._path}: mask at {t_us} us has shape {mask.shape}; expected {(height, width)}")
        self._check_later("truth/known/t", t_us)
        self._append("truth/known/t", np.array([t_us], np.int64), ROWS)
        self._append("truth/known/mask", np.asarray(mask, np.uint8)[None], 1)

    def _append(self, name: str, values: NDArray[Any], chunk_rows: int) -> None:
        check_truth(name, values)
        super()._append(name, values, chunk_rows)

    def _append_joints(self, name: str, joints: Mapping[str, NDArray[np.float64]]) -> None:
        """Append the positions of joints [m], shape (k, 3) each, to the dataset ``name``."""
        if joints:
            self._keep_names("truth/joints/names", joints)
            self._append(name, np.stack(list(joints.values()), axis=1).astype(np.float64), ROWS)

    def _keep_names(self, name: str, given: Iterable[str]) -> None:
        """Write the names at the first call, and check that later calls give the same names."""
        names = tuple(given)
        if name not in self._names:
            self._names[name] = names
            self._write_names(name, names)
        elif self._names[name] != names:
            raise AmiwarpError(f"{self._path}: {name} changed between calls; give the same names in the same order")

    def _write_names(self, name: str, names: tuple[str, ...]) -> None:
        """Write names to a dataset of UTF-8 strings."""
        import h5py

        encoded = [text.encode("utf-8", "replace") for text in names]
        kind = h5py.string_dtype("utf-8", max([1, *(len(text) for text in encoded)]))
        self._file.create_dataset(name, data=np.array(encoded, kind))


# Reader of the ground truth in native recordings, which reads events, instants and poses on demand.
#
# ``docs/reference/recording-format.md`` describes the format.

Read = Callable[[int, int], NDArray[Any]]
"""Function that returns the rows of a dataset from ``start`` up to ``stop`` (excluded)."""


def read_truth(path: Path, file: Hdf5File, count: int, size: tuple[int, int]) -> Truth:
    """Return the ground truth of a file with ``count`` events.

    ``size``: width and height of the sensor [px].
    """
    attributes = file.attributes("truth") or {}
    values = {name: _event_values(path, file, name, count) for name in EVENT_COLUMNS}
    return Truth(
        {name: attribute(attributes, f"{path}: /truth", name, float) for name in attributes},
        stored_points=_points(path, file, count),
        stored_causes=values["cause"],
        stored_instances=values["instance"],
        stored_depths=values["depth"],
        stored_places=values["place"],
        labels=_labels(path, file),
        frames=_StoredFrames(path, file, size) if "truth/frames/t" in file.columns else None,
        poses=_StoredPoses(path, file) if "truth/poses/t" in file.columns else None,
        known=_StoredMasks(path, file, size) if "truth/known/t" in file.columns else None,
    )


class _StoredRows:
    """Rows of a dataset, or of several datasets side by side, that are read on demand."""

    def __init__(self, path: Path, name: str, count: int, read: Read, file: Hdf5File) -> None:
        self._path, self._name, self._count, self._read = path, name, count, read
        self._file = file  # keeps the file open: the columns hold only a weak reference to the file

    def __getitem__(self, which: slice, /) -> NDArray[Any]:
        start, stop, _ = which.indices(self._count)
        with errors_name(self._path, lambda: f"{self._name} {which.start} .. {which.stop}"):
            return self._read(start, max(start, stop))


def _points(path: Path, file: Hdf5File, count: int) -> _StoredRows | None:
    """Return the true points of the events, or None if they are not stored."""
    if "truth/x" not in file.columns:
        return None
    x, y = (_column(file, f"truth/{name}") for name in ("x", "y"))
    if len(x) != count or len(y) != count:
        raise AmiwarpError(
            f"{path}: truth/x and truth/y have {len(x)} and {len(y)} rows for {count} events; the file is damaged"
        )
    return _StoredRows(path, "truth", count, partial(_read_points, x, y), file)


def _read_points(x: Column, y: Column, start: int, stop: int) -> NDArray[np.float32]:
    """Return rows of two datasets as points [px], shape (n, 2)."""
    return np.stack([_read_as(column, np.float32, start, stop) for column in (x, y)], axis=1)


def _event_values(path: Path, file: Hdf5File, name: str, count: int) -> EventValues | None:
    """Return the values of the dataset ``truth/events/name``, or None if the dataset is missing."""
    column = file.columns.get(f"truth/events/{name}")
    if column is None:
        return None
    dtype, row = EVENT_COLUMNS[name]
    if len(column) != count or column.row != row:
        shape = (len(column), *column.row)
        raise AmiwarpError(
            f"{path}: truth/events/{name} has shape {shape} for {count} events; expected {(count, *row)}"
        )
    return _StoredRows(path, f"truth/events/{name}", count, partial(_read_as, column, dtype), file)


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
    name = attribute(file.attributes("truth/world") or {}, f"{path}: /truth/world", "name", str, "")
    instances, categories = (_names(file, f"truth/world/{what}") for what in ("instances", "categories"))
    with errors_name(path, lambda: "truth/world"):
        return WorldLabels(name, instances, categories or ("",) * len(instances))


def _names(file: Hdf5File, name: str) -> tuple[str, ...]:
    """Return the names in a dataset; an empty tuple if the dataset is missing."""
    column = file.columns.get(name)
    if column is None:
        return ()
    return tuple(bytes(text).decode("utf-8", "replace") for text in column.read(0, len(column)).tolist())


def _column(file: Hdf5File, name: str, count: int | None = None, row: tuple[int, ...] | None = None) -> Column:
    """Return a dataset; raise :class:`AmiwarpError` if the dataset is missing or does not have the expected shape.

    ``count``: expected number of rows; ``row``: expected shape of a row. None accepts any.
    """
    if name not in file.columns:
        raise AmiwarpError(f"dataset '{name}' is missing; the file is incomplete")
    column = file.columns[name]
    shape = (len(column), *column.row)
    expected = (len(column) if count is None else count, *(column.row if row is None else row))
    if shape != expected:
        raise AmiwarpError(f"dataset '{name}' has shape {shape}; expected {expected}; the file is damaged")
    return column


class _StoredFrames:
    """Ground truth of all pixels at several instants, read from a file on demand."""

    def __init__(self, path: Path, file: Hdf5File, size: tuple[int, int]) -> None:
        self._path, self._file = path, file
        self.t = _rising_times(path, file, "truth/frames/t")
        """Times of the instants [us], shape ``(k,)``."""
        count, (width, height) = len(self.t), size
        self._maps = {
            name: _column(file, f"truth/frames/{name}", count, (height, width, *tail))
            for name, (_, tail) in MAPS.items()
        }
        self._pose = _column(file, "truth/frames/pose", count, (7,))
        self._joint_names = _names(file, "truth/joints/names")
        self._joints = (
            _column(file, "truth/frames/joints", count, (len(self._joint_names), 3)) if self._joint_names else None
        )

    def __getitem__(self, index: int, /) -> FrameTruth:
        at = range(len(self.t))[index]
        with errors_name(self._path, lambda: f"truth/frames {index}"):
            maps = {name: _read_as(self._maps[name], dtype, at, at + 1)[0] for name, (dtype, _) in MAPS.items()}
            pose = _read_as(self._pose, np.float64, at, at + 1)[0]
            joints = np.zeros((0, 3)) if self._joints is None else _read_as(self._joints, np.float64, at, at + 1)[0]
            named = dict(zip(self._joint_names, joints, strict=True))
            return FrameTruth(t_us=int(self.t[at]), **maps, rotation=rotation_of(pose), position=pose[:3], joints=named)


def _rising_times(path: Path, file: Hdf5File, name: str) -> NDArray[np.int64]:
    """Return the times of a dataset [us]. Raises :class:`AmiwarpError` if they do not rise."""
    times = rounded_times(file.columns[name].read(0, len(file.columns[name])))
    if (np.diff(times) <= 0).any():
        raise AmiwarpError(f"{path}: {name} does not increase; the file is damaged")
    return times


class _StoredMasks:
    """Masks of known pixels, read on demand."""

    def __init__(self, path: Path, file: Hdf5File, size: tuple[int, int]) -> None:
        self._path, self._file = path, file
        self.t = _rising_times(path, file, "truth/known/t")
        """Times from which the masks hold [us], shape ``(k,)``."""
        self._masks = _column(file, "truth/known/mask", len(self.t), size[::-1])

    def __getitem__(self, index: int, /) -> NDArray[np.bool_]:
        at = range(len(self.t))[index]
        with errors_name(self._path, lambda: f"truth/known {index}"):
            return self._masks.read(at, at + 1)[0] != 0


class _StoredPoses:
    """Poses of camera, bodies and joints, read from a file on demand."""

    def __init__(self, path: Path, file: Hdf5File) -> None:
        self._path, self._file = path, file
        self._t = file.columns["truth/poses/t"]
        count = len(self._t)
        self._camera = _column(file, "truth/poses/camera", count, (7,))
        self._tables = {
            what: (names, _column(file, table, count, (len(names), width)) if names and table in file.columns else None)
            for what, names, table, width in (
                ("bodies", _names(file, "truth/poses/body_names"), "truth/poses/bodies", 7),
                ("joints", _names(file, "truth/joints/names"), "truth/joints/position", 3),
            )
        }

    def __len__(self) -> int:
        return len(self._t)

    def __getitem__(self, which: slice, /) -> Poses:
        start, stop, _ = which.indices(len(self))
        stop = max(start, stop)
        with errors_name(self._path, lambda: f"truth/poses {start} .. {stop}"):
            tables = {
                what: {} if column is None else dict(
                    zip(names, np.moveaxis(_read_as(column, np.float64, start, stop), 1, 0), strict=True)
                )
                for what, (names, column) in self._tables.items()
            }  # fmt: skip
            camera = _read_as(self._camera, np.float64, start, stop)
            return Poses(rounded_times(self._t.read(start, stop)), camera, **tables)
