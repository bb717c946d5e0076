"""Evenness of events over the image: kernel density at each event's place, and its variance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

if TYPE_CHECKING:
    from numpy.typing import NDArray

TRUNCATE = 5.0
"""Radius at which the Gaussian kernel ends [standard deviations]."""


def event_density(xy: NDArray[np.floating], size: tuple[int, int], h_px: float) -> NDArray[np.float64]:
    """Return the kernel density at the place of each event [events/px²], shape (n,).

    ``xy``: places [px], shape (n, 2), within half a pixel around the image. ``size``: width and height [px]. ``h_px``:
    standard deviation of the Gaussian kernel. Each event contributes to its own density, as usual for kernel density
    estimates. Near the border the density is divided by the part of the kernel that lies in the image.
    """
    width, height = size
    counts = _vote(xy, size)
    ones = np.ones((height, width))
    mass, share = (ndimage.gaussian_filter(a, h_px, mode="constant", truncate=TRUNCATE) for a in (counts, ones))
    return np.asarray(ndimage.map_coordinates(mass / share, [xy[:, 1], xy[:, 0]], order=1, mode="nearest"))


def _vote(xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the number of events at each pixel, with bilinear votes; those at the border go to the last pixel."""
    width, height = size
    x, y = np.clip(xy[:, 0], 0.0, width - 1.0), np.clip(xy[:, 1], 0.0, height - 1.0)
    left, top = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    u, v = x - left, y - top
    counts = np.zeros(width * height)
    for dx, dy, weight in ((0, 0, (1 - u) * (1 - v)), (1, 0, u * (1 - v)), (0, 1, (1 - u) * v), (1, 1, u * v)):
        counts += np.bincount((top + dy) * width + left + dx, weight, width * height)
    return counts.reshape(height, width)


def density_variance(xy: NDArray[np.floating], size: tuple[int, int], h_px: float) -> float:
    """Return the variance of ρ / mean ρ, where ρ is the kernel density at each event: 0 for an even distribution.

    NaN without events. For a Poisson process of λ events/px² it is about λ / (4πh²) / (λ + 1 / (2πh²))².
    """
    xy = inside(xy, size)
    if not len(xy):
        return float("nan")
    density = event_density(xy, size, h_px)
    return float(np.var(density / density.mean()))


def inside(xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the places within the image: those whose nearest pixel belongs to it."""
    pixel = np.rint(xy)
    return np.asarray(xy[((pixel >= 0) & (pixel < size)).all(axis=1)], np.float64)
