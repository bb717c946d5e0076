"""Rays into a scene of another program: where each pixel of each camera looks through its optic at its own angle.

Compensation uses the same models: a renderer that casts these rays sees what compensation takes out.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.event_arrays import EventArrays
from amiwarp.kernels.plate import PlateParams, bent_by_wedge, seen_from
from amiwarp.kernels.refraction import compensate_direction, state_at

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class RayGrid:
    """Pixels of an image through which rays go, every ``stride``-th in both directions."""

    width: int  # number of columns of rays
    height: int  # number of rows of rays
    stride: int  # distance of two columns or rows [px]
    offsets: wp.array(dtype=wp.vec2)  # places of a pixel's rays from its centre [px]
    axes: (
        wp.vec3
    )  # signs of the axes of the renderer's camera frame; amiwarp's is x right, y down, z ahead


@wp.func
def scene_ray(model: Any, x: float, y: float, z: float, w: wp.vec2):
    """Return origin [m] and direction of the ray into the scene that a camera's direction sees through the optic."""
    a, b, c = compensate_direction(model, x, y, z, w[0], w[1])
    return wp.vec3(0.0, 0.0, 0.0), wp.vec3(a, b, c)


@wp.func
def scene_ray(model: PlateParams, x: float, y: float, z: float, w: wp.vec2):
    """Return origin [m] and direction of the ray behind a plate: it starts where the plate shifts the centre."""
    origin = seen_from(model, x, y, z, w)
    return origin, bent_by_wedge(model, x, y, z, w)


@wp.func
def place_of(grid: RayGrid, i: int) -> wp.vec2:
    """Return the place in the image of ray ``i`` of a bundle [px]; order: row, column, sample."""
    samples = grid.offsets.shape[0]
    pixel = i // samples
    row = pixel // grid.width
    column = pixel - row * grid.width
    centre = wp.vec2(float(column * grid.stride), float(row * grid.stride))
    return centre + grid.offsets[i - pixel * samples]


@wp.kernel
def write_rays(
    model: Any,
    camera: CameraParams,
    theta: wp.array(dtype=float),
    grid: RayGrid,
    start: int,
    rays: wp.array(dtype=wp.vec3),
):
    """Write origin and direction of one ray per thread; bundle ``k`` has the optic's angle ``k``.

    The direction of a pixel without a ray is zero.
    """
    i = start + wp.tid()
    size = grid.width * grid.height * grid.offsets.shape[0]
    bundle = i // size
    ray = pixel_to_ray(camera, place_of(grid, i - bundle * size))
    origin, direction = scene_ray(model, ray[0], ray[1], ray[2], state_at(model, theta, bundle))
    if not (wp.isfinite(direction) and wp.isfinite(origin) and wp.length(direction) > 0.0):
        origin = wp.vec3(0.0, 0.0, 0.0)
        direction = wp.vec3(0.0, 0.0, 0.0)
    else:
        direction = wp.normalize(direction)
    rays[2 * i] = wp.cw_mul(grid.axes, origin)
    rays[2 * i + 1] = wp.cw_mul(grid.axes, direction)


@wp.struct
class SceneFrames:
    """Places of cameras and bodies at two times, in the world."""

    cameras_before: wp.array(dtype=wp.transform)
    cameras_after: wp.array(dtype=wp.transform)
    bodies_before: wp.array(dtype=wp.transform)
    bodies_after: wp.array(dtype=wp.transform)


FAR = wp.constant(1.0e6)  # distance of what no ray hits [m]


@wp.kernel
def find_flow(
    camera: CameraParams,
    grid: RayGrid,
    rays: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    body: wp.array(dtype=int),
    frames: SceneFrames,
    start: int,
    flow: wp.array(dtype=wp.vec2),
):
    """Find by how much what each pixel sees without the optic moves in the image from one time to another [px].

    One bundle of rays serves all cameras. ``distance``: of what a ray hits [m], 0 if nothing. ``body``: its row among
    the bodies, negative if it rests. NaN where the point leaves the image plane.
    """
    i = start + wp.tid()
    size = grid.width * grid.height
    view = i // size
    k = i - view * size
    far = wp.where(distance[i] > 0.0, distance[i], FAR)
    point = wp.transform_point(frames.cameras_before[view], rays[2 * k] + far * rays[2 * k + 1])
    if distance[i] > 0.0 and body[i] >= 0:
        inside = wp.transform_point(wp.transform_inverse(frames.bodies_before[body[i]]), point)
        point = wp.transform_point(frames.bodies_after[body[i]], inside)
    seen = wp.transform_point(wp.transform_inverse(frames.cameras_after[view]), point)
    flow[i] = ray_to_pixel(camera, wp.cw_mul(grid.axes, seen)) - place_of(grid, k)


@wp.kernel
def find_longest(
    flow: wp.array(dtype=wp.vec2),
    counts: wp.array(dtype=wp.uint8),
    size: int,
    start: int,
    longest: wp.array(dtype=float),
):
    """Find the length of the longest vector; NaN does not count.

    ``counts``: 1 for each camera whose vectors count. ``size``: number of vectors of a camera.
    """
    i = start + wp.tid()
    length = wp.length(flow[i])
    if wp.isfinite(length) and counts[i // size] == wp.uint8(1):
        wp.atomic_max(longest, 0, length)


@wp.kernel
def blend_frames(
    before: wp.array(dtype=wp.transform),
    after: wp.array(dtype=wp.transform),
    fraction: float,
    start: int,
    out: wp.array(dtype=wp.transform),
):
    """Interpolate places linearly, and orientations on the shorter arc."""
    i = start + wp.tid()
    a = before[i]
    b = after[i]
    place = (1.0 - fraction) * wp.transform_get_translation(a)
    place += fraction * wp.transform_get_translation(b)
    p = wp.transform_get_rotation(a)
    q = wp.transform_get_rotation(b)
    if wp.dot(p, q) < 0.0:
        q = -q
    mixed = wp.quat_slerp(p, q, fraction)
    # The slerp of equal orientations may divide by the sine of 0
    if wp.dot(p, q) > 0.999999:
        mixed = wp.normalize((1.0 - fraction) * p + fraction * q)
    out[i] = wp.transform(place, mixed)


@wp.kernel
def blend_points(
    before: wp.array(dtype=wp.vec3),
    after: wp.array(dtype=wp.vec3),
    fraction: float,
    start: int,
    out: wp.array(dtype=wp.vec3),
):
    """Interpolate points linearly."""
    i = start + wp.tid()
    out[i] = (1.0 - fraction) * before[i] + fraction * after[i]


@wp.kernel
def name_surfaces(
    hit: wp.array(dtype=wp.uint32),
    bodies: wp.array(dtype=int),
    start: int,
    shape: wp.array(dtype=int),
    body: wp.array(dtype=int),
):
    """Find shape and body of what rays hit. ``bodies``: row of the body of each shape; a greater number is nothing.

    What is no rigid shape, such as a particle, rests.
    """
    i = start + wp.tid()
    shape[i] = -1
    body[i] = -1
    if hit[i] < wp.uint32(bodies.shape[0]):
        shape[i] = int(hit[i])
        body[i] = bodies[int(hit[i])]


@wp.kernel
def mount_cameras(
    bodies: wp.array(dtype=wp.transform),
    body: wp.array(dtype=int),
    pose: wp.array(dtype=wp.transform),
    start: int,
    out: wp.array(dtype=wp.transform),
):
    """Find the place of each camera in the world. ``pose``: in the frame of its body; in the world without one."""
    k = start + wp.tid()
    if body[k] < 0:
        out[k] = pose[k]
    else:
        out[k] = wp.transform_multiply(bodies[body[k]], pose[k])


@wp.kernel
def look_up_rays(
    rays: wp.array(dtype=wp.vec3),
    bundles: int,
    samples: int,
    wide: CameraParams,
    axes: wp.vec3,
    factor: float,
    pictures: wp.array3d(dtype=wp.vec3),
    start: int,
    out: wp.array(dtype=wp.vec3),
):
    """Look up in pictures without the optic what each pixel's rays see, bilinearly, and average over the rays.

    ``pictures``: axes camera, row, column, of the pinhole camera ``wide``; ``factor``: their unit. A ray beyond a
    picture's edge sees the edge.
    """
    i = start + wp.tid()
    size = rays.shape[0] // (2 * samples * bundles)
    view = i // size
    bundle = view % bundles
    first = (bundle * size + i - view * size) * samples
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(samples):
        ray = wp.cw_mul(axes, rays[2 * (first + k) + 1])
        depth = wp.max(ray[2], 1.0e-6)
        x = wp.clamp(wide.fx * ray[0] / depth + wide.cx, 0.0, float(wide.width - 1))
        y = wp.clamp(wide.fy * ray[1] / depth + wide.cy, 0.0, float(wide.height - 1))
        column = wp.min(int(x), wide.width - 2)
        row = wp.min(int(y), wide.height - 2)
        u = x - float(column)
        v = y - float(row)
        upper = (1.0 - u) * pictures[view, row, column] + u * pictures[view, row, column + 1]
        row += 1
        lower = (1.0 - u) * pictures[view, row, column] + u * pictures[view, row, column + 1]
        total += (1.0 - v) * upper + v * lower
    out[i] = total * (factor / float(samples))


@wp.struct
class WideView:
    """A larger view without the optic, and what its pixels show."""

    camera: CameraParams  # its intrinsics
    axes: wp.vec3  # signs of the axes of the renderer's camera frame
    farthest: float  # unit of its depth, which is at most 1 [m]
    geoms: int  # number of geometries of a world


@wp.kernel
def look_up_surfaces(
    rays: wp.array(dtype=wp.vec3),
    view: WideView,
    depth: wp.array3d(dtype=float),
    hit: wp.array3d(dtype=wp.vec2i),
    start: int,
    distance: wp.array(dtype=float),
    shape: wp.array(dtype=int),
    body: wp.array(dtype=int),
):
    """Look up what the nearest pixel of a larger view shows to each ray, one bundle for all cameras.

    ``depth``: along the axis, relative to the farthest. ``hit``: number and kind of an object; kind 5 is a geometry.
    """
    i = start + wp.tid()
    size = rays.shape[0] // 2
    world = i // size
    ray = wp.cw_mul(view.axes, rays[2 * (i - world * size) + 1])
    ahead = wp.max(ray[2], 1.0e-6)
    column = int(wp.floor(view.camera.fx * ray[0] / ahead + view.camera.cx + 0.5))
    row = int(wp.floor(view.camera.fy * ray[1] / ahead + view.camera.cy + 0.5))
    column = wp.clamp(column, 0, view.camera.width - 1)
    row = wp.clamp(row, 0, view.camera.height - 1)
    found = hit[world, row, column]
    part = depth[world, row, column]
    distance[i] = 0.0
    shape[i] = -1
    body[i] = -1
    if found[0] >= 0 and part > 0.0 and part < 1.0:
        distance[i] = part * view.farthest / ahead
        if found[1] == 5:
            shape[i] = found[0]
            body[i] = world * view.geoms + found[0]


@wp.kernel
def join_places(
    position: wp.array(dtype=wp.vec3),
    matrix: wp.array(dtype=wp.mat33),
    start: int,
    out: wp.array(dtype=wp.transform),
):
    """Make transforms of positions and rotation matrices."""
    i = start + wp.tid()
    out[i] = wp.transform(position[i], wp.normalize(wp.quat_from_matrix(matrix[i])))


@wp.kernel
def split_places(
    places: wp.array(dtype=wp.transform),
    start: int,
    position: wp.array(dtype=wp.vec3),
    matrix: wp.array(dtype=wp.mat33),
):
    """Make positions and rotation matrices of transforms."""
    i = start + wp.tid()
    position[i] = wp.transform_get_translation(places[i])
    matrix[i] = wp.quat_to_matrix(wp.transform_get_rotation(places[i]))


@wp.kernel
def gather_events(
    events: EventArrays,
    edges: wp.array(dtype=int),
    shift: wp.array(dtype=int),
    start: int,
    columns: EventArrays,
):
    """Copy the events of a step, sorted by camera, behind the events of earlier steps of their camera.

    ``edges``: index of the first event of each camera, then their number; ``shift``: from it to its new place.
    """
    i = start + wp.tid()
    # The last camera that starts at or before the event
    camera = wp.lower_bound(edges, i + 1) - 1
    k = i + shift[camera]
    columns.x[k] = events.x[i]
    columns.y[k] = events.y[i]
    columns.t[k] = events.t[i]
    columns.p[k] = events.p[i]
