"""Beam steerer of two deflectors: a constant vector added to the transverse part of a unit direction, and back.

The state of the optic is the angles of both commands, as for a pair of prisms.
"""

import warp as wp

from amiwarp.kernels.camera import NAN, CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.compensation import state_at_time
from amiwarp.kernels.events_with_angles import (
    EventsWithAngles,
    load_angles,
    load_states,
    stored_angles,
    stored_state,
)
from amiwarp.kernels.prism_angle import EncoderParams, both_angles
from amiwarp.kernels.refraction import (
    advanced,
    compensate_direction,
    deflect,
    state_at,
    state_of,
    state_of_angles,
)

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class SteererParams:
    """What both deflectors add at their largest, and the phases of their commands."""

    phase: float  # phase of the first deflector [rad]
    second_phase: float  # phase of the second deflector [rad]
    ratio: float  # speed of the second command's angle relative to the first
    # What the first deflector adds to x and y of an observed unit direction at a command of 1
    first: wp.vec2
    second: wp.vec2  # the same of the second deflector


@wp.func
def state_of(model: SteererParams, first: float, second: float):
    """Return the state from what is stored for an event: the angles of both commands [rad]."""
    return first + model.phase, second + model.second_phase


@wp.func
def state_of_angles(model: SteererParams, first: float, second: float) -> wp.vec2:
    """Return the state from the true angles of both commands, phases included [rad]."""
    return wp.vec2(first, second)


@wp.func
def advanced(model: SteererParams, w0: float, w1: float, angle: float) -> wp.vec2:
    """Return the state after the first command has gone on by ``angle`` [rad], and the second one by its share."""
    return wp.vec2(w0 + angle, w1 + model.ratio * angle)


@wp.func
def state_at(model: SteererParams, theta: wp.array(dtype=float), i: int) -> wp.vec2:
    """Return the state at the angles of both commands, ``theta[2 i]`` and ``theta[2 i + 1]`` [rad]."""
    return wp.vec2(theta[2 * i] + model.phase, theta[2 * i + 1] + model.second_phase)


@wp.func
def state_at_time(
    model: SteererParams, encoder: EncoderParams, azimuths: wp.array(dtype=float), t: wp.int64
):
    """Return the state at event time ``t`` [us]."""
    first, second = both_angles(encoder, t)
    w0, w1 = state_of(model, first, second)
    return w0, w1


@wp.func
def stored_state(model: SteererParams, events: EventsWithAngles, i: int):
    """Return the angles of both commands at event ``i`` [rad]."""
    first, second = stored_angles(events, i)
    return first, second


@wp.func
def load_states(
    model: SteererParams, events: EventsWithAngles, first: int, states: wp.array(dtype=float)
):
    """Load what :func:`stored_state` returns for a block of 64 events."""
    load_angles(events, first, states)


@wp.func
def with_transverse(x: float, y: float, z: float, p: float, q: float):
    """Return a direction at unit length, with (p, q) added to its transverse part; NaN if no such direction exists.

    The third component is computed from its change: 1 - x² - y² would cancel in float32 far from the axis.
    """
    scale = 1.0 / wp.sqrt(x * x + y * y + z * z)
    a = x * scale
    b = y * scale
    c = z * scale
    squared = c * c - p * (2.0 * a + p) - q * (2.0 * b + q)
    exists = wp.min(c, squared) > 0.0  # squared may be NaN and comes last: min(a, NaN) is NaN here
    return a + p, b + q, wp.where(exists, wp.sqrt(squared), NAN)


@wp.func
def compensate_direction(model: SteererParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the direction without the deflectors."""
    added = wp.cos(w0) * model.first + wp.cos(w1) * model.second
    a, b, c = with_transverse(x, y, z, -added[0], -added[1])
    return a, b, c


@wp.func
def deflect(model: SteererParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel: both deflectors add their vectors."""
    ray = pixel_to_ray(camera, xy)
    added = wp.cos(w[0]) * model.first + wp.cos(w[1]) * model.second
    x, y, z = with_transverse(ray[0], ray[1], ray[2], added[0], added[1])
    return ray_to_pixel(camera, wp.vec3(x, y, z))
