"""Joints of a figure: accuracy of detected ones, and a detector that only checks the plumbing of the evaluation."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.errors import AmiwarpError

PROPORTIONS: dict[str, tuple[float, float]] = {
    "head": (0.5, 0.07),
    "left shoulder": (0.35, 0.2), "right shoulder": (0.65, 0.2),
    "left elbow": (0.3, 0.37), "right elbow": (0.7, 0.37),
    "left wrist": (0.3, 0.5), "right wrist": (0.7, 0.5),
    "left hip": (0.42, 0.48), "right hip": (0.58, 0.48),
    "left knee": (0.42, 0.72), "right knee": (0.58, 0.72),
    "left ankle": (0.42, 0.94), "right ankle": (0.58, 0.94),
}  # fmt: skip
"""Place of each joint in the bounding box of a standing figure, as shares of its width and height from the top left."""


def blob_keypoints(picture: NDArray[Any]) -> dict[str, NDArray[np.float64]]:
    """Return joints [px] by name, in fixed proportions of the bounding box of the picture's largest blob.

    The blob is the largest connected region whose smoothed distance from the median exceeds half its maximum. This
    checks the plumbing only: the joints of a real figure are elsewhere, and in a textured scene the blob is often
    another object. A uniform picture has no joints.
    """
    from_median = np.abs(picture - np.median(picture)).astype(np.float64)
    distance = ndimage.gaussian_filter(from_median, 1.0)
    most = distance.max()
    if not most > 0.0:
        return {}
    blobs, _ = ndimage.label(distance > 0.5 * most)
    sizes = np.bincount(blobs.ravel())[1:]  # without the background, whose label is 0
    largest = int(np.argmax(sizes))

    rows, columns = ndimage.find_objects(blobs)[largest]
    top_left = np.array([columns.start, rows.start], np.float64)
    bottom_right = np.array([columns.stop - 1, rows.stop - 1], np.float64)
    size = bottom_right - top_left
    return {name: top_left + size * np.array(share) for name, share in PROPORTIONS.items()}


Detector = Callable[[NDArray[Any]], Mapping[str, NDArray[Any]]]
"""Function that returns the joints (x, y) [px] by name in a grey picture with values from 0 to 255; missing ones are
left out. The names are the world's."""


def detected_joints(
    found: NDArray[Any], truth: NDArray[Any], torso_px: float, *, fraction: float = 0.2
) -> float:
    """Return the percentage of detected joints (PDJ), as a share from 0 to 1.

    A joint counts as detected if it is closer to its true place than ``fraction`` of the torso's diameter. ``found``
    and ``truth``: joints in the same order [px], shape (n, 2). A joint that was not found is NaN and counts as not
    detected. True joints that are NaN, as outside the view, do not count. The result is NaN if no true joint counts.

    Source: B. Sapp and B. Taskar, "MODEC: Multimodal Decomposable Models for Human Pose Estimation", CVPR 2013; the
    diameter is the distance from the left shoulder to the right hip.
    Raises :class:`AmiwarpError` for different shapes.
    """
    if found.shape != truth.shape or truth.ndim != 2 or truth.shape[1] != 2:
        raise AmiwarpError(
            f"found and true joints have shapes {found.shape} and {truth.shape}; give (n, 2) twice"
        )
    known = np.isfinite(truth).all(axis=1)
    if not known.any():
        return float("nan")
    away = found[known] - truth[known]
    distance = np.hypot(away[:, 0], away[:, 1])
    # A comparison with NaN is false.
    detected = distance < fraction * torso_px
    return float(detected.mean())


def box_overlap(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return the intersection over union of the bounding boxes of two point sets, shapes (n, 2) and (m, 2).

    Points that are not finite do not count. The result is 0 if a set has no points or a box has no area.
    """
    a = a[np.isfinite(a).all(axis=1)]
    b = b[np.isfinite(b).all(axis=1)]
    if not len(a) or not len(b):
        return 0.0
    low = np.stack([a.min(axis=0), b.min(axis=0)])
    high = np.stack([a.max(axis=0), b.max(axis=0)])
    areas = np.prod(high - low, axis=1)

    # The intersection is a box, too; without one, a side is negative.
    sides = high.min(axis=0) - low.max(axis=0)
    shared = float(np.prod(np.maximum(sides, 0.0)))
    union = float(areas.sum()) - shared
    return shared / union if union > 0.0 else 0.0
