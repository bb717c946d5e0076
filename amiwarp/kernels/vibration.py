"""Vibrating camera: rotation of a bearing by the camera's rotation from its orientation at rest, and back."""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
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
    # Rotation about x and y by the forward circle of the second harmonic at φ = 0 [rad]
    second: wp.vec2
    second_backward: wp.vec2  # the same of its backward circle [rad]
    # Rotation about x and y by the forward circle of the third harmonic at φ = 0 [rad]
    third: wp.vec2
    third_backward: wp.vec2  # the same of its backward circle [rad]


@wp.func
def rotate_by_vector(x: float, y: float, z: float, a: float, b: float, c: float):
    """Rotate a direction about the axis (a, b, c) by its length [rad], by Rodrigues' formula.

    sin(r)/r and (1 - cos r)/r² are computed by their series, with equal bits on every device.
    """
    r2 = a * a + b * b + c * c
    s = 1.0 / 120.0 + r2 * (-1.0 / 5040.0 + r2 * (1.0 / 362880.0 - r2 / 39916800.0))
    v = 1.0 / 720.0 + r2 * (-1.0 / 40320.0 + r2 * (1.0 / 3628800.0 - r2 / 479001600.0))
    s = 1.0 + r2 * (-1.0 / 6.0 + r2 * s)
    v = 0.5 + r2 * (-1.0 / 24.0 + r2 * v)
    p = b * z - c * y
    q = c * x - a * z
    r = a * y - b * x
    return (
        x + s * p + v * (b * r - c * q),
        y + s * q + v * (c * p - a * r),
        z + s * r + v * (a * q - b * p),
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
    a, b, c = rotate_by_vibration(model, 1.0, x, y, z, w0, w1)
    return a, b, c


@wp.func
def deflect(model: VibrationParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the pixel that the vibrating camera observes."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = rotate_by_vibration(model, -1.0, ray[0], ray[1], ray[2], w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(x, y, z))
