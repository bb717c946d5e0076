"""Pictures of a camera with lens distortion or an off-centre axis, as a centred pinhole camera sees them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.camera import Camera
from amiwarp.simulation.translation.event_pictures import EventPictures
from amiwarp.simulation.translation.picture_flow import warped


def centred(camera: Camera) -> Camera:
    """Return the pinhole camera of the same size and horizontal field of view, with its axis in the middle."""
    return Camera.from_fov(camera.width, camera.height, camera.fov)


def is_centred(camera: Camera) -> bool:
    """Whether :func:`centred` changes nothing, up to a hundredth of a pixel."""
    if camera.distortion is not None:
        return False
    same = centred(camera)
    given = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    wanted = np.array([same.fx, same.fy, same.cx, same.cy])
    return bool((np.abs(given - wanted) < 0.01).all())


def pixel_grid(camera: Camera) -> NDArray[np.float64]:
    """Return all pixels of a camera, row by row [px], shape (n, 2)."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([x, y], axis=2).reshape(-1, 2).astype(np.float64)


def looking(
    camera: Camera, rays: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where rays meet the image of a camera, for one ray per pixel of an image of ``shape`` (height, width).

    The first array is the offset from each pixel [px], shape (height, width, 2); the second tells whether the ray meets
    the image.
    """
    rows, columns = np.indices(shape)
    xy = np.asarray(camera.rays_to_pixels(rays), np.float64).reshape(*shape, 2)
    low = np.array([-0.5, -0.5])
    high = np.array([camera.width - 0.5, camera.height - 0.5])
    inside = np.asarray(((xy >= low) & (xy < high)).all(axis=2))
    offset = xy - np.stack([columns, rows], axis=2)
    return np.nan_to_num(offset).astype(np.float32), inside


class RectifiedPictures:
    """Pictures as a centred pinhole camera without distortion sees them (:class:`amiwarp.Frames`)."""

    def __init__(self, pictures: EventPictures, camera: Camera) -> None:
        """``camera``: the camera that took the pictures."""
        self._pictures = pictures
        rays = np.asarray(centred(camera).pixels_to_rays(pixel_grid(camera)))
        self._offset, self._inside = looking(camera, rays, (camera.height, camera.width))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self._pictures.size

    @property
    def interval_us(self) -> float:
        """Smallest time between two pictures [us]."""
        return self._pictures.interval_us

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time [us] and linear luminance, shape (height, width)."""
        for t, light in self._pictures.read():
            yield t, np.maximum(warped(light, self._offset), np.float32(0.0))

    def take_known(self) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return, and forget, the masks of the pictures read so far."""
        masks = []
        for t, known in self._pictures.take_known():
            still_known = warped(known.astype(np.float32), self._offset) > 0.5
            masks.append((t, still_known & self._inside))
        return masks
