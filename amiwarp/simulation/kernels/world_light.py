"""Luminance that a ray sees in a simulated world: ambient light, sun, lamps with their shadows, and the sky."""

import warp as wp

from amiwarp.simulation.kernels.ray_casting import FAR, Hit, blocked, cast
from amiwarp.simulation.kernels.textures import bilinear, reflectance
from amiwarp.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

# Height above a surface at which shadow rays start, per (distance to the camera + 0.1 m)
LIFT = wp.constant(1.0e-4)

PI = wp.constant(3.14159265358979)


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
def illumination(
    world: World, instant: int, origin: wp.vec3, direction: wp.vec3, hit: Hit
) -> float:
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
    return (
        world.surfaces[world.body[hit.face]].emission
        + reflectance(world, hit, direction, cone) * white
    )


@wp.func
def radiance(world: World, instant: int, origin: wp.vec3, direction: wp.vec3, cone: float) -> float:
    """Return the luminance that a ray along a unit vector sees; ``cone``: angular width of the ray [rad]."""
    hit = cast(world, instant, origin, direction, FAR)
    return luminance(
        world, direction, hit, cone, illumination(world, instant, origin, direction, hit)
    )
