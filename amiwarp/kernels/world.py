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


# Maps of a simulated world: rendering, anti-aliasing, blur, and interpolation between two maps.
#
# A map is a picture of the world without the prism. A map is rendered in tiles of 8 by 8 texels, so that a renderer can
# skip the tiles in which no body moves.

TILE = wp.constant(8)  # side of a tile [texels]
CONTRAST = wp.constant(0.1)  # contrast (difference over sum) of illumination above which texels are anti-aliased
LEAST_LIGHT = wp.constant(0.04)  # luminance added to this sum, so that small differences in the dark do not count
SAME_PLANE = wp.constant(0.95)  # cosine between normals of neighbouring texels below which texels are anti-aliased
LEAST_SLANT = wp.constant(0.1)  # lower limit of the cosine between a ray and a normal in the size of footprints


@wp.struct
class MapFrame:
    """Image plane of a map at distance 1 from the camera, the grid of texels on the plane, and the tiles to render."""

    pose: Pose  # pose of the plane's frame; its z axis is the plane's normal
    left: float  # x coordinate of the map's left edge on the plane
    top: float  # y coordinate of the map's top edge on the plane
    pitch_x: float  # texels per unit of x on the plane
    pitch_y: float  # texels per unit of y on the plane
    width: int  # width of the map [texels]
    height: int  # height of the map [texels]
    offsets: wp.array(dtype=wp.vec2)  # positions of a texel's samples relative to its centre [texels]
    cone: float  # angular width of a sample [rad]
    instant: int  # number of the instant that is rendered: row of World.poses
    first: int  # index of the map's first texel in the arrays of all maps
    tiles: wp.array(dtype=int)  # numbers of the tiles to render, counted row by row


@wp.struct
class FirstHits:
    """Result of the ray through the centre of each texel or pixel."""

    face: wp.array(dtype=int)  # number of the face that the ray hits; -1 for the sky
    light: wp.array(dtype=float)  # luminance that the ray sees
    white: wp.array(dtype=float)  # illumination: luminance of a white surface in the same place
    normal: wp.array(dtype=wp.vec3)  # unit normal of the surface in the world's frame; zero for the sky


@wp.func
def place_in_tile(width: int, height: int, k: int) -> int:
    """Return the index of the element of an image that is number ``k`` in the order of tiles; -1 outside of the image.

    Tiles and the elements of a tile are counted row by row.
    """
    across = (width + TILE - 1) / TILE
    tile = k / (TILE * TILE)
    inner = k % (TILE * TILE)
    row = tile / across * TILE + inner / TILE
    col = tile % across * TILE + inner % TILE
    return wp.where(row < height and col < width, row * width + col, -1)


@wp.func
def texel_of_tile(f: MapFrame, k: int) -> int:
    """Return the index of the texel that thread ``k`` computes; -1 if the texel lies outside of the map."""
    return place_in_tile(f.width, f.height, f.tiles[k / (TILE * TILE)] * TILE * TILE + k % (TILE * TILE))


@wp.func
def map_direction(f: MapFrame, x: float, y: float) -> wp.vec3:
    """Return the unit vector in the world's frame through texel coordinates; whole numbers are texel centres."""
    plane = wp.vec3(f.left + (x + 0.5) / f.pitch_x, f.top + (y + 0.5) / f.pitch_y, 1.0)
    return f.pose.rotation * wp.normalize(plane)


@wp.kernel
def render_map(world: World, f: MapFrame, start: int, faces: wp.array(dtype=int), out: FirstHits):
    """Cast one ray through the centre of each texel of the tiles, and store the result and the face."""
    i = texel_of_tile(f, start + wp.tid())
    if i < 0:
        return
    row = i / f.width
    direction = map_direction(f, float(i - row * f.width), float(row))
    hit = cast(world, f.instant, f.pose.position, direction, FAR)
    white = illumination(world, f.instant, f.pose.position, direction, hit)
    out.white[i] = white
    out.light[i] = luminance(world, direction, hit, f.cone, white)
    out.normal[i] = hit.normal
    out.face[i] = hit.face
    faces[f.first + i] = hit.face


@wp.func
def differs(world: World, hits: FirstHits, i: int, j: int) -> bool:
    """Return whether rays ``i`` and ``j`` see different bodies, differently inclined surfaces, or different light."""
    apart = wp.abs(hits.white[i] - hits.white[j])
    if apart > CONTRAST * (hits.white[i] + hits.white[j] + LEAST_LIGHT):
        return True
    a = hits.face[i]
    b = hits.face[j]
    if a == b:
        return False
    return body_of(world, a) != body_of(world, b) or wp.dot(hits.normal[i], hits.normal[j]) < SAME_PLANE


@wp.func
def on_edge(world: World, hits: FirstHits, base: int, width: int, height: int, reach: int, i: int) -> bool:
    """Return whether element ``i`` of an image differs from any element at most ``reach`` rows and columns away.

    ``base``: index of the image's first element in the arrays of ``hits``.
    """
    row = i / width
    col = i - row * width
    for r in range(wp.max(row - reach, 0), wp.min(row + reach, height - 1) + 1):
        for c in range(wp.max(col - reach, 0), wp.min(col + reach, width - 1) + 1):
            if differs(world, hits, base + i, base + r * width + c):
                return True
    return False


@wp.kernel
def smooth_edges(world: World, f: MapFrame, hits: FirstHits, start: int, out: wp.array(dtype=float)):
    """Replace the luminance of texels on edges by the mean of several rays.

    Textures need no further rays, because each ray averages the texture over the ray's angular width.
    """
    i = texel_of_tile(f, start + wp.tid())
    if i < 0:
        return
    value = float(hits.light[i])
    if on_edge(world, hits, 0, f.width, f.height, 1, i):
        row = i / f.width
        col = i - row * f.width
        value = float(0.0)
        for k in range(f.offsets.shape[0]):
            direction = map_direction(f, float(col) + f.offsets[k][0], float(row) + f.offsets[k][1])
            value += radiance(world, f.instant, f.pose.position, direction, f.cone) / float(f.offsets.shape[0])
    out[i] = value


@wp.kernel
def blur_lines(
    f: MapFrame, image: wp.array(dtype=float), weights: wp.array(dtype=float), across: int, start: int,
    out: wp.array(dtype=float),
):  # fmt: skip
    """Convolve the rows (``across`` 0) or columns (``across`` 1) of an image with ``weights``.

    Texels on the border are repeated.
    """
    i = texel_of_tile(f, start + wp.tid())
    if i < 0:
        return
    row = i / f.width
    col = i - row * f.width
    half = weights.shape[0] / 2
    total = float(0.0)
    for k in range(weights.shape[0]):
        c = wp.clamp(col + wp.where(across == 0, k - half, 0), 0, f.width - 1)
        r = wp.clamp(row + wp.where(across == 1, k - half, 0), 0, f.height - 1)
        total += weights[k] * image[r * f.width + c]
    out[i] = total


@wp.func
def log_texel(f: MapFrame, light: wp.array(dtype=float), col: int, row: int, dark: float) -> float:
    """Return the log intensity of a texel; texels on the right and lower border are repeated."""
    return wp.log(light[wp.min(row, f.height - 1) * f.width + wp.min(col, f.width - 1)] + dark)


@wp.kernel
def log_pieces(f: MapFrame, light: wp.array(dtype=float), dark: float, start: int, out: wp.array(dtype=wp.vec4)):
    """Compute the four coefficients of bilinear interpolation of the log intensity at each texel.

    The coefficients are the factors of 1, x, y and xy between the texel and its right and lower neighbours.
    """
    i = texel_of_tile(f, start + wp.tid())
    if i < 0:
        return
    row = i / f.width
    col = i - row * f.width
    a = log_texel(f, light, col, row, dark)
    b = log_texel(f, light, col + 1, row, dark) - a
    c = log_texel(f, light, col, row + 1, dark) - a
    d = log_texel(f, light, col + 1, row + 1, dark) - a - b - c
    out[f.first + i] = wp.vec4(a, b, c, d)


# -- maps between an earlier and a later map, which are rendered only where bodies move


@wp.kernel
def interpolate_maps(
    maps: wp.array(dtype=wp.vec4), faces: wp.array(dtype=int), before: int, after: int, weight: float, to: int,
    start: int,
):  # fmt: skip
    """Interpolate a map between two maps: the log intensities linearly, the faces from the map nearer in time.

    ``before``, ``after``, ``to``: indices of the first texels of the three maps; ``weight``: weight of ``after``.
    """
    i = start + wp.tid()
    a = maps[before + i]
    maps[to + i] = a + weight * (maps[after + i] - a)
    faces[to + i] = faces[wp.where(weight < 0.5, before, after) + i]


@wp.func
def meets_ball(origin: wp.vec3, direction: wp.vec3, centre: wp.vec3, radius: float) -> bool:
    """Return whether a ray along a unit vector hits a ball or starts inside the ball."""
    to = centre - origin
    along = wp.max(wp.dot(to, direction), 0.0)
    return wp.length_sq(to - along * direction) <= radius * radius


@wp.func
def meets_box(o: wp.vec3, d: wp.vec3, lower: wp.vec3, upper: wp.vec3, slack: float) -> bool:
    """Return whether a ray hits a box, enlarged by ``slack`` [m] on all sides, or starts inside the box.

    ``o``, ``d``: origin and direction of the ray in the frame of the box.
    """
    enters = float(0.0)
    leaves = float(FAR)
    for k in range(3):
        step = wp.where(wp.abs(d[k]) > 1.0e-9, d[k], 1.0e-9)
        a = (lower[k] - slack - o[k]) / step
        b = (upper[k] + slack - o[k]) / step
        enters = wp.max(enters, wp.min(a, b))
        leaves = wp.min(leaves, wp.max(a, b))
    return enters <= leaves


@wp.func
def passes_mover(world: World, instants: int, origin: wp.vec3, direction: wp.vec3, slack: float, spread: float) -> bool:
    """Return whether a ray passes near any moving body at any of the first ``instants`` instants.

    ``slack``: margin around the body [m]; ``spread``: additional margin per distance from the origin [m/m].
    """
    for k in range(instants):
        for m in range(world.movers.shape[0]):
            mover = world.movers[m]
            margin = slack + spread * wp.length(world.centres[k, m] - origin)
            if meets_ball(origin, direction, world.centres[k, m], mover.radius + margin):
                pose = world.poses[k, m]
                o = wp.transpose(pose.rotation) * (origin - pose.position)
                if meets_box(o, wp.transpose(pose.rotation) * direction, mover.lower, mover.upper, margin):
                    return True
    return False


@wp.func
def shadow_passes_mover(world: World, instants: int, place: wp.vec3, slack: float) -> bool:
    """Return whether the shadow of any moving body falls near a place at any of the first ``instants`` instants.

    ``slack``: margin around the body [m].
    """
    if world.sun_light > 0.0 and world.sun_shadows == 1:
        if passes_mover(world, instants, place, world.sun, slack, 0.0):
            return True
    for k in range(world.lamps.shape[0]):
        lamp = world.lamps[k]
        if lamp.shadows == 1:
            if passes_mover(world, instants, place, wp.normalize(lamp.position - place), slack, 0.0):
                return True
    return False


@wp.func
def mover_changes(world: World, f: MapFrame, instants: int, face: int, direction: wp.vec3) -> bool:
    """Return whether a moving body or its shadow is seen near a direction at any of the first ``instants`` instants.

    ``face``: number of the face that is seen in this direction; -1 for the sky.
    """
    origin = f.pose.position
    spread = float(TILE) * f.cone
    if passes_mover(world, instants, origin, direction, 0.0, spread):
        return True
    if face < 0:
        return False
    distance = meet_face(world, 0, face, origin, direction)[0]
    if distance == FAR:
        return False
    a = world.corners[3 * face]
    normal = wp.normalize(wp.cross(world.corners[3 * face + 1] - a, world.corners[3 * face + 2] - a))
    slack = distance * spread / wp.max(wp.abs(wp.dot(normal, direction)), LEAST_SLANT)
    return shadow_passes_mover(world, instants, origin + distance * direction, slack)


@wp.kernel
def mark_tiles(
    world: World, f: MapFrame, faces: wp.array(dtype=int), instants: int, start: int, marks: wp.array(dtype=wp.uint8)
):
    """Mark the tiles that a moving body or its shadow may touch at any of the first ``instants`` instants.

    Each tile is tested at its centre, with the faces of the map at ``f.first`` and margins of the width of a tile.
    """
    tile = start + wp.tid()
    across = (f.width + TILE - 1) / TILE
    row = wp.min(tile / across * TILE + TILE / 2, f.height - 1)
    col = wp.min(tile % across * TILE + TILE / 2, f.width - 1)
    face = faces[f.first + row * f.width + col]
    direction = map_direction(f, float(col), float(row))
    marks[tile] = wp.where(mover_changes(world, f, instants, face, direction), wp.uint8(1), wp.uint8(0))
