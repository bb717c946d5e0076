"""Pixels of a simulation whose scene is known: pictures of other people's recordings do not show everything."""

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.description import Scene, SimulationValues
from amiwarp.simulation.picture_maps import place_scene


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

    def __init__(self, simulation: SimulationValues) -> None:
        """Find the pixel of the pictures that each pixel of the camera sees."""
        scene = simulation.scene
        self._frames: PartlyKnown | None = None
        if isinstance(scene, Scene) and isinstance(scene.frames, PartlyKnown):
            self._frames = scene.frames
        self._duration_us = simulation.duration_us
        self._last: NDArray[np.bool_] | None = None
        if self._frames is not None:
            self._rows, self._columns, self._inside = picture_pixels(simulation)

    def take(self) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Yield time [us] and mask of each change since the last call, shape (height, width)."""
        if self._frames is None:
            return
        for t, known in self._frames.take_known():
            mask = self._inside & known[self._rows, self._columns]
            changed = self._last is None or (mask != self._last).any()
            if t <= self._duration_us and changed:
                self._last = mask
                yield t, mask


def picture_pixels(
    simulation: SimulationValues,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return row and column of the picture that each pixel of the camera sees without the prism, and if it is inside.

    Each has the shape (height, width) of the camera. Rows and columns outside the picture are those nearest to it.
    """
    camera = simulation.camera
    place = place_scene(simulation)
    scene = simulation.scene
    assert isinstance(scene, Scene)
    width, height = scene.frames.size
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    rays = np.asarray(camera.pixels_to_rays(pixels))
    ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.0)
    straight_ahead = (0.0, 0.0, 1.0)  # for rays that do not meet the plane; they are not inside
    rays = np.where(ahead[:, None], rays, straight_ahead)

    # From the plane at distance 1 to texels of the map, and from these to pixels of the picture.
    left, top, right, bottom = place.box
    texel_x = (rays[:, 0] / rays[:, 2] - place.left) * place.pitch[0]
    texel_y = (rays[:, 1] / rays[:, 2] - place.top) * place.pitch[1]
    column = left + texel_x * (right - left) / place.width
    row = top + texel_y * (bottom - top) / place.height

    inside = ahead & (column >= 0.0) & (column < width) & (row >= 0.0) & (row < height)
    rows = np.clip(row, 0, height - 1).astype(np.int64)
    columns = np.clip(column, 0, width - 1).astype(np.int64)
    shape = (camera.height, camera.width)
    return rows.reshape(shape), columns.reshape(shape), inside.reshape(shape)
