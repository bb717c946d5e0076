"""Regions of the image: their events, and the region in which compensation gains most sharpness."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Sharpness
from amiwarp.events.recording import Events
from amiwarp.imaging.export import PERCENTILE
from amiwarp.imaging.iwe import CanvasShape, UploadedEvents, Votes
from amiwarp.imaging.sharpness import SharpnessMeter, random_variance, relative_variance
from amiwarp.optics.models import Model

Region = tuple[int, int, int, int]
"""Part of the image: left, top, right and bottom [px]; right and bottom are exclusive."""

SMOOTHING_PX = 1.0
"""Standard deviation of the Gaussian that smooths the image before its sharpness is measured, as in calibration [px].
"""
WIDEST, NARROWEST = 120, 60
"""Largest width of a suggested region, and its width on a small sensor or if there are very many events [px]."""
CLEAR_EVENTS = 50_000
"""Number of events above which a narrower region is suggested, because so many points hide each other in the cloud."""
LEAST_SIGMA = 5.0
"""Smallest gain of variance over mean, in standard deviations of that of random events, that shows an effect."""
NEARLY_BEST = 0.5
"""Share of the largest gain of variance from which a region is a candidate. The candidate whose sharpness gains the
largest factor is chosen.

The variance grows with the square of the number of events, so that nearly empty regions are no candidates.
"""
MOST_SEARCHED, BLOCK_PX = 1 << 22, 64
"""Largest number of pixels that are searched; of a larger image, the square with most events, in steps of
:data:`BLOCK_PX` [px]."""
LEAST_SHARE = 0.8
"""Smallest ratio of the number of recorded events to that of compensated events in a candidate: its edges do not come
from outside."""


def inside(events: Events, region: Region) -> NDArray[np.bool_]:
    """Return whether each event lies in a region, shape ``(n,)``."""
    left, top, right, bottom = region
    return (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)


class RegionSharpness:
    """Measures the sharpness of a region of warped events, as calibration does: bilinear votes at dithered places.

    It owns its buffers, so only one thread may use it.
    """

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        self._votes, self._device = Votes(CanvasShape(*size, dither=True), device), device
        self._meter: SharpnessMeter | None = None

    def measure(self, model: Model, events: UploadedEvents, offset_us: float, region: Region) -> tuple[float, float]:
        """Return variance and sharpness of the smoothed region.

        The variance over mean, as :attr:`amiwarp.Sharpness.VARIANCE`, grows with the number of events. The sharpness,
        see :func:`amiwarp.imaging.sharpness.relative_variance`, does not depend on it. ``offset_us`` is added to the
        encoder's clock offset [us].
        """
        self._votes.add_events(model, events, drift=offset_us)
        left, top, right, bottom = region
        canvas, meter = CanvasShape(right - left, bottom - top, dither=True), self._meter
        if meter is None or meter.image.shape != canvas.shape:
            meter = SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=SMOOTHING_PX, device=self._device)
            self._meter = meter
        part = self._votes.take()[0][top:bottom, left:right]
        meter.image.write(part[None])
        variance, mean = meter.measure(), float(part.mean())
        return variance, relative_variance(variance, mean, SMOOTHING_PX) if mean > 0.0 else 0.0


def suggest_region(before: NDArray[np.float32], after: NDArray[np.float32], *, margin: int = 0) -> Region:
    """Return the region in which compensation gains most sharpness.

    If it gains nothing anywhere, return the region of the recorded image that has most structure. ``before`` and
    ``after`` are images of the same events as recorded and compensated [events per pixel], shape ``(height, width)``.
    ``margin``: distance that the region keeps from the border of the image if it can [px]. If it is the radius of the
    orbit, no events of the region were outside of the image during a part of the turn.
    """
    rows, columns = before.shape
    if before.size > MOST_SEARCHED:
        left, top, right, bottom = busiest(before)
        part = np.s_[top:bottom, left:right]
        x0, y0, x1, y1 = suggest_region(before[part], after[part], margin=margin)
        return left + x0, top + y0, left + x1, top + y1
    width = min(columns, WIDEST, max(columns // 3, NARROWEST))
    while True:
        height = min(rows, max(1, round(width * min(rows / columns, 1.0))))
        left, top = best_box(before, after, width, height, margin)
        events = float(before[top : top + height, left : left + width].sum())
        if events <= CLEAR_EVENTS or width <= NARROWEST:
            return left, top, left + width, top + height
        width = max(NARROWEST, min(width - 1, int(width * (CLEAR_EVENTS / events) ** 0.5)))


def busiest(image: NDArray[np.float32]) -> Region:
    """Return the part of a large image, of at most :data:`MOST_SEARCHED` pixels, that has most events."""
    side = math.isqrt(MOST_SEARCHED) // BLOCK_PX
    rows, columns = (-(-size // BLOCK_PX) for size in image.shape)
    blocks = np.add.reduceat(np.add.reduceat(image, range(0, image.shape[0], BLOCK_PX), axis=0),
                             range(0, image.shape[1], BLOCK_PX), axis=1).astype(np.float64)  # fmt: skip
    height, width = min(side, rows), min(side, columns)
    means = _box_means(blocks, width, height)
    top, left = (BLOCK_PX * int(k) for k in np.unravel_index(int(np.argmax(means)), means.shape))
    right, bottom = min(left + BLOCK_PX * width, image.shape[1]), min(top + BLOCK_PX * height, image.shape[0])
    return left, top, right, bottom


def best_box(
    before: NDArray[np.float32], after: NDArray[np.float32], width: int, height: int, margin: int
) -> tuple[int, int]:
    """Return left and top of the box of a size in which compensation gains most; without a gain, of most structure.

    ``margin``: distance of the box from the border of the image, if the image is large enough [px].
    """
    width, height = (min(size, limit) for size, limit in zip((width, height), before.shape[::-1], strict=True))
    mean, over_mean = _of_boxes(before, width, height)
    mean_after, over_mean_after = _of_boxes(after, width, height)
    noise = random_variance(SMOOTHING_PX)
    # the variance of random events stays in the divisor, so that a region without structure has no arbitrary factor
    factor = (over_mean_after - noise) / mean_after / (np.maximum(over_mean, noise) / mean)
    variance = mean_after * over_mean_after - mean * over_mean
    variance = np.where(mean >= LEAST_SHARE * mean_after, variance, 0.0)
    margins = (min(margin, (n - 1) // 2) for n in variance.shape)  # at least the middle is searched
    inner = tuple(slice(m, n - m) for m, n in zip(margins, variance.shape, strict=True))
    if (over_mean_after - over_mean)[inner].max() <= LEAST_SIGMA * noise * (2.0 / (width * height)) ** 0.5:
        variance = factor = mean * over_mean
    candidates = np.full(variance.shape, -np.inf)
    candidates[inner] = np.where(variance[inner] >= NEARLY_BEST * variance[inner].max(), factor[inner], -np.inf)
    top, left = np.unravel_index(int(np.argmax(candidates)), candidates.shape)
    return int(left), int(top)


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
