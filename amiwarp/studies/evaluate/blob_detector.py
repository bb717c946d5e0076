"""Detector of a figure's joints that only checks the plumbing of the pose evaluation. It is no pose estimator."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

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
    distance = ndimage.gaussian_filter(np.abs(picture - np.median(picture)).astype(np.float64), 1.0)
    if not distance.max() > 0.0:
        return {}
    label, count = ndimage.label(distance > 0.5 * distance.max())
    largest = 1 + int(np.argmax(ndimage.sum_labels(np.ones_like(distance), label, np.arange(1, count + 1))))
    rows, columns = ndimage.find_objects(label)[largest - 1]
    low = np.array([columns.start, rows.start], np.float64)
    size = np.array([columns.stop - columns.start - 1, rows.stop - rows.start - 1], np.float64)
    return {name: low + size * np.array(share) for name, share in PROPORTIONS.items()}
