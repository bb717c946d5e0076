"""Device side of the models: observed pixel to the pixel without the prism (compensate), and back (deflect).

Every model struct has the two functions ``compensate(model, camera, xy, w)`` and ``deflect(model, camera, xy, w)``,
``w`` being the azimuth (cos, sin) of the prism's tilt, and ``azimuth(model, theta)`` that gives it.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, invalid_pixel, invalid_ray, pixel_to_ray, ray_to_pixel

wp.set_module_options({"enable_backward": False})

HARMONIC_ANGLES = wp.constant(16)
INVERSION_STEPS = wp.constant(8)


@wp.struct
class CircleParams:
    deflection: float  # signed: positive with the flat face to the scene
    phase: float


@wp.struct
class RadialCircleParams:
    deflection: float  # on the axis; negative with the flat face to the camera: the sign also says which side
    phase: float
    index: float


@wp.struct
class ExactParams:
    sin_apex: float
    cos_apex: float
    index2: float  # n squared
    phase: float
    flat_to_scene: int
    axis: wp.mat33  # columns: the prism's frame in the camera's


@wp.struct
class EllipseParams:
    phase: float
    offset: wp.array2d(dtype=wp.vec2)
    cosine: wp.array2d(dtype=wp.vec2)
    sine: wp.array2d(dtype=wp.vec2)


@wp.func
def azimuth(model: Any, theta: float) -> wp.vec2:
    phi = theta + model.phase
    return wp.vec2(wp.cos(phi), wp.sin(phi))


# -- circle: a rotation of the bearing by a constant angle about z x w


@wp.func
def rotate_towards(ray: wp.vec3, w: wp.vec2, angle: float) -> wp.vec3:
    """Rodrigues' rotation about z x w = (-w_y, w_x, 0): turns the optical axis towards w."""
    axis = wp.vec3(-w[1], w[0], 0.0)
    s = wp.sin(angle)
    c = wp.cos(angle)
    return ray * c + wp.cross(axis, ray) * s + axis * (wp.dot(axis, ray) * (1.0 - c))


@wp.func
def compensate(model: CircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    return ray_to_pixel(camera, rotate_towards(pixel_to_ray(camera, xy), w, model.deflection))


@wp.func
def deflect(model: CircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    return ray_to_pixel(camera, rotate_towards(pixel_to_ray(camera, xy), w, -model.deflection))


# -- radial circle: the same, the angle growing off the axis


@wp.func
def radial_deflection(model: RadialCircleParams, ray: wp.vec3) -> float:
    """delta(phi) = delta_0 (sqrt(n^2 - sin^2 phi) / cos phi - 1) / (n - 1), for a thin prism."""
    cos2 = ray[2] * ray[2]
    growth = wp.sqrt((model.index * model.index - 1.0 + cos2) / wp.max(cos2, 1.0e-4)) - 1.0
    return model.deflection * growth / (model.index - 1.0)


@wp.func
def turn_from_tilted_side(model: RadialCircleParams, ray: wp.vec3, w: wp.vec2) -> wp.vec3:
    """From the bearing on the tilted face's side, to which the angle belongs, to the one on the flat face's side."""
    return rotate_towards(ray, w, wp.abs(radial_deflection(model, ray)))


@wp.func
def turn_from_flat_side(model: RadialCircleParams, ray: wp.vec3, w: wp.vec2) -> wp.vec3:
    """The reverse: the angle belongs to the bearing that is sought; a contraction, solved by iteration."""
    found = ray
    step = wp.length(ray)
    for _ in range(INVERSION_STEPS):
        better = rotate_towards(ray, w, -wp.abs(radial_deflection(model, found)))
        step = wp.length(better - found)
        found = better
        if step < 2.0e-7:  # as near as float32 comes
            break
    if not (step < 1.0e-4):
        return invalid_ray()
    return found


@wp.func
def compensate(model: RadialCircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    ray = pixel_to_ray(camera, xy)
    if model.deflection < 0.0:
        return ray_to_pixel(camera, turn_from_flat_side(model, ray, w))
    return ray_to_pixel(camera, turn_from_tilted_side(model, ray, w))


@wp.func
def deflect(model: RadialCircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    ray = pixel_to_ray(camera, xy)
    if model.deflection < 0.0:
        return ray_to_pixel(camera, turn_from_tilted_side(model, ray, w))
    return ray_to_pixel(camera, turn_from_flat_side(model, ray, w))


# -- exact: both faces in closed form


@wp.func
def shift_bearing(ray: wp.vec3, w: wp.vec2, shift: float) -> wp.vec3:
    """Unit bearing moved by ``shift`` along w; invalid past total internal reflection.

    z² by its change, not as 1 - x² - y²: far off the axis that would cancel in float32.
    """
    z2 = ray[2] * ray[2] - shift * (2.0 * (w[0] * ray[0] + w[1] * ray[1]) + shift)
    if not (z2 > 0.0):
        return invalid_ray()
    return wp.vec3(ray[0] + shift * w[0], ray[1] + shift * w[1], wp.sqrt(z2))


@wp.func
def enter_tilted_face(m: ExactParams, ray: wp.vec3, w: wp.vec2) -> wp.vec3:
    """In through the tilted face, out through the flat one: shift Gamma sin(alpha) along w."""
    q = m.sin_apex * (w[0] * ray[0] + w[1] * ray[1]) + m.cos_apex * ray[2]
    if not (q > 0.0 and ray[2] > 0.0):
        return invalid_ray()
    shift = (wp.sqrt(m.index2 - 1.0 + q * q) - q) * m.sin_apex
    return shift_bearing(ray, w, shift)


@wp.func
def leave_tilted_face(m: ExactParams, ray: wp.vec3, w: wp.vec2) -> wp.vec3:
    """In through the flat face, out through the tilted one: the reverse of :func:`enter_tilted_face`."""
    p = wp.sqrt(m.index2 - 1.0 + ray[2] * ray[2])
    q = m.sin_apex * (w[0] * ray[0] + w[1] * ray[1]) + m.cos_apex * p
    radicand = 1.0 - m.index2 + q * q
    if not (radicand > 0.0 and ray[2] > 0.0):
        return invalid_ray()
    shift = (q - wp.sqrt(radicand)) * m.sin_apex
    return shift_bearing(ray, w, -shift)


@wp.func
def trace(m: ExactParams, ray: wp.vec3, w: wp.vec2, entering: int) -> wp.vec3:
    """Through the prism in its own frame, entering at the tilted (1) or the flat (0) face."""
    local = wp.transpose(m.axis) * ray
    if entering == 1:
        return m.axis * enter_tilted_face(m, local, w)
    return m.axis * leave_tilted_face(m, local, w)


@wp.func
def compensate(model: ExactParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    return ray_to_pixel(camera, trace(model, pixel_to_ray(camera, xy), w, model.flat_to_scene))


@wp.func
def deflect(model: ExactParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    return ray_to_pixel(camera, trace(model, pixel_to_ray(camera, xy), w, 1 - model.flat_to_scene))


# -- ellipse: offset and first harmonic of the displacement, per observed pixel


@wp.func
def lookup(table: wp.array2d(dtype=wp.vec2), xy: wp.vec2) -> wp.vec2:
    """Bilinear look-up, held constant past the border."""
    x = wp.clamp(xy[0], 0.0, float(table.shape[1] - 1))
    y = wp.clamp(xy[1], 0.0, float(table.shape[0] - 1))
    col = wp.min(int(x), wp.max(table.shape[1] - 2, 0))
    row = wp.min(int(y), wp.max(table.shape[0] - 2, 0))
    fx = x - float(col)
    fy = y - float(row)
    next_col = wp.min(col + 1, table.shape[1] - 1)
    next_row = wp.min(row + 1, table.shape[0] - 1)
    top = table[row, col] * (1.0 - fx) + table[row, next_col] * fx
    bottom = table[next_row, col] * (1.0 - fx) + table[next_row, next_col] * fx
    return top * (1.0 - fy) + bottom * fy


@wp.func
def compensate(model: EllipseParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    if not (wp.length(xy) < 1.0e9):  # an invalid pixel must not become an index
        return invalid_pixel()
    col = int(xy[0])
    row = int(xy[1])
    inside = col >= 0 and row >= 0 and col < model.offset.shape[1] and row < model.offset.shape[0]
    if inside and float(col) == xy[0] and float(row) == xy[1]:
        return xy + model.offset[row, col] + model.cosine[row, col] * w[0] + model.sine[row, col] * w[1]
    return xy + lookup(model.offset, xy) + lookup(model.cosine, xy) * w[0] + lookup(model.sine, xy) * w[1]


@wp.func
def deflect(model: EllipseParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """The tables belong to the observed pixel, which is sought: a contraction, solved by iteration."""
    observed = xy
    error = wp.vec2(0.0, 0.0)
    for _ in range(INVERSION_STEPS):
        error = compensate(model, camera, observed, w) - xy
        observed = observed - error
    if not (wp.length(error) < 0.01):
        return invalid_pixel()
    return observed


@wp.kernel
def compensate_points(
    model: Any,
    camera: CameraParams,
    xy: wp.array(dtype=wp.vec2),
    theta: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=wp.vec2),
):
    i = start + wp.tid()
    out[i] = compensate(model, camera, xy[i], azimuth(model, theta[i]))


@wp.kernel
def deflect_points(
    model: Any,
    camera: CameraParams,
    xy: wp.array(dtype=wp.vec2),
    theta: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=wp.vec2),
):
    i = start + wp.tid()
    out[i] = deflect(model, camera, xy[i], azimuth(model, theta[i]))


@wp.kernel
def fit_harmonics(
    model: Any,
    camera: CameraParams,
    offset: wp.array2d(dtype=wp.vec2),
    cosine: wp.array2d(dtype=wp.vec2),
    sine: wp.array2d(dtype=wp.vec2),
):
    """Least squares of offset and first harmonic over evenly spaced angles (their Fourier sums)."""
    row, col = wp.tid()
    xy = wp.vec2(float(col), float(row))
    mean = wp.vec2(0.0, 0.0)
    c = wp.vec2(0.0, 0.0)
    s = wp.vec2(0.0, 0.0)
    for k in range(HARMONIC_ANGLES):
        phi = 6.283185307179586 * float(k) / float(HARMONIC_ANGLES)
        w = wp.vec2(wp.cos(phi), wp.sin(phi))
        d = compensate(model, camera, xy, w) - xy
        mean += d
        c += d * w[0]
        s += d * w[1]
    n = float(HARMONIC_ANGLES)
    offset[row, col] = mean / n
    cosine[row, col] = c * (2.0 / n)
    sine[row, col] = s * (2.0 / n)


MODEL_STRUCTS = (CircleParams, RadialCircleParams, EllipseParams, ExactParams)
for _struct in MODEL_STRUCTS:
    wp.overload(compensate_points, {"model": _struct})
    wp.overload(deflect_points, {"model": _struct})
    if _struct is not EllipseParams:
        wp.overload(fit_harmonics, {"model": _struct})
