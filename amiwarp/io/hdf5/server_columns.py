"""Arrays of an HDF5 file of any layout. Runs in the reading process."""

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.columns.names import unit_of
from amiwarp.io.hdf5.server_datasets import check_stored
from amiwarp.io.hdf5.server_objects import is_dataset, member, plain_value

MOST_OBJECTS = 2000
"""Largest number of arrays of a file among which events are sought."""

DEEPEST = 3
"""Largest number of groups that an array is in."""


@contextlib.contextmanager
def open_arrays(path: str) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Open a file, and yield its arrays by name, their units, and the sensor size or None."""
    with h5py.File(path, "r") as file:
        arrays = dict(_datasets(file))
        units = {name: _unit_of(dataset) for name, dataset in arrays.items()}
        offset = member(file, "t_offset")
        has_offset = getattr(offset, "size", 0) == 1 and offset.dtype.kind in "iuf"
        if "events/t" in arrays and has_offset:
            arrays["events/t"] = _LaterTimes(arrays["events/t"], np.ravel(offset[()])[0])
        yield arrays, {"units": units, "size": _sensor_size(file)}


def _datasets(file: h5py.File) -> Iterator[tuple[str, Any]]:
    """Yield the datasets of a file by name. Links and other files are left out."""
    waiting = [("", 0)]
    examined = 0
    while waiting:
        group, depth = waiting.pop(0)
        for key in file[group or "/"]:
            examined += 1
            name = f"{group}/{key}".lstrip("/")
            if key.startswith("#") or examined > MOST_OBJECTS:
                continue
            try:
                item = member(file, name)
            except AmiwarpError:
                # It is a link, or its values are in another file.
                continue
            if is_dataset(item):
                if item.dtype.kind in "iufbV" and math.prod(item.shape):
                    check_stored(item, name, file.filename)
                    yield name, item
            elif isinstance(item, h5py.Group) and depth < DEEPEST:
                waiting.append((name, depth + 1))


def _unit_of(dataset: Any) -> Any:
    """Return the unit that a dataset's attributes state, or None."""
    for key in ("unit", "units"):
        if key in dataset.attrs:
            unit = unit_of(str(plain_value(dataset.attrs[key])))
            if unit:
                return unit
    return None


def _sensor_size(file: h5py.File) -> list[int] | None:
    """Return the sensor size in a file's attributes (width, height), or None."""
    for group in (file, file.get("events")):
        attributes = getattr(group, "attrs", {})
        if "width" in attributes and "height" in attributes:
            return [int(attributes["width"]), int(attributes["height"])]
        if "sensor_resolution" in attributes:
            sides = np.ravel(attributes["sensor_resolution"])
            if sides.size == 2 and sides.dtype.kind in "iuf":
                # Both orders occur, and no sensor is higher than wide.
                return [int(sides.max()), int(sides.min())]
    return None


class _LaterTimes:
    """Times of DSEC's layout, which count from the file's ``t_offset`` in the same unit."""

    def __init__(self, times: Any, offset: Any) -> None:
        self._times = times
        self._offset = offset
        whole = times.dtype.kind in "iub" and float(offset).is_integer()
        self.shape = times.shape
        self.dtype = np.dtype(np.int64 if whole else np.float64)

    def __getitem__(self, rows: Any) -> NDArray[Any]:
        times = np.asarray(self._times[rows]).astype(self.dtype)
        offset = self._offset.astype(self.dtype)
        return times + offset
