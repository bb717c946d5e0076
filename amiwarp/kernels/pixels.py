"""Event generation of the simulator: one thread per pixel steps through a chunk and writes the events as keys.

Times are ticks of 1/16 us since the start of the chunk, in integers, so that results do not depend on where a chunk
begins. An event is an int64 key, ``time | pixel | reversed lag | polarity``. Sorted keys give the same stream for any
order of the threads.
"""

import warp as wp

from amiwarp.kernels.prism_view import (
    AHEAD,
    Steps,
    View,
    levels_ahead,
    locate_texels,
    ray_in_prism_frame,
    see_level,
    texels_ahead,
)

OPTIONS = {"enable_backward": False}
wp.set_module_options(OPTIONS)


TICKS = wp.constant(16)  # ticks per microsecond
HALF_TICKS = wp.constant(8)
TICK_BITS = wp.constant(4)

# Lowest bits of a key: lag (19), cause (2), polarity (1); pixel and time are above them
LOW_BITS = wp.constant(22)
LOW_MASK = wp.constant((1 << 22) - 1)
LAG_BIT = wp.constant(3)
SIGNAL = wp.constant(0)  # codes of the causes of an event, as in amiwarp.Cause
SHOT_NOISE = wp.constant(1)
LEAK = wp.constant(2)
HOT_PIXEL = wp.constant(3)

# An ON event is a leak if the level rises by less than this multiple of the drift
LEAK_SHARE = wp.constant(1.5)

# Smallest leak relative to the mean leak, so that jitter cannot stop the leak
SMALLEST_LEAK = wp.constant(0.1)
LARGEST_LAG = wp.constant((1 << 19) - 1)

# Ticks added to the lag, because rounding a time stamp may make the lag slightly negative
LAG_ZERO = wp.constant(16)
NEVER = wp.constant(wp.int64(-(1 << 60)))
NO_NOISE = wp.constant(wp.int64(1 << 60))

# Smallest threshold relative to the nominal one, which mismatch cannot undercut
SMALLEST_THRESHOLD = wp.constant(0.1)
UNREACHED = wp.constant(1.0e6)  # threshold of a dead pixel [log intensity], which no light crosses
PAST_STEP = wp.constant(2.0)  # fraction of a step that means: after the end of the step


@wp.struct
class SensorParams:
    """Sensor parameters in the units of the simulator."""

    on: float  # nominal ON threshold [log intensity]
    off: float  # nominal OFF threshold [log intensity]
    mismatch: float  # relative standard deviation of both thresholds
    leak: float  # mean leak [thresholds per step]
    leak_jitter: float  # relative standard deviation of the leak between two events of a pixel
    noise: float  # shot noise in the dark [events per tick]
    noise_white: float  # shot noise at white, relative to that in the dark
    spread: float  # standard deviation of ln(leak) and ln(shot noise) between pixels
    hot_fraction: float  # fraction of the pixels that are hot
    hot: float  # rate of additional random events of hot pixels [events per tick]
    refractory: wp.int64  # refractory period [ticks]
    latency: float  # mean latency [ticks]
    jitter: float  # standard deviation of the latency [ticks]
    bandwidth: float  # photoreceptor's angular cut-off frequency per unit of exp(level) [1/step]
    buffer: float  # angular cut-off frequency of its second stage [1/step]; 0 for none
    dark: float  # luminance added before the logarithm


@wp.struct
class Pixel:
    """State of one simulated pixel."""

    level: float  # level at the last step, after the photoreceptor [log intensity]
    reference: float  # reference level [log intensity]
    on: float  # ON threshold of this pixel [log intensity]
    off: float  # OFF threshold of this pixel [log intensity]
    leak: float  # leak of this pixel, without jitter, relative to the mean leak; 0 for a dead pixel
    noise: float  # shot noise of this pixel in the dark [events per tick]
    hot: float  # rate of additional random events if the pixel is hot [events per tick], else 0
    jitter: (
        float  # present leak relative to the leak without jitter; drawn from the generator's state
    )
    light: float  # exponential of the last log intensity that entered the photoreceptor
    rng: wp.uint32  # state of the random number generator
    blind_until: wp.int64  # end of the refractory period; NEVER if it has passed
    next_noise: wp.int64  # time of the next random event; NO_NOISE for none
    last_stamp: wp.int64  # time stamp of the pixel's last event [us]


@wp.struct
class Interval:
    """Time interval over which a pixel is advanced: a step, or one of the equal pieces of a step."""

    ticks: int  # length of the interval [ticks]
    per_tick: float  # length of a tick in units of the interval
    share: float  # length of the interval [steps]
    drift: float  # change of the reference in the interval at the present leak [log intensity]
    shift: int  # bit position of the time in a key


@wp.struct
class Sink:
    """Destination of the event keys: segments with limited room, each with a counter of events.

    On a CPU a segment is a run of pixels of one thread. On CUDA neighbouring pixels use different segments, because one
    counter for all pixels, or for all of a warp, would be the bottleneck.
    """

    keys: wp.array2d(dtype=wp.int64)  # keys of the events; axes: segment, position in the segment
    # First column: events of each segment, including those that did not fit
    count: wp.array2d(dtype=int)
    run: int  # number of consecutive pixels that share a segment


@wp.func
def jittered_leak(p: Pixel, s: SensorParams) -> float:
    """Return a pixel's leak [thresholds per step]."""
    return s.leak * p.leak * p.jitter


@wp.func
def leak_factor(s: SensorParams, state: wp.uint32) -> float:
    """Return the ratio of a pixel's leak to its mean at a state of the generator, which changes at every event."""
    factor = float(1.0)
    if s.leak_jitter > 0.0:
        rng = wp.rand_init(int(state), 1)
        factor = wp.max(1.0 + s.leak_jitter * wp.randn(rng), SMALLEST_LEAK)
    return factor


@wp.func
def whole_step(steps: Steps, s: SensorParams, p: Pixel) -> Interval:
    """Return one step of a chunk as a time interval, in which the pixel leaks without jitter."""
    span = Interval()
    span.ticks = steps.ticks
    span.per_tick = steps.per_tick
    span.share = 1.0
    span.drift = s.leak * p.leak * p.on
    span.shift = steps.shift
    return span


@wp.func
def crossing(reference: float, on: float, off: float, level: float, slope: float) -> float:
    """Return the fraction of the step at which the level next crosses a threshold; above 1 if it does not."""
    if slope > 0.0:
        return (reference + on - level) / slope
    if slope < 0.0:
        return (reference - off - level) / slope
    return PAST_STEP


@wp.func
def draw_waiting_time(rate: float, uniform: float) -> wp.int64:
    """Return an exponential waiting time [ticks] to the next event of a Poisson process."""
    if rate > 0.0:
        return wp.int64(1.0 - wp.log(1.0 - uniform) / rate)
    return NO_NOISE


@wp.func
def append_key(sink: Sink, shift: int, index: int, t: wp.int64, stamp: wp.int64, kind: int):
    """Append the key of an event at tick ``t`` with time stamp ``stamp`` [us]; ``kind``: 2 cause + polarity."""
    lag = wp.clamp(int(stamp * wp.int64(TICKS) - t) + LAG_ZERO, 0, LARGEST_LAG)
    segment = (index / sink.run) % sink.keys.shape[0]
    place = wp.atomic_add(sink.count, segment, 0, 1)
    if place < sink.keys.shape[1]:
        low = wp.int64(index) << wp.int64(LOW_BITS) | wp.int64(
            (LARGEST_LAG - lag) << LAG_BIT | kind
        )
        sink.keys[segment, place] = stamp << wp.int64(shift) | low


@wp.func
def latency(s: SensorParams, rng: wp.uint32):
    """Return a random latency [ticks] from a threshold crossing to its time stamp, and the generator's next state."""
    late = s.latency
    if (
        s.jitter > 0.0
    ):  # nearly Gaussian: sum of four uniform numbers, within 3.5 standard deviations
        four = wp.randf(rng) + wp.randf(rng) + wp.randf(rng) + wp.randf(rng)
        late = wp.max(late + s.jitter * 1.7320508 * (four - 2.0), 0.0)
    return late, rng


@wp.func
def cause_of(p: Pixel, span: Interval, slope: float, noise: bool) -> int:
    """Return the cause of an event in a step in which the level, minus the leaking reference, rises by ``slope``."""
    if noise:
        return wp.where(p.hot > 0.0, HOT_PIXEL, SHOT_NOISE)
    return wp.where(slope > 0.0 and slope <= LEAK_SHARE * span.drift, LEAK, SIGNAL)


@wp.func
def next_state(s: SensorParams, rng: wp.uint32) -> wp.uint32:
    """Return the generator's state after an event. With jitter, the leak until the next event depends on it."""
    state = rng
    if s.leak_jitter > 0.0:
        state = wp.rand_init(int(rng))
    return state


@wp.func
def thin_noise(p: Pixel, s: SensorParams, slope: float, f: float, noise: bool) -> Pixel:
    """Return the pixel before an event at fraction ``f`` of the step; in bright light, noise may be postponed.

    Noise is drawn at the rate in the dark. Postponing noise events at random gives the rate at the level of the moment.
    It falls linearly with luminance, as in v2e (Hu, Liu, Delbruck, CVPR Workshops 2021).
    """
    if noise and f < 1.0 and s.noise_white < 1.0:
        rng = p.rng
        light = wp.clamp(wp.exp(p.level + f * slope) - s.dark, 0.0, 1.0)
        rate = p.noise * (1.0 - (1.0 - s.noise_white) * light) + p.hot
        if wp.randf(rng) * (p.noise + p.hot) >= rate:
            p.next_noise += draw_waiting_time(p.noise + p.hot, wp.randf(rng))
        p.rng = rng
    return p


@wp.func
def fire_event(
    p: Pixel,
    s: SensorParams,
    sink: Sink,
    index: int,
    t0: wp.int64,
    span: Interval,
    slope: float,
    f: float,
    noise: bool,
) -> Pixel:
    """Return the pixel after an event at fraction ``f`` of the step, and write that event, if f < 1."""
    if f < 1.0:
        rng = p.rng
        on = int(slope > 0.0)
        if noise:
            on = int(wp.randf(rng) < 0.5)
            p.reference = p.level + f * slope
        else:
            p.reference += wp.where(on == 1, p.on, -p.off)
        t = t0 + wp.int64(f * float(span.ticks))
        late, rng = latency(s, rng)
        stamp = (t + wp.int64(late) + wp.int64(HALF_TICKS)) >> wp.int64(TICK_BITS)
        p.last_stamp = wp.max(stamp, p.last_stamp + wp.int64(1))
        append_key(
            sink, span.shift, index, t, p.last_stamp, 2 * cause_of(p, span, slope, noise) + on
        )
        p.blind_until = wp.where(s.refractory > wp.int64(0), t + s.refractory, NEVER)
        if noise or p.next_noise < p.blind_until:
            p.next_noise = wp.max(t, p.blind_until) + draw_waiting_time(
                p.noise + p.hot, wp.randf(rng)
            )
        p.rng = next_state(s, rng)
    return p


@wp.func
def generate_events(
    p: Pixel,
    s: SensorParams,
    sink: Sink,
    index: int,
    t0: wp.int64,
    span: Interval,
    slope: float,
    quiet: bool,
):
    """Generate all events of a step in which the level, minus the leaking reference, rises by ``slope``.

    Return the pixel, and the change of the reference in the whole step at the leak at its end. If jitter changes the
    leak at an event, the line of the level gets another slope. The reference is then shifted such that their distance
    at the event stays the same.

    The struct is changed field by field or unconditionally: a conditional assignment of the whole struct would move it
    out of the registers.
    """
    rise = float(slope)
    f = wp.where(quiet, PAST_STEP, 0.0)
    while f < 1.0:
        if p.blind_until > NEVER:  # the reference is reset at the end of the refractory period
            f = wp.max(f, float(p.blind_until - t0) * span.per_tick)
            if f < 1.0:
                p.reference = p.level + f * rise
                p.blind_until = NEVER
        signal = wp.max(crossing(p.reference, p.on, p.off, p.level, rise), f)
        due = p.next_noise
        f = wp.min(signal, wp.max(float(due - t0) * span.per_tick, f))
        p = thin_noise(p, s, rise, f, f < signal)
        p = fire_event(
            p,
            s,
            sink,
            index,
            t0,
            span,
            rise,
            wp.where(p.next_noise == due, f, PAST_STEP),
            f < signal,
        )
        if s.leak_jitter > 0.0 and f < 1.0:
            p.jitter = leak_factor(s, p.rng)
            change = span.share * jittered_leak(p, s) * p.on - span.drift
            span.drift += change
            rise += change
            p.reference += f * change
    return p, span.drift


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def reconverge():
    """Make the threads of a warp run together again: after an event they would diverge until the end of the chunk."""


@wp.func
def rate_factor(sensor: SensorParams, rng: wp.uint32):
    """Draw the ratio of a pixel's leak and shot noise to their means; return also the generator's next state."""
    factor = float(1.0)
    if sensor.spread > 0.0:
        factor = wp.exp(sensor.spread * wp.randn(rng))
    return factor, rng


@wp.func
def new_pixel(sensor: SensorParams, seed: int, i: int, level: float) -> Pixel:
    """Draw a pixel's thresholds and noise rate, and set its reference.

    The reference is the level minus a random part of a threshold, which stands for earlier leakage.
    """
    rng = wp.rand_init(seed, i)
    p = Pixel()
    p.level = level
    p.on = sensor.on * wp.max(1.0 + sensor.mismatch * wp.randn(rng), SMALLEST_THRESHOLD)
    p.off = sensor.off * wp.max(1.0 + sensor.mismatch * wp.randn(rng), SMALLEST_THRESHOLD)
    p.hot = wp.where(wp.randf(rng) < sensor.hot_fraction, sensor.hot, 0.0)
    factor, rng = rate_factor(sensor, rng)
    p.noise = sensor.noise * factor
    p.leak = factor
    leaked = wp.randf(rng)
    p.reference = p.level - wp.where(sensor.leak > 0.0, leaked * p.on, 0.0)
    p.blind_until = NEVER
    p.last_stamp = wp.int64(-1)
    p.next_noise = draw_waiting_time(p.noise + p.hot, wp.randf(rng))
    p.rng = rng
    p.jitter = leak_factor(sensor, rng)
    p.light = wp.exp(level)
    return p


@wp.kernel
def start_pixels(
    view: View,
    steps: Steps,
    sensor: SensorParams,
    seed: int,
    start: int,
    pixels: wp.array(dtype=Pixel),
):
    """Initialise every pixel with the level that it sees at the start."""
    i = start + wp.tid()
    pixels[i] = new_pixel(
        sensor, seed, i, see_level(view, steps.at[steps.margin], ray_in_prism_frame(view, i))
    )


@wp.kernel(module="unique", module_options=OPTIONS)
def set_pixels(
    on: wp.array(dtype=float),
    off: wp.array(dtype=float),
    hot: wp.array(dtype=float),
    dead: wp.array(dtype=wp.bool),
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
):
    """Replace drawn thresholds and hot rates by the values of a map, which are relative and in events per tick.

    A threshold of NaN stays as drawn. Dead pixels get thresholds that no light crosses.
    """
    i = wp.tid()
    p = pixels[i]
    reference = p.level
    if not dead[i]:
        reference = wp.where(
            wp.isnan(on[i]),
            p.reference,
            p.level - (p.level - p.reference) * sensor.on * on[i] / p.on,
        )
    p.reference = reference
    p.on = wp.where(wp.isnan(on[i]), p.on, sensor.on * on[i])
    p.off = wp.where(wp.isnan(off[i]), p.off, sensor.off * off[i])
    drawn = p.hot == hot[i] and not dead[i]
    p.hot = hot[i]
    if dead[i]:
        p.on = UNREACHED
        p.off = UNREACHED
        p.noise = 0.0
        p.leak = 0.0
    if not drawn:
        rng = p.rng
        p.next_noise = draw_waiting_time(p.noise + p.hot, wp.randf(rng))
        p.rng = rng
        p.jitter = leak_factor(sensor, rng)
    pixels[i] = p


@wp.func
def advance_pixel(
    p: Pixel, s: SensorParams, sink: Sink, index: int, t0: wp.int64, span: Interval, level: float
) -> Pixel:
    """Advance a pixel by one interval, at the end of which it sees ``level``."""
    end = level + span.drift
    within = end < p.reference + p.on and end > p.reference - p.off
    quiet = within and p.blind_until == NEVER and p.next_noise >= t0 + wp.int64(span.ticks)
    p, drift = generate_events(p, s, sink, index, t0, span, end - p.level, quiet)
    p.level = level
    p.reference -= drift
    return p


@wp.func
def shift_times(p: Pixel, passed: wp.int64) -> Pixel:
    """Shift the pixel's times to a new origin that is ``passed`` ticks later."""
    if p.blind_until > NEVER:
        p.blind_until -= passed
    p.next_noise -= passed
    p.last_stamp -= passed >> wp.int64(TICK_BITS)
    return p


@wp.kernel(
    module="unique", module_options=OPTIONS
)  # so that each device compiles only what it runs
def run_pixels(
    view: View,
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    start: int,
    sink: Sink,
):
    """Advance one pixel per thread through all steps of a chunk."""
    i = start + wp.tid()
    p = pixels[i]
    ray = ray_in_prism_frame(view, i)
    span = whole_step(steps, sensor, p)
    t0 = wp.int64(0)
    for k in range(steps.count):
        level = see_level(view, steps.at[steps.margin + k + 1], ray)
        p = advance_pixel(p, sensor, sink, i, t0, span, level)
        t0 += wp.int64(steps.ticks)
        reconverge()
    pixels[i] = shift_times(p, t0)


@wp.kernel(module="unique", module_options=OPTIONS)
def run_pixels_ahead(
    view: View,
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    start: int,
    sink: Sink,
):
    """Generate the same events as :func:`run_pixels`, bit for bit.

    Faster on a CPU, because it computes the log intensities of several instants at once.
    """
    i = start + wp.tid()
    p = pixels[i]
    ray = ray_in_prism_frame(view, i)
    span = whole_step(steps, sensor, p)
    t0 = wp.int64(0)
    for block in range(steps.ahead.shape[0]):
        n = wp.min(AHEAD, steps.count - block * AHEAD)
        met = texels_ahead(view.prism, view.second, view.steered, steps.ahead[block], ray)
        at = locate_texels(view, met)
        levels = levels_ahead(view, steps, block, n, at)
        j = int(0)
        while j < n:
            p = advance_pixel(p, sensor, sink, i, t0, span, levels[j])
            t0 += wp.int64(steps.ticks)
            j += 1
    pixels[i] = shift_times(p, t0)
