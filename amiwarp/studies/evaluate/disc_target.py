"""Test picture of discs, whose edges are known: their distance from compensated events is the blur that is left."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from amiwarp.simulation.scene import Scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

PITCH_PX, RADIUS_PX = 80.0, 20.0
"""Distance between the centres of the discs, and their radius [px]."""
REACH_PX = 18.0
"""Largest distance from an edge at which events belong to it [px]; the next edge is 40 px away or more."""
SHIFT_PX = 10.0
"""Largest shift of all discs, drawn at random [px]."""
BACKGROUND, LUMINANCES = 0.25, (1.0, 0.12, 0.5, 0.06)
"""Luminance of the background and of the discs, white is 1. Two are brighter than the background, two are darker."""
FINENESS = 4
"""Pixels of the picture per pixel of the sensor, along each axis."""


@dataclass(frozen=True, eq=False)
class DiscTarget:
    """Discs on a plane at infinity."""

    centres: NDArray[np.float64]
    """Centres in the image without the prism [px], shape ``(n, 2)``."""
    luminance: NDArray[np.float64]
    """Luminance of each disc, shape ``(n,)``."""
    size: tuple[int, int]
    """Width and height of the image [px]."""

    @classmethod
    def of_seed(cls, size: tuple[int, int], seed: int) -> DiscTarget:
        """Return the discs that an image of ``size`` (width, height) holds, shifted and mixed by a seed."""
        rng = np.random.default_rng([seed, 1])
        columns, rows = (max(1, int((n - 2 * SHIFT_PX) // PITCH_PX)) for n in size)
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        middle = (np.array(size) - 1.0) / 2.0 + rng.uniform(-SHIFT_PX, SHIFT_PX, 2)
        centres = middle + PITCH_PX * (grid - (np.array([columns, rows]) - 1.0) / 2.0)
        return cls(centres, rng.permutation(np.resize(LUMINANCES, len(grid))), size)

    def scene(self, focal_px: float) -> Scene:
        """Return the scene for a camera of a focal length [px] whose principal point is the image's middle."""
        margin = int(PITCH_PX)
        shape = [FINENESS * (n + 2 * margin) for n in self.size]
        x, y = ((np.arange(n) + 0.5) / FINENESS - margin - 0.5 for n in shape)
        light = np.full(shape[::-1], BACKGROUND, np.float32)
        for (cx, cy), luminance in zip(self.centres, self.luminance, strict=True):
            light[(x - cx) ** 2 + (y[:, None] - cy) ** 2 < RADIUS_PX**2] = luminance
        return Scene.from_picture(light, fov=2.0 * math.atan(0.5 * shape[0] / FINENESS / focal_px))

    def distances(self, xy: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the distance of each place from the edge of its disc [px], positive outside, and the disc's luminance.

        Places further than :data:`REACH_PX` from all edges are left out.
        """
        nearest = np.asarray(KDTree(self.centres).query(xy)[1], np.intp)
        distance = np.hypot(*(xy - self.centres[nearest]).T) - RADIUS_PX
        near = np.abs(distance) <= REACH_PX
        return distance[near], self.luminance[nearest[near]]


def robust_spread(distance: NDArray[np.floating], group: NDArray[np.floating]) -> float:
    """Return half the range that holds the middle 68.3 % of the distances [px]; inf without any.

    The median of each group is subtracted first: a blurred edge of light lies towards the darker side in its logarithm.
    For normal distances it is their standard deviation.
    """
    if not len(distance):
        return float("inf")
    away = np.array(distance, np.float64)
    for value in np.unique(group):
        away[group == value] -= np.median(away[group == value])
    low, high = np.quantile(away, (0.158655, 0.841345))
    return float(high - low) / 2.0
