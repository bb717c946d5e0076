"""Light that pixels receive from a simulated world: rays from every pixel through the prism into the world."""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray
from amiwarp.kernels.exact import ExactParams
from amiwarp.kernels.plate import PlateParams, bent_by_wedge, seen_from
from amiwarp.kernels.prism_view import Steps, ray_without_prisms
from amiwarp.simulation.kernels.edges import NAN, FirstHits, on_edge
from amiwarp.simulation.kernels.image_tiles import place_in_tile
from amiwarp.simulation.kernels.ray_casting import FAR, Hit, cast, meet_face
from amiwarp.simulation.kernels.world import Pose, World
from amiwarp.simulation.kernels.world_light import illumination, luminance, radiance, sky

wp.set_module_options({"enable_backward": False})


@wp.struct
class RayView:
    """Camera and prism, and the camera's pose at every instant of a chunk of simulated time."""

    camera: CameraParams  # camera model
    prism: ExactParams  # prism model
    second: ExactParams  # second prism of a pair; without one, its apex angle is 0
    steered: int  # 1 if the camera looks through a beam steerer, else 0
    plate: PlateParams  # plate model; thickness 0 without a plate
    poses: wp.array(dtype=Pose)  # pose of the camera at each instant
    # Rays of a pixel: x and y relative to the pixel's centre [px], and weight
    aperture: wp.array(dtype=wp.vec3)
    reach: int  # largest distance of these rays from the pixel's centre, rounded up [px]
    cone: float  # angular width of these rays [rad]


@wp.func
def look_through(view: RayView, steps: Steps, k: int, x: float, y: float) -> wp.vec3:
    """Return the unit vector in the world's frame along which a point of the image looks at instant ``k``."""
    ray = pixel_to_ray(view.camera, wp.vec2(x, y))
    at = steps.at[k]
    ray = ray_without_prisms(view.prism, view.second, view.steered, ray, at.azimuth, at.second)
    ray = bent_by_wedge(view.plate, ray[0], ray[1], ray[2], steps.at[k].azimuth)
    return view.poses[k].rotation * wp.normalize(ray)


@wp.func
def look_from(view: RayView, steps: Steps, k: int, x: float, y: float) -> wp.vec3:
    """Return the place in the world's frame from which a point of the image looks at instant ``k``."""
    if view.plate.thickness == 0.0:
        return view.poses[k].position
    ray = pixel_to_ray(view.camera, wp.vec2(x, y))
    centre = seen_from(view.plate, ray[0], ray[1], ray[2], steps.at[k].azimuth)
    return view.poses[k].position + view.poses[k].rotation * centre


@wp.struct
class Batch:
    """Pixels at several successive instants whose rays are cast together.

    Arrays of a batch hold all pixels of one instant, row by row, after the pixels of the instant before.
    """

    first: int  # number of the first instant
    count: int  # number of instants
    # Number of instants in :class:`Steps` for each instant of the batch: 1, or the height of the image if each of its
    # rows has its own
    rows: int
    hits: FirstHits  # result of the ray through the centre of each pixel


@wp.struct
class Sample:
    """Pixel at an instant of a batch."""

    at: int  # index in the arrays of the batch
    base: int  # index of the instant's first pixel in these arrays
    k: int  # index of the instant in :class:`Steps`
    col: int  # column [px]
    row: int  # row [px]


@wp.func
def sample_at(view: RayView, batch: Batch, j: int, i: int) -> Sample:
    """Return pixel number ``i`` at instant number ``j`` of a batch."""
    s = Sample()
    s.base = j * (view.camera.width * view.camera.height)
    s.at = s.base + i
    s.row = i / view.camera.width
    s.col = i - s.row * view.camera.width
    s.k = (batch.first + j) * batch.rows + wp.min(s.row, batch.rows - 1)
    return s


@wp.func
def place_at(view: RayView, batch: Batch, place: int) -> Sample:
    """Return the sample at a place in the order of the list of edges: by tile, then by pixel, then by instant.

    Outside of the image, the index of the sample is -1.
    """
    i = place_in_tile(view.camera.width, view.camera.height, place / batch.count)
    s = sample_at(view, batch, place % batch.count, i)
    s.at = wp.where(i < 0, -1, s.at)
    return s


@wp.kernel
def cast_centres(world: World, view: RayView, steps: Steps, start: int, batch: Batch):
    """Cast one ray through the centre of each pixel at the instants of a batch.

    The threads follow tiles of the image, because a search of the world is fast if neighbouring threads search alike.
    """
    i = place_in_tile(view.camera.width, view.camera.height, start + wp.tid())
    if i < 0:
        return
    for j in range(batch.count):
        s = sample_at(view, batch, j, i)
        origin = look_from(view, steps, s.k, float(s.col), float(s.row))
        direction = look_through(view, steps, s.k, float(s.col), float(s.row))
        hit = cast(world, s.k, origin, direction, FAR)
        white = illumination(world, s.k, origin, direction, hit)
        batch.hits.face[s.at] = hit.face
        batch.hits.white[s.at] = white
        batch.hits.normal[s.at] = hit.normal
        if view.aperture.shape[0] == 1:
            batch.hits.light[s.at] = luminance(world, direction, hit, view.cone, white)


@wp.func
def meet_around(
    world: World, view: RayView, batch: Batch, s: Sample, origin: wp.vec3, direction: wp.vec3
) -> Hit:
    """Return the nearest surface on a ray among the faces that a pixel and its eight neighbours see.

    ``direction``: unit vector. The normal is that at the pixel's centre. If the ray hits none of these faces, the face
    is -1.
    """
    hit = Hit()
    hit.distance = FAR
    hit.face = -1
    hit.normal = batch.hits.normal[s.at]
    last = int(-1)
    for n in range(9):
        row = wp.clamp(s.row + n / 3 - 1, 0, view.camera.height - 1)
        col = wp.clamp(s.col + n % 3 - 1, 0, view.camera.width - 1)
        face = batch.hits.face[s.base + row * view.camera.width + col]
        if face != last:
            last = face
            met = meet_face(world, s.k, face, origin, direction)
            if met[0] < hit.distance:
                hit.distance = met[0]
                hit.face = face
                hit.u = met[1]
                hit.v = met[2]
    return hit


@wp.func
def smooth_light(world: World, view: RayView, steps: Steps, batch: Batch, s: Sample) -> float:
    """Return the luminance of a pixel that sees no edge; NaN if a ray misses all faces nearby.

    The rays of the pixel's aperture are tested only against the faces that centres of pixels see nearby, which saves a
    search of the world, and are in the light of the pixel's centre.
    """
    total = float(0.0)
    white = batch.hits.white[s.at]
    for j in range(view.aperture.shape[0]):
        ray = view.aperture[j]
        x = float(s.col) + ray[0]
        y = float(s.row) + ray[1]
        weight = ray[2]
        direction = look_through(view, steps, s.k, x, y)
        if batch.hits.face[s.at] < 0:
            total += weight * sky(world, direction)
        else:
            origin = look_from(view, steps, s.k, x, y)
            hit = meet_around(world, view, batch, s, origin, direction)
            if hit.face < 0:
                return NAN
            total += weight * luminance(world, direction, hit, view.cone, white)
    return total


@wp.kernel
def smooth_insides(
    world: World, view: RayView, steps: Steps, batch: Batch, start: int, marks: wp.array(dtype=int)
):
    """Compute the luminance of the pixels that see no edge, and mark all other pixels with 1.

    The marks are in the order of :func:`place_at`.
    """
    t = start + wp.tid()
    places = marks.shape[0] / batch.count
    place = t % places * batch.count + t / places
    s = place_at(view, batch, place)
    marks[place] = 0
    if s.at < 0:
        return
    width = view.camera.width
    height = view.camera.height
    pixel = s.at - s.base
    light = float(NAN)
    if not on_edge(world, batch.hits, s.base, width, height, view.reach, pixel):
        light = smooth_light(world, view, steps, batch, s)
    batch.hits.light[s.at] = light
    marks[place] = wp.where(wp.isnan(light), 1, 0)


@wp.kernel
def list_marked(ends: wp.array(dtype=int), start: int, out: wp.array(dtype=int)):
    """List the indices of marked elements in ascending order. ``ends``: running sum of the marks."""
    i = start + wp.tid()
    slot = wp.where(i > 0, ends[wp.max(i - 1, 0)], 0)
    if ends[i] > slot:
        out[slot] = i


@wp.kernel
def cast_edges(
    world: World,
    view: RayView,
    steps: Steps,
    batch: Batch,
    listed: wp.array(dtype=int),
    start: int,
    out: wp.array(dtype=float),
):
    """Cast the rays of the apertures of listed pixels, and store the weighted luminance of each ray."""
    t = start + wp.tid()
    rays = view.aperture.shape[0]
    s = place_at(view, batch, listed[t / rays])
    ray = view.aperture[t % rays]
    x = float(s.col) + ray[0]
    y = float(s.row) + ray[1]
    weight = ray[2]
    direction = look_through(view, steps, s.k, x, y)
    origin = look_from(view, steps, s.k, x, y)
    out[t] = weight * radiance(world, s.k, origin, direction, view.cone)


@wp.kernel
def add_edges(
    view: RayView,
    batch: Batch,
    listed: wp.array(dtype=int),
    cast: wp.array(dtype=float),
    start: int,
):
    """Add up the luminance of the rays of each listed pixel."""
    t = start + wp.tid()
    rays = view.aperture.shape[0]
    total = float(0.0)
    for j in range(rays):
        total += cast[t * rays + j]
    batch.hits.light[place_at(view, batch, listed[t]).at] = total
