"""Images of events, smoothed and in tiles, and what a search needs of the events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.imaging.votes import Votes
from amiwarp.studies.evaluate.libraries import library

DENSITY_PX = 1.0
"""Standard deviation of the Gaussian that smooths the density of events in local sharpness [px]."""
BRIGHT_PERCENTILE = 99.0
"""Percentile of the non-empty pixels of all images of events that becomes the brightest grey value."""
TILE_PX = 24
"""Side of the tiles whose sharpness is compared [px]."""


def smoothed(
    image: NDArray[Any], sigma: float, *, truncate: float = 4.0, mirrored: bool = True
) -> NDArray[np.float32]:
    """Return an image smoothed by a Gaussian of standard deviation ``sigma`` [px]; OpenCV is the fastest on one core.

    ``truncate``: radius at which the Gaussian ends [standard deviations]. Outside, the image is ``mirrored``, or zero.
    """
    plain = np.ascontiguousarray(image, np.float32)
    cv2 = library("cv2")
    if sigma <= 0.0:
        return plain
    side = 2 * int(truncate * sigma + 0.5) + 1
    border = cv2.BORDER_REFLECT if mirrored else cv2.BORDER_CONSTANT
    blurred = cv2.GaussianBlur(plain, (side, side), sigma, borderType=border)
    return np.asarray(blurred, np.float32)


def thinned(events: Events, most: int) -> Events:
    """Return at most ``most`` of the events, spread evenly."""
    step = max(1, math.ceil(len(events) / most))
    return events[::step]


def dithered(events: Events) -> Events:
    """Return the events at random places in their pixels, if they are at pixel centres, where a grid adds sharpness."""
    if not events.whole_pixels:
        return events
    rng = np.random.default_rng(0)
    right, down = rng.uniform(-0.5, 0.5, (2, len(events))).astype(np.float32)
    return Events(events.x + right, events.y + down, events.t, events.p)


def image_tiles(image: NDArray[np.float32], side: int = TILE_PX) -> NDArray[np.float32]:
    """Return the square tiles of an image, shape (n, side * side), without a rest at the right and at the bottom."""
    height, width = image.shape
    rows = height // side
    columns = width // side
    whole = image[: rows * side, : columns * side]
    tiles = whole.reshape(rows, side, columns, side).swapaxes(1, 2)
    return tiles.reshape(rows * columns, side * side)


def smooth_image(events: Events, votes: Votes, sigma: float) -> NDArray[np.float32]:
    """Return the image of the events [events per pixel], smoothed; ``votes`` are its buffers."""
    votes.add_unmoved(events)
    image = votes.take()[0]
    return smoothed(image, sigma)


def grey_images(images: Sequence[NDArray[np.floating]]) -> list[NDArray[np.uint8]]:
    """Return images of events with 8 bits, all on one scale."""
    positive = np.concatenate([image[image > 0.0] for image in images])
    brightest = float(np.percentile(positive, BRIGHT_PERCENTILE)) if positive.size else 1.0
    grey = []
    for image in images:
        scaled = np.clip(255.0 / brightest * image, 0.0, 255.0)
        grey.append(scaled.astype(np.uint8))
    return grey


def pixel_index(events: Events, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return the index of each event's pixel, row by row; events outside have the nearest pixel's index."""
    width, height = size
    column = _nearest_inside(events.x, width)
    row = _nearest_inside(events.y, height)
    return np.asarray(row * width + column)


def _nearest_inside(place: NDArray[Any], count: int) -> NDArray[np.int64]:
    """Return the nearest of ``count`` pixels along an axis, for places along it [px]."""
    inside = np.clip(np.nan_to_num(place), 0, count - 1)
    return np.rint(inside).astype(np.int64)
