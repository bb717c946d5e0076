"""Widths of the edges on which events lie: what is left of the motion after compensation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

NEAR_PX = 2.0
"""Standard deviation of the Gaussian weights of the events near an event [px]."""
WIDEST_PX = 3.0 * NEAR_PX
"""Largest residual [px]. Wider edges look the same as spread events."""
ROUNDING_VARIANCE = 1.0 / 12.0
"""Variance that rounding to a pixel adds to the place of an event in an image [px²]."""
WIDE_EVENTS = 2.0
"""Number of spread events that are assumed near each event, so that a lone event has a large residual."""


def outside(xy: NDArray[np.float32], rows: slice, columns: slice) -> NDArray[np.bool_]:
    """Return which points lie outside rows and columns of an image, shape ``(n,)``. Points that are not finite do."""
    column = np.rint(xy[:, 0])
    row = np.rint(xy[:, 1])
    in_columns = (column >= columns.start) & (column < columns.stop)
    in_rows = (row >= rows.start) & (row < rows.stop)
    return np.asarray(~(in_columns & in_rows), np.bool_)


def at_pixels(image: NDArray[Any], xy: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the image's value at each point, shape ``(n,)``; NaN outside the image."""
    height, width = image.shape
    known = ~outside(xy, slice(0, height), slice(0, width))
    column, row = np.rint(xy[known]).astype(np.int64).T
    values = np.full(len(xy), np.nan)
    values[known] = image[row, column]
    return values


def residual(
    image: NDArray[np.float32], xy: NDArray[np.float32], where: tuple[slice, slice] = (slice(None), slice(None))
) -> NDArray[np.float64]:
    """Return the width of the edge at each point, or what is left of the prism's motion [px], shape ``(n,)``.

    It is the standard deviation across the edge of the events near the point: near 0 on a sharp edge, and
    :data:`WIDEST_PX` among spread events. The event itself does not count. Outside the rows and columns ``where``, in
    which it is computed, it is unknown: NaN.
    """
    width_at = np.full(image.shape, np.nan)
    spread = _spread_across_edges(image, where)
    # Gaussian weights of variance n² and an edge of variance w² give a spread of 1 / (1 / n² + 1 / w²).
    variance = spread * NEAR_PX**2 / np.maximum(NEAR_PX**2 - spread, 1e-6) - ROUNDING_VARIANCE
    width_at[where] = np.sqrt(np.clip(variance, 1e-6, WIDEST_PX**2))
    return at_pixels(width_at, xy)


def _spread_across_edges(image: NDArray[np.float32], where: tuple[slice, slice]) -> NDArray[np.float64]:
    """Return the smallest variance, over all directions, of the weighted events about each pixel [px²].

    The variance is about the mean of these events, so that it is the same on both sides of an edge and on its middle.
    Sums with weights G of variance s are s G' for the places, and s G + s² G'' for their squares, so they follow from
    derivatives of the smoothed image.
    """
    from scipy.ndimage import gaussian_filter

    reach, near = 4 * math.ceil(NEAR_PX), NEAR_PX**2
    rows, columns = (range(size)[axis] for size, axis in zip(image.shape, where, strict=True))
    top, left = max(rows.start - reach, 0), max(columns.start - reach, 0)
    part = image[top : rows.stop + reach, left : columns.stop + reach].astype(np.float64)
    orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    smooth, y, x, yy, xy, xx = (gaussian_filter(part, NEAR_PX, order=order, mode="constant") for order in orders)
    own = 1.0 / (math.tau * near)
    density = np.maximum(smooth - own, 0.0) + WIDE_EVENTS * own
    mean_y, mean_x = near * y / density, near * x / density
    yy, xx = (near + near**2 * (second + own / near) / density for second in (yy, xx))
    yy, xx = yy - mean_y**2, xx - mean_x**2
    xy = near**2 * xy / density - mean_x * mean_y
    spread = np.clip(0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy), 0.0, near)
    return np.asarray(spread[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left])
