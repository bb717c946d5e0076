"""Device side of the photometric stage: pairs of events as equations in a log-brightness map, and their operator.

The map is a set of rectangular tiles of equal shape, one behind the other, followed by two more unknowns: the leak, and
by how much the OFF threshold exceeds the ON threshold. Sums are kept in fixed point, as votes are: they do not depend
on the order of threads. Of what is done often there are two kernels: on CUDA a thread takes one pair, on a CPU a block
of :data:`BLOCK`, in loops that vectorise.
"""

import warp as wp

from amiwarp.kernels.camera import NAN
from amiwarp.kernels.descent import add_fixed, add_two, to_fixed
from amiwarp.kernels.native import load_float, load_int, load_uint8, store_float
from amiwarp.kernels.prior import EXTRA

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(64)  # pairs that a CPU takes at a time; their arrays are padded to whole blocks
# What a pair's ``on`` may hold: bit 0, the polarity; bit 1, no event at the second time; bit 2, none at the first;
# bit 3, held out: it does not weigh.
ON = wp.constant(wp.uint8(1))
QUIET = wp.constant(wp.uint8(2))
HELD = wp.constant(wp.uint8(8))


@wp.struct
class Pairs:
    """Two consecutive events of a pixel each: the first sets the reference, the second is fired.

    Flat arrays: ``azimuth`` holds all cosines of the encoder's angle at the first, the sines, and both at the second;
    ``time`` [s] from the window's middle, and ``slope`` of the angle per unit of the drifting parameter (or empty),
    all first, then all second ones.
    """

    count: int
    stride: int  # length of each of these parts
    weak: float  # weight of pairs that are not of two events
    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    tile: wp.array(dtype=wp.int32)
    on: wp.array(dtype=wp.uint8)  # polarity of the second, and which of the two is no event
    azimuth: wp.array(dtype=float)
    slope: wp.array(dtype=float)
    time: wp.array(dtype=float)


@wp.struct
class Atlas:
    """Tiles of the map: ``origin`` (x, y, x, …) is the pixel of a tile's first node, nodes are ``1 / density`` px
    apart."""

    origin: wp.array(dtype=float)
    rows: int
    columns: int
    density: float
    with_leak: float
    with_off: int  # whether the OFF threshold is solved for


@wp.struct
class Geometry:
    """Where either event of a pair falls on the map: index of the upper left node, and the way to the next."""

    stride: int
    cell: wp.array(dtype=int)  # of all first, then all second events; -1: one of the two is not on its tile
    part: wp.array(dtype=float)  # all x of the first, y, x of the second, y


# -- one equation


@wp.func
def part_of(g: Geometry, k: int, i: int) -> wp.vec2:
    return wp.vec2(load_float(g.part, 2 * k * g.stride + i), load_float(g.part, (2 * k + 1) * g.stride + i))


@wp.func
def fraction(node: wp.vec2) -> wp.vec2:
    return wp.vec2(node[0] - wp.floor(node[0]), node[1] - wp.floor(node[1]))


@wp.func
def bilinear(f: wp.vec2) -> wp.vec4:
    """Weights of the nodes: upper left, upper right, lower left, lower right."""
    return wp.vec4((1.0 - f[0]) * (1.0 - f[1]), f[0] * (1.0 - f[1]), (1.0 - f[0]) * f[1], f[0] * f[1])


@wp.func
def look_up(image: wp.array(dtype=float), g: Geometry, columns: int, k: int, i: int) -> float:
    """Brightness at the first (k = 0) or second event; that of node 0 for a pair off the map."""
    cell = wp.max(load_int(g.cell, k * g.stride + i), 0)
    fx = load_float(g.part, 2 * k * g.stride + i)
    fy = load_float(g.part, (2 * k + 1) * g.stride + i)
    upper = load_float(image, cell) * (1.0 - fx) + load_float(image, cell + 1) * fx
    lower = load_float(image, cell + columns) * (1.0 - fx) + load_float(image, cell + columns + 1) * fx
    return upper * (1.0 - fy) + lower * fy


@wp.func
def is_off(pairs: Pairs, i: int) -> float:
    return wp.where((int(load_uint8(pairs.on, i)) & 3) == 0, 1.0, 0.0)


@wp.func
def difference(image: wp.array(dtype=float), atlas: Atlas, pairs: Pairs, g: Geometry, i: int) -> float:
    """Left side of a pair's equation: L(second) - L(first) + [OFF] s + leak (t2 - t1)."""
    extra = image.shape[0] - EXTRA
    value = look_up(image, g, atlas.columns, 1, i) - look_up(image, g, atlas.columns, 0, i)
    elapsed = load_float(pairs.time, pairs.stride + i) - load_float(pairs.time, i)
    value += atlas.with_leak * load_float(image, extra) * elapsed
    return value + is_off(pairs, i) * load_float(image, extra + 1)


@wp.func
def right_side(pairs: Pairs, i: int) -> float:
    """In units of the ON threshold: +1 for ON, -1 for OFF, 0 where the pixel kept quiet."""
    on = int(load_uint8(pairs.on, i))
    return wp.where((on & 2) != 0, 0.0, wp.where((on & 1) != 0, 1.0, -1.0))


@wp.func
def spread(sums: wp.array(dtype=wp.int64), cell: int, columns: int, f: wp.vec2, value: float):
    """The reverse of :func:`look_up`."""
    upper = value * (1.0 - f[1])
    lower = value * f[1]
    add_two(sums, cell, to_fixed(upper * (1.0 - f[0])), to_fixed(upper * f[0]))
    add_two(sums, cell + columns, to_fixed(lower * (1.0 - f[0])), to_fixed(lower * f[0]))


@wp.func
def transpose_add(sums: wp.array(dtype=wp.int64), atlas: Atlas, pairs: Pairs, g: Geometry, i: int, value: float):
    """The transpose of :func:`difference`; nothing for a pair off the map."""
    if g.cell[i] < 0:
        return
    spread(sums, g.cell[g.stride + i], atlas.columns, part_of(g, 1, i), value)
    spread(sums, g.cell[i], atlas.columns, part_of(g, 0, i), -value)
    add_extra(sums, atlas, pairs, i, value)


@wp.func
def add_extra(sums: wp.array(dtype=wp.int64), atlas: Atlas, pairs: Pairs, i: int, value: float):
    """To the unknowns behind the map."""
    extra = sums.shape[0] - EXTRA
    if atlas.with_leak > 0.0:
        add_fixed(sums, extra, value * (pairs.time[pairs.stride + i] - pairs.time[i]))
    if atlas.with_off != 0:
        add_fixed(sums, extra + 1, is_off(pairs, i) * value)


@wp.func
def continues(g: Geometry, i: int) -> bool:
    """Whether pair i - 1, i > 0, ends where pair i begins: one addition then does for both."""
    before = g.stride + i - 1
    if g.cell[i] < 0 or g.cell[i] != g.cell[before]:
        return False
    return g.part[i] == g.part[g.stride + before] and g.part[g.stride + i] == g.part[2 * g.stride + before]


# -- all equations


@wp.kernel
def apply_normal(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    vector: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """sums += Aᵀ W A vector."""
    i = start + wp.tid()
    if geometry.cell[i] < 0:
        return
    value = weight[i] * difference(vector, atlas, pairs, geometry, i)
    add_extra(sums, atlas, pairs, i, value)
    if i == 0 or not continues(geometry, i):
        spread(sums, geometry.cell[i], atlas.columns, part_of(geometry, 0, i), -value)
    if i + 1 < pairs.count and continues(geometry, i + 1):
        value -= weight[i + 1] * difference(vector, atlas, pairs, geometry, i + 1)
    spread(sums, geometry.cell[geometry.stride + i], atlas.columns, part_of(geometry, 1, i), value)


@wp.kernel
def apply_normal_blocks(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    vector: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """The same, a block a thread."""
    first = (start + wp.tid()) * BLOCK
    values = wp.zeros(shape=(64,), dtype=float)
    for k in range(BLOCK):
        store_float(values, k, load_float(weight, first + k) * difference(vector, atlas, pairs, geometry, first + k))
    for k in range(BLOCK):
        transpose_add(sums, atlas, pairs, geometry, first + k, values[k])


@wp.kernel
def apply_transpose(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """sums += Aᵀ W residual."""
    i = start + wp.tid()
    transpose_add(sums, atlas, pairs, geometry, i, weight[i] * residual[i])


@wp.kernel
def subtract(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    vector: wp.array(dtype=float),
    start: int,
    residual: wp.array(dtype=float),
):
    """residual -= A vector; 0 for a pair that is not on the map."""
    i = start + wp.tid()
    if i < pairs.count:
        rest = residual[i] - difference(vector, atlas, pairs, geometry, i)
        residual[i] = wp.where(geometry.cell[i] >= 0, rest, 0.0)


@wp.kernel
def add_diagonal(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    weight: wp.array(dtype=float),
    start: int,
    sums: wp.array(dtype=wp.int64),
):
    """sums += diag(Aᵀ W A), as if the two places of a pair shared no node: the preconditioner."""
    i = start + wp.tid()
    if geometry.cell[i] < 0:
        return
    extra = sums.shape[0] - EXTRA
    for k in range(2):
        w = bilinear(part_of(geometry, k, i))
        w = wp.cw_mul(w, w) * weight[i]
        cell = geometry.cell[k * geometry.stride + i]
        add_two(sums, cell, to_fixed(w[0]), to_fixed(w[1]))
        add_two(sums, cell + atlas.columns, to_fixed(w[2]), to_fixed(w[3]))
    gap = pairs.time[pairs.stride + i] - pairs.time[i]
    if atlas.with_leak > 0.0:
        add_fixed(sums, extra, weight[i] * gap * gap)
    if atlas.with_off != 0:
        add_fixed(sums, extra + 1, is_off(pairs, i) * weight[i])


@wp.kernel
def weigh(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    image: wp.array(dtype=float),
    scale: wp.array(dtype=float),
    start: int,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
):
    """Residual of each equation, and Cauchy's weight for it; NaN and 0 for a pair that is not on the map."""
    i = start + wp.tid()
    if i >= pairs.count:
        return
    r = right_side(pairs, i) - difference(image, atlas, pairs, geometry, i)
    on_map = geometry.cell[i] >= 0
    residual[i] = wp.where(on_map, r, NAN)
    cauchy = 1.0 / (1.0 + (r / scale[0]) * (r / scale[0]))
    if pairs.on[i] > ON:
        cauchy = pairs.weak / (1.0 + r * r)  # right to within a threshold
    if (pairs.on[i] & HELD) != wp.uint8(0):
        cauchy = 0.0
    weight[i] = wp.where(on_map, cauchy, 0.0)
