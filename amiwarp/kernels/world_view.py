"""Device side of worlds: the maps and views that are rendered of them, and what each event saw."""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray
from amiwarp.kernels.prism_view import Steps, View
from amiwarp.kernels.refraction import ExactParams, trace
from amiwarp.kernels.world import FAR, Pose, World, cast, radiance, shade

wp.set_module_options({"enable_backward": False})

NAN = wp.constant(float("nan"))
CONTRAST = wp.constant(0.1)  # difference over sum of two texels' light, above which they are sampled more finely
LEAST_LIGHT = wp.constant(0.04)


@wp.struct
class MapFrame:
    """A plane at distance 1 before a point, that rays are cast through."""

    pose: Pose  # the frame's, whose z axis is the plane's normal
    left: float  # plane coordinates of the map's corner
    top: float
    pitch_x: float  # texels per unit
    pitch_y: float
    width: int
    height: int
    offsets: wp.array(dtype=wp.vec2)  # of the samples of a texel, from its centre [texels]
    cone: float  # angular width of a sample [rad]
    instant: int  # row of the world's poses


@wp.func
def map_direction(f: MapFrame, x: float, y: float) -> wp.vec3:
    """Direction in the world through texel coordinates, whose whole numbers are texel centres."""
    plane = wp.vec3(f.left + (x + 0.5) / f.pitch_x, f.top + (y + 0.5) / f.pitch_y, 1.0)
    return f.pose.rotation * wp.normalize(plane)


@wp.kernel
def render_map(world: World, f: MapFrame, start: int, light: wp.array(dtype=float), body: wp.array(dtype=int)):
    """Render one ray per texel, through its centre: luminance, and the body that it hits."""
    i = start + wp.tid()
    row = i / f.width
    col = i - row * f.width
    origin = f.pose.position
    direction = map_direction(f, float(col), float(row))
    hit = cast(world, f.instant, origin, direction, FAR)
    light[i] = shade(world, f.instant, origin, direction, hit, f.cone)
    body[i] = -1
    if hit.face >= 0:
        body[i] = world.body[hit.face]


@wp.func
def differs(f: MapFrame, light: wp.array(dtype=float), body: wp.array(dtype=int), col: int, row: int) -> bool:
    """Return whether any of the eight neighbours of a texel shows another body, or light of clear contrast."""
    here = row * f.width + col
    found = bool(False)
    for k in range(9):
        c = wp.clamp(col + k % 3 - 1, 0, f.width - 1)
        r = wp.clamp(row + k / 3 - 1, 0, f.height - 1)
        there = r * f.width + c
        apart = wp.abs(light[there] - light[here])
        found = found or body[there] != body[here] or apart > CONTRAST * (light[here] + light[there] + LEAST_LIGHT)
    return found


@wp.kernel
def refine_map(
    world: World, f: MapFrame, light: wp.array(dtype=float), body: wp.array(dtype=int), start: int,
    out: wp.array(dtype=float),
):  # fmt: skip
    """Replace the luminance of texels at edges by the mean of several rays."""
    i = start + wp.tid()
    row = i / f.width
    col = i - row * f.width
    value = float(light[i])
    if differs(f, light, body, col, row):
        value = float(0.0)
        for k in range(f.offsets.shape[0]):
            direction = map_direction(f, float(col) + f.offsets[k][0], float(row) + f.offsets[k][1])
            value += radiance(world, f.instant, f.pose.position, direction, f.cone) / float(f.offsets.shape[0])
    out[i] = value


@wp.kernel
def blur_lines(
    image: wp.array(dtype=float), weights: wp.array(dtype=float), width: int, height: int, across: int, start: int,
    out: wp.array(dtype=float),
):  # fmt: skip
    """Convolve along rows (``across`` 0) or columns (1); the border's texels are repeated."""
    i = start + wp.tid()
    row = i / width
    col = i - row * width
    half = weights.shape[0] / 2
    total = float(0.0)
    for k in range(weights.shape[0]):
        c = wp.clamp(col + wp.where(across == 0, k - half, 0), 0, width - 1)
        r = wp.clamp(row + wp.where(across == 1, k - half, 0), 0, height - 1)
        total += weights[k] * image[r * width + c]
    out[i] = total


@wp.func
def log_texel(light: wp.array(dtype=float), width: int, height: int, col: int, row: int, dark: float) -> float:
    return wp.log(light[wp.min(row, height - 1) * width + wp.min(col, width - 1)] + dark)


@wp.kernel
def log_pieces(
    light: wp.array(dtype=float), width: int, height: int, dark: float, first: int, start: int,
    out: wp.array(dtype=wp.vec4),
):  # fmt: skip
    """Log intensity, as the four numbers of each texel's bilinear piece, from place ``first`` on."""
    i = start + wp.tid()
    row = i / width
    col = i - row * width
    a = log_texel(light, width, height, col, row, dark)
    b = log_texel(light, width, height, col + 1, row, dark) - a
    c = log_texel(light, width, height, col, row + 1, dark) - a
    d = log_texel(light, width, height, col + 1, row + 1, dark) - a - b - c
    out[first + i] = wp.vec4(a, b, c, d)


# -- views without the prism: what stands where


@wp.struct
class Surfaces:
    """What each pixel sees."""

    depth: wp.array(dtype=float)  # along the camera's axis [m]; infinite for the sky
    normal: wp.array(dtype=wp.vec3)  # in the world's frame
    instance: wp.array(dtype=int)
    mover: wp.array(dtype=int)  # number of the moving body; -1 for what rests
    place: wp.array(dtype=wp.vec3)  # in the world's frame [m]


@wp.func
def instance_of(world: World, face: int) -> int:
    if face < 0:
        return 0
    return world.surfaces[world.body[face]].instance


@wp.kernel
def find_surfaces(world: World, instant: int, rays: wp.array(dtype=wp.vec3), pose: Pose, start: int, out: Surfaces):
    """What unit rays in the camera's frame meet; NaN for a ray that is none."""
    i = start + wp.tid()
    ray = rays[i]
    direction = pose.rotation * ray
    hit = cast(world, instant, pose.position, direction, FAR)
    out.depth[i] = wp.where(hit.face < 0, wp.inf, hit.distance * ray[2])
    out.normal[i] = hit.normal
    out.instance[i] = instance_of(world, hit.face)
    out.mover[i] = hit.mover
    out.place[i] = pose.position + hit.distance * direction


# -- what events saw


@wp.struct
class EventTruth:
    """Per event."""

    instance: wp.array(dtype=wp.uint16)
    depth: wp.array(dtype=float)  # along the camera's axis, without the prism [m]
    place: wp.array(dtype=wp.vec3)  # in the world's frame [m]


@wp.func
def between(a: Pose, b: Pose, share: float) -> Pose:
    """A pose between two that are near each other: the rotation's error is of third order in its angle."""
    p = Pose()
    p.position = a.position + share * (b.position - a.position)
    r = a.rotation + share * (b.rotation - a.rotation)
    x = wp.normalize(wp.vec3(r[0, 0], r[1, 0], r[2, 0]))
    y = wp.vec3(r[0, 1], r[1, 1], r[2, 1])
    y = wp.normalize(y - wp.dot(x, y) * x)
    p.rotation = wp.matrix_from_cols(x, y, wp.cross(x, y))
    return p


@wp.func
def seen_direction(camera: CameraParams, prism: ExactParams, col: int, row: int, angle: float) -> wp.vec3:
    """Direction in the camera's frame in which a pixel looks through the prism, of length one."""
    ray = pixel_to_ray(camera, wp.vec2(float(col), float(row)))
    return wp.normalize(trace(prism, ray, wp.vec2(wp.cos(angle), wp.sin(angle)), prism.flat_to_scene))


@wp.kernel
def find_event_truth(
    world: World,
    view: View,
    steps: Steps,
    poses: wp.array(dtype=Pose),
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    ticks: wp.array(dtype=int),
    start: int,
    out: EventTruth,
):
    """What a pixel saw at the crossing of each event: a ray through the prism at that very time.

    ``poses``: the camera's at each instant of ``steps``; ``ticks``: times from the first of them. Bodies that move are
    where they are at the nearest instant, less than half a pixel off.
    """
    i = start + wp.tid()
    k = wp.clamp(ticks[i] / steps.ticks, 0, steps.margin + steps.count - 1)
    share = wp.clamp(float(ticks[i] - k * steps.ticks) / float(steps.ticks), 0.0, 1.0)
    angle = steps.angle[k] + steps.turn[k] * share
    ray = seen_direction(view.camera, view.prism, int(x[i]), int(y[i]), angle)
    pose = between(poses[k], poses[k + 1], share)
    direction = pose.rotation * ray
    hit = cast(world, k + int(share + 0.5), pose.position, direction, FAR)
    out.instance[i] = wp.uint16(instance_of(world, hit.face))
    out.depth[i] = wp.where(hit.face < 0, wp.inf, hit.distance * ray[2])
    out.place[i] = wp.where(hit.face < 0, wp.vec3(NAN, NAN, NAN), pose.position + hit.distance * direction)
