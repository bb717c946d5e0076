"""Visible surfaces of a simulated world: the surface at each pixel, and the surface that each event saw."""

import warp as wp

from amiwarp.kernels.camera import pixel_to_ray, ray_to_pixel
from amiwarp.kernels.plate import bent_by_wedge, seen_from
from amiwarp.kernels.prism_view import Steps, View
from amiwarp.simulation.kernels.edges import NAN
from amiwarp.simulation.kernels.ray_casting import FAR, blocked, body_of, cast, meet_face
from amiwarp.simulation.kernels.world import Pose, World
from amiwarp.simulation.kernels.world_rays import RayView

wp.set_module_options({"enable_backward": False})


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
    world: World,
    instant: int,
    rays: wp.array(dtype=wp.vec3),
    centres: wp.array(dtype=wp.vec3),
    pose: Pose,
    start: int,
    out: Surfaces,
):
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
def find_hidden(
    world: World,
    starts: wp.array(dtype=wp.vec3),
    places: wp.array(dtype=wp.vec3),
    instants: wp.array(dtype=int),
    share: float,
    start: int,
    hidden: wp.array(dtype=wp.uint8),
):
    """Find the places that a surface hides from where they are looked at, within a ``share`` of the way to them.

    ``starts``, ``places``: ends of the way in the world's frame [m]; ``instants``: index of each one's time.
    """
    i = start + wp.tid()
    way = places[i] - starts[i]
    distance = wp.length(way)
    is_blocked = blocked(world, instants[i], starts[i], way / distance, share * distance)
    hidden[i] = wp.where(is_blocked, wp.uint8(1), wp.uint8(0))


@wp.kernel
def find_centres(
    view: RayView,
    azimuth: wp.vec2,
    rays: wp.array(dtype=wp.vec3),
    start: int,
    out: wp.array(dtype=wp.vec3),
    bent: wp.array(dtype=wp.vec3),
):
    """Compute the place in the camera's frame from which each ray looks through the plate, and its direction there."""
    i = start + wp.tid()
    out[i] = seen_from(view.plate, rays[i][0], rays[i][1], rays[i][2], azimuth)
    bent[i] = bent_by_wedge(view.plate, rays[i][0], rays[i][1], rays[i][2], azimuth)


@wp.struct
class SeenSurfaces:
    """Surface that the pixel of each event saw through the prism when it fired."""

    instance: wp.array(dtype=wp.uint16)  # instance number of the body; 0 for the sky
    depth: wp.array(dtype=float)  # distance along the optical axis [m]; infinite for the sky
    place: wp.array(dtype=wp.vec3)  # point in the world's frame [m]; NaN for the sky


@wp.struct
class FaceHit:
    """Face that a ray hits, and the distance to this face."""

    face: int  # number of the face; -1 for the sky
    distance: float  # distance along the ray [m]; FAR for the sky, or if the face is not yet known


@wp.func
def pose_between(before: Pose, after: Pose, share: float) -> Pose:
    """Interpolate between two poses that differ little.

    ``share``: fraction of the way from ``before`` to ``after``. The error of the rotation is of third order in the
    angle.
    """
    pose = Pose()
    pose.position = before.position + share * (after.position - before.position)
    mean = before.rotation + share * (after.rotation - before.rotation)
    # Its columns are made unit vectors again, at right angles to each other.
    x = wp.normalize(wp.vec3(mean[0, 0], mean[1, 0], mean[2, 0]))
    y = wp.vec3(mean[0, 1], mean[1, 1], mean[2, 1])
    y = wp.normalize(y - wp.dot(x, y) * x)
    pose.rotation = wp.matrix_from_cols(x, y, wp.cross(x, y))
    return pose


@wp.func
def texel_near(view: View, steps: Steps, k: int, ray: wp.vec3) -> int:
    """Return the index, in the array of all maps, of the texel nearest to a ray of the camera.

    The texel belongs to the map nearest in time to instant ``k``. ``ray``: direction in the camera's frame.
    """
    step = steps.at[k]
    # Homogeneous coordinates of the texel
    texel = step.to_texel * (wp.transpose(view.prism.axis) * ray)
    col = wp.clamp(int(texel[0] / texel[2] + 0.5), 1, view.width - 2)
    row = wp.clamp(int(texel[1] / texel[2] + 0.5), 1, view.height - 2)
    slot = wp.where(step.weight > 0.5, step.after, step.before)
    return (slot * view.height + row) * view.width + col


@wp.func
def meet_near(
    world: World,
    instant: int,
    faces: wp.array(dtype=int),
    texel: int,
    width: int,
    origin: wp.vec3,
    direction: wp.vec3,
) -> FaceHit:
    """Return the nearest face that a ray hits among the faces of a texel and its eight neighbours.

    The distance is FAR if the ray hits none of these faces, or if the texels see several bodies: the ray may then hit
    a face that lies between texels. ``width``: width of a map [texels].
    """
    hit = FaceHit()
    hit.face = -1
    hit.distance = FAR
    body = body_of(world, faces[texel])
    last = int(-1)
    for k in range(9):
        face = faces[texel + (k / 3 - 1) * width + k % 3 - 1]
        if face != last:
            if body_of(world, face) != body or body < 0:
                hit.distance = FAR
                return hit
            last = face
            distance = meet_face(world, instant, face, origin, direction)[0]
            if distance < hit.distance:
                hit.face = face
                hit.distance = distance
    return hit


@wp.func
def meet_anywhere(world: World, instant: int, origin: wp.vec3, direction: wp.vec3) -> FaceHit:
    """Return the nearest face of the whole world that a ray hits."""
    nearest = cast(world, instant, origin, direction, FAR)
    hit = FaceHit()
    hit.face = nearest.face
    hit.distance = nearest.distance
    return hit


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
    pose = pose_between(poses[k], poses[k + 1], share)
    direction = pose.rotation * ray
    nearest = k + int(share + 0.5)
    hit = FaceHit()
    hit.distance = FAR
    if faces.shape[0] > 0:
        texel = texel_near(view, steps, nearest, ray)
        hit = meet_near(world, nearest, faces, texel, view.width, pose.position, direction)
    if hit.distance == FAR:
        hit = meet_anywhere(world, nearest, pose.position, direction)
    out.instance[i] = wp.uint16(instance_of(world, hit.face))
    out.depth[i] = wp.where(hit.face < 0, wp.inf, hit.distance * ray[2])
    out.place[i] = wp.where(
        hit.face < 0, wp.vec3(NAN, NAN, NAN), pose.position + hit.distance * direction
    )


@wp.kernel
def find_surfaces_through_plate(
    world: World,
    view: RayView,
    steps: Steps,
    ticks: wp.array(dtype=int),
    start: int,
    points: wp.array(dtype=wp.vec2),
    out: SeenSurfaces,
):
    """Find the surface that each event saw through the plate, and replace its pixel by that without the plate.

    ``points``: pixel of each event [px]; ``ticks``: as in :func:`find_seen_surfaces`.
    """
    i = start + wp.tid()
    k = wp.clamp(ticks[i] / steps.ticks, 0, steps.margin + steps.count - 1)
    share = wp.clamp(float(ticks[i] - k * steps.ticks) / float(steps.ticks), 0.0, 1.0)
    angle = steps.angle[k] + steps.turn[k] * share
    ray = pixel_to_ray(view.camera, points[i])
    pose = pose_between(view.poses[k], view.poses[k + 1], share)
    azimuth = wp.vec2(wp.cos(angle), wp.sin(angle))
    centre = seen_from(view.plate, ray[0], ray[1], ray[2], azimuth)
    ray = bent_by_wedge(view.plate, ray[0], ray[1], ray[2], azimuth)
    hit = meet_anywhere(
        world, k + int(share + 0.5), pose.position + pose.rotation * centre, pose.rotation * ray
    )
    place = centre + hit.distance * ray
    out.instance[i] = wp.uint16(instance_of(world, hit.face))
    out.depth[i] = wp.where(hit.face < 0, wp.inf, place[2])
    out.place[i] = wp.where(
        hit.face < 0, wp.vec3(NAN, NAN, NAN), pose.position + pose.rotation * place
    )
    if hit.face >= 0:
        points[i] = ray_to_pixel(view.camera, place)
