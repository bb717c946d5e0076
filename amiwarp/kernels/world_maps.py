"""Maps of a simulated world: rendering, anti-aliasing, blur, and interpolation between two maps.

A map is a picture of the world without the prism. A map is rendered in tiles of 8 by 8 texels, so that a renderer can
skip the tiles in which no body moves.
"""

import warp as wp

from amiwarp.kernels.world import FAR, Pose, World, body_of, cast, illumination, luminance, meet_face, radiance

wp.set_module_options({"enable_backward": False})

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
