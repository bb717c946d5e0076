"""Local motion by contrast maximisation: how well events around a pixel agree under each of many velocities.

Source: G. Gallego, H. Rebecq and D. Scaramuzza, "A Unifying Contrast Maximization Framework for Event Cameras", CVPR
2018. Coordinates may be a sensor's, or compensated.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.votes import Votes
from amiwarp.studies.evaluate.event_images import DENSITY_PX, pixel_index, smooth_image, smoothed

MOST_LOCAL = 100_000
"""Largest number of events from which local motion is estimated; more are thinned evenly."""


def velocity_grid(reach: float, step: float) -> NDArray[np.float64]:
    """Return velocities from ``-reach`` to ``reach`` along both axes, shape (n, n, 2): (x, y); the middle is 0."""
    half = max(1, round(reach / step))
    line = step * np.arange(-half, half + 1)
    return np.stack(np.meshgrid(line, line), axis=-1)


def local_agreement(
    events: Events, size: tuple[int, int], velocities: NDArray[np.float64], pool: float
) -> Iterator[NDArray[np.floating[Any]]]:
    """Yield how well events agree under each velocity [px/s] of shape (k, 2), as images of shape (height, width).

    It is the mean, over the events of a surrounding, of the density of events of their polarity less the density of the
    other polarity, at their places when moved back to the middle of the time span; relative to the density of the
    surrounding. ``size``: width and height [px]. ``pool``: standard deviation of the surrounding's Gaussian [px].
    """
    width, height = size
    pixels = width * height
    votes = Votes(CanvasShape(width, height, per_polarity=True), "cpu")
    place = pixel_index(events, size)
    sign = 2.0 * events.p - 1.0
    count = np.bincount(place, minlength=pixels).reshape(height, width)
    around = np.maximum(smoothed(count.astype(np.float64), pool), 1e-9)
    for moved in _moved(events, velocities):
        votes.add_unmoved(moved)
        off, on = votes.take()
        surplus_of_on = smoothed(on - off, DENSITY_PX).ravel()
        # Each event brings the density at its moved place to the pixel where it was.
        density = sign * surplus_of_on[pixel_index(moved, size)]
        total = np.bincount(place, weights=density, minlength=pixels).reshape(height, width)
        agreement = smoothed(total, pool) / around
        yield np.asarray(agreement, np.float32)


def local_contrast(
    events: Events, size: tuple[int, int], velocities: NDArray[np.float64], pool: float
) -> Iterator[NDArray[np.floating[Any]]]:
    """Yield variance over mean of the image of moved events around each pixel, arguments as in :func:`local_agreement`.

    Both polarities count, because an edge behind the prism has both within a turn.
    """
    votes = Votes(CanvasShape(*size), "cpu")
    for moved in _moved(events, velocities):
        image = smooth_image(moved, votes, DENSITY_PX)
        mean = smoothed(image, pool)
        variance = smoothed(image * image, pool) - mean * mean
        yield np.asarray(variance / np.maximum(mean, 1e-9), np.float32)


def _moved(events: Events, velocities: NDArray[np.float64]) -> Iterator[Events]:
    """Yield the events moved back to the middle of their time span, for each velocity [px/s]."""
    middle_us = (int(events.t[0]) + int(events.t[-1])) / 2.0
    seconds = ((events.t - middle_us) * 1e-6).astype(np.float32)
    x = events.x.astype(np.float32)
    y = events.y.astype(np.float32)
    for vx, vy in velocities.astype(np.float32):
        yield Events(x - vx * seconds, y - vy * seconds, events.t, events.p)
