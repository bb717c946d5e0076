"""Agreement of a set of events or pixels with the true set."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.studies.evaluate.event_images import pixel_index
from amiwarp.studies.evaluate.libraries import library


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
        raise AmiwarpError(
            f"found and true masks have shapes {found.shape} and {truth.shape}; give equal shapes"
        )
    both = int(np.count_nonzero(found & truth))

    def share_of(mask: NDArray[np.bool_]) -> float:
        count = int(np.count_nonzero(mask))
        return both / count if count else float("nan")

    return Overlap(iou=share_of(found | truth), precision=share_of(found), recall=share_of(truth))


def hull(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels in the convex hull of the pixels of a mask."""
    cv2 = library("cv2")
    filled = np.zeros(mask.shape, np.uint8)
    if mask.any():
        # OpenCV takes (x, y).
        places = np.argwhere(mask)[:, ::-1].astype(np.int32)
        cv2.fillConvexPoly(filled, cv2.convexHull(places), 1)
    return filled > 0


def object_ious(
    events: Events, number: NDArray[np.intp], bodies: Sequence[NDArray[np.bool_]]
) -> list[float]:
    """Return for each body the IoU of the convex hulls of its pixels and of the events of the best cluster.

    It does not depend on how many events the body and the background have. ``number``: cluster of each event, 0 for
    none. ``bodies``: pixels of each body, shape (height, width).
    """
    clusters = []
    for cluster in range(1, int(number.max(initial=0)) + 1):
        mask = np.zeros_like(bodies[0])
        height, width = mask.shape
        mask.ravel()[pixel_index(events[number == cluster], (width, height))] = True
        clusters.append(mask)
    return best_ious(clusters, bodies)


def best_ious(
    clusters: Sequence[NDArray[np.bool_]], bodies: Sequence[NDArray[np.bool_]]
) -> list[float]:
    """Return for each body the IoU of its convex hull with the best cluster's; all are pixels of an image."""
    hulls = [hull(cluster) for cluster in clusters]
    ious = []
    for body in bodies:
        true_hull = hull(body)
        ious.append(max((overlap(found, true_hull).iou for found in hulls), default=0.0))
    return ious
