"""The pinhole camera: size, intrinsics, lens distortion."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Any, TypeVar

import numpy as np

from amiwarp.errors import AmiwarpError


@dataclass(frozen=True, slots=True)
class RadialTangential:
    """OpenCV's radial-tangential distortion, coefficients in its order k1, k2, p1, p2, k3."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


@dataclass(frozen=True, slots=True)
class Fisheye:
    """OpenCV's fisheye (equidistant) distortion, coefficients k1 .. k4."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0


Distortion = RadialTangential | Fisheye

Rows = TypeVar("Rows")
"""A NumPy array of shape (n, 2) or (n, 3), or a Warp array of vec2 or vec3, shape (n,): the same kind comes out."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera: pixel ``(0, 0)`` has its centre at image coordinate ``(0.0, 0.0)``.

    Raises :class:`AmiwarpError` where a size or focal length is not positive or a number is not finite.
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
        if self.width < 1 or self.height < 1:
            raise AmiwarpError(f"camera size {self.width}x{self.height} px is not positive; give width and height")
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise AmiwarpError(f"camera {name} = {value} is not a positive focal length in pixels")
        for name in ("cx", "cy"):
            if not math.isfinite(getattr(self, name)):
                raise AmiwarpError(f"camera {name} = {getattr(self, name)} is not finite")
        if self.distortion is not None and not all(map(math.isfinite, astuple(self.distortion))):
            raise AmiwarpError(f"camera distortion {self.distortion} has a coefficient that is not finite")

    @classmethod
    def from_fov(cls, width: int, height: int, fov: float, distortion: Distortion | None = None) -> Camera:
        """A centred camera with square pixels and horizontal field of view ``fov`` [rad] (before distortion)."""
        if not 0.0 < fov < math.pi:
            raise AmiwarpError(f"field of view {math.degrees(fov):.6g} deg is not between 0 and 180")
        focal = width / (2.0 * math.tan(fov / 2.0))
        return cls(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0, distortion)

    @property
    def fov(self) -> float:
        """Horizontal field of view of the undistorted pinhole [rad]."""
        return 2.0 * math.atan(self.width / (2.0 * self.fx))

    def pixels_to_rays(self, xy: Rows) -> Rows:
        """Unit bearings (n, 3) of pixels (n, 2) [px]; NaN rows where the lens sends no ray.

        Raises :class:`AmiwarpError` for other shapes.
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
    from amiwarp.kernels.structs import camera_params

    given, wanted = ({2: wp.vec2, 3: wp.vec3}[size] for size in sizes)
    if isinstance(rows, wp.array):
        if rows.dtype is not given or rows.ndim != 1:
            raise AmiwarpError(f"array has type {rows.dtype} and shape {rows.shape}; give vec{sizes[0]} of shape (n,)")
        out = wp.empty(len(rows), dtype=wanted, device=rows.device)
        params = camera_params(camera, str(rows.device))
        launch(getattr(kernels, kernel_name), len(rows), [params, rows], [out], device=rows.device)
        return out
    rows = np.asarray(rows)
    if rows.ndim != 2 or rows.shape[1] != sizes[0]:
        raise AmiwarpError(f"array has shape {rows.shape}; give (n, {sizes[0]})")
    result = _run(kernel_name, camera, wp.array(rows.astype(np.float32), dtype=given, device="cpu"), sizes)
    return result.numpy().astype(rows.dtype if np.issubdtype(rows.dtype, np.floating) else np.float32, copy=False)
