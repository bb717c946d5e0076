"""Order of four columns without names, from their first values.

A time rises, a polarity has few values, and x and y lie within a sensor.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.columns.layout import Hints
from amiwarp.io.columns.names import ROLES
from amiwarp.optics.camera import LARGEST_SIZE

KNOWN_ORDERS: tuple[tuple[str, ...], ...] = (
    ("t", "x", "y", "p"),
    ("x", "y", "t", "p"),
    ("x", "y", "p", "t"),
)
"""Orders of columns without names that other programs write."""


@dataclass(frozen=True, slots=True)
class _Facts:
    """What the values of a column show."""

    fractions: bool
    """Whether some are no whole numbers."""
    low: float
    """Smallest value."""
    high: float
    """Largest value."""
    rising: bool
    """Whether at most 1 % of the values are smaller than the one before."""
    polarity: bool
    """Whether the values can be polarities: few whole numbers."""
    pixels: bool
    """Whether the values can be coordinates."""

    @classmethod
    def of(cls, values: NDArray[Any]) -> _Facts:
        """Return what values show; values that are not finite are left out."""
        known = values
        if values.dtype.kind == "f":
            # float16 holds no larger coordinates. NaN is left out, too.
            wide = values.astype(np.float64)
            known = wide[np.abs(wide) < 2.0**63]
        if not known.size:
            return cls(
                fractions=True,
                low=0.0,
                high=0.0,
                rising=False,
                polarity=False,
                pixels=True,
            )
        fractions = False
        if known.dtype.kind == "f":
            fractions = bool((known != np.floor(known)).any())
        falls = np.count_nonzero(known[1:] < known[:-1])
        is_outside = (known < 0) | (known >= LARGEST_SIZE)
        outside = np.count_nonzero(is_outside)
        are_few = 1 <= len(common_values(known)) <= 3
        return cls(
            fractions=fractions,
            low=float(known.min()),
            high=float(known.max()),
            rising=_is_rare(int(falls), known.size),
            polarity=are_few and not fractions,
            pixels=fractions or _is_rare(int(outside), known.size),
        )

    @property
    def range(self) -> float:
        """Largest minus smallest value."""
        return self.high - self.low


def _is_rare(count: int, total: int) -> bool:
    """Return whether at most 1 % of the values have a fault, so that their reader names or repairs it."""
    return count * 100 <= total


def common_values(values: NDArray[Any]) -> list[Any]:
    """Return the different values, without those that at most 1 % of all have."""
    distinct, counts = np.unique(values, return_counts=True)
    is_common = counts * 100 > len(values)
    return list(distinct[is_common].tolist())


def order_by_values(values: Sequence[NDArray[Any]], hints: Hints) -> tuple[str, ...]:
    """Return the order of four columns without names; x is taken to come before y."""
    facts = [_Facts.of(column_values) for column_values in values]
    if hints.order is not None and _fits_promise(facts, hints.order):
        return hints.order
    fitting = []
    for order in itertools.permutations(ROLES):
        by_role = dict(zip(order, facts, strict=True))
        if order.index("x") < order.index("y") and _fits_order(by_role):
            fitting.append(order)
    fitting = _with_clearest_time(fitting, facts)

    usual = [order for order in fitting if order in KNOWN_ORDERS]
    if len(usual) == 1:
        fitting = usual
    if len(fitting) == 1:
        return fitting[0]
    shown = [" ".join(order) for order in fitting[:3]]
    orders = " or ".join(shown) or "none fits"
    raise AmiwarpError(
        f"has four columns without names, in which the order of t, x, y and p is in doubt ({orders}); "
        "give it with --columns, such as t,x,y,p",
        ErrorCode.AMBIGUOUS,
    )


def _with_clearest_time(
    orders: list[tuple[str, ...]], facts: Sequence[_Facts]
) -> list[tuple[str, ...]]:
    """Return the orders with the clearest time, if several columns rise: with the widest range by far, or fractions."""
    times = {order.index("t") for order in orders}
    if len(times) < 2:
        return orders
    best = max(times, key=lambda column: (facts[column].fractions, facts[column].range))
    others = times - {best}
    if not all(_is_clearer(facts[best], facts[column]) for column in others):
        return orders
    return [order for order in orders if order.index("t") == best]


def _fits_promise(facts: Sequence[_Facts], order: tuple[str, ...]) -> bool:
    """Return whether columns can have the order that the format promises, even if values are damaged."""
    by_role = dict(zip(order, facts, strict=True))
    t, x, y, p = (by_role[role] for role in ROLES)
    only_t_has_fractions = t.fractions and not x.fractions and not y.fractions
    is_time = t.rising or only_t_has_fractions
    # Where only the last column can be the polarity, wrong coordinates do not make it another order.
    are_places = x.pixels and y.pixels
    no_other_polarity = not x.polarity and not y.polarity
    return is_time and p.polarity and (are_places or no_other_polarity)


def _fits_order(by_role: Mapping[str, _Facts]) -> bool:
    """Return whether columns can have these roles."""
    t, x, y, p = (by_role[role] for role in ROLES)
    if not p.polarity or not x.pixels or not y.pixels:
        return False
    if x.fractions != y.fractions:
        return False
    beyond = t.high >= LARGEST_SIZE or (t.fractions and not x.fractions)
    return t.rising or beyond


def _is_clearer(best: _Facts, other: _Facts) -> bool:
    """Return whether one column is more clearly the time than another."""
    if best.fractions != other.fractions:
        return best.fractions
    return best.range > 16 * other.range
