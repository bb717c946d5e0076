"""Guess of the point that DIRECT evaluates next.

DIRECT (Jones et al., J. Optim. Theory Appl. 1993) divides a box into three along one axis: it evaluates one point on
each side of the box's centre, at a third of its length. The centre was evaluated before.
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

TOLERANCE = 1e-6
"""Largest relative difference of two lengths that are equal but for rounding."""


class MirroredPoints:
    """Points that DIRECT evaluated, which are centres of boxes, each with the largest size that its box may have.

    Coordinates are Python numbers: for few points, these are faster than arrays.
    """

    def __init__(self, size: Sequence[float]) -> None:
        """Start without points in a box of the given ``size``, one length per axis."""
        self._whole = [*size]
        self._points: list[Sequence[float]] = []
        self._sizes: list[list[float]] = []
        self._on_line: defaultdict[tuple[float, ...], list[int]] = defaultdict(list)

    def guess(self, v: Sequence[float]) -> list[float] | None:
        """Add an evaluated point ``v``, and return the one on the other side of its centre; None if none is found."""
        found = self._centre(v)
        if found is None:
            self._add(v, self._whole)
            return None
        k, axis = found
        size = [*self._sizes[k]]
        size[axis] = abs(self._points[k][axis] - v[axis])
        self._sizes[k] = size
        self._add(v, size)
        mirrored = [*v]
        mirrored[axis] = 2.0 * self._points[k][axis] - v[axis]
        return mirrored

    def confirm(self, v: Sequence[float]) -> None:
        """Add an evaluated point that is the last guess, but for rounding."""
        self._add(v, self._sizes[-1])

    def _add(self, v: Sequence[float], size: list[float]) -> None:
        for axis in range(len(v)):
            self._on_line[axis, *v[:axis], *v[axis + 1 :]].append(len(self._points))
        self._points.append(v)
        self._sizes.append(size)

    def _centre(self, v: Sequence[float]) -> tuple[int, int] | None:
        """Return the number of the point whose box was divided by ``v``, and the axis; None if there is none.

        The distance is the box's length over a power of three: the smallest power that is possible, and of several
        such points the nearest.
        """
        best, found = (math.inf, math.inf), None
        for axis, whole in enumerate(self._whole):
            for k in self._on_line.get((axis, *v[:axis], *v[axis + 1 :]), ()):
                distance = abs(self._points[k][axis] - v[axis])
                if not 0.0 < 2.0 * distance < self._sizes[k][axis]:
                    continue
                power = math.log(self._sizes[k][axis] / distance, 3.0)
                rank = round(power), distance / whole
                if abs(power - rank[0]) < TOLERANCE and rank < best:
                    best, found = rank, (k, axis)
        return found
