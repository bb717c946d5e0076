"""Textures of a simulated world: pyramids of halved copies, of which a ray reads the level that fits its width."""

import warp as wp

from amiwarp.simulation.kernels.ray_casting import Hit
from amiwarp.simulation.kernels.world import Surface, World

wp.set_module_options({"enable_backward": False})


@wp.func
def texel(world: World, first: int, width: int, height: int, col: int, row: int) -> float:
    """Return a texel of a repeating texture, whose first texel has the index ``first``."""
    # The remainder of a negative number is negative, as in C.
    c = col % width
    c = wp.where(c < 0, c + width, c)
    r = row % height
    r = wp.where(r < 0, r + height, r)
    return world.texels[first + r * width + c]


@wp.func
def bilinear(world: World, first: int, width: int, height: int, x: float, y: float) -> float:
    """Interpolate a texture at texel coordinates; whole numbers are texel centres."""
    col = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - float(col)
    fy = y - float(row)
    top_left = texel(world, first, width, height, col, row)
    top_right = texel(world, first, width, height, col + 1, row)
    low_left = texel(world, first, width, height, col, row + 1)
    low_right = texel(world, first, width, height, col + 1, row + 1)
    top = top_left + fx * (top_right - top_left)
    low = low_left + fx * (low_right - low_left)
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
        coarser = level_at(world, s, uv, level + 1)
        value += (depth - float(level)) * (coarser - value)
    return value


@wp.func
def reflectance(world: World, hit: Hit, direction: wp.vec3, cone: float) -> float:
    """Return the reflectance of the surface that a ray of angular width ``cone`` [rad] hits."""
    # Factors of the face's corners, of which the first has the index k
    u = hit.u
    v = hit.v
    w = 1.0 - hit.u - hit.v
    k = 3 * hit.face
    s = world.surfaces[world.body[hit.face]]
    shade = u * world.shade[k] + v * world.shade[k + 1] + w * world.shade[k + 2]
    value = s.reflectance * shade
    if s.texel >= 0:
        uv = u * world.uv[k] + v * world.uv[k + 1] + w * world.uv[k + 2]
        slant = wp.max(-wp.dot(hit.normal, direction), 0.1)
        footprint = world.density[hit.face] * hit.distance * cone / wp.sqrt(slant)
        value *= textured(world, s, uv, footprint)
    return value
