"""Shift of rays by a tilted plane-parallel plate, and where a point at a known depth then appears.

A plate leaves the direction of a ray and shifts it along the normal N of its faces: the camera sees along the ray as if
its centre were at g N. A point at inverse depth ρ on the ray appears, from the resting centre, at a displacement that
is linear in ρ. ``docs/explanation/optics.md`` derives both.
"""

import warp as wp

from amiwarp.kernels.camera import NAN, CameraParams, PinholeParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.refraction import compensate, compensate_direction, deflect, displace, inverted

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class PlateParams:
    """Tilted plane-parallel plate in front of a plane scene."""

    phase: float  # phase of the plate's angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    thickness: float  # distance between the faces [m]
    inside: float  # square of the refractive index, minus 1
    sin_tilt: float  # sine of the angle between the faces' normal and the optical axis
    cos_tilt: float  # cosine of this angle
    inverse_depth: float  # inverse depth of the scene [1/m]
    wedge: wp.vec2  # angle between the faces, along the tilt and across it [rad]


@wp.struct
class PlateMapParams:
    """Tilted plane-parallel plate, and the inverse depth of what each pixel sees."""

    phase: float  # phase of the plate's angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    plate: PlateParams  # the plate
    table: wp.array2d(dtype=float)  # inverse depth of what each pixel sees [1/m]


@wp.func
def plate_shift(m: PlateParams, x: float, y: float, z: float, w0: float, w1: float) -> float:
    """Return the distance g by which the plate shifts a ray along the faces' normal [m]; NaN if none passes.

    g = t (1 − c / √(n² − 1 + c²)) by Snell's law at both faces, where c is the cosine between ray and normal.
    """
    c = (m.sin_tilt * (w0 * x + w1 * y) + m.cos_tilt * z) / wp.sqrt(x * x + y * y + z * z)
    return m.thickness * (1.0 - wp.where(c > 0.0, c, NAN) / wp.sqrt(m.inside + c * c))


@wp.func
def bent_by_wedge(m: PlateParams, x: float, y: float, z: float, w: wp.vec2) -> wp.vec3:
    """Return the direction behind the plate of a camera's ray, which faces at an angle to each other change.

    Snell's law in vector form at both faces; the direction inside has the length n. NaN if no ray passes.
    """
    if m.wedge[0] == 0.0 and m.wedge[1] == 0.0:
        return wp.vec3(x, y, z)
    ray = wp.normalize(wp.vec3(x, y, z))
    near = wp.vec3(m.sin_tilt * w[0], m.sin_tilt * w[1], m.cos_tilt)
    along = wp.vec3(m.cos_tilt * w[0], m.cos_tilt * w[1], -m.sin_tilt)
    across = wp.vec3(-w[1], w[0], 0.0)
    far = wp.normalize(near + m.wedge[0] * along + m.wedge[1] * across)
    c = wp.dot(ray, near)
    inside = ray + (wp.sqrt(m.inside + c * c) - c) * near
    c = wp.dot(inside, far)
    return inside - (c - wp.sqrt(c * c - m.inside)) * far


@wp.func
def seen_from(m: PlateParams, x: float, y: float, z: float, w: wp.vec2) -> wp.vec3:
    """Return the place, in the camera's frame, from which the camera sees along a ray through the plate [m]."""
    g = plate_shift(m, x, y, z, w[0], w[1])
    return wp.vec3(g * m.sin_tilt * w[0], g * m.sin_tilt * w[1], g * m.cos_tilt)


@wp.func
def move_direction(
    m: PlateParams, inverse_depth: float, x: float, y: float, z: float, w0: float, w1: float
):
    """Return the direction from the resting centre to the point at an inverse depth [1/m] on the ray of a pixel."""
    k = inverse_depth * plate_shift(m, x, y, z, w0, w1)
    b = bent_by_wedge(m, x, y, z, wp.vec2(w0, w1))
    return (
        b[0] + k * (m.sin_tilt * w0 * b[2] - m.cos_tilt * b[0]),
        b[1] + k * (m.sin_tilt * w1 * b[2] - m.cos_tilt * b[1]),
        b[2],
    )


@wp.func
def compensate_direction(model: PlateParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the direction without the plate of a scene at the plate's one inverse depth."""
    return move_direction(model, model.inverse_depth, x, y, z, w0, w1)


@wp.func
def deflect(model: PlateParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel of a point of a plane scene, by a fixed-point iteration."""
    return inverted(model, camera, xy, w)


# -- a map of inverse depths


@wp.func
def inverse_depth_at(m: PlateMapParams, x: float, y: float) -> float:
    """Return the inverse depth [1/m] of what the nearest pixel sees; NaN for NaN."""
    if not (wp.abs(x) < 1.0e9 and wp.abs(y) < 1.0e9):  # a NaN pixel must not become an index
        return NAN
    col = wp.clamp(int(wp.floor(x + 0.5)), 0, m.table.shape[1] - 1)
    row = wp.clamp(int(wp.floor(y + 0.5)), 0, m.table.shape[0] - 1)
    return m.table[row, col]


@wp.func
def compensate(model: PlateMapParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the pixel without the plate of what a pixel sees."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = move_direction(
        model.plate, inverse_depth_at(model, xy[0], xy[1]), ray[0], ray[1], ray[2], w[0], w[1]
    )
    return ray_to_pixel(camera, wp.vec3(x, y, z))


@wp.func
def displace(
    model: PlateMapParams, camera: PinholeParams, x: float, y: float, w0: float, w1: float
):
    """Return the compensated position of an event, for a camera without distortion."""
    a, b, c = move_direction(
        model.plate,
        model.table[int(y), int(x)],
        (x - camera.cx) * camera.inverse_fx,
        (y - camera.cy) * camera.inverse_fy,
        1.0,
        w0,
        w1,
    )
    return camera.fx * (a / c) + camera.cx, camera.fy * (b / c) + camera.cy


@wp.func
def deflect(model: PlateMapParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel of a scene point. NaN where the map does not say which of two depths the pixel sees."""
    return inverted(model, camera, xy, w)


@wp.kernel
def compensate_at_depths(
    model: PlateParams,
    camera: CameraParams,
    xy: wp.array(dtype=wp.vec2),
    theta: wp.array(dtype=float),
    inverse_depth: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=wp.vec2),
):
    """Compensate one pixel per thread at its own inverse depth [1/m]."""
    i = start + wp.tid()
    phi = theta[i] + model.phase
    ray = pixel_to_ray(camera, xy[i])
    x, y, z = move_direction(
        model, inverse_depth[i], ray[0], ray[1], ray[2], wp.cos(phi), wp.sin(phi)
    )
    out[i] = ray_to_pixel(camera, wp.vec3(x, y, z))
