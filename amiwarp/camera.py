"""The pinhole camera: size, intrinsics, lens distortion."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
            raise AmiwarpError(f"camera size {self.width}x{self.height} is not positive; give width and height in pixels")
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise AmiwarpError(f"camera {name} = {value} is not a positive focal length in pixels")
        for name in ("cx", "cy"):
            if not math.isfinite(getattr(self, name)):
                raise AmiwarpError(f"camera {name} = {getattr(self, name)} is not finite")

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
