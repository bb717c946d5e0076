"""Device side of the simulator: what a pixel sees through the prism at an instant, or at several at once."""

import warp as wp

from amiwarp.kernels.camera import CameraParams, pixel_to_ray
from amiwarp.kernels.optics import ExactParams, trace

wp.set_module_options({"enable_backward": False})

AHEAD = wp.constant(16)  # instants that a CPU looks at together: the columns of the next four types
Instants = wp.types.matrix(shape=(11, 16), dtype=float)  # rows: cos and sin of the azimuth, then to_texel
Met = wp.types.matrix(shape=(2, 16), dtype=float)  # rows: x and y, texel coordinates
Located = wp.types.matrix(shape=(3, 16), dtype=float)  # rows: a texel's number (an int's bits), x and y from its centre
Levels = wp.types.vector(length=16, dtype=float)  # log intensities
SMALLEST_DEPTH = wp.constant(1.0e-3)  # of what a bearing meets, before the camera
NAN = wp.constant(float("nan"))


@wp.struct
class View:
    """What the pixels look at: camera, prism, picture maps."""

    camera: CameraParams
    prism: ExactParams
    maps: wp.array(dtype=wp.vec4)  # log intensity, as the four numbers of each texel's bilinear piece; slot by slot
    width: int  # of a map
    height: int


@wp.struct
class Step:
    """An instant: the end of one step and the start of the next."""

    azimuth: wp.vec2  # cos, sin of the true tilt azimuth
    to_texel: wp.mat33  # prism's frame to homogeneous texel coordinates
    before: int  # slots of the maps before and after this time
    after: int
    weight: float  # of the one after


@wp.struct
class Steps:
    """A chunk's table of instants, equally spaced; entry ``margin`` is the chunk's start."""

    at: wp.array(dtype=Step)
    ahead: wp.array(dtype=Instants)  # the ends of the chunk's steps again, the last ones repeated; on a CPU only
    angle: wp.array(dtype=float)  # true tilt azimuth [rad]
    turn: wp.array(dtype=float)  # its change until the next instant
    margin: int
    count: int
    ticks: int  # per step
    per_tick: float  # steps
    shift: int  # of the time in a key: above the bits of the pixel


@wp.func
def mirror(x: float, size: int) -> float:
    """Texel coordinate reflected at the map's edges; to the bit the same where it is on the map."""
    last = float(size - 1)
    r = wp.abs(x)
    r = r - 2.0 * last * wp.floor(r / (2.0 * last))
    return wp.where(r <= last, r, 2.0 * last - r)


@wp.func
def corner(x: float, size: int) -> int:
    """Texel whose bilinear piece holds a mirrored coordinate, which may be NaN."""
    return wp.min(int(wp.where(x >= 0.0, x, 0.0)), size - 2)


@wp.func
def piece(view: View, slot: int, texel: int, fx: float, fy: float) -> float:
    """Bilinear look-up: one load."""
    c = view.maps[slot * (view.height * view.width) + texel]
    return c[0] + fx * c[1] + fy * (c[2] + fx * c[3])


@wp.func
def blend(view: View, step: Step, texel: int, fx: float, fy: float) -> float:
    """Log intensity at a place in a bilinear piece, between the maps before and after an instant."""
    level = piece(view, step.before, texel, fx, fy)
    if step.weight > 0.0:
        level += step.weight * (piece(view, step.after, texel, fx, fy) - level)
    return level


@wp.func
def look(view: View, step: Step, u: float, v: float) -> float:
    """Log intensity at texel coordinates at an instant; NaN stays NaN."""
    x = u
    y = v
    if not (x >= 0.0 and y >= 0.0 and x <= float(view.width - 1) and y <= float(view.height - 1)):
        x = mirror(u, view.width)
        y = mirror(v, view.height)
    col = corner(x, view.width)
    row = corner(y, view.height)
    return blend(view, step, row * view.width + col, x - float(col), y - float(row))


@wp.func
def bend(m: ExactParams, along: float, z: float) -> float:
    """How far the prism shifts a bearing along the azimuth, as in kernels/optics.py; NaN where it lets no light pass.

    ``along``, ``z``: the bearing's components along the azimuth and the axis. Without branches, see :func:`meet_ahead`:
    the square root of a negative number is NaN, which stays NaN to the end.
    """
    inside = m.index2 - 1.0
    if m.flat_to_scene == 1:
        q = m.sin_apex * along + m.cos_apex * z
        return m.sin_apex * (wp.sqrt(inside + q * q) - wp.where(q > 0.0, q, NAN))
    q = m.sin_apex * along + m.cos_apex * wp.sqrt(inside + z * z)
    return m.sin_apex * (wp.sqrt(q * q - inside) - q)


@wp.func
def in_front(depth: float) -> float:
    """A depth; NaN where it is not before the camera."""
    return wp.where(depth > SMALLEST_DEPTH, depth, NAN)


@wp.func
def see(view: View, step: Step, ray: wp.vec3) -> float:
    """Log intensity that a bearing (in the prism's frame) meets at an instant; NaN where it has no ray."""
    w = step.azimuth
    along = w[0] * ray[0] + w[1] * ray[1]
    shift = bend(view.prism, along, ray[2])
    z = wp.sqrt(ray[2] * ray[2] - shift * (2.0 * along + shift))
    h = step.to_texel * wp.vec3(ray[0] + shift * w[0], ray[1] + shift * w[1], z)
    depth = in_front(h[2])
    return look(view, step, h[0] / depth, h[1] / depth)


@wp.func
def meet_ahead(prism: ExactParams, m: Instants, ray: wp.vec3) -> Met:
    """Texel coordinates, as :func:`see` has them, that a bearing meets at several instants: rows of x and y.

    LLVM turns such a loop to vector instructions: it has no branches, no vectors, no loads but contiguous ones, and is
    no ``for``, which would be unrolled.
    """
    met = Met()
    j = int(0)
    while j < AHEAD:
        along = m[0, j] * ray[0] + m[1, j] * ray[1]
        shift = bend(prism, along, ray[2])
        x = ray[0] + shift * m[0, j]
        y = ray[1] + shift * m[1, j]
        z = wp.sqrt(ray[2] * ray[2] - shift * (2.0 * along + shift))
        depth = in_front(m[8, j] * x + m[9, j] * y + m[10, j] * z)
        met[0, j] = (m[2, j] * x + m[3, j] * y + m[4, j] * z) / depth
        met[1, j] = (m[5, j] * x + m[6, j] * y + m[7, j] * z) / depth
        j += 1
    return met


@wp.func
def locate_ahead(view: View, met: Met) -> Located:
    """Bilinear pieces that hold texel coordinates, and the places in them, as :func:`look` has them."""
    at = Located()
    j = int(0)
    while j < AHEAD:
        x = mirror(met[0, j], view.width)
        y = mirror(met[1, j], view.height)
        col = corner(x, view.width)
        row = corner(y, view.height)
        at[0, j] = wp.cast(row * view.width + col, float)
        at[1, j] = x - float(col)
        at[2, j] = y - float(row)
        j += 1
    return at


@wp.func
def see_ahead(view: View, steps: Steps, block: int, n: int, at: Located) -> Levels:
    """Log intensities at the first ``n`` instants of a block."""
    levels = Levels()
    first = steps.margin + block * AHEAD + 1
    j = int(0)
    while j < n:
        levels[j] = blend(view, steps.at[first + j], wp.cast(at[0, j], int), at[1, j], at[2, j])
        j += 1
    return levels


@wp.func
def local_ray(view: View, index: int) -> wp.vec3:
    """Bearing of a pixel in the prism's frame; NaN where it points away from the prism."""
    row = index / view.camera.width
    col = index - row * view.camera.width
    ray = wp.transpose(view.prism.axis) * pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    return ray * wp.where(ray[2] > 0.0, 1.0, NAN)


@wp.kernel
def scene_bearings(
    camera: CameraParams,
    prism: ExactParams,
    xy: wp.array(dtype=wp.vec2),
    theta: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=wp.vec3),
):
    """Bearing in the camera's frame of what a pixel sees at tilt azimuth ``theta``."""
    i = start + wp.tid()
    w = wp.vec2(wp.cos(theta[i]), wp.sin(theta[i]))
    out[i] = trace(prism, pixel_to_ray(camera, xy[i]), w, prism.flat_to_scene)


@wp.kernel
def see_without_prism(view: View, to_texel: wp.mat33, start: int, out: wp.array(dtype=float)):
    """Log intensity at each pixel with no prism, in the first map; NaN where it has no ray."""
    i = start + wp.tid()
    row = i / view.camera.width
    col = i - row * view.camera.width
    h = to_texel * pixel_to_ray(view.camera, wp.vec2(float(col), float(row)))
    depth = in_front(h[2])
    out[i] = look(view, Step(), h[0] / depth, h[1] / depth)
