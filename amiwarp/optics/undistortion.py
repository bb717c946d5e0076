"""Undistortion of events by the lens of their camera, on the CPU."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from amiwarp.events.recording import Events
    from amiwarp.optics.camera import Camera


class UndistortedPlaces(NamedTuple):
    """Places of events in an undistorted image."""

    x: NDArray[np.float32]
    """Column [px], NaN if no ray reaches the event, shape ``(n,)``."""
    y: NDArray[np.float32]
    """Row [px], NaN if no ray reaches the event, shape ``(n,)``."""
    outside: NDArray[np.bool_]
    """Whether each event lies on no pixel of the undistorted image, shape ``(n,)``."""


def undistorted_places(events: Events, camera: Camera, target: Camera) -> UndistortedPlaces:
    """Return the places of events of ``camera`` in the image of ``target``, which has the same view.

    Events of a sensor are looked up in a table of all pixels, which is many times faster than a kernel's launch for
    each packet of a stream. Raises :class:`AmiwarpError` if such an event lies outside the image of ``camera``.
    """
    if not events.whole_pixels:
        return _places_of(np.stack([events.x, events.y], axis=1), camera, target)
    _check_pixels(events, camera)
    table = _places_of_pixels(camera, target)
    pixel = events.y.astype(np.intp)
    pixel *= camera.width
    pixel += events.x
    return UndistortedPlaces(*(column.take(pixel) for column in table))


@lru_cache(maxsize=4)
def _places_of_pixels(camera: Camera, target: Camera) -> UndistortedPlaces:
    """Return the places of all pixels, row by row."""
    rows, columns = np.indices((camera.height, camera.width), np.float32)
    return _places_of(np.stack([columns.ravel(), rows.ravel()], axis=1), camera, target)


def _places_of(xy: NDArray[np.float32], camera: Camera, target: Camera) -> UndistortedPlaces:
    """Return the places of points of ``camera`` [px], shape (n, 2)."""
    places = target.rays_to_pixels(camera.pixels_to_rays(xy))
    x, y = np.ascontiguousarray(places.T)
    in_columns = (x >= -0.5) & (x < target.width - 0.5)
    in_rows = (y >= -0.5) & (y < target.height - 0.5)
    return UndistortedPlaces(x, y, ~(in_columns & in_rows))


def _check_pixels(events: Events, camera: Camera) -> None:
    """Raise :class:`AmiwarpError` if an event lies outside the camera's image."""
    if not len(events):
        return
    largest_x = int(events.x.max())
    largest_y = int(events.y.max())
    if largest_x >= camera.width or largest_y >= camera.height:
        raise AmiwarpError(
            f"events reach to pixel ({largest_x}, {largest_y}), and the camera has {camera.width}x{camera.height} "
            "pixels; give the camera of these events"
        )
