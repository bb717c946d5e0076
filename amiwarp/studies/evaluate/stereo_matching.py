"""Disparity between two images by semi-global matching, and its errors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.studies.evaluate.libraries import library

BLOCK_PX = 9
"""Side of the blocks that are compared [px]."""
LARGEST_PX = 64
"""Disparities below this one are searched [px]."""
STEP_COST = 8 * BLOCK_PX**2
JUMP_COST = 32 * BLOCK_PX**2
"""Costs of a change of the disparity by one pixel, and by more, as OpenCV's manual recommends for grey pictures."""
BOTH_WAYS_PX = 1
"""Largest difference of the disparities from left to right and back [px]."""
EDGE_CAP = 31
"""Slope at which the grey values are clipped before they are compared."""
UNIQUE_PERCENT = 10
"""Margin by which the best disparity must win over the others [percent]."""
SUBPIXELS = 16
"""Number of OpenCV's units in a pixel."""
OUTLIER_PX = 1.0
"""Error above which a disparity is an outlier [px]: the error "1PE" of the data set DSEC."""


def match(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the disparity of the left image's pixels [px], shape (height, width); NaN where none is found.

    Source: H. Hirschmüller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008, in OpenCV's
    variant along eight directions. Regions are not filtered by their size.
    """
    cv2 = library("cv2")
    matcher = cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=LARGEST_PX,
        blockSize=BLOCK_PX,
        P1=STEP_COST,
        P2=JUMP_COST,
        disp12MaxDiff=BOTH_WAYS_PX,
        preFilterCap=EDGE_CAP,
        uniquenessRatio=UNIQUE_PERCENT,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    # OpenCV leaves out as many columns at the left as there are disparities.
    wide = [np.pad(image, ((0, 0), (LARGEST_PX, 0))) for image in (left, right)]
    found = matcher.compute(*wide)[:, LARGEST_PX:].astype(np.float32) / SUBPIXELS
    return np.where(found < 0.0, np.float32(np.nan), found)


@dataclass(frozen=True, slots=True)
class DisparityError:
    """Errors of disparities at edges."""

    complete: float
    """Share of the edge pixels that have a disparity; NaN without edges."""
    median: float
    """Median error of these [px]; NaN if there are none."""
    outliers: float
    """Share of these whose error is above :data:`OUTLIER_PX`; NaN if there are none."""
    right: float
    """Share of the edge pixels that have a disparity with a smaller error; NaN without edges."""


def disparity_error(
    found: NDArray[np.floating], truth: NDArray[np.floating], edges: NDArray[np.bool_]
) -> DisparityError:
    """Compare disparities with the true ones [px] at edges, all of shape (height, width). NaN: none is found."""
    count = int(edges.sum())
    error = np.abs(found - truth)[edges]
    error = error[np.isfinite(error)]
    nothing = float("nan")
    if not count:
        return DisparityError(nothing, nothing, nothing, nothing)
    if not error.size:
        return DisparityError(0.0, nothing, nothing, 0.0)
    is_outlier = error > OUTLIER_PX
    return DisparityError(
        complete=error.size / count,
        median=float(np.median(error)),
        outliers=float(is_outlier.mean()),
        right=float((~is_outlier).sum() / count),
    )
