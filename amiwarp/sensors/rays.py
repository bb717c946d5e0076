"""Rays of many cameras through their optic, each at its own angle, on a device."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import scene_rays
from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.launch import launch
from amiwarp.kernels.scene_rays import RayGrid
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.circle import CircleModel
from amiwarp.optics.models.ellipse import EllipseModel
from amiwarp.optics.models.plate import PlateModel
from amiwarp.schema.calls import guarded
from amiwarp.validation import whole

SQUARES = (1, 4, 9, 16, 25)
"""Numbers of rays of a pixel that are offered."""
ROTATION = math.atan(0.5)
"""Rotation of a pixel's grid of rays [rad], so that horizontal and vertical edges pass over them one by one."""


def sample_offsets(count: int) -> NDArray[np.float32]:
    """Return the places of a pixel's rays from its centre [px], shape (count, 2). ``count``: one of ``SQUARES``.

    They are a grid that is rotated if it is small enough to stay inside of the pixel.
    """
    count = whole(count, "rays_per_pixel", 1, SQUARES[-1])
    if count not in SQUARES:
        raise AmiwarpError(
            f"rays_per_pixel is {count}; choose among {', '.join(map(str, SQUARES))}"
        )
    side = math.isqrt(count)
    steps = (np.arange(side) + 0.5) / side - 0.5
    x, y = np.meshgrid(steps, steps)
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    if count != 4:
        return grid.astype(np.float32)
    # The rotated grid of four: each has a quarter of the pixel's columns and of its rows to itself
    c, s = math.cos(ROTATION), math.sin(ROTATION)
    turned = grid @ np.array([[c, s], [-s, c]])
    return (turned * (0.375 / np.abs(turned).max())).astype(np.float32)


@guarded
@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of the pixels of all cameras, in the frame of the renderer's camera, on a device.

    Examples
    --------
    >>> eyes = amiwarp.EventCamera(amiwarp.Renderer(3, "cpu"), amiwarp.Camera.from_fov(8, 6, 1.0), rays_per_pixel=4)
    >>> rays = eyes.rays(t_us=0)
    >>> rays.bundle(0).shape  # row, column, sample, and origin or direction
    (6, 8, 4, 2)
    """

    values: Any
    """Origins [m] and unit directions, Warp array of vec3, shape (bundles * height, width, samples, 2). The direction
    of a pixel without a ray is zero."""
    bundles: int
    """Number of bundles: one for each camera, or one for all."""

    @property
    def samples(self) -> int:
        """Number of rays of a pixel."""
        return int(self.values.shape[2])

    def bundle(self, camera: int) -> Any:
        """Return the rays of one camera.

        Parameters
        ----------
        camera : int
            Number of the camera, or 0 if all have the same rays.

        Returns
        -------
        warp.array
            Part of :attr:`values`, shape (height, width, samples, 2).
        """
        height = self.values.shape[0] // self.bundles
        k = camera if self.bundles > 1 else 0
        return self.values[k * height : (k + 1) * height]


class RayWriter:
    """Writes the rays of cameras at given angles into one array that is used again.

    ``axes``: signs of the axes of the renderer's camera frame. ``stride``: distance of the pixels that have rays.
    """

    def __init__(
        self,
        camera: Camera,
        optic: Model | None,
        axes: tuple[int, int, int],
        device: Any,
        samples: int = 1,
        stride: int = 1,
    ) -> None:
        if isinstance(optic, EllipseModel) or (
            isinstance(optic, PlateModel) and optic.depths is not None
        ):
            raise AmiwarpError(
                f"the optic is a model with a table for each pixel ({optic.NAME}), which gives no rays; give the model "
                "of the glass, such as amiwarp.ExactModel or amiwarp.PlateModel without depths"
            )
        self._model: Model = CircleModel(camera, 0.0) if optic is None else optic
        self._camera = camera_params(camera, str(device))
        self._device = device
        self._samples = samples
        grid = RayGrid()
        grid.width = -(-camera.width // stride)
        grid.height = -(-camera.height // stride)
        grid.stride = stride
        grid.offsets = wp.array(sample_offsets(samples), dtype=wp.vec2, device=device)
        grid.axes = wp.vec3(*axes)
        self.grid = grid
        """Pixels that have rays, for kernels."""
        self._values: wp.array | None = None

    def write(self, theta: NDArray[np.float64]) -> Rays:
        """Return the rays at the angles of each bundle [rad], shape (bundles,) or (bundles, 2); the last are lost."""
        bundles = len(theta)
        shape = (bundles * self.grid.height, self.grid.width, self._samples, 2)
        if self._values is None or self._values.shape != shape:
            self._values = wp.empty(shape, dtype=wp.vec3, device=self._device)
        within_a_turn = np.remainder(theta + math.pi, math.tau) - math.pi
        angles = within_a_turn.astype(np.float32).ravel()
        on_device = wp.array(angles, dtype=float, device=self._device)
        inputs = [self._model.params(self._device), self._camera, on_device, self.grid]
        count = self._values.size // 2
        launch(scene_rays.write_rays, count, inputs, [self._values.flatten()], device=self._device)
        return Rays(self._values, bundles)
