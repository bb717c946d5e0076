"""Device side of the simulator: one thread a pixel walks through the steps of a chunk and writes its events as keys.

Times are ticks of 1/16 us since the chunk's start, in integers: nothing depends on where a chunk begins. An event is an
int64 key, ``time | pixel | reversed lag | polarity``, so that sorting the keys makes the stream whatever the order in
which threads wrote it.
"""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.optics import ExactParams, enter_tilted_face, leave_tilted_face, trace

wp.set_module_options({"enable_backward": False})

TICKS = wp.constant(16)  # per microsecond
HALF_TICKS = wp.constant(8)
TICK_BITS = wp.constant(4)
LOW_BITS = wp.constant(
    20
)  # of a key: lag (19) and polarity; then the pixel, in as many bits as it needs; then the time
LOW_MASK = wp.constant((1 << 20) - 1)
LARGEST_LAG = wp.constant((1 << 19) - 1)
LAG_ZERO = wp.constant(16)  # ticks added to the lag: rounding a stamp may make it slightly negative
NEVER = wp.constant(wp.int64(-(1 << 60)))
NO_NOISE = wp.constant(wp.int64(1 << 60))
SMALLEST_THRESHOLD = wp.constant(0.1)  # of the nominal one: mismatch never makes a threshold vanish
BEYOND = wp.constant(2.0)  # a fraction of a step past its end
NAN = wp.constant(float("nan"))


@wp.struct
class SensorParams:
    on: float  # nominal thresholds, log intensity
    off: float
    mismatch: float  # relative standard deviation of both thresholds
    leak: float  # thresholds per step
    noise: float  # events per tick
    hot_fraction: float
    hot: float  # events per tick
    refractory: wp.int64  # ticks
    latency: float  # ticks
    jitter: float  # ticks, standard deviation


@wp.struct
class Pixel:
    """What one pixel remembers."""

    level: float  # log intensity at the last step
    reference: float  # log intensity that changes are measured against
    on: float  # its own thresholds
    off: float
    noise: float  # its own rate of noise, events per tick
    rng: wp.uint32
    blind_until: wp.int64  # end of the refractory time; NEVER when over
    next_noise: wp.int64
    last_stamp: wp.int64  # us


@wp.struct
class View:
    """What the pixels look at: camera, prism, picture maps."""

    camera: CameraParams
    prism: ExactParams
    maps: wp.array(dtype=wp.vec4)  # log intensity, as the four numbers of each texel's bilinear piece; slot by slot
    width: int  # of a map
    height: int


@wp.struct
class Step:
    """An instant: the end of one step and the start of the next."""

    azimuth: wp.vec2  # cos, sin of the true tilt azimuth
    to_texel: wp.mat33  # prism's frame to homogeneous texel coordinates
    before: int  # slots of the maps before and after this time
    after: int
    weight: float  # of the one after


@wp.struct
class Steps:
    """A chunk's table of instants, equally spaced; entry ``margin`` is the chunk's start."""

    at: wp.array(dtype=Step)
    angle: wp.array(dtype=float)  # true tilt azimuth [rad]
    turn: wp.array(dtype=float)  # its change until the next instant
    margin: int
    count: int
    ticks: int  # per step
    per_tick: float  # steps
    shift: int  # of the time in a key: above the bits of the pixel


@wp.struct
class Sink:
    """Where keys go: pixels share segments, each with room and a counter of its own.

    On a CPU a segment is a run of pixels that belongs to one thread; on CUDA neighbours count apart, for one counter
    for all, or for a whole warp, would be the bottleneck.
    """

    keys: wp.array2d(dtype=wp.int64)  # segment, place
    count: wp.array(dtype=int)  # events of each segment, also those that found no room
    run: int  # consecutive pixels in a segment


@wp.struct
class Block:
    """Events taken out of their keys."""

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    t: wp.array(dtype=wp.int64)
    p: wp.array(dtype=wp.uint8)
    points: wp.array(dtype=wp.vec2)


# -- what a pixel sees


@wp.func
def mirror(x: float, size: int) -> float:
    """Texel coordinate reflected at the map's edges."""
    last = float(size - 1)
    if x >= 0.0 and x <= last:
        return x
    r = wp.abs(x)
    r = r - 2.0 * last * wp.floor(r / (2.0 * last))
    return wp.min(r, 2.0 * last - r)


@wp.func
def piece(view: View, slot: int, x: float, y: float) -> float:
    """Bilinear look-up: one load."""
    col = wp.min(int(x), view.width - 2)
    row = wp.min(int(y), view.height - 2)
    c = view.maps[(slot * view.height + row) * view.width + col]
    fx = x - float(col)
    return c[0] + fx * c[1] + (y - float(row)) * (c[2] + fx * c[3])


@wp.func
def look(view: View, h: wp.vec3, before: int, after: int, weight: float) -> float:
    """Log intensity at homogeneous texel coordinates, between the maps in two slots."""
    if not (h[2] > 1.0e-3):
        return NAN
    x = mirror(h[0] / h[2], view.width)
    y = mirror(h[1] / h[2], view.height)
    level = piece(view, before, x, y)
    if weight > 0.0:
        level += weight * (piece(view, after, x, y) - level)
    return level


@wp.func
def see(view: View, step: Step, local: wp.vec3) -> float:
    """Log intensity that a bearing (in the prism's frame) meets at an instant; NaN where it has no ray."""
    if view.prism.flat_to_scene == 1:
        ray = enter_tilted_face(view.prism, local, step.azimuth)
    else:
        ray = leave_tilted_face(view.prism, local, step.azimuth)
    return look(view, step.to_texel * ray, step.before, step.after, step.weight)


@wp.func
def local_ray(view: View, index: int) -> wp.vec3:
    """Bearing of a pixel in the prism's frame."""
    row = index / view.camera.width
    col = index - row * view.camera.width
    return wp.transpose(view.prism.axis) * pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))


# -- what it does about it


@wp.func
def crossing(reference: float, on: float, off: float, level: float, slope: float) -> float:
    """Fraction of the step at which the level next crosses a threshold; past the step if it does not."""
    if slope > 0.0:
        return (reference + on - level) / slope
    if slope < 0.0:
        return (reference - off - level) / slope
    return BEYOND


@wp.func
def waiting(rate: float, uniform: float) -> wp.int64:
    """Exponential waiting time [ticks] until the next event of a Poisson process."""
    if rate > 0.0:
        return wp.int64(1.0 - wp.log(1.0 - uniform) / rate)
    return NO_NOISE


@wp.func
def write(sink: Sink, shift: int, index: int, t: wp.int64, stamp: wp.int64, on: int):
    """Append the key of an event that happened at tick ``t`` and is stamped ``stamp`` [us]."""
    lag = wp.clamp(int(stamp * wp.int64(TICKS) - t) + LAG_ZERO, 0, LARGEST_LAG)
    segment = (index / sink.run) % sink.keys.shape[0]
    place = wp.atomic_add(sink.count, segment, 1)
    if place < sink.keys.shape[1]:
        low = wp.int64(index) << wp.int64(LOW_BITS) | wp.int64((LARGEST_LAG - lag) << 1 | on)
        sink.keys[segment, place] = stamp << wp.int64(shift) | low


@wp.func
def react(
    p: Pixel, s: SensorParams, sink: Sink, index: int, t0: wp.int64, steps: Steps, slope: float, quiet: bool
) -> Pixel:
    """All events of one step in which the level (less the leaking reference) rises by ``slope``.

    The struct changes by field only: reassigned under a condition it would no longer live in registers.
    """
    f = wp.where(quiet, BEYOND, 0.0)
    while f < 1.0:
        if p.blind_until > NEVER:  # the reference starts afresh where the refractory time ends
            f = wp.max(f, float(p.blind_until - t0) * steps.per_tick)
            if f < 1.0:
                p.reference = p.level + f * slope
                p.blind_until = NEVER
        signal = wp.max(crossing(p.reference, p.on, p.off, p.level, slope), f)
        f = wp.min(signal, wp.max(float(p.next_noise - t0) * steps.per_tick, f))
        if f < 1.0:
            rng = p.rng
            noise = f < signal
            on = int(slope > 0.0)
            if noise:
                on = int(wp.randf(rng) < 0.5)
                p.reference = p.level + f * slope
            else:
                p.reference += wp.where(on == 1, p.on, -p.off)
            t = t0 + wp.int64(f * float(steps.ticks))
            latency = s.latency
            if s.jitter > 0.0:  # nearly Gaussian, within 3.5 standard deviations: four uniforms
                four = wp.randf(rng) + wp.randf(rng) + wp.randf(rng) + wp.randf(rng)
                latency = wp.max(latency + s.jitter * 1.7320508 * (four - 2.0), 0.0)
            stamp = (t + wp.int64(latency) + wp.int64(HALF_TICKS)) >> wp.int64(TICK_BITS)
            stamp = wp.max(stamp, p.last_stamp + wp.int64(1))
            write(sink, steps.shift, index, t, stamp, on)
            p.last_stamp = stamp
            if s.refractory > wp.int64(0):
                p.blind_until = t + s.refractory
            if noise or p.next_noise < p.blind_until:
                p.next_noise = wp.max(t, p.blind_until) + waiting(p.noise, wp.randf(rng))
            p.rng = rng
    return p


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def reconverge():
    """Bring a warp back together: after an event its lanes would else run apart to the end of the chunk."""


@wp.kernel
def start_pixels(view: View, steps: Steps, sensor: SensorParams, seed: int, start: int, pixels: wp.array(dtype=Pixel)):
    """Every pixel's own thresholds and noise; its reference is the level, less what has leaked by then."""
    i = start + wp.tid()
    rng = wp.rand_init(seed, i)
    p = Pixel()
    p.level = see(view, steps.at[steps.margin], local_ray(view, i))
    p.on = sensor.on * wp.max(1.0 + sensor.mismatch * wp.randn(rng), SMALLEST_THRESHOLD)
    p.off = sensor.off * wp.max(1.0 + sensor.mismatch * wp.randn(rng), SMALLEST_THRESHOLD)
    p.noise = sensor.noise
    if wp.randf(rng) < sensor.hot_fraction:
        p.noise = sensor.noise + sensor.hot
    leaked = wp.randf(rng)
    p.reference = p.level
    if sensor.leak > 0.0:
        p.reference = p.level - leaked * p.on
    p.blind_until = NEVER
    p.last_stamp = wp.int64(-1)
    p.next_noise = waiting(p.noise, wp.randf(rng))
    p.rng = rng
    pixels[i] = p


@wp.kernel
def run_pixels(view: View, steps: Steps, sensor: SensorParams, pixels: wp.array(dtype=Pixel), start: int, sink: Sink):
    i = start + wp.tid()
    p = pixels[i]
    ray = local_ray(view, i)
    drift = sensor.leak * p.on
    length = wp.int64(steps.ticks)
    t0 = wp.int64(0)
    for k in range(steps.count):
        level = see(view, steps.at[steps.margin + k + 1], ray)
        end = level + drift
        within = end < p.reference + p.on and end > p.reference - p.off
        quiet = within and p.blind_until == NEVER and p.next_noise >= t0 + length
        p = react(p, sensor, sink, i, t0, steps, end - p.level, quiet)
        p.level = level
        p.reference -= drift
        t0 += length
        reconverge()
    if p.blind_until > NEVER:
        p.blind_until -= t0
    p.next_noise -= t0
    p.last_stamp -= t0 >> wp.int64(TICK_BITS)
    pixels[i] = p


# -- keys to events


@wp.kernel
def unpack(view: View, steps: Steps, keys: wp.array(dtype=wp.int64), origin: wp.int64, start: int, block: Block):
    """Event ``i`` of sorted keys, and its point without the prism: compensated at the true angle of its crossing."""
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
    lag = LARGEST_LAG - (low >> 1) - LAG_ZERO
    at = int(t) * TICKS - lag + steps.margin * steps.ticks
    k = wp.clamp(at / steps.ticks, 0, steps.margin + steps.count)
    angle = steps.angle[k] + steps.turn[k] * float(at - k * steps.ticks) / float(steps.ticks)
    ray = pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    w = wp.vec2(wp.cos(angle), wp.sin(angle))
    block.points[i] = ray_to_pixel(view.camera, trace(view.prism, ray, w, view.prism.flat_to_scene))


@wp.kernel
def scene_bearings(
    camera: CameraParams,
    prism: ExactParams,
    xy: wp.array(dtype=wp.vec2),
    theta: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=wp.vec3),
):
    """Bearing in the camera's frame of what a pixel sees at tilt azimuth ``theta``."""
    i = start + wp.tid()
    w = wp.vec2(wp.cos(theta[i]), wp.sin(theta[i]))
    out[i] = trace(prism, pixel_to_ray(camera, xy[i]), w, prism.flat_to_scene)


@wp.kernel
def see_without_prism(view: View, to_texel: wp.mat33, start: int, out: wp.array(dtype=float)):
    """Log intensity at each pixel with no prism, in the first map; NaN where it has no ray."""
    i = start + wp.tid()
    row = i / view.camera.width
    col = i - row * view.camera.width
    h = to_texel * pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    out[i] = look(view, h, 0, 0, 0.0)


@wp.kernel
def pack(sink: Sink, offset: wp.array(dtype=int), out: wp.array(dtype=wp.int64)):
    """Join the segments: segment ``i`` begins at ``offset[i]``."""
    segment, place = wp.tid()
    if place < sink.count[segment]:
        out[offset[segment] + place] = sink.keys[segment, place]


@wp.kernel
def rebase(keys: wp.array(dtype=wp.int64), passed: wp.int64):
    """Take the time of a chunk that has ended off the keys of events that come after it."""
    i = wp.tid()
    keys[i] -= passed


@wp.kernel
def find(keys: wp.array(dtype=wp.int64), n: int, limit: wp.int64, found: wp.array(dtype=int)):
    """Number of sorted keys below ``limit``: a bisection by one thread."""
    low = wp.int32(0)
    high = int(n)
    while low < high:
        middle = (low + high) / 2
        if keys[middle] < limit:
            low = middle + 1
        else:
            high = middle
    found[0] = low
