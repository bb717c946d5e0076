"""Pair of prisms behind each other: refraction at all four faces."""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.exact import ExactParams, deflect_direction
from amiwarp.kernels.refraction import advanced, compensate_direction, deflect, state_at, state_of

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class PairParams:
    """Two prisms behind each other, with refraction at all four faces."""

    first: ExactParams  # prism next to the camera
    second: ExactParams  # prism behind it
    phase: float  # phase of the first prism's angle [rad]
    second_phase: float  # phase of the second prism's angle [rad]
    ratio: float  # mean speed of the second prism relative to the first


@wp.func
def state_of(model: PairParams, first: float, second: float):
    """Return the state from what is stored for an event: the angles of both prisms [rad]."""
    return first + model.phase, second + model.second_phase


@wp.func
def advanced(model: PairParams, w0: float, w1: float, angle: float) -> wp.vec2:
    """Return the state after the first prism has turned by ``angle`` [rad], and the second one by its share."""
    return wp.vec2(w0 + angle, w1 + model.ratio * angle)


@wp.func
def state_at(model: PairParams, theta: wp.array(dtype=float), i: int) -> wp.vec2:
    """Return the state at the angles of both prisms, ``theta[2 i]`` and ``theta[2 i + 1]`` [rad]."""
    w0, w1 = state_of(model, theta[2 * i], theta[2 * i + 1])
    return wp.vec2(w0, w1)


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
