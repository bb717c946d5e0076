"""Agreement of a set of events or pixels with the true set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError


@dataclass(frozen=True, slots=True)
class Overlap:
    """Overlap of a found set with the true set. A ratio without a denominator is NaN."""

    iou: float
    """Intersection over union."""
    precision: float
    """Share of the found members that are true."""
    recall: float
    """Share of the true members that are found."""


def overlap(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> Overlap:
    """Return the overlap of two Boolean arrays of one shape. Raises :class:`AmiwarpError` for different shapes."""
    if found.shape != truth.shape:
        raise AmiwarpError(f"found and true masks have shapes {found.shape} and {truth.shape}; give equal shapes")
    both = int(np.count_nonzero(found & truth))
    counts = [int(np.count_nonzero(mask)) for mask in (found | truth, found, truth)]
    return Overlap(*(both / n if n else float("nan") for n in counts))


def box_overlap(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return the intersection over union of the bounding boxes of two point sets, shapes (n, 2) and (m, 2).

    Points that are not finite do not count. The result is 0 if a set has no points or a box has no area.
    """
    a, b = (points[np.isfinite(points).all(axis=1)] for points in (a, b))
    if not len(a) or not len(b):
        return 0.0
    low, high = np.stack([a.min(axis=0), b.min(axis=0)]), np.stack([a.max(axis=0), b.max(axis=0)])
    shared = float(np.prod(np.maximum(high.min(axis=0) - low.max(axis=0), 0.0)))
    union = float(np.prod(high - low, axis=1).sum()) - shared
    return shared / union if union > 0.0 else 0.0
