"""Mirror with two tilts: rotation of a bearing to what the mirror at rest would show, and back.

The state of the optic is the angles of both commands, as for a pair of prisms.
"""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
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
from amiwarp.kernels.vibration import rotate_by_vector

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class MirrorParams:
    """Rotation vectors by which both tilts turn the view at their largest, and the phases of their commands."""

    phase: float  # phase of the first tilt [rad]
    second_phase: float  # phase of the second tilt [rad]
    ratio: float  # speed of the second command's angle relative to the first
    first: wp.vec3  # rotation vector by the first tilt [rad]
    second: wp.vec3  # rotation vector by the second tilt [rad]


@wp.func
def state_of(model: MirrorParams, first: float, second: float):
    """Return the state from what is stored for an event: the angles of both commands [rad]."""
    return first + model.phase, second + model.second_phase


@wp.func
def state_of_angles(model: MirrorParams, first: float, second: float) -> wp.vec2:
    """Return the state from the true angles of both commands, phases included [rad]."""
    return wp.vec2(first, second)


@wp.func
def advanced(model: MirrorParams, w0: float, w1: float, angle: float) -> wp.vec2:
    """Return the state after the first command has gone on by ``angle`` [rad], and the second one by its share."""
    return wp.vec2(w0 + angle, w1 + model.ratio * angle)


@wp.func
def state_at(model: MirrorParams, theta: wp.array(dtype=float), i: int) -> wp.vec2:
    """Return the state at the angles of both commands, ``theta[2 i]`` and ``theta[2 i + 1]`` [rad]."""
    return wp.vec2(theta[2 * i] + model.phase, theta[2 * i + 1] + model.second_phase)


@wp.func
def state_at_time(
    model: MirrorParams, encoder: EncoderParams, azimuths: wp.array(dtype=float), t: wp.int64
):
    """Return the state at event time ``t`` [us]."""
    first, second = both_angles(encoder, t)
    w0, w1 = state_of(model, first, second)
    return w0, w1


@wp.func
def stored_state(model: MirrorParams, events: EventsWithAngles, i: int):
    """Return the angles of both commands at event ``i`` [rad]."""
    first, second = stored_angles(events, i)
    return first, second


@wp.func
def load_states(
    model: MirrorParams, events: EventsWithAngles, first: int, states: wp.array(dtype=float)
):
    """Load what :func:`stored_state` returns for a block of 64 events."""
    load_angles(events, first, states)


@wp.func
def turn_by_mirror(
    m: MirrorParams, sign: float, x: float, y: float, z: float, w0: float, w1: float
):
    """Rotate a direction as the tilted mirror and then the one at rest do, or back with ``sign`` -1.

    Two reflections are a rotation by twice the angle between their normals.
    """
    v = sign * (wp.cos(w0) * m.first + wp.cos(w1) * m.second)
    return rotate_by_vector(x, y, z, v[0], v[1], v[2])


@wp.func
def compensate_direction(model: MirrorParams, x: float, y: float, z: float, w0: float, w1: float):
    """Return the direction in which the camera would see the same point in the mirror at rest."""
    a, b, c = turn_by_mirror(model, 1.0, x, y, z, w0, w1)
    return a, b, c


@wp.func
def deflect(model: MirrorParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the pixel that sees in the tilted mirror what ``xy`` sees in the mirror at rest."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = turn_by_mirror(model, -1.0, ray[0], ray[1], ray[2], w[0], w[1])
    return ray_to_pixel(camera, wp.vec3(x, y, z))
