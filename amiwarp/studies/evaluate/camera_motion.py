"""Rotation of the camera by contrast maximisation: the rotation whose compensation makes the image of events sharpest.

Source: G. Gallego, H. Rebecq and D. Scaramuzza, "A Unifying Contrast Maximization Framework for Event Cameras", CVPR
2018. The events may be a sensor's or compensated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.votes import Votes
from amiwarp.optics.camera import Camera
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.studies.evaluate.event_images import dithered, image_tiles, smooth_image, thinned

SMOOTHING_PX = (5.0, 1.0)
"""Standard deviations of the Gaussian that smooths the image, from coarse to fine [px]."""
LEAST_SHARE = 0.25
"""Number of events, relative to the median tile, below which a tile is left out."""
MOST_EVENTS = 40_000
"""Largest number of events from which the camera's rotation is estimated; more are thinned evenly."""


def rotated_back(events: Events, camera: Camera, rotation: CameraRotation) -> Events:
    """Return the events where the camera saw their scene points at ``rotation.middle_us``."""
    places = np.stack([events.x, events.y], axis=1).astype(np.float32)
    rays = camera.pixels_to_rays(places)
    seconds = ((events.t - rotation.middle_us) * 1e-6).astype(np.float64)
    rays_in_middle = turned(rays, rotation.rotation(seconds)).astype(np.float32)
    xy = camera.rays_to_pixels(rays_in_middle)
    return Events(xy[:, 0].copy(), xy[:, 1].copy(), events.t, events.p)


def turned(rays: NDArray[np.floating], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays turned by rotation vectors [rad], both of shape (n, 3), by the formula of Rodrigues."""
    angle = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    axis = vectors / np.maximum(angle, 1e-300)
    cos = np.cos(angle)
    sin = np.sin(angle)
    # The cross product of axis and ray
    ax, ay, az = axis.T
    x, y, z = rays.T
    across = np.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x], axis=1)
    along = np.einsum("ij,ij->i", axis, rays)[:, None]
    return np.asarray(rays * cos + across * sin + axis * (along * (1.0 - cos)))


def estimate_rotation(events: Events, camera: Camera) -> CameraRotation:
    """Return the camera's angular velocity about the middle of the events' time span.

    The search starts at rest, once for each of :data:`SMOOTHING_PX`: on a coarse image it finds fast rotations, and on
    a fine one it is not drawn away by a moving body. The sharpest result counts. Without events, the rotation is
    zero.
    """
    if not len(events):
        return CameraRotation()
    few = dithered(thinned(events, MOST_EVENTS))
    search = _RotationSearch(few, camera)
    optima = []
    for coarsest in range(len(SMOOTHING_PX)):
        rate = np.zeros(3)
        for sigma in SMOOTHING_PX[coarsest:]:
            rate, cost = search.refine(rate, sigma)
        optima.append((cost, rate))
    _, best = min(optima, key=lambda pair: pair[0])
    return search.rotation(best)


class _RotationSearch:
    """Search for the angular velocity with the sharpest image.

    The cost is the median over the tiles of the change of sharpness from the sharpness at rest, so that a fast body
    with many events does not decide.
    """

    def __init__(self, events: Events, camera: Camera) -> None:
        first_us = int(events.t[0])
        last_us = int(events.t[-1])
        self._events = events
        self._camera = camera
        self._middle_us = (first_us + last_us) // 2
        # Angular velocity that moves the image by about one pixel during the events [rad/s]
        span_us = max(last_us - first_us, 1)
        self._unit = 1.0 / (camera.fx * span_us * 1e-6)
        self._votes = Votes(CanvasShape(camera.width, camera.height), "cpu")
        image = smooth_image(events, self._votes, 0.0)
        counts = image_tiles(image).sum(axis=1)
        self._busy = counts >= LEAST_SHARE * np.median(counts)
        self._at_rest = {sigma: self._log_variance(events, sigma) for sigma in SMOOTHING_PX}

    def rotation(self, rate: NDArray[np.float64]) -> CameraRotation:
        """Return the rotation with an angular velocity [rad/s]."""
        x, y, z = rate.tolist()
        return CameraRotation((x, y, z), middle_us=self._middle_us)

    def refine(self, rate: NDArray[np.float64], sigma: float) -> tuple[NDArray[np.float64], float]:
        """Return the best angular velocity near ``rate`` and its cost, on an image smoothed by ``sigma`` [px]."""
        from scipy.optimize import minimize

        def cost(rate: NDArray[np.float64]) -> float:
            moved = rotated_back(self._events, self._camera, self.rotation(rate))
            change = self._log_variance(moved, sigma) - self._at_rest[sigma]
            return -float(np.median(change))

        # A roll must be larger to move the border by one pixel.
        roll = 2.0 * self._camera.fx / self._camera.width
        directions = np.vstack([np.zeros(3), np.diag([1.0, 1.0, roll])])
        simplex = rate + 1.5 * sigma * self._unit * directions
        options: Any = {
            "initial_simplex": simplex,
            "xatol": 0.02 * self._unit * sigma,
            "fatol": np.inf,  # the simplex's size alone decides: a cost that is a median jumps
            "maxiter": 60,
        }
        optimum = minimize(cost, rate, method="Nelder-Mead", options=options)
        return np.asarray(optimum.x), float(optimum.fun)

    def _log_variance(self, events: Events, sigma: float) -> NDArray[np.float32]:
        """Return the logarithm of the image's variance in each tile that has events."""
        image = smooth_image(events, self._votes, sigma)
        variance = image_tiles(image).var(axis=1)
        return np.asarray(np.log(variance[self._busy] + 1e-9))
