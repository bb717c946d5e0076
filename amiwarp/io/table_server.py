"""Part of the reader of HDF5, MATLAB and Parquet files of any layout that runs in the reading process.

It finds the arrays that hold events, and sends their values. :mod:`amiwarp.io.column_search` decides what they mean.
"""

import contextlib
import importlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.column_names import ROLES, example_of_columns, is_wanted, names_roles, roles_of, unit_of
from amiwarp.io.column_options import given_roles
from amiwarp.io.columns import SAMPLE
from amiwarp.io.reading_process import Reply

PIECE = 1 << 17
"""Number of events that are read at once."""

MOST_COLUMNS = 16
"""Largest number of columns of a table of events."""

MOST_OBJECTS = 2000
"""Largest number of arrays of a file among which events are sought."""


@dataclass(frozen=True)
class Source:
    """Column of a file: an array, a field of an array of records, or a column or row of a table."""

    name: str | None
    """Its name with the groups that it is in; or None."""
    array: Any
    """Array or dataset with the values."""
    axis: int = 0
    """Axis of the events."""
    part: int | str | None = None
    """Index of the column or row, or name of the field."""

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.array.shape[self.axis])

    def read(self, start: int, stop: int, blocks: dict[int, NDArray[Any]]) -> NDArray[Any]:
        """Return the values with ``start <= index < stop``. ``blocks`` keeps what was read of each array."""
        key = id(self.array)
        if key not in blocks:
            blocks[key] = np.asarray(self.array[start:stop] if self.axis == 0 else self.array[:, start:stop])
        block = blocks[key]
        if isinstance(self.part, str):
            block = block[self.part]
        elif self.part is not None:
            block = block[:, self.part] if self.axis == 0 else block[self.part]
        return np.ascontiguousarray(block).reshape(-1)


def sources_of(arrays: Mapping[str, Any], columns: str | None) -> list[Source]:
    """Return the columns among the arrays of a file that hold the events.

    ``columns`` is the option ``--columns``. Raises :class:`AmiwarpError` in doubt.
    """
    vectors = [source for name, array in arrays.items() for source in _vectors(name, array)]
    if columns is not None:
        wanted = given_roles(columns).values()
        named = [source for source in vectors if is_wanted(str(source.name), wanted)]
        if len({source.name for source in named}) == len(ROLES):
            return named
    groups: dict[str, list[Source]] = {}
    for source in vectors:
        groups.setdefault(str(source.name).rpartition("/")[0], []).append(source)
    found = {group: named for group, named in groups.items() if names_roles(str(each.name) for each in named)}
    tables = {name: _table(array) for name, array in arrays.items() if _is_table(array)}
    for kinds in (found, tables):
        if len(kinds) == 1:
            return next(iter(kinds.values()))
        if "events" in kinds:
            return kinds["events"]
        if kinds:
            listed = ", ".join(name or "the root" for name in list(kinds)[:20])
            raise AmiwarpError(
                f"holds several sets of columns with events: {listed}; choose with --columns, such as "
                + example_of_columns(str(source.name) for source in found.get(next(iter(kinds)), []))
            )
    listed = ", ".join(list(arrays)[:20]) or "none"
    raise AmiwarpError(
        f"no arrays are named as t, x, y and p; its arrays are {listed}; choose with --columns, such as "
        + example_of_columns(arrays)
    )


def _vectors(name: str, array: Any) -> list[Source]:
    """Return the columns that an array holds by name: itself, or its fields."""
    shape, dtype = tuple(array.shape), array.dtype
    if dtype.names is not None:
        whole = [each for each in dtype.names if dtype.fields[each][0].kind in "iufb"]
        return [Source(f"{name}/{each}", array, 0, each) for each in whole] if len(shape) == 1 else []
    if dtype.kind not in "iufb" or not shape or math.prod(shape) != max(shape) or len(shape) > 2:
        return []
    return [Source(name, array, int(np.argmax(shape)))]


def _is_table(array: Any) -> bool:
    """Return whether an array is a table of numbers with a column or row for each property."""
    shape = tuple(array.shape)
    return len(shape) == 2 and array.dtype.kind in "iuf" and len(ROLES) <= min(shape) <= MOST_COLUMNS


def _table(array: Any) -> list[Source]:
    """Return the columns of a table of numbers."""
    rows, columns = array.shape
    axis = 0 if columns <= MOST_COLUMNS else 1
    return [Source(None, array, axis, at) for at in range(columns if axis == 0 else rows)]


def head_of(path: str, kind: str, columns: str | None) -> Reply:
    """Return the names and units of a file's columns and its sensor size, and the first values of each column."""
    with _opened(path, kind) as (arrays, about):
        sources = sources_of(arrays, columns)
        _check_alike(sources)
        head: list[NDArray[Any]] = []
        blocks: dict[int, NDArray[Any]] = {}
        for source in sources:
            head.append(source.read(0, min(source.count, SAMPLE), blocks))
        units = [about["units"].get(source.name) for source in sources]
        return {"names": [source.name for source in sources], "units": units, "size": about["size"]}, head


def _check_alike(sources: list[Source]) -> None:
    """Raise :class:`AmiwarpError` if columns that are named as events differ in length."""
    named = {at for places in roles_of([source.name or "" for source in sources]).values() for at in places}
    counts = {source.name: source.count for at, source in enumerate(sources) if source.name is None or at in named}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise AmiwarpError(f"columns of events differ in length: {listed}; the file is incomplete")


def read_columns(
    notes: dict[str, int], path: str, kind: str, columns: str | None, chosen: list[int]
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield pieces of the columns with these indices."""
    with _opened(path, kind) as (arrays, _):
        sources = sources_of(arrays, columns)
        used = [sources[at] for at in chosen]
        counts = {source.count for source in used}
        if len(counts) != 1:
            raise AmiwarpError(f"the columns have the lengths {sorted(counts)}; expected one length")
        count = counts.pop()
        notes["total"] = max(count, 1)
        for start in range(0, count, PIECE):
            stop = min(start + PIECE, count)
            notes["read"] = stop
            blocks: dict[int, NDArray[Any]] = {}
            yield tuple(source.read(start, stop, blocks) for source in used)


@contextlib.contextmanager
def _opened(path: str, kind: str) -> Iterator[tuple[Mapping[str, Any], dict[str, Any]]]:
    """Open a file of the kind "hdf5", "mat" or "parquet", and yield its arrays by name, its units and sensor size."""
    about: dict[str, Any] = {"units": {}, "size": None}
    if kind == "mat":
        yield _matlab_arrays(path), about
    elif kind == "parquet":
        yield _parquet_arrays(path), about
    else:
        import h5py

        server: Any = importlib.import_module("amiwarp.io.hdf5_server")
        with h5py.File(path, "r") as file:
            arrays = dict(_datasets(file, server))
            for name, dataset in arrays.items():
                stated = [
                    str(server.plain_value(dataset.attrs[key])) for key in ("unit", "units") if key in dataset.attrs
                ]
                about["units"][name] = next(filter(None, map(unit_of, stated)), None)
            about["size"] = _hdf5_size(file, server)
            offset = server.member(file, "t_offset")
            if "events/t" in arrays and getattr(offset, "size", 0) == 1 and offset.dtype.kind in "iuf":
                arrays["events/t"] = _LaterTimes(arrays["events/t"], np.ravel(offset[()])[0])
            yield arrays, about


# HDF5.


class _LaterTimes:
    """Times of DSEC's layout, which count from the file's ``t_offset`` in the same unit."""

    def __init__(self, times: Any, offset: Any) -> None:
        self._times, self._offset = times, offset
        whole = times.dtype.kind in "iub" and float(offset).is_integer()
        self.shape, self.dtype = times.shape, np.dtype(np.int64 if whole else np.float64)

    def __getitem__(self, rows: Any) -> NDArray[Any]:
        return np.asarray(self._times[rows]).astype(self.dtype) + self._offset.astype(self.dtype)


def _datasets(file: Any, server: Any) -> Iterator[tuple[str, Any]]:
    """Yield the datasets of a file by name, down to three groups deep. Links and other files are left out."""
    waiting = [("", 0)]
    seen = 0
    while waiting:
        group, depth = waiting.pop(0)
        for key in file[group or "/"]:
            seen += 1
            name = f"{group}/{key}".lstrip("/")
            if key.startswith("#") or seen > MOST_OBJECTS:
                continue
            try:
                found = server.member(file, name)
            except AmiwarpError:  # a link, or values in another file
                continue
            if server.is_dataset(found):
                if found.dtype.kind in "iufbV" and math.prod(found.shape):
                    server.check_stored(found, name, file.filename)
                    yield name, found
            elif found is not None and not hasattr(found, "dtype") and depth < 3:
                waiting.append((name, depth + 1))


def _hdf5_size(file: Any, server: Any) -> list[int] | None:
    """Return the sensor size in a file's attributes (width, height), or None."""
    for group in (file, file.get("events")):
        attributes = getattr(group, "attrs", {})
        if "width" in attributes and "height" in attributes:
            return [int(attributes["width"]), int(attributes["height"])]
        if "sensor_resolution" in attributes:
            sides = np.ravel(attributes["sensor_resolution"])
            if sides.size == 2 and sides.dtype.kind in "iuf":
                return [int(sides.max()), int(sides.min())]  # both orders occur, and no sensor is higher than wide
    return None


# MATLAB.


def _matlab_arrays(path: str) -> dict[str, NDArray[Any]]:
    """Return the numeric arrays of a MATLAB file, with the fields of structures by ``structure/field``."""
    from scipy.io import loadmat

    found: dict[str, NDArray[Any]] = {}

    def collect(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                if not key.startswith("__"):
                    collect(f"{name}/{key}".lstrip("/"), inner)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "iufb" and value.size > 1 and value.ndim <= 2:
            found[name] = value

    collect("", loadmat(path, simplify_cells=True))
    return found


# Parquet.


class _ParquetColumn:
    """Column of a Parquet table. The rows of one group are in memory at a time."""

    def __init__(self, table: Any, bounds: NDArray[np.int64], name: str, dtype: np.dtype[Any]) -> None:
        """``bounds``: the first row of each group, and the number of rows."""
        self._table, self._bounds, self._name = table, bounds, name
        self.shape, self.dtype = (int(bounds[-1]),), dtype
        self._group: tuple[int, NDArray[Any]] | None = None

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        first_group = int(np.searchsorted(self._bounds[1:], rows.start, side="right"))
        last_group = int(np.searchsorted(self._bounds[:-1], rows.stop, side="left"))
        parts = []
        for group in range(first_group, last_group):
            first = int(self._bounds[group])
            parts.append(self._rows(group)[max(rows.start - first, 0) : rows.stop - first])
        return np.concatenate(parts) if parts else np.zeros(0, self.dtype)

    def _rows(self, group: int) -> NDArray[Any]:
        if self._group is None or self._group[0] != group:
            column = self._table.read_row_group(group, columns=[self._name]).column(0)
            values = column.to_numpy()
            if values.dtype.kind in "mM":  # a time or a duration of Arrow
                values = values.astype(values.dtype.str[:2] + "8[ns]").astype(np.int64)
            self._group = group, values
        return self._group[1]


def _parquet_arrays(path: str) -> dict[str, Any]:
    """Return the columns of a Parquet table by name."""
    from amiwarp.errors import optional_module

    parquet: Any = optional_module("pyarrow.parquet", "dataset", "Parquet files need PyArrow")
    table = parquet.ParquetFile(path)
    groups = range(table.metadata.num_row_groups)
    bounds = np.cumsum([0, *(table.metadata.row_group(group).num_rows for group in groups)], dtype=np.int64)
    found = {}
    for field in table.schema_arrow:
        with contextlib.suppress(NotImplementedError):  # columns of text and the like are left out
            dtype = np.dtype(field.type.to_pandas_dtype())
            name = f"{field.name} [ns]" if dtype.kind in "mM" else field.name
            kind = np.dtype(np.int64) if dtype.kind in "mM" else dtype
            if kind.kind in "iufb":
                found[name] = _ParquetColumn(table, bounds, field.name, kind)
    return found
