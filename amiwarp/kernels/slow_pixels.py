"""Equations of slow pixels, for :mod:`amiwarp.brightness.slow_pixels`.

A photoreceptor is a first-order low-pass filter whose rate is proportional to the light, as in
:mod:`amiwarp.kernels.pixels`. An event tells the filter's output, not the brightness at the event.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import NAN, CameraParams
from amiwarp.kernels.equations import Atlas, Pairs, interpolated
from amiwarp.kernels.map_positions import contracted_position, event_state, lag_of, node_at
from amiwarp.kernels.photoreceptors import filter_level
from amiwarp.kernels.refraction import advanced, compensate

wp.set_module_options({"enable_backward": False})

STEPS = wp.constant(16)  # number of steps in which the filter's equation is solved
# Time before an event from which the filter is followed [time constants at median light]
MEMORY = wp.constant(6.0)
# Largest difference from the median brightness that is used [ON thresholds]
MOST_THRESHOLDS = wp.constant(8.0)


@wp.struct
class Photoreceptor:
    """Photoreceptors of the pixels."""

    threshold: float  # ON threshold [log intensity]
    middle: float  # median brightness [ON thresholds]
    # Angle of the prism per time constant at the median brightness, by tile [rad]
    turn: wp.array(dtype=float)
    ahead: float  # angle by which the prism is ahead of the effective phase [rad]


@wp.func
def brightness_at_position(
    image: wp.array(dtype=float), atlas: Atlas, tile: int, xy: wp.vec2
) -> float:
    """Return the brightness of a tile's map at a position [px]; NaN off the tile."""
    cell, fx, fy = node_at(atlas, tile, xy[0], xy[1])
    if cell < 0:
        return NAN
    return interpolated(image, atlas.columns, cell, fx, fy)


@wp.func
def brightness_before(
    model: Any,
    camera: CameraParams,
    pairs: Pairs,
    atlas: Atlas,
    image: wp.array(dtype=float),
    k: int,
    i: int,
    back: float,
) -> float:
    """Return the brightness at the pixel of an event when the prism's angle was smaller by ``back`` [rad]."""
    w0, w1 = event_state(model, pairs, k, i)
    w = advanced(model, w0, w1, -back)
    xy = compensate(model, camera, wp.vec2(float(pairs.x[i]), float(pairs.y[i])), w)
    return brightness_at_position(image, atlas, pairs.tile[i], xy)


@wp.kernel
def write_brightness(
    model: Any,
    camera: CameraParams,
    pairs: Pairs,
    atlas: Atlas,
    image: wp.array(dtype=float),
    ahead: float,
    every: int,
    start: int,
    out: wp.array2d(dtype=float),
):
    """Compute the brightness at both events of every ``every``-th pair; NaN off the map."""
    number = start + wp.tid()
    for k in range(2):
        out[k, number] = brightness_before(
            model, camera, pairs, atlas, image, k, number * every, -ahead
        )


@wp.kernel
def write_time_constants(
    model: Any,
    camera: CameraParams,
    pairs: Pairs,
    atlas: Atlas,
    image: wp.array(dtype=float),
    photoreceptor: Photoreceptor,
    start: int,
    out: wp.array2d(dtype=float),
):
    """Compute the time constant at both events of a pair, relative to that at the median brightness; 1 off the map."""
    i = start + wp.tid()
    for k in range(2):
        level = brightness_before(model, camera, pairs, atlas, image, k, i, -photoreceptor.ahead)
        away = wp.clamp(level - photoreceptor.middle, -MOST_THRESHOLDS, MOST_THRESHOLDS)
        out[k, i] = wp.where(wp.isnan(level), 1.0, wp.exp(-photoreceptor.threshold * away))


@wp.func
def filtered(
    model: Any,
    camera: CameraParams,
    pairs: Pairs,
    atlas: Atlas,
    image: wp.array(dtype=float),
    k: int,
    i: int,
    photoreceptor: Photoreceptor,
) -> float:
    """Return the output of the filter at an event.

    A dark pixel remembers for longer than :data:`MEMORY`: its output begins on the contracted orbit.
    """
    width = MEMORY / float(STEPS)  # step [time constants at median light]
    turn = photoreceptor.turn[pairs.tile[i]]
    before = float(
        brightness_before(
            model, camera, pairs, atlas, image, k, i, MEMORY * turn - photoreceptor.ahead
        )
    )
    w0, w1 = event_state(model, pairs, k, i)
    begun = advanced(model, w0, w1, -MEMORY * turn)
    pixel = wp.vec2(float(pairs.x[i]), float(pairs.y[i]))
    xy = contracted_position(model, camera, pixel, begun[0], begun[1], lag_of(pairs, k, i))
    level = float(brightness_at_position(image, atlas, pairs.tile[i], xy))
    if wp.isnan(level):
        level = before
    # A variable, so that Warp does not unroll the loop, which takes minutes to compile for CUDA
    steps = int(STEPS)
    for j in range(steps):
        past = MEMORY - float(j + 1) * width
        after = brightness_before(
            model, camera, pairs, atlas, image, k, i, past * turn - photoreceptor.ahead
        )
        if wp.isnan(after):
            after = before
        light = wp.exp(photoreceptor.threshold * (0.5 * (before + after) - photoreceptor.middle))
        level = filter_level(level, before, after, width * light)
        before = after
    return level


@wp.kernel
def write_offsets(
    model: Any,
    camera: CameraParams,
    pairs: Pairs,
    atlas: Atlas,
    image: wp.array(dtype=float),
    photoreceptor: Photoreceptor,
    start: int,
    offset: wp.array(dtype=float),
):
    """Compute the difference between the filter's output and the brightness on the contracted orbit, for a pair."""
    i = start + wp.tid()
    total = float(0.0)
    sign = float(-1.0)
    for k in range(2):
        w0, w1 = event_state(model, pairs, k, i)
        pixel = wp.vec2(float(pairs.x[i]), float(pairs.y[i]))
        xy = contracted_position(model, camera, pixel, w0, w1, lag_of(pairs, k, i))
        there = brightness_at_position(image, atlas, pairs.tile[i], xy)
        total += sign * (filtered(model, camera, pairs, atlas, image, k, i, photoreceptor) - there)
        sign = 1.0
    offset[i] = wp.where(wp.isnan(total), 0.0, total)
