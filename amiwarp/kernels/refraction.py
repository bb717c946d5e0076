"""Refraction models: observed pixel to the pixel without the prism (compensate), and back (deflect).

Every model struct has ``compensate(model, camera, xy, w)`` and ``deflect(model, camera, xy, w)``, where ``w`` is the
state of the optic: two floats, for one prism the (cos, sin) of its tilt azimuth, for a pair the azimuths of both.
``state_of`` computes it from what is stored for an event, and ``advanced`` turns it on. ``displace`` is ``compensate``
for an event's pixel, with plain floats. ``compensate_direction`` compensates a direction.
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
    rotate,
    rotate_by_deflection,
    sine_versine,
)

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

INVERSION_STEPS = wp.constant(8)


@wp.struct
class CircleParams:
    """Circle model: rotation of each bearing by a constant deflection."""

    sine: float  # sine of the deflection; positive if the flat face looks to the scene
    versine: float  # 1 - cosine of the deflection
    phase: float  # phase of the prism angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase


@wp.struct
class RadialCircleParams:
    """Radial circle model: the deflection grows with the angle from the axis."""

    deflection: float  # deflection on the optical axis [rad]; negative if the flat face looks to the camera
    phase: float  # phase of the prism angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    index: float  # refractive index


@wp.struct
class ExactParams:
    """Exact model: refraction at both faces of the prism."""

    sin_apex: float  # sine of the apex angle
    cos_apex: float  # cosine of the apex angle
    index2: float  # square of the refractive index
    phase: float  # phase of the prism angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    flat_to_scene: int  # 1 if the flat face looks to the scene, else 0
    tilted: int  # 1 if the rotation axis is not the optical axis, or the prism is uneven; else 0
    uneven: int  # 1 if the tilted face has cylinder power or the prism wobbles, else 0
    cylinder_x: float  # cylinder power of the tilted face along and across the wedge [1 per unit of tangent]
    cylinder_y: float  # the same at 45 degrees to the wedge
    wobble_cos: float  # cosine of the azimuth, from that of the wedge, to which the prism's axis is tipped
    wobble_sin: float  # sine of this azimuth
    wobble_sine: float  # sine of the angle between the prism's axis and the rotation axis
    wobble_versine: float  # 1 - cosine of this angle
    axis: wp.mat33  # columns: axes of the rotation axis' frame in the camera's frame


@wp.struct
class EllipseParams:
    """Ellipse model: table of the displacement's offset and first harmonic for each pixel."""

    phase: float  # phase of the prism angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    table: wp.array3d(dtype=float)  # per pixel [px]: offset (x, y), factor of cos (x, y), factor of sin (x, y)


@wp.struct
class PairParams:
    """Two prisms behind each other, with refraction at all four faces."""

    first: ExactParams  # prism next to the camera
    second: ExactParams  # prism behind it
    phase: float  # phase of the first prism's angle [rad]
    second_phase: float  # phase of the second prism's angle [rad]
    ratio: float  # mean speed of the second prism relative to the first


# -- state of an optic at an event


@wp.func
def state_of(model: Any, c: float, s: float):
    """Return the state from what is stored for an event: cosine and sine of the prism angle."""
    return c * model.phase_cos - s * model.phase_sin, s * model.phase_cos + c * model.phase_sin


@wp.func
def state_of(model: PairParams, first: float, second: float):
    """Return the state from what is stored for an event: the angles of both prisms [rad]."""
    return first + model.phase, second + model.second_phase


@wp.func
def advanced(model: Any, w0: float, w1: float, angle: float) -> wp.vec2:
    """Return the state after the prism has turned by ``angle`` [rad]."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec2(w0 * c - w1 * s, w1 * c + w0 * s)


@wp.func
def advanced(model: PairParams, w0: float, w1: float, angle: float) -> wp.vec2:
    """Return the state after the first prism has turned by ``angle`` [rad], and the second one by its share."""
    return wp.vec2(w0 + angle, w1 + model.ratio * angle)


@wp.func
def state_at(model: Any, theta: wp.array(dtype=float), i: int) -> wp.vec2:
    """Return the state at the prism angle ``theta[i]`` [rad]."""
    phi = theta[i] + model.phase
    return wp.vec2(wp.cos(phi), wp.sin(phi))


@wp.func
def state_at(model: PairParams, theta: wp.array(dtype=float), i: int) -> wp.vec2:
    """Return the state at the angles of both prisms, ``theta[2 i]`` and ``theta[2 i + 1]`` [rad]."""
    w0, w1 = state_of(model, theta[2 * i], theta[2 * i + 1])
    return wp.vec2(w0, w1)


# Directions are three floats, not a vec3, in code that CPUs vectorise over eight events: LLVM does not vectorise calls
# that return small structs. A direction may have any length except zero.

# -- circle: rotation of the bearing by a constant angle about z x w


@wp.func
def compensate_direction(model: CircleParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the direction without the prism, by the circle model."""
    return rotate_by_deflection(x, y, z, w0, w1, model.sine, model.versine)


@wp.func
def deflect(model: CircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel by the circle model."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = rotate_by_deflection(ray[0], ray[1], ray[2], w[0], w[1], -model.sine, model.versine)
    return ray_to_pixel(camera, wp.vec3(x, y, z))


# -- radial circle: rotation by an angle that grows with the distance from the axis


@wp.func
def radial_deflection(model: RadialCircleParams, z: float) -> float:
    """Return the deflection [rad] of a thin prism for a bearing with cosine ``z``.

    delta(phi) = delta_0 (sqrt(n^2 - sin^2 phi) / cos phi - 1) / (n - 1), where z = cos phi.
    """
    cos2 = z * z
    growth = wp.sqrt((model.index * model.index - 1.0 + cos2) / wp.max(cos2, 1.0e-4)) - 1.0
    return wp.abs(model.deflection * growth / (model.index - 1.0))


@wp.func
def rotate_from_tilted_side(model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float):
    """Rotate a bearing on the side of the tilted face to the bearing on the side of the flat face.

    The deflection is a function of the given bearing.
    """
    sine, versine = sine_versine(radial_deflection(model, z))
    return rotate_by_deflection(x, y, z, w0, w1, sine, versine)


@wp.func
def rotate_from_flat_side(model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float):
    """Rotate a bearing on the side of the flat face to the bearing on the side of the tilted face.

    The deflection is a function of the result, so that a fixed-point iteration solves for it.
    """
    a, b, c = x, y, z
    step = float(1.0)
    for _ in range(INVERSION_STEPS):
        sine, versine = sine_versine(-radial_deflection(model, c))
        before = c
        a, b, c = rotate_by_deflection(x, y, z, w0, w1, sine, versine)
        step = wp.abs(c - before)
    scale = wp.where(step < 1.0e-4, 1.0, NAN)
    return a * scale, b * scale, c * scale


@wp.func
def compensate_direction(model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the direction without the prism, by the radial circle model."""
    length = wp.sqrt(x * x + y * y + z * z)
    a, b, c = x / length, y / length, z / length
    if model.deflection < 0.0:
        a, b, c = rotate_from_flat_side(model, a, b, c, w0, w1)
    else:
        a, b, c = rotate_from_tilted_side(model, a, b, c, w0, w1)
    return a, b, c


@wp.func
def deflect(model: RadialCircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel by the radial circle model."""
    ray = pixel_to_ray(camera, xy)
    a, b, c = ray[0], ray[1], ray[2]
    if model.deflection < 0.0:
        a, b, c = rotate_from_tilted_side(model, a, b, c, w[0], w[1])
    else:
        a, b, c = rotate_from_flat_side(model, a, b, c, w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(a, b, c))


# -- exact: refraction at both faces in closed form


@wp.func
def refract_in_prism_frame(
    sine: float, cosine: float, index2: float, x: float, y: float, z: float, w0: float, w1: float, entering: int
):
    """Refract a direction at both faces, in the prism's frame; NaN if no light passes.

    The faces shift it by Gamma sin(alpha) along w. ``entering`` is 1 if the light enters at the tilted face, where q is
    its cosine. It is 0 if the light leaves there: q is then the cosine behind the flat face, and n^2 - 1 changes its
    sign. z^2 is computed from its change, because computing it from x^2 + y^2 would cancel in float32 far from the
    axis. ``sine`` and ``cosine`` are those of alpha.
    """
    length2 = x * x + y * y + z * z
    bent = (index2 - 1.0) * length2
    d = w0 * x + w1 * y
    q = sine * d + cosine * wp.where(entering == 1, z, wp.sqrt(z * z + bent))
    shift = (wp.sqrt(q * q + wp.where(entering == 1, bent, -bent)) - q) * sine
    z2 = z * z - shift * (2.0 * d + shift)
    passes = wp.min(wp.min(z, q), z2) > 0.0  # z2 may be NaN and comes last: min(a, NaN) is NaN here
    return x + shift * w0, y + shift * w1, wp.where(passes, wp.sqrt(z2), NAN)


@wp.func
def prism_shift(m: ExactParams, along: float, z: float) -> float:
    """Return the shift of :func:`refract_in_prism_frame` for a unit direction, as the simulator computes it.

    ``along`` and ``z`` are the components of the direction along w and the axis. There are no branches, so that LLVM
    computes several shifts at once: if no light passes, the square root of a negative number gives NaN.
    """
    inside = m.index2 - 1.0
    if m.flat_to_scene == 1:
        q = m.sin_apex * along + m.cos_apex * z
        return m.sin_apex * (wp.sqrt(inside + q * q) - wp.where(q > 0.0, q, NAN))
    q = m.sin_apex * along + m.cos_apex * wp.sqrt(inside + z * z)
    return m.sin_apex * (wp.sqrt(q * q - inside) - q)


@wp.func
def tip(m: ExactParams, x: float, y: float, z: float, w0: float, w1: float, sine: float):
    """Rotate a direction as the wobble tips the prism: out of the prism's frame, or into it by the negative sine."""
    u0 = w0 * m.wobble_cos - w1 * m.wobble_sin
    u1 = w1 * m.wobble_cos + w0 * m.wobble_sin
    return rotate_by_deflection(x, y, z, u0, u1, sine, m.wobble_versine)


@wp.func
def refract_at_slope(
    m: ExactParams,
    x: float, y: float, z: float, w0: float, w1: float, along: float, across: float, entering: int,
):  # fmt: skip
    """Refract a direction, in the prism's frame, where a camera's ray of the given tangents meets the tilted face.

    ``along`` and ``across``: tangents along w and along w turned by a quarter. The slope of the face there has its own
    size and direction.
    """
    slope0 = m.sin_apex / m.cos_apex + m.cylinder_x * along + m.cylinder_y * across
    slope1 = m.cylinder_y * along - m.cylinder_x * across
    slope = wp.sqrt(slope0 * slope0 + slope1 * slope1)
    cosine = 1.0 / wp.sqrt(1.0 + slope * slope)
    scale = 1.0 / wp.max(slope, 1.0e-20)  # without a slope, nothing is shifted
    v0 = (slope0 * w0 - slope1 * w1) * scale
    v1 = (slope0 * w1 + slope1 * w0) * scale
    a, b, c = refract_in_prism_frame(slope * cosine, cosine, m.index2, x, y, z, v0, v1, entering)
    return a, b, c


@wp.func
def compensate_uneven(m: ExactParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return a camera's direction without an uneven prism, both in the frame of the rotation axis."""
    a, b, c = tip(m, x, y, z, w0, w1, -m.wobble_sine)
    along, across = (w0 * a + w1 * b) / c, (w0 * b - w1 * a) / c
    a, b, c = refract_at_slope(m, a, b, c, w0, w1, along, across, m.flat_to_scene)
    return tip(m, a, b, c, w0, w1, m.wobble_sine)


@wp.func
def deflect_uneven(m: ExactParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the camera's direction of a scene's ray through an uneven prism. Inverse of :func:`compensate_uneven`.

    The slope depends on the result, so that a fixed-point iteration solves for it. A step shortens the error by a
    factor of about (n - 1) times the cylinder power.
    """
    a, b, c = tip(m, x, y, z, w0, w1, -m.wobble_sine)
    p, q, r = float(a), float(b), float(c)
    change = float(0.0)
    steps = int(INVERSION_STEPS)  # a variable, so that Warp does not unroll the loop, which is slow to compile
    for _ in range(steps):
        along, across = (w0 * p + w1 * q) / r, (w0 * q - w1 * p) / r
        p, q, r = refract_at_slope(m, a, b, c, w0, w1, along, across, 1 - m.flat_to_scene)
        change = wp.abs((w0 * p + w1 * q) / r - along) + wp.abs((w0 * q - w1 * p) / r - across)
    scale = wp.where(change * r * r < 1.0e-5 * (p * p + q * q + r * r), 1.0, NAN)
    return tip(m, p * scale, q * scale, r * scale, w0, w1, m.wobble_sine)


@wp.func
def compensate_about_axis(m: ExactParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the direction without the prism, both in the frame of the rotation axis."""
    if m.uneven == 1:
        a, b, c = compensate_uneven(m, x, y, z, w0, w1)
        return a, b, c
    a, b, c = refract_in_prism_frame(m.sin_apex, m.cos_apex, m.index2, x, y, z, w0, w1, m.flat_to_scene)
    return a, b, c


@wp.func
def compensate_direction(model: ExactParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the direction without the prism, by the exact model."""
    if model.tilted == 0:
        a, b, c = refract_in_prism_frame(
            model.sin_apex, model.cos_apex, model.index2, x, y, z, w0, w1, model.flat_to_scene
        )
        return a, b, c
    a, b, c = rotate(wp.transpose(model.axis), x, y, z)
    a, b, c = compensate_about_axis(model, a, b, c, w0, w1)
    return rotate(model.axis, a, b, c)


@wp.func
def deflect_direction(model: ExactParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the observed direction by the exact model. Inverse of :func:`compensate_direction`."""
    entering = 1 - model.flat_to_scene
    if model.tilted == 0:
        a, b, c = refract_in_prism_frame(model.sin_apex, model.cos_apex, model.index2, x, y, z, w0, w1, entering)
        return a, b, c
    a, b, c = rotate(wp.transpose(model.axis), x, y, z)
    if model.uneven == 1:
        a, b, c = deflect_uneven(model, a, b, c, w0, w1)
    else:
        a, b, c = refract_in_prism_frame(model.sin_apex, model.cos_apex, model.index2, a, b, c, w0, w1, entering)
    return rotate(model.axis, a, b, c)


@wp.func
def ray_without_prism(m: ExactParams, ray: wp.vec3, w: wp.vec2) -> wp.vec3:
    """Return the direction of the scene point that a camera's ray sees through the prism."""
    x, y, z = compensate_direction(m, ray[0], ray[1], ray[2], w[0], w[1])
    return wp.vec3(x, y, z)


@wp.func
def deflect(model: ExactParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel by the exact model."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = deflect_direction(model, ray[0], ray[1], ray[2], w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(x, y, z))


# -- pair: refraction at both faces of both prisms


@wp.func
def compensate_direction(model: PairParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the direction without the prisms: behind the first prism, then behind the second."""
    a, b, c = compensate_direction(model.first, x, y, z, wp.cos(w0), wp.sin(w0))
    return compensate_direction(model.second, a, b, c, wp.cos(w1), wp.sin(w1))


@wp.func
def deflect(model: PairParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel: the ray meets the second prism first."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = deflect_direction(model.second, ray[0], ray[1], ray[2], wp.cos(w[1]), wp.sin(w[1]))
    x, y, z = deflect_direction(model.first, x, y, z, wp.cos(w[0]), wp.sin(w[0]))
    return ray_to_pixel(camera, wp.vec3(x, y, z))


# -- models whose displacement belongs to the observed pixel


@wp.func
def inverted(model: Any, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel that compensation moves to ``xy``, by a fixed-point iteration; NaN if it diverges."""
    observed = xy
    error = wp.vec2(0.0, 0.0)
    for _ in range(INVERSION_STEPS):
        error = compensate(model, camera, observed, w) - xy
        observed = observed - error
    if not (wp.length(error) < 0.01):
        return invalid_pixel()
    return observed


# -- ellipse: offset and first harmonic of the displacement of each observed pixel


@wp.func
def ellipse_displacement(m: EllipseParams, row: int, col: int, w0: float, w1: float):
    """Return the displacement of a whole pixel by the ellipse model [px]."""
    x = m.table[row, col, 0] + m.table[row, col, 2] * w0 + m.table[row, col, 4] * w1
    return x, m.table[row, col, 1] + m.table[row, col, 3] * w0 + m.table[row, col, 5] * w1


@wp.func
def interpolate_ellipses(m: EllipseParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the displacement [px] between whole pixels: bilinear, constant beyond the border."""
    x = wp.clamp(xy[0], 0.0, float(m.table.shape[1] - 1))
    y = wp.clamp(xy[1], 0.0, float(m.table.shape[0] - 1))
    col = wp.min(int(x), wp.max(m.table.shape[1] - 2, 0))
    row = wp.min(int(y), wp.max(m.table.shape[0] - 2, 0))
    total = wp.vec2(0.0, 0.0)
    for k in range(4):
        across = wp.min(col + k % 2, m.table.shape[1] - 1)
        down = wp.min(row + k / 2, m.table.shape[0] - 1)
        dx, dy = ellipse_displacement(m, down, across, w[0], w[1])
        weight = (1.0 - wp.abs(x - float(col + k % 2))) * (1.0 - wp.abs(y - float(row + k / 2)))
        total += wp.vec2(dx, dy) * weight
    return total


@wp.func
def compensate(model: EllipseParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the compensated pixel by the ellipse model."""
    if not (wp.length(xy) < 1.0e9):  # a NaN pixel must not become an index
        return invalid_pixel()
    col = int(xy[0])
    row = int(xy[1])
    inside = col >= 0 and row >= 0 and col < model.table.shape[1] and row < model.table.shape[0]
    if inside and float(col) == xy[0] and float(row) == xy[1]:
        dx, dy = ellipse_displacement(model, row, col, w[0], w[1])
        return xy + wp.vec2(dx, dy)
    return xy + interpolate_ellipses(model, xy, w)


@wp.func
def deflect(model: EllipseParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel by the ellipse model.

    The table belongs to the observed pixel, so that a fixed-point iteration solves for it.
    """
    return inverted(model, camera, xy, w)


# -- all models: pixels to pixels


@wp.func
def compensate(model: Any, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the compensated pixel, for any model that compensates directions."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = compensate_direction(model, ray[0], ray[1], ray[2], w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(x, y, z))


@wp.func
def displace(model: Any, camera: CameraParams, x: float, y: float, w0: float, w1: float):
    """Return the compensated position of an event at pixel (x, y); NaN if it has none."""
    xy = compensate(model, camera, wp.vec2(x, y), wp.vec2(w0, w1))
    return xy[0], xy[1]


@wp.func
def displace(model: EllipseParams, camera: PinholeParams, x: float, y: float, w0: float, w1: float):
    """Return the compensated position by the ellipse model, for a camera without distortion."""
    dx, dy = ellipse_displacement(model, int(y), int(x), w0, w1)
    return x + dx, y + dy


@wp.func
def displace(model: Any, camera: PinholeParams, x: float, y: float, w0: float, w1: float):
    """Return the compensated position without branches, for a camera without distortion."""
    a, b, c = compensate_direction(
        model, (x - camera.cx) * camera.inverse_fx, (y - camera.cy) * camera.inverse_fy, 1.0, w0, w1
    )
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
    """Compensate one pixel per thread at its prism angle [rad]."""
    i = start + wp.tid()
    out[i] = compensate(model, camera, xy[i], state_at(model, theta, i))


@wp.kernel
def deflect_points(
    model: Any,
    camera: CameraParams,
    xy: wp.array(dtype=wp.vec2),
    theta: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=wp.vec2),
):
    """Deflect one pixel per thread at its prism angle [rad]."""
    i = start + wp.tid()
    out[i] = deflect(model, camera, xy[i], state_at(model, theta, i))


@wp.kernel
def fit_harmonics(
    model: Any,
    camera: CameraParams,
    angles: wp.array(dtype=wp.vec2),
    start: int,
    table: wp.array3d(dtype=float),
):
    """Fit offset and first harmonic of the displacement of one pixel per thread, by Fourier sums.

    ``angles`` holds the (cos, sin) of evenly spaced tilt azimuths.
    """
    pixel = start + wp.tid()
    row, col = pixel // table.shape[1], pixel % table.shape[1]
    xy = wp.vec2(float(col), float(row))
    mean = wp.vec2(0.0, 0.0)
    c = wp.vec2(0.0, 0.0)
    s = wp.vec2(0.0, 0.0)
    for k in range(angles.shape[0]):
        w = angles[k]
        d = compensate(model, camera, xy, w) - xy
        mean += d
        c += d * w[0]
        s += d * w[1]
    n = float(angles.shape[0])
    for k in range(2):
        table[row, col, k] = mean[k] / n
        table[row, col, 2 + k] = c[k] * (2.0 / n)
        table[row, col, 4 + k] = s[k] * (2.0 / n)


# Optical models without their rare cases, for loops that CPUs vectorise.
#
# LLVM vectorises a loop with a branch by computing both of its sides. So a loop over a plain model costs less: half,
# for the exact model. A loop over an even model leaves out the rarest case.


@wp.func
def is_plain(model: Any) -> int:
    """Return 1 if :func:`plain` of the model is the same model."""
    return 1


@wp.func
def is_plain(model: ExactParams) -> int:
    """Return 1 if :func:`plain` of the model is the same model."""
    return (1 - model.tilted) * model.flat_to_scene


@wp.func
def is_even(model: Any) -> int:
    """Return 1 if :func:`even` of the model is the same model."""
    return 1


@wp.func
def is_even(model: ExactParams) -> int:
    """Return 1 if :func:`even` of the model is the same model."""
    return 1 - model.uneven


@wp.func
def even(model: Any):
    """Return the model itself, which has no rarest case."""
    return model


@wp.func
def even(model: ExactParams) -> ExactParams:
    """Return the exact model of a prism without cylinder power and wobble."""
    m = ExactParams()
    m.sin_apex = model.sin_apex
    m.cos_apex = model.cos_apex
    m.index2 = model.index2
    m.phase = model.phase
    m.phase_cos = model.phase_cos
    m.phase_sin = model.phase_sin
    m.axis = model.axis
    m.flat_to_scene = model.flat_to_scene
    m.tilted = model.tilted
    m.uneven = 0
    return m


@wp.func
def plain(model: Any):
    """Return the model itself, which has no rare case."""
    return model


@wp.func
def plain(model: ExactParams) -> ExactParams:
    """Return the exact model of an even prism that is not tilted and has its flat face to the scene."""
    m = even(model)
    m.flat_to_scene = 1
    m.tilted = 0
    return m
