"""Motion of the camera in the three saccades of N-Caltech101 and N-MNIST."""

import numpy as np

from amiwarp.optics.camera import Camera
from amiwarp.simulation.motion import CameraMotion

SACCADES_PX = ((3.5, 7.0), (3.5, -7.0), (-7.0, 0.0))
"""Motion of the image in the three saccades of N-Caltech101 and N-MNIST, x and y [px]."""
SACCADE_US = 105_000
"""Length of a saccade [us]."""
TURN_US = 1_000
"""Time in which the camera changes from one saccade to the next [us]."""


def saccade_rates(camera: Camera) -> list[tuple[float, float, float]]:
    """Return the angular velocity of the camera in each saccade [rad/s], for which the image moves as it should."""
    # a rotation about x moves the image along y, one about y along -x
    seconds = SACCADE_US * 1e-6
    return [(dy / camera.fy / seconds, -dx / camera.fx / seconds, 0.0) for dx, dy in SACCADES_PX]


def saccades(camera: Camera) -> CameraMotion:
    """Return the rotation of the camera in the three saccades, at constant speeds."""
    rows = []
    for k, rates in enumerate(saccade_rates(camera)):
        start = k * SACCADE_US + TURN_US / 2
        stop = (k + 1) * SACCADE_US - TURN_US / 2
        rows += [(start * 1e-6, *rates), (stop * 1e-6, *rates)]
    return CameraMotion(np.array(rows))
