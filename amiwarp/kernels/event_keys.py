"""Keys of simulated events: joined, shifted in time, counted, and converted to events with ground truth.

:mod:`amiwarp.kernels.event_generation` describes the keys.
"""

import warp as wp

from amiwarp.kernels.camera import pixel_to_ray, ray_to_pixel
from amiwarp.kernels.event_generation import LAG_ZERO, LARGEST_LAG, LOW_BITS, LOW_MASK, TICKS, Sink
from amiwarp.kernels.prism_view import Steps, View
from amiwarp.kernels.refraction import trace

wp.set_module_options({"enable_backward": False})


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


@wp.kernel
def unpack(view: View, steps: Steps, keys: wp.array(dtype=wp.int64), origin: wp.int64, start: int, block: Block):
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
    k = wp.clamp(at / steps.ticks, 0, steps.margin + steps.count)
    angle = steps.angle[k] + steps.turn[k] * float(at - k * steps.ticks) / float(steps.ticks)
    ray = pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    w = wp.vec2(wp.cos(angle), wp.sin(angle))
    block.points[i] = ray_to_pixel(view.camera, trace(view.prism, ray, w, view.prism.flat_to_scene))


@wp.kernel
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


@wp.kernel
def find(keys: wp.array(dtype=wp.int64), n: int, limit: wp.int64, found: wp.array(dtype=int)):
    """Find the number of sorted keys below ``limit``, by bisection in one thread."""
    low = wp.int32(0)
    high = int(n)
    while low < high:
        middle = (low + high) / 2
        if keys[middle] < limit:
            low = middle + 1
        else:
            high = middle
    found[0] = low
