"""Reader of the ground truth of native recordings."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.poses import Poses, rotation_of
from amiwarp.events.truth import (
    EVENT_COLUMNS,
    MAPS,
    UNKNOWN_MAPS,
    FrameTruth,
    Truth,
    WorldLabels,
    check_truth,
)
from amiwarp.io.hdf5.file import Column, Hdf5File
from amiwarp.io.inputs import errors_name
from amiwarp.io.native.attributes import attribute
from amiwarp.io.native.layout import POSE_TABLES
from amiwarp.io.native.stored import StoredImages, StoredRows, dataset_of
from amiwarp.validation import rounded_times


def read_truth(path: Path, file: Hdf5File, count: int, size: tuple[int, int]) -> Truth:
    """Return the ground truth of a file with ``count`` events.

    ``size``: width and height of the sensor [px].
    """
    attributes = file.attributes["truth"]
    parameters = {}
    for name in attributes:
        parameters[name] = attribute(attributes, f"{path}: /truth", name, float)
    values = {}
    for name in EVENT_COLUMNS:
        values[name] = _event_values(path, file, name, count)
    return Truth(
        parameters,
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


def _points(path: Path, file: Hdf5File, count: int) -> StoredRows | None:
    """Return the true points of the events, or None if they are not stored."""
    if "truth/x" not in file.columns:
        return None
    column_x = dataset_of(file, "truth/x", count)
    column_y = dataset_of(file, "truth/y", count)

    def read(start: int, stop: int) -> NDArray[np.float32]:
        x = _read_as(column_x, np.float32, start, stop)
        y = _read_as(column_y, np.float32, start, stop)
        return np.stack([x, y], axis=1)

    return StoredRows(path, "truth", count, read, file)


def _event_values(path: Path, file: Hdf5File, name: str, count: int) -> StoredRows | None:
    """Return the values of the dataset ``truth/events/name``, or None if the dataset is missing."""
    stored = f"truth/events/{name}"
    if stored not in file.columns:
        return None
    dtype, row = EVENT_COLUMNS[name]
    column = dataset_of(file, stored, count, row)
    read = partial(_read_as, column, dtype)
    return StoredRows(path, stored, count, read, file)


def _read_as(column: Column, dtype: Any, start: int, stop: int) -> NDArray[Any]:
    """Read rows of a dataset as ``dtype``.

    Raises :class:`AmiwarpError` for integers that do not fit, and for values without meaning.
    """
    values = column.read(start, stop)
    check_truth(column.name, values)
    may_not_fit = values.dtype.kind in "iu" and not np.can_cast(values.dtype, dtype)
    if may_not_fit and values.size:
        limits = np.iinfo(dtype)
        if values.min() < limits.min or values.max() > limits.max:
            raise AmiwarpError(
                f"holds numbers outside of {limits.min} .. {limits.max}; the file is damaged",
                ErrorCode.FILE_DAMAGED,
            )
    return values.astype(dtype, copy=False)


def _labels(path: Path, file: Hdf5File) -> WorldLabels | None:
    """Return the names and classes of the instances, or None if they are not stored."""
    if "truth/world/instances" not in file.columns:
        return None
    world = file.attributes.get("truth/world", {})
    name = attribute(world, f"{path}: /truth/world", "name", str, "")
    instances = _names(file, "truth/world/instances")
    categories = _names(file, "truth/world/categories") or ("",) * len(instances)
    with errors_name(path, lambda: "truth/world"):
        return WorldLabels(name, instances, categories)


def _names(file: Hdf5File, name: str) -> tuple[str, ...]:
    """Return the names in a dataset; an empty tuple if the dataset is missing."""
    column = file.columns.get(name)
    if column is None:
        return ()
    texts = column.read(0, len(column)).tolist()
    return tuple(bytes(text).decode("utf-8", "replace") for text in texts)


def _rising_times(path: Path, file: Hdf5File, name: str) -> NDArray[np.int64]:
    """Return the times of a dataset [us]. Raises :class:`AmiwarpError` if they do not rise."""
    column = file.columns[name]
    times = rounded_times(column.read(0, len(column)))
    if (np.diff(times) <= 0).any():
        raise AmiwarpError(
            f"{path}: {name} does not increase; the file is damaged",
            ErrorCode.FILE_DAMAGED,
        )
    return times


def _frames(path: Path, file: Hdf5File, size: tuple[int, int]) -> StoredImages | None:
    """Return the ground truth of all pixels at several instants, or None if it is not stored."""
    if "truth/frames/t" not in file.columns:
        return None
    t = _rising_times(path, file, "truth/frames/t")
    count = len(t)
    width, height = size
    maps = {}
    for name, (_, tail) in MAPS.items():
        row = (height, width, *tail)
        if name in UNKNOWN_MAPS and f"truth/frames/{name}" not in file.columns:
            continue
        maps[name] = dataset_of(file, f"truth/frames/{name}", count, row)
    poses = dataset_of(file, "truth/frames/pose", count, (7,))
    names = _names(file, "truth/joints/names")
    joints = None
    if names:
        joints = dataset_of(file, "truth/frames/joints", count, (len(names), 3))

    def read(index: int) -> FrameTruth:
        values = {}
        for name, (dtype, tail) in MAPS.items():
            if name in maps:
                values[name] = _read_as(maps[name], dtype, index, index + 1)[0]
            else:
                values[name] = np.full((height, width, *tail), UNKNOWN_MAPS[name], dtype)
        pose = _read_as(poses, np.float64, index, index + 1)[0]
        joint_places = {}
        if joints is not None:
            places = _read_as(joints, np.float64, index, index + 1)[0]
            joint_places = dict(zip(names, places, strict=True))
        return FrameTruth(
            t_us=int(t[index]),
            **values,
            rotation=rotation_of(pose),
            position=pose[:3],
            joints=joint_places,
        )

    return StoredImages(path, "truth/frames", t, size, read, file)


def _masks(path: Path, file: Hdf5File, size: tuple[int, int]) -> StoredImages | None:
    """Return the masks of known pixels, or None if they are not stored."""
    if "truth/known/t" not in file.columns:
        return None
    t = _rising_times(path, file, "truth/known/t")
    width, height = size
    masks = dataset_of(file, "truth/known/mask", len(t), (height, width))

    def read(index: int) -> NDArray[np.bool_]:
        (mask,) = masks.read(index, index + 1)
        return np.asarray(mask != 0)

    return StoredImages(path, "truth/known", t, size, read, file)


def _poses(path: Path, file: Hdf5File) -> StoredRows | None:
    """Return the poses of camera, bodies and joints, or None if they are not stored."""
    if "truth/poses/t" not in file.columns:
        return None
    t = file.columns["truth/poses/t"]
    count = len(t)
    camera = dataset_of(file, "truth/poses/camera", count, (7,))
    tables = {}
    for what, (listed, table, width) in POSE_TABLES.items():
        names = _names(file, listed)
        if names and table in file.columns:
            column = dataset_of(file, table, count, (len(names), width))
            tables[what] = names, column

    def read(start: int, stop: int) -> Poses:
        by_name = {}
        for what, (names, column) in tables.items():
            values = _read_as(column, np.float64, start, stop)
            of_names = np.moveaxis(values, 1, 0)
            by_name[what] = dict(zip(names, of_names, strict=True))
        return Poses(
            rounded_times(t.read(start, stop)),
            _read_as(camera, np.float64, start, stop),
            **by_name,
        )

    return StoredRows(path, "truth/poses", count, read, file)
