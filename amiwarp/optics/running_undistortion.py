"""Undistortion of a stream of a sensor's events, which arrive in packets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import pixel_places as kernels
from amiwarp.kernels.launch import RecordedLaunch
from amiwarp.kernels.quiet_start import start_once
from amiwarp.optics.camera import (
    Camera,
    UndistortedPlaces,
    check_pixels,
    places_of_pixels,
    undistorted_places,
)

BLOCK = 1 << 14
"""Largest number of events that the kernel takes at a time. They stay in a core's cache."""
COUNT = 8
"""Place of the number of events among the arguments of the kernel."""


class RunningUndistortion:
    """Undistortion of one stream by a camera, to a pinhole camera with the same focal lengths and principal point.

    It keeps memory for a block of events, and finds the same places as
    :func:`~amiwarp.optics.camera.undistorted_places`, which takes twice the time for a packet.
    """

    def __init__(self, camera: Camera) -> None:
        start_once()
        self._camera = camera
        self._target = replace(camera, distortion=None)
        table = places_of_pixels(camera, self._target)
        pairs = np.stack([table.x, table.y], axis=1).ravel()
        types = (wp.uint16, wp.uint16, wp.float32, wp.float32, wp.uint8)
        arrays = [wp.empty(BLOCK, dtype=kind, device="cpu") for kind in types]
        self._x, self._y, *self._found = (array.numpy() for array in arrays)
        places = wp.array(pairs, dtype=float, device="cpu", copy=False)
        image = wp.vec2i(self._target.width, self._target.height)
        inputs = [places, camera.width, image, *arrays, 0]
        self._launch = RecordedLaunch(kernels.look_up_places, inputs, [], device="cpu")

    def places(self, events: Any) -> UndistortedPlaces:
        """Return the places of events. Raises :class:`AmiwarpError` for an event of a sensor outside the camera."""
        if not events.whole_pixels:
            return undistorted_places(events, self._camera, self._target)
        check_pixels(events, self._camera)
        count = len(events)
        columns: tuple[NDArray[Any], ...] = (
            np.empty(count, np.float32),
            np.empty(count, np.float32),
            np.empty(count, np.uint8),
        )
        for start in range(0, count, BLOCK):
            stop = min(start + BLOCK, count)
            self._x[: stop - start] = events.x[start:stop]
            self._y[: stop - start] = events.y[start:stop]
            self._launch.set(COUNT, stop - start)
            self._launch.repeat()
            for column, block in zip(columns, self._found, strict=True):
                column[start:stop] = block[: stop - start]
        x, y, outside = columns
        return UndistortedPlaces(x, y, outside.view(np.bool_))
