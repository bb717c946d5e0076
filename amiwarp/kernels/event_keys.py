"""Keys of simulated events: joined, shifted in time, counted, and converted to events with ground truth.

:mod:`amiwarp.kernels.pixels` describes the keys.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.mirror import MirrorParams
from amiwarp.kernels.pixels import LAG_ZERO, LARGEST_LAG, LOW_BITS, LOW_MASK, TICKS, Sink
from amiwarp.kernels.prism_view import Steps, View, ray_without_prisms
from amiwarp.kernels.refraction import compensate

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


@wp.func
def true_angle(steps: Steps, angle: wp.array(dtype=float), turn: wp.array(dtype=float), at: int) -> float:
    """Return one of the true angles of ``steps`` at a time since the first instant of the table [ticks]."""
    k = wp.clamp(at / steps.ticks, 0, steps.margin + steps.count)
    return angle[k] + turn[k] * float(at - k * steps.ticks) / float(steps.ticks)


@wp.func
def azimuth_at(steps: Steps, angle: wp.array(dtype=float), turn: wp.array(dtype=float), at: int) -> wp.vec2:
    """Return (cos, sin) of the true azimuth of a prism at a time since the first instant of the table [ticks].

    ``angle`` and ``turn`` are those of one prism in ``steps``.
    """
    azimuth = true_angle(steps, angle, turn, at)
    return wp.vec2(wp.cos(azimuth), wp.sin(azimuth))


@wp.func
def true_state(model: Any, steps: Steps, at: int) -> wp.vec2:
    """Return the true state of an optic without glass at a time since the first instant of the table [ticks]."""
    return azimuth_at(steps, steps.angle, steps.turn, at)


@wp.func
def true_state(model: MirrorParams, steps: Steps, at: int) -> wp.vec2:
    """Return the true state of a mirror: the angles of both commands, phases included [rad]."""
    first = true_angle(steps, steps.angle, steps.turn, at)
    return wp.vec2(first, true_angle(steps, steps.second_angle, steps.second_turn, at))


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
    ray = pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    w = azimuth_at(steps, steps.angle, steps.turn, at)
    w2 = azimuth_at(steps, steps.second_angle, steps.second_turn, at)
    block.points[i] = ray_to_pixel(view.camera, ray_without_prisms(view.prism, view.second, ray, w, w2))


@wp.kernel
def find_points_at_rest(
    model: Any, camera: CameraParams, steps: Steps, block: Block, start: int, points: wp.array(dtype=wp.vec2)
):
    """Find the pixel that each event's scene point has if camera or mirror do not move as ``model`` says."""
    i = start + wp.tid()
    points[i] = compensate(model, camera, block.points[i], true_state(model, steps, block.ticks[i]))


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


# Readout of the simulated sensor: rows that are read one after the other, and a bus with a queue of finite length.

PS_PER_US = wp.constant(wp.int64(1000000))
LAG_BIT = wp.constant(3)  # lowest bit of the lag in a key


@wp.struct
class RowScan:
    """Scan of the sensor's rows one after the other, without a pause."""

    row_ps: wp.int64  # time to read a row [ps]
    scan_ps: wp.int64  # time to read all rows [ps]
    origin: wp.int64  # time of a key's tick 0 since the first scan [us]
    width: int  # width of the sensor [px]
    shift: int  # bit position of the time in a key


@wp.func
def time_of_row(scan: RowScan, row: int, t: wp.int64) -> wp.int64:
    """Return the time at which a row is read next, at or after ``t`` [us], rounded up [us]."""
    phase = wp.int64(row) * scan.row_ps
    passed = wp.max((t + scan.origin) * PS_PER_US - phase, wp.int64(0))
    scans = (passed + scan.scan_ps - wp.int64(1)) / scan.scan_ps
    read = scans * scan.scan_ps + phase
    return (read + PS_PER_US - wp.int64(1)) / PS_PER_US - scan.origin


@wp.kernel
def stamp_rows(scan: RowScan, keys: wp.array(dtype=wp.int64), start: int):
    """Replace the time stamp of each key by the time at which its row is read; the time of its crossing stays."""
    i = start + wp.tid()
    key = keys[i]
    t = key >> wp.int64(scan.shift)
    low = key - (t << wp.int64(scan.shift))
    row = int(low >> wp.int64(LOW_BITS)) / scan.width
    read = time_of_row(scan, row, t)
    reversed_lag = (low & wp.int64(LOW_MASK)) >> wp.int64(LAG_BIT)
    shorter = wp.min((read - t) * wp.int64(TICKS), reversed_lag)
    keys[i] = (read << wp.int64(scan.shift)) + low - (shorter << wp.int64(LAG_BIT))


@wp.struct
class Bus:
    """Bus of the sensor, which transmits one event at a time."""

    event_ps: wp.int64  # time to transmit an event [ps]
    longest_ps: wp.int64  # longest time in the queue [ps]; events that would wait longer are lost
    row: int  # pixels of a row whose events share a time stamp; 0 if every event has its own


@wp.kernel
def queue_events(
    bus: Bus,
    t: wp.array(dtype=wp.int64),
    pixel: wp.array(dtype=int),
    free: wp.array(dtype=wp.int64),
    stamp: wp.array(dtype=wp.int64),
):
    """Transmit events in order, in one thread: ``stamp`` is the time of transmission [us], or -1 for a lost event.

    ``free`` holds the time at which the bus becomes free [ps].
    """
    until = free[0]
    for i in range(t.shape[0]):
        now = t[i] * PS_PER_US
        stamp[i] = wp.int64(-1)
        if until - now <= bus.longest_ps:
            begin = wp.max(until, now)
            stamp[i] = begin / PS_PER_US
            if bus.row > 0 and i > 0:
                if t[i - 1] == t[i] and pixel[i - 1] / bus.row == pixel[i] / bus.row and stamp[i - 1] >= wp.int64(0):
                    stamp[i] = stamp[i - 1]
            until = begin + bus.event_ps
    free[0] = until
