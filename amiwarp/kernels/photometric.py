"""Device side of the photometric stage: pairs of events as equations in a log-brightness map, and their operator.

The map is a set of rectangular tiles of equal shape, one behind the other, followed by two more unknowns: by how much
the OFF threshold exceeds the ON threshold, and the leak. Sums are kept in fixed point, as votes are: they do not depend
on the order of threads.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, TurningParams, turn_back
from amiwarp.kernels.descent import add_fixed
from amiwarp.kernels.optics import MODEL_STRUCTS, azimuth, compensate

wp.set_module_options({"enable_backward": False})

EXTRA = wp.constant(2)  # unknowns behind the map: leak, OFF threshold
# What a pair's ``on`` may hold: bit 0, the polarity; bit 1, no event at the second time; bit 2, none at the first.
ON = wp.constant(wp.uint8(1))
QUIET = wp.constant(wp.uint8(2))


@wp.struct
class Pairs:
    """Two consecutive events of a pixel each: the first sets the reference, the second is fired."""

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    tile: wp.array(dtype=wp.int32)
    theta: wp.array(dtype=wp.vec2)  # encoder's angle at either [rad]
    slope: wp.array(dtype=wp.vec2)  # its change per unit of the drifting parameter
    time: wp.array(dtype=wp.vec2)  # of either, from the window's middle [s]
    on: wp.array(dtype=wp.uint8)  # polarity of the second, and which of the two is no event
    weak: float  # weight of pairs that are not of two events


@wp.struct
class Atlas:
    """Tiles of the map: ``origin`` is the pixel of a tile's first node, nodes are ``1 / density`` px apart."""

    origin: wp.array(dtype=wp.vec2)
    rows: int
    columns: int
    density: float
    with_leak: float


@wp.struct
class Geometry:
    """Where either event of a pair falls on the map: index of the upper left node, and the way to the next."""

    cell: wp.array(dtype=wp.vec2i)  # -1: not on its tile
    first: wp.array(dtype=wp.vec2)
    second: wp.array(dtype=wp.vec2)


@wp.func
def node_of(atlas: Atlas, tile: int, xy: wp.vec2) -> wp.vec2:
    return (xy - atlas.origin[tile]) * atlas.density


@wp.func
def cell_of(atlas: Atlas, tile: int, node: wp.vec2) -> int:
    """Index of the node to the upper left; -1 off the tile."""
    inside = node[0] >= 0.0 and node[1] >= 0.0
    if not (inside and node[0] < float(atlas.columns - 1) and node[1] < float(atlas.rows - 1)):
        return -1
    return (tile * atlas.rows + int(node[1])) * atlas.columns + int(node[0])


@wp.func
def fraction(node: wp.vec2) -> wp.vec2:
    return wp.vec2(node[0] - wp.floor(node[0]), node[1] - wp.floor(node[1]))


@wp.func
def place_of(
    model: Any, camera: CameraParams, turning: TurningParams, pairs: Pairs, drift: float, i: int, k: int
) -> wp.vec2:
    """Compensated place of the first (k = 0) or second event of a pair [px]."""
    theta = pairs.theta[i][k] + pairs.slope[i][k] * drift
    xy = compensate(model, camera, wp.vec2(float(pairs.x[i]), float(pairs.y[i])), azimuth(model, theta))
    return turn_back(camera, xy, turning, pairs.time[i][k])


@wp.kernel
def find_places(
    model: Any,
    camera: CameraParams,
    pairs: Pairs,
    drift: float,
    turning: TurningParams,
    start: int,
    places: wp.array(dtype=wp.vec4),
):
    """Compensated places of both events of a pair [px]."""
    i = start + wp.tid()
    a = place_of(model, camera, turning, pairs, drift, i, 0)
    b = place_of(model, camera, turning, pairs, drift, i, 1)
    places[i] = wp.vec4(a[0], a[1], b[0], b[1])


@wp.kernel
def place_pairs(
    model: Any,
    camera: CameraParams,
    pairs: Pairs,
    atlas: Atlas,
    drift: float,
    turning: TurningParams,
    start: int,
    geometry: Geometry,
):
    """Compensated places of both events of a pair, on the map."""
    i = start + wp.tid()
    a = node_of(atlas, pairs.tile[i], place_of(model, camera, turning, pairs, drift, i, 0))
    b = node_of(atlas, pairs.tile[i], place_of(model, camera, turning, pairs, drift, i, 1))
    cell = wp.vec2i(cell_of(atlas, pairs.tile[i], a), cell_of(atlas, pairs.tile[i], b))
    if cell[0] < 0 or cell[1] < 0:
        cell = wp.vec2i(-1, -1)
    geometry.cell[i] = cell
    geometry.first[i] = fraction(a)
    geometry.second[i] = fraction(b)


@wp.func
def bilinear(f: wp.vec2) -> wp.vec4:
    """Weights of the nodes: upper left, upper right, lower left, lower right."""
    return wp.vec4((1.0 - f[0]) * (1.0 - f[1]), f[0] * (1.0 - f[1]), (1.0 - f[0]) * f[1], f[0] * f[1])


@wp.func
def look_up(image: wp.array(dtype=float), cell: int, columns: int, w: wp.vec4) -> float:
    upper = image[cell] * w[0] + image[cell + 1] * w[1]
    return upper + image[cell + columns] * w[2] + image[cell + columns + 1] * w[3]


@wp.func
def spread(sums: wp.array(dtype=wp.int64), cell: int, columns: int, w: wp.vec4, value: float):
    """The reverse of :func:`look_up`."""
    add_fixed(sums, cell, w[0] * value)
    add_fixed(sums, cell + 1, w[1] * value)
    add_fixed(sums, cell + columns, w[2] * value)
    add_fixed(sums, cell + columns + 1, w[3] * value)


@wp.func
def difference(image: wp.array(dtype=float), atlas: Atlas, pairs: Pairs, g: Geometry, i: int) -> float:
    """Left side of a pair's equation: L(second) - L(first) + [OFF] s + leak (t2 - t1)."""
    cell = g.cell[i]
    extra = image.shape[0] - EXTRA
    value = look_up(image, cell[1], atlas.columns, bilinear(g.second[i]))
    value -= look_up(image, cell[0], atlas.columns, bilinear(g.first[i]))
    value += atlas.with_leak * image[extra] * (pairs.time[i][1] - pairs.time[i][0])
    if is_off(pairs, i):
        value += image[extra + 1]
    return value


@wp.func
def right_side(pairs: Pairs, i: int) -> float:
    """In units of the ON threshold: +1 for ON, -1 for OFF, 0 where the pixel kept quiet."""
    if (pairs.on[i] & QUIET) != wp.uint8(0):
        return 0.0
    return wp.where((pairs.on[i] & ON) != wp.uint8(0), 1.0, -1.0)


@wp.func
def is_off(pairs: Pairs, i: int) -> bool:
    return (pairs.on[i] & (ON | QUIET)) == wp.uint8(0)


@wp.func
def transpose_add(sums: wp.array(dtype=wp.int64), atlas: Atlas, pairs: Pairs, g: Geometry, i: int, value: float):
    """The transpose of :func:`difference`."""
    cell = g.cell[i]
    extra = sums.shape[0] - EXTRA
    spread(sums, cell[1], atlas.columns, bilinear(g.second[i]), value)
    spread(sums, cell[0], atlas.columns, bilinear(g.first[i]), -value)
    if atlas.with_leak > 0.0:
        add_fixed(sums, extra, value * (pairs.time[i][1] - pairs.time[i][0]))
    if is_off(pairs, i):
        add_fixed(sums, extra + 1, value)


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
    if geometry.cell[i][0] >= 0:
        value = weight[i] * difference(vector, atlas, pairs, geometry, i)
        transpose_add(sums, atlas, pairs, geometry, i, value)


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
    if geometry.cell[i][0] >= 0:
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
    if geometry.cell[i][0] >= 0:
        residual[i] = residual[i] - difference(vector, atlas, pairs, geometry, i)
    else:
        residual[i] = 0.0


@wp.func
def square(w: wp.vec4) -> wp.vec4:
    return wp.cw_mul(w, w)


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
    cell = geometry.cell[i]
    extra = sums.shape[0] - EXTRA
    if cell[0] >= 0:
        spread(sums, cell[1], atlas.columns, square(bilinear(geometry.second[i])), weight[i])
        spread(sums, cell[0], atlas.columns, square(bilinear(geometry.first[i])), weight[i])
        gap = pairs.time[i][1] - pairs.time[i][0]
        add_fixed(sums, extra, atlas.with_leak * weight[i] * gap * gap)
        if is_off(pairs, i):
            add_fixed(sums, extra + 1, weight[i])


@wp.kernel
def weigh(
    pairs: Pairs,
    atlas: Atlas,
    geometry: Geometry,
    image: wp.array(dtype=float),
    scale: float,
    start: int,
    weight: wp.array(dtype=float),
    residual: wp.array(dtype=float),
):
    """Residual of each equation, and Cauchy's weight for it; NaN and 0 for a pair that is not on the map."""
    i = start + wp.tid()
    weight[i] = 0.0
    residual[i] = wp.nan
    if geometry.cell[i][0] >= 0:
        r = right_side(pairs, i) - difference(image, atlas, pairs, geometry, i)
        residual[i] = r
        if pairs.on[i] > ON:
            weight[i] = pairs.weak / (1.0 + r * r)  # right to within a threshold
        else:
            weight[i] = 1.0 / (1.0 + (r / scale) * (r / scale))


for _struct in MODEL_STRUCTS:
    wp.overload(place_pairs, {"model": _struct})
    wp.overload(find_places, {"model": _struct})
