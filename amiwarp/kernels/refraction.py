"""What every optical model does: move a pixel to where it would be without the optic (compensate), and back (deflect).

Every model has a struct of parameters and versions (overloads) of these functions for it:

- ``compensate_direction(model, x, y, z, w0, w1)``: the direction without the optic. A model that is no function of
  the direction has ``compensate(model, camera, xy, w)`` instead, from pixel to pixel.
- ``deflect(model, camera, xy, w)``: the observed pixel, the inverse of ``compensate``.

``w`` is the state of the optic: two floats, for one prism the (cos, sin) of its tilt azimuth, for a pair the azimuths
of both. ``state_of`` computes it from what is stored for an event, and ``advanced`` turns it on. ``displace`` is
``compensate`` for an event's pixel, with plain floats.

This file has the versions for any model, and the circle model, the simplest one. Each other model has its own file.

Directions are three floats, not a vec3, in code that CPUs vectorise over eight events: LLVM does not vectorise calls
that return small structs. A direction may have any length except zero.
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
from amiwarp.kernels.rotations import rotate_by_deflection

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

INVERSION_STEPS = wp.constant(8)  # number of steps of fixed-point iterations that invert a model


@wp.struct
class CircleParams:
    """Circle model: rotation of each bearing by a constant deflection."""

    sine: float  # sine of the deflection; positive if the flat face looks to the scene
    versine: float  # 1 - cosine of the deflection
    phase: float  # phase of the prism angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase


@wp.func
def state_of(model: Any, c: float, s: float):
    """Return the state from what is stored for an event: cosine and sine of the prism angle."""
    return c * model.phase_cos - s * model.phase_sin, s * model.phase_cos + c * model.phase_sin


@wp.func
def state_of_angles(model: Any, first: float, second: float) -> wp.vec2:
    """Return the state from the true angles of the optic, phases included [rad]; ``second`` counts for two of them."""
    return wp.vec2(wp.cos(first), wp.sin(first))


@wp.func
def advanced(model: Any, w0: float, w1: float, angle: float) -> wp.vec2:
    """Return the state after the prism has turned by ``angle`` [rad]."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec2(w0 * c - w1 * s, w1 * c + w0 * s)


@wp.func
def state_at(model: Any, theta: wp.array(dtype=float), i: int) -> wp.vec2:
    """Return the state at the prism angle ``theta[i]`` [rad]."""
    phi = theta[i] + model.phase
    return wp.vec2(wp.cos(phi), wp.sin(phi))


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
