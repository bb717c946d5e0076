"""Photoreceptors of the simulated pixels: first-order low-pass filters whose bandwidth is proportional to the light.

These kernels replace those of :mod:`amiwarp.kernels.event_generation` if the sensor's bandwidth is limited. The level of
a pixel is then the output of its photoreceptor. The input is linear in time between two instants, and the filter's
equation is solved exactly for it, so that the events hardly depend on the length of the steps.
"""

import warp as wp

from amiwarp.kernels.event_generation import Pixel, SensorParams, Sink, advance_by, reconverge, shift_times
from amiwarp.kernels.sight import (
    AHEAD,
    Steps,
    View,
    levels_ahead,
    locate_texels,
    ray_in_prism_frame,
    see_level,
    texels_ahead,
)

wp.set_module_options({"enable_backward": False})

MOST_PIECES = wp.constant(16)  # of a step: divides its number of ticks, which are 16 per microsecond
LARGEST_BEND = wp.constant(0.01)  # of the level between the ends of a piece [ON thresholds]
SMALL_ANGLE = wp.constant(0.1)  # angular frequency times duration below which a series is more precise in float32


@wp.func
def mean_light(before: float, after: float) -> float:
    """Return the mean of exp(level) over an interval in which the level changes linearly."""
    half = wp.max(0.5 * wp.abs(after - before), 1.0e-4)
    return wp.exp(0.5 * (before + after)) * wp.sinh(half) / half


@wp.func
def filter_level(level: float, before: float, after: float, angle: float) -> float:
    """Return the filter's output at the end of an interval; ``level`` is that at its beginning.

    The input changes linearly from ``before`` to ``after``. ``angle`` is the duration in time constants. The output
    starts anew at the input after an instant without light, which is NaN.
    """
    lag = 1.0 - (1.0 - wp.exp(-angle)) / angle
    if angle < SMALL_ANGLE:
        lag = angle * (0.5 - angle * (1.0 / 6.0 - angle / 24.0))
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
def advance_filtered(
    p: Pixel, s: SensorParams, sink: Sink, index: int, t0: wp.int64, steps: Steps, before: float, after: float
) -> Pixel:
    """Advance a pixel by one step, in which its photoreceptor's input changes from ``before`` to ``after``."""
    angle = s.bandwidth * mean_light(before, after)
    n = piece_count(p.level, before, after, angle, LARGEST_BEND * p.on)
    piece = Steps()
    piece.ticks = steps.ticks / n
    piece.per_tick = steps.per_tick * float(n)
    piece.share = 1.0 / float(n)
    piece.shift = steps.shift
    j = int(0)
    while j < n:
        x0 = before + (after - before) * piece.share * float(j)
        x1 = before + (after - before) * piece.share * float(j + 1)
        level = filter_level(p.level, x0, x1, s.bandwidth * piece.share * mean_light(x0, x1))
        p = advance_by(p, s, sink, index, t0 + wp.int64(j * piece.ticks), piece, level, piece.share * p.leak * p.on)
        j += 1
    return p


@wp.kernel
def run_filtered_pixels(
    view: View, steps: Steps, sensor: SensorParams, pixels: wp.array(dtype=Pixel), seen: wp.array(dtype=float),
    start: int, sink: Sink,
):  # fmt: skip
    """Advance one pixel per thread through all steps of a chunk; ``seen``: its photoreceptor's last input."""
    i = start + wp.tid()
    p = pixels[i]
    before = seen[i]
    ray = ray_in_prism_frame(view, i)
    t0 = wp.int64(0)
    for k in range(steps.count):
        level = see_level(view, steps.at[steps.margin + k + 1], ray)
        p = advance_filtered(p, sensor, sink, i, t0, steps, before, level)
        before = level
        t0 += wp.int64(steps.ticks)
        reconverge()
    pixels[i] = shift_times(p, t0)
    seen[i] = before


@wp.kernel
def run_filtered_pixels_ahead(
    view: View, steps: Steps, sensor: SensorParams, pixels: wp.array(dtype=Pixel), seen: wp.array(dtype=float),
    start: int, sink: Sink,
):  # fmt: skip
    """Generate the same events as :func:`run_filtered_pixels`, faster on a CPU."""
    i = start + wp.tid()
    p = pixels[i]
    before = seen[i]
    ray = ray_in_prism_frame(view, i)
    t0 = wp.int64(0)
    for block in range(steps.ahead.shape[0]):
        n = wp.min(AHEAD, steps.count - block * AHEAD)
        at = locate_texels(view, texels_ahead(view.prism, steps.ahead[block], ray))
        levels = levels_ahead(view, steps, block, n, at)
        j = int(0)
        while j < n:
            level = levels[j]
            p = advance_filtered(p, sensor, sink, i, t0, steps, before, level)
            before = level
            t0 += wp.int64(steps.ticks)
            j += 1
    pixels[i] = shift_times(p, t0)
    seen[i] = before
