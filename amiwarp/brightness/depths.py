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
from amiwarp.optics.models.plate import LARGEST_INVERSE_DEPTH, PlateModel

Vector = NDArray[np.float64]
Floats = NDArray[np.float32]

WINDOW_PX = 2.5
"""Standard deviation of the Gaussian window whose pixels are assumed to see one depth [px]."""
SMALLEST_PX = 0.4
"""Smallest radius of an orbit that is tried [px]. On smaller ones, the map has enough nodes to fit each pixel alone."""
PLANE_PX = 0.3
"""Largest distance of the orbits' radii at successive inverse depths [px]."""
STEP_PX = 0.03
"""Distance of the orbits' radii for the second derivative of the cost [px]. With 0.08 px, depths of a desk came out 1 %
too large."""
SLOPE_PX = 0.02
"""Distance of the orbits' radii for the first derivative of the cost [px]."""
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
    costs: PixelCosts,
    model: PlateModel,
    largest: float,
    report: Callable[[float], None] = lambda share: None,
) -> Depths:
    """Return the depths of all pixels. ``largest``: largest inverse depth to try [1/m]; ``report`` gets the share."""
    from scipy.ndimage import gaussian_filter

    radius = orbit_px(model)
    least = min(SMALLEST_PX / radius, largest / 2.0)
    planes = 1 + math.ceil((largest - least) * radius / PLANE_PX)
    tried = np.linspace(least, largest, max(5, planes))

    # The cost of each pixel, and of the window about it, at each depth.
    pixels = []
    windows = []
    for k, inverse_depth in enumerate(tried.tolist()):
        plane = replace(model, inverse_depth=inverse_depth, depths=None)
        cost = costs.of(plane).astype(np.float32)
        pixels.append(cost)
        windows.append(gaussian_filter(cost, WINDOW_PX))
        report((k + 1) / (len(tried) + 4))
    of_windows: Floats = np.stack(windows)

    best = lowest(tried, of_windows)
    step = newton_step(costs, model, best)
    report(1.0)
    best = np.clip(best + step, 0.0, LARGEST_INVERSE_DEPTH).astype(np.float32)

    count = gaussian_filter(costs.count.astype(np.float64), WINDOW_PX)
    std = deviation(tried, of_windows, count, best, FLOOR_PX / radius)
    lowest_at = of_windows.argmin(axis=0)
    # The lowest cost may lie beyond what was tried
    std[(lowest_at == 0) | (lowest_at == len(tried) - 1)] = np.inf
    std = np.sqrt(std**2 + contrast(best, std) ** 2)

    lowest_costs = np.take_along_axis(np.stack(pixels), lowest_at[None], axis=0)
    pairs = max(costs.count.sum(), 1)
    return Depths(
        inverse_depth=best,
        std=std.astype(np.float32),
        count=costs.count,
        cost=float(lowest_costs.sum() / pairs),
    )


def orbit_px(model: PlateModel) -> float:
    """Return the radius of the orbit of a point at 1 m on the optical axis [px]."""
    return max(model.camera.fx, model.camera.fy) * model.plate.shift


def lowest(tried: Vector, windows: Floats) -> Floats:
    """Return the inverse depth of the lowest cost, between those that were tried by a parabola; (height, width)."""
    middle = np.clip(windows.argmin(axis=0), 1, len(tried) - 2)

    def cost_at(plane: NDArray[np.int64]) -> Floats:
        chosen = np.take_along_axis(windows, plane[None], axis=0)
        return np.asarray(chosen[0])

    before = cost_at(middle - 1)
    after = cost_at(middle + 1)
    bend = before - 2.0 * cost_at(middle) + after
    positive_bend = np.where(bend > 0.0, bend, np.inf)
    planes = np.clip(0.5 * (before - after) / positive_bend, -1.0, 1.0)
    distance = tried[1] - tried[0]
    return np.asarray(tried[middle] + planes * distance, np.float32)


def newton_step(
    costs: PixelCosts,
    model: PlateModel,
    at: Floats,
) -> Vector:
    """Return the change of the inverse depths that minimises the cost to second order, shape (height, width).

    The second derivative is a difference of first ones. The usual one of Gauss and Newton is several times too large,
    because the map follows the noise.
    """
    from scipy.ndimage import gaussian_filter

    radius = orbit_px(model)
    far = STEP_PX / radius
    near = SLOPE_PX / radius

    def moved(by: float) -> PlateModel:
        depths = np.clip(at + by, 0.0, LARGEST_INVERSE_DEPTH)
        return model.with_depths(depths.astype(np.float32))

    def slope_at(by: float) -> Vector:
        return costs.gradient(moved(by), moved(by + near), moved(by - near), 2.0 * near)

    low = slope_at(-far)
    high = slope_at(far)
    slope = gaussian_filter((low + high) / 2.0, WINDOW_PX)
    bend = gaussian_filter((high - low) / (2.0 * far), WINDOW_PX)
    positive_bend = np.where(bend > 0.0, bend, np.inf)
    longest = LONGEST_STEP_PX / radius
    step = np.clip(-slope / positive_bend, -longest, longest)
    return np.asarray(step)


def contrast(inverse_depth: Floats, std: Vector) -> Vector:
    """Return by how much the inverse depths of two pixels nearby differ, beyond their noise [rms], (height, width).

    A window across the edge of a body holds two depths, of which its pixel has one.
    """
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(std)
    weight = np.divide(1.0, std**2, out=np.zeros(std.shape), where=known)
    value = np.where(known, inverse_depth, 0.0).astype(np.float64)
    total = gaussian_filter(weight, NEARBY_PX)

    def weighted_mean(weighted: Vector) -> Vector:
        nothing = np.zeros(std.shape)
        nearby = gaussian_filter(weighted, NEARBY_PX)
        mean = np.divide(nearby, total, out=nothing, where=total > 0.0)
        return np.asarray(mean)

    mean = weighted_mean(weight * value)
    square = weighted_mean(weight * value**2)
    # The variance of each value, times its weight, is 1.
    noise = weighted_mean(known.astype(np.float64))
    variance = np.maximum(square - mean**2 - noise, 0.0)
    return np.asarray(np.sqrt(2.0 * variance))


def deviation(
    tried: Vector,
    windows: Floats,
    count: Vector,
    at: Floats,
    floor: float,
) -> Vector:
    """Return the standard deviation of the inverse depths ``at``, shape (height, width).

    The cost of a window is taken as a likelihood, whose variance is the lowest cost of a pair. So a window in which
    several depths explain the events has a large deviation. ``count``: number of pairs of each window.
    """
    from scipy.interpolate import CubicSpline

    has_pairs = count > LEAST_COUNT
    samples = FINER * (len(tried) - 1) + 1
    fine = np.linspace(tried[0], tried[-1], samples)
    area = 4.0 * math.pi * WINDOW_PX**2
    std = np.full(count.shape, np.inf)
    # Row by row: of a whole image, the interpolated costs would take gigabytes.
    for row in range(len(count)):
        some = has_pairs[row]
        if not some.any():
            continue
        pairs = count[row, some]
        spline = CubicSpline(tried, windows[:, row, some])
        costs = spline(fine)
        least = np.maximum(costs.min(axis=0), 1e-6 * pairs)  # a spline may swing below 0
        excess = np.maximum(costs / least - 1.0, 0.0)
        independent_pairs = pairs * area / (2.0 * CORRELATED)
        likelihood = np.exp(-excess * independent_pairs)
        square = (fine[:, None] - at[row, some]) ** 2
        variance = (likelihood * square).sum(axis=0) / likelihood.sum(axis=0)
        std[row, some] = np.sqrt(variance + floor**2)
    return std
