"""Maps between an earlier and a later map: interpolated, and rendered again only where bodies or shadows move."""

import warp as wp

from amiwarp.simulation.kernels.image_tiles import TILE
from amiwarp.simulation.kernels.map_rendering import MapFrame, map_direction
from amiwarp.simulation.kernels.ray_casting import FAR, meet_face
from amiwarp.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

# Lower limit of the cosine between a ray and a normal in the size of footprints
LEAST_SLANT = wp.constant(0.1)


@wp.kernel
def interpolate_maps(
    maps: wp.array(dtype=wp.vec4),
    faces: wp.array(dtype=int),
    before: int,
    after: int,
    weight: float,
    to: int,
    start: int,
):
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
def passes_mover(
    world: World, instants: int, origin: wp.vec3, direction: wp.vec3, slack: float, spread: float
) -> bool:
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
                if meets_box(
                    o, wp.transpose(pose.rotation) * direction, mover.lower, mover.upper, margin
                ):
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
            if passes_mover(
                world, instants, place, wp.normalize(lamp.position - place), slack, 0.0
            ):
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
    normal = wp.normalize(
        wp.cross(world.corners[3 * face + 1] - a, world.corners[3 * face + 2] - a)
    )
    slack = distance * spread / wp.max(wp.abs(wp.dot(normal, direction)), LEAST_SLANT)
    return shadow_passes_mover(world, instants, origin + distance * direction, slack)


@wp.kernel
def mark_tiles(
    world: World,
    f: MapFrame,
    faces: wp.array(dtype=int),
    instants: int,
    start: int,
    marks: wp.array(dtype=wp.uint8),
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
    marks[tile] = wp.where(
        mover_changes(world, f, instants, face, direction), wp.uint8(1), wp.uint8(0)
    )
