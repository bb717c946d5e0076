"""Test picture of discs, whose edges are known: their distance from compensated events is the blur that is left."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from amiwarp.simulation.description import Scene

PITCH_PX = 80.0
"""Distance between the centres of neighbouring discs [px]."""
RADIUS_PX = 20.0
"""Radius of the discs [px]."""
REACH_PX = 18.0
"""Largest distance from an edge at which events belong to it [px]; the next edge is 40 px away or more."""
SHIFT_PX = 10.0
"""Largest shift of all discs, drawn at random [px]."""
BACKGROUND = 0.25
"""Luminance of the background; white is 1."""
LUMINANCES = (1.0, 0.12, 0.5, 0.06)
"""Luminances of the discs. Two are brighter than the background, two are darker."""
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
        columns, rows = (max(1, int((side - 2 * SHIFT_PX) // PITCH_PX)) for side in size)
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        grid = np.stack([x.ravel(), y.ravel()], axis=1)
        middle_of_grid = (np.array([columns, rows]) - 1.0) / 2.0

        middle_of_image = (np.array(size) - 1.0) / 2.0
        shift = rng.uniform(-SHIFT_PX, SHIFT_PX, 2)
        centres = middle_of_image + shift + PITCH_PX * (grid - middle_of_grid)
        luminance = rng.permutation(np.resize(LUMINANCES, len(grid)))
        return cls(centres, luminance, size)

    def scene(self, focal_px: float) -> Scene:
        """Return the scene for a camera of a focal length [px] whose principal point is the image's middle."""
        # The prism moves the view beyond the image: the picture is larger on all sides.
        margin = int(PITCH_PX)
        width, height = self.size
        columns = FINENESS * (width + 2 * margin)
        rows = FINENESS * (height + 2 * margin)
        # Places of the picture's pixels in the image [px]
        x = (np.arange(columns) + 0.5) / FINENESS - margin - 0.5
        y = (np.arange(rows) + 0.5) / FINENESS - margin - 0.5

        light = np.full((rows, columns), BACKGROUND, np.float32)
        for (centre_x, centre_y), luminance in zip(self.centres, self.luminance, strict=True):
            inside = (x - centre_x) ** 2 + (y[:, None] - centre_y) ** 2 < RADIUS_PX**2
            light[inside] = luminance
        fov = 2.0 * math.atan(0.5 * columns / FINENESS / focal_px)
        return Scene.from_picture(light, fov=fov)

    def distances(
        self, xy: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the distance of each place from the edge of its disc [px], positive outside, and the disc's luminance.

        Places further than :data:`REACH_PX` from all edges are left out.
        """
        _, nearest = KDTree(self.centres).query(xy)
        nearest = np.asarray(nearest, np.intp)
        from_centre = xy - self.centres[nearest]
        distance = np.hypot(from_centre[:, 0], from_centre[:, 1]) - RADIUS_PX
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
        members = group == value
        away[members] -= np.median(away[members])
    low, high = np.quantile(away, (0.158655, 0.841345))
    return float(high - low) / 2.0
