"""Events on a device with their prism angles, and what kernels load of them."""

from typing import Any

import warp as wp

from amiwarp.kernels.native_code import load_float, load_pairs, load_uint16, store_float
from amiwarp.kernels.prism_angle import THETA_U16_RAD, EncoderParams, of_second, theta_u32_at
from amiwarp.kernels.prism_pair import PairParams

OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(OPTIONS)


@wp.struct
class EventsWithAngles:
    """Events on a device, padded to whole blocks.

    ``layer`` is the image that an event goes to, by its part, then by its polarity. ``turn`` is theta_u16, the
    encoder's angle [1/65536 turn], and ``azimuths`` holds cosine and sine of each such angle. ``second`` is theta_u16
    of the second prism, or empty. ``time`` [s] counts from the middle of the window; it is empty if the camera does not
    rotate. ``weight`` is the number of events that an entry stands for, or empty.
    """

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    layer: wp.array(dtype=wp.uint8)
    turn: wp.array(dtype=wp.uint16)
    second: wp.array(dtype=wp.uint16)
    azimuths: wp.array(dtype=float)
    time: wp.array(dtype=float)
    weight: wp.array(dtype=wp.uint8)


@wp.func
def stored_angles(events: EventsWithAngles, i: int):
    """Return the angles of both encoders, or of both commands, at event ``i`` [rad]."""
    first = float(int(load_uint16(events.turn, i)))
    return first * THETA_U16_RAD, float(int(load_uint16(events.second, i))) * THETA_U16_RAD


@wp.func
def stored_state(model: Any, events: EventsWithAngles, i: int):
    """Return cosine and sine of the encoder's angle at event ``i``."""
    turn = 2 * int(load_uint16(events.turn, i))
    return load_float(events.azimuths, turn), load_float(events.azimuths, turn + 1)


@wp.func
def stored_state(model: PairParams, events: EventsWithAngles, i: int):
    """Return the angles of both encoders at event ``i`` [rad]."""
    return stored_angles(events, i)


@wp.func
def load_angles(events: EventsWithAngles, first: int, states: wp.array(dtype=float)):
    """Load what :func:`stored_angles` returns for a block of 64 events."""
    for k in range(64):
        a, b = stored_angles(events, first + k)
        store_float(states, 2 * k, a)
        store_float(states, 2 * k + 1, b)


@wp.func
def load_states(model: Any, events: EventsWithAngles, first: int, states: wp.array(dtype=float)):
    """Load what :func:`stored_state` returns for a block of 64 events, in a form that CPUs vectorise."""
    load_pairs(states, events.azimuths, events.turn, first)


@wp.func
def load_states(
    model: PairParams, events: EventsWithAngles, first: int, states: wp.array(dtype=float)
):
    """Load what :func:`stored_state` returns for a block of 64 events."""
    load_angles(events, first, states)


@wp.func
def theta_u16_at(encoder: EncoderParams, t: wp.int64) -> wp.uint16:
    """Return theta_u16, the prism angle [1/65536 turn], at event time ``t`` [us]."""
    return wp.uint16((theta_u32_at(encoder, t) + wp.uint32(32768)) >> wp.uint32(16))


@wp.kernel
def store_turns(
    encoder: EncoderParams, t: wp.array(dtype=wp.int64), start: int, turn: wp.array(dtype=wp.uint16)
):
    """Compute theta_u16 of each event: the prism angle at its time, rounded to 1/65536 turn."""
    i = start + wp.tid()
    turn[i] = theta_u16_at(encoder, t[i])


@wp.kernel(module="unique", module_options=OPTIONS)
def store_second_turns(
    encoder: EncoderParams, t: wp.array(dtype=wp.int64), start: int, turn: wp.array(dtype=wp.uint16)
):
    """Compute theta_u16 of the second prism at each event."""
    i = start + wp.tid()
    turn[i] = theta_u16_at(of_second(encoder), t[i])


@wp.kernel(module="unique", module_options=OPTIONS)
def store_times(
    t: wp.array(dtype=wp.int64), middle: wp.int64, start: int, time: wp.array(dtype=float)
):
    """Compute the time of each event from the middle of the window [s]."""
    i = start + wp.tid()
    # The difference may exceed 32 bits, which hold 36 minutes.
    time[i] = float(wp.float64(t[i] - middle) * wp.float64(1.0e-6))


@wp.kernel
def store_layers(
    p: wp.array(dtype=wp.uint8),
    parts: int,
    per_polarity: int,
    start: int,
    layer: wp.array(dtype=wp.uint8),
):
    """Assign an image to each event: by its part (event i belongs to part i modulo ``parts``), then by its polarity."""
    i = start + wp.tid()
    layer[i] = wp.uint8(
        (i % parts) * (1 + per_polarity) + per_polarity * wp.where(p[i] != wp.uint8(0), 1, 0)
    )


@wp.kernel(module="unique", module_options=OPTIONS)
def drift_turns(
    base: wp.array(dtype=wp.uint16),
    slope: wp.array(dtype=float),
    drift: float,
    start: int,
    turn: wp.array(dtype=wp.uint16),
):
    """Compute theta_u16 after a parameter has changed by ``drift``.

    ``slope`` is the derivative of the angle by the parameter [1/65536 turn per unit].
    """
    i = start + wp.tid()
    turn[i] = wp.uint16((int(base[i]) + int(wp.floor(drift * slope[i] + 0.5))) & 65535)
