"""NumPy files of events of any layout: a structured array, an array with a column per property, or one array each."""

from __future__ import annotations

import contextlib
import math
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io.columns.layout import SAMPLE, Column, Hints
from amiwarp.io.columns.names import ROLES, example_of_columns, is_wanted, names_roles, role_of
from amiwarp.io.columns.options import GivenLayout, given_roles
from amiwarp.io.columns.table import Table, open_table
from amiwarp.io.inputs import errors_name, input_path, open_input
from amiwarp.io.numpy_arrays import (
    Array,
    array_header,
    is_of_kind,
    lengths,
    next_rows,
    open_any_array,
    open_array,
)

KINDS = "iubfV"
"""Kinds of data types of arrays that are read: numbers, truth values, and records."""

Opened: TypeAlias = Callable[[contextlib.ExitStack], tuple[Array, bool]]
"""Function that opens an array at its beginning, and returns whether it is stored by columns, too."""

Rows: TypeAlias = Iterator[tuple[NDArray[Any], ...]]
"""Pieces of some columns, one after the other."""

MOST_COLUMNS = 16
"""Largest number of columns of a table of events. A table with more columns has a row per property."""

WHOLE_EVENTS = ("event_data", "events", "arr_0")
"""Names of arrays that hold all properties of the events, in N-ImageNet, in EV-IMO, and by ``numpy.savez``."""

OpenedByName: TypeAlias = Callable[[str, contextlib.ExitStack], tuple[Array, bool]]
"""Function that opens an array of an archive, as :data:`Opened`."""


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
    with (
        errors_name(path, lambda: "reading width and height"),
        zipfile.ZipFile(input_path(path)) as archive,
    ):
        names = []
        for member in archive.namelist():
            if member.endswith(".npy"):
                names.append(member.removesuffix(".npy"))
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
            raise AmiwarpError(
                f"{name} has shape {shape}; expected one number", ErrorCode.FORMAT_UNKNOWN
            )
        return int(np.frombuffer(stream.read(dtype.itemsize), dtype)[0])


def _npz_table(path: Path, names: Sequence[str], given: GivenLayout) -> Table:
    """Return the columns of an archive."""

    def opened(name: str, stack: contextlib.ExitStack) -> tuple[Array, bool]:
        archive = stack.enter_context(zipfile.ZipFile(input_path(path)))
        return stack.enter_context(open_any_array(archive, name, KINDS))

    if given.columns is None and set(ROLES).issubset(names):
        has_size = {"width", "height"}.issubset(names)
        return _own_table(opened, has_size)

    # An array of all properties counts only if no arrays are named as the properties.
    whole = [name for name in WHOLE_EVENTS if name in names]
    if not whole and len(names) == 1:
        whole = list(names)
    wanted: tuple[str, ...] = ()
    are_chosen = False
    if given.columns is not None:
        wanted = tuple(given_roles(given.columns).values())
        all_exist = all(_is_among(names, wanted_name) for wanted_name in wanted)
        are_chosen = len(names) >= len(ROLES) and (all_exist or not whole)
    if names_roles(names) or are_chosen:
        return _arrays_table(_readable(path, names, wanted), opened)

    if not whole:
        missing = ", ".join(name for name in "xytp" if name not in names)
        listed = ", ".join(names)[:300] or "none"
        raise AmiwarpError(
            f"{path}: is a ZIP archive without x, y, t and p: no array {missing}; its arrays are {listed}; choose with "
            f"--columns, such as {example_of_columns(names)}",
            ErrorCode.AMBIGUOUS,
        )
    name = whole[0]
    hints = Hints()
    if name == "events":
        # EV-IMO's arrays are in this order, with times in seconds.
        hints = Hints(order=ROLES, fractions="s")
    return _array_table(partial(opened, name), f"array {name}", hints)


def _is_among(names: Sequence[str], wanted: str) -> bool:
    """Return whether an array of a wanted name is among some."""
    return any(is_wanted(name, [wanted]) for name in names)


def _readable(path: Path, names: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """Return the names of an archive's arrays, without arrays of text or objects unless events are expected there."""
    with zipfile.ZipFile(input_path(path)) as archive:

        def is_readable(name: str) -> bool:
            role, _ = role_of(name)
            if role is not None or is_wanted(name, wanted):
                return True
            return is_of_kind(archive, name, KINDS)

        return [name for name in names if is_readable(name)]


def _own_table(opened: OpenedByName, has_size: bool) -> Table:
    """Return the arrays x, y, t, p, as amiwarp writes them, always with a size: integer times are in us."""
    table = _arrays_table("xytp", opened)
    types = {str(column.name): column.values.dtype for column in table.columns}
    x_is_float = types["x"].kind == "f"
    y_is_float = types["y"].kind == "f"
    if x_is_float != y_is_float:
        given = f"array x is {types['x']}, y is {types['y']}"
        raise AmiwarpError(
            f"{given}; expected integers, or floating numbers for compensated events",
            ErrorCode.FORMAT_UNKNOWN,
        )
    unit = "us" if types["t"].kind in "iub" else None
    hints = Hints(unit=unit, compensated=True, is_own=has_size)
    return replace(table, hints=hints)


def _arrays_table(names: Sequence[str], opened: OpenedByName) -> Table:
    """Return the columns of arrays with one value per event. Other arrays are left out."""
    columns = []
    counts: dict[str, int] = {}
    for name in names:
        with contextlib.ExitStack() as stack:
            array, _ = opened(name, stack)
            _, shape, dtype = array
            role, _ = role_of(name)
            if len(shape) == 1 and dtype.names is None:
                (count,) = shape
                head = next_rows(array, min(count, SAMPLE))
                columns.append(Column(name, head))
                counts[name] = count
            elif role is not None:
                raise AmiwarpError(
                    f"array {name} has shape {shape}; expected one length (n,)",
                    ErrorCode.FILE_DAMAGED,
                )

    def pieces(chosen: tuple[int, ...], notes: dict[str, int]) -> Rows:
        first, *others = [str(columns[column].name) for column in chosen]
        count = counts[first]
        for name in others:
            if counts[name] != count:
                shapes = f"array {name} has shape ({counts[name]},), {first} ({count},)"
                raise AmiwarpError(f"{shapes}; expected one length (n,)", ErrorCode.FILE_DAMAGED)
        with contextlib.ExitStack() as stack:
            arrays = [opened(name, stack)[0] for name in (first, *others)]
            for length in lengths(count, notes):
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
        raise AmiwarpError(
            f"{name} is {dtype} of shape {shape}; expected a table (n, 4) of t, x, y and p, or fields",
            ErrorCode.FORMAT_UNKNOWN,
        )
    has_row_per_event = shape[1] <= MOST_COLUMNS
    count, width = shape if has_row_per_event else shape[::-1]
    # The values of an event follow one another in a table of rows per event, and in one of rows per property that is
    # stored by columns.
    events_in_order = has_row_per_event != by_columns

    def rows_of_events(chosen: tuple[int, ...], notes: dict[str, int]) -> Rows:
        with contextlib.ExitStack() as stack:
            (stream, _, _), _ = opened(stack)
            by_event = (stream, (count, width), dtype)
            for length in lengths(count, notes):
                rows = next_rows(by_event, length)
                yield tuple(np.ascontiguousarray(rows[:, number]) for number in chosen)

    def rows_of_properties(chosen: tuple[int, ...], notes: dict[str, int]) -> Rows:
        with contextlib.ExitStack() as stack:
            columns = [_column_of(opened(stack)[0], number, count) for number in chosen]
            for length in lengths(count, notes):
                yield tuple(next_rows(column, length) for column in columns)

    pieces = rows_of_events if events_in_order else rows_of_properties
    first = next(pieces(tuple(range(width)), {}), None)
    if first is None:
        first = (np.zeros(0),) * width
    columns = [Column(None, values[:SAMPLE]) for values in first]
    return Table(columns, pieces, hints)


def _column_of(array: Array, column: int, count: int) -> Array:
    """Return a column of an array that is stored by columns. It needs a stream of its own."""
    stream, _, dtype = array
    bytes_before = column * count * dtype.itemsize
    stream.seek(bytes_before, 1)
    return stream, (count,), dtype


def _fields_table(array: Array, opened: Opened, name: str) -> Table:
    """Return the columns of a structured array. Integer times named t are in us, as in data sets with such files."""
    _, shape, dtype = array
    if len(shape) != 1:
        raise AmiwarpError(
            f"{name} is {dtype} of shape {shape}; expected fields t, x, y, p of shape (n,)",
            ErrorCode.FORMAT_UNKNOWN,
        )
    (count,) = shape
    head = next_rows(array, min(count, SAMPLE))
    names = []
    columns = []
    unit = None
    for field in dtype.names or ():
        values = head[field]
        if values.ndim != 1:
            continue
        names.append(field)
        columns.append(Column(field, values.copy()))
        if field == "t" and values.dtype.kind in "iu":
            unit = "us"

    def pieces(chosen: tuple[int, ...], notes: dict[str, int]) -> Rows:
        with contextlib.ExitStack() as stack:
            array, _ = opened(stack)
            for length in lengths(count, notes):
                rows = next_rows(array, length)
                yield tuple(rows[names[column]] for column in chosen)

    return Table(columns, pieces, Hints(unit=unit))
