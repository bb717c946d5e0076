"""Optical flow between two pictures, and pictures warped by it. OpenCV does both."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

CONSISTENT_PX = 1.0
"""Largest distance from a pixel to where the flow forward and back leads it; beyond, the flow is not known [px]."""
WHITE_PERCENTILE = 99.8
"""Percentile of the light that becomes white in the 8-bit pictures of which the flow is computed."""
SMALLEST_SIDE = 16
"""Smallest width and height of pictures whose flow can be computed [px]."""


def load_opencv() -> Any:
    """Return OpenCV. Raises :class:`AmiwarpError` if it is not installed."""
    try:
        import cv2
    except ImportError as error:
        raise AmiwarpError(
            "motion between pictures needs OpenCV, which is not installed; "
            "run pip install 'amiwarp[translate]', or choose interpolation 'blend'"
        ) from error
    return cv2


@contextlib.contextmanager
def one_thread() -> Iterator[Any]:
    """Give OpenCV with a single thread: its flow depends on the number of threads."""
    cv2 = load_opencv()
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield cv2
    finally:
        cv2.setNumThreads(before)


def flows(
    first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Return the flow from the first picture to the second, the flow back, and where both agree.

    Pictures are linear luminance of shape (height, width), flows have shape (height, width, 2) [px]. The method is DIS
    (T. Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016). The mask belongs to the first
    picture.
    """
    if min(first.shape) < SMALLEST_SIDE:
        none = np.zeros((*first.shape, 2), np.float32)
        return none, none, np.ones(first.shape, np.bool_)
    white = max(float(np.percentile(first, WHITE_PERCENTILE)), float(np.percentile(second, WHITE_PERCENTILE)), 1e-6)
    with one_thread() as cv2:
        bytes_ = [
            (255.0 * np.clip(light / white, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8) for light in (first, second)
        ]
        method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        method.setFinestScale(0)
        forward, back = method.calc(*bytes_, None), method.calc(*bytes_[::-1], None)
    y, x = np.indices(first.shape, np.float32)
    to_x, to_y = x + forward[..., 0], y + forward[..., 1]
    returned = forward + np.stack([warped(back[..., k], forward) for k in (0, 1)], axis=2)
    inside = (to_x >= 0.0) & (to_x <= first.shape[1] - 1.0) & (to_y >= 0.0) & (to_y <= first.shape[0] - 1.0)
    return forward, back, inside & (np.hypot(returned[..., 0], returned[..., 1]) <= CONSISTENT_PX)


def warped(picture: NDArray[np.float32], offset: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the picture seen at each pixel plus ``offset``, shape (height, width, 2) [px]; its border is repeated."""
    y, x = np.indices(picture.shape, np.float32)
    with one_thread() as cv2:
        at = (x + offset[..., 0], y + offset[..., 1])
        out = cv2.remap(np.ascontiguousarray(picture), *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, np.float32)
