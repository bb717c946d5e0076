"""Motion by contrast maximisation: the motion whose compensation makes the image of warped events sharpest.

Source: G. Gallego, H. Rebecq and D. Scaramuzza, "A Unifying Contrast Maximization Framework for Event Cameras", CVPR
2018. Coordinates may be those of a sensor, or compensated.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.imaging.iwe import CanvasShape, Votes
from amiwarp.optics.camera import Camera, CameraRotation
from amiwarp.studies.evaluate.measures import smoothed

SMOOTHING_PX = (5.0, 1.0)
"""Standard deviations of the Gaussian that smooths the image, from coarse to fine [px]."""
DENSITY_PX = 1.0
"""Standard deviation of the Gaussian that smooths the density of events in local sharpness [px]."""
TILE = 24
"""Side of the tiles whose sharpness is compared [px]."""
LEAST_SHARE = 0.25
"""Number of events, relative to the median tile, below which a tile is left out."""
MOST_EVENTS = 40_000
"""Largest number of events from which the camera's rotation is estimated; more are thinned evenly."""
MOST_LOCAL = 100_000
"""Largest number of events from which local motion is estimated; more are thinned evenly."""


def thinned(events: Events, most: int) -> Events:
    """Return at most ``most`` of the events, spread evenly."""
    return events[:: max(1, -(-len(events) // most))]


def rotated_back(events: Events, camera: Camera, rotation: CameraRotation) -> Events:
    """Return the events where the camera saw their scene points at ``rotation.middle_us``."""
    rays = camera.pixels_to_rays(np.stack([events.x, events.y], axis=1).astype(np.float32))
    tau = ((events.t - rotation.middle_us) * 1e-6).astype(np.float64)
    xy = camera.rays_to_pixels(turned(rays, rotation.rotation(tau)).astype(np.float32))
    return Events(xy[:, 0].copy(), xy[:, 1].copy(), events.t, events.p)


def turned(rays: NDArray[np.floating], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays turned by rotation vectors [rad], both of shape (n, 3), by the formula of Rodrigues."""
    angle = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    axis = vectors / np.maximum(angle, 1e-300)
    cos, (ax, ay, az), (x, y, z) = np.cos(angle), axis.T, rays.T
    across = np.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x], axis=1)
    along = np.einsum("ij,ij->i", axis, rays)[:, None]
    return np.asarray(rays * cos + across * np.sin(angle) + axis * (along * (1.0 - cos)))


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
    found = []
    for k in range(len(SMOOTHING_PX)):
        rate = np.zeros(3)
        for sigma in SMOOTHING_PX[k:]:
            rate, cost = search.refine(rate, sigma)
        found.append((cost, rate))
    return search.rotation(min(found, key=lambda pair: pair[0])[1])


def dithered(events: Events) -> Events:
    """Return the events at random places in their pixels, if they are at pixel centres, where a grid adds sharpness."""
    if not events.whole_pixels:
        return events
    offset = np.random.default_rng(0).uniform(-0.5, 0.5, (2, len(events))).astype(np.float32)
    return Events(events.x + offset[0], events.y + offset[1], events.t, events.p)


class _RotationSearch:
    """Search for the angular velocity with the sharpest image.

    The cost is the median over the tiles of the change of sharpness from that at rest, so that a fast body with many
    events does not decide.
    """

    def __init__(self, events: Events, camera: Camera) -> None:
        first, last = int(events.t[0]), int(events.t[-1])
        self._events, self._camera, self._middle_us = events, camera, (first + last) // 2
        self._unit = 1.0 / (camera.fx * max(last - first, 1) * 1e-6)  # moves the image by about one pixel [rad/s]
        self._votes = Votes(CanvasShape(camera.width, camera.height), "cpu")
        counts = tiles(smooth_image(events, self._votes, 0.0)).sum(axis=1)
        self._busy = counts >= LEAST_SHARE * np.median(counts)
        self._at_rest = {sigma: self._log_variance(events, sigma) for sigma in SMOOTHING_PX}

    def rotation(self, rate: NDArray[np.float64]) -> CameraRotation:
        """Return the rotation with an angular velocity [rad/s]."""
        return CameraRotation((float(rate[0]), float(rate[1]), float(rate[2])), middle_us=self._middle_us)

    def refine(self, rate: NDArray[np.float64], sigma: float) -> tuple[NDArray[np.float64], float]:
        """Return the best angular velocity near ``rate`` and its cost, on an image smoothed by ``sigma`` [px]."""
        from scipy.optimize import minimize

        def cost(v: NDArray[np.float64]) -> float:
            moved = rotated_back(self._events, self._camera, self.rotation(v))
            return -float(np.median(self._log_variance(moved, sigma) - self._at_rest[sigma]))

        roll = 2.0 * self._camera.fx / self._camera.width  # the roll that moves the border by one pixel
        simplex = rate + 1.5 * sigma * self._unit * np.vstack([np.zeros(3), np.diag([1.0, 1.0, roll])])
        options: Any = {"initial_simplex": simplex, "xatol": 0.02 * self._unit * sigma, "fatol": np.inf, "maxiter": 60}
        run = minimize(cost, rate, method="Nelder-Mead", options=options)
        return np.asarray(run.x), float(run.fun)

    def _log_variance(self, events: Events, sigma: float) -> NDArray[np.float32]:
        """Return the logarithm of the image's variance in each tile that has events."""
        variance = tiles(smooth_image(events, self._votes, sigma)).var(axis=1)
        return np.asarray(np.log(variance[self._busy] + 1e-9))


def tiles(image: NDArray[np.float32], side: int = TILE) -> NDArray[np.float32]:
    """Return the square tiles of an image, shape (n, side * side), without a rest at the right and at the bottom."""
    rows, columns = (n // side for n in image.shape)
    whole = image[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return whole.swapaxes(1, 2).reshape(rows * columns, side * side)


def smooth_image(events: Events, votes: Votes, sigma: float) -> NDArray[np.float32]:
    """Return the image of the events [events per pixel], smoothed; ``votes`` are its buffers."""
    votes.add_unmoved(events)
    return smoothed(votes.take()[0], sigma)


def velocity_grid(reach: float, step: float) -> NDArray[np.float64]:
    """Return velocities from ``-reach`` to ``reach`` along both axes, shape (n, n, 2): (x, y); the middle is 0."""
    half = max(1, round(reach / step))
    line = step * np.arange(-half, half + 1)
    return np.stack(np.meshgrid(line, line), axis=-1)


def local_agreement(
    events: Events, size: tuple[int, int], velocities: NDArray[np.float64], pool: float
) -> Iterator[NDArray[np.floating[Any]]]:
    """Yield how well events agree under each velocity [px/s] of shape (k, 2), as images of shape (height, width).

    It is the mean, over the events of a surrounding, of the density of events of their polarity less that of the other
    polarity, at their places when moved back to the middle of the time span; relative to the density of the
    surrounding. ``size``: width and height [px]. ``pool``: standard deviation of the surrounding's Gaussian [px].
    """
    width, height = size
    votes = Votes(CanvasShape(width, height, per_polarity=True), "cpu")
    place, sign = pixel_index(events, size), 2.0 * events.p - 1.0
    count = np.bincount(place, minlength=width * height).reshape(height, width).astype(np.float64)
    around = np.maximum(smoothed(count, pool), 1e-9)
    for moved in _moved(events, velocities):
        votes.add_unmoved(moved)
        off, on = votes.take()
        density = sign * smoothed(on - off, DENSITY_PX).ravel()[pixel_index(moved, size)]
        total = np.bincount(place, weights=density, minlength=width * height).reshape(height, width)
        yield np.asarray(smoothed(total, pool) / around, np.float32)


def local_contrast(
    events: Events, size: tuple[int, int], velocities: NDArray[np.float64], pool: float
) -> Iterator[NDArray[np.floating[Any]]]:
    """Yield variance over mean of the image of moved events around each pixel, arguments as in :func:`local_agreement`.

    Both polarities count, because an edge behind the prism has both within a turn.
    """
    votes = Votes(CanvasShape(*size), "cpu")
    for moved in _moved(events, velocities):
        image = smooth_image(moved, votes, DENSITY_PX)
        mean, square = (smoothed(values, pool) for values in (image, image * image))
        yield np.asarray((square - mean * mean) / np.maximum(mean, 1e-9), np.float32)


def _moved(events: Events, velocities: NDArray[np.float64]) -> Iterator[Events]:
    """Yield the events moved back to the middle of their time span, for each velocity [px/s]."""
    middle_us = (int(events.t[0]) + int(events.t[-1])) / 2.0
    tau = ((events.t - middle_us) * 1e-6).astype(np.float32)
    x, y = events.x.astype(np.float32), events.y.astype(np.float32)
    for vx, vy in velocities.astype(np.float32):
        yield Events(x - vx * tau, y - vy * tau, events.t, events.p)


def pixel_index(events: Events, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return the index of each event's pixel, row by row; events outside have that of the nearest pixel."""
    width, height = size
    x, y = (np.rint(np.clip(np.nan_to_num(v), 0, n - 1)).astype(np.int64)
            for v, n in ((events.x, width), (events.y, height)))  # fmt: skip
    return np.asarray(y * width + x)
