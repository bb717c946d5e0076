"""Edges in an image of a simulated world: where rays next to each other see different bodies, inclinations or light."""

import warp as wp

from amiwarp.simulation.kernels.ray_casting import body_of
from amiwarp.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

NAN = wp.constant(float("nan"))

# Contrast (difference over sum) of illumination above which texels are anti-aliased
CONTRAST = wp.constant(0.1)
# Luminance added to this sum, so that small differences in the dark do not count
LEAST_LIGHT = wp.constant(0.04)
# Cosine between normals of neighbouring texels below which texels are anti-aliased
SAME_PLANE = wp.constant(0.95)


@wp.struct
class FirstHits:
    """Result of the ray through the centre of each texel or pixel."""

    face: wp.array(dtype=int)  # number of the face that the ray hits; -1 for the sky
    light: wp.array(dtype=float)  # luminance that the ray sees
    white: wp.array(dtype=float)  # illumination: luminance of a white surface in the same place
    # Unit normal of the surface in the world's frame; zero for the sky
    normal: wp.array(dtype=wp.vec3)


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
    return (
        body_of(world, a) != body_of(world, b)
        or wp.dot(hits.normal[i], hits.normal[j]) < SAME_PLANE
    )


@wp.func
def on_edge(
    world: World, hits: FirstHits, base: int, width: int, height: int, reach: int, i: int
) -> bool:
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
