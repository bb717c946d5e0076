"""Event simulation from a table of the luminance that each pixel sees at every time step."""

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


@wp.func
def table_level(light: wp.array2d(dtype=float), sensor: SensorParams, k: int, i: int) -> float:
    """Return the log intensity of pixel ``i`` in row ``k`` of a table of luminance."""
    return wp.log(light[k, i] + sensor.dark)


@wp.kernel(module="unique", module_options=OPTIONS)
def start_world_pixels(
    light: wp.array2d(dtype=float),
    steps: Steps,
    sensor: SensorParams,
    seed: int,
    start: int,
    pixels: wp.array(dtype=Pixel),
):
    """Set the state of every pixel at the start of the recording, whose luminance is the first row of ``light``."""
    i = start + wp.tid()
    pixels[i] = new_pixel(sensor, seed, i, table_level(light, sensor, 0, i))


@wp.kernel(module="unique", module_options=OPTIONS)
def run_world_pixels(
    light: wp.array2d(dtype=float),
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    start: int,
    sink: Sink,
):
    """Simulate pixels over the steps of a chunk, and write the keys of their events to ``sink``.

    :func:`amiwarp.kernels.pixels.run_pixels` does so with maps. ``light``: luminance of each pixel at the end of each
    step; axes: step, pixel.
    """
    i = start + wp.tid()
    p = pixels[i]
    span = whole_step(steps, sensor, p)
    t0 = wp.int64(0)
    for k in range(steps.count):
        p = advance_pixel(p, sensor, sink, i, t0, span, table_level(light, sensor, k, i))
        t0 += wp.int64(steps.ticks)
        reconverge()
    pixels[i] = shift_times(p, t0)


@wp.kernel(module="unique", module_options=OPTIONS)
def run_filtered_world_pixels(
    light: wp.array2d(dtype=float),
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    receptors: wp.array(dtype=Receptor),
    start: int,
    sink: Sink,
):
    """Simulate pixels whose photoreceptors have limited bandwidth; see :func:`run_world_pixels`."""
    i = start + wp.tid()
    p = pixels[i]
    before = last_input(p, receptors[i].seen)
    first = receptors[i].first
    span = whole_step(steps, sensor, p)
    t0 = wp.int64(0)
    for k in range(steps.count):
        after = next_input(table_level(light, sensor, k, i), before)
        p, first = advance_filtered(p, first, sensor, sink, i, t0, span, before, after)
        before = after
        t0 += wp.int64(steps.ticks)
        reconverge()
    p.light = before.light
    pixels[i] = shift_times(p, t0)
    receptors[i] = receptor(before.level, first)
