"""Motion compensation of a recording's columns: prism angle, displacement and position of every event in one pass."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from amiwarp.kernels.camera import camera_params, pinhole_params
from amiwarp.kernels.launch import launch
from amiwarp.kernels.loading import load, specialised
from amiwarp.kernels.native_code import (
    load_float,
    load_int64,
    load_uint16,
    load_uint32,
    store_float,
    store_uint8,
    store_uint32,
)
from amiwarp.kernels.plain_models import even, is_even
from amiwarp.kernels.prism_angle import (
    THETA_U32_RAD,
    EncoderParams,
    both_angles,
    piece_at,
    theta_u32_at,
    theta_u32_on,
)
from amiwarp.kernels.prism_pair import PairParams
from amiwarp.kernels.refraction import displace, state_of

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


@lru_cache(maxsize=4)
def azimuths(device: str) -> wp.array:
    """Return cosine and sine of 65,536 angles of a turn, interleaved, float32.

    They are computed by NumPy in float64, so that every device has the same bits.
    """
    angle = np.arange(1 << 16) * (2.0 * math.pi / (1 << 16))
    table = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    return wp.array(table.ravel(), dtype=float, device=device)


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
def state_at_time(
    model: PairParams, encoder: EncoderParams, azimuths: wp.array(dtype=float), t: wp.int64
):
    """Return the state of both prisms at event time ``t`` [us]."""
    first, second = both_angles(encoder, t)
    w0, w1 = state_of(model, first, second)
    return w0, w1


@wp.func
def displace_event(model: Any, camera: Any, columns: Columns, w0: float, w1: float, i: int):
    """Return the compensated position [px] of event ``i``."""
    x, y = displace(
        model, camera, float(load_uint16(columns.x, i)), float(load_uint16(columns.y, i)), w0, w1
    )
    return x, y


@wp.func
def displace_block(
    model: Any,
    camera: Any,
    azimuths: wp.array(dtype=float),
    columns: Columns,
    turns: wp.array(dtype=wp.uint32),
    first: int,
    xs: wp.array(dtype=float),
    ys: wp.array(dtype=float),
):
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


class LaunchPlan:
    """Choice of the kernel that compensates events by one model on one device, and its launch arguments."""

    def __init__(self, model: Any, device: Any) -> None:
        """Load the kernel, so that threads that use the plan do not each try to. ``device``: a ``wp.Device``."""
        name = str(device)
        self.size = model.camera.width, model.camera.height
        """Sensor width and height [px]."""
        in_blocks = device.is_cpu and model.ANGLES == 1
        self.kernel = compensate_blocks if in_blocks else compensate_events
        self.block = int(BLOCK) if in_blocks else 1
        """Number of events per thread of the kernel; columns are padded to a multiple of this number."""
        self._camera = camera_params(model.camera, name)
        self._pinhole = pinhole_params(model.camera) or self._camera
        self._model = model.params(name)
        self._limits = wp.vec2(*self.size)
        self._azimuths = azimuths(name)
        load(specialised(self.kernel, [self._model, self._pinhole]), device)

    def padded(self, n: int) -> int:
        """Return the padded length of a column of ``n`` events."""
        return -(-n // self.block) * self.block

    def any_outside(self, max_x: int, max_y: int) -> bool:
        """Return whether any event can lie outside the sensor, given the largest coordinates of the events [px]."""
        return max_x >= self.size[0] or max_y >= self.size[1]

    def device_columns(self, events: Any) -> list[wp.array]:
        """Return x, y and t of events on the device, padded, without a copy if they need no padding."""
        padded = self.padded(len(events))
        if padded == len(events):
            return [events.x, events.y, events.t]
        columns: list[wp.array] = []
        for values in (events.x, events.y, events.t):
            column = wp.zeros(padded, dtype=values.dtype, device=values.device)
            wp.copy(column, values)
            columns.append(column)
        return columns

    def run(
        self,
        columns: list[wp.array],
        encoder: Any,
        max_x: int,
        max_y: int,
        *,
        all_cores: bool = True,
    ) -> Any:
        """Compensate padded columns x, y, t, with these largest coordinates [px]; return new ``Columns``."""
        padded = len(columns[0])
        device = columns[0].device
        c = Columns()
        c.x, c.y, c.t = columns
        c.out_x = wp.empty(padded, dtype=float, device=device)
        c.out_y = wp.empty(padded, dtype=float, device=device)
        c.inside = wp.empty(padded, dtype=wp.uint8, device=device)
        inputs = self.inputs(encoder, c, outside=self.any_outside(max_x, max_y))
        blocks = padded // self.block
        smallest = 512 if all_cores else blocks
        launch(self.kernel, blocks, inputs, [], device=device, smallest=smallest)
        return c

    def inputs(self, encoder: Any, columns: Any, *, outside: bool) -> list[Any]:
        """Return the kernel's inputs, except the first block.

        ``encoder``: ``EncoderParams``. ``columns``: ``Columns``. ``outside``: whether events may lie outside the
        sensor. If none does and the lens has no distortion, the faster kernel for a pinhole camera is used, which reads
        the ellipse model's per-pixel table without a bounds check.
        """
        camera = self._camera if outside else self._pinhole
        return [self._model, camera, self._limits, encoder, self._azimuths, columns]
