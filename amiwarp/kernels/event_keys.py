"""Keys of simulated events: joined, shifted in time, counted, and converted to events with ground truth.

:mod:`amiwarp.kernels.pixels` describes the keys.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.pixels import LAG_ZERO, LARGEST_LAG, LOW_BITS, LOW_MASK, TICKS, Sink
from amiwarp.kernels.prism_view import Steps, View, ray_without_prisms
from amiwarp.kernels.refraction import compensate, state_of_angles

OPTIONS = {"enable_backward": False}
wp.set_module_options(OPTIONS)


@wp.struct
class Block:
    """Columns of simulated events that were unpacked from their keys."""

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    t: wp.array(dtype=wp.int64)
    p: wp.array(dtype=wp.uint8)
    cause: wp.array(dtype=wp.uint8)
    points: wp.array(dtype=wp.vec2)
    ticks: wp.array(dtype=int)  # time of the crossing since the first instant of the table


@wp.func
def true_angle(
    steps: Steps, angle: wp.array(dtype=float), turn: wp.array(dtype=float), at: int
) -> float:
    """Return one of the true angles of ``steps`` at a time since the first instant of the table [ticks]."""
    k = wp.clamp(at / steps.ticks, 0, steps.margin + steps.count)
    return angle[k] + turn[k] * float(at - k * steps.ticks) / float(steps.ticks)


@wp.func
def azimuth_at(
    steps: Steps, angle: wp.array(dtype=float), turn: wp.array(dtype=float), at: int
) -> wp.vec2:
    """Return (cos, sin) of the true azimuth of a prism at a time since the first instant of the table [ticks].

    ``angle`` and ``turn`` belong to one prism in ``steps``.
    """
    azimuth = true_angle(steps, angle, turn, at)
    return wp.vec2(wp.cos(azimuth), wp.sin(azimuth))


@wp.func
def true_state(model: Any, steps: Steps, at: int) -> wp.vec2:
    """Return the true state of an optic without glass at a time since the first instant of the table [ticks]."""
    first = true_angle(steps, steps.angle, steps.turn, at)
    second = true_angle(steps, steps.second_angle, steps.second_turn, at)
    return state_of_angles(model, first, second)


@wp.kernel
def unpack(
    view: View,
    steps: Steps,
    keys: wp.array(dtype=wp.int64),
    origin: wp.int64,
    start: int,
    block: Block,
):
    """Unpack event ``i`` of the sorted keys, and compensate it with the true prism angle at its crossing."""
    i = start + wp.tid()
    key = keys[i]
    t = key >> wp.int64(steps.shift)
    low = int(key & wp.int64(LOW_MASK))
    index = int((key - (t << wp.int64(steps.shift))) >> wp.int64(LOW_BITS))
    row = index / view.camera.width
    col = index - row * view.camera.width
    block.x[i] = wp.uint16(col)
    block.y[i] = wp.uint16(row)
    block.t[i] = t + origin
    block.p[i] = wp.uint8(low & 1)
    block.cause[i] = wp.uint8((low >> 1) & 3)
    lag = LARGEST_LAG - (low >> 3) - LAG_ZERO
    at = int(t) * TICKS - lag + steps.margin * steps.ticks
    block.ticks[i] = at
    ray = pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    w = azimuth_at(steps, steps.angle, steps.turn, at)
    w2 = azimuth_at(steps, steps.second_angle, steps.second_turn, at)
    block.points[i] = ray_to_pixel(
        view.camera, ray_without_prisms(view.prism, view.second, 0, ray, w, w2)
    )


@wp.kernel(module="unique", module_options=OPTIONS)
def find_points_at_rest(
    model: Any,
    camera: CameraParams,
    steps: Steps,
    block: Block,
    start: int,
    points: wp.array(dtype=wp.vec2),
):
    """Find the pixel that each event's scene point has if the optic does not move as ``model`` says."""
    i = start + wp.tid()
    points[i] = compensate(model, camera, block.points[i], true_state(model, steps, block.ticks[i]))


@wp.kernel(module="unique", module_options=OPTIONS)
def pack(sink: Sink, offset: wp.array(dtype=int), out: wp.array(dtype=wp.int64)):
    """Join the segments of keys without gaps: segment ``i`` begins at ``offset[i]``."""
    segment, place = wp.tid()
    if place < sink.count[segment, 0]:
        out[offset[segment] + place] = sink.keys[segment, place]


@wp.kernel
def rebase(keys: wp.array(dtype=wp.int64), passed: wp.int64):
    """Subtract the duration of a finished chunk from the times in keys of later events."""
    i = wp.tid()
    keys[i] -= passed


@wp.func
def count_below(keys: wp.array(dtype=wp.int64), n: int, limit: wp.int64) -> int:
    """Return the number of the first ``n`` keys, which are sorted, that are below ``limit``."""
    low = wp.int32(0)
    high = int(n)
    while low < high:
        middle = (low + high) / 2
        if keys[middle] < limit:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel(module="unique", module_options=OPTIONS)
def find(keys: wp.array(dtype=wp.int64), n: int, limit: wp.int64, found: wp.array(dtype=int)):
    """Find the number of sorted keys below ``limit``, in one thread."""
    found[0] = count_below(keys, n, limit)
