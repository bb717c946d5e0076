"""Reader of the ground truth in native recordings, which reads events, instants and poses on demand.

``docs/reference/recording-format.md`` describes the format.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import rounded_times
from amiwarp.events.recording import Truth
from amiwarp.events.truth import MAPS, EventValues, FrameTruth, Poses, WorldLabels, check_truth, rotation_of
from amiwarp.io.camera_attributes import attribute
from amiwarp.io.hdf5 import Column, Hdf5File
from amiwarp.io.input_files import errors_name
from amiwarp.io.truth_writer import EVENT_COLUMNS

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
