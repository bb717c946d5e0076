"""Event simulation in a world by ray casting: each pixel casts rays through the prism at every time step."""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray
from amiwarp.kernels.event_generation import (
    Pixel,
    SensorParams,
    Sink,
    advance_pixel,
    new_pixel,
    reconverge,
    shift_times,
    whole_step,
)
from amiwarp.kernels.photoreceptor import advance_filtered, last_input, next_input
from amiwarp.kernels.prism_view import Steps
from amiwarp.kernels.refraction import ExactParams, trace
from amiwarp.kernels.world import Pose, World, radiance

wp.set_module_options({"enable_backward": False})


@wp.struct
class RayView:
    """Camera and prism, and the camera's pose at every instant of a chunk of simulated time."""

    camera: CameraParams  # camera model
    prism: ExactParams  # prism model
    poses: wp.array(dtype=Pose)  # pose of the camera at each instant
    aperture: wp.array(dtype=wp.vec3)  # rays of a pixel: x and y relative to the pixel's centre [px], and weight
    cone: float  # angular width of a ray [rad]
    dark: float  # luminance that is added before the logarithm


@wp.func
def see_world(world: World, view: RayView, steps: Steps, k: int, i: int) -> float:
    """Return the log intensity that pixel ``i`` sees through the prism at instant ``k``."""
    row = i / view.camera.width
    col = i - row * view.camera.width
    w = steps.at[k].azimuth
    pose = view.poses[k]
    total = float(0.0)
    for j in range(view.aperture.shape[0]):
        a = view.aperture[j]
        xy = wp.vec2(float(col) + a[0], float(row) + a[1])
        ray = trace(view.prism, pixel_to_ray(view.camera, xy), w, view.prism.flat_to_scene)
        total += a[2] * radiance(world, k, pose.position, pose.rotation * wp.normalize(ray), view.cone)
    return wp.log(total + view.dark)


@wp.kernel
def start_world_pixels(
    world: World, view: RayView, steps: Steps, sensor: SensorParams, seed: int, start: int,
    pixels: wp.array(dtype=Pixel),
):  # fmt: skip
    """Set the state of every pixel at the start of the recording."""
    i = start + wp.tid()
    pixels[i] = new_pixel(sensor, seed, i, see_world(world, view, steps, steps.margin, i))


@wp.kernel
def run_world_pixels(
    world: World,
    view: RayView,
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    start: int,
    sink: Sink,
):
    """Simulate pixels that cast rays over the steps of a chunk, and write the keys of their events to ``sink``.

    Counterpart of :func:`amiwarp.kernels.event_generation.run_pixels`, which uses maps.
    """
    i = start + wp.tid()
    p = pixels[i]
    span = whole_step(steps, p)
    t0 = wp.int64(0)
    for k in range(steps.count):
        p = advance_pixel(p, sensor, sink, i, t0, span, see_world(world, view, steps, steps.margin + k + 1, i))
        t0 += wp.int64(steps.ticks)
        reconverge()
    pixels[i] = shift_times(p, t0)


@wp.kernel
def run_filtered_world_pixels(
    world: World,
    view: RayView,
    steps: Steps,
    sensor: SensorParams,
    pixels: wp.array(dtype=Pixel),
    seen: wp.array(dtype=float),
    start: int,
    sink: Sink,
):
    """Simulate pixels that cast rays and whose photoreceptors have limited bandwidth, over the steps of a chunk.

    ``seen``: last log intensity that entered each photoreceptor.
    """
    i = start + wp.tid()
    p = pixels[i]
    before = last_input(seen[i])
    span = whole_step(steps, p)
    t0 = wp.int64(0)
    for k in range(steps.count):
        after = next_input(see_world(world, view, steps, steps.margin + k + 1, i), before)
        p = advance_filtered(p, sensor, sink, i, t0, span, before, after)
        before = after
        t0 += wp.int64(steps.ticks)
        reconverge()
    pixels[i] = shift_times(p, t0)
    seen[i] = before.level


@wp.kernel
def see_pixels(world: World, view: RayView, steps: Steps, k: int, start: int, out: wp.array(dtype=float)):
    """Compute the luminance that each pixel sees through the prism at instant ``k``."""
    i = start + wp.tid()
    out[i] = wp.exp(see_world(world, view, steps, k, i)) - view.dark
