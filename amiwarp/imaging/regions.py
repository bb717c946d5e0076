"""Regions of the image: their events, and the region in which compensation gains most sharpness."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Sharpness
from amiwarp.events.recording import Events
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.export import PERCENTILE
from amiwarp.imaging.relative_variance import random_variance, relative_variance
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.imaging.uploaded_events import UploadedEvents
from amiwarp.imaging.votes import Votes
from amiwarp.optics.models.base import Model

Vector = NDArray[np.float64]
Floats = NDArray[np.float32]

Region = tuple[int, int, int, int]
"""Part of the image: left, top, right and bottom [px]; right and bottom are exclusive."""

SMOOTHING_PX = 1.0
"""Standard deviation of the Gaussian that smooths the image before its sharpness is measured, as in calibration [px].
"""
WIDEST = 120
NARROWEST = 60
"""Largest width of a suggested region, and its width on a small sensor or if there are very many events [px]."""
CLEAR_EVENTS = 50_000
"""Number of events above which a narrower region is suggested, because so many points hide each other in the cloud."""
LEAST_SIGMA = 5.0
"""Smallest gain of variance over mean that shows an effect, in standard deviations that it has for random events."""
NEARLY_BEST = 0.5
"""Share of the largest gain of variance from which a region is a candidate. The candidate whose sharpness gains the
largest factor is chosen.

The variance grows with the square of the number of events, so that nearly empty regions are no candidates.
"""
MOST_SEARCHED = 1 << 22
BLOCK_PX = 64
"""Largest number of pixels that are searched; of a larger image, the square with most events, in steps of
:data:`BLOCK_PX` [px]."""
LEAST_SHARE = 0.8
"""Smallest ratio of the number of recorded events to the number of compensated events in a candidate: its edges do not
come from outside."""


def inside(events: Events, region: Region) -> NDArray[np.bool_]:
    """Return whether each event lies in a region, shape ``(n,)``."""
    left, top, right, bottom = region
    in_columns = (events.x >= left) & (events.x < right)
    in_rows = (events.y >= top) & (events.y < bottom)
    return in_columns & in_rows


class RegionSharpness:
    """Measures the sharpness of a region of warped events, as calibration does: bilinear votes at dithered places.

    It owns its buffers, so only one thread may use it.
    """

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        self._votes = Votes(CanvasShape(*size, dither=True), device)
        self._device = device
        self._meter: SharpnessMeter | None = None

    def measure(
        self,
        model: Model,
        events: UploadedEvents,
        offset_us: float,
        region: Region,
    ) -> tuple[float, float]:
        """Return variance and sharpness of the smoothed region.

        The variance over mean, as :attr:`amiwarp.Sharpness.VARIANCE`, grows with the number of events. The sharpness,
        see :func:`amiwarp.imaging.relative_variance.relative_variance`, does not depend on it. ``offset_us`` is added
        to the encoder's clock offset [us].
        """
        self._votes.add_events(model, events, drift=offset_us)
        left, top, right, bottom = region
        meter = self._meter_of(right - left, bottom - top)
        image = self._votes.take()[0]
        part = image[top:bottom, left:right]
        meter.image.write(part[None])
        variance = meter.measure()
        mean = float(part.mean())
        if not mean > 0.0:
            return variance, 0.0
        return variance, relative_variance(variance, mean, SMOOTHING_PX)

    def _meter_of(self, width: int, height: int) -> SharpnessMeter:
        """Return the meter of regions of a size: the last one if it fits."""
        canvas = CanvasShape(width, height, dither=True)
        meter = self._meter
        if meter is None or meter.image.shape != canvas.shape:
            meter = SharpnessMeter(
                canvas,
                Sharpness.VARIANCE,
                smoothing=SMOOTHING_PX,
                device=self._device,
            )
            self._meter = meter
        return meter


def suggest_region(before: Floats, after: Floats, *, margin: int = 0) -> Region:
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
        region_of_part = suggest_region(before[part], after[part], margin=margin)
        found_left, found_top, found_right, found_bottom = region_of_part
        return left + found_left, top + found_top, left + found_right, top + found_bottom

    # The wider, the better, but for regions of very many events.
    flatness = min(rows / columns, 1.0)
    width = min(columns, WIDEST, max(columns // 3, NARROWEST))
    while True:
        height = min(rows, max(1, round(width * flatness)))
        left, top = best_box(before, after, width, height, margin)
        right = left + width
        bottom = top + height
        events = float(before[top:bottom, left:right].sum())
        if events <= CLEAR_EVENTS or width <= NARROWEST:
            return left, top, right, bottom
        clear_width = int(width * (CLEAR_EVENTS / events) ** 0.5)
        width = max(NARROWEST, min(width - 1, clear_width))


def busiest(image: Floats) -> Region:
    """Return the part of a large image, of at most :data:`MOST_SEARCHED` pixels, that has most events."""
    image_height, image_width = image.shape
    first_rows = range(0, image_height, BLOCK_PX)
    first_columns = range(0, image_width, BLOCK_PX)
    strips = np.add.reduceat(image, first_rows, axis=0)
    blocks = np.add.reduceat(strips, first_columns, axis=1).astype(np.float64)
    rows, columns = blocks.shape

    side = math.isqrt(MOST_SEARCHED) // BLOCK_PX
    height = min(side, rows)
    width = min(side, columns)
    means = _box_means(blocks, width, height)
    row, column = np.unravel_index(int(np.argmax(means)), means.shape)
    top = BLOCK_PX * int(row)
    left = BLOCK_PX * int(column)
    right = min(left + BLOCK_PX * width, image_width)
    bottom = min(top + BLOCK_PX * height, image_height)
    return left, top, right, bottom


def best_box(
    before: Floats,
    after: Floats,
    width: int,
    height: int,
    margin: int,
) -> tuple[int, int]:
    """Return left and top of the box of a size in which compensation gains most; without a gain, of most structure.

    ``margin``: distance of the box from the border of the image, if the image is large enough [px].
    """
    image_height, image_width = before.shape
    width = min(width, image_width)
    height = min(height, image_height)
    mean, over_mean = _of_boxes(before, width, height)
    mean_after, over_mean_after = _of_boxes(after, width, height)
    noise = random_variance(SMOOTHING_PX)

    # the variance of random events stays in the divisor, so that a region without structure has no arbitrary factor
    relative_after = (over_mean_after - noise) / mean_after
    factor = relative_after / (np.maximum(over_mean, noise) / mean)
    variance = mean_after * over_mean_after - mean * over_mean
    comes_from_inside = mean >= LEAST_SHARE * mean_after
    variance = np.where(comes_from_inside, variance, 0.0)

    # The boxes within the margin; at least the middle is searched.
    rows, columns = variance.shape
    row_margin = min(margin, (rows - 1) // 2)
    column_margin = min(margin, (columns - 1) // 2)
    inner_rows = slice(row_margin, rows - row_margin)
    inner_columns = slice(column_margin, columns - column_margin)
    inner = (inner_rows, inner_columns)

    gain = (over_mean_after - over_mean)[inner].max()
    least_gain = LEAST_SIGMA * noise * (2.0 / (width * height)) ** 0.5
    if gain <= least_gain:
        variance = mean * over_mean
        factor = variance
    candidates = np.full(variance.shape, -np.inf)
    nearly_best = variance[inner] >= NEARLY_BEST * variance[inner].max()
    candidates[inner] = np.where(nearly_best, factor[inner], -np.inf)
    top, left = np.unravel_index(int(np.argmax(candidates)), candidates.shape)
    return int(left), int(top)


def _of_boxes(image: Floats, width: int, height: int) -> tuple[Vector, Vector]:
    """Return mean, and variance over mean, of all boxes in a smoothed image, indexed by top and left.

    Counts are limited, so that hot pixels are not taken for structure.
    """
    from scipy.ndimage import gaussian_filter

    positive = image[image > 0.0]
    limit = float(np.percentile(positive, PERCENTILE)) if positive.size else 1.0
    limited = np.minimum(image, limit).astype(np.float64)
    smoothed = gaussian_filter(limited, SMOOTHING_PX, mode="constant")
    mean = np.maximum(_box_means(smoothed, width, height), 1e-6)
    square = _box_means(smoothed**2, width, height)
    over_mean = square / mean - mean
    return mean, np.maximum(over_mean, 0.0)


def _box_means(values: Vector, width: int, height: int) -> Vector:
    """Return the mean over each box that lies in the image, indexed by top and left."""
    padded = np.pad(values, ((1, 0), (1, 0)))
    sums = padded.cumsum(axis=0).cumsum(axis=1)
    in_box = (
        sums[height:, width:]
        - sums[:-height, width:]
        - sums[height:, :-width]
        + sums[:-height, :-width]
    )
    return np.asarray(in_box / (width * height), np.float64)
