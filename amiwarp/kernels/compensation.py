"""Compensation of a recording's columns: angle, displacement and place of every event in one pass."""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, PinholeParams
from amiwarp.kernels.encoder import EncoderParams, angle_at, angle_on, piece_at
from amiwarp.kernels.native import (
    load_float,
    load_int64,
    load_uint16,
    load_uint32,
    store_float,
    store_uint8,
    store_uint32,
)
from amiwarp.kernels.optics import MODEL_STRUCTS, place

# without fused multiply-add, which CPUs and GPUs place differently: both give the same bits
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK = wp.constant(64)  # events of one thread on a CPU, placed eight at a time
FINE = wp.constant(2.0 * 3.141592653589793 / 4294967296.0)  # 2**-32 turn [rad]


@wp.struct
class Columns:
    """A recording's events as they are stored, padded to whole blocks, and where they belong."""

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    t: wp.array(dtype=wp.int64)
    out_x: wp.array(dtype=float)
    out_y: wp.array(dtype=float)
    inside: wp.array(dtype=wp.uint8)  # 1: on a pixel of the image


@wp.func
def one_piece(encoder: EncoderParams, t: wp.array(dtype=wp.int64), first: int) -> int:
    """The piece of a block's events where they share one, as almost all blocks do; -1 where not."""
    low = t[first]
    high = low
    for k in range(BLOCK):
        low = wp.min(low, load_int64(t, first + k))
        high = wp.max(high, load_int64(t, first + k))
    piece = piece_at(encoder, low - encoder.origin)
    return wp.where(piece_at(encoder, high - encoder.origin) == piece, piece, -1)


@wp.func
def azimuth(model: Any, azimuths: wp.array(dtype=float), turn: wp.uint32):
    """Cosine and sine of an angle [2**-32 turn]: the table's at the coarser angle below it, turned on by the rest.

    The rest is below 1e-4 rad: what its square leaves out moves an event on an orbit of 100 px by 5e-7 px.
    """
    coarse = 2 * int(turn >> wp.uint32(16))
    rest = float(int(turn & wp.uint32(0xFFFF))) * FINE
    c = load_float(azimuths, coarse)
    s = load_float(azimuths, coarse + 1)
    a = c - s * rest
    b = s + c * rest
    return a * model.phase_cos - b * model.phase_sin, b * model.phase_cos + a * model.phase_sin


@wp.func
def placed(model: Any, camera: Any, azimuths: wp.array(dtype=float), columns: Columns, turn: wp.uint32, i: int):
    w0, w1 = azimuth(model, azimuths, turn)
    x, y = place(model, camera, float(load_uint16(columns.x, i)), float(load_uint16(columns.y, i)), w0, w1)
    return x, y


@wp.func
def store_place(size: wp.vec2, columns: Columns, i: int, x: float, y: float):
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
    """For CPUs: a block's angles, then its places by a loop that vectorises."""
    first = (start + wp.tid()) * BLOCK
    turns = wp.zeros(shape=(64,), dtype=wp.uint32)
    xs = wp.zeros(shape=(64,), dtype=float)
    ys = wp.zeros(shape=(64,), dtype=float)
    piece = one_piece(encoder, columns.t, first)
    if piece >= 0:
        for k in range(BLOCK):
            elapsed = load_int64(columns.t, first + k) - encoder.origin
            store_uint32(turns, k, angle_on(encoder, piece, elapsed))
    else:
        for k in range(BLOCK):
            turns[k] = angle_at(encoder, columns.t[first + k])
    for k in range(BLOCK):
        x, y = placed(model, camera, azimuths, columns, load_uint32(turns, k), first + k)
        store_float(xs, k, x)
        store_float(ys, k, y)
    for k in range(BLOCK):
        store_place(size, columns, first + k, load_float(xs, k), load_float(ys, k))


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
    """For CUDA: one event."""
    i = start + wp.tid()
    x, y = placed(model, camera, azimuths, columns, angle_at(encoder, columns.t[i]), i)
    store_place(size, columns, i, x, y)


for _model in MODEL_STRUCTS:
    for _camera in (PinholeParams, CameraParams):
        wp.overload(compensate_blocks, {"model": _model, "camera": _camera})
        wp.overload(compensate_events, {"model": _model, "camera": _camera})
