"""Evenness of events over the image: kernel density at each event's place, and its variance."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.studies.evaluate.event_images import smoothed

FINENESS = 2
"""Cells of the grid per pixel, along each axis. Pixel centres are centres of cells, so plain events are exact.

Other places are rounded to the cell, as if the Gaussian's variance were larger by 1 / (6 FINENESS²) px²: by 4 % for a
standard deviation of 1 px, by 0.5 % for 3 px.
"""
TRUNCATE = 5.0
"""Radius at which the Gaussian kernel ends [standard deviations]."""


def event_counts(x: NDArray[Any], y: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    """Return the number of events in each cell of a grid over the image, whose outermost cells are half outside.

    ``x``, ``y``: places [px], shape (n,); those outside the image are left out. ``size``: width and height [px].
    """
    width, height = size
    columns = FINENESS * width + 1
    rows = FINENESS * height + 1
    column = _cell(x)
    row = _cell(y)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    cell = (row * columns + column)[inside]
    counts = np.bincount(cell, minlength=rows * columns)
    return np.asarray(counts.reshape(rows, columns), np.float32)


def _cell(place: NDArray[Any]) -> NDArray[np.int32]:
    """Return the index of the cell along an axis, for places along it [px]."""
    nearest = np.rint(FINENESS * place.astype(np.float32)).astype(np.int32)
    # The first cell is centred half a pixel before the first pixel's centre.
    return np.asarray(nearest + FINENESS // 2)


def density_variance(counts: NDArray[np.float32], h_px: float) -> float:
    """Return the variance of ρ / mean ρ, where ρ is the kernel density at each event: 0 for an even distribution.

    ``counts``: events in the cells of a grid, see :func:`event_counts`. ``h_px``: standard deviation of the Gaussian
    kernel. Each event contributes to its own density, as usual for kernel density estimates. Near the border the
    density is divided by the part of the kernel that lies in the image. NaN without events. For a Poisson process of λ
    events/px² the variance is about λ / (4πh²) / (λ + 1 / (2πh²))².
    """
    events = float(counts.sum(dtype=np.float64))
    if not events:
        return float("nan")
    mass = smoothed(counts, FINENESS * h_px, truncate=TRUNCATE, mirrored=False)
    density = mass / _inside_share(counts.shape, h_px)
    mean = float(np.sum(counts * density, dtype=np.float64)) / events
    square = (density / mean - 1.0) ** 2
    return float(np.sum(counts * square, dtype=np.float64)) / events


@lru_cache(maxsize=16)
def _inside_share(shape: tuple[int, int], h_px: float) -> NDArray[np.float32]:
    """Return the part of the kernel around each cell that lies in the image."""
    cells = np.ones(shape, np.float32)
    # The outermost cells are half outside.
    for edge in (cells[0], cells[-1], cells[:, 0], cells[:, -1]):
        edge *= 0.5
    return smoothed(cells, FINENESS * h_px, truncate=TRUNCATE, mirrored=False)
