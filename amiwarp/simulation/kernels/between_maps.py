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
    value = maps[before + i]
    maps[to + i] = value + weight * (maps[after + i] - value)
    faces[to + i] = faces[wp.where(weight < 0.5, before, after) + i]


@wp.func
def meets_ball(origin: wp.vec3, direction: wp.vec3, centre: wp.vec3, radius: float) -> bool:
    """Return whether a ray along a unit vector hits a ball or starts inside the ball."""
    to_centre = centre - origin
    along = wp.max(wp.dot(to_centre, direction), 0.0)
    return wp.length_sq(to_centre - along * direction) <= radius * radius


@wp.func
def meets_box(
    origin: wp.vec3, direction: wp.vec3, lower: wp.vec3, upper: wp.vec3, slack: float
) -> bool:
    """Return whether a ray hits a box, enlarged by ``slack`` [m] on all sides, or starts inside the box.

    ``origin``, ``direction``: the ray in the frame of the box; ``lower``, ``upper``: opposite corners of the box [m].
    """
    enters = float(0.0)
    leaves = float(FAR)
    for axis in range(3):
        # A ray along the sides counts as slightly inclined.
        step = wp.where(wp.abs(direction[axis]) > 1.0e-9, direction[axis], 1.0e-9)
        to_lower = (lower[axis] - slack - origin[axis]) / step
        to_upper = (upper[axis] + slack - origin[axis]) / step
        enters = wp.max(enters, wp.min(to_lower, to_upper))
        leaves = wp.min(leaves, wp.max(to_lower, to_upper))
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
                to_body = wp.transpose(pose.rotation)
                from_body = to_body * (origin - pose.position)
                if meets_box(from_body, to_body * direction, mover.lower, mover.upper, margin):
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
            to_lamp = wp.normalize(lamp.position - place)
            if passes_mover(world, instants, place, to_lamp, slack, 0.0):
                return True
    return False


@wp.func
def mover_changes(
    world: World, frame: MapFrame, instants: int, face: int, direction: wp.vec3
) -> bool:
    """Return whether a moving body or its shadow is seen near a direction at any of the first ``instants`` instants.

    ``face``: number of the face that is seen in this direction; -1 for the sky.
    """
    origin = frame.pose.position
    spread = float(TILE) * frame.cone
    if passes_mover(world, instants, origin, direction, 0.0, spread):
        return True
    if face < 0:
        return False
    distance = meet_face(world, 0, face, origin, direction)[0]
    if distance == FAR:
        return False
    corner = world.corners[3 * face]
    side = world.corners[3 * face + 1] - corner
    other_side = world.corners[3 * face + 2] - corner
    normal = wp.normalize(wp.cross(side, other_side))
    slack = distance * spread / wp.max(wp.abs(wp.dot(normal, direction)), LEAST_SLANT)
    return shadow_passes_mover(world, instants, origin + distance * direction, slack)


@wp.kernel
def mark_tiles(
    world: World,
    frame: MapFrame,
    faces: wp.array(dtype=int),
    instants: int,
    start: int,
    marks: wp.array(dtype=wp.uint8),
):
    """Mark the tiles that a moving body or its shadow may touch at any of the first ``instants`` instants.

    Each tile is tested at its centre, with the faces of the map at ``frame.first`` and margins of the width of a tile.
    """
    tile = start + wp.tid()
    across = (frame.width + TILE - 1) / TILE
    row = wp.min(tile / across * TILE + TILE / 2, frame.height - 1)
    col = wp.min(tile % across * TILE + TILE / 2, frame.width - 1)
    face = faces[frame.first + row * frame.width + col]
    direction = map_direction(frame, float(col), float(row))
    marks[tile] = wp.where(
        mover_changes(world, frame, instants, face, direction), wp.uint8(1), wp.uint8(0)
    )
