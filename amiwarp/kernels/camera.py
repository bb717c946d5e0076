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
RATIONAL = wp.constant(3)  # radial-tangential with a denominator; apart, so that a lens without one needs no division

NEWTON_STEPS = wp.constant(12)
LARGEST_RESIDUAL = wp.constant(
    1.0e-6
)  # largest error of a converged inverse relative to 1 + radius: 1e-3 px at a focal length of 1000 px
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
    limit: float  # largest tangent (radial-tangential) or angle (fisheye) with one-to-one distortion
    rays: wp.array2d(dtype=wp.vec3)  # bearing of each pixel centre, NaN if invalid; empty for a pinhole


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
    steps = int(NEWTON_STEPS)  # a variable, so that Warp does not unroll the loop, which is slow to compile
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
    steps = int(NEWTON_STEPS)  # a variable, so that Warp does not unroll the loop, which is slow to compile
    for _ in range(steps):
        before = float(angle)
        angle = wp.clamp(angle - (fisheye_radius(c, angle) - radius) / fisheye_slope(c, angle), 0.0, c.limit)
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
def pixels_to_rays(c: CameraParams, xy: wp.array(dtype=wp.vec2), start: int, rays: wp.array(dtype=wp.vec3)):
    """Compute the unit bearing of one pixel per thread."""
    i = start + wp.tid()
    rays[i] = pixel_to_ray(c, xy[i])


@wp.kernel
def rays_to_pixels(c: CameraParams, rays: wp.array(dtype=wp.vec3), start: int, xy: wp.array(dtype=wp.vec2)):
    """Compute the pixel of one bearing per thread."""
    i = start + wp.tid()
    xy[i] = ray_to_pixel(c, rays[i])


# -- rotation of the camera, and growth of the image


@wp.struct
class CameraRotationParams:
    """Angular velocity at time 0 [rad/s], angular acceleration [rad/s²], and growth of the image [1/s]."""

    velocity: wp.vec3
    acceleration: wp.vec3
    growth: float


@wp.func
def rotation_vector(camera_rotation: CameraRotationParams, time: float) -> wp.vec3:
    """Return the camera's rotation from time 0 to ``time`` [s], as axis times angle [rad]."""
    return camera_rotation.velocity * time + camera_rotation.acceleration * (0.5 * time * time)


@wp.func
def undo_camera_rotation(
    camera: CameraParams, xy: wp.vec2, camera_rotation: CameraRotationParams, time: float
) -> wp.vec2:
    """Return the pixel that the scene point seen at ``xy`` at ``time`` [s] has at time 0.

    A camera that moves forward by the share g of all distances sees the image grow by 1 / (1 - g). From g = 1 on, it is
    behind the scene, and pixels are NaN.
    """
    rotation = rotation_vector(camera_rotation, time)
    angle = wp.length(rotation)
    size = 1.0 - camera_rotation.growth * time
    if angle < 1.0e-9 and size == 1.0:
        return xy
    ray = pixel_to_ray(camera, xy)
    ray = wp.quat_rotate(wp.quat_from_axis_angle(rotation / wp.max(angle, 1.0e-9), angle), ray)
    return ray_to_pixel(camera, wp.vec3(size * ray[0], size * ray[1], wp.where(size > 0.0, ray[2], -1.0)))


@wp.func
def undo_camera_rotation(
    camera: PinholeParams, xy: wp.vec2, camera_rotation: CameraRotationParams, time: float
) -> wp.vec2:
    """Return the pixel at time 0, for a camera without distortion."""
    rotation = rotation_vector(camera_rotation, time)
    angle = wp.length(rotation)
    size = 1.0 - camera_rotation.growth * time
    if angle < 1.0e-9 and size == 1.0:
        return xy
    ray = wp.vec3((xy[0] - camera.cx) * camera.inverse_fx, (xy[1] - camera.cy) * camera.inverse_fy, 1.0)
    ray = wp.quat_rotate(wp.quat_from_axis_angle(rotation / wp.max(angle, 1.0e-9), angle), ray)
    scale = wp.where(wp.min(ray[2], size) > 1.0e-6, size / ray[2], NAN)
    return wp.vec2(camera.fx * (ray[0] * scale) + camera.cx, camera.fy * (ray[1] * scale) + camera.cy)


# Rotations of directions, as three floats; see :mod:`amiwarp.kernels.refraction`.

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.


@wp.func
def rotate_by_deflection(x: float, y: float, z: float, w0: float, w1: float, sine: float, versine: float):
    """Rotate a direction about z × w = (-w1, w0, 0) by Rodrigues' formula.

    A positive ``sine`` rotates the optical axis towards w.
    """
    d = w0 * x + w1 * y
    g = z * sine - d * versine
    return x + g * w0, y + g * w1, z - z * versine - d * sine


@wp.func
def sine_versine(a: float):
    """Return sine and 1 - cosine of an angle up to pi/2.

    Computed by their series, with equal bits on every device.
    """
    b = a * a
    s = 1.0 / 120.0 + b * (-1.0 / 5040.0 + b * (1.0 / 362880.0 - b / 39916800.0))
    v = 1.0 / 720.0 + b * (-1.0 / 40320.0 + b * (1.0 / 3628800.0 - b / 479001600.0))
    return a * (1.0 + b * (-1.0 / 6.0 + b * s)), b * (0.5 + b * (-1.0 / 24.0 + b * v))


@wp.func
def rotate(r: wp.mat33, x: float, y: float, z: float):
    """Return the matrix product r · (x, y, z)."""
    a = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
    b = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
    return a, b, r[2, 0] * x + r[2, 1] * y + r[2, 2] * z


# From a camera to its parameters, on the host.


FEW_RAYS = 1 << 12
"""Fewest rays of a camera's table that a thread of its own solves: each takes several steps of Newton's method."""


@lru_cache(maxsize=16)
def camera_params(camera: Any, device: str) -> CameraParams:
    """Return the camera's parameters on ``device``, with a table of bearing vectors if the lens distorts."""
    c = CameraParams()
    c.fx, c.fy, c.cx, c.cy = camera.fx, camera.fy, camera.cx, camera.cy
    c.width, c.height = camera.width, camera.height
    c.kind, c.limit = int(PINHOLE), 1.0e30
    d = camera.distortion
    if d is None:
        c.rays = wp.empty((0, 0), dtype=wp.vec3, device=device)
        return c
    k = astuple(d)  # eight numbers, or four of a fisheye lens
    if len(k) == 8:
        below = (d.k4, d.k5, d.k6)
        c.kind = int(RATIONAL if any(below) else RADIAL_TANGENTIAL)
        c.limit = fold_radius(d.k1, d.k2, d.k3, below=below, largest=100.0)
    else:
        c.kind, c.limit = int(FISHEYE), fold_radius(d.k1, d.k2, d.k3, d.k4, largest=0.999 * math.pi / 2)
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
    c.fx, c.fy, c.cx, c.cy = camera.fx, camera.fy, camera.cx, camera.cy
    c.inverse_fx, c.inverse_fy = 1.0 / camera.fx, 1.0 / camera.fy
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
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return min(largest, 1.0 / math.sqrt(real.max())) if len(real) else largest
