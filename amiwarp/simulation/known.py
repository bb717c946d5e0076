"""Pixels of a simulation whose scene is known: pictures of other people's recordings do not show everything."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.scene import Scene
from amiwarp.simulation.scenery import place_scene

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation


@runtime_checkable
class PartlyKnown(Protocol):
    """Pictures (:class:`amiwarp.Frames`) parts of which are guessed."""

    def take_known(self) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return, and forget, the masks of the pictures read so far.

        Each is the time from which it holds [us], rising, and whether each pixel of the pictures is known, shape
        (height, width).
        """


class KnownPixels:
    """Masks of the pixels whose scene is known, without the prism. They are taken from the pictures while these run."""

    def __init__(self, simulation: Simulation) -> None:
        """Find the pixel of the pictures that each pixel of the camera sees."""
        scene = simulation.scene
        self._frames = scene.frames if isinstance(scene, Scene) and isinstance(scene.frames, PartlyKnown) else None
        self._duration_us = simulation.duration_us
        self._last: NDArray[np.bool_] | None = None
        if self._frames is not None:
            self._rows, self._columns, self._inside = picture_pixels(simulation)

    def take(self) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Yield time [us] and mask of each change since the last call, shape (height, width)."""
        for t, known in [] if self._frames is None else self._frames.take_known():
            mask = self._inside & known[self._rows, self._columns]
            if t <= self._duration_us and (self._last is None or (mask != self._last).any()):
                self._last = mask
                yield t, mask


def picture_pixels(simulation: Simulation) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return row and column of the picture that each pixel of the camera sees without the prism, and if it is inside.

    Each has the shape (height, width) of the camera. Rows and columns outside the picture are those nearest to it.
    """
    camera, place, scene = simulation.camera, place_scene(simulation), simulation.scene
    assert isinstance(scene, Scene)
    width, height = scene.frames.size
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = np.asarray(camera.pixels_to_rays(np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)))
    ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.0)
    rays = np.where(ahead[:, None], rays, (0.0, 0.0, 1.0))
    left, top, right, bottom = place.box
    column = left + (rays[:, 0] / rays[:, 2] - place.left) * place.pitch[0] * (right - left) / place.width
    row = top + (rays[:, 1] / rays[:, 2] - place.top) * place.pitch[1] * (bottom - top) / place.height
    inside = ahead & (column >= 0.0) & (column < width) & (row >= 0.0) & (row < height)
    rows, columns = (np.clip(v, 0, n - 1).astype(np.int64) for v, n in ((row, height), (column, width)))
    shape = (camera.height, camera.width)
    return rows.reshape(shape), columns.reshape(shape), inside.reshape(shape)
