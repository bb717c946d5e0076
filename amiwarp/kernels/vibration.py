"""Vibrating camera: rotation of a bearing by the camera's rotation from its orientation at rest, and back."""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel

# Imported by name, so that the functions of the same names below become their overloads.
from amiwarp.kernels.refraction import compensate_direction, deflect

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class VibrationParams:
    """Vibration of the camera, by the angle φ = θ + phase of its forward circle."""

    amplitude: float  # radius of the forward circle [rad]
    phase: float  # phase of the forward circle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    backward: wp.vec2  # rotation about x and y by the backward circle at φ = 0 [rad]
    roll: wp.vec2  # rotation about the optical axis: factors of cos φ and sin φ [rad]
    # Rotations about x and y by the circles of the second and of the third harmonic at φ = 0 [rad]
    second: wp.vec2
    second_backward: wp.vec2
    third: wp.vec2
    third_backward: wp.vec2


@wp.func
def rotate_by_vector(x: float, y: float, z: float, a: float, b: float, c: float):
    """Rotate a direction about the axis (a, b, c) by its length [rad], by Rodrigues' formula.

    sin(r)/r and (1 - cos r)/r² of the length r are computed by their series: accurate to 1e-7 up to 1 rad, with equal
    bits on every device.
    """
    r2 = a * a + b * b + c * c
    sine = 1.0 / 120.0 + r2 * (-1.0 / 5040.0 + r2 * (1.0 / 362880.0 - r2 / 39916800.0))
    versine = 1.0 / 720.0 + r2 * (-1.0 / 40320.0 + r2 * (1.0 / 3628800.0 - r2 / 479001600.0))
    sine = 1.0 + r2 * (-1.0 / 6.0 + r2 * sine)  # sin(r) / r
    versine = 0.5 + r2 * (-1.0 / 24.0 + r2 * versine)  # (1 - cos r) / r²
    cross_x = b * z - c * y
    cross_y = c * x - a * z
    cross_z = a * y - b * x
    return (
        x + sine * cross_x + versine * (b * cross_z - c * cross_y),
        y + sine * cross_y + versine * (c * cross_x - a * cross_z),
        z + sine * cross_z + versine * (a * cross_y - b * cross_x),
    )


@wp.func
def rotate_by_vibration(
    m: VibrationParams, sign: float, x: float, y: float, z: float, w0: float, w1: float
):
    """Rotate a direction by the camera's rotation from rest at φ = (w0, w1), or back with ``sign`` -1."""
    t0, t1 = w0 * w0 - w1 * w1, 2.0 * w0 * w1  # cosine and sine of 2φ
    u0, u1 = w0 * t0 - w1 * t1, w0 * t1 + w1 * t0  # and of 3φ
    a = m.amplitude * w0 + m.backward[0] * w0 + m.backward[1] * w1
    b = m.amplitude * w1 + m.backward[1] * w0 - m.backward[0] * w1
    c = m.roll[0] * w0 + m.roll[1] * w1
    a += m.second[0] * t0 - m.second[1] * t1 + m.second_backward[0] * t0 + m.second_backward[1] * t1
    b += m.second[1] * t0 + m.second[0] * t1 + m.second_backward[1] * t0 - m.second_backward[0] * t1
    a += m.third[0] * u0 - m.third[1] * u1 + m.third_backward[0] * u0 + m.third_backward[1] * u1
    b += m.third[1] * u0 + m.third[0] * u1 + m.third_backward[1] * u0 - m.third_backward[0] * u1
    return rotate_by_vector(x, y, z, sign * a, sign * b, sign * c)


@wp.func
def compensate_direction(
    model: VibrationParams, x: float, y: float, z: float, w0: float, w1: float
):
    """Return the direction that the camera at rest would observe."""
    return rotate_by_vibration(model, 1.0, x, y, z, w0, w1)


@wp.func
def deflect(model: VibrationParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the pixel that the vibrating camera observes."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = rotate_by_vibration(model, -1.0, ray[0], ray[1], ray[2], w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(x, y, z))
