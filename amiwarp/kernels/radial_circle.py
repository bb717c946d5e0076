"""Radial circle model: rotation of a bearing by an angle that grows with its distance from the optical axis."""

import warp as wp

from amiwarp.kernels.camera import NAN, CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.refraction import INVERSION_STEPS, compensate_direction, deflect
from amiwarp.kernels.rotations import rotate_by_deflection, sine_versine

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class RadialCircleParams:
    """Radial circle model: the deflection grows with the angle from the axis."""

    # Deflection on the optical axis [rad]; negative if the flat face looks to the camera
    deflection: float
    phase: float  # phase of the prism angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    index: float  # refractive index


@wp.func
def radial_deflection(model: RadialCircleParams, z: float) -> float:
    """Return the deflection [rad] of a thin prism for a bearing with cosine ``z``.

    delta(phi) = delta_0 (sqrt(n^2 - sin^2 phi) / cos phi - 1) / (n - 1), where z = cos phi.
    """
    cos2 = z * z
    growth = wp.sqrt((model.index * model.index - 1.0 + cos2) / wp.max(cos2, 1.0e-4)) - 1.0
    return wp.abs(model.deflection * growth / (model.index - 1.0))


@wp.func
def rotate_from_tilted_side(
    model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float
):
    """Rotate a bearing on the side of the tilted face to the bearing on the side of the flat face.

    The deflection is a function of the given bearing.
    """
    sine, versine = sine_versine(radial_deflection(model, z))
    return rotate_by_deflection(x, y, z, w0, w1, sine, versine)


@wp.func
def rotate_from_flat_side(
    model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float
):
    """Rotate a bearing on the side of the flat face to the bearing on the side of the tilted face.

    The deflection is a function of the result, so that a fixed-point iteration solves for it.
    """
    a = x
    b = y
    c = z
    step = float(1.0)
    for _ in range(INVERSION_STEPS):
        sine, versine = sine_versine(-radial_deflection(model, c))
        before = c
        a, b, c = rotate_by_deflection(x, y, z, w0, w1, sine, versine)
        step = wp.abs(c - before)
    scale = wp.where(step < 1.0e-4, 1.0, NAN)
    return a * scale, b * scale, c * scale


@wp.func
def compensate_direction(
    model: RadialCircleParams, x: float, y: float, z: float, w0: float, w1: float
):
    """Return the direction without the prism, by the radial circle model."""
    length = wp.sqrt(x * x + y * y + z * z)
    a = x / length
    b = y / length
    c = z / length
    if model.deflection < 0.0:
        a, b, c = rotate_from_flat_side(model, a, b, c, w0, w1)
    else:
        a, b, c = rotate_from_tilted_side(model, a, b, c, w0, w1)
    return a, b, c


@wp.func
def deflect(model: RadialCircleParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel by the radial circle model."""
    ray = pixel_to_ray(camera, xy)
    a = ray[0]
    b = ray[1]
    c = ray[2]
    if model.deflection < 0.0:
        a, b, c = rotate_from_tilted_side(model, a, b, c, w[0], w[1])
    else:
        a, b, c = rotate_from_flat_side(model, a, b, c, w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(a, b, c))
