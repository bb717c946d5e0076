"""Lines in the event clouds: the orbit on which the prism moves a scene point, and its place without the prism."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.shown_window import DisplayedWindow


def orbit_lines(
    inspector: Inspector, shown: DisplayedWindow, picked: int = -1
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the orbit of a scene point, and the column in which the model sees it without the prism.

    The scene point lies where the drawn event number ``picked`` is; of a negative number, in the middle of the region.
    Both lines have points x, y [px] and prism angle [deg], shape ``(n, 3)``.
    """
    left, top, right, bottom = shown.region
    point = np.array([left + right, top + bottom]) / 2.0
    if picked >= 0:
        point = shown.after[picked]
    theta, orbit = inspector.orbit(float(point[0]), float(point[1]))
    theta_deg = np.degrees(theta)
    column = np.broadcast_to(point, orbit.shape)
    return np.column_stack([orbit, theta_deg]), np.column_stack([column, theta_deg])


def shown_lines(
    inspector: Inspector,
    shown: DisplayedWindow,
    axis: Axis,
    against: Knobs | None,
    picked: int = -1,
) -> tuple[NDArray[Any], ...]:
    """Return the line of each cloud: of a scene point that moves, or that stays; none without a motion or over time."""
    if axis is not Axis.ANGLE or not math.isfinite(inspector.turn_us):
        return ()
    orbit, column = orbit_lines(inspector, shown, picked)
    recorded = against is None and shown.beside is None  # else the first cloud is compensated, too
    return (orbit if recorded else column), column
