"""Maps of a simulated world: rendering, anti-aliasing and blur.

A map is a picture of the world without the prism. A map is rendered in tiles of 8 by 8 texels, so that a renderer can
skip the tiles in which no body moves.
"""

import warp as wp

from amiwarp.simulation.kernels.edges import FirstHits, on_edge
from amiwarp.simulation.kernels.image_tiles import TILE, place_in_tile
from amiwarp.simulation.kernels.ray_casting import FAR, cast
from amiwarp.simulation.kernels.world import Pose, World
from amiwarp.simulation.kernels.world_light import illumination, luminance, radiance

wp.set_module_options({"enable_backward": False})


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
    # Positions of a texel's samples relative to its centre [texels]
    offsets: wp.array(dtype=wp.vec2)
    cone: float  # angular width of a sample [rad]
    instant: int  # number of the instant that is rendered: row of World.poses
    first: int  # index of the map's first texel in the arrays of all maps
    tiles: wp.array(dtype=int)  # numbers of the tiles to render, counted row by row


@wp.func
def texel_of_tile(frame: MapFrame, thread: int) -> int:
    """Return the index of the texel that a thread computes; -1 if the texel lies outside of the map."""
    tile = frame.tiles[thread / (TILE * TILE)]
    texel = thread % (TILE * TILE)
    return place_in_tile(frame.width, frame.height, tile * TILE * TILE + texel)


@wp.func
def map_direction(frame: MapFrame, x: float, y: float) -> wp.vec3:
    """Return the unit vector in the world's frame through texel coordinates; whole numbers are texel centres."""
    plane = wp.vec3(
        frame.left + (x + 0.5) / frame.pitch_x, frame.top + (y + 0.5) / frame.pitch_y, 1.0
    )
    return frame.pose.rotation * wp.normalize(plane)


@wp.kernel
def render_map(
    world: World, frame: MapFrame, start: int, faces: wp.array(dtype=int), out: FirstHits
):
    """Cast one ray through the centre of each texel of the tiles, and store the result and the face."""
    i = texel_of_tile(frame, start + wp.tid())
    if i < 0:
        return
    row = i / frame.width
    direction = map_direction(frame, float(i - row * frame.width), float(row))
    hit = cast(world, frame.instant, frame.pose.position, direction, FAR)
    white = illumination(world, frame.instant, frame.pose.position, direction, hit)
    out.white[i] = white
    out.light[i] = luminance(world, direction, hit, frame.cone, white)
    out.normal[i] = hit.normal
    out.face[i] = hit.face
    faces[frame.first + i] = hit.face


@wp.kernel
def smooth_edges(
    world: World, frame: MapFrame, hits: FirstHits, start: int, out: wp.array(dtype=float)
):
    """Replace the luminance of texels on edges by the mean of several rays.

    Textures need no further rays, because each ray averages the texture over the ray's angular width.
    """
    i = texel_of_tile(frame, start + wp.tid())
    if i < 0:
        return
    value = float(hits.light[i])
    if on_edge(world, hits, 0, frame.width, frame.height, 1, i):
        row = i / frame.width
        col = i - row * frame.width
        value = float(0.0)
        rays = frame.offsets.shape[0]
        for k in range(rays):
            offset = frame.offsets[k]
            direction = map_direction(frame, float(col) + offset[0], float(row) + offset[1])
            light = radiance(world, frame.instant, frame.pose.position, direction, frame.cone)
            value += light / float(rays)
    out[i] = value


@wp.kernel
def blur_lines(
    frame: MapFrame,
    image: wp.array(dtype=float),
    weights: wp.array(dtype=float),
    across: int,
    start: int,
    out: wp.array(dtype=float),
):
    """Convolve the rows (``across`` 0) or columns (``across`` 1) of an image with ``weights``.

    Texels on the border are repeated.
    """
    i = texel_of_tile(frame, start + wp.tid())
    if i < 0:
        return
    row = i / frame.width
    col = i - row * frame.width
    half = weights.shape[0] / 2
    total = float(0.0)
    for k in range(weights.shape[0]):
        near_col = wp.clamp(col + wp.where(across == 0, k - half, 0), 0, frame.width - 1)
        near_row = wp.clamp(row + wp.where(across == 1, k - half, 0), 0, frame.height - 1)
        total += weights[k] * image[near_row * frame.width + near_col]
    out[i] = total


@wp.func
def log_texel(
    frame: MapFrame, light: wp.array(dtype=float), col: int, row: int, dark: float
) -> float:
    """Return the log intensity of a texel; texels on the right and lower border are repeated."""
    inside_col = wp.min(col, frame.width - 1)
    inside_row = wp.min(row, frame.height - 1)
    return wp.log(light[inside_row * frame.width + inside_col] + dark)


@wp.kernel
def log_pieces(
    frame: MapFrame,
    light: wp.array(dtype=float),
    dark: float,
    start: int,
    out: wp.array(dtype=wp.vec4),
):
    """Compute the four coefficients of bilinear interpolation of the log intensity at each texel.

    The coefficients are the factors of 1, x, y and xy between the texel and its right and lower neighbours.
    """
    i = texel_of_tile(frame, start + wp.tid())
    if i < 0:
        return
    row = i / frame.width
    col = i - row * frame.width
    constant = log_texel(frame, light, col, row, dark)
    along_x = log_texel(frame, light, col + 1, row, dark) - constant
    along_y = log_texel(frame, light, col, row + 1, dark) - constant
    diagonal = log_texel(frame, light, col + 1, row + 1, dark)
    mixed = diagonal - constant - along_x - along_y
    out[frame.first + i] = wp.vec4(constant, along_x, along_y, mixed)
