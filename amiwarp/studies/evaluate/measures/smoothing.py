"""Gaussian smoothing of images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.studies.evaluate.measures.libraries import library

if TYPE_CHECKING:
    from numpy.typing import NDArray


def smoothed(image: NDArray[Any], sigma: float, *, truncate: float = 4.0, mirrored: bool = True) -> NDArray[np.float32]:
    """Return an image smoothed by a Gaussian of standard deviation ``sigma`` [px]; OpenCV is the fastest on one core.

    ``truncate``: radius at which the Gaussian ends [standard deviations]. Outside, the image is ``mirrored``, or zero.
    """
    plain, cv2 = np.ascontiguousarray(image, np.float32), library("cv2")
    if sigma <= 0.0:
        return plain
    side = 2 * int(truncate * sigma + 0.5) + 1
    border = cv2.BORDER_REFLECT if mirrored else cv2.BORDER_CONSTANT
    return np.asarray(cv2.GaussianBlur(plain, (side, side), sigma, borderType=border), np.float32)
