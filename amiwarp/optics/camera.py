"""The pinhole camera: size, intrinsics and lens distortion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.lens import Distortion
from amiwarp.validation import array, real, shown, whole

LARGEST_SIZE = 65536
"""Largest width and height of a sensor [px]: columns and rows of events are uint16."""
LEAST_FOCAL = 1e-3
"""Least focal length, in widths (fx) or heights (fy) of the image: a field of view of 179.8 deg."""
LARGEST_FOCAL = 1e6
"""Largest focal length [px]: a microradian per pixel. Beyond it float32 no longer holds the prism's displacement."""
LEAST_FOV = 1e-9
"""Least field of view [rad]; the focal length then decides."""


Rows = TypeVar("Rows")
"""A NumPy array of shape (n, 2) or (n, 3), or a Warp array of vec2 or vec3, shape (n,): the same kind comes out."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera: pixel ``(0, 0)`` has its centre at image coordinate ``(0.0, 0.0)``.

    Limits: 1 to 65536 px each way; a focal length from 0.001 of the image's width or height (179.8 deg) to 1e6 px; a
    principal point within 65536 px of the first pixel. Raises :class:`AmiwarpError` for anything else.
    """

    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point, x [px]."""
    cy: float
    """Principal point, y [px]."""
    distortion: Distortion | None = None
    """Lens distortion, or None for a pure pinhole."""

    def __post_init__(self) -> None:
        for name, focal in (("width", "fx"), ("height", "fy")):
            size = whole(getattr(self, name), f"camera {name}", 1, LARGEST_SIZE, " pixels")
            length = real(getattr(self, focal), f"camera {focal}", LEAST_FOCAL * size, LARGEST_FOCAL, " pixels")
            object.__setattr__(self, name, size)
            object.__setattr__(self, focal, length)
        for name in ("cx", "cy"):
            value = real(getattr(self, name), f"camera {name}", -LARGEST_SIZE, LARGEST_SIZE, " pixels")
            object.__setattr__(self, name, value)
        if not isinstance(self.distortion, Distortion | None):
            raise AmiwarpError(
                f"camera distortion is {shown(self.distortion)}; expected RadialTangential, Fisheye or None"
            )

    @classmethod
    def from_fov(cls, width: int, height: int, fov: float, distortion: Distortion | None = None) -> Camera:
        """A centred camera with square pixels and horizontal field of view ``fov`` [rad] (before distortion)."""
        width = whole(width, "camera width", 1, LARGEST_SIZE, " pixels")
        height = whole(height, "camera height", 1, LARGEST_SIZE, " pixels")
        hint = " rad, 0 .. 180 deg; is it given in degrees?"
        fov = real(fov, "camera field of view", LEAST_FOV, math.nextafter(math.pi, 0.0), hint)
        focal = width / (2.0 * math.tan(fov / 2.0))
        return cls(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0, distortion)

    @property
    def fov(self) -> float:
        """Horizontal field of view of the undistorted pinhole [rad]."""
        return 2.0 * math.atan(self.width / (2.0 * self.fx))

    def pixels_to_rays(self, xy: Rows) -> Rows:
        """Unit bearings (n, 3) of pixels (n, 2) [px]; NaN rows where the lens sends no ray.

        Raises :class:`AmiwarpError` for other shapes, and for what are no numbers.
        """
        return _run("pixels_to_rays", self, xy, (2, 3))

    def rays_to_pixels(self, rays: Rows) -> Rows:
        """Pixels (n, 2) [px] of bearings (n, 3), of any length.

        NaN rows behind the image plane and where the distortion folds back. Raises :class:`AmiwarpError` for other
        shapes.
        """
        return _run("rays_to_pixels", self, rays, (3, 2))


def _run(kernel_name: str, camera: Camera, rows: Any, sizes: tuple[int, int]) -> Any:
    import warp as wp

    from amiwarp.kernels import camera as kernels
    from amiwarp.kernels.launch import launch
    from amiwarp.optics.device_camera import camera_params

    given, wanted = ({2: wp.vec2, 3: wp.vec3}[size] for size in sizes)
    if isinstance(rows, wp.array):
        if rows.dtype is not given or rows.ndim != 1:
            raise AmiwarpError(f"array has type {rows.dtype} and shape {rows.shape}; give vec{sizes[0]} of shape (n,)")
        out = wp.empty(len(rows), dtype=wanted, device=rows.device)
        params = camera_params(camera, str(rows.device))
        launch(getattr(kernels, kernel_name), len(rows), [params, rows], [out], device=rows.device)
        return out
    rows = array(rows, "array")
    if rows.ndim != 2 or rows.shape[1] != sizes[0]:
        raise AmiwarpError(f"array has shape {rows.shape}; give (n, {sizes[0]})")
    result = _run(kernel_name, camera, wp.array(rows.astype(np.float32), dtype=given, device="cpu"), sizes)
    return result.numpy().astype(rows.dtype if np.issubdtype(rows.dtype, np.floating) else np.float32, copy=False)
