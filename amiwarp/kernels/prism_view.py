"""Log intensity that a pixel of the simulator sees through the prism, at one instant or at several."""

import warp as wp

from amiwarp.kernels.camera import NAN, CameraParams, pixel_to_ray
from amiwarp.kernels.exact import (
    ExactParams,
    compensate_about_axis,
    compensate_uneven,
    prism_shift,
    ray_without_prism,
    refract_in_prism_frame,
    shifted,
)
from amiwarp.kernels.steerer import with_transverse

wp.set_module_options({"enable_backward": False})

# Number of instants that a CPU computes together: columns of the next four types
AHEAD = wp.constant(16)
# Rows: azimuth (cos, sin), to_texel, `second` of the instant
Instants = wp.types.matrix(shape=(13, 16), dtype=float)
TexelCoordinates = wp.types.matrix(shape=(2, 16), dtype=float)  # rows: x and y, texel coordinates
# Rows: texel index (bits of an int), x and y in it
TexelPieces = wp.types.matrix(shape=(3, 16), dtype=float)
Levels = wp.types.vector(length=16, dtype=float)  # log intensity at each instant
# Smallest z of a direction that counts as in front of the camera
SMALLEST_DEPTH = wp.constant(1.0e-3)


@wp.struct
class View:
    """What pixels see: camera, prism and the maps of the pictures."""

    camera: CameraParams
    prism: ExactParams
    second: (
        ExactParams  # second prism of a pair, about the same axis; without one, its apex angle is 0
    )
    # Coefficients of bilinear interpolation of log intensity at each texel, slot by slot
    maps: wp.array(dtype=wp.vec4)
    steered: int  # 1 if the camera looks through a beam steerer, else 0
    width: int  # width of a map [texels]
    height: int  # height of a map [texels]


@wp.struct
class Step:
    """Instant: the end of one step and the start of the next."""

    azimuth: wp.vec2  # cosine and sine of the true azimuth of the prism
    # The same for the second prism; or what a beam steerer adds to x and y of an observed unit direction
    second: wp.vec2
    to_texel: wp.mat33  # matrix from the prism's frame to homogeneous texel coordinates
    before: int  # slot of the map before this time
    after: int  # slot of the map after this time
    weight: float  # weight of the map after this time


@wp.struct
class Steps:
    """Table of the equally spaced instants of a chunk; entry ``margin`` is the start of the chunk."""

    at: wp.array(dtype=Step)
    # Ends of the steps in blocks of 16, for CPUs; the last end is repeated
    ahead: wp.array(dtype=Instants)
    angle: wp.array(dtype=float)  # true azimuth of the prism [rad]
    turn: wp.array(dtype=float)  # change of the azimuth until the next instant [rad]
    second_angle: wp.array(dtype=float)  # the same two arrays for the second prism
    second_turn: wp.array(dtype=float)
    margin: int  # number of instants before the start of the chunk
    count: int  # number of steps in the chunk
    ticks: int  # length of a step [ticks]
    per_tick: float  # length of a tick [steps]
    shift: int  # bit position of the time in a key, above the bits of the pixel


@wp.func
def mirror(x: float, size: int) -> float:
    """Reflect a texel coordinate at the map's edges; on the map it keeps its bits."""
    last = float(size - 1)
    r = wp.abs(x)
    r = r - 2.0 * last * wp.floor(r / (2.0 * last))
    return wp.where(r <= last, r, 2.0 * last - r)


@wp.func
def texel_of(x: float, size: int) -> int:
    """Return the texel whose bilinear piece contains a mirrored coordinate, which may be NaN."""
    return wp.min(int(wp.where(x >= 0.0, x, 0.0)), size - 2)


@wp.func
def bilinear_level(view: View, slot: int, texel: int, fx: float, fy: float) -> float:
    """Return the log intensity at a position in a texel's bilinear piece, with a single load."""
    c = view.maps[slot * (view.height * view.width) + texel]
    return c[0] + fx * c[1] + fy * (c[2] + fx * c[3])


@wp.func
def blend_maps(view: View, step: Step, texel: int, fx: float, fy: float) -> float:
    """Return the log intensity in a texel's bilinear piece, interpolated between the maps around an instant."""
    level = bilinear_level(view, step.before, texel, fx, fy)
    if step.weight > 0.0:
        level += step.weight * (bilinear_level(view, step.after, texel, fx, fy) - level)
    return level


@wp.func
def level_at(view: View, step: Step, u: float, v: float) -> float:
    """Return the log intensity at texel coordinates at an instant; NaN for NaN."""
    x = u
    y = v
    if not (x >= 0.0 and y >= 0.0 and x <= float(view.width - 1) and y <= float(view.height - 1)):
        x = mirror(u, view.width)
        y = mirror(v, view.height)
    col = texel_of(x, view.width)
    row = texel_of(y, view.height)
    return blend_maps(view, step, row * view.width + col, x - float(col), y - float(row))


@wp.func
def behind_second(m: ExactParams, steered: int, x: float, y: float, z: float, w0: float, w1: float):
    """Return a direction behind the second prism of a pair, in the prism's frame; the same one if there is none.

    With ``steered`` 1, a beam steerer is there, which adds (w0, w1) to the transverse part of observed directions.
    """
    a = x
    b = y
    c = z
    if m.sin_apex != 0.0:
        a, b, c = refract_in_prism_frame(
            m.sin_apex, m.cos_apex, m.index2, x, y, z, w0, w1, m.flat_to_scene
        )
    if steered == 1:
        a, b, c = with_transverse(x, y, z, -w0, -w1)
    return a, b, c


@wp.func
def ray_without_prisms(
    prism: ExactParams, second: ExactParams, steered: int, ray: wp.vec3, w: wp.vec2, w2: wp.vec2
) -> wp.vec3:
    """Return the direction of the scene point that a camera's ray sees through the prism, or both prisms of a pair.

    ``steered`` and ``w2``: as for :func:`behind_second`.
    """
    seen = ray_without_prism(prism, ray, w)
    x, y, z = behind_second(second, steered, seen[0], seen[1], seen[2], w2[0], w2[1])
    return wp.vec3(x, y, z)


@wp.func
def depth_or_nan(depth: float) -> float:
    """Return a depth, or NaN for a depth that is not in front of the camera."""
    return wp.where(depth > SMALLEST_DEPTH, depth, NAN)


@wp.func
def see_level(view: View, step: Step, ray: wp.vec3) -> float:
    """Return the log intensity that a bearing, in the prism's frame, sees at an instant; NaN if no light passes."""
    w = step.azimuth
    x = ray[0]
    y = ray[1]
    z = ray[2]
    if view.prism.uneven == 1:
        x, y, z = compensate_uneven(view.prism, x, y, z, w[0], w[1])
    else:
        along = w[0] * ray[0] + w[1] * ray[1]
        shift = prism_shift(view.prism, along, ray[2])
        x, y, z = shifted(ray[0], ray[1], ray[2], w[0], w[1], along, shift)
    x, y, z = behind_second(view.second, view.steered, x, y, z, step.second[0], step.second[1])
    h = step.to_texel * wp.vec3(x, y, z)
    depth = depth_or_nan(h[2])
    return level_at(view, step, h[0] / depth, h[1] / depth)


@wp.func
def texels_ahead(
    prism: ExactParams, second: ExactParams, steered: int, m: Instants, ray: wp.vec3
) -> TexelCoordinates:
    """Return the texel coordinates, rows x and y, that a bearing sees at several instants; see :func:`see_level`.

    LLVM vectorises this loop because it has no branches, no vector types and only contiguous loads. It is a ``while``
    loop, because Warp would unroll a ``for`` loop.
    """
    met = TexelCoordinates()
    j = int(0)
    while j < AHEAD and (prism.uneven == 1 or second.sin_apex != 0.0 or steered == 1):
        x, y, z = compensate_about_axis(prism, ray[0], ray[1], ray[2], m[0, j], m[1, j])
        x, y, z = behind_second(second, steered, x, y, z, m[11, j], m[12, j])
        depth = depth_or_nan(m[8, j] * x + m[9, j] * y + m[10, j] * z)
        met[0, j] = (m[2, j] * x + m[3, j] * y + m[4, j] * z) / depth
        met[1, j] = (m[5, j] * x + m[6, j] * y + m[7, j] * z) / depth
        j += 1
    while j < AHEAD:
        along = m[0, j] * ray[0] + m[1, j] * ray[1]
        shift = prism_shift(prism, along, ray[2])
        x, y, z = shifted(ray[0], ray[1], ray[2], m[0, j], m[1, j], along, shift)
        depth = depth_or_nan(m[8, j] * x + m[9, j] * y + m[10, j] * z)
        met[0, j] = (m[2, j] * x + m[3, j] * y + m[4, j] * z) / depth
        met[1, j] = (m[5, j] * x + m[6, j] * y + m[7, j] * z) / depth
        j += 1
    return met


@wp.func
def locate_texels(view: View, met: TexelCoordinates) -> TexelPieces:
    """Return the bilinear pieces of texel coordinates and the positions in them; see :func:`level_at`."""
    at = TexelPieces()
    j = int(0)
    while j < AHEAD:
        x = mirror(met[0, j], view.width)
        y = mirror(met[1, j], view.height)
        col = texel_of(x, view.width)
        row = texel_of(y, view.height)
        at[0, j] = wp.cast(row * view.width + col, float)
        at[1, j] = x - float(col)
        at[2, j] = y - float(row)
        j += 1
    return at


@wp.func
def levels_ahead(view: View, steps: Steps, block: int, n: int, at: TexelPieces) -> Levels:
    """Return the log intensities at the first ``n`` instants of a block."""
    levels = Levels()
    first = steps.margin + block * AHEAD + 1
    j = int(0)
    while j < n:
        levels[j] = blend_maps(
            view, steps.at[first + j], wp.cast(at[0, j], int), at[1, j], at[2, j]
        )
        j += 1
    return levels


@wp.func
def ray_in_prism_frame(view: View, index: int) -> wp.vec3:
    """Return the bearing of a pixel in the prism's frame; NaN if it points away from the prism."""
    row = index / view.camera.width
    col = index - row * view.camera.width
    ray = wp.transpose(view.prism.axis) * pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    return ray * wp.where(ray[2] > 0.0, 1.0, NAN)


@wp.kernel
def scene_bearings(
    view: View,
    xy: wp.array(dtype=wp.vec2),
    theta: wp.array(dtype=wp.vec2),
    start: int,
    out: wp.array(dtype=wp.vec3),
):
    """Compute the bearing, in the camera's frame, of the scene point that a pixel sees at the azimuths ``theta``."""
    i = start + wp.tid()
    w = wp.vec2(wp.cos(theta[i][0]), wp.sin(theta[i][0]))
    w2 = wp.vec2(wp.cos(theta[i][1]), wp.sin(theta[i][1]))
    out[i] = ray_without_prisms(view.prism, view.second, 0, pixel_to_ray(view.camera, xy[i]), w, w2)


@wp.kernel
def see_without_prism(view: View, to_texel: wp.mat33, start: int, out: wp.array(dtype=float)):
    """Compute the log intensity of each pixel without a prism, in the first map; NaN if it has no ray."""
    i = start + wp.tid()
    row = i / view.camera.width
    col = i - row * view.camera.width
    h = to_texel * pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    depth = depth_or_nan(h[2])
    out[i] = level_at(view, Step(), h[0] / depth, h[1] / depth)
