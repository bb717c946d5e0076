"""Ray casting in a simulated world: the nearest surface along a ray, and whether any surface is in its way."""

import warp as wp

from amiwarp.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e6)  # distance of the sky [m]

# Barycentric distance outside of a face at which a ray still counts as a hit
EDGE = wp.constant(1.0e-5)


@wp.struct
class Hit:
    """Nearest surface that a ray hits."""

    distance: float  # distance along the ray [m]; FAR for the sky
    face: int  # number of the face; -1 for the sky
    u: float  # barycentric weight of the face's first corner
    v: float  # barycentric weight of the face's second corner
    mover: int  # number of the mover; -1 for a body at rest or the sky
    normal: wp.vec3  # unit normal in the world's frame, on the side of the ray's origin


@wp.func
def body_of(world: World, face: int) -> int:
    """Return the number of the body to which a face belongs; -1 for the sky (face -1)."""
    if face < 0:
        return -1
    return world.body[face]


@wp.func
def facing(normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Return the normal or its opposite, whichever points against the direction."""
    return wp.where(wp.dot(normal, direction) > 0.0, -normal, normal)


@wp.func
def meets_sphere(origin: wp.vec3, direction: wp.vec3, centre: wp.vec3, radius: float) -> bool:
    """Return whether a ray along a unit vector passes through a sphere."""
    to = centre - origin
    along = wp.dot(to, direction)
    aside = wp.dot(to, to) - along * along
    return aside <= radius * radius and along > -radius


@wp.func
def nearer(hit: Hit, q: wp.MeshQueryRay, first_face: int, mover: int, direction: wp.vec3) -> Hit:
    """Return the surface that a ray query found, or ``hit`` if the query found no surface nearer than ``hit``.

    ``direction``: direction of the ray in the mesh's frame; ``mover``: number of the mover, or -1.
    """
    if q.result:
        hit.distance = q.t
        hit.face = first_face + q.face
        hit.u = q.u
        hit.v = q.v
        hit.mover = mover
        hit.normal = facing(q.normal, direction)
    return hit


@wp.func
def cast(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, far: float) -> Hit:
    """Return the nearest surface within ``far`` [m] of ``origin`` along a unit vector, at an instant."""
    hit = Hit()
    hit.distance = far
    hit.face = -1
    hit.mover = -1
    if world.still != wp.uint64(0):
        hit = nearer(hit, wp.mesh_query_ray(world.still, origin, direction, far), 0, -1, direction)
    for m in range(world.movers.shape[0]):
        mover = world.movers[m]
        if meets_sphere(origin, direction, world.centres[instant, m], mover.radius):
            pose = world.poses[instant, m]
            o = wp.transpose(pose.rotation) * (origin - pose.position)
            d = wp.transpose(pose.rotation) * direction
            hit = nearer(
                hit, wp.mesh_query_ray(mover.mesh, o, d, hit.distance), mover.first_face, m, d
            )
    if hit.mover >= 0:
        hit.normal = world.poses[instant, hit.mover].rotation * hit.normal
    return hit


@wp.func
def blocked(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, far: float) -> bool:
    """Return whether any surface lies within ``far`` [m] of ``origin`` along a unit vector, at an instant."""
    if world.still != wp.uint64(0):
        if wp.mesh_query_ray_anyhit(world.still, origin, direction, far):
            return True
    for m in range(world.movers.shape[0]):
        mover = world.movers[m]
        if meets_sphere(origin, direction, world.centres[instant, m], mover.radius):
            pose = world.poses[instant, m]
            o = wp.transpose(pose.rotation) * (origin - pose.position)
            if wp.mesh_query_ray_anyhit(
                mover.mesh, o, wp.transpose(pose.rotation) * direction, far
            ):
                return True
    return False


@wp.func
def meet_triangle(o: wp.vec3, direction: wp.vec3, u: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return where a ray from ``o`` along ``d`` hits the triangle with the corners 0, ``u`` and ``v``.

    The result is the distance and the barycentric weights of the first two corners. If the ray does not hit the
    triangle, the distance is FAR. Uses Cramer's rule.
    """
    missed = wp.vec3(FAR, 0.0, 0.0)
    p = wp.cross(direction, v)
    q = wp.cross(o, u)
    det = wp.dot(u, p)
    if det == 0.0:
        return missed
    a = wp.dot(o, p) / det
    b = wp.dot(direction, q) / det
    distance = wp.dot(v, q) / det
    if a < -EDGE or b < -EDGE or a + b > 1.0 + EDGE or distance <= 0.0:
        return missed
    return wp.vec3(distance, 1.0 - a - b, a)


@wp.func
def meet_face(
    world: World, instant: int, face: int, origin: wp.vec3, direction: wp.vec3
) -> wp.vec3:
    """Return where a ray along a unit vector hits a known face; see :func:`meet_triangle`.

    It is cheaper than a search of the whole mesh.
    """
    o = origin
    d = direction
    m = world.body[face] - world.first_mover
    if m >= 0:
        pose = world.poses[instant, m]
        o = wp.transpose(pose.rotation) * (origin - pose.position)
        d = wp.transpose(pose.rotation) * direction
    a = world.corners[3 * face]
    u = world.corners[3 * face + 1] - a
    v = world.corners[3 * face + 2] - a
    return meet_triangle(o - a, d, u, v)
