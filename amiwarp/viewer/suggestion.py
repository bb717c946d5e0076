"""Region of the image that the inspector shows first: where compensation gains most sharpness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.imaging.export import PERCENTILE
from amiwarp.imaging.sharpness_costs import random_variance
from amiwarp.viewer.imager import SMOOTHING_PX

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.imager import Region

WIDEST, NARROWEST = 120, 60
"""Largest width of a suggested region, and its width on a small sensor [px]."""
LEAST_SIGMA = 5.0
"""Smallest gain of variance over mean, in standard deviations of that of random events, that shows an effect."""
NEARLY_BEST = 0.5
"""Share of the largest gain of variance from which a region is a candidate. The candidate with the largest gain of
sharpness is chosen.

The variance grows with the square of the number of events, so that nearly empty regions are no candidates.
"""

LEAST_SHARE = 0.8
"""Smallest ratio of the number of recorded events to that of compensated events in a candidate: its edges do not come
from outside."""


@dataclass(frozen=True)
class Suggestion:
    """Suggested region of the image."""

    region: Region
    """Left, top, right and bottom [px]; right and bottom are exclusive."""
    gains: bool
    """Whether compensation with the current parameters sharpens the region. Otherwise, the region has most structure.
    """


def suggest_region(before: NDArray[np.float32], after: NDArray[np.float32]) -> Suggestion:
    """Return the region in which compensation gains most sharpness.

    If it gains nothing anywhere, return the region of the recorded image that has most structure. ``before`` and
    ``after`` are images of the same events as recorded and compensated [events per pixel], shape ``(height, width)``.
    """
    rows, columns = before.shape
    width = min(columns, WIDEST, max(columns // 3, NARROWEST))
    height = min(rows, max(1, round(width * min(rows / columns, 1.0))))
    mean, over_mean = _of_boxes(before, width, height)
    mean_after, over_mean_after = _of_boxes(after, width, height)
    noise = random_variance(SMOOTHING_PX)
    sharp, sharp_after = (over_mean - noise) / mean, (over_mean_after - noise) / mean_after
    variance, sharper = mean_after * over_mean_after - mean * over_mean, sharp_after - sharp
    variance = np.where(mean >= LEAST_SHARE * mean_after, variance, 0.0)
    gains = bool((over_mean_after - over_mean).max() > LEAST_SIGMA * noise * (2.0 / (width * height)) ** 0.5)
    if not gains:
        variance = sharper = mean * over_mean
    candidates = np.where(variance >= NEARLY_BEST * variance.max(), sharper, -np.inf)
    top, left = np.unravel_index(int(np.argmax(candidates)), candidates.shape)
    return Suggestion((int(left), int(top), int(left) + width, int(top) + height), gains)


def _of_boxes(image: NDArray[np.float32], width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean, and variance over mean, of all boxes in a smoothed image, indexed by top and left.

    Counts are limited, so that hot pixels are not taken for structure.
    """
    from scipy.ndimage import gaussian_filter

    positive = image[image > 0.0]
    limit = float(np.percentile(positive, PERCENTILE)) if positive.size else 1.0
    smoothed = gaussian_filter(np.minimum(image, limit).astype(np.float64), SMOOTHING_PX, mode="constant")
    mean, square = (_box_means(values, width, height) for values in (smoothed, smoothed**2))
    mean = np.maximum(mean, 1e-6)
    return mean, np.maximum(square / mean - mean, 0.0)


def _box_means(values: NDArray[np.float64], width: int, height: int) -> NDArray[np.float64]:
    """Return the mean over each box that lies in the image, indexed by top and left."""
    sums = np.pad(values, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    both = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    return np.asarray(both / (width * height), np.float64)
