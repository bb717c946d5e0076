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


@wp.kernel(module="unique", module_options=OPTIONS)
def find_points_at_rest(
    model: Any, camera: CameraParams, steps: Steps, block: Block, start: int, points: wp.array(dtype=wp.vec2)
):
    """Find the pixel that each event's scene point has if camera or mirror do not move as ``model`` says."""
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
    height: int  # height of the sensor [px]; the pixels of several cameras follow each other
    shift: int  # bit position of the time in a key


@wp.func
def time_of_row(scan: RowScan, row: int, t: wp.int64) -> wp.int64:
    """Return the time at which a row is read next, at or after ``t`` [us], rounded up [us]."""
    phase = wp.int64(row) * scan.row_ps
    passed = wp.max((t + scan.origin) * PS_PER_US - phase, wp.int64(0))
    scans = (passed + scan.scan_ps - wp.int64(1)) / scan.scan_ps
    read = scans * scan.scan_ps + phase
    return (read + PS_PER_US - wp.int64(1)) / PS_PER_US - scan.origin


@wp.kernel(module="unique", module_options=OPTIONS)
def stamp_rows(scan: RowScan, keys: wp.array(dtype=wp.int64), start: int):
    """Replace the time stamp of each key by the time at which its row is read; the time of its crossing stays."""
    i = start + wp.tid()
    key = keys[i]
    t = key >> wp.int64(scan.shift)
    low = key - (t << wp.int64(scan.shift))
    row = int(low >> wp.int64(LOW_BITS)) / scan.width % scan.height
    read = time_of_row(scan, row, t)
    reversed_lag = (low & wp.int64(LOW_MASK)) >> wp.int64(LAG_BIT)
    shorter = wp.min((read - t) * wp.int64(TICKS), reversed_lag)
    keys[i] = (read << wp.int64(scan.shift)) + low - (shorter << wp.int64(LAG_BIT))


@wp.struct
class Bus:
    """Bus of a sensor, which transmits one event at a time."""

    event_ps: wp.int64  # time to transmit an event [ps]
    longest_ps: wp.int64  # longest time in the queue [ps]; events that would wait longer are lost
    rows: int  # 1 if the events of a row that is read share a time stamp; 0 if every event has its own
    origin: wp.int64  # time from which picoseconds are counted [us]


@wp.func
def transmission(bus: Bus, now: wp.int64, until: wp.int64) -> wp.int64:
    """Return the time at which a bus that is busy ``until`` transmits an event of time ``now`` [ps], or -1 if lost."""
    if until - now > bus.longest_ps:
        return wp.int64(-1)
    return wp.max(until, now)


@wp.kernel(module="unique", module_options=OPTIONS)
def queue_events(
    bus: Bus,
    t: wp.array(dtype=wp.int64),
    row: wp.array(dtype=wp.uint16),
    first: wp.array(dtype=int),
    free: wp.array(dtype=wp.int64),
    stamp: wp.array(dtype=wp.int64),
):
    """Transmit events in order, one thread per sensor: ``stamp`` is the time of transmission [us], or -1 if lost.

    ``first``: index of each sensor's first event, and behind them the number of events. ``free`` holds the time at
    which each bus becomes free [ps since the origin].
    """
    sensor = wp.tid()
    until = free[sensor]
    for i in range(first[sensor], first[sensor + 1]):
        now = (t[i] - bus.origin) * PS_PER_US
        stamp[i] = wp.int64(-1)
        begin = transmission(bus, now, until)
        if begin >= wp.int64(0):
            stamp[i] = begin / PS_PER_US + bus.origin
            if bus.rows > 0 and i > first[sensor]:
                if t[i - 1] == t[i] and row[i - 1] == row[i] and stamp[i - 1] >= wp.int64(0):
                    stamp[i] = stamp[i - 1]
            until = begin + bus.event_ps
    free[sensor] = until


@wp.kernel(module="unique", module_options=OPTIONS)
def queue_keys(
    bus: Bus,
    shift: int,
    width: int,
    origin: wp.int64,
    duration: wp.int64,
    keys: wp.array(dtype=wp.int64),
    free: wp.array(dtype=wp.int64),
    stamp: wp.array(dtype=wp.int64),
    kept: wp.array(dtype=int),
):
    """Transmit the events of one sensor in order, as :func:`queue_events` does, given as ``keys``; one thread.

    ``keys`` and ``stamp`` keep the events that are transmitted before ``duration`` [us]; ``kept`` is their number.
    ``shift``: bit position of the time in a key; ``width``: width of the sensor [px]; ``origin``: time from which the
    times of keys are counted [us].
    """
    until = free[0]
    n = int(0)
    t_before = wp.int64(-1)
    row_before = wp.int64(-1)
    stamp_before = wp.int64(-1)
    for i in range(keys.shape[0]):
        key = keys[i]
        t = key >> wp.int64(shift)
        begin = transmission(bus, (t + origin) * PS_PER_US, until)
        at = wp.int64(-1)
        if begin >= wp.int64(0):
            at = begin / PS_PER_US
            until = begin + bus.event_ps
        if bus.rows > 0:
            row = ((key - (t << wp.int64(shift))) >> wp.int64(LOW_BITS)) / wp.int64(width)
            if at >= wp.int64(0) and t == t_before and row == row_before and stamp_before >= wp.int64(0):
                at = stamp_before
            t_before = t
            row_before = row
            stamp_before = at
        if at >= wp.int64(0) and at < duration:
            keys[n] = key
            stamp[n] = at
            n += 1
    free[0] = until
    kept[0] = n


# Events of many cameras: sorted by camera, then by time.
#
# The kernels that simulate pixels write keys whose pixel counts through all cameras. They are converted to keys of
# ``part | camera | time | pixel | reversed lag | polarity``. The part is 0 for events of the chunk, 1 for later ones,
# and 2 for those of cameras that start anew, which are dropped. Only a row scan needs the lag; without one, it is left
# out.

CAMERA_LOW_BITS = wp.constant(wp.int64(20))  # lowest bits of a key with a lag: reversed lag (19) and polarity (1)


@wp.struct
class CameraKeys:
    """Layout of the keys of the events of many cameras, and the chunk that they belong to."""

    pixels: int  # number of pixels of a camera
    width: int  # width of a camera [px]
    shift: int  # bit position of the time in a key that counts through all pixels
    pixel: int  # bit position of the pixel in a key that is sorted by camera
    time: int  # bit position of the time in a key that is sorted by camera
    camera: int  # bit position of the camera
    part: int  # bit position of the part
    length: wp.int64  # length of the chunk [us]


@wp.func
def low_mask(layout: CameraKeys) -> wp.int64:
    """Return the mask of the bits below the pixel of a key that is sorted by camera."""
    return (wp.int64(1) << wp.int64(layout.pixel)) - wp.int64(1)


@wp.kernel(module="unique", module_options=OPTIONS)
def sort_by_camera(layout: CameraKeys, starts: wp.array(dtype=wp.uint8), keys: wp.array(dtype=wp.int64), start: int):
    """Convert keys that count through the pixels of all cameras to keys that are sorted by camera."""
    i = start + wp.tid()
    t = keys[i] >> wp.int64(layout.shift)
    low = int(keys[i] & wp.int64(LOW_MASK))
    index = int((keys[i] - (t << wp.int64(layout.shift))) >> wp.int64(LOW_BITS))
    camera = index / layout.pixels
    part = wp.where(starts[camera] != wp.uint8(0), 2, wp.where(t < layout.length, 0, 1))
    key = wp.int64(part) << wp.int64(layout.part) | wp.int64(camera) << wp.int64(layout.camera)
    key = key | t << wp.int64(layout.time) | wp.int64(index - camera * layout.pixels) << wp.int64(layout.pixel)
    keys[i] = key | (wp.int64((low >> LAG_BIT) << 1 | (low & 1)) & low_mask(layout))


@wp.func
def camera_of(layout: CameraKeys, key: wp.int64) -> int:
    """Return the camera of a key that is sorted by camera."""
    return int(
        (key >> wp.int64(layout.camera)) & ((wp.int64(1) << wp.int64(layout.part - layout.camera)) - wp.int64(1))
    )


@wp.func
def time_of(layout: CameraKeys, key: wp.int64) -> wp.int64:
    """Return the time of a key that is sorted by camera, since the start of its chunk [us]."""
    bits = wp.int64(layout.camera - layout.time)
    return (key >> wp.int64(layout.time)) & ((wp.int64(1) << bits) - wp.int64(1))


@wp.func
def pixel_of(layout: CameraKeys, key: wp.int64) -> int:
    """Return the pixel of a key that is sorted by camera, in its camera."""
    bits = wp.int64(layout.time - layout.pixel)
    return int((key >> wp.int64(layout.pixel)) & ((wp.int64(1) << bits) - wp.int64(1)))


@wp.kernel(module="unique", module_options=OPTIONS)
def carry_over(layout: CameraKeys, keys: wp.array(dtype=wp.int64), start: int):
    """Convert keys that are sorted by camera to keys of the next chunk that count through the pixels of all cameras.

    Counterpart of :func:`sort_by_camera`; the cause is lost, and without a row scan the lag.
    """
    i = start + wp.tid()
    key = keys[i]
    low = int(key & low_mask(layout))
    index = camera_of(layout, key) * layout.pixels + pixel_of(layout, key)
    t = time_of(layout, key) - layout.length
    kept = wp.int64((low >> 1) << LAG_BIT | (low & 1))
    keys[i] = t << wp.int64(layout.shift) | wp.int64(index) << wp.int64(LOW_BITS) | kept


@wp.kernel(module="unique", module_options=OPTIONS)
def find_cameras(
    layout: CameraKeys, keys: wp.array(dtype=wp.int64), n: int, cameras: int, start: int, found: wp.array(dtype=int)
):
    """Find the first event of each camera in ``n`` sorted keys, then the end of part 0, then that of part 1."""
    k = start + wp.tid()
    limit = wp.int64(k) << wp.int64(layout.camera)
    if k >= cameras:
        limit = wp.int64(k - cameras + 1) << wp.int64(layout.part)
    found[k] = count_below(keys, n, limit)


@wp.kernel(module="unique", module_options=OPTIONS)
def unpack_cameras(
    layout: CameraKeys, keys: wp.array(dtype=wp.int64), origin: wp.int64, start: int,
    x: wp.array(dtype=wp.uint16), y: wp.array(dtype=wp.uint16), t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
):  # fmt: skip
    """Convert keys that are sorted by camera to events. ``origin``: time of the start of the chunk [us]."""
    i = start + wp.tid()
    pixel = pixel_of(layout, keys[i])
    row = pixel / layout.width
    x[i] = wp.uint16(pixel - row * layout.width)
    y[i] = wp.uint16(row)
    t[i] = time_of(layout, keys[i]) + origin
    p[i] = wp.uint8(keys[i] & wp.int64(1))


# Selection of events on the device.


@wp.kernel(module="unique", module_options=OPTIONS)
def mark_first_of_pixel(keys: wp.array(dtype=wp.int64), start: int, kept: wp.array(dtype=int)):
    """Mark the first of the successive keys with the same camera, time and pixel with 1, the others with 0.

    The keys have a lag.
    """
    i = start + wp.tid()
    before = keys[wp.max(i - 1, 0)] >> CAMERA_LOW_BITS
    kept[i] = wp.where(i == 0 or before != keys[i] >> CAMERA_LOW_BITS, 1, 0)


@wp.kernel(module="unique", module_options=OPTIONS)
def mark_transmitted(stamp: wp.array(dtype=wp.int64), start: int, kept: wp.array(dtype=int)):
    """Mark the events that the bus transmits with 1, the lost ones with 0."""
    i = start + wp.tid()
    kept[i] = wp.where(stamp[i] >= wp.int64(0), 1, 0)


@wp.kernel(module="unique", module_options=OPTIONS)
def keep_marked(values: wp.array(dtype=Any), ends: wp.array(dtype=int), start: int, out: wp.array(dtype=Any)):
    """Copy the values that are marked. ``ends``: number of marked values up to and including each one."""
    i = start + wp.tid()
    before = int(0)
    if i > 0:
        before = ends[i - 1]
    if ends[i] > before:
        out[before] = values[i]


@wp.kernel(module="unique", module_options=OPTIONS)
def count_before(ends: wp.array(dtype=int), start: int, index: wp.array(dtype=int)):
    """Replace indices of values by the number of marked values before them; see :func:`keep_marked`."""
    k = start + wp.tid()
    at = index[k]
    before = int(0)
    if at > 0:
        before = ends[at - 1]
    index[k] = before


for _dtype in (wp.uint8, wp.uint16, wp.int64):
    wp.overload(keep_marked, {"values": wp.array(dtype=_dtype), "out": wp.array(dtype=_dtype)})
