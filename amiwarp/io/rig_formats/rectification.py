"""Rectification of a pair of cameras: virtual cameras whose rows are the epipolar lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.rig_formats.task import Matrix, RigTask
from amiwarp.optics.camera import Camera


@dataclass(frozen=True, slots=True)
class Rectified:
    """Virtual pinhole cameras of a pair, which look in the same direction, with the same focal length and centre."""

    left: Matrix
    """Rotation from the left camera's frame to the frame of its virtual camera, shape ``(3, 3)``."""
    right: Matrix
    """The same of the right camera."""
    focal: float
    """Focal length [px]."""
    centre: tuple[float, float]
    """Principal point [px]."""
    baseline: float
    """Distance of the cameras along x [m]."""

    @property
    def intrinsics(self) -> list[float]:
        """Focal lengths and principal point of the virtual cameras [px]."""
        return [self.focal, self.focal, *self.centre]

    def disparity_to_depth(self) -> Matrix:
        """Return the matrix that turns (x, y, disparity, 1) into homogeneous points, shape ``(4, 4)``."""
        x, y = self.centre
        return np.array(
            [
                [1.0, 0.0, 0.0, -x],
                [0.0, 1.0, 0.0, -y],
                [0.0, 0.0, 0.0, self.focal],
                [0.0, 0.0, 1.0 / self.baseline, 0.0],
            ]
        )

    def map_of(self, camera: Camera, rotation: Matrix) -> NDArray[np.float32]:
        """Return the rectified position of each pixel [px], shape ``(height, width, 2)``; NaN if there is none."""
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        rays = camera.pixels_to_rays(pixels.reshape(-1, 2).astype(np.float64)) @ rotation.T
        ahead = np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)
        places = self.focal * rays[:, :2] / ahead + self.centre
        return places.reshape(pixels.shape).astype(np.float32)

    def image_of(self, image: NDArray[Any], camera: Camera, rotation: Matrix) -> NDArray[np.uint8]:
        """Return an image as the virtual camera sees it; black where the camera does not look."""
        from scipy.ndimage import map_coordinates

        height, width = image.shape[:2]
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        ahead = np.ones((len(pixels), 1))
        rays = np.concatenate([(pixels - self.centre) / self.focal, ahead], axis=1) @ rotation
        x, y = camera.rays_to_pixels(rays).T
        layers = image.reshape(height, width, -1)
        seen = [
            map_coordinates(layers[..., layer], [y, x], order=1, output=np.float64)
            for layer in range(layers.shape[2])
        ]
        return np.rint(np.stack(seen, axis=-1)).astype(np.uint8).reshape(image.shape)


def rectify(task: RigTask, left: str, right: str) -> Rectified:
    """Return the virtual cameras of a pair. Raises :class:`AmiwarpError` if left and right are swapped.

    Their x axis is the baseline, and their z axis the mean of the two optical axes as far as it is at a right angle to
    it (Fusiello et al., "A compact algorithm for rectification of stereo pairs", 2000).
    """
    from_right = task.between(right, left)
    turned = from_right[:3, :3]
    distance = float(np.linalg.norm(from_right[:3, 3]))
    if from_right[0, 3] <= 0.0 or distance == 0.0:
        raise AmiwarpError(
            f"{task.out}: {right} does not lie to the right of {left} (x {1e3 * from_right[0, 3]:.6g} mm); give "
            "--left and --right"
        )
    x = from_right[:3, 3] / distance
    mean_axis = turned[:, 2] + [0.0, 0.0, 1.0]
    y = np.cross(mean_axis, x)
    y /= np.linalg.norm(y)
    rotation = np.array([x, y, np.cross(x, y)])
    cameras = (task.camera(left), task.camera(right))
    rotations = (rotation, rotation @ turned)
    focal = float(np.mean([(camera.fx + camera.fy) / 2.0 for camera in cameras]))
    # The middles of both images lie as near as possible to the middle of the virtual image.
    middles = []
    for camera, own_rotation in zip(cameras, rotations, strict=True):
        middle = np.array([[(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]])
        ray = own_rotation @ camera.pixels_to_rays(middle)[0]
        middles.append(middle[0] - focal * ray[:2] / ray[2])
    centre_x, centre_y = np.mean(middles, axis=0).tolist()
    return Rectified(rotations[0], rotations[1], focal, (centre_x, centre_y), distance)
