"""Search for the layout of a file of plain columns.

All readers of text, NumPy, HDF5, MATLAB and Parquet files decide here. A layout is found from names
(:mod:`amiwarp.io.column_names`), types and the first values (:mod:`amiwarp.io.column_order`,
:mod:`amiwarp.io.column_units`). What the file does not state is an :class:`~amiwarp.io.file_scan.Assumption`, which
names the option that overrides it. In doubt, :func:`find_layout` raises :class:`AmiwarpError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.column_names import ROLES, example_of_columns, role_of, roles_of, unit_in
from amiwarp.io.column_options import GivenLayout, given_polarity, given_roles
from amiwarp.io.column_order import common_values, order_by_values
from amiwarp.io.column_units import find_unit
from amiwarp.io.columns import SIGNED, UNSIGNED_MINUS_ONE, ZERO_OR_ONE, Coding, Column, Hints, Layout, listed
from amiwarp.io.file_scan import Assumption


def find_layout(columns: Sequence[Column], given: GivenLayout, hints: Hints) -> Layout:
    """Return the layout of a file's columns. Raises :class:`AmiwarpError` in doubt, with the option that decides."""
    given.check()
    if columns and not any(column.values.size for column in columns):
        raise AmiwarpError("holds no events; give another recording")
    if _is_openmv(columns) and given.columns is None and not hints.is_text:
        return _openmv_layout()
    roles, assumptions = _find_roles(columns, given, hints)
    chosen = {role: columns[at] for role, at in roles.items()}
    for role, column in chosen.items():
        if column.values.dtype.kind not in "iufb" or column.values.ndim != 1:
            raise AmiwarpError(
                f"column {_shown(columns, roles[role])} for {role} is {column.values.dtype}; give numbers"
            )
    unit, why = find_unit(chosen["t"], given, hints)
    if why is not None:
        assumptions.append(Assumption("time unit", unit, why, "--time-unit"))
    coding, said = _find_coding(chosen["p"].values, given)
    assumptions += said
    compensated = hints.compensated and all(chosen[role].values.dtype.kind == "f" for role in "xy")
    scale = given.scale_xy or 1
    if given.scale_xy is None and not compensated and not hints.is_own:
        _check_scale(chosen["x"].values, chosen["y"].values)
    return Layout(
        columns=roles,
        unit=unit,
        coding=coding,
        scale=scale,
        compensated=compensated,
        assumptions=tuple(assumptions),
        unit_is_assumed=why is not None and unit == "us",
        is_promised=given == GivenLayout() and not assumptions and bool(hints.unit or hints.fractions),
        names={role: _shown(columns, at) for role, at in roles.items()},
    )


def _shown(columns: Sequence[Column], at: int) -> str:
    """Return the name of a column, or else its number from 1 on."""
    return columns[at].name or f"column {at + 1}"


# Which column is which.


def _find_roles(columns: Sequence[Column], given: GivenLayout, hints: Hints) -> tuple[dict[str, int], list[Assumption]]:
    """Return the index of the column of each role, and what was assumed."""
    if given.columns is not None:
        return _given_columns(columns, given.columns), []
    if any(column.name for column in columns):
        roles = _named_columns(columns)
        guessed = [
            f"{role} = {columns[at].name}" for role, at in roles.items() if role_of(columns[at].name or "")[0] is None
        ]
        why = "no column has the usual name"
        return roles, [Assumption("columns", ", ".join(guessed), why, "--columns")] if guessed else []
    if len(columns) != len(ROLES):
        raise AmiwarpError(
            f"has {len(columns)} columns without names; say which are which with --columns, such as t,x,y,p"
            + (" (- for a column without use)" if len(columns) > len(ROLES) else "; amiwarp needs t, x, y and p")
        )
    order = order_by_values([column.values for column in columns], hints)
    roles = {role: order.index(role) for role in ROLES}
    if order == hints.order:
        return roles, []
    why = "the columns have no names, and their values fit this order best"
    return roles, [Assumption("columns", " ".join(order), why, "--columns")]


def _given_columns(columns: Sequence[Column], text: str) -> dict[str, int]:
    """Return the columns that the option ``--columns`` gives."""
    names = [column.name for column in columns]
    roles = {}
    given = given_roles(text)
    for role in ROLES:
        wanted = given[role]
        same = [at for at, name in enumerate(names) if name == wanted]
        if not same:
            same = [at for at, name in enumerate(names) if name and name.rpartition("/")[2] == wanted]
        if not same and wanted.isdecimal() and 1 <= int(wanted) <= len(columns):
            same = [int(wanted) - 1]
        if len(same) != 1:
            known = ", ".join(name for name in names if name)[:300] or f"the numbers 1 to {len(columns)}"
            raise AmiwarpError(f"has no column {wanted!r}, which --columns gives for {role}; it has {known}")
        roles[role] = same[0]
    return roles


def _named_columns(columns: Sequence[Column]) -> dict[str, int]:
    """Return the columns with the names of the roles."""
    names = [column.name or "" for column in columns]
    found = roles_of(names)
    known = ", ".join(name for name in names if name)[:300]
    for role, places in found.items():
        if len(places) > 1:
            several = " and ".join(names[place] for place in places)
            units = {unit_in(names[place]) for place in places}
            parts = "; if they are parts of one time, join them in one column first" if len(units) > 1 else ""
            raise AmiwarpError(
                f"columns {several} can {'both' if len(places) == 2 else 'all'} be {role}; choose with --columns, such "
                f"as {example_of_columns(names)}{parts}"
            )
    missing = [role for role, at in found.items() if not at]
    if missing:
        raise AmiwarpError(
            f"no column is named as {', '.join(missing)}; the columns are {known}; choose with --columns, such as "
            f"{example_of_columns(names)}"
        )
    return {role: at[0] for role, at in found.items()}


# Coding of polarity, and scale of coordinates.


def _find_coding(p: NDArray[Any], given: GivenLayout) -> tuple[Coding, list[Assumption]]:
    """Return the meaning of the values of the polarity, and what was assumed."""
    if given.polarity is not None:
        return given_polarity(given.polarity), []
    if p.dtype == np.bool_:
        return ZERO_OR_ONE, []
    if not p.size:
        return SIGNED, []
    values: list[Any] = [int(value) if float(value).is_integer() else value for value in common_values(p)]
    if len(values) > 8 or not values:
        raise AmiwarpError(
            f"the polarity has many different values, {p.min()} to {p.max()}; choose its column with --columns, or "
            "give --polarity, such as 1=on,2=off"
        )
    found = set(values)
    if len(found) == 1 and found <= {-1, 0, 1}:
        (value,) = values
        meaning = "ON" if value == 1 else "OFF"
        why = f"the first {p.size:,} events all have the polarity {value}"
        return SIGNED, [Assumption("polarity", f"{value} is {meaning}", why, "--polarity")]
    if found in ({0, 1}, {-1, 1}):
        return SIGNED, []
    large = found - {0, 1}
    if 1 in found and len(large) == 1 and large <= set(UNSIGNED_MINUS_ONE):
        (value,) = large
        why = f"it is -1 in an unsigned integer, and the values are {listed(found)}"
        return {**ZERO_OR_ONE, value: False}, [Assumption("polarity", f"{value} is OFF", why, "--polarity")]
    raise AmiwarpError(
        f"the polarity has the values {', '.join(map(str, values))}, of which ON and OFF are not known; say so with "
        "--polarity, such as 1=on,2=off"
    )


LARGEST_SENSOR = 2048
"""Sides of sensors are at most this [px]."""


def _check_scale(x: NDArray[Any], y: NDArray[Any]) -> None:
    """Raise :class:`AmiwarpError` if coordinates are multiples of a pixel's fraction."""
    if x.dtype.kind not in "iu" or y.dtype.kind not in "iu" or not x.size:
        return
    largest = max(int(x.max()), int(y.max()))
    common = int(np.gcd(np.gcd.reduce(x), np.gcd.reduce(y)))
    if largest >= LARGEST_SENSOR and common > 1:
        raise AmiwarpError(
            f"x and y reach {largest} and are multiples of {common}, as fixed-point numbers are; divide them with "
            f"--scale-xy {common}, or keep them with --scale-xy 1"
        )


# OpenMV's arrays of the GenX320.


def _is_openmv(columns: Sequence[Column]) -> bool:
    """Return whether columns are OpenMV's: type, s, ms, us, x, y."""
    if len(columns) != 6 or any(column.name for column in columns):
        return False
    if any(column.values.dtype.kind not in "iuf" or not column.values.size for column in columns):
        return False
    limits = (16, 2**32, 1000, 1000, 320, 320)
    return all(
        column.values.min() >= 0 and column.values.max() < limit and (column.values == np.floor(column.values)).all()
        for column, limit in zip(columns, limits, strict=True)
    )


def _openmv_layout() -> Layout:
    """Return the layout of OpenMV's arrays."""
    names = ("type", "s", "ms", "us", "x", "y")
    why = "six columns of whole numbers, as OpenMV writes them for the GenX320"
    return Layout(
        columns={name: at for at, name in enumerate(names)},
        unit="us",
        coding=ZERO_OR_ONE,
        assumptions=(Assumption("columns", " ".join(names), why, "--columns"),),
        openmv=True,
        names={name: f"column {at + 1}" for at, name in enumerate(names)},
    )
