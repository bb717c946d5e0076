"""Part of the reader of HDF5, MATLAB and Parquet files of any layout that runs in the reading process.

It finds the arrays that hold events, and sends their values. :mod:`amiwarp.io.columns.search` decides what they mean.
"""

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.columns.layout import SAMPLE
from amiwarp.io.columns.matlab import matlab_arrays
from amiwarp.io.columns.names import ROLES, example_of_columns, is_wanted, names_roles, roles_of
from amiwarp.io.columns.options import given_roles
from amiwarp.io.columns.parquet import parquet_arrays
from amiwarp.io.reading_server import Reply

PIECE = 1 << 17
"""Number of events that are read at once."""

MOST_COLUMNS = 16
"""Largest number of columns of a table of events."""


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
            blocks[key] = np.asarray(self._block(start, stop))
        block = blocks[key]
        if isinstance(self.part, str):
            block = block[self.part]
        elif self.part is not None:
            block = block[:, self.part] if self.axis == 0 else block[self.part]
        return np.ascontiguousarray(block).reshape(-1)

    def _block(self, start: int, stop: int) -> Any:
        """Return the values of all columns of the array."""
        if self.axis == 0:
            return self.array[start:stop]
        return self.array[:, start:stop]


def sources_of(arrays: Mapping[str, Any], columns: str | None) -> list[Source]:
    """Return the columns among the arrays of a file that hold the events.

    ``columns`` is the option ``--columns``. Raises :class:`AmiwarpError` in doubt.
    """
    vectors: list[Source] = []
    tables = {}
    for name, array in arrays.items():
        vectors += _vectors(name, array)
        if _is_table(array):
            tables[name] = _table(array)
    if columns is not None:
        wanted = given_roles(columns).values()
        named = [source for source in vectors if is_wanted(str(source.name), wanted)]
        if len({source.name for source in named}) == len(ROLES):
            return named

    groups = _groups_of_events(vectors)
    for sets in (groups, tables):
        if len(sets) == 1:
            return next(iter(sets.values()))
        if "events" in sets:
            return sets["events"]
        if sets:
            first = next(iter(sets))
            example = example_of_columns(str(source.name) for source in groups.get(first, []))
            listed = ", ".join(name or "the root" for name in list(sets)[:20])
            raise AmiwarpError(
                f"holds several sets of columns with events: {listed}; choose with --columns, such as {example}",
                ErrorCode.AMBIGUOUS,
            )
    listed = ", ".join(list(arrays)[:20]) or "none"
    raise AmiwarpError(
        f"no arrays are named as t, x, y and p; its arrays are {listed}; choose with --columns, such as "
        + example_of_columns(arrays),
        ErrorCode.AMBIGUOUS,
    )


def _groups_of_events(vectors: list[Source]) -> dict[str, list[Source]]:
    """Return the columns of each group whose columns are named as t, x, y and p."""
    groups: dict[str, list[Source]] = {}
    for source in vectors:
        group, _, _ = str(source.name).rpartition("/")
        groups.setdefault(group, []).append(source)
    of_events = {}
    for group, sources in groups.items():
        if names_roles(str(source.name) for source in sources):
            of_events[group] = sources
    return of_events


def _vectors(name: str, array: Any) -> list[Source]:
    """Return the columns that an array holds by name: itself, or its fields."""
    shape = tuple(array.shape)
    dtype = array.dtype
    if dtype.names is not None:
        if len(shape) != 1:
            return []
        fields = []
        for field in dtype.names:
            kind = dtype.fields[field][0].kind
            if kind in "iufb":
                fields.append(Source(f"{name}/{field}", array, 0, field))
        return fields
    # MATLAB stores a column as a matrix of one row or column.
    is_vector = len(shape) in (1, 2) and math.prod(shape) == max(shape)
    if dtype.kind not in "iufb" or not is_vector:
        return []
    axis = int(np.argmax(shape))
    return [Source(name, array, axis)]


def _is_table(array: Any) -> bool:
    """Return whether an array is a table of numbers with a column or row for each property."""
    shape = tuple(array.shape)
    if len(shape) != 2 or array.dtype.kind not in "iuf":
        return False
    return len(ROLES) <= min(shape) <= MOST_COLUMNS


def _table(array: Any) -> list[Source]:
    """Return the columns of a table of numbers."""
    rows, columns = array.shape
    if columns <= MOST_COLUMNS:
        return [Source(None, array, axis=0, part=column) for column in range(columns)]
    return [Source(None, array, axis=1, part=row) for row in range(rows)]


def head_of(path: str, kind: str, columns: str | None) -> Reply:
    """Return the names and units of a file's columns and its sensor size, and the first values of each column."""
    with _opened(path, kind) as (arrays, about):
        sources = sources_of(arrays, columns)
        _check_alike(sources)
        blocks: dict[int, NDArray[Any]] = {}
        head = [source.read(0, min(source.count, SAMPLE), blocks) for source in sources]
        names = [source.name for source in sources]
        units = [about["units"].get(name) for name in names]
        return {"names": names, "units": units, "size": about["size"]}, head


def _check_alike(sources: list[Source]) -> None:
    """Raise :class:`AmiwarpError` if columns that are named as events differ in length."""
    places_by_role = roles_of([source.name or "" for source in sources])
    named = {place for places in places_by_role.values() for place in places}
    counts = {}
    for place, source in enumerate(sources):
        if source.name is None or place in named:
            counts[source.name] = source.count
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise AmiwarpError(
            f"columns of events differ in length: {listed}; the file is incomplete",
            ErrorCode.FILE_DAMAGED,
        )


def read_columns(
    notes: dict[str, int],
    path: str,
    kind: str,
    columns: str | None,
    chosen: list[int],
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield pieces of the columns with these indices."""
    with _opened(path, kind) as (arrays, _):
        sources = sources_of(arrays, columns)
        used = [sources[number] for number in chosen]
        counts = {source.count for source in used}
        if len(counts) != 1:
            raise AmiwarpError(
                f"the columns have the lengths {sorted(counts)}; expected one length",
                ErrorCode.FILE_DAMAGED,
            )
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
    if kind == "mat":
        yield matlab_arrays(path), {"units": {}, "size": None}
    elif kind == "parquet":
        yield parquet_arrays(path), {"units": {}, "size": None}
    else:
        # HDF5 is loaded only for its own files.
        from amiwarp.io.hdf5.server_columns import open_arrays

        with open_arrays(path) as opened:
            yield opened
