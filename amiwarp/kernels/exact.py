"""Exact model: refraction at both faces of a prism, in closed form."""

import warp as wp

from amiwarp.kernels.camera import NAN, CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.refraction import INVERSION_STEPS, compensate_direction, deflect
from amiwarp.kernels.rotations import rotate, rotate_by_deflection

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class ExactParams:
    """Exact model: refraction at both faces of the prism.

    A new field must be copied in :func:`amiwarp.kernels.plain_models.even`.
    """

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
    # Cosine and sine of the azimuth to which the prism's axis is tipped, from the wedge's azimuth on
    wobble_cos: float
    wobble_sin: float
    wobble_sine: float  # sine of the angle between the prism's axis and the rotation axis
    wobble_versine: float  # 1 - cosine of this angle
    axis: wp.mat33  # columns: axes of the rotation axis' frame in the camera's frame


@wp.func
def shift_at_faces(sine: float, cosine: float, bent: float, along: float, z: float, entering: int):
    """Return the shift Gamma sin(alpha) of a direction by both faces, and q, by Snell's law.

    ``along`` and ``z`` are the components of the direction along w and the axis, ``sine`` and ``cosine`` belong to
    alpha. ``bent`` is n^2 - 1, times the squared length of the direction. ``entering`` is 1 if the light enters at the
    tilted face, where q is its cosine. It is 0 if the light leaves there: q is then the cosine behind the flat face,
    and n^2 - 1 changes its sign. There are no branches, so that LLVM computes several shifts at once.
    """
    q = sine * along + cosine * wp.where(entering == 1, z, wp.sqrt(z * z + bent))
    return (wp.sqrt(q * q + wp.where(entering == 1, bent, -bent)) - q) * sine, q


@wp.func
def shifted(x: float, y: float, z: float, w0: float, w1: float, along: float, shift: float):
    """Return a direction shifted along w at equal length; NaN if no such direction exists.

    z^2 is computed from its change, because computing it from x^2 + y^2 would cancel in float32 far from the axis.
    ``along``: component of the direction along w.
    """
    return x + shift * w0, y + shift * w1, wp.sqrt(z * z - shift * (2.0 * along + shift))


@wp.func
def refract_in_prism_frame(
    sine: float,
    cosine: float,
    index2: float,
    x: float,
    y: float,
    z: float,
    w0: float,
    w1: float,
    entering: int,
):
    """Refract a direction of any length at both faces, in the prism's frame; NaN if no light passes.

    ``sine`` and ``cosine`` belong to the apex angle alpha; ``entering``: as for :func:`shift_at_faces`.
    """
    bent = (index2 - 1.0) * (x * x + y * y + z * z)
    along = w0 * x + w1 * y
    shift, q = shift_at_faces(sine, cosine, bent, along, z, entering)
    a, b, c = shifted(x, y, z, w0, w1, along, shift)
    passes = wp.min(wp.min(z, q), c) > 0.0  # c may be NaN and comes last: min(a, NaN) is NaN here
    return a, b, wp.where(passes, c, NAN)


@wp.func
def prism_shift(m: ExactParams, along: float, z: float) -> float:
    """Return the shift of :func:`shift_at_faces` for a unit direction; NaN if no light passes.

    It is the same side of the branch for all directions. So each side has a constant ``entering``, and computes no
    square root in vain.
    """
    if m.flat_to_scene == 1:
        shift, q = shift_at_faces(m.sin_apex, m.cos_apex, m.index2 - 1.0, along, z, 1)
        return wp.where(q > 0.0, shift, NAN)
    shift, q = shift_at_faces(m.sin_apex, m.cos_apex, m.index2 - 1.0, along, z, 0)
    return shift


@wp.func
def tip(m: ExactParams, x: float, y: float, z: float, w0: float, w1: float, sine: float):
    """Rotate a direction as the wobble tips the prism: out of the prism's frame, or into it by the negative sine."""
    u0 = w0 * m.wobble_cos - w1 * m.wobble_sin
    u1 = w1 * m.wobble_cos + w0 * m.wobble_sin
    return rotate_by_deflection(x, y, z, u0, u1, sine, m.wobble_versine)


@wp.func
def refract_at_slope(
    m: ExactParams,
    x: float,
    y: float,
    z: float,
    w0: float,
    w1: float,
    along: float,
    across: float,
    entering: int,
):
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
    p = float(a)
    q = float(b)
    r = float(c)
    change = float(0.0)
    # A variable, so that Warp does not unroll the loop, which is slow to compile
    steps = int(INVERSION_STEPS)
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
    a, b, c = refract_in_prism_frame(
        m.sin_apex, m.cos_apex, m.index2, x, y, z, w0, w1, m.flat_to_scene
    )
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
        a, b, c = refract_in_prism_frame(
            model.sin_apex, model.cos_apex, model.index2, x, y, z, w0, w1, entering
        )
        return a, b, c
    a, b, c = rotate(wp.transpose(model.axis), x, y, z)
    if model.uneven == 1:
        a, b, c = deflect_uneven(model, a, b, c, w0, w1)
    else:
        a, b, c = refract_in_prism_frame(
            model.sin_apex, model.cos_apex, model.index2, a, b, c, w0, w1, entering
        )
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
