"""Camera parameters on a device, for kernels."""

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from amiwarp.kernels import camera as kernels
from amiwarp.optics.lens import Fisheye, RadialTangential

if TYPE_CHECKING:
    from amiwarp.optics.camera import Camera


@lru_cache(maxsize=16)
def camera_params(camera: "Camera", device: str) -> kernels.CameraParams:
    """Return the camera's parameters on ``device``, with a table of bearing vectors if the lens distorts."""
    c = kernels.CameraParams()
    c.fx, c.fy, c.cx, c.cy = camera.fx, camera.fy, camera.cx, camera.cy
    c.width, c.height = camera.width, camera.height
    c.kind, c.limit = int(kernels.PINHOLE), 1.0e30
    d = camera.distortion
    if d is None:
        c.rays = wp.empty((0, 0), dtype=wp.vec3, device=device)
        return c
    if isinstance(d, RadialTangential):
        coefficients = (d.k1, d.k2, d.p1, d.p2, d.k3)
        c.kind, c.limit = int(kernels.RADIAL_TANGENTIAL), fold_radius(d.k1, d.k2, d.k3, largest=100.0)
    elif isinstance(d, Fisheye):
        coefficients = (d.k1, d.k2, d.k3, d.k4, 0.0)
        c.kind, c.limit = int(kernels.FISHEYE), fold_radius(d.k1, d.k2, d.k3, d.k4, largest=0.999 * math.pi / 2)
    c.k = type(c.k)(*coefficients)
    rays = wp.empty((camera.height, camera.width), dtype=wp.vec3, device=device)
    wp.launch(kernels.fill_rays, dim=rays.shape, inputs=[c], outputs=[rays], device=device)
    c.rays = rays
    return c


@lru_cache(maxsize=16)
def pinhole_params(camera: "Camera") -> "kernels.PinholeParams | None":
    """Return the camera's parameters for kernels without a distortion branch, or None if the lens distorts."""
    if camera.distortion is not None:
        return None
    c = kernels.PinholeParams()
    c.fx, c.fy, c.cx, c.cy = camera.fx, camera.fy, camera.cx, camera.cy
    c.inverse_fx, c.inverse_fy = 1.0 / camera.fx, 1.0 / camera.fy
    return c


def fold_radius(*k: float, largest: float) -> float:
    """Return the radius up to which the distorted radius r(1 + k1 r² + k2 r⁴ + …) increases with r.

    It is the first root of the slope, or ``largest`` if there is none below. The polynomial in 1/r² is monic, so a last
    coefficient of zero causes no division by zero.
    """
    roots = np.roots([1.0, *((2 * i + 3) * value for i, value in enumerate(k))])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return min(largest, 1.0 / math.sqrt(real.max())) if len(real) else largest
