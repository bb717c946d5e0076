"""Optical flow between two pictures, and pictures warped by it. OpenCV does both."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import optional_module

CONSISTENT_PX = 1.0
"""Largest distance from a pixel to where the flow forward and back leads it; beyond, the flow is not known [px]."""
WHITE_PERCENTILE = 99.8
"""Percentile of the light that becomes white in the 8-bit pictures of which the flow is computed."""
SMALLEST_SIDE = 16
"""Smallest width and height of pictures whose flow can be computed [px]."""


def load_opencv() -> Any:
    """Return OpenCV. Raises :class:`AmiwarpError` if it is not installed."""
    return optional_module(
        "cv2", "translate", "motion between pictures needs OpenCV, unlike interpolation 'blend'"
    )


@contextlib.contextmanager
def limited_opencv(cv2: Any, threads: int = 1) -> Iterator[Any]:
    """Yield OpenCV, which uses a number of threads within the block. Its flow depends on that number."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
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
    first_white = float(np.percentile(first, WHITE_PERCENTILE))
    second_white = float(np.percentile(second, WHITE_PERCENTILE))
    white = max(first_white, second_white, 1e-6)
    first_bytes = _display_bytes(first, white)
    second_bytes = _display_bytes(second, white)
    with limited_opencv(load_opencv()) as cv2:
        method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        method.setFinestScale(0)
        forward = method.calc(first_bytes, second_bytes, None)
        back = method.calc(second_bytes, first_bytes, None)

    # Both agree where the way forward and back ends near its start, and does not leave the picture.
    height, width = first.shape
    y, x = np.indices(first.shape, np.float32)
    to_x = x + forward[..., 0]
    to_y = y + forward[..., 1]
    inside = (to_x >= 0.0) & (to_x <= width - 1.0) & (to_y >= 0.0) & (to_y <= height - 1.0)
    away_x = forward[..., 0] + warped(back[..., 0], forward)
    away_y = forward[..., 1] + warped(back[..., 1], forward)
    consistent = np.hypot(away_x, away_y) <= CONSISTENT_PX
    return forward, back, inside & consistent


def _display_bytes(light: NDArray[np.float32], white: float) -> NDArray[np.uint8]:
    """Return a picture of 8 bits with the gamma of displays; the luminance ``white`` and more is white."""
    display = np.clip(light / white, 0.0, 1.0) ** (1.0 / 2.2)
    return (255.0 * display).astype(np.uint8)


def warped(picture: NDArray[np.float32], offset: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the picture seen at each pixel plus ``offset``, shape (height, width, 2) [px]; its border is repeated."""
    y, x = np.indices(picture.shape, np.float32)
    with limited_opencv(load_opencv()) as cv2:
        out = cv2.remap(
            np.ascontiguousarray(picture),
            x + offset[..., 0],
            y + offset[..., 1],
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return np.asarray(out, np.float32)
