"""Agreement of edge pixels with true edges: one-to-one matches within a tolerance, precision, recall and F-score."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_flow
from scipy.spatial import KDTree

THRESHOLDS = np.arange(3, 100, 3) / 100.0
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


def match(
    found: NDArray[np.bool_], true: NDArray[np.bool_], tolerances: Sequence[float]
) -> list[NDArray[np.bool_]]:
    """Return for each tolerance [px] which of the true pixels match a found one, shape (height, width).

    Pixels are matched one to one, in as many pairs as possible. They are the largest flow from the true pixels to the
    found ones (Dinic, by SciPy), whose time is bounded; SciPy's matching takes up to minutes on such images.
    """
    found_places = np.argwhere(found)
    true_pixels = np.flatnonzero(true)
    matched = [np.zeros(true.shape, np.bool_) for _ in tolerances]
    if not len(found_places) or not len(true_pixels):
        return matched
    true_tree = KDTree(np.argwhere(true))
    found_tree = KDTree(found_places)
    farthest = max(tolerances) + 1e-9
    pairs = true_tree.sparse_distance_matrix(found_tree, farthest, output_type="coo_matrix")

    # Nodes: the true pixels, the found ones, the source and the sink. All edges have capacity 1.
    true_count = len(true_pixels)
    found_count = len(found_places)
    source = true_count + found_count
    sink = source + 1
    from_source = np.full(true_count, source)
    to_sink = np.full(found_count, sink)
    true_nodes = np.arange(true_count)
    found_nodes = true_count + np.arange(found_count)
    for mask, tolerance in zip(matched, tolerances, strict=True):
        near = pairs.data <= tolerance + 1e-9
        begin = np.concatenate([from_source, pairs.row[near], found_nodes])
        end = np.concatenate([true_nodes, true_count + pairs.col[near], to_sink])
        capacity = np.ones(len(begin), np.int32)
        nodes = sink + 1
        graph = csr_array((capacity, (begin, end)), (nodes, nodes))
        flow = maximum_flow(graph, source, sink, method="dinic").flow
        is_matched = flow[[source]].toarray()[0, :true_count] > 0
        mask.ravel()[true_pixels[is_matched]] = True
    return matched


def normalised(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return an event image relative to its scale, :data:`SCALE_PERCENTILE` of the pixels with events."""
    positive = image[image > 0]
    if not positive.size:
        return np.asarray(image, np.float64)
    return np.asarray(image / np.percentile(positive, SCALE_PERCENTILE), np.float64)


def best_f(counts: Counts) -> tuple[int, float]:
    """Return the index of the threshold with the highest F-score, and the score: the ODS-F of the set."""
    scores = counts.f_score
    best = int(np.argmax(scores))
    return best, float(scores[best])


def binary_entropy(mask: NDArray[np.bool_]) -> float:
    """Return the entropy of a binary image [bit/px]: 1 if half of its pixels are set, 0 if none or all are."""
    share = float(mask.mean())
    if share in (0.0, 1.0):
        return 0.0
    return float(-share * np.log2(share) - (1 - share) * np.log2(1 - share))
