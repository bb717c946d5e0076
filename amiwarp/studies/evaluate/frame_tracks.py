"""Tracks of corners through the frames of a standard camera, by OpenCV."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from amiwarp.studies.evaluate.corner_tracks import Tracks, sorted_tracks
from amiwarp.studies.evaluate.libraries import library

MOST_CORNERS = 500
"""Largest number of corners that a frame adds to those that are tracked."""
QUALITY = 0.01
"""Least quality of a corner, relative to the best."""
LEAST_DISTANCE_PX = 5.0
"""Least distance between corners [px]."""
LARGEST_RETURN_PX = 1.0
"""Largest distance between a corner and the same corner tracked to the next frame and back [px]."""


def track_frames(grey: Sequence[NDArray[np.uint8]], t_us: Sequence[int]) -> Tracks:
    """Track corners through the frames of a standard camera (Shi and Tomasi; Lucas and Kanade, by OpenCV).

    ``t_us``: times of the frames [us]. In each frame, new corners are added away from those that are tracked. The
    ``index`` of a point is the index of its frame.
    """
    number = np.zeros(0, np.int64)
    xy = np.zeros((0, 2), np.float32)
    numbers = []
    places = []
    indices = []
    total = 0
    for k, frame in enumerate(grey):
        if k and len(xy):
            moved, is_tracked = _tracked(grey[k - 1], frame, xy)
            number = number[is_tracked]
            xy = moved[is_tracked]
        new = _new_corners(frame, xy)
        number = np.concatenate([number, total + np.arange(len(new))])
        xy = np.concatenate([xy, new])
        total = total + len(new)
        numbers.append(number)
        places.append(xy)
        indices.append(np.full(len(xy), k, np.int64))
    index = np.concatenate(indices)
    times = np.asarray(t_us, np.int64)[index]
    return sorted_tracks(np.concatenate(numbers), times, np.concatenate(places), index)


def _tracked(
    before: NDArray[np.uint8], frame: NDArray[np.uint8], xy: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where corners of the frame before are [px], and whether tracking back leads to where they were."""
    cv2 = library("cv2")
    moved, was_found, _ = cv2.calcOpticalFlowPyrLK(before, frame, xy, None)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(frame, before, moved, None)
    away = back - xy
    returns = np.hypot(away[:, 0], away[:, 1]) < LARGEST_RETURN_PX
    return moved, (was_found.ravel() == 1) & (found_back.ravel() == 1) & returns


def _new_corners(frame: NDArray[np.uint8], xy: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return corners away from the places of known ones [px], shape (n, 2)."""
    cv2 = library("cv2")
    free = np.full(frame.shape, 255, np.uint8)
    for x, y in np.rint(xy).astype(int).tolist():
        cv2.circle(free, (x, y), round(LEAST_DISTANCE_PX), color=0, thickness=-1)
    corners = cv2.goodFeaturesToTrack(frame, MOST_CORNERS, QUALITY, LEAST_DISTANCE_PX, mask=free)
    if corners is None:
        return np.zeros((0, 2), np.float32)
    return np.asarray(corners.reshape(-1, 2))
