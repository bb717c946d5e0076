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

from amiwarp.errors import AmiwarpError
from amiwarp.io.column_names import ROLES
from amiwarp.io.columns import Hints
from amiwarp.optics.camera import LARGEST_SIZE

KNOWN_ORDERS: tuple[tuple[str, ...], ...] = (("t", "x", "y", "p"), ("x", "y", "t", "p"), ("x", "y", "p", "t"))
"""Orders of columns without names that other programs write."""


@dataclass(frozen=True, slots=True)
class _Facts:
    """What the values of a column show."""

    fractions: bool
    """Whether some are no whole numbers."""
    low: float
    high: float
    """Smallest and largest value."""
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
            wide = values.astype(np.float64)  # float16 holds no larger coordinates
            known = wide[np.abs(wide) < 2.0**63]  # without NaN, too
        if not known.size:
            return cls(True, 0.0, 0.0, False, False, True)
        fractions = known.dtype.kind == "f" and bool((known != np.floor(known)).any())
        low = float(known.min())
        high = float(known.max())
        falls = int(np.count_nonzero(known[1:] < known[:-1]))
        few = not fractions and 1 <= len(common_values(known)) <= 3
        outside = int(np.count_nonzero((known < 0) | (known >= LARGEST_SIZE)))
        return cls(fractions, low, high, _is_rare(falls, known.size), few, fractions or _is_rare(outside, known.size))


def _is_rare(count: int, total: int) -> bool:
    """Return whether at most 1 % of the values have a fault, so that their reader names or repairs it."""
    return count * 100 <= total


def common_values(values: NDArray[Any]) -> list[Any]:
    """Return the different values, without those that at most 1 % of all have."""
    found, counts = np.unique(values, return_counts=True)
    return [found[at].item() for at in np.flatnonzero(counts * 100 > len(values))]


def order_by_values(values: Sequence[NDArray[Any]], hints: Hints) -> tuple[str, ...]:
    """Return the order of four columns without names; x is taken to come before y."""
    facts = [_Facts.of(each) for each in values]
    if hints.order is not None and _fits_promise(facts, hints.order):
        return hints.order
    fitting = []
    for order in itertools.permutations(ROLES):
        by_role = {role: facts[at] for at, role in enumerate(order)}
        if order.index("x") < order.index("y") and _fits_order(by_role):
            fitting.append(order)
    times = {order.index("t") for order in fitting}
    if len(times) > 1:  # several columns rise: the time has the widest range by far, or alone has fractions
        best = max(times, key=lambda at: (facts[at].fractions, facts[at].high - facts[at].low))
        if all(_is_clearer(facts[best], facts[at]) for at in times - {best}):
            fitting = [order for order in fitting if order.index("t") == best]
    usual = [order for order in fitting if order in KNOWN_ORDERS]
    if len(usual) == 1:
        fitting = usual
    if len(fitting) == 1:
        return fitting[0]
    orders = " or ".join(" ".join(order) for order in fitting[:3])
    raise AmiwarpError(
        f"has four columns without names, in which the order of t, x, y and p is in doubt ({orders or 'none fits'}); "
        "give it with --columns, such as t,x,y,p"
    )


def _fits_promise(facts: Sequence[_Facts], order: tuple[str, ...]) -> bool:
    """Return whether columns can have the order that the format promises, even if values are damaged."""
    by_role = {role: facts[at] for at, role in enumerate(order)}
    t, x, y, p = (by_role[role] for role in ROLES)
    is_time = t.rising or (t.fractions and not x.fractions and not y.fractions)
    # Where only the last column can be the polarity, wrong coordinates do not make it another order.
    are_places = (x.pixels and y.pixels) or not (x.polarity or y.polarity)
    return is_time and p.polarity and are_places


def _fits_order(by_role: Mapping[str, _Facts]) -> bool:
    """Return whether columns can have these roles."""
    t, x, y, p = (by_role[role] for role in ROLES)
    if not (p.polarity and x.pixels and y.pixels) or x.fractions != y.fractions:
        return False
    beyond = t.high >= LARGEST_SIZE or (t.fractions and not x.fractions)
    return t.rising or beyond


def _is_clearer(best: _Facts, other: _Facts) -> bool:
    """Return whether one column is more clearly the time than another."""
    if best.fractions != other.fractions:
        return best.fractions
    return best.high - best.low > 16 * (other.high - other.low)
