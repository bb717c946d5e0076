"""Agreement of edge pixels with true edges: one-to-one matches within a tolerance, precision, recall and F-score."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_flow
from scipy.spatial import KDTree

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
    """Return for each tolerance [px] which of the true pixels match a found one, in the order of ``np.nonzero``.

    As many pixels as possible are matched, one to one, at distances up to the tolerance.
    """
    points, targets = (np.argwhere(mask).astype(np.float64) for mask in (found, true))
    if not (len(points) and len(targets)):
        return [np.zeros(len(targets), np.bool_) for _ in tolerances]
    pairs = KDTree(targets).sparse_distance_matrix(KDTree(points), max(tolerances), output_type="ndarray")
    out = []
    for tolerance in tolerances:
        near: Any = pairs[pairs["v"] <= tolerance]
        out.append(_matched(near["i"], near["j"], len(targets), len(points)))
    return out


def _matched(i: NDArray[np.int64], j: NDArray[np.int64], rows: int, columns: int) -> NDArray[np.bool_]:
    """Return which rows a largest one-to-one matching of the pairs (i, j) contains, shape (rows,).

    It is the largest flow from a source over rows and columns to a sink. SciPy's maximum_bipartite_matching takes
    minutes for some pairs of lines with gaps, where many pixels have no partner.
    """
    source, sink = rows + columns, rows + columns + 1
    start = np.concatenate([np.full(rows, source), i, rows + np.arange(columns)])
    end = np.concatenate([np.arange(rows), rows + j, np.full(columns, sink)])
    ones = np.ones(len(start), np.int32)
    graph = csr_array((ones, (start.astype(np.int32), end.astype(np.int32))), shape=(sink + 1, sink + 1))
    flow = maximum_flow(graph, source, sink, method="dinic").flow
    taken = np.zeros(rows, np.bool_)
    row = csr_array(flow)[[source], :rows].tocoo()
    taken[row.coords[1]] = row.data > 0
    return taken


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
