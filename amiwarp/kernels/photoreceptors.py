"""Photoreceptors of the simulated pixels: low-pass filters of one or two stages.

The bandwidth of the first stage is proportional to the light, the bandwidth of the second stage, a buffer, is constant.
These kernels replace the kernels of :mod:`amiwarp.kernels.pixels` if the sensor's bandwidth is limited, or if its leak
has jitter. The level of a pixel is then the output of its photoreceptor. The input is linear in time between two
instants, and the first stage's equation is solved exactly for it, so that the events hardly depend on the length of the
steps. The second stage's equation is solved exactly for an input that is linear in each piece of a step.
"""

import warp as wp

from amiwarp.kernels.pixels import (
    OPTIONS,
    Interval,
    Pixel,
    SensorParams,
    Sink,
    advance_pixel,
    jittered_leak,
    reconverge,
    shift_times,
    whole_step,
)
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

wp.set_module_options(OPTIONS)


# Largest number of pieces per step; divides the ticks of a step, a multiple of 16
MOST_PIECES = wp.constant(16)

# Largest deviation of the level from a straight line within a piece [ON thresholds]
LARGEST_BEND = wp.constant(0.01)

# Duration [time constants] below which a series is more precise in float32
SMALL_ANGLE = wp.constant(0.1)

# Change of the log intensity below which a series is more precise in float32
SMALL_CHANGE = wp.constant(0.3)


@wp.struct
class Receptor:
    """State of a photoreceptor between two chunks, without its output, which is the level of its pixel."""

    seen: float  # last log intensity of the light
    first: float  # output of the first stage


@wp.func
def receptor(seen: float, first: float) -> Receptor:
    """Return the state of a photoreceptor."""
    result = Receptor()
    result.seen = seen
    result.first = first
    return result


@wp.struct
class Input:
    """Input of a photoreceptor at one instant: the light on its pixel."""

    level: float  # log intensity of the light
    light: float  # exponential of the level


@wp.func
def last_input(p: Pixel, level: float) -> Input:
    """Return the photoreceptor's last input, by its level and the exponential that the pixel keeps."""
    result = Input()
    result.level = level
    result.light = p.light
    return result


@wp.func
def next_input(level: float, last: Input) -> Input:
    """Return the photoreceptor's input for a level. ``last`` saves the exponential if it has the same level."""
    result = Input()
    result.level = level
    result.light = last.light
    if level != last.level:
        result.light = wp.exp(level)
    return result


@wp.func
def mean_light(before: Input, after: Input) -> float:
    """Return the mean of exp(level) over an interval in which the level changes linearly."""
    change = after.level - before.level
    if wp.abs(change) > SMALL_CHANGE:
        return (after.light - before.light) / change
    return 0.5 * (before.light + after.light) * (1.0 - change * change / 12.0)


@wp.func
def filter_level(level: float, before: float, after: float, angle: float) -> float:
    """Return the filter's output at the end of an interval; ``level`` is that at its beginning.

    The input changes linearly from ``before`` to ``after``. ``angle`` is the duration in time constants. The output
    starts anew at the input after an instant without light, which is NaN.
    """
    lag = angle * (0.5 - angle * (1.0 / 6.0 - angle / 24.0))
    if angle > SMALL_ANGLE:
        lag = 1.0 - (1.0 - wp.exp(-angle)) / angle
    result = level + angle * (1.0 - lag) * (before - level) + lag * (after - before)
    return wp.where(wp.isnan(level) or wp.isnan(before), after, result)


@wp.func
def piece_count(level: float, before: float, after: float, angle: float, tolerance: float) -> int:
    """Return the number of pieces of a step, within which the filter's output is nearly linear: a power of two.

    A chord leaves a curve by at most an eighth of the largest second derivative, which is that at the beginning.
    """
    bend = wp.abs(angle * (angle * (level - before) + after - before)) / (8.0 * tolerance)
    n = int(1)
    while n < MOST_PIECES and bend > float(n * n):
        n *= 2
    return n


@wp.func
def pieces_of_step(
    p: Pixel, first: float, s: SensorParams, before: float, after: float, angle: float
) -> int:
    """Return the number of pieces of a step, within which both stages of a photoreceptor are nearly linear.

    ``angle``: duration of the step in time constants of the first stage.
    """
    tolerance = LARGEST_BEND * p.on
    n = piece_count(first, before, after, angle, tolerance)
    if s.buffer > 0.0:
        end = after
        if s.bandwidth > 0.0:
            end = filter_level(first, before, after, angle)
        n = wp.max(n, piece_count(p.level, first, end, s.buffer, tolerance))
    return n


@wp.func
def advance_filtered(
    p: Pixel,
    first: float,
    s: SensorParams,
    sink: Sink,
    index: int,
    t0: wp.int64,
    span: Interval,
    before: Input,
    after: Input,
):
    """Advance a pixel by one step, in which its photoreceptor's input changes from ``before`` to ``after``.

    Return the pixel, and the output of the photoreceptor's first stage, which was ``first``.
    """
    n = pieces_of_step(
        p, first, s, before.level, after.level, s.bandwidth * mean_light(before, after)
    )
    piece = Interval()
    piece.ticks = span.ticks / n
    piece.per_tick = span.per_tick * float(n)
    piece.shift = span.shift
    piece.share = 1.0 / float(n)
    x0 = before
    j = int(0)
    while j < n:
        j += 1
        between = wp.lerp(before.level, after.level, piece.share * float(j))
        x1 = next_input(wp.where(j == n, after.level, between), after)
        end = x1.level
        if s.bandwidth > 0.0:
            end = filter_level(
                first, x0.level, x1.level, s.bandwidth * piece.share * mean_light(x0, x1)
            )
        level = end
        if s.buffer > 0.0:
            level = filter_level(p.level, first, end, s.buffer * piece.share)
        first = end
        piece.drift = piece.share * jittered_leak(p, s) * p.on
        p = advance_pixel(p, s, sink, index, t0 + wp.int64((j - 1) * piece.ticks), piece, level)
        x0 = x1
    return p, first


@wp.kernel(
    module="unique", module_options=OPTIONS
)  # so that each device compiles only what it runs
def run_filtered_pixels(
    view: View,
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    receptors: wp.array(dtype=Receptor),
    start: int,
    sink: Sink,
):
    """Advance one pixel per thread through all steps of a chunk, with its photoreceptor."""
    i = start + wp.tid()
    p = pixels[i]
    before = last_input(p, receptors[i].seen)
    first = receptors[i].first
    span = whole_step(steps, sensor, p)
    ray = ray_in_prism_frame(view, i)
    t0 = wp.int64(0)
    for k in range(steps.count):
        after = next_input(see_level(view, steps.at[steps.margin + k + 1], ray), before)
        p, first = advance_filtered(p, first, sensor, sink, i, t0, span, before, after)
        before = after
        t0 += wp.int64(steps.ticks)
        reconverge()
    p.light = before.light
    pixels[i] = shift_times(p, t0)
    receptors[i] = receptor(before.level, first)


@wp.kernel(module="unique", module_options=OPTIONS)
def run_filtered_pixels_ahead(
    view: View,
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    receptors: wp.array(dtype=Receptor),
    start: int,
    sink: Sink,
):
    """Generate the same events as :func:`run_filtered_pixels`, faster on a CPU."""
    i = start + wp.tid()
    p = pixels[i]
    before = last_input(p, receptors[i].seen)
    first = receptors[i].first
    span = whole_step(steps, sensor, p)
    ray = ray_in_prism_frame(view, i)
    t0 = wp.int64(0)
    for block in range(steps.ahead.shape[0]):
        n = wp.min(AHEAD, steps.count - block * AHEAD)
        met = texels_ahead(view.prism, view.second, view.steered, steps.ahead[block], ray)
        at = locate_texels(view, met)
        levels = levels_ahead(view, steps, block, n, at)
        j = int(0)
        while j < n:
            after = next_input(levels[j], before)
            p, first = advance_filtered(p, first, sensor, sink, i, t0, span, before, after)
            before = after
            t0 += wp.int64(steps.ticks)
            j += 1
    p.light = before.light
    pixels[i] = shift_times(p, t0)
    receptors[i] = receptor(before.level, first)
