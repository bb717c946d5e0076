"""Motion compensation of a recording's columns: prism angle, displacement and position of every event in one pass."""

from typing import Any

import warp as wp

from amiwarp.kernels.native_code import (
    load_float,
    load_int64,
    load_uint16,
    load_uint32,
    store_float,
    store_uint8,
    store_uint32,
)
from amiwarp.kernels.prism_angle import (
    THETA_U32_RAD,
    EncoderParams,
    of_second,
    piece_at,
    radians,
    theta_u32_at,
    theta_u32_on,
)
from amiwarp.kernels.refraction import PairParams, displace, even, is_even, state_of

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK = wp.constant(64)  # number of events per CPU thread, which displaces eight at a time


@wp.struct
class Columns:
    """Columns of events as in a recording, padded to whole blocks, and of their compensated positions [px]."""

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    t: wp.array(dtype=wp.int64)
    out_x: wp.array(dtype=float)
    out_y: wp.array(dtype=float)
    inside: wp.array(dtype=wp.uint8)  # 1 if the event lies on a pixel of the image, else 0


@wp.func
def shared_piece(encoder: EncoderParams, t: wp.array(dtype=wp.int64), first: int) -> int:
    """Return the encoder piece that all events of a block lie on, or -1 if they lie on several."""
    low = t[first]
    high = low
    for k in range(BLOCK):
        low = wp.min(low, load_int64(t, first + k))
        high = wp.max(high, load_int64(t, first + k))
    piece = piece_at(encoder, low - encoder.origin)
    return wp.where(piece_at(encoder, high - encoder.origin) == piece, piece, -1)


@wp.func
def state_at_turn(model: Any, azimuths: wp.array(dtype=float), turn: wp.uint32):
    """Return the optic's state for theta_u32 ``turn``.

    The table gives the values at the next coarser angle; a first-order rotation adds the remainder. The remainder is
    below 1e-4 rad; neglecting its square moves an event on an orbit of 100 px by 5e-7 px.
    """
    coarse = 2 * int(turn >> wp.uint32(16))
    rest = float(int(turn & wp.uint32(0xFFFF))) * THETA_U32_RAD
    c = load_float(azimuths, coarse)
    s = load_float(azimuths, coarse + 1)
    w0, w1 = state_of(model, c - s * rest, s + c * rest)
    return w0, w1


@wp.func
def state_at_time(model: Any, encoder: EncoderParams, azimuths: wp.array(dtype=float), t: wp.int64):
    """Return the optic's state at event time ``t`` [us]."""
    w0, w1 = state_at_turn(model, azimuths, theta_u32_at(encoder, t))
    return w0, w1


@wp.func
def state_at_time(model: PairParams, encoder: EncoderParams, azimuths: wp.array(dtype=float), t: wp.int64):
    """Return the state of both prisms at event time ``t`` [us]."""
    second = radians(theta_u32_at(of_second(encoder), t))
    w0, w1 = state_of(model, radians(theta_u32_at(encoder, t)), second)
    return w0, w1


@wp.func
def displace_event(model: Any, camera: Any, columns: Columns, w0: float, w1: float, i: int):
    """Return the compensated position [px] of event ``i``."""
    x, y = displace(model, camera, float(load_uint16(columns.x, i)), float(load_uint16(columns.y, i)), w0, w1)
    return x, y


@wp.func
def displace_block(
    model: Any, camera: Any, azimuths: wp.array(dtype=float), columns: Columns, turns: wp.array(dtype=wp.uint32),
    first: int, xs: wp.array(dtype=float), ys: wp.array(dtype=float),
):  # fmt: skip
    """Compute the compensated positions [px] of a block of events."""
    for k in range(BLOCK):
        w0, w1 = state_at_turn(model, azimuths, load_uint32(turns, k))
        x, y = displace_event(model, camera, columns, w0, w1, first + k)
        store_float(xs, k, x)
        store_float(ys, k, y)


@wp.func
def store_position(size: wp.vec2, columns: Columns, i: int, x: float, y: float):
    """Store a compensated position, and whether it lies on a pixel of an image of ``size`` [px]."""
    across = wp.where(x >= -0.5, wp.where(x < size[0] - 0.5, 1, 0), 0)
    store_float(columns.out_x, i, x)
    store_float(columns.out_y, i, y)
    store_uint8(columns.inside, i, wp.where(y >= -0.5, wp.where(y < size[1] - 0.5, across, 0), 0))


@wp.kernel
def compensate_blocks(
    model: Any,
    camera: Any,
    size: wp.vec2,
    encoder: EncoderParams,
    azimuths: wp.array(dtype=float),
    columns: Columns,
    start: int,
):
    """Compensate one block of events per thread. For CPUs: a vectorised loop finds the positions."""
    first = (start + wp.tid()) * BLOCK
    turns = wp.zeros(shape=(64,), dtype=wp.uint32)
    xs = wp.zeros(shape=(64,), dtype=float)
    ys = wp.zeros(shape=(64,), dtype=float)
    piece = shared_piece(encoder, columns.t, first)
    if piece >= 0:
        for k in range(BLOCK):
            elapsed = load_int64(columns.t, first + k) - encoder.origin
            store_uint32(turns, k, theta_u32_on(encoder, piece, elapsed))
    else:
        for k in range(BLOCK):
            turns[k] = theta_u32_at(encoder, columns.t[first + k])
    if is_even(model) == 1:
        displace_block(even(model), camera, azimuths, columns, turns, first, xs, ys)
    else:
        displace_block(model, camera, azimuths, columns, turns, first, xs, ys)
    for k in range(BLOCK):
        store_position(size, columns, first + k, load_float(xs, k), load_float(ys, k))


@wp.kernel
def compensate_events(
    model: Any,
    camera: Any,
    size: wp.vec2,
    encoder: EncoderParams,
    azimuths: wp.array(dtype=float),
    columns: Columns,
    start: int,
):
    """Compensate one event per thread. For CUDA, and for a pair of prisms."""
    i = start + wp.tid()
    w0, w1 = state_at_time(model, encoder, azimuths, columns.t[i])
    x, y = displace_event(model, camera, columns, w0, w1, i)
    store_position(size, columns, i, x, y)
