"""Device side of worlds: rays that meet meshes, and the light that comes back along them."""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e6)  # [m]
LIFT = wp.constant(1.0e-4)  # a shadow ray starts so far above its surface, relative to the distance, plus one tenth [m]
PI = wp.constant(3.14159265358979)


@wp.struct
class Pose:
    """From a body's or camera's frame to the world's."""

    rotation: wp.mat33
    position: wp.vec3


@wp.struct
class Mover:
    """A body that moves: its mesh, in its own frame."""

    mesh: wp.uint64
    first_face: int  # of its faces among those of the world
    centre: wp.vec3  # of a sphere around it
    radius: float


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
    position: wp.vec3
    shadows: int


@wp.struct
class World:
    still: wp.uint64  # mesh of all bodies that rest; 0 for none
    movers: wp.array(dtype=Mover)
    poses: wp.array2d(dtype=Pose)  # instant, mover
    body: wp.array(dtype=int)  # of each face
    uv: wp.array(dtype=wp.vec2)  # of each face's three corners
    shade: wp.array(dtype=float)  # factor of the reflectance at each face's three corners
    density: wp.array(dtype=float)  # texels per metre on each face
    surfaces: wp.array(dtype=Surface)
    texels: wp.array(dtype=float)
    ambient: float
    sun: wp.vec3  # towards it
    sun_light: float
    sun_shadows: int
    lamps: wp.array(dtype=Lamp)
    lamp_light: wp.array2d(dtype=float)  # instant, lamp
    sky: float
    panorama: int  # first texel; -1 for none
    panorama_width: int
    panorama_height: int


@wp.struct
class Hit:
    """What a ray meets first."""

    distance: float  # [m]; FAR for the sky
    face: int  # -1 for the sky
    u: float  # barycentric weights of the face's first two corners
    v: float
    mover: int  # -1 for a body that rests
    normal: wp.vec3  # in the world's frame, towards the ray's origin


@wp.func
def facing(normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    return wp.where(wp.dot(normal, direction) > 0.0, -normal, normal)


@wp.func
def meets_sphere(origin: wp.vec3, direction: wp.vec3, centre: wp.vec3, radius: float) -> bool:
    """Whether a ray with a direction of length one comes within ``radius`` of ``centre``."""
    to = centre - origin
    along = wp.dot(to, direction)
    aside = wp.dot(to, to) - along * along
    return aside <= radius * radius and along > -radius


@wp.func
def nearer(hit: Hit, q: wp.MeshQueryRay, first_face: int, mover: int, direction: wp.vec3) -> Hit:
    """The hit, or that of a query which met something nearer; ``direction`` is in the frame of the mesh."""
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
    """Nearest surface within ``far`` [m] along a direction of length one."""
    hit = Hit()
    hit.distance = far
    hit.face = -1
    hit.mover = -1
    if world.still != wp.uint64(0):
        hit = nearer(hit, wp.mesh_query_ray(world.still, origin, direction, far), 0, -1, direction)
    for m in range(world.movers.shape[0]):
        mover = world.movers[m]
        pose = world.poses[instant, m]
        o = wp.transpose(pose.rotation) * (origin - pose.position)
        d = wp.transpose(pose.rotation) * direction
        if meets_sphere(o, d, mover.centre, mover.radius):
            hit = nearer(hit, wp.mesh_query_ray(mover.mesh, o, d, hit.distance), mover.first_face, m, d)
    if hit.mover >= 0:
        hit.normal = world.poses[instant, hit.mover].rotation * hit.normal
    return hit


@wp.func
def blocked(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, far: float) -> bool:
    """Whether anything lies within ``far`` [m] along a direction of length one."""
    if world.still != wp.uint64(0):
        if wp.mesh_query_ray_anyhit(world.still, origin, direction, far):
            return True
    for m in range(world.movers.shape[0]):
        mover = world.movers[m]
        pose = world.poses[instant, m]
        o = wp.transpose(pose.rotation) * (origin - pose.position)
        d = wp.transpose(pose.rotation) * direction
        if meets_sphere(o, d, mover.centre, mover.radius):
            if wp.mesh_query_ray_anyhit(mover.mesh, o, d, far):
                return True
    return False


# -- textures: pyramids of halved copies


@wp.func
def texel(world: World, first: int, width: int, height: int, col: int, row: int) -> float:
    """One texel of a texture that repeats."""
    c = col % width
    r = row % height
    return world.texels[first + wp.where(r < 0, r + height, r) * width + wp.where(c < 0, c + width, c)]


@wp.func
def bilinear(world: World, first: int, width: int, height: int, x: float, y: float) -> float:
    """Look-up at texel coordinates, whose whole numbers are texel centres."""
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
    """Look-up in one level of a pyramid."""
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
    """Factor of the reflectance, averaged over ``footprint`` texels."""
    depth = wp.clamp(wp.log2(wp.max(footprint, 1.0)), 0.0, float(s.levels - 1))
    level = int(depth)
    value = level_at(world, s, uv, level)
    if level + 1 < s.levels:
        value += (depth - float(level)) * (level_at(world, s, uv, level + 1) - value)
    return value


@wp.func
def reflectance(world: World, hit: Hit, direction: wp.vec3, cone: float) -> float:
    """Reflectance where a ray of angular width ``cone`` [rad] meets a face."""
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
    """Luminance of the sky."""
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
    """Luminance that a lamp gives a white surface."""
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
    """Luminance of a white surface."""
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
def shade(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, hit: Hit, cone: float) -> float:
    """Return the luminance of what a ray of angular width ``cone`` [rad] hit."""
    if hit.face < 0:
        return sky(world, direction)
    place = origin + hit.distance * direction + LIFT * (hit.distance + 0.1) * hit.normal
    s = world.surfaces[world.body[hit.face]]
    return s.emission + reflectance(world, hit, direction, cone) * light_at(world, instant, place, hit.normal)


@wp.func
def radiance(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, cone: float) -> float:
    """Return the luminance along a ray of angular width ``cone`` [rad]; its direction has length one."""
    return shade(world, instant, origin, direction, cast(world, instant, origin, direction, FAR), cone)
