"""Ray casting in a simulated world: the nearest surface along a ray, and the luminance that the ray sees."""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e6)  # distance of the sky [m]
LIFT = wp.constant(1.0e-4)  # height above a surface at which shadow rays start, per (distance to the camera + 0.1 m)
EDGE = wp.constant(1.0e-5)  # barycentric distance outside of a face at which a ray still counts as a hit
PI = wp.constant(3.14159265358979)
NAN = wp.constant(float("nan"))


@wp.struct
class Pose:
    """Pose of a body or a camera: transformation from the frame of the body or camera to the world's frame."""

    rotation: wp.mat33
    position: wp.vec3


@wp.struct
class Mover:
    """Mesh of a moving body."""

    mesh: wp.uint64  # id of the Warp mesh, whose vertices are in the body's frame
    first_face: int  # number of the body's first face among the faces of the world
    radius: float  # radius of the bounding sphere [m]
    lower: wp.vec3  # corner of the bounding box with the smallest x, y, z, in the body's frame [m]
    upper: wp.vec3  # corner of the bounding box with the largest x, y, z, in the body's frame [m]


@wp.struct
class Surface:
    """Material of a body."""

    reflectance: float  # fraction of the light that the surface reflects
    emission: float  # luminance that the surface emits
    texel: int  # index of the first texel of the texture pyramid; -1 without a texture
    width: int  # width of the texture [texels]
    height: int  # height of the texture [texels]
    levels: int  # number of levels of the texture pyramid
    instance: int  # instance number of the body


@wp.struct
class Lamp:
    """Point light source."""

    position: wp.vec3  # position in the world's frame [m]
    shadows: int  # 1 if bodies cast shadows in the light of this lamp, else 0


@wp.struct
class World:
    """Geometry, materials and light of a world, at one or more instants.

    A mover is a moving body. The faces of bodies at rest come first, followed by the faces of each mover.
    """

    still: wp.uint64  # id of the Warp mesh of all bodies at rest; 0 if all bodies move
    movers: wp.array(dtype=Mover)  # meshes of the moving bodies
    first_mover: int  # number of the first mover among all bodies
    poses: wp.array2d(dtype=Pose)  # pose of each mover at each instant; axes: instant, mover
    centres: wp.array2d(dtype=wp.vec3)  # centre of each mover's bounding sphere in the world [m]; instant, mover
    body: wp.array(dtype=int)  # number of the body of each face
    corners: wp.array(dtype=wp.vec3)  # the three corners of each face, in the frame of its mesh [m]
    uv: wp.array(dtype=wp.vec2)  # texture coordinates at the three corners of each face
    shade: wp.array(dtype=float)  # factor of the reflectance at the three corners of each face
    density: wp.array(dtype=float)  # texels per metre on each face
    surfaces: wp.array(dtype=Surface)  # material of each body
    texels: wp.array(dtype=float)  # texels of all texture pyramids and of the panorama
    ambient: float  # luminance of a white surface in the shade
    sun: wp.vec3  # unit vector towards the sun
    sun_light: float  # luminance that the sun gives to a white surface that faces the sun; 0 without a sun
    sun_shadows: int  # 1 if bodies cast shadows in sunlight, else 0
    lamps: wp.array(dtype=Lamp)  # point light sources
    lamp_light: wp.array2d(dtype=float)  # intensity of each lamp at each instant; axes: instant, lamp
    sky: float  # luminance of an even sky, or factor of the panorama
    panorama: int  # index of the first texel of the sky's panorama; -1 for an even sky
    panorama_width: int  # width of the panorama [texels]
    panorama_height: int  # height of the panorama [texels]


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
            hit = nearer(hit, wp.mesh_query_ray(mover.mesh, o, d, hit.distance), mover.first_face, m, d)
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
            if wp.mesh_query_ray_anyhit(mover.mesh, o, wp.transpose(pose.rotation) * direction, far):
                return True
    return False


# -- textures: pyramids of halved copies


@wp.func
def texel(world: World, first: int, width: int, height: int, col: int, row: int) -> float:
    """Return a texel of a repeating texture, whose first texel has the index ``first``."""
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
    """Interpolate one level of a texture pyramid at texture coordinates; level 0 is the full resolution."""
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
    """Return the factor that a texture applies to the reflectance, averaged over a width of ``footprint`` [texels]."""
    depth = wp.clamp(wp.log2(wp.max(footprint, 1.0)), 0.0, float(s.levels - 1))
    level = int(depth)
    value = level_at(world, s, uv, level)
    if level + 1 < s.levels:
        value += (depth - float(level)) * (level_at(world, s, uv, level + 1) - value)
    return value


@wp.func
def reflectance(world: World, hit: Hit, direction: wp.vec3, cone: float) -> float:
    """Return the reflectance of the surface that a ray of angular width ``cone`` [rad] hits."""
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
    """Return the luminance that lamp ``k`` adds to a white surface at ``place`` with a unit normal."""
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
    """Return the luminance of a white surface at ``place`` with a unit normal, in the light of all sources."""
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
    """Return the luminance of a white surface where a ray hits, or the luminance of the sky if the ray hits no body."""
    if hit.face < 0:
        return sky(world, direction)
    place = origin + hit.distance * direction + LIFT * (hit.distance + 0.1) * hit.normal
    return light_at(world, instant, place, hit.normal)


@wp.func
def luminance(world: World, direction: wp.vec3, hit: Hit, cone: float, white: float) -> float:
    """Return the luminance that a ray of angular width ``cone`` [rad] sees at a hit.

    ``white``: :func:`illumination` of the hit.
    """
    if hit.face < 0:
        return white
    return world.surfaces[world.body[hit.face]].emission + reflectance(world, hit, direction, cone) * white


@wp.func
def radiance(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, cone: float) -> float:
    """Return the luminance that a ray along a unit vector sees; ``cone``: angular width of the ray [rad]."""
    hit = cast(world, instant, origin, direction, FAR)
    return luminance(world, direction, hit, cone, illumination(world, instant, origin, direction, hit))


# -- intersection with one known face, which is cheaper than a search of the whole mesh


@wp.func
def meet_triangle(o: wp.vec3, d: wp.vec3, u: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return where a ray from ``o`` along ``d`` hits the triangle with the corners 0, ``u`` and ``v``.

    The result is the distance and the barycentric weights of the first two corners. If the ray does not hit the
    triangle, the distance is FAR. Uses Cramer's rule.
    """
    missed = wp.vec3(FAR, 0.0, 0.0)
    p = wp.cross(d, v)
    q = wp.cross(o, u)
    det = wp.dot(u, p)
    if det == 0.0:
        return missed
    a = wp.dot(o, p) / det
    b = wp.dot(d, q) / det
    distance = wp.dot(v, q) / det
    if a < -EDGE or b < -EDGE or a + b > 1.0 + EDGE or distance <= 0.0:
        return missed
    return wp.vec3(distance, 1.0 - a - b, a)


@wp.func
def meet_face(world: World, instant: int, face: int, origin: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Return where a ray along a unit vector hits a face; see :func:`meet_triangle`."""
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
