"""Widths of the edges on which events lie: what is left of the motion after compensation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Points = NDArray[np.float32]
"""Points of an image [px], shape (n, 2)."""
Part = tuple[slice, slice]
"""Rows and columns of an image."""

NEAR_PX = 2.0
"""Standard deviation of the Gaussian weights of the events near an event [px]."""
WIDEST_PX = 3.0 * NEAR_PX
"""Largest residual [px]. Wider edges look the same as spread events."""
ROUNDING_VARIANCE = 1.0 / 12.0
"""Variance that rounding to a pixel adds to the place of an event in an image [px²]."""
WIDE_EVENTS = 2.0
"""Number of spread events that are assumed near each event, so that a lone event has a large residual."""


def outside(xy: Points, rows: slice, columns: slice) -> NDArray[np.bool_]:
    """Return which points lie outside rows and columns of an image, shape ``(n,)``. Points that are not finite do."""
    column = np.rint(xy[:, 0])
    row = np.rint(xy[:, 1])
    in_columns = (column >= columns.start) & (column < columns.stop)
    in_rows = (row >= rows.start) & (row < rows.stop)
    inside = in_columns & in_rows
    return np.asarray(~inside, np.bool_)


def at_pixels(image: NDArray[Any], xy: Points) -> Vector:
    """Return the image's value at each point, shape ``(n,)``; NaN outside the image."""
    height, width = image.shape
    known = ~outside(xy, slice(0, height), slice(0, width))
    pixel = np.rint(xy[known]).astype(np.int64)
    column = pixel[:, 0]
    row = pixel[:, 1]
    values = np.full(len(xy), np.nan)
    values[known] = image[row, column]
    return values


def residual(
    image: NDArray[np.float32],
    xy: Points,
    where: Part = (slice(None), slice(None)),
) -> Vector:
    """Return the width of the edge at each point, or what is left of the prism's motion [px], shape ``(n,)``.

    It is the standard deviation across the edge of the events near the point: near 0 on a sharp edge, and
    :data:`WIDEST_PX` among spread events. The event itself does not count. Outside the rows and columns ``where``, in
    which it is computed, it is unknown: NaN.
    """
    width_at = np.full(image.shape, np.nan)
    spread = _spread_across_edges(image, where)
    # Gaussian weights of variance n² and an edge of variance w² give a spread of 1 / (1 / n² + 1 / w²).
    near = NEAR_PX**2
    variance = spread * near / np.maximum(near - spread, 1e-6)
    variance -= ROUNDING_VARIANCE
    limited = np.clip(variance, 1e-6, WIDEST_PX**2)
    width_at[where] = np.sqrt(limited)
    return at_pixels(width_at, xy)


def _spread_across_edges(image: NDArray[np.float32], where: Part) -> Vector:
    """Return the smallest variance, over all directions, of the weighted events about each pixel [px²].

    The variance is about the mean of these events, so that it is the same on both sides of an edge and on its middle.
    Sums with weights G of variance s are s G' for the places, and s G + s² G'' for their squares, so they follow from
    derivatives of the smoothed image.
    """
    from scipy.ndimage import gaussian_filter

    # The part of the image that counts: with a border as wide as the weights reach.
    height, width = image.shape
    rows = range(height)[where[0]]
    columns = range(width)[where[1]]
    border = 4 * math.ceil(NEAR_PX)
    top = max(rows.start - border, 0)
    left = max(columns.start - border, 0)
    bottom = rows.stop + border
    right = columns.stop + border
    part = image[top:bottom, left:right].astype(np.float64)

    def derivative(y: int, x: int) -> Vector:
        return np.asarray(gaussian_filter(part, NEAR_PX, order=(y, x), mode="constant"))

    # The event itself is taken away, and spread events are assumed instead.
    near = NEAR_PX**2
    own_weight = 1.0 / (math.tau * near)
    others = np.maximum(derivative(0, 0) - own_weight, 0.0)
    density = others + WIDE_EVENTS * own_weight
    mean_y = near * derivative(1, 0) / density
    mean_x = near * derivative(0, 1) / density
    second_y = derivative(2, 0) + own_weight / near
    second_x = derivative(0, 2) + own_weight / near
    yy = near + near**2 * second_y / density - mean_y**2
    xx = near + near**2 * second_x / density - mean_x**2
    xy = near**2 * derivative(1, 1) / density - mean_x * mean_y

    # The smaller eigenvalue of the covariance.
    half_trace = 0.5 * (xx + yy)
    half_difference = 0.5 * (xx - yy)
    smaller = half_trace - np.hypot(half_difference, xy)
    spread = np.clip(smaller, 0.0, near)
    kept_rows = slice(rows.start - top, rows.stop - top)
    kept_columns = slice(columns.start - left, columns.stop - left)
    return np.asarray(spread[kept_rows, kept_columns])
