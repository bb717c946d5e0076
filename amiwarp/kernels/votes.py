"""Events on a device, their prism angles, and the shares of their votes in the image of warped events (IWE).

A vote goes to the four pixels around its position, the corners of a cell. The position in the cell is (x, y), in units
of 1/256, and b is x y. The four bilinear weights are 256 - x - y + b for the cell's first pixel, x - b for the next
column, y - b for the next row, and b for the pixel diagonally opposite. These are integers, so that their sums do not
depend on the order of events.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.native_code import load_float, load_pairs, load_uint16, store_float
from amiwarp.kernels.prism_angle import THETA_U16_RAD, EncoderParams, of_second, theta_u32_at
from amiwarp.kernels.prism_pair import PairParams

OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(OPTIONS)

MIX_1 = wp.constant(wp.uint32(0x85EBCA6B))  # multipliers of MurmurHash3's finaliser
MIX_2 = wp.constant(wp.uint32(0xC2B2AE35))


@wp.struct
class EventArrays:
    """Events on a device, padded to whole blocks.

    ``layer`` is the image that an event goes to, by its polarity. ``turn`` is theta_u16, the encoder's angle
    [1/65536 turn], and ``azimuths`` holds cosine and sine of each such angle. ``second`` is theta_u16 of the second
    prism, or empty. ``time`` [s] counts from the middle of the window; it is empty if the camera does not rotate.
    ``weight`` is the number of events that an entry stands for, or empty.
    """

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    layer: wp.array(dtype=wp.uint8)
    turn: wp.array(dtype=wp.uint16)
    second: wp.array(dtype=wp.uint16)
    azimuths: wp.array(dtype=float)
    time: wp.array(dtype=float)
    weight: wp.array(dtype=wp.uint8)


@wp.struct
class Canvas:
    """Geometry of the votes: the image grown by ``pad`` pixels on each side, scaled, with a border of one pixel."""

    pad: float  # border around the sensor [px]
    scale: float  # canvas pixels per sensor pixel
    nearest: int  # 1: nearest votes, 0: bilinear votes
    dither: float  # 1: events get a random offset in their pixels; 0: they lie at the centres
    rows: int  # number of rows of cells, including the border
    columns: int
    layer: int  # distance from one image to the next [cells]; 0: one image for all events


@wp.func
def events_of(votes: wp.int64) -> float:
    """Return a number of events from votes [1/256 event]."""
    return float(wp.float64(votes) / wp.float64(256.0))


@wp.func
def dither_offset(i: int):
    """Return a random offset in the pixel, uniform over it, for event ``i``.

    It is the same at every call. The hash is MurmurHash3's finaliser.
    """
    h = wp.uint32(i + 1)
    h = (h ^ (h >> wp.uint32(16))) * MIX_1
    h = (h ^ (h >> wp.uint32(13))) * MIX_2
    h = h ^ (h >> wp.uint32(16))
    scale = 1.0 / 65536.0
    return float(int(h & wp.uint32(0xFFFF))) * scale - 0.5, float(
        int(h >> wp.uint32(16))
    ) * scale - 0.5


@wp.func
def cell_at(canvas: Canvas, x: float, y: float, layer: int):
    """Return whether a position lies on the canvas, its cell, and x, y and x y in the cell [1/256].

    A position off the canvas, or NaN, gets the place of cell 0's first pixel, which is outside the image.
    """
    u = (x + canvas.pad + 0.5) * canvas.scale + 0.5
    v = (y + canvas.pad + 0.5) * canvas.scale + 0.5
    inside = wp.where(u > 0.0, wp.where(u < float(canvas.columns - 1), 1, 0), 0)
    inside = wp.where(v > 0.0, wp.where(v < float(canvas.rows - 1), inside, 0), 0)
    u = wp.where(inside == 1, wp.where(canvas.nearest != 0, wp.floor(u + 0.5), u), 0.0)
    v = wp.where(inside == 1, wp.where(canvas.nearest != 0, wp.floor(v + 0.5), v), 0.0)
    col = int(u)
    row = int(v)
    fx = int((u - float(col)) * 256.0 + 0.5)
    fy = int((v - float(row)) * 256.0 + 0.5)
    cell = row * canvas.columns + col + layer
    return inside, wp.where(inside == 1, cell, 0), fx, fy, (fx * fy + 128) >> 8


@wp.func
def stored_state(model: Any, events: EventArrays, i: int):
    """Return cosine and sine of the encoder's angle at event ``i``."""
    turn = 2 * int(load_uint16(events.turn, i))
    return load_float(events.azimuths, turn), load_float(events.azimuths, turn + 1)


@wp.func
def stored_angles(events: EventArrays, i: int):
    """Return the angles of both encoders, or of both commands, at event ``i`` [rad]."""
    first = float(int(load_uint16(events.turn, i)))
    return first * THETA_U16_RAD, float(int(load_uint16(events.second, i))) * THETA_U16_RAD


@wp.func
def stored_state(model: PairParams, events: EventArrays, i: int):
    """Return the angles of both encoders at event ``i`` [rad]."""
    first, second = stored_angles(events, i)
    return first, second


@wp.func
def load_states(model: Any, events: EventArrays, first: int, states: wp.array(dtype=float)):
    """Load what :func:`stored_state` returns for a block of 64 events, in a form that CPUs vectorise."""
    load_pairs(states, events.azimuths, events.turn, first)


@wp.func
def load_angles(events: EventArrays, first: int, states: wp.array(dtype=float)):
    """Load what :func:`stored_angles` returns for a block of 64 events."""
    for k in range(64):
        a, b = stored_angles(events, first + k)
        store_float(states, 2 * k, a)
        store_float(states, 2 * k + 1, b)


@wp.func
def load_states(model: PairParams, events: EventArrays, first: int, states: wp.array(dtype=float)):
    """Load what :func:`stored_state` returns for a block of 64 events."""
    load_angles(events, first, states)


@wp.func
def theta_u16_at(encoder: EncoderParams, t: wp.int64) -> wp.uint16:
    """Return theta_u16, the prism angle [1/65536 turn], at event time ``t`` [us]."""
    return wp.uint16((theta_u32_at(encoder, t) + wp.uint32(32768)) >> wp.uint32(16))


@wp.kernel
def turn_events(
    encoder: EncoderParams, t: wp.array(dtype=wp.int64), start: int, turn: wp.array(dtype=wp.uint16)
):
    """Compute theta_u16 of each event: the prism angle at its time, rounded to 1/65536 turn."""
    i = start + wp.tid()
    turn[i] = theta_u16_at(encoder, t[i])


@wp.kernel(module="unique", module_options=OPTIONS)
def turn_second(
    encoder: EncoderParams, t: wp.array(dtype=wp.int64), start: int, turn: wp.array(dtype=wp.uint16)
):
    """Compute theta_u16 of the second prism at each event."""
    i = start + wp.tid()
    turn[i] = theta_u16_at(of_second(encoder), t[i])


@wp.kernel(module="unique", module_options=OPTIONS)
def time_events(
    t: wp.array(dtype=wp.int64), middle: wp.int64, start: int, time: wp.array(dtype=float)
):
    """Compute the time of each event from the middle of the window [s]."""
    i = start + wp.tid()
    # The difference may exceed 32 bits, which hold 36 minutes.
    time[i] = float(wp.float64(t[i] - middle) * wp.float64(1.0e-6))


@wp.kernel
def layer_events(
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
def fold_keys(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    layer: wp.array(dtype=wp.uint8),
    turn: wp.array(dtype=wp.uint16),
    bins: int,
    start: int,
    keys: wp.array(dtype=wp.int64),
):
    """Compute a sort key of each event: bin of the prism angle, pixel and polarity, in that order."""
    i = start + wp.tid()
    bin_of = wp.int64((wp.uint32(turn[i]) * wp.uint32(bins)) >> wp.uint32(16))
    pixel = (wp.int64(y[i]) << wp.int64(16)) | wp.int64(x[i])
    keys[i] = (
        (bin_of << wp.int64(33))
        | (pixel << wp.int64(1))
        | wp.int64(wp.where(layer[i] != wp.uint8(0), 1, 0))
    )


@wp.kernel(module="unique", module_options=OPTIONS)
def unfold_keys(keys: wp.array(dtype=wp.int64), bins: int, start: int, events: EventArrays):
    """Recover the events from their sort keys; the prism angle becomes the middle of its bin."""
    i = start + wp.tid()
    key = keys[i]
    events.layer[i] = wp.uint8(key & wp.int64(1))
    events.x[i] = wp.uint16((key >> wp.int64(1)) & wp.int64(65535))
    events.y[i] = wp.uint16((key >> wp.int64(17)) & wp.int64(65535))
    bin_of = key >> wp.int64(33)
    events.turn[i] = wp.uint16((wp.int64(65536) * bin_of + wp.int64(32768)) / wp.int64(bins))


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
