"""Camera on the device: pixel to unit bearing and back, with OpenCV's two distortion models."""

import math
from dataclasses import astuple
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from amiwarp.kernels.launch import launch

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


PINHOLE = wp.constant(0)


RADIAL_TANGENTIAL = wp.constant(1)


FISHEYE = wp.constant(2)


# Radial-tangential with a denominator; apart, so that a lens without one needs no division
RATIONAL = wp.constant(3)


NEWTON_STEPS = wp.constant(12)


# Largest error of a converged inverse relative to 1 + radius: 1e-3 px at a focal length of 1000 px
LARGEST_RESIDUAL = wp.constant(1.0e-6)


NAN = wp.constant(float("nan"))


@wp.struct
class CameraParams:
    """Camera parameters. ``k`` holds k1 k2 p1 p2 k3 k4 k5 k6 (radial-tangential) or k1 .. k4 (fisheye)."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    kind: int
    k: wp.types.vector(length=8, dtype=float)
    # Largest tangent (radial-tangential) or angle (fisheye) with one-to-one distortion
    limit: float
    # Bearing of each pixel centre, NaN if invalid; empty for a pinhole
    rays: wp.array2d(dtype=wp.vec3)


@wp.struct
class PinholeParams:
    """Camera without distortion, for kernels without branches. All values in [px], the inverses in [1/px]."""

    fx: float
    fy: float
    inverse_fx: float
    inverse_fy: float
    cx: float
    cy: float


@wp.func
def invalid_pixel() -> wp.vec2:
    """Return an invalid pixel, whose coordinates are NaN."""
    return wp.vec2(NAN, NAN)


@wp.func
def invalid_ray() -> wp.vec3:
    """Return an invalid bearing, whose components are NaN."""
    return wp.vec3(NAN, NAN, NAN)


@wp.func
def distort_radial_tangential(c: CameraParams, p: wp.vec2) -> wp.vec2:
    """Distort normalised (tangent) coordinates by OpenCV's radial-tangential model."""
    r2 = wp.dot(p, p)
    radial = 1.0 + r2 * (c.k[0] + r2 * (c.k[1] + r2 * c.k[4]))
    if c.kind == RATIONAL:
        radial = radial / (1.0 + r2 * (c.k[5] + r2 * (c.k[6] + r2 * c.k[7])))
    x = p[0] * radial + 2.0 * c.k[2] * p[0] * p[1] + c.k[3] * (r2 + 2.0 * p[0] * p[0])
    y = p[1] * radial + c.k[2] * (r2 + 2.0 * p[1] * p[1]) + 2.0 * c.k[3] * p[0] * p[1]
    return wp.vec2(x, y)


@wp.func
def jacobian_radial_tangential(c: CameraParams, p: wp.vec2) -> wp.mat22:
    """Return the Jacobian of :func:`distort_radial_tangential`."""
    r2 = wp.dot(p, p)
    radial = 1.0 + r2 * (c.k[0] + r2 * (c.k[1] + r2 * c.k[4]))
    slope = 2.0 * (c.k[0] + r2 * (2.0 * c.k[1] + r2 * 3.0 * c.k[4]))
    if c.kind == RATIONAL:
        below = 1.0 + r2 * (c.k[5] + r2 * (c.k[6] + r2 * c.k[7]))
        radial = radial / below
        slope = (slope - radial * 2.0 * (c.k[5] + r2 * (2.0 * c.k[6] + r2 * 3.0 * c.k[7]))) / below
    xx = radial + slope * p[0] * p[0] + 2.0 * c.k[2] * p[1] + 6.0 * c.k[3] * p[0]
    xy = slope * p[0] * p[1] + 2.0 * c.k[2] * p[0] + 2.0 * c.k[3] * p[1]
    yy = radial + slope * p[1] * p[1] + 6.0 * c.k[2] * p[1] + 2.0 * c.k[3] * p[0]
    return wp.mat22(xx, xy, xy, yy)


@wp.func
def undistort_radial_tangential(c: CameraParams, d: wp.vec2) -> wp.vec3:
    """Return the unit bearing of a distorted point, by Newton's method.

    The result is invalid if the method does not converge inside the disc in which the distortion is one-to-one.
    """
    p = wp.vec2(d[0], d[1])
    if wp.length(p) > 0.9 * c.limit:
        p = p * (0.9 * c.limit / wp.length(p))
    # A variable, so that Warp does not unroll the loop, which is slow to compile
    steps = int(NEWTON_STEPS)
    for _ in range(steps):
        last = wp.vec2(p[0], p[1])
        p = p - wp.inverse(jacobian_radial_tangential(c, p)) * (distort_radial_tangential(c, p) - d)
        if p[0] == last[0] and p[1] == last[1]:  # all further steps would be 0
            break
    error = wp.length(distort_radial_tangential(c, p) - d)
    if not (error < LARGEST_RESIDUAL * (1.0 + wp.length(d)) and wp.length(p) <= c.limit):
        return invalid_ray()
    return wp.normalize(wp.vec3(p[0], p[1], 1.0))


@wp.func
def fisheye_radius(c: CameraParams, angle: float) -> float:
    """Return the distorted radius of an angle [rad] from the optical axis."""
    a2 = angle * angle
    return angle * (1.0 + a2 * (c.k[0] + a2 * (c.k[1] + a2 * (c.k[2] + a2 * c.k[3]))))


@wp.func
def fisheye_slope(c: CameraParams, angle: float) -> float:
    """Return the derivative of :func:`fisheye_radius`."""
    a2 = angle * angle
    return 1.0 + a2 * (3.0 * c.k[0] + a2 * (5.0 * c.k[1] + a2 * (7.0 * c.k[2] + a2 * 9.0 * c.k[3])))


@wp.func
def undistort_fisheye(c: CameraParams, d: wp.vec2) -> wp.vec3:
    """Return the unit bearing of a distorted point of a fisheye, by Newton's method."""
    radius = wp.length(d)
    if radius < 1.0e-8:
        return wp.normalize(wp.vec3(d[0], d[1], 1.0))
    angle = float(wp.min(radius, 0.9 * c.limit))
    # A variable, so that Warp does not unroll the loop, which is slow to compile
    steps = int(NEWTON_STEPS)
    for _ in range(steps):
        before = float(angle)
        angle = wp.clamp(
            angle - (fisheye_radius(c, angle) - radius) / fisheye_slope(c, angle), 0.0, c.limit
        )
        if angle == before:
            break
    if not (wp.abs(fisheye_radius(c, angle) - radius) < LARGEST_RESIDUAL * (1.0 + radius)):
        return invalid_ray()
    s = wp.sin(angle) / radius
    return wp.vec3(s * d[0], s * d[1], wp.cos(angle))


@wp.func
def solve_ray(c: CameraParams, xy: wp.vec2) -> wp.vec3:
    """Return the unit bearing of a pixel, computed without the table."""
    d = wp.vec2((xy[0] - c.cx) / c.fx, (xy[1] - c.cy) / c.fy)
    if c.kind == FISHEYE:
        return undistort_fisheye(c, d)
    if c.kind != PINHOLE:
        return undistort_radial_tangential(c, d)
    ray = wp.vec3(d[0], d[1], 1.0)
    return ray / wp.length(ray)  # wp.normalize would return zero, not NaN, for a NaN pixel


@wp.func
def pixel_to_ray(c: CameraParams, xy: wp.vec2) -> wp.vec3:
    """Return the unit bearing of a pixel, NaN if invalid; whole pixels of a distorted camera use its table."""
    if c.kind != PINHOLE:
        col = int(xy[0])
        row = int(xy[1])
        inside = col >= 0 and row >= 0 and col < c.width and row < c.height
        if inside and float(col) == xy[0] and float(row) == xy[1]:
            return c.rays[row, col]
    return solve_ray(c, xy)


@wp.func
def distort_fisheye(c: CameraParams, ray: wp.vec3) -> wp.vec2:
    """Return distorted normalised coordinates by OpenCV's fisheye model; invalid beyond the fold."""
    r = wp.length(wp.vec2(ray[0], ray[1]))
    angle = wp.atan2(r, ray[2])
    if angle > c.limit:
        return invalid_pixel()
    if r < 1.0e-8 * ray[2]:
        return wp.vec2(ray[0], ray[1]) / ray[2]
    return wp.vec2(ray[0], ray[1]) * (fisheye_radius(c, angle) / r)


@wp.func
def ray_to_pixel(c: CameraParams, ray: wp.vec3) -> wp.vec2:
    """Return the pixel of a bearing; NaN behind the image plane or where the distortion folds back."""
    if not (ray[2] > 1.0e-6 and wp.isfinite(ray)):
        return invalid_pixel()
    p = wp.vec2(ray[0] / ray[2], ray[1] / ray[2])
    if c.kind == FISHEYE:
        p = distort_fisheye(c, ray)
    elif c.kind != PINHOLE:
        if wp.length(p) > c.limit:
            return invalid_pixel()
        p = distort_radial_tangential(c, p)
    return wp.vec2(c.fx * p[0] + c.cx, c.fy * p[1] + c.cy)


@wp.kernel
def fill_rays(c: CameraParams, start: int, rays: wp.array2d(dtype=wp.vec3)):
    """Fill the camera's table of bearings: one pixel per thread."""
    i = start + wp.tid()
    row, col = i // c.width, i % c.width
    rays[row, col] = solve_ray(c, wp.vec2(float(col), float(row)))


@wp.kernel
def pixels_to_rays(
    c: CameraParams, xy: wp.array(dtype=wp.vec2), start: int, rays: wp.array(dtype=wp.vec3)
):
    """Compute the unit bearing of one pixel per thread."""
    i = start + wp.tid()
    rays[i] = pixel_to_ray(c, xy[i])


@wp.kernel
def rays_to_pixels(
    c: CameraParams, rays: wp.array(dtype=wp.vec3), start: int, xy: wp.array(dtype=wp.vec2)
):
    """Compute the pixel of one bearing per thread."""
    i = start + wp.tid()
    xy[i] = ray_to_pixel(c, rays[i])


FEW_RAYS = 1 << 12
"""Fewest rays of a camera's table that a thread of its own solves: each takes several steps of Newton's method."""


@lru_cache(maxsize=16)
def camera_params(camera: Any, device: str) -> CameraParams:
    """Return the camera's parameters on ``device``, with a table of bearing vectors if the lens distorts."""
    c = CameraParams()
    c.fx = camera.fx
    c.fy = camera.fy
    c.cx = camera.cx
    c.cy = camera.cy
    c.width = camera.width
    c.height = camera.height
    c.kind = int(PINHOLE)
    c.limit = 1.0e30
    d = camera.distortion
    if d is None:
        c.rays = wp.empty((0, 0), dtype=wp.vec3, device=device)
        return c
    k = astuple(d)  # eight numbers, or four of a fisheye lens
    if len(k) == 8:
        below = (d.k4, d.k5, d.k6)
        kind = RATIONAL if any(below) else RADIAL_TANGENTIAL
        c.kind = int(kind)
        c.limit = fold_radius(d.k1, d.k2, d.k3, below=below, largest=100.0)
    else:
        c.kind = int(FISHEYE)
        c.limit = fold_radius(d.k1, d.k2, d.k3, d.k4, largest=0.999 * math.pi / 2)
    c.k = type(c.k)(*k, *(0.0,) * (8 - len(k)))
    rays = wp.empty((camera.height, camera.width), dtype=wp.vec3, device=device)
    launch(fill_rays, rays.size, [c], [rays], device=device, smallest=FEW_RAYS)
    c.rays = rays
    return c


@lru_cache(maxsize=16)
def pinhole_params(camera: Any) -> Any:
    """Return the camera's parameters for kernels without a distortion branch, or None if the lens distorts."""
    if camera.distortion is not None:
        return None
    c = PinholeParams()
    c.fx = camera.fx
    c.fy = camera.fy
    c.cx = camera.cx
    c.cy = camera.cy
    c.inverse_fx = 1.0 / camera.fx
    c.inverse_fy = 1.0 / camera.fy
    return c


def fold_radius(*k: float, below: tuple[float, ...] = (), largest: float) -> float:
    """Return the radius up to which the distorted radius r(1 + k1 r² + k2 r⁴ + …) increases with r.

    ``below`` holds the coefficients of a denominator 1 + k4 r² + … It is the first root of the slope or of the
    denominator, or ``largest`` if there is none below. The polynomials in 1/r² are monic, so a last coefficient of zero
    causes no division by zero.
    """
    slope = np.array([1.0, *((2 * i + 3) * value for i, value in enumerate(k))])
    if any(below):  # the numerator of the slope of r·n/d is n_slope·d − n·r·d′
        d = np.array([1.0, *below])
        slope = np.convolve(slope, d) - np.convolve([1.0, *k], 2.0 * np.arange(len(d)) * d)
    roots = np.concatenate([np.roots(slope), np.roots([1.0, *below])])
    is_real = np.abs(roots.imag) < 1e-9 * np.abs(roots)
    found = roots.real[is_real & (roots.real > 0.0)]
    if not len(found):
        return largest
    return min(largest, 1.0 / math.sqrt(found.max()))
