"""Meaning of the values of the polarity in a file of plain columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.assumptions import Assumption
from amiwarp.io.columns.layout import SIGNED, UNSIGNED_MINUS_ONE, ZERO_OR_ONE, Coding, listed
from amiwarp.io.columns.options import GivenLayout, given_polarity
from amiwarp.io.columns.order import common_values

MOST_VALUES = 8
"""Largest number of different values of a polarity."""


def find_coding(p: NDArray[Any], given: GivenLayout) -> tuple[Coding, list[Assumption]]:
    """Return the meaning of the values of the polarity, and what was assumed."""
    if given.polarity is not None:
        return given_polarity(given.polarity), []
    if p.dtype == np.bool_:
        return ZERO_OR_ONE, []
    if not p.size:
        return SIGNED, []
    values: list[Any] = [
        int(value) if float(value).is_integer() else value for value in common_values(p)
    ]
    if not values or len(values) > MOST_VALUES:
        raise AmiwarpError(
            f"the polarity has many different values, {p.min()} to {p.max()}; choose its column with --columns, or "
            "give --polarity, such as 1=on,2=off",
            ErrorCode.AMBIGUOUS,
        )
    distinct = set(values)
    if len(distinct) == 1 and distinct <= {-1, 0, 1}:
        (value,) = values
        meaning = "ON" if value == 1 else "OFF"
        why = f"the first {p.size:,} events all have the polarity {value}"
        return SIGNED, [Assumption("polarity", f"{value} is {meaning}", why, "--polarity")]
    if distinct in ({0, 1}, {-1, 1}):
        return SIGNED, []
    large = distinct - {0, 1}
    if 1 in distinct and len(large) == 1 and large <= set(UNSIGNED_MINUS_ONE):
        (value,) = large
        why = f"it is -1 in an unsigned integer, and the values are {listed(distinct)}"
        assumption = Assumption("polarity", f"{value} is OFF", why, "--polarity")
        return {**ZERO_OR_ONE, value: False}, [assumption]
    raise AmiwarpError(
        f"the polarity has the values {', '.join(map(str, values))}, of which ON and OFF are not known; say so with "
        "--polarity, such as 1=on,2=off",
        ErrorCode.AMBIGUOUS,
    )
