"""Event pairs as equations in a log-brightness map, one pair an equation.

The map is a set of rectangular tiles of equal shape, stored one after the other, followed by two more unknowns: the
leak, and the excess of the OFF threshold over the ON threshold. Sums are in fixed point, as votes are, so that they
do not depend on the order of threads.
"""

import warp as wp

from amiwarp.kernels.conjugate_gradients import EXTRA, add_from_warp
from amiwarp.kernels.native_code import load_float, load_int, load_uint8

wp.set_module_options({"enable_backward": False})

# Bits of a pair's ``on``: bit 0 is the polarity; bit 1, no event at the second time; bit 2, no event at the first time;
# bit 3, held out, with weight 0.
ON = wp.constant(wp.uint8(1))
QUIET = wp.constant(wp.uint8(2))
EARLY = wp.constant(wp.uint8(4))
HELD = wp.constant(wp.uint8(8))


@wp.struct
class Pairs:
    """Pairs of consecutive events of a pixel: the first sets the reference level, the second is triggered by it.

    All arrays are flat. ``azimuth`` holds four parts: the cosines of the encoder's angle at the first events, the
    sines, and both at the second events. For two prisms it holds the angles of the first prism, and of the second
    [rad]. ``time`` [s] counts from the middle of the window; ``slope`` is the derivative of the angle by the
    drifting parameter, or empty. Both hold the first events, then the second events. ``lag`` and ``offset``
    describe slow pixels (:mod:`amiwarp.kernels.slow_pixels`), or are empty. ``path`` tells how the scene of each
    tile moves in the image, or is empty.
    """

    count: int
    stride: int  # length of each part of ``azimuth``, ``time`` and ``slope``
    weak: float  # weight of pairs without two events
    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    tile: wp.array(dtype=wp.int32)
    on: wp.array(dtype=wp.uint8)  # polarity of the second event, and flags; see ON to HELD
    azimuth: wp.array(dtype=float)
    slope: wp.array(dtype=float)
    time: wp.array(dtype=float)
    # Rotation and contraction of the orbit at each event, in parts as ``azimuth``
    lag: wp.array(dtype=float)
    offset: wp.array(dtype=float)  # what the equation's left side lacks [thresholds]
    # For each tile, the factors of t, t², … in its motion along x, then along y [px]
    path: wp.array(dtype=float)


@wp.struct
class Atlas:
    """Tiles of the brightness map.

    ``origin`` (x, y, x, …) is the pixel of each tile's first node. Nodes are ``1 / density`` px apart.
    """

    origin: wp.array(dtype=float)
    rows: int
    columns: int
    density: float
    with_leak: float  # 1 if the leak is solved for, else 0
    with_off: int  # 1 if the OFF threshold is solved for, else 0


@wp.struct
class Geometry:
    """Position of both events of a pair on the map: index of the upper left node, and the fraction to the next node."""

    stride: int
    # Nodes of first, then of second events; -1 if either event is outside its tile
    cell: wp.array(dtype=int)
    # Fractions in the cells: x of first events, y of first, x of second, y of second
    part: wp.array(dtype=float)


@wp.func
def fractions_of(g: Geometry, k: int, i: int) -> wp.vec2:
    """Return the fractions (x, y) between map nodes of the first (k = 0) or second event of pair ``i``."""
    return wp.vec2(
        load_float(g.part, 2 * k * g.stride + i), load_float(g.part, (2 * k + 1) * g.stride + i)
    )


@wp.func
def fraction(node: wp.vec2) -> wp.vec2:
    """Return the fractional part of each node coordinate."""
    return wp.vec2(node[0] - wp.floor(node[0]), node[1] - wp.floor(node[1]))


@wp.func
def bilinear(f: wp.vec2) -> wp.vec4:
    """Return the bilinear weights of four nodes: upper left, upper right, lower left, lower right."""
    return wp.vec4(
        (1.0 - f[0]) * (1.0 - f[1]), f[0] * (1.0 - f[1]), (1.0 - f[0]) * f[1], f[0] * f[1]
    )


@wp.func
def interpolated(
    image: wp.array(dtype=float), columns: int, cell: int, fx: float, fy: float
) -> float:
    """Return the brightness between four nodes, of which ``cell`` is the upper left one."""
    upper = load_float(image, cell) * (1.0 - fx) + load_float(image, cell + 1) * fx
    lower = (
        load_float(image, cell + columns) * (1.0 - fx) + load_float(image, cell + columns + 1) * fx
    )
    return upper * (1.0 - fy) + lower * fy


@wp.func
def brightness_at(image: wp.array(dtype=float), g: Geometry, columns: int, k: int, i: int) -> float:
    """Return the brightness at the first (k = 0) or second event of a pair, or at node 0 for a pair off the map."""
    cell = wp.max(load_int(g.cell, k * g.stride + i), 0)
    fx = load_float(g.part, 2 * k * g.stride + i)
    fy = load_float(g.part, (2 * k + 1) * g.stride + i)
    return interpolated(image, columns, cell, fx, fy)


@wp.func
def is_off(pairs: Pairs, i: int) -> float:
    """Return 1 if the second event of the pair is an OFF event, else 0."""
    return wp.where((int(load_uint8(pairs.on, i)) & 3) == 0, 1.0, 0.0)


@wp.func
def sensor_terms(image: wp.array(dtype=float), atlas: Atlas, pairs: Pairs, i: int) -> float:
    """Return the terms of a pair's equation that do not depend on the map: [OFF] s + leak (t2 - t1)."""
    extra = image.shape[0] - EXTRA
    value = is_off(pairs, i) * load_float(image, extra + 1)
    if atlas.with_leak > 0.0:
        elapsed = load_float(pairs.time, pairs.stride + i) - load_float(pairs.time, i)
        value += load_float(image, extra) * elapsed
    return value


@wp.func
def difference(
    image: wp.array(dtype=float), atlas: Atlas, pairs: Pairs, g: Geometry, i: int
) -> float:
    """Return the left side of a pair's equation: L(second) - L(first) + [OFF] s + leak (t2 - t1)."""
    value = brightness_at(image, g, atlas.columns, 1, i) - brightness_at(
        image, g, atlas.columns, 0, i
    )
    return value + sensor_terms(image, atlas, pairs, i)


@wp.func
def right_side(pairs: Pairs, i: int) -> float:
    """Return the right side in units of the ON threshold: +1 for ON, -1 for OFF, 0 for a quiet pixel."""
    on = int(load_uint8(pairs.on, i))
    return wp.where((on & 2) != 0, 0.0, wp.where((on & 1) != 0, 1.0, -1.0))


@wp.func
def add_extra(sums: wp.array(dtype=wp.int64), atlas: Atlas, pairs: Pairs, i: int, value: float):
    """Add a value to the sums of the leak and the OFF threshold. On CUDA all threads of a warp must call it."""
    extra = sums.shape[0] - EXTRA
    if atlas.with_leak > 0.0:
        add_from_warp(sums, extra, value * (pairs.time[pairs.stride + i] - pairs.time[i]))
    if atlas.with_off != 0:
        add_from_warp(sums, extra + 1, is_off(pairs, i) * value)


@wp.func
def add_extra_diagonal(
    sums: wp.array(dtype=wp.int64), atlas: Atlas, pairs: Pairs, i: int, weight: float
):
    """Add the squared coefficients of the leak and the OFF threshold times a weight to their sums; see
    :func:`add_extra`."""
    extra = sums.shape[0] - EXTRA
    if atlas.with_leak > 0.0:
        gap = pairs.time[pairs.stride + i] - pairs.time[i]
        add_from_warp(sums, extra, weight * gap * gap)
    if atlas.with_off != 0:
        add_from_warp(sums, extra + 1, is_off(pairs, i) * weight)


@wp.func
def residual_of(pairs: Pairs, difference: float, i: int) -> float:
    """Return the residual of an equation whose left side is ``difference``."""
    r = right_side(pairs, i) - difference
    if pairs.offset.shape[0] > 0:
        r -= pairs.offset[i]
    return r


@wp.func
def weight_of(pairs: Pairs, r: float, scale: float, i: int) -> float:
    """Return the Cauchy weight of an equation with residual ``r``."""
    cauchy = 1.0 / (1.0 + (r / scale) * (r / scale))
    on = load_uint8(pairs.on, i)
    # the scale of the residuals of quiet pairs is one threshold, the accuracy of such pairs
    cauchy = wp.where(on > ON, pairs.weak / (1.0 + r * r), cauchy)
    return wp.where((on & HELD) != wp.uint8(0), 0.0, cauchy)
