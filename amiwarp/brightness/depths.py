"""Inverse depth of what each pixel sees through a rotating tilted plate, from the radius of its events' orbit.

The photometric cost of a window of pixels is computed for a series of inverse depths, as in a plane sweep. One step of
Newton's method improves the best of them. See ``docs/how-to/depth.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.pixel_costs import PixelCosts
from amiwarp.optics.models import LARGEST_INVERSE_DEPTH, PlateModel

WINDOW_PX = 2.5
"""Standard deviation of the Gaussian window whose pixels are assumed to see one depth [px]."""
SMALLEST_PX = 0.4
"""Smallest radius of an orbit that is tried [px]. On smaller ones, the map has enough nodes to fit each pixel alone."""
PLANE_PX = 0.3
"""Largest distance of the orbits' radii at successive inverse depths [px]."""
STEP_PX, SLOPE_PX = 0.03, 0.02
"""Distances of the orbits' radii for the second and for the first derivative of the cost [px]. With 0.08 px for the
second, depths of a desk came out 1 % too large."""
LONGEST_STEP_PX = 0.15
"""Longest step by which the best inverse depth of the series is improved: the change of the orbit's radius [px]."""
CORRELATED = 12.0
"""Number of pairs of events that count as one, because their errors are alike. In simulations, with :func:`contrast`,
about 68 and 95 % of the depths or more then lie within one and two standard deviations."""
FLOOR_PX = 0.01
"""Standard deviation of an orbit's radius by errors that all windows have [px]."""
NEARBY_PX = 2.4 * WINDOW_PX
"""Standard deviation of the Gaussian window in which depths are compared with each other [px]."""
LEAST_COUNT = 0.01
"""Smallest number of pairs per pixel of a window whose depth is determined."""
FINER = 12
"""Number of steps in which the cost between two inverse depths is interpolated."""


@dataclass(frozen=True, eq=False)
class Depths:
    """Inverse depths, their uncertainty and their cost, each of shape (height, width)."""

    inverse_depth: NDArray[np.float32]
    """Inverse depth [1/m]."""
    std: NDArray[np.float32]
    """Standard deviation of the inverse depth [1/m]; infinity in windows that do not determine it."""
    count: NDArray[np.int64]
    """Number of pairs of events of each pixel."""
    cost: float
    """Mean cost of a pair of events [thresholds²]."""


def find_depths(
    costs: PixelCosts, model: PlateModel, largest: float, report: Callable[[float], None] = lambda share: None
) -> Depths:
    """Return the depths of all pixels. ``largest``: largest inverse depth to try [1/m]; ``report`` gets the share."""
    from scipy.ndimage import gaussian_filter

    radius = orbit_px(model)
    least = min(SMALLEST_PX / radius, largest / 2.0)
    tried = np.linspace(least, largest, max(5, 1 + math.ceil((largest - least) * radius / PLANE_PX)))
    pixels = []
    for k, each in enumerate(tried):
        cost = costs.of(replace(model, inverse_depth=float(each), depths=None))
        pixels.append(cost.astype(np.float32))
        report((k + 1) / (len(tried) + 4))
    windows: NDArray[np.float32] = np.stack([gaussian_filter(one, WINDOW_PX) for one in pixels])
    best = lowest(tried, windows)
    step = newton_step(costs, model, best)
    report(1.0)
    best = np.clip(best + step, 0.0, LARGEST_INVERSE_DEPTH).astype(np.float32)
    count = gaussian_filter(costs.count.astype(np.float64), WINDOW_PX)
    std = deviation(tried, windows, count, best, FLOOR_PX / radius)
    lowest_at = windows.argmin(axis=0)
    std[(lowest_at == 0) | (lowest_at == len(tried) - 1)] = np.inf  # the lowest cost may lie beyond what was tried
    std = np.sqrt(std**2 + contrast(best, std) ** 2)
    total = np.take_along_axis(np.stack(pixels), lowest_at[None], axis=0).sum()
    return Depths(best, std.astype(np.float32), costs.count, float(total / max(costs.count.sum(), 1)))


def orbit_px(model: PlateModel) -> float:
    """Return the radius of the orbit of a point at 1 m on the optical axis [px]."""
    return max(model.camera.fx, model.camera.fy) * model.plate.shift


def lowest(tried: NDArray[np.float64], windows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the inverse depth of the lowest cost, between those that were tried by a parabola; (height, width)."""
    middle = np.clip(windows.argmin(axis=0), 1, len(tried) - 2)
    a, b, c = (np.take_along_axis(windows, (middle + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = a - 2.0 * b + c
    away = np.clip(0.5 * (a - c) / np.where(bend > 0.0, bend, np.inf), -1.0, 1.0)
    return np.asarray(tried[middle] + away * (tried[1] - tried[0]), np.float32)


def newton_step(costs: PixelCosts, model: PlateModel, at: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the change of the inverse depths that minimises the cost to second order, shape (height, width).

    The second derivative is a difference of first ones: that of Gauss and Newton is several times too large, because
    the map follows the noise.
    """
    from scipy.ndimage import gaussian_filter

    radius = orbit_px(model)
    far, near = STEP_PX / radius, SLOPE_PX / radius

    def moved(by: float) -> PlateModel:
        return model.with_depths(np.clip(at + by, 0.0, LARGEST_INVERSE_DEPTH).astype(np.float32))

    low, high = (costs.gradient(moved(by), moved(by + near), moved(by - near), 2.0 * near) for by in (-far, far))
    slope, bend = (gaussian_filter(one, WINDOW_PX) for one in ((low + high) / 2.0, (high - low) / (2.0 * far)))
    longest = LONGEST_STEP_PX / radius
    return np.asarray(np.clip(-slope / np.where(bend > 0.0, bend, np.inf), -longest, longest))


def contrast(inverse_depth: NDArray[np.float32], std: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much the inverse depths of two pixels nearby differ, beyond their noise [rms], (height, width).

    A window across the edge of a body holds two depths, of which its pixel has one.
    """
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(std)
    weight = np.divide(1.0, std**2, out=np.zeros(std.shape), where=known)
    value = np.where(known, inverse_depth, 0.0).astype(np.float64)
    total = gaussian_filter(weight, NEARBY_PX)
    sums = weight * value, weight * value**2, known.astype(np.float64)
    mean, square, noise = (
        np.divide(gaussian_filter(each, NEARBY_PX), total, out=np.zeros(std.shape), where=total > 0.0) for each in sums
    )
    return np.asarray(np.sqrt(2.0 * np.maximum(square - mean**2 - noise, 0.0)))


def deviation(
    tried: NDArray[np.float64],
    windows: NDArray[np.float32],
    count: NDArray[np.float64],
    at: NDArray[np.float32],
    floor: float,
) -> NDArray[np.float64]:
    """Return the standard deviation of the inverse depths ``at``, shape (height, width).

    The cost of a window is taken as a likelihood, whose variance is the lowest cost of a pair. So a window in which
    several depths explain the events has a large deviation. ``count``: number of pairs of each window.
    """
    from scipy.interpolate import CubicSpline

    seen = count > LEAST_COUNT
    fine = np.linspace(tried[0], tried[-1], FINER * (len(tried) - 1) + 1)
    out = np.full(count.shape, np.inf)
    for row in range(len(count)):  # of a whole image, the interpolated costs would take gigabytes
        some = seen[row]
        if not some.any():
            continue
        costs = CubicSpline(tried, windows[:, row, some])(fine)
        least = np.maximum(costs.min(axis=0), 1e-6 * count[row, some])  # a spline may swing below 0
        area = 4.0 * math.pi * WINDOW_PX**2
        weight = np.exp(-np.maximum(costs / least - 1.0, 0.0) * (count[row, some] * area / (2.0 * CORRELATED)))
        away = (fine[:, None] - at[row, some]) ** 2
        out[row, some] = np.sqrt((weight * away).sum(axis=0) / weight.sum(axis=0) + floor**2)
    return out
