"""Light that pixels receive from a simulated world: rays from every pixel through the prism into the world."""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.plate import PlateParams, bent_by_wedge, seen_from
from amiwarp.kernels.prism_view import Steps, View, ray_without_prisms
from amiwarp.kernels.refraction import ExactParams
from amiwarp.kernels.world import (
    FAR,
    NAN,
    FirstHits,
    Hit,
    Pose,
    World,
    body_of,
    cast,
    illumination,
    luminance,
    meet_face,
    on_edge,
    place_in_tile,
    radiance,
    sky,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class RayView:
    """Camera and prism, and the camera's pose at every instant of a chunk of simulated time."""

    camera: CameraParams  # camera model
    prism: ExactParams  # prism model
    second: ExactParams  # second prism of a pair; without one, its apex angle is 0
    plate: PlateParams  # plate model; thickness 0 without a plate
    poses: wp.array(dtype=Pose)  # pose of the camera at each instant
    aperture: wp.array(dtype=wp.vec3)  # rays of a pixel: x and y relative to the pixel's centre [px], and weight
    reach: int  # largest distance of these rays from the pixel's centre, rounded up [px]
    cone: float  # angular width of these rays [rad]


@wp.func
def look_through(view: RayView, steps: Steps, k: int, x: float, y: float) -> wp.vec3:
    """Return the unit vector in the world's frame along which a point of the image looks at instant ``k``."""
    ray = pixel_to_ray(view.camera, wp.vec2(x, y))
    ray = ray_without_prisms(view.prism, view.second, ray, steps.at[k].azimuth, steps.at[k].second)
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

    Arrays of a batch hold all pixels of one instant, row by row, after those of the instant before.
    """

    first: int  # index of the first instant in :class:`Steps`
    count: int  # number of instants
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
    s.k = batch.first + j
    s.row = i / view.camera.width
    s.col = i - s.row * view.camera.width
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
def meet_around(world: World, view: RayView, batch: Batch, s: Sample, origin: wp.vec3, direction: wp.vec3) -> Hit:
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
    for j in range(view.aperture.shape[0]):
        a = view.aperture[j]
        direction = look_through(view, steps, s.k, float(s.col) + a[0], float(s.row) + a[1])
        if batch.hits.face[s.at] < 0:
            total += a[2] * sky(world, direction)
        else:
            origin = look_from(view, steps, s.k, float(s.col) + a[0], float(s.row) + a[1])
            hit = meet_around(world, view, batch, s, origin, direction)
            if hit.face < 0:
                return NAN
            total += a[2] * luminance(world, direction, hit, view.cone, batch.hits.white[s.at])
    return total


@wp.kernel
def smooth_insides(world: World, view: RayView, steps: Steps, batch: Batch, start: int, marks: wp.array(dtype=int)):
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
    height = view.camera.height
    light = float(NAN)
    if not on_edge(world, batch.hits, s.base, view.camera.width, height, view.reach, s.at - s.base):
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
    world: World, view: RayView, steps: Steps, batch: Batch, listed: wp.array(dtype=int), start: int,
    out: wp.array(dtype=float),
):  # fmt: skip
    """Cast the rays of the apertures of listed pixels, and store the weighted luminance of each ray."""
    t = start + wp.tid()
    rays = view.aperture.shape[0]
    s = place_at(view, batch, listed[t / rays])
    a = view.aperture[t % rays]
    direction = look_through(view, steps, s.k, float(s.col) + a[0], float(s.row) + a[1])
    origin = look_from(view, steps, s.k, float(s.col) + a[0], float(s.row) + a[1])
    out[t] = a[2] * radiance(world, s.k, origin, direction, view.cone)


@wp.kernel
def add_edges(view: RayView, batch: Batch, listed: wp.array(dtype=int), cast: wp.array(dtype=float), start: int):
    """Add up the luminance of the rays of each listed pixel."""
    t = start + wp.tid()
    rays = view.aperture.shape[0]
    total = float(0.0)
    for j in range(rays):
        total += cast[t * rays + j]
    batch.hits.light[place_at(view, batch, listed[t]).at] = total


# Visible surfaces of a simulated world: the surface at each pixel, and the surface that each event saw.


@wp.struct
class Surfaces:
    """Surface that each ray hits first."""

    depth: wp.array(dtype=float)  # distance along the optical axis [m]; infinite for the sky
    normal: wp.array(dtype=wp.vec3)  # unit normal in the world's frame; zero for the sky
    instance: wp.array(dtype=int)  # instance number of the body; 0 for the sky
    mover: wp.array(dtype=int)  # number of the moving body; -1 for a body at rest or the sky
    place: wp.array(dtype=wp.vec3)  # point in the world's frame [m]


@wp.func
def instance_of(world: World, face: int) -> int:
    """Return the instance number of a face; 0 for the sky."""
    if face < 0:
        return 0
    return world.surfaces[world.body[face]].instance


@wp.kernel
def find_surfaces(
    world: World, instant: int, rays: wp.array(dtype=wp.vec3), centres: wp.array(dtype=wp.vec3), pose: Pose, start: int,
    out: Surfaces,
):  # fmt: skip
    """Find the surfaces that unit rays from a camera hit. A ray of NaN counts as seeing the sky.

    ``rays``: directions in the camera's frame; ``centres``: where they begin in this frame, empty if they begin at its
    origin; ``pose``: pose of the camera.
    """
    i = start + wp.tid()
    ray = rays[i]
    centre = wp.vec3(0.0, 0.0, 0.0)
    if centres.shape[0] > 0:
        centre = centres[i]
    origin = pose.position + pose.rotation * centre
    direction = pose.rotation * ray
    hit = cast(world, instant, origin, direction, FAR)
    out.depth[i] = wp.where(hit.face < 0, wp.inf, centre[2] + hit.distance * ray[2])
    out.normal[i] = hit.normal
    out.instance[i] = instance_of(world, hit.face)
    out.mover[i] = hit.mover
    out.place[i] = origin + hit.distance * direction


@wp.kernel
def find_centres(
    view: RayView, azimuth: wp.vec2, rays: wp.array(dtype=wp.vec3), start: int, out: wp.array(dtype=wp.vec3),
    bent: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Compute the place in the camera's frame from which each ray looks through the plate, and its direction there."""
    i = start + wp.tid()
    out[i] = seen_from(view.plate, rays[i][0], rays[i][1], rays[i][2], azimuth)
    bent[i] = bent_by_wedge(view.plate, rays[i][0], rays[i][1], rays[i][2], azimuth)


# -- the surface that each event saw


@wp.struct
class SeenSurfaces:
    """Surface that the pixel of each event saw through the prism when it fired."""

    instance: wp.array(dtype=wp.uint16)  # instance number of the body; 0 for the sky
    depth: wp.array(dtype=float)  # distance along the optical axis [m]; infinite for the sky
    place: wp.array(dtype=wp.vec3)  # point in the world's frame [m]; NaN for the sky


@wp.struct
class Met:
    """Face that a ray hits, and the distance to this face."""

    face: int  # number of the face; -1 for the sky
    distance: float  # distance along the ray [m]; FAR for the sky, or if the face is not yet known


@wp.func
def between(a: Pose, b: Pose, share: float) -> Pose:
    """Interpolate between two poses that differ little.

    ``share``: fraction of the way from ``a`` to ``b``. The error of the rotation is of third order in the angle.
    """
    p = Pose()
    p.position = a.position + share * (b.position - a.position)
    r = a.rotation + share * (b.rotation - a.rotation)
    x = wp.normalize(wp.vec3(r[0, 0], r[1, 0], r[2, 0]))
    y = wp.vec3(r[0, 1], r[1, 1], r[2, 1])
    y = wp.normalize(y - wp.dot(x, y) * x)
    p.rotation = wp.matrix_from_cols(x, y, wp.cross(x, y))
    return p


@wp.func
def texel_near(view: View, steps: Steps, k: int, ray: wp.vec3) -> int:
    """Return the index, in the array of all maps, of the texel nearest to a ray of the camera.

    The texel belongs to the map nearest in time to instant ``k``. ``ray``: direction in the camera's frame.
    """
    at = steps.at[k]
    h = at.to_texel * (wp.transpose(view.prism.axis) * ray)
    col = wp.clamp(int(h[0] / h[2] + 0.5), 1, view.width - 2)
    row = wp.clamp(int(h[1] / h[2] + 0.5), 1, view.height - 2)
    slot = wp.where(at.weight > 0.5, at.after, at.before)
    return (slot * view.height + row) * view.width + col


@wp.func
def meet_near(
    world: World, instant: int, faces: wp.array(dtype=int), texel: int, width: int, origin: wp.vec3, direction: wp.vec3
) -> Met:
    """Return the nearest face that a ray hits among the faces of a texel and its eight neighbours.

    The distance is FAR if the ray hits none of these faces, or if the texels see several bodies: the ray may then hit
    a face that lies between texels. ``width``: width of a map [texels].
    """
    met = Met()
    met.face = -1
    met.distance = FAR
    body = body_of(world, faces[texel])
    last = int(-1)
    for k in range(9):
        face = faces[texel + (k / 3 - 1) * width + k % 3 - 1]
        if face != last:
            if body_of(world, face) != body or body < 0:
                met.distance = FAR
                return met
            last = face
            distance = meet_face(world, instant, face, origin, direction)[0]
            if distance < met.distance:
                met.face = face
                met.distance = distance
    return met


@wp.func
def meet_anywhere(world: World, instant: int, origin: wp.vec3, direction: wp.vec3) -> Met:
    """Return the nearest face of the whole world that a ray hits."""
    hit = cast(world, instant, origin, direction, FAR)
    met = Met()
    met.face = hit.face
    met.distance = hit.distance
    return met


@wp.kernel
def find_seen_surfaces(
    world: World,
    view: View,
    steps: Steps,
    poses: wp.array(dtype=Pose),
    faces: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec2),
    ticks: wp.array(dtype=int),
    start: int,
    out: SeenSurfaces,
):
    """Find the surface that each event saw at the time of its threshold crossing.

    ``poses``: pose of the camera at each instant of ``steps``; ``faces``: face of each texel of all maps, empty without
    maps; ``points``: pixel without the prism of each event's scene point [px]; ``ticks``: time of each crossing since
    the first instant. Moving bodies have the pose of the nearest instant, which displaces them by half a pixel at most.
    """
    i = start + wp.tid()
    k = wp.clamp(ticks[i] / steps.ticks, 0, steps.margin + steps.count - 1)
    share = wp.clamp(float(ticks[i] - k * steps.ticks) / float(steps.ticks), 0.0, 1.0)
    ray = pixel_to_ray(view.camera, points[i])
    pose = between(poses[k], poses[k + 1], share)
    direction = pose.rotation * ray
    nearest = k + int(share + 0.5)
    met = Met()
    met.distance = FAR
    if faces.shape[0] > 0:
        texel = texel_near(view, steps, nearest, ray)
        met = meet_near(world, nearest, faces, texel, view.width, pose.position, direction)
    if met.distance == FAR:
        met = meet_anywhere(world, nearest, pose.position, direction)
    out.instance[i] = wp.uint16(instance_of(world, met.face))
    out.depth[i] = wp.where(met.face < 0, wp.inf, met.distance * ray[2])
    out.place[i] = wp.where(met.face < 0, wp.vec3(NAN, NAN, NAN), pose.position + met.distance * direction)


@wp.kernel
def find_surfaces_through_plate(
    world: World, view: RayView, steps: Steps, ticks: wp.array(dtype=int), start: int, points: wp.array(dtype=wp.vec2),
    out: SeenSurfaces,
):  # fmt: skip
    """Find the surface that each event saw through the plate, and replace its pixel by that without the plate.

    ``points``: pixel of each event [px]; ``ticks``: as in :func:`find_seen_surfaces`.
    """
    i = start + wp.tid()
    k = wp.clamp(ticks[i] / steps.ticks, 0, steps.margin + steps.count - 1)
    share = wp.clamp(float(ticks[i] - k * steps.ticks) / float(steps.ticks), 0.0, 1.0)
    angle = steps.angle[k] + steps.turn[k] * share
    ray = pixel_to_ray(view.camera, points[i])
    pose = between(view.poses[k], view.poses[k + 1], share)
    azimuth = wp.vec2(wp.cos(angle), wp.sin(angle))
    centre = seen_from(view.plate, ray[0], ray[1], ray[2], azimuth)
    ray = bent_by_wedge(view.plate, ray[0], ray[1], ray[2], azimuth)
    met = meet_anywhere(world, k + int(share + 0.5), pose.position + pose.rotation * centre, pose.rotation * ray)
    place = centre + met.distance * ray
    out.instance[i] = wp.uint16(instance_of(world, met.face))
    out.depth[i] = wp.where(met.face < 0, wp.inf, place[2])
    out.place[i] = wp.where(met.face < 0, wp.vec3(NAN, NAN, NAN), pose.position + pose.rotation * place)
    if met.face >= 0:
        points[i] = ray_to_pixel(view.camera, place)
