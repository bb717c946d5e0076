"""Positions of event pairs on the brightness map, for :mod:`amiwarp.brightness.positions`."""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import NAN, CameraParams, PinholeParams
from amiwarp.kernels.camera_rotation import CameraRotationParams, undo_camera_rotation
from amiwarp.kernels.equations import Atlas, Geometry, Pairs
from amiwarp.kernels.equations_cpu import BLOCK, interpolate
from amiwarp.kernels.native_code import load_float, load_int, load_uint16, store_float, store_int
from amiwarp.kernels.plain_models import even, is_even, is_plain, plain
from amiwarp.kernels.refraction import advanced, compensate, displace, state_of

wp.set_module_options({"enable_backward": False})

PATH_TERMS = wp.constant(4)  # number of powers of time in the path of a tile


@wp.func
def node_from(atlas: Atlas, tile: int, left: float, top: float, x: float, y: float):
    """Return :func:`node_at` for the tile's origin (``left``, ``top``)."""
    u = (x - left) * atlas.density
    v = (y - top) * atlas.density
    inside = wp.where(u >= 0.0, wp.where(u < float(atlas.columns - 1), 1, 0), 0)
    inside = wp.where(v >= 0.0, wp.where(v < float(atlas.rows - 1), inside, 0), 0)
    u = wp.where(inside == 1, u, 0.0)
    v = wp.where(inside == 1, v, 0.0)
    cell = (tile * atlas.rows + int(v)) * atlas.columns + int(u)
    return wp.where(inside == 1, cell, -1), u - float(int(u)), v - float(int(v))


@wp.func
def node_at(atlas: Atlas, tile: int, x: float, y: float):
    """Return the map node up and left of a position, and the fractions to the next; -1 off the tile, and for NaN."""
    left = load_float(atlas.origin, 2 * tile)
    top = load_float(atlas.origin, 2 * tile + 1)
    cell, u, v = node_from(atlas, tile, left, top, x, y)
    return cell, u, v


@wp.func
def event_state(model: Any, pairs: Pairs, k: int, i: int):
    """Return the optic's state at the first (k = 0) or second event of pair ``i``."""
    a = load_float(pairs.azimuth, 2 * k * pairs.stride + i)
    b = load_float(pairs.azimuth, (2 * k + 1) * pairs.stride + i)
    w0, w1 = state_of(model, a, b)
    return w0, w1


@wp.func
def turned(w0: float, w1: float, c: float, s: float) -> wp.vec2:
    """Return the direction (w0, w1) rotated by the angle with cosine ``c`` and sine ``s``."""
    return wp.vec2(w0 * c - w1 * s, w1 * c + w0 * s)


@wp.func
def drifted_state(model: Any, pairs: Pairs, drift: float, k: int, i: int) -> wp.vec2:
    """Return the optic's state at the first (k = 0) or second event of a pair, at the given drift."""
    w0, w1 = event_state(model, pairs, k, i)
    if pairs.slope.shape[0] == 0:
        return wp.vec2(w0, w1)
    return advanced(model, w0, w1, pairs.slope[k * pairs.stride + i] * drift)


@wp.func
def without_path(pairs: Pairs, k: int, i: int, xy: wp.vec2) -> wp.vec2:
    """Return where the scene at ``xy`` at the first (k = 0) or second event of a pair is at time 0.

    The scene of each tile moves on its own path, a polynomial of time.
    """
    if pairs.path.shape[0] == 0:
        return xy
    first = 2 * PATH_TERMS * pairs.tile[i]
    time = pairs.time[k * pairs.stride + i]
    moved = wp.vec2(0.0, 0.0)
    for j in range(PATH_TERMS):
        term = first + PATH_TERMS - 1 - j
        moved = (moved + wp.vec2(pairs.path[term], pairs.path[term + PATH_TERMS])) * time
    return xy - moved


@wp.func
def compensated_position(
    model: Any,
    camera: CameraParams,
    camera_rotation: CameraRotationParams,
    pairs: Pairs,
    drift: float,
    i: int,
    k: int,
) -> wp.vec2:
    """Return the compensated position [px] of the first (k = 0) or second event of a pair, at the given drift."""
    w = drifted_state(model, pairs, drift, k, i)
    pixel = wp.vec2(float(pairs.x[i]), float(pairs.y[i]))
    if pairs.lag.shape[0] > 0:
        return contracted_position(model, camera, pixel, w[0], w[1], lag_of(pairs, k, i))
    xy = compensate(model, camera, pixel, w)
    xy = undo_camera_rotation(camera, xy, camera_rotation, pairs.time[k * pairs.stride + i])
    return without_path(pairs, k, i, xy)


@wp.func
def compensated_position(
    model: Any,
    camera: PinholeParams,
    camera_rotation: CameraRotationParams,
    pairs: Pairs,
    drift: float,
    i: int,
    k: int,
) -> wp.vec2:
    """Return the compensated position for a camera without distortion, and pixels that are not slow."""
    w = drifted_state(model, pairs, drift, k, i)
    u, v = displace(model, camera, float(pairs.x[i]), float(pairs.y[i]), w[0], w[1])
    xy = undo_camera_rotation(
        camera, wp.vec2(u, v), camera_rotation, pairs.time[k * pairs.stride + i]
    )
    return without_path(pairs, k, i, xy)


@wp.func
def lag_of(pairs: Pairs, k: int, i: int) -> wp.vec2:
    """Return rotation and contraction of the orbit at the first (k = 0) or second event, as a complex factor."""
    return wp.vec2(pairs.lag[2 * k * pairs.stride + i], pairs.lag[(2 * k + 1) * pairs.stride + i])


@wp.func
def contracted_position(
    model: Any, camera: CameraParams, pixel: wp.vec2, w0: float, w1: float, lag: wp.vec2
) -> wp.vec2:
    """Return the compensated position [px] on an orbit that is rotated and contracted about its centre by ``lag``."""
    size = wp.length(lag)
    azimuth = turned(w0, w1, lag[0] / size, lag[1] / size)
    there = compensate(model, camera, pixel, azimuth)
    opposite = compensate(model, camera, pixel, -azimuth)
    return 0.5 * (there + opposite) + 0.5 * size * (there - opposite)


@wp.kernel
def find_places(
    model: Any,
    camera: Any,
    pairs: Pairs,
    drift: float,
    camera_rotation: CameraRotationParams,
    start: int,
    places: wp.array(dtype=wp.vec4),
):
    """Compute the compensated positions [px] of both events of a pair."""
    i = start + wp.tid()
    a = compensated_position(model, camera, camera_rotation, pairs, drift, i, 0)
    b = compensated_position(model, camera, camera_rotation, pairs, drift, i, 1)
    places[i] = wp.vec4(a[0], a[1], b[0], b[1])


@wp.func
def store_geometry(g: Geometry, i: int, a: int, ax: float, ay: float, b: int, bx: float, by: float):
    """Store the map nodes and fractions of a pair's two events; both nodes are -1 if either is."""
    store_int(g.cell, i, wp.where(b < 0, -1, a))
    store_int(g.cell, g.stride + i, wp.where(a < 0, -1, b))
    store_float(g.part, i, ax)
    store_float(g.part, g.stride + i, ay)
    store_float(g.part, 2 * g.stride + i, bx)
    store_float(g.part, 3 * g.stride + i, by)


@wp.kernel
def place_pairs(
    model: Any,
    camera: CameraParams,
    pairs: Pairs,
    atlas: Atlas,
    drift: float,
    camera_rotation: CameraRotationParams,
    start: int,
    geometry: Geometry,
):
    """Compute the positions of both events of a pair on the brightness map."""
    i = start + wp.tid()
    a = compensated_position(model, camera, camera_rotation, pairs, drift, i, 0)
    b = compensated_position(model, camera, camera_rotation, pairs, drift, i, 1)
    tile = pairs.tile[i]
    cell_a, ax, ay = node_at(atlas, tile, a[0], a[1])
    cell_b, bx, by = node_at(atlas, tile, b[0], b[1])
    store_geometry(geometry, i, cell_a, ax, ay, cell_b, bx, by)


@wp.func
def event_node(model: Any, camera: PinholeParams, pairs: Pairs, atlas: Atlas, k: int, i: int):
    """Return map node and fractions of the first (k = 0) or second event of a pair.

    This function is for a camera without distortion and rotation, and without drift.
    """
    w0, w1 = event_state(model, pairs, k, i)
    u, v = displace(
        model, camera, float(load_uint16(pairs.x, i)), float(load_uint16(pairs.y, i)), w0, w1
    )
    cell, x, y = node_at(atlas, load_int(pairs.tile, i), u, v)
    return cell, x, y


@wp.kernel
def place_still(
    model: Any, camera: PinholeParams, pairs: Pairs, atlas: Atlas, start: int, geometry: Geometry
):
    """Compute the positions as :func:`place_pairs` does, without branches; see :func:`event_node`."""
    i = start + wp.tid()
    a, ax, ay = event_node(model, camera, pairs, atlas, 0, i)
    b, bx, by = event_node(model, camera, pairs, atlas, 1, i)
    store_geometry(geometry, i, a, ax, ay, b, bx, by)


@wp.func
def displace_block(
    model: Any,
    camera: PinholeParams,
    pairs: Pairs,
    k: int,
    first: int,
    drifts: int,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
):
    """Compute the compensated positions [px] of the first (k = 0) or second events of a block of pairs.

    If ``drifts`` is 1, ``x`` and ``y`` hold the states at these events before.
    """
    for j in range(BLOCK):
        i = first + j
        w0, w1 = event_state(model, pairs, k, i)
        w0 = wp.where(drifts == 1, load_float(x, j), w0)
        w1 = wp.where(drifts == 1, load_float(y, j), w1)
        u, v = displace(
            model, camera, float(load_uint16(pairs.x, i)), float(load_uint16(pairs.y, i)), w0, w1
        )
        store_float(x, j, u)
        store_float(y, j, v)


@wp.func
def drift_block(
    model: Any,
    pairs: Pairs,
    drift: float,
    k: int,
    first: int,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
):
    """Compute the states at the first (k = 0) or second events of a block of pairs, at the given drift."""
    for j in range(BLOCK):
        w = drifted_state(model, pairs, drift, k, first + j)
        x[j] = w[0]
        y[j] = w[1]


@wp.func
def undo_rotations(
    camera: PinholeParams,
    camera_rotation: CameraRotationParams,
    pairs: Pairs,
    k: int,
    first: int,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
):
    """Move the positions of a block of pairs to where they are at time 0."""
    for j in range(BLOCK):
        at = undo_camera_rotation(
            camera, wp.vec2(x[j], y[j]), camera_rotation, pairs.time[k * pairs.stride + first + j]
        )
        at = without_path(pairs, k, first + j, at)
        x[j] = at[0]
        y[j] = at[1]


@wp.func
def compensate_block(
    model: Any,
    camera: PinholeParams,
    pairs: Pairs,
    drift: float,
    camera_rotation: CameraRotationParams,
    k: int,
    first: int,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
):
    """Compute the compensated positions [px] of the first (k = 0) or second events of a block of pairs."""
    drifts = wp.min(pairs.slope.shape[0], 1)
    if drifts == 1:
        drift_block(model, pairs, drift, k, first, x, y)
    if is_plain(model) == 1:
        displace_block(plain(model), camera, pairs, k, first, drifts, x, y)
    elif is_even(model) == 1:
        displace_block(even(model), camera, pairs, k, first, drifts, x, y)
    else:
        displace_block(model, camera, pairs, k, first, drifts, x, y)
    moves = wp.length_sq(camera_rotation.velocity) + wp.length_sq(camera_rotation.acceleration)
    moves = (
        moves
        + camera_rotation.growth * camera_rotation.growth
        + float(camera_rotation.path.shape[0])
    )
    if moves > 0.0:
        undo_rotations(camera, camera_rotation, pairs, k, first, x, y)


@wp.func
def load_origins(
    atlas: Atlas, pairs: Pairs, first: int, left: wp.array(dtype=float), top: wp.array(dtype=float)
):
    """Load the origins of the tiles of a block of pairs.

    A compiler does not vectorise a loop that loads from places which it finds in the loop, and stores results.
    """
    for j in range(BLOCK):
        tile = load_int(pairs.tile, first + j)
        store_float(left, j, load_float(atlas.origin, 2 * tile))
        store_float(top, j, load_float(atlas.origin, 2 * tile + 1))


@wp.func
def find_nodes(
    atlas: Atlas,
    pairs: Pairs,
    first: int,
    left: wp.array(dtype=float),
    top: wp.array(dtype=float),
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    cells: wp.array(dtype=int),
):
    """Replace the positions of a block by the fractions between map nodes, and compute the nodes.

    ``left`` and ``top`` are the origins of the tiles, see :func:`load_origins`.
    """
    for j in range(BLOCK):
        cell, u, v = node_from(
            atlas,
            load_int(pairs.tile, first + j),
            load_float(left, j),
            load_float(top, j),
            load_float(x, j),
            load_float(y, j),
        )
        store_int(cells, j, cell)
        store_float(x, j, u)
        store_float(y, j, v)


@wp.func
def find_block_nodes(
    atlas: Atlas,
    pairs: Pairs,
    first: int,
    ax: wp.array(dtype=float),
    ay: wp.array(dtype=float),
    bx: wp.array(dtype=float),
    by: wp.array(dtype=float),
    a: wp.array(dtype=int),
    b: wp.array(dtype=int),
):
    """Compute the map nodes of a block of pairs, given their positions, which the fractions replace."""
    left = wp.zeros(shape=(64,), dtype=float)
    top = wp.zeros(shape=(64,), dtype=float)
    load_origins(atlas, pairs, first, left, top)
    find_nodes(atlas, pairs, first, left, top, ax, ay, a)
    find_nodes(atlas, pairs, first, left, top, bx, by, b)


@wp.func
def store_block(
    geometry: Geometry,
    first: int,
    ax: wp.array(dtype=float),
    ay: wp.array(dtype=float),
    bx: wp.array(dtype=float),
    by: wp.array(dtype=float),
    a: wp.array(dtype=int),
    b: wp.array(dtype=int),
):
    """Store the map nodes and fractions of a block of pairs."""
    for j in range(BLOCK):
        u, v = load_float(ax, j), load_float(ay, j)
        store_geometry(
            geometry,
            first + j,
            load_int(a, j),
            u,
            v,
            load_int(b, j),
            load_float(bx, j),
            load_float(by, j),
        )


@wp.func
def store_changes(
    atlas: Atlas,
    image: wp.array(dtype=float),
    first: int,
    ax: wp.array(dtype=float),
    ay: wp.array(dtype=float),
    bx: wp.array(dtype=float),
    by: wp.array(dtype=float),
    a: wp.array(dtype=int),
    b: wp.array(dtype=int),
    change: wp.array(dtype=float),
):
    """Store how much the brightness changes from the first to the second event of each pair; NaN off the map."""
    before = wp.zeros(shape=(80,), dtype=float)
    after = wp.zeros(shape=(80,), dtype=float)
    on_map = wp.zeros(shape=(64,), dtype=int)
    for j in range(BLOCK):
        store_int(on_map, j, wp.where(wp.min(load_int(a, j), load_int(b, j)) >= 0, 1, 0))
        store_int(a, j, wp.max(load_int(a, j), 0))
        store_int(b, j, wp.max(load_int(b, j), 0))
    interpolate(before, image, atlas.columns, a, ax, ay, 0, BLOCK)
    interpolate(after, image, atlas.columns, b, bx, by, 0, BLOCK)
    for j in range(BLOCK):
        value = load_float(after, 16 + j) - load_float(before, 16 + j)
        store_float(change, first + j, wp.where(load_int(on_map, j) == 1, value, NAN))


@wp.kernel
def place_blocks(
    model: Any,
    camera: PinholeParams,
    pairs: Pairs,
    atlas: Atlas,
    drift: float,
    camera_rotation: CameraRotationParams,
    image: wp.array(dtype=float),
    start: int,
    geometry: Geometry,
    change: wp.array(dtype=float),
):
    """Compute the positions as :func:`place_pairs` does, one block of pairs per thread. For CPUs.

    This kernel is for a camera without distortion, and for pixels that are not slow. With an ``image``, it computes the
    change of brightness from the first to the second events instead, for finite differences.
    """
    first = (start + wp.tid()) * BLOCK
    ax = wp.zeros(shape=(64,), dtype=float)
    ay = wp.zeros(shape=(64,), dtype=float)
    bx = wp.zeros(shape=(64,), dtype=float)
    by = wp.zeros(shape=(64,), dtype=float)
    a = wp.zeros(shape=(64,), dtype=int)
    b = wp.zeros(shape=(64,), dtype=int)
    compensate_block(model, camera, pairs, drift, camera_rotation, 0, first, ax, ay)
    compensate_block(model, camera, pairs, drift, camera_rotation, 1, first, bx, by)
    find_block_nodes(atlas, pairs, first, ax, ay, bx, by, a, b)
    if image.shape[0] > 0:
        store_changes(atlas, image, first, ax, ay, bx, by, a, b, change)
    else:
        store_block(geometry, first, ax, ay, bx, by, a, b)
