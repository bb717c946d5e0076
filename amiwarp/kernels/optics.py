"""Device side of the models: observed pixel to the pixel without the prism (compensate), and back (deflect).

Every model struct has the two functions ``compensate(model, camera, xy, w)`` and ``deflect(model, camera, xy, w)``,
``w`` being the azimuth (cos, sin) of the prism's tilt, and ``azimuth(model, theta)`` that gives it; ``place`` is
``compensate`` for an event's pixel, in plain floats. ``moved`` compensates a direction.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import (
    NAN,
    CameraParams,
    PinholeParams,
    invalid_pixel,
    pixel_to_ray,
    ray_to_pixel,
)

# without fused multiply-add, which CPUs and GPUs place differently: both give the same bits
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

HARMONIC_ANGLES = wp.constant(16)
INVERSION_STEPS = wp.constant(8)


@wp.struct
class CircleParams:
    sine: float  # of the deflection, signed: positive with the flat face to the scene
    versine: float  # 1 - cosine
    phase: float
    phase_cos: float
    phase_sin: float


@wp.struct
class RadialCircleParams:
    deflection: float  # on the axis; negative with the flat face to the camera: the sign also says which side
    phase: float
    phase_cos: float
    phase_sin: float
    index: float


@wp.struct
class ExactParams:
    sin_apex: float
    cos_apex: float
    index2: float  # n squared
    phase: float
    phase_cos: float
    phase_sin: float
    flat_to_scene: int
    tilted: int
    axis: wp.mat33  # columns: the prism's frame in the camera's


@wp.struct
class EllipseParams:
    phase: float
    phase_cos: float
    phase_sin: float
    table: wp.array3d(dtype=float)  # per pixel: offset x, y, then the factors of cos, x, y, then of sin, x, y


@wp.func
def azimuth(model: Any, theta: float) -> wp.vec2:
    phi = theta + model.phase
    return wp.vec2(wp.cos(phi), wp.sin(phi))


# Directions are three floats, not a vec3, wherever CPUs shall run eight events at a time: LLVM does not vectorise calls
# that return small structs. They may have any length but zero.

# -- circle: a rotation of the bearing by a constant angle about z x w


@wp.func
def turned(x: float, y: float, z: float, w0: float, w1: float, sine: float, versine: float):
    """Rodrigues' rotation of a direction about z x w = (-w1, w0, 0): turns the optical axis towards w."""
    d = w0 * x + w1 * y
    g = z * sine - d * versine
    return x + g * w0, y + g * w1, z - z * versine - d * sine


@wp.func
def moved(model: CircleParams, x: float, y: float, z: float, w0: float, w1: float):
    return turned(x, y, z, w0, w1, model.sine, model.versine)


@wp.func
def deflect(model: CircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    ray = pixel_to_ray(camera, xy)
    x, y, z = turned(ray[0], ray[1], ray[2], w[0], w[1], -model.sine, model.versine)
    return ray_to_pixel(camera, wp.vec3(x, y, z))


# -- radial circle: the same, the angle growing off the axis


@wp.func
def sine_versine(a: float):
    """Sine and 1 - cosine of an angle up to pi/2, by their series: the same bits on every device."""
    b = a * a
    s = 1.0 / 120.0 + b * (-1.0 / 5040.0 + b * (1.0 / 362880.0 - b / 39916800.0))
    v = 1.0 / 720.0 + b * (-1.0 / 40320.0 + b * (1.0 / 3628800.0 - b / 479001600.0))
    return a * (1.0 + b * (-1.0 / 6.0 + b * s)), b * (0.5 + b * (-1.0 / 24.0 + b * v))


@wp.func
def radial_deflection(model: RadialCircleParams, z: float) -> float:
    """delta(phi) = delta_0 (sqrt(n^2 - sin^2 phi) / cos phi - 1) / (n - 1), for a thin prism; z is cos phi."""
    cos2 = z * z
    growth = wp.sqrt((model.index * model.index - 1.0 + cos2) / wp.max(cos2, 1.0e-4)) - 1.0
    return wp.abs(model.deflection * growth / (model.index - 1.0))


@wp.func
def turn_from_tilted_side(model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float):
    """From the bearing on the tilted face's side, to which the angle belongs, to the one on the flat face's side."""
    sine, versine = sine_versine(radial_deflection(model, z))
    return turned(x, y, z, w0, w1, sine, versine)


@wp.func
def turn_from_flat_side(model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float):
    """The reverse: the angle belongs to the bearing that is sought; a contraction, solved by iteration."""
    a, b, c = x, y, z
    step = float(1.0)
    for _ in range(INVERSION_STEPS):
        sine, versine = sine_versine(-radial_deflection(model, c))
        before = c
        a, b, c = turned(x, y, z, w0, w1, sine, versine)
        step = wp.abs(c - before)
    scale = wp.where(step < 1.0e-4, 1.0, NAN)
    return a * scale, b * scale, c * scale


@wp.func
def moved(model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float):
    length = wp.sqrt(x * x + y * y + z * z)
    a, b, c = x / length, y / length, z / length
    if model.deflection < 0.0:
        a, b, c = turn_from_flat_side(model, a, b, c, w0, w1)
    else:
        a, b, c = turn_from_tilted_side(model, a, b, c, w0, w1)
    return a, b, c


@wp.func
def deflect(model: RadialCircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    ray = pixel_to_ray(camera, xy)
    a, b, c = ray[0], ray[1], ray[2]
    if model.deflection < 0.0:
        a, b, c = turn_from_tilted_side(model, a, b, c, w[0], w[1])
    else:
        a, b, c = turn_from_flat_side(model, a, b, c, w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(a, b, c))


# -- exact: both faces in closed form


@wp.func
def rotated(r: wp.mat33, x: float, y: float, z: float):
    a = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
    b = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
    return a, b, r[2, 0] * x + r[2, 1] * y + r[2, 2] * z


@wp.func
def refracted(m: ExactParams, x: float, y: float, z: float, w0: float, w1: float, entering: int):
    """A direction through both faces in the prism's frame: Gamma sin(alpha) along w; NaN where no light passes.

    In at the tilted face (``entering`` 1): q is its cosine there. Out at it (0): the same behind the flat face, and the
    other sign of n^2 - 1. z^2 by its change, not from x^2 + y^2: far off the axis that would cancel in float32.
    """
    inside = float(entering)
    length2 = x * x + y * y + z * z
    bent = (m.index2 - 1.0) * length2
    d = w0 * x + w1 * y
    q = m.sin_apex * d + m.cos_apex * wp.sqrt(z * z + (1.0 - inside) * bent)
    shift = (wp.sqrt(q * q + (2.0 * inside - 1.0) * bent) - q) * m.sin_apex
    z2 = z * z - shift * (2.0 * d + shift)
    passes = wp.min(wp.min(z, q), z2) > 0.0  # z2, which may be NaN, last: min(a, NaN) is NaN here
    return x + shift * w0, y + shift * w1, wp.where(passes, wp.sqrt(z2), NAN)


@wp.func
def through(m: ExactParams, x: float, y: float, z: float, w0: float, w1: float, entering: int):
    """Through the prism, entering at the tilted (1) or the flat (0) face; directions in the camera's frame."""
    if m.tilted == 0:
        d, e, f = refracted(m, x, y, z, w0, w1, entering)
        return d, e, f
    d, e, f = rotated(wp.transpose(m.axis), x, y, z)
    d, e, f = refracted(m, d, e, f, w0, w1, entering)
    return rotated(m.axis, d, e, f)


@wp.func
def trace(m: ExactParams, ray: wp.vec3, w: wp.vec2, entering: int) -> wp.vec3:
    x, y, z = through(m, ray[0], ray[1], ray[2], w[0], w[1], entering)
    return wp.vec3(x, y, z)


@wp.func
def moved(model: ExactParams, x: float, y: float, z: float, w0: float, w1: float):
    return through(model, x, y, z, w0, w1, model.flat_to_scene)


@wp.func
def deflect(model: ExactParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    return ray_to_pixel(camera, trace(model, pixel_to_ray(camera, xy), w, 1 - model.flat_to_scene))


# -- ellipse: offset and first harmonic of the displacement, per observed pixel


@wp.func
def on_ellipse(m: EllipseParams, row: int, col: int, w0: float, w1: float):
    """Displacement of one pixel."""
    x = m.table[row, col, 0] + m.table[row, col, 2] * w0 + m.table[row, col, 4] * w1
    return x, m.table[row, col, 1] + m.table[row, col, 3] * w0 + m.table[row, col, 5] * w1


@wp.func
def between_ellipses(m: EllipseParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Displacement bilinear between pixels, held constant past the border."""
    x = wp.clamp(xy[0], 0.0, float(m.table.shape[1] - 1))
    y = wp.clamp(xy[1], 0.0, float(m.table.shape[0] - 1))
    col = wp.min(int(x), wp.max(m.table.shape[1] - 2, 0))
    row = wp.min(int(y), wp.max(m.table.shape[0] - 2, 0))
    total = wp.vec2(0.0, 0.0)
    for k in range(4):
        across = wp.min(col + k % 2, m.table.shape[1] - 1)
        down = wp.min(row + k / 2, m.table.shape[0] - 1)
        dx, dy = on_ellipse(m, down, across, w[0], w[1])
        weight = (1.0 - wp.abs(x - float(col + k % 2))) * (1.0 - wp.abs(y - float(row + k / 2)))
        total += wp.vec2(dx, dy) * weight
    return total


@wp.func
def compensate(model: EllipseParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    if not (wp.length(xy) < 1.0e9):  # an invalid pixel must not become an index
        return invalid_pixel()
    col = int(xy[0])
    row = int(xy[1])
    inside = col >= 0 and row >= 0 and col < model.table.shape[1] and row < model.table.shape[0]
    if inside and float(col) == xy[0] and float(row) == xy[1]:
        dx, dy = on_ellipse(model, row, col, w[0], w[1])
        return xy + wp.vec2(dx, dy)
    return xy + between_ellipses(model, xy, w)


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


# -- every model: pixels to pixels


@wp.func
def compensate(model: Any, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    ray = pixel_to_ray(camera, xy)
    x, y, z = moved(model, ray[0], ray[1], ray[2], w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(x, y, z))


@wp.func
def place(model: Any, camera: CameraParams, x: float, y: float, w0: float, w1: float):
    """Where an event of a pixel belongs; NaN: nowhere."""
    xy = compensate(model, camera, wp.vec2(x, y), wp.vec2(w0, w1))
    return xy[0], xy[1]


@wp.func
def place(model: EllipseParams, camera: PinholeParams, x: float, y: float, w0: float, w1: float):
    dx, dy = on_ellipse(model, int(y), int(x), w0, w1)
    return x + dx, y + dy


@wp.func
def place(model: Any, camera: PinholeParams, x: float, y: float, w0: float, w1: float):
    """The same without a branch, for cameras without distortion."""
    a, b, c = moved(model, (x - camera.cx) * camera.inverse_fx, (y - camera.cy) * camera.inverse_fy, 1.0, w0, w1)
    scale = wp.where(c > 1.0e-6, 1.0 / c, NAN)
    return camera.fx * (a * scale) + camera.cx, camera.fy * (b * scale) + camera.cy


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
    start: int,
    table: wp.array3d(dtype=float),
):
    """Least squares of offset and first harmonic over evenly spaced angles (their Fourier sums)."""
    pixel = start + wp.tid()
    row, col = pixel // table.shape[1], pixel % table.shape[1]
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
    for k in range(2):
        table[row, col, k] = mean[k] / n
        table[row, col, 2 + k] = c[k] * (2.0 / n)
        table[row, col, 4 + k] = s[k] * (2.0 / n)


MODEL_STRUCTS = (CircleParams, RadialCircleParams, EllipseParams, ExactParams)
for _struct in MODEL_STRUCTS:
    wp.overload(compensate_points, {"model": _struct})
    wp.overload(deflect_points, {"model": _struct})
    if _struct is not EllipseParams:
        wp.overload(fit_harmonics, {"model": _struct})
