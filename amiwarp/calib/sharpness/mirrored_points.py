"""Guess of the point that DIRECT evaluates next.

DIRECT (Jones et al., J. Optim. Theory Appl. 1993) divides a box into three along one axis: it evaluates one point on
each side of the box's centre, at a third of its length. The centre was evaluated before.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Vector = NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest relative difference of two lengths that are equal but for rounding."""


class MirroredPoints:
    """Points that DIRECT evaluated, which are centres of boxes, each with the largest size that its box may have."""

    def __init__(self, size: Vector) -> None:
        """Start without points in a box of the given ``size``, shape (n,)."""
        self._whole = size
        self._points: list[Vector] = []
        self._sizes: list[Vector] = []

    def guess(self, v: Vector) -> Vector | None:
        """Add an evaluated point ``v``, and return the one on the other side of its centre; None if none is found."""
        found = self._centre(v) if self._points else None
        if found is None:
            self._add(v, self._whole)
            return None
        k, axis = found
        size = self._sizes[k].copy()
        size[axis] = abs(self._points[k][axis] - v[axis])
        self._sizes[k] = size
        self._add(v, size)
        mirrored = v.copy()
        mirrored[axis] = 2.0 * self._points[k][axis] - v[axis]
        return mirrored

    def confirm(self, v: Vector) -> None:
        """Add an evaluated point that is the last guess, but for rounding."""
        self._add(v, self._sizes[-1])

    def _add(self, v: Vector, size: Vector) -> None:
        self._points.append(v.copy())
        self._sizes.append(size)

    def _centre(self, v: Vector) -> tuple[int, int] | None:
        """Return the number of the point whose box was divided by ``v``, and the axis; None if there is none.

        The distance is the box's length over a power of three: the smallest power that is possible, and of several
        such points the nearest.
        """
        away = np.abs(np.array(self._points) - v)
        best, found = (math.inf, math.inf), None
        for k in np.flatnonzero(np.count_nonzero(away, axis=1) == 1).tolist():
            axis = int(away[k].argmax())
            distance = float(away[k, axis])
            power = math.log(self._sizes[k][axis] / distance, 3.0)
            whole = round(power)
            rank = whole, distance / float(self._whole[axis])
            if whole >= 1 and abs(power - whole) < TOLERANCE and rank < best:
                best, found = rank, (k, axis)
        return found
