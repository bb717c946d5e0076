"""Arrays that OpenMV records with the GenX320: six columns of whole numbers without names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.assumptions import Assumption
from amiwarp.io.columns.layout import ZERO_OR_ONE, Column, Layout

LIMITS = {"type": 16, "s": 2**32, "ms": 1000, "us": 1000, "x": 320, "y": 320}
"""Names of the columns in order, with the limits that their values are below."""


def is_openmv(columns: Sequence[Column]) -> bool:
    """Return whether columns are OpenMV's."""
    if len(columns) != len(LIMITS):
        return False
    for column, limit in zip(columns, LIMITS.values(), strict=True):
        if column.name or not _are_whole_numbers(column.values, limit):
            return False
    return True


def _are_whole_numbers(values: NDArray[Any], limit: int) -> bool:
    """Return whether some values are whole numbers from 0 to below a limit."""
    if values.dtype.kind not in "iuf" or not values.size:
        return False
    if values.min() < 0 or not values.max() < limit:
        return False
    return bool((values == np.floor(values)).all())


def openmv_layout() -> Layout:
    """Return the layout of OpenMV's arrays."""
    why = "six columns of whole numbers, as OpenMV writes them for the GenX320"
    places = {name: place for place, name in enumerate(LIMITS)}
    return Layout(
        columns=places,
        unit="us",
        coding=ZERO_OR_ONE,
        assumptions=(Assumption("columns", " ".join(LIMITS), why, "--columns"),),
        openmv=True,
        names={name: f"column {place + 1}" for name, place in places.items()},
    )
