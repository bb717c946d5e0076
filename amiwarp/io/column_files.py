"""Files of plain columns other than text: NumPy arrays (.npy, .npz), HDF5, MATLAB and Parquet.

Each reader finds the columns of its file, and :func:`open_table` decides what they mean, see
:mod:`amiwarp.io.column_search`.
HDF5, MATLAB and Parquet files are read in the reading process.
"""

from __future__ import annotations

import contextlib
import math
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.io.column_names import ROLES, example_of_columns, is_wanted, names_roles, role_of
from amiwarp.io.column_options import GivenLayout, given_roles
from amiwarp.io.column_search import find_layout
from amiwarp.io.column_units import check_duration
from amiwarp.io.columns import SAMPLE, Column, Hints, Layout
from amiwarp.io.file_scan import SENSORS, FileEvents, Packet
from amiwarp.io.files import errors_name, input_path, open_input
from amiwarp.io.plain_files import Array, array_header, is_of_kind, lengths, next_rows, open_any_array, open_array

Pieces: TypeAlias = Callable[[tuple[int, ...], dict[str, int]], Iterator[tuple[NDArray[Any], ...]]]
"""Function that yields pieces of the columns with these indices, and notes how much of the file it has read."""


@dataclass(frozen=True)
class Table:
    """Columns of a file."""

    columns: Sequence[Column]
    """The columns, with their first values."""
    pieces: Pieces
    """Reader of all values."""
    hints: Hints = field(default_factory=Hints)
    """What the format promises."""
    size: tuple[int, int] | None = None
    """Sensor size (width, height) that the file states [px], or None."""
    metadata: Mapping[str, MetadataValue] = field(default_factory=dict)
    """Further findings for the metadata of the recording."""


def open_table(path: Path, format: str, table: Table, given: GivenLayout) -> Recording:
    """Open the events in the columns of a file."""
    with errors_name(path, lambda: "finding the columns"):
        layout = find_layout(table.columns, given, table.hints)
    sensors = ((320, 320),) if layout.openmv else SENSORS
    events = FileEvents(path, partial(_events, table, layout), size=table.size, sensors=sensors)
    check_table(path, events, layout)
    metadata = {"format": format, **layout.metadata, **table.metadata, **events.metadata}
    return Recording(events=events, metadata=metadata, name=path.stem)


def check_table(path: Path, events: FileEvents, layout: Layout) -> None:
    """Raise :class:`AmiwarpError` if the events make an assumption about their file implausible."""
    with errors_name(path, lambda: "checking the columns"):
        check_duration(layout, round((events.t_last - events.t_first) / events.share))
        if not events.size_is_known and max(events.size) > LARGEST_FRAME:
            width, height = events.size
            raise AmiwarpError(
                f"x and y reach {width - 1} and {height - 1}, more than any sensor has; divide them with --scale-xy, "
                f"or give the size, such as --size {width}x{height}"
            )


LARGEST_FRAME = 4096
"""Largest side of a sensor that is assumed [px]."""


def _events(table: Table, layout: Layout, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a file."""
    for columns in table.pieces(layout.chosen, notes):
        yield layout.events(*columns, notes=notes)


# NumPy arrays: one structured array, one array with a column per property, or one array per property.

KINDS = "iubfV"
"""Kinds of data types of arrays that are read: numbers, truth values, and records."""

Opened: TypeAlias = Callable[[contextlib.ExitStack], tuple[Array, bool]]
"""Function that opens an array at its beginning, and returns whether it is stored by columns, too."""


def open_npy(path: Path, given: GivenLayout) -> Recording:
    """Open a ``.npy`` file: a structured array, or an array with four columns or rows."""

    def opened(stack: contextlib.ExitStack) -> tuple[Array, bool]:
        stream = stack.enter_context(open_input(path))
        return array_header(stream, "the array", path.stat().st_size, KINDS)

    with errors_name(path, lambda: "reading the array"):
        table = _array_table(opened, "the array", Hints())
    return open_table(path, "npy", table, given)


def open_npz(path: Path, given: GivenLayout) -> Recording:
    """Open an archive of events.

    Arrays are read in pieces, and read again for each use if they are too large to keep in memory.
    """
    with errors_name(path, lambda: "reading width and height"), zipfile.ZipFile(input_path(path)) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        size = None
        if {"width", "height"} <= set(names):
            size = (_number(archive, "width"), _number(archive, "height"))
    with errors_name(path, lambda: "reading the arrays"):
        table = _npz_table(path, names, given)
    return open_table(path, "npz", replace(table, size=size), given)


def _number(archive: zipfile.ZipFile, name: str) -> int:
    """Return the single number in an array of the archive."""
    with open_array(archive, name) as (stream, shape, dtype):
        if math.prod(shape) != 1:
            raise AmiwarpError(f"{name} has shape {shape}; expected one number")
        return int(np.frombuffer(stream.read(dtype.itemsize), dtype)[0])


WHOLE_EVENTS = ("event_data", "events", "arr_0")
"""Names of arrays that hold all properties of the events: those of N-ImageNet, of EV-IMO, and of ``numpy.savez``."""


def _npz_table(path: Path, names: Sequence[str], given: GivenLayout) -> Table:
    """Return the columns of an archive."""

    def opened(name: str, stack: contextlib.ExitStack) -> tuple[Array, bool]:
        archive = stack.enter_context(zipfile.ZipFile(input_path(path)))
        return stack.enter_context(open_any_array(archive, name, KINDS))

    wanted = () if given.columns is None else tuple(given_roles(given.columns).values())
    named = names_roles(names)
    if given.columns is None and set(ROLES) <= set(names):
        return _own_table(opened, {"width", "height"} <= set(names))
    whole = [name for name in WHOLE_EVENTS if name in names] or (list(names) if len(names) == 1 else [])
    arrays_are_wanted = all(any(is_wanted(name, [each]) for name in names) for each in wanted)
    several_by_option = given.columns is not None and len(names) >= len(ROLES) and (arrays_are_wanted or not whole)
    if named or several_by_option:
        return _arrays_table(_readable(path, names, wanted), opened)
    if not whole:
        missing = ", ".join(name for name in "xytp" if name not in names)
        listed = ", ".join(names)[:300] or "none"
        raise AmiwarpError(
            f"{path}: is a ZIP archive without x, y, t and p: no array {missing}; its arrays are {listed}; choose with "
            f"--columns, such as {example_of_columns(names)}"
        )
    promised = Hints(order=ROLES, fractions="s") if whole[0] == "events" else Hints()
    return _array_table(partial(opened, whole[0]), f"array {whole[0]}", promised)


def _readable(path: Path, names: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """Return the names of an archive's arrays without those of text or objects, unless events are expected there."""
    with zipfile.ZipFile(input_path(path)) as archive:
        return [
            name
            for name in names
            if role_of(name)[0] is not None or is_wanted(name, wanted) or is_of_kind(archive, name, KINDS)
        ]


OpenedByName: TypeAlias = Callable[[str, contextlib.ExitStack], tuple[Array, bool]]
"""Function that opens an array of an archive, as :data:`Opened`."""


def _own_table(opened: OpenedByName, has_size: bool) -> Table:
    """Return the arrays x, y, t, p, as amiwarp writes them, always with a size: integer times are in us."""
    table = _arrays_table("xytp", opened)
    types = {str(column.name): column.values.dtype for column in table.columns}
    if (types["x"].kind == "f") != (types["y"].kind == "f"):
        given = f"array x is {types['x']}, y is {types['y']}"
        raise AmiwarpError(f"{given}; expected integers, or floating numbers for compensated events")
    unit = "us" if types["t"].kind in "iub" else None
    return replace(table, hints=Hints(unit=unit, compensated=True, is_own=has_size))


def _arrays_table(names: Sequence[str], opened: OpenedByName) -> Table:
    """Return the columns of arrays with one value per event. Other arrays are left out."""
    columns = []
    counts: dict[str, int] = {}
    for name in names:
        with contextlib.ExitStack() as stack:
            array, _ = opened(name, stack)
            _, shape, dtype = array
            if len(shape) == 1 and dtype.names is None:
                columns.append(Column(name, next_rows(array, min(shape[0], SAMPLE))))
                counts[name] = shape[0]
            elif role_of(name)[0] is not None:
                raise AmiwarpError(f"array {name} has shape {shape}; expected one length (n,)")

    def pieces(chosen: tuple[int, ...], notes: dict[str, int]) -> Iterator[tuple[NDArray[Any], ...]]:
        used = [str(columns[at].name) for at in chosen]
        for name in used[1:]:
            if counts[name] != counts[used[0]]:
                shapes = f"array {name} has shape ({counts[name]},), {used[0]} ({counts[used[0]]},)"
                raise AmiwarpError(f"{shapes}; expected one length (n,)")
        with contextlib.ExitStack() as stack:
            arrays = [opened(name, stack)[0] for name in used]
            for length in lengths(counts[used[0]], notes):
                yield tuple(next_rows(array, length) for array in arrays)

    return Table(columns, pieces)


def _array_table(opened: Opened, name: str, hints: Hints) -> Table:
    """Return the columns of one array: the fields of a structured array, or the columns or rows of a table."""
    with contextlib.ExitStack() as stack:
        array, by_columns = opened(stack)
        _, shape, dtype = array
        if dtype.names is not None:
            return _fields_table(array, opened, name)
    if len(shape) != 2 or dtype.kind not in "iuf" or min(shape) > MOST_COLUMNS:
        raise AmiwarpError(f"{name} is {dtype} of shape {shape}; expected a table (n, 4) of t, x, y and p, or fields")
    one_row_each = shape[1] <= MOST_COLUMNS
    count, width = shape if one_row_each else shape[::-1]
    # The values of an event follow one another, unless the table is stored by columns or has a row per property.
    events_in_order = one_row_each != by_columns

    def pieces(chosen: tuple[int, ...], notes: dict[str, int]) -> Iterator[tuple[NDArray[Any], ...]]:
        with contextlib.ExitStack() as stack:
            if events_in_order:
                stream = opened(stack)[0][0]
                for length in lengths(count, notes):
                    rows = next_rows((stream, (count, width), dtype), length)
                    yield tuple(np.ascontiguousarray(rows[:, at]) for at in chosen)
                return
            columns = [_column_of(opened(stack)[0], at, count) for at in chosen]
            for length in lengths(count, notes):
                yield tuple(next_rows(column, length) for column in columns)

    first = next(pieces(tuple(range(width)), {}), None)
    columns = [np.zeros(0)] * width if first is None else [values[:SAMPLE] for values in first]
    return Table([Column(None, values) for values in columns], pieces, hints)


MOST_COLUMNS = 16
"""Largest number of columns of a table of events. A table with more columns has a row per property."""


def _column_of(array: Array, at: int, count: int) -> Array:
    """Return a column of an array that is stored by columns. It needs a stream of its own."""
    stream, _, dtype = array
    stream.seek(at * count * dtype.itemsize, 1)
    return stream, (count,), dtype


def _fields_table(array: Array, opened: Opened, name: str) -> Table:
    """Return the columns of a structured array. Integer times named t are in us, as in data sets with such files."""
    _, shape, dtype = array
    if len(shape) != 1:
        raise AmiwarpError(f"{name} is {dtype} of shape {shape}; expected fields t, x, y, p of shape (n,)")
    rows = next_rows(array, min(shape[0], SAMPLE))
    names = [each for each in dtype.names or () if rows[each].ndim == 1]
    columns = [Column(each, rows[each].copy()) for each in names]

    def pieces(chosen: tuple[int, ...], notes: dict[str, int]) -> Iterator[tuple[NDArray[Any], ...]]:
        with contextlib.ExitStack() as stack:
            array, _ = opened(stack)
            for length in lengths(shape[0], notes):
                rows = next_rows(array, length)
                yield tuple(rows[names[at]] for at in chosen)

    promised = any(column.name == "t" and column.values.dtype.kind in "iu" for column in columns)
    return Table(columns, pieces, Hints(unit="us" if promised else None))
