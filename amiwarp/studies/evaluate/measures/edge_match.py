"""Agreement of edge pixels with true edges: one-to-one matches within a tolerance, precision, recall and F-score."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

THRESHOLDS = np.arange(1, 100) / 100.0
"""Thresholds that are swept, relative to the scale of an event image."""
SCALE_PERCENTILE = 99.0
"""Percentile of the pixels with events that is the scale of an event image."""


@dataclass(frozen=True)
class Counts:
    """Numbers of edge pixels, added up over a set of images, for each threshold, shape (n,)."""

    matched: NDArray[np.int64]
    """Number of found pixels that match a true pixel, one to one."""
    found: NDArray[np.int64]
    """Number of found pixels."""
    true: NDArray[np.int64]
    """Number of true pixels."""

    @property
    def precision(self) -> NDArray[np.float64]:
        """Part of the found pixels that match, 0 without any."""
        return self.matched / np.maximum(self.found, 1)

    @property
    def recall(self) -> NDArray[np.float64]:
        """Part of the true pixels that match, 0 without any."""
        return self.matched / np.maximum(self.true, 1)

    @property
    def f_score(self) -> NDArray[np.float64]:
        """Harmonic mean of precision and recall."""
        return 2.0 * self.matched / np.maximum(self.found + self.true, 1)


def match(found: NDArray[np.bool_], true: NDArray[np.bool_], tolerances: Sequence[float]) -> list[NDArray[np.bool_]]:
    """Return for each tolerance [px] which of the true pixels match a found one, shape (height, width).

    Pixels are matched one to one, the nearest pairs first; pairs of equal distance in the order of their offsets. On
    event images they are 90 to 99 % of the largest possible number of pairs, which takes a hundred times as long.
    """
    reach = math.ceil(max(tolerances))
    free = np.pad(true, reach)
    stride = free.shape[1]
    y, x = np.nonzero(found)
    left, flat = (y + reach) * stride + x + reach, free.ravel()  # pixels without a partner; a view
    out = []
    offsets = _offsets(reach)
    for tolerance in sorted(tolerances):
        for square, dy, dx in offsets:
            if square > tolerance**2:
                break
            to = left + (dy * stride + dx)
            hit = flat[to]
            flat[to[hit]] = False
            left = left[~hit]
        offsets = [offset for offset in offsets if offset[0] > tolerance**2]
        out.append(true & ~free[reach:-reach, reach:-reach])
    return [out[sorted(tolerances).index(tolerance)] for tolerance in tolerances]


@functools.cache
def _offsets(reach: int) -> list[tuple[int, int, int]]:
    """Return the offsets (y, x) of the pixels up to ``reach`` away, after their squared distance, nearest first."""
    line = range(-reach, reach + 1)
    return sorted((dy * dy + dx * dx, dy, dx) for dy in line for dx in line if dy * dy + dx * dx <= reach * reach)


def normalised(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return an event image relative to its scale, :data:`SCALE_PERCENTILE` of the pixels with events."""
    positive = image[image > 0]
    return np.asarray(image / np.percentile(positive, SCALE_PERCENTILE) if positive.size else image, np.float64)


def best_f(counts: Counts) -> tuple[int, float]:
    """Return the index of the threshold with the highest F-score, and the score: the ODS-F of the set."""
    scores = counts.f_score
    best = int(np.argmax(scores))
    return best, float(scores[best])


def binary_entropy(mask: NDArray[np.bool_]) -> float:
    """Return the entropy of a binary image [bit/px]: 1 if half of its pixels are set, 0 if none or all are."""
    p = float(mask.mean())
    return 0.0 if p in (0.0, 1.0) else float(-p * np.log2(p) - (1 - p) * np.log2(1 - p))
