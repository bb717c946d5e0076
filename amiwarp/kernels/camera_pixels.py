"""Event simulation from images of the log intensity, of many cameras in one launch."""

import warp as wp

from amiwarp.kernels.photoreceptors import (
    Receptor,
    advance_filtered,
    last_input,
    next_input,
    receptor,
)
from amiwarp.kernels.pixels import (
    OPTIONS,
    Pixel,
    SensorParams,
    Sink,
    advance_pixel,
    new_pixel,
    reconverge,
    shift_times,
    whole_step,
)
from amiwarp.kernels.prism_view import Steps

wp.set_module_options(OPTIONS)


@wp.struct
class Cameras:
    """Cameras of one size, whose pixels follow each other camera by camera."""

    pixels: int  # number of pixels of a camera
    seed: wp.array(dtype=int)  # seed of each camera
    starts: wp.array(dtype=wp.uint8)  # 1 for each camera that begins at the end of the chunk


@wp.func
def starting_pixel(cameras: Cameras, sensor: SensorParams, i: int, level: float) -> Pixel:
    """Return the state of a pixel whose camera starts at a level; ``i``: number among the pixels of all cameras."""
    camera = i / cameras.pixels
    return new_pixel(sensor, cameras.seed[camera], i - camera * cameras.pixels, level)


@wp.kernel(module="unique", module_options=OPTIONS)
def run_camera_pixels(
    levels: wp.array2d(dtype=float),
    cameras: Cameras,
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    start: int,
    sink: Sink,
):
    """Simulate the pixels of cameras over a chunk, as :func:`amiwarp.kernels.world_pixels.run_world_pixels` does.

    ``levels``: log intensity at the end of each step; axes: step, pixel. Cameras that begin take the last row.
    """
    i = start + wp.tid()
    if cameras.starts[i / cameras.pixels] != wp.uint8(0):
        pixels[i] = starting_pixel(cameras, sensor, i, levels[steps.count - 1, i])
        return
    p = pixels[i]
    span = whole_step(steps, sensor, p)
    t0 = wp.int64(0)
    for k in range(steps.count):
        p = advance_pixel(p, sensor, sink, i, t0, span, levels[k, i])
        t0 += wp.int64(steps.ticks)
        reconverge()
    pixels[i] = shift_times(p, t0)


@wp.kernel(module="unique", module_options=OPTIONS)
def run_filtered_camera_pixels(
    levels: wp.array2d(dtype=float),
    cameras: Cameras,
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    receptors: wp.array(dtype=Receptor),
    start: int,
    sink: Sink,
):
    """Simulate pixels whose photoreceptors have limited bandwidth; see :func:`run_camera_pixels`."""
    i = start + wp.tid()
    if cameras.starts[i / cameras.pixels] != wp.uint8(0):
        level = levels[steps.count - 1, i]
        receptors[i] = receptor(level, level)
        pixels[i] = starting_pixel(cameras, sensor, i, level)
        return
    p = pixels[i]
    before = last_input(p, receptors[i].seen)
    first = receptors[i].first
    span = whole_step(steps, sensor, p)
    t0 = wp.int64(0)
    for k in range(steps.count):
        after = next_input(levels[k, i], before)
        p, first = advance_filtered(p, first, sensor, sink, i, t0, span, before, after)
        before = after
        t0 += wp.int64(steps.ticks)
        reconverge()
    p.light = before.light
    pixels[i] = shift_times(p, t0)
    receptors[i] = receptor(before.level, first)
