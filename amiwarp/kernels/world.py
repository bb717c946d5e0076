"""Rays in a world: the nearest surface along a ray, and the luminance that the ray sees."""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e6)  # [m]
LIFT = wp.constant(1.0e-4)  # height above its surface at which a shadow ray starts, as a share of the distance + 0.1 m
EDGE = wp.constant(1.0e-5)  # width of a face's border that still belongs to the face, in barycentric coordinates
PI = wp.constant(3.14159265358979)


@wp.struct
class Pose:
    """Pose of a body or a camera: maps coordinates in its own frame to the world's frame."""

    rotation: wp.mat33
    position: wp.vec3


@wp.struct
class Mover:
    """Mesh of a moving body, in the body's frame."""

    mesh: wp.uint64
    first_face: int  # number of its first face among the faces of the world
    radius: float  # radius of its bounding sphere [m]
    lower: wp.vec3  # corners of its bounding box, in the body's frame [m]
    upper: wp.vec3


@wp.struct
class Surface:
    """Material of a body."""

    reflectance: float
    emission: float
    texel: int  # first texel of its texture pyramid; -1 for none
    width: int
    height: int
    levels: int
    instance: int


@wp.struct
class Lamp:
    """Position of a lamp, and whether bodies cast shadows in its light."""

    position: wp.vec3
    shadows: int


@wp.struct
class World:
    """Geometry, materials and light of a world. The faces of bodies at rest come first, then those of each mover."""

    still: wp.uint64  # mesh of all bodies at rest; 0 for none
    movers: wp.array(dtype=Mover)
    first_mover: int  # number of the first moving body among all bodies
    poses: wp.array2d(dtype=Pose)  # pose of each mover at each instant; axes: instant, mover
    centres: wp.array2d(dtype=wp.vec3)  # centre of each mover's bounding sphere in the world's frame; instant, mover
    body: wp.array(dtype=int)  # number of the body of each face
    corners: wp.array(dtype=wp.vec3)  # the three corners of each face, in the frame of its mesh [m]
    uv: wp.array(dtype=wp.vec2)  # texture coordinates at the three corners of each face
    shade: wp.array(dtype=float)  # factor of the reflectance at the three corners of each face
    density: wp.array(dtype=float)  # texels per metre on each face
    surfaces: wp.array(dtype=Surface)
    texels: wp.array(dtype=float)
    ambient: float
    sun: wp.vec3  # unit vector towards the sun
    sun_light: float
    sun_shadows: int
    lamps: wp.array(dtype=Lamp)
    lamp_light: wp.array2d(dtype=float)  # intensity of each lamp at each instant; axes: instant, lamp
    sky: float
    panorama: int  # first texel of the panorama; -1 for none
    panorama_width: int
    panorama_height: int


@wp.struct
class Hit:
    """Nearest surface along a ray."""

    distance: float  # [m]; FAR for the sky
    face: int  # -1 for the sky
    u: float  # barycentric weights of the face's first two corners
    v: float
    mover: int  # number of the moving body; -1 for a body at rest
    normal: wp.vec3  # unit normal in the world's frame, on the side of the ray's origin


@wp.func
def body_of(world: World, face: int) -> int:
    """Return the body of a face; -1 for the sky."""
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
    """Return the surface that a query found, or ``hit`` if it found none; ``direction`` is in the mesh's frame."""
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
    """Return the nearest surface within ``far`` [m] along a unit vector."""
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
            hit = nearer(hit, wp.mesh_query_ray(mover.mesh, o, d, hit.distance), mover.first_face, m, d)
    if hit.mover >= 0:
        hit.normal = world.poses[instant, hit.mover].rotation * hit.normal
    return hit


@wp.func
def blocked(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, far: float) -> bool:
    """Return whether any surface lies within ``far`` [m] along a unit vector."""
    if world.still != wp.uint64(0):
        if wp.mesh_query_ray_anyhit(world.still, origin, direction, far):
            return True
    for m in range(world.movers.shape[0]):
        mover = world.movers[m]
        if meets_sphere(origin, direction, world.centres[instant, m], mover.radius):
            pose = world.poses[instant, m]
            o = wp.transpose(pose.rotation) * (origin - pose.position)
            if wp.mesh_query_ray_anyhit(mover.mesh, o, wp.transpose(pose.rotation) * direction, far):
                return True
    return False


# -- textures: pyramids of halved copies


@wp.func
def texel(world: World, first: int, width: int, height: int, col: int, row: int) -> float:
    """Return a texel of a repeated texture."""
    c = col % width
    r = row % height
    return world.texels[first + wp.where(r < 0, r + height, r) * width + wp.where(c < 0, c + width, c)]


@wp.func
def bilinear(world: World, first: int, width: int, height: int, x: float, y: float) -> float:
    """Interpolate a texture at texel coordinates; whole numbers are texel centres."""
    col = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - float(col)
    fy = y - float(row)
    top = texel(world, first, width, height, col, row)
    top += fx * (texel(world, first, width, height, col + 1, row) - top)
    low = texel(world, first, width, height, col, row + 1)
    low += fx * (texel(world, first, width, height, col + 1, row + 1) - low)
    return top + fy * (low - top)


@wp.func
def level_at(world: World, s: Surface, uv: wp.vec2, level: int) -> float:
    """Interpolate one level of a texture pyramid."""
    first = int(s.texel)
    width = int(s.width)
    height = int(s.height)
    for _ in range(level):
        first += width * height
        width = wp.max(width / 2, 1)
        height = wp.max(height / 2, 1)
    x = uv[0] * float(width) - 0.5
    y = (1.0 - uv[1]) * float(height) - 0.5
    return bilinear(world, first, width, height, x, y)


@wp.func
def textured(world: World, s: Surface, uv: wp.vec2, footprint: float) -> float:
    """Return the texture's factor of the reflectance, averaged over ``footprint`` texels."""
    depth = wp.clamp(wp.log2(wp.max(footprint, 1.0)), 0.0, float(s.levels - 1))
    level = int(depth)
    value = level_at(world, s, uv, level)
    if level + 1 < s.levels:
        value += (depth - float(level)) * (level_at(world, s, uv, level + 1) - value)
    return value


@wp.func
def reflectance(world: World, hit: Hit, direction: wp.vec3, cone: float) -> float:
    """Return the reflectance where a ray of angular width ``cone`` [rad] meets a face."""
    k = 3 * hit.face
    w = 1.0 - hit.u - hit.v
    s = world.surfaces[world.body[hit.face]]
    value = s.reflectance * (hit.u * world.shade[k] + hit.v * world.shade[k + 1] + w * world.shade[k + 2])
    if s.texel >= 0:
        uv = hit.u * world.uv[k] + hit.v * world.uv[k + 1] + w * world.uv[k + 2]
        slant = wp.max(-wp.dot(hit.normal, direction), 0.1)
        value *= textured(world, s, uv, world.density[hit.face] * hit.distance * cone / wp.sqrt(slant))
    return value


# -- light


@wp.func
def sky(world: World, direction: wp.vec3) -> float:
    """Return the luminance of the sky in a direction."""
    if world.panorama < 0:
        return world.sky
    width = world.panorama_width
    height = world.panorama_height
    x = (0.5 - 0.5 * wp.atan2(direction[1], direction[0]) / PI) * float(width) - 0.5
    y = (0.5 - wp.asin(wp.clamp(direction[2], -1.0, 1.0)) / PI) * float(height) - 0.5
    y = wp.clamp(y, 0.0, float(height) - 1.001)
    return world.sky * bilinear(world, world.panorama, width, height, x, y)


@wp.func
def lamp_light(world: World, instant: int, k: int, place: wp.vec3, normal: wp.vec3) -> float:
    """Return the luminance that a lamp adds to a white surface."""
    lamp = world.lamps[k]
    to = lamp.position - place
    distance = wp.length(to)
    toward = wp.dot(normal, to) / distance
    if toward <= 0.0:
        return 0.0
    if lamp.shadows == 1:
        if blocked(world, instant, place, to / distance, distance):
            return 0.0
    return world.lamp_light[instant, k] * toward / (distance * distance)


@wp.func
def light_at(world: World, instant: int, place: wp.vec3, normal: wp.vec3) -> float:
    """Return the luminance of a white surface."""
    light = float(world.ambient)
    toward = wp.dot(normal, world.sun)
    if world.sun_light > 0.0 and toward > 0.0:
        shadow = False
        if world.sun_shadows == 1:
            shadow = blocked(world, instant, place, world.sun, FAR)
        if not shadow:
            light += world.sun_light * toward
    for k in range(world.lamps.shape[0]):
        light += lamp_light(world, instant, k, place, normal)
    return light


@wp.func
def illumination(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, hit: Hit) -> float:
    """Return the luminance of a white surface where a ray hits, or that of the sky if it hits nothing."""
    if hit.face < 0:
        return sky(world, direction)
    place = origin + hit.distance * direction + LIFT * (hit.distance + 0.1) * hit.normal
    return light_at(world, instant, place, hit.normal)


@wp.func
def luminance(world: World, direction: wp.vec3, hit: Hit, cone: float, white: float) -> float:
    """Return the luminance of a hit whose :func:`illumination` is ``white``; ``cone``: angular width [rad]."""
    if hit.face < 0:
        return white
    return world.surfaces[world.body[hit.face]].emission + reflectance(world, hit, direction, cone) * white


@wp.func
def radiance(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, cone: float) -> float:
    """Return the luminance along a unit vector, averaged over the angular width ``cone`` [rad]."""
    hit = cast(world, instant, origin, direction, FAR)
    return luminance(world, direction, hit, cone, illumination(world, instant, origin, direction, hit))


# -- single faces: cheaper than the whole mesh if the face is known


@wp.func
def meet_triangle(o: wp.vec3, d: wp.vec3, u: wp.vec3, v: wp.vec3) -> float:
    """Return the distance from ``o`` along ``d`` to the triangle with the corners 0, ``u`` and ``v``, or FAR."""
    p = wp.cross(d, v)
    q = wp.cross(o, u)
    det = wp.dot(u, p)
    if det == 0.0:
        return FAR
    a = wp.dot(o, p) / det
    b = wp.dot(d, q) / det
    distance = wp.dot(v, q) / det
    if a < -EDGE or b < -EDGE or a + b > 1.0 + EDGE or distance <= 0.0:
        return FAR
    return distance


@wp.func
def meet_face(world: World, instant: int, face: int, origin: wp.vec3, direction: wp.vec3) -> float:
    """Return the distance [m] at which a ray along a unit vector meets a face; FAR if it does not (Cramer's rule)."""
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
