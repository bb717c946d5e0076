"""Search for the layout of a file of plain columns.

All readers of text, NumPy, HDF5, MATLAB and Parquet files decide here. A layout is found from names
(:mod:`amiwarp.io.columns.names`), types and the first values (:mod:`amiwarp.io.columns.order`,
:mod:`amiwarp.io.columns.units`). What the file does not state is an :class:`~amiwarp.io.assumptions.Assumption`, which
names the option that overrides it. In doubt, :func:`find_layout` raises :class:`AmiwarpError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.assumptions import Assumption
from amiwarp.io.columns.layout import Column, Hints, Layout
from amiwarp.io.columns.names import ROLES, example_of_columns, role_of, roles_of, unit_in
from amiwarp.io.columns.openmv import is_openmv, openmv_layout
from amiwarp.io.columns.options import GivenLayout, given_roles
from amiwarp.io.columns.order import order_by_values
from amiwarp.io.columns.polarity import find_coding
from amiwarp.io.columns.units import find_unit


def find_layout(columns: Sequence[Column], given: GivenLayout, hints: Hints) -> Layout:
    """Return the layout of a file's columns. Raises :class:`AmiwarpError` in doubt, with the option that decides."""
    given.check()
    if columns and not any(column.values.size for column in columns):
        raise AmiwarpError("holds no events; give another recording", ErrorCode.CONTENT_MISSING)
    if is_openmv(columns) and given.columns is None and not hints.is_text:
        return openmv_layout()
    roles, assumptions = _find_roles(columns, given, hints)
    chosen = {role: columns[number] for role, number in roles.items()}
    for role, column in chosen.items():
        if column.values.dtype.kind not in "iufb" or column.values.ndim != 1:
            raise AmiwarpError(
                f"column {_shown(columns, roles[role])} for {role} is {column.values.dtype}; give numbers",
                ErrorCode.FORMAT_UNKNOWN,
            )

    unit, why = find_unit(chosen["t"], given, hints)
    if why is not None:
        assumptions.append(Assumption("time unit", unit, why, "--time-unit"))
    coding, assumed_coding = find_coding(chosen["p"].values, given)
    assumptions += assumed_coding

    is_compensated = hints.compensated and all(
        chosen[role].values.dtype.kind == "f" for role in ("x", "y")
    )
    if given.scale_xy is None and not is_compensated and not hints.is_own:
        _check_scale(chosen["x"].values, chosen["y"].values)

    is_stated = bool(hints.unit or hints.fractions)
    return Layout(
        columns=roles,
        unit=unit,
        coding=coding,
        scale=given.scale_xy or 1,
        compensated=is_compensated,
        assumptions=tuple(assumptions),
        unit_is_assumed=why is not None and unit == "us",
        is_promised=given == GivenLayout() and not assumptions and is_stated,
        names={role: _shown(columns, number) for role, number in roles.items()},
    )


def _shown(columns: Sequence[Column], number: int) -> str:
    """Return the name of a column, or else its number from 1 on."""
    return columns[number].name or f"column {number + 1}"


def _find_roles(
    columns: Sequence[Column], given: GivenLayout, hints: Hints
) -> tuple[dict[str, int], list[Assumption]]:
    """Return the index of the column of each role, and what was assumed."""
    if given.columns is not None:
        return _given_columns(columns, given.columns), []
    if any(column.name for column in columns):
        roles = _named_columns(columns)
        guessed = []
        for role, number in roles.items():
            name = columns[number].name
            usual_role, _ = role_of(name or "")
            if usual_role is None:
                guessed.append(f"{role} = {name}")
        if not guessed:
            return roles, []
        why = "no column has the usual name"
        return roles, [Assumption("columns", ", ".join(guessed), why, "--columns")]

    if len(columns) != len(ROLES):
        hint = "; amiwarp needs t, x, y and p"
        if len(columns) > len(ROLES):
            hint = " (- for a column without use)"
        raise AmiwarpError(
            f"has {len(columns)} columns without names; say which are which with --columns, such as t,x,y,p{hint}",
            ErrorCode.AMBIGUOUS,
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
        # The whole name counts first, then the name without its groups, then the number.
        matches = [index for index, name in enumerate(names) if name == wanted]
        if not matches:
            last_parts = [name.rpartition("/")[2] if name else None for name in names]
            matches = [index for index, part in enumerate(last_parts) if part == wanted]
        if not matches and wanted.isdecimal() and 1 <= int(wanted) <= len(columns):
            matches = [int(wanted) - 1]
        if len(matches) != 1:
            known = ", ".join(name for name in names if name)[:300]
            if not known:
                known = f"the numbers 1 to {len(columns)}"
            raise AmiwarpError(
                f"has no column {wanted!r}, which --columns gives for {role}; it has {known}",
                ErrorCode.CONTENT_MISSING,
            )
        (roles[role],) = matches
    return roles


def _named_columns(columns: Sequence[Column]) -> dict[str, int]:
    """Return the columns with the names of the roles."""
    names = [column.name or "" for column in columns]
    places_of_roles = roles_of(names)
    known = ", ".join(name for name in names if name)[:300]
    for role, places in places_of_roles.items():
        if len(places) > 1:
            several = " and ".join(names[place] for place in places)
            both = "both" if len(places) == 2 else "all"
            units = {unit_in(names[place]) for place in places}
            remedy = ""
            if len(units) > 1:
                remedy = "; if they are parts of one time, join them in one column first"
            raise AmiwarpError(
                f"columns {several} can {both} be {role}; choose with --columns, such as "
                f"{example_of_columns(names)}{remedy}",
                ErrorCode.AMBIGUOUS,
            )
    missing = [role for role, places in places_of_roles.items() if not places]
    if missing:
        raise AmiwarpError(
            f"no column is named as {', '.join(missing)}; the columns are {known}; choose with --columns, such as "
            f"{example_of_columns(names)}",
            ErrorCode.AMBIGUOUS,
        )
    return {role: places[0] for role, places in places_of_roles.items()}


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
            f"--scale-xy {common}, or keep them with --scale-xy 1",
            ErrorCode.AMBIGUOUS,
        )
