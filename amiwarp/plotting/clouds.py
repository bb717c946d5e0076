"""Events as point clouds in x, y and prism angle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR

HALF_BOX = (0.4, 0.5, 0.5)
"""Half width of the box about the origin in which the points lie: along x, y and angle."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of one event cloud."""

    xyz: NDArray[np.float32]
    """Coordinates of the points: x, y (up) and prism angle, within :data:`HALF_BOX` of the origin for points in the
    region, shape ``(n, 3)``."""
    on: NDArray[np.bool_]
    """Whether each point is an ON event, shape ``(n,)``."""


def draw_cloud(axes: Any, cloud: Cloud) -> None:
    """Draw a cloud on three-dimensional Matplotlib axes."""
    from matplotlib.colors import to_rgba_array

    # Colours by their names would be slow.
    colours = to_rgba_array([OFF_COLOUR, ON_COLOUR])[cloud.on.astype(int)]
    axes.scatter(*cloud.xyz.T, s=1.6, c=colours, linewidths=0, alpha=0.7, depthshade=False)
    axes.set_box_aspect(HALF_BOX, zoom=1.1)
    x, y, z = HALF_BOX
    axes.set(xlim=(-x, x), ylim=(-y, y), zlim=(-z, z))
    axes.view_init(elev=22, azim=-45)
    axes.set(xlabel="x", ylabel="y", xticks=(), yticks=(), zticks=())
    axes.text2D(0.03, 0.9, "angle", transform=axes.transAxes)
