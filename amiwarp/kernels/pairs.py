"""Event pairs: from events to the pairs that form the equations of :mod:`amiwarp.brightness.solver`.

Events are sorted by pixel, in the order of :func:`place_of`, and by time within a pixel. Every event is a candidate for
up to three pairs; every pixel is a candidate for one pair in each time span without events. Candidates are marked,
counted and written.
"""

import warp as wp

from amiwarp.kernels.background_activity import hot_threshold
from amiwarp.kernels.equations import EARLY, HELD, ON, QUIET, Pairs
from amiwarp.kernels.prism_angle import EncoderParams, of_second, piece_at, radians

wp.set_module_options({"enable_backward": False})

SQUARE = wp.constant(32)  # side of the squares of pixels in whose order events are sorted [px]


@wp.struct
class Sorted:
    """Events of the sensor, and their order by time span and pixel.

    ``key`` is span · places + place of the pixel; ``order`` is the index of the event.
    """

    count: int
    pixels: int
    places: int  # number of places of :func:`place_of`
    columns: int
    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    t: wp.array(dtype=wp.int64)
    p: wp.array(dtype=wp.uint8)
    key: wp.array(dtype=int)
    order: wp.array(dtype=int)


@wp.struct
class Window:
    """Times of the window, and delays of the sensor."""

    start: wp.int64  # start of the time window [us]
    stop: wp.int64  # end of the time window [us]
    middle: wp.int64  # middle of the time window [us]
    late_first: wp.float64  # correction added to the time of the first event [us]
    late_second: wp.float64  # correction added to the time of the second event [us]
    longest: wp.int64  # longest gap between the two events of a pair [us]
    shortest: wp.float64  # length that the gap between the two events must exceed [us]


@wp.func
def place_of(row: int, column: int, columns: int) -> int:
    """Return the place of a pixel in the order of squares of pixels: row by row, and row by row in each square.

    Successive pixels then have orbits over the same few nodes of a map, which stay in a core's fastest cache.
    """
    square = (row / SQUARE) * ((columns + SQUARE - 1) / SQUARE) + column / SQUARE
    return (square * SQUARE + row % SQUARE) * SQUARE + column % SQUARE


@wp.func
def pixel_at(place: int, columns: int):
    """Return row and column of the pixel at a place; see :func:`place_of`. It may be outside the image."""
    across = (columns + SQUARE - 1) / SQUARE
    square = place / (SQUARE * SQUARE)
    row = (square / across) * SQUARE + (place / SQUARE) % SQUARE
    column = (square % across) * SQUARE + place % SQUARE
    return row, column


@wp.kernel
def mark_inside(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    tile_of: wp.array2d(dtype=int),
    start: int,
    flag: wp.array(dtype=int),
):
    """Mark the events of pixels that belong to a tile."""
    i = start + wp.tid()
    flag[i] = wp.where(tile_of[int(y[i]), int(x[i])] >= 0, 1, 0)


@wp.kernel
def fill_keys(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    tile_of: wp.array2d(dtype=int),
    place: wp.array(dtype=int),
    first: wp.array(dtype=int),
    places: int,
    start: int,
    key: wp.array(dtype=int),
    order: wp.array(dtype=int),
):
    """Write the keys of the marked events contiguously.

    ``first`` is the index of the first event of each span. ``places`` is the number of places of :func:`place_of`.
    """
    i = start + wp.tid()
    row = int(y[i])
    column = int(x[i])
    if tile_of[row, column] < 0:
        return
    span = int(0)
    while span + 1 < first.shape[0] and first[span + 1] <= i:
        span += 1
    at = place[i] - 1
    key[at] = span * places + place_of(row, column, tile_of.shape[1])
    order[at] = i


@wp.kernel
def mark_pairs(s: Sorted, window: Window, start: int, flag: wp.array(dtype=int)):
    """Mark pairs of consecutive events of one pixel."""
    i = start + wp.tid()
    flag[i] = 0
    if i + 1 < s.count and s.key[i + 1] == s.key[i]:
        gap = s.t[s.order[i + 1]] - s.t[s.order[i]]
        if gap <= window.longest and wp.float64(gap) > window.shortest:
            flag[i] = 1


@wp.kernel
def mark_ends(s: Sorted, start: int, flag: wp.array(dtype=int)):
    """Mark the first and the last event of each pixel as candidates for pairs.

    The flags follow the flags of :func:`mark_pairs`: ``count`` flags for first events, then ``count`` for last events.
    """
    i = start + wp.tid()
    flag[s.count + i] = wp.where(i == 0 or s.key[wp.max(i - 1, 0)] != s.key[i], 1, 0)
    flag[2 * s.count + i] = wp.where(
        i == s.count - 1 or s.key[wp.min(i + 1, s.count - 1)] != s.key[i], 1, 0
    )


@wp.kernel
def mark_spans(
    s: Sorted, edges: wp.array(dtype=wp.int64), start: int, fired: wp.array(dtype=wp.uint8)
):
    """Mark the pixels that fire in each time span between two successive ``edges`` [us]."""
    i = start + wp.tid()
    t = s.t[i]
    spans = edges.shape[0] - 1
    if t < edges[0] or t >= edges[spans]:
        return
    low = int(0)
    high = spans - 1
    while low < high:
        middle = (low + high + 1) / 2
        if edges[middle] <= t:
            low = middle
        else:
            high = middle - 1
    fired[low * s.pixels + int(s.y[i]) * s.columns + int(s.x[i])] = wp.uint8(1)


@wp.kernel
def mark_quiet(
    fired: wp.array(dtype=wp.uint8),
    tile_of: wp.array2d(dtype=int),
    at_least: int,
    base: int,
    start: int,
    flag: wp.array(dtype=int),
):
    """Mark the spans of each pixel that belong to at least ``at_least`` consecutive spans without an event."""
    place = start + wp.tid()
    row, column = pixel_at(place, tile_of.shape[1])
    inside = bool(False)
    if row < tile_of.shape[0] and column < tile_of.shape[1]:
        inside = tile_of[row, column] >= 0
    pixels = tile_of.shape[0] * tile_of.shape[1]
    spans = fired.shape[0] / pixels
    run = int(0)
    for k in range(spans + 1):
        quiet = int(0)
        if k < spans:
            flag[base + place * spans + k] = 0
            if inside:
                quiet = wp.where(
                    fired[k * pixels + row * tile_of.shape[1] + column] == wp.uint8(0), 1, 0
                )
        if quiet == 1:
            run += 1
        else:
            for j in range(k - wp.where(run >= at_least, run, 0), k):
                flag[base + place * spans + j] = 1
            run = 0


# -- writing


@wp.func
def angle_after(encoder: EncoderParams, t: wp.int64, late: wp.float64) -> float:
    """Return the prism angle [rad] ``late`` [us] after a time stamp, extrapolated on the encoder's piece there."""
    elapsed = t - encoder.origin
    piece = piece_at(encoder, elapsed)
    slope = encoder.slope[piece]
    angle = encoder.angle[piece] + wp.uint64(elapsed - encoder.start[piece]) * slope
    angle += wp.uint64(wp.int64(wp.float64(wp.int64(slope)) * late))
    return radians(wp.uint32(angle >> wp.uint64(32)))


@wp.func
def store_time(
    encoder: EncoderParams,
    window: Window,
    pairs: Pairs,
    k: int,
    i: int,
    t: wp.int64,
    late: wp.float64,
):
    """Store time and angle of an event, ``late`` [us] after its time stamp.

    The angle is cosine and sine of one prism's angle, or the angles of both prisms of a pair.
    """
    a = angle_after(encoder, t, late)
    b = float(0.0)
    if encoder.second_start.shape[0] > 0:
        b = angle_after(of_second(encoder), t, late)
    else:
        b = wp.sin(a)
        a = wp.cos(a)
    pairs.azimuth[2 * k * pairs.stride + i] = a
    pairs.azimuth[(2 * k + 1) * pairs.stride + i] = b
    pairs.time[k * pairs.stride + i] = float(wp.float64(t - window.middle) * wp.float64(1.0e-6))


@wp.func
def store_pair(
    encoder: EncoderParams, window: Window, pairs: Pairs, i: int, first: wp.int64, second: wp.int64
):
    """Store the times and angles of both events of a pair."""
    store_time(encoder, window, pairs, 0, i, first, window.late_first)
    store_time(encoder, window, pairs, 1, i, second, window.late_second)


@wp.kernel
def write_pairs(
    s: Sorted,
    window: Window,
    encoder: EncoderParams,
    tile_of: wp.array2d(dtype=int),
    flag: wp.array(dtype=int),
    place: wp.array(dtype=int),
    kinds: int,
    start: int,
    pairs: Pairs,
):
    """Write the marked pairs that include an event: those with the next event, and with ``kinds`` = 3 open ends."""
    at = start + wp.tid()
    event = s.order[at]
    row, column = pixel_at(s.key[at] % s.places, s.columns)
    for kind in range(kinds):
        candidate = kind * s.count + at
        if flag[candidate] == 0:
            continue
        i = place[candidate] - 1
        pairs.x[i] = wp.uint16(column)
        pairs.y[i] = wp.uint16(row)
        pairs.tile[i] = tile_of[row, column]
        if kind == 0:
            pairs.on[i] = s.p[s.order[at + 1]]
            store_pair(encoder, window, pairs, i, s.t[event], s.t[s.order[at + 1]])
        elif kind == 1:
            pairs.on[i] = s.p[event] | EARLY
            store_pair(encoder, window, pairs, i, window.start, s.t[event])
        else:
            pairs.on[i] = QUIET
            store_pair(encoder, window, pairs, i, s.t[event], window.stop)


@wp.kernel
def write_spans(
    edges: wp.array(dtype=wp.int64),
    window: Window,
    encoder: EncoderParams,
    start: int,
    pairs: Pairs,
):
    """Write times and angles of a pair from the beginning to the end of each time span between ``edges`` [us]."""
    span = start + wp.tid()
    store_pair(encoder, window, pairs, span, edges[span], edges[span + 1])


@wp.kernel
def write_quiet(
    spans: Pairs,
    tile_of: wp.array2d(dtype=int),
    base: int,
    flag: wp.array(dtype=int),
    place: wp.array(dtype=int),
    start: int,
    pairs: Pairs,
):
    """Write the marked pairs of spans without an event; ``spans`` come from :func:`write_spans`."""
    candidate = start + wp.tid()
    if flag[base + candidate] == 0:
        return
    span = candidate % spans.count
    row, column = pixel_at(candidate / spans.count, tile_of.shape[1])
    i = place[base + candidate] - 1
    pairs.x[i] = wp.uint16(column)
    pairs.y[i] = wp.uint16(row)
    pairs.tile[i] = tile_of[row, column]
    pairs.on[i] = QUIET
    for k in range(4):
        pairs.azimuth[k * pairs.stride + i] = spans.azimuth[k * spans.stride + span]
    for k in range(2):
        pairs.time[k * pairs.stride + i] = spans.time[k * spans.stride + span]


# -- selecting


@wp.func
def tile_at(tile_of: wp.array2d(dtype=int), x: float, y: float) -> int:
    """Return the tile of the pixel nearest to a position; -1 outside, and for NaN."""
    inside = (
        x >= -0.5
        and y >= -0.5
        and x < float(tile_of.shape[1]) - 0.5
        and y < float(tile_of.shape[0]) - 0.5
    )
    if not inside:
        return -1
    return tile_of[int(wp.floor(y + 0.5)), int(wp.floor(x + 0.5))]


@wp.kernel
def mark_same_tile(
    places: wp.array(dtype=wp.vec4),
    tile_of: wp.array2d(dtype=int),
    start: int,
    tile: wp.array(dtype=int),
    flag: wp.array(dtype=int),
):
    """Mark pairs whose events both fall on one tile, which becomes the tile of the pair."""
    i = start + wp.tid()
    a = tile_at(tile_of, places[i][0], places[i][1])
    b = tile_at(tile_of, places[i][2], places[i][3])
    tile[i] = a
    flag[i] = wp.where(a >= 0 and a == b, 1, 0)


@wp.kernel
def mark_listed(
    tile: wp.array(dtype=int), listed: wp.array(dtype=int), start: int, flag: wp.array(dtype=int)
):
    """Mark pairs whose tile is listed (1, else 0)."""
    i = start + wp.tid()
    flag[i] = listed[tile[i]]


@wp.kernel
def mark_square(
    pairs: Pairs, left: int, top: int, side: int, start: int, flag: wp.array(dtype=int)
):
    """Mark pairs of the pixels in a square of the sensor [px]."""
    i = start + wp.tid()
    x = int(pairs.x[i]) - left
    y = int(pairs.y[i]) - top
    flag[i] = wp.where(x >= 0 and y >= 0 and x < side and y < side, 1, 0)


@wp.func
def copy_pair(pairs: Pairs, i: int, out: Pairs, at: int):
    """Copy pair ``i`` to the place ``at``, with its slopes if it has some."""
    out.x[at] = pairs.x[i]
    out.y[at] = pairs.y[i]
    out.tile[at] = pairs.tile[i]
    out.on[at] = pairs.on[i]
    for k in range(4):
        out.azimuth[k * out.stride + at] = pairs.azimuth[k * pairs.stride + i]
    for k in range(2):
        out.time[k * out.stride + at] = pairs.time[k * pairs.stride + i]
        if pairs.slope.shape[0] > 0:
            out.slope[k * out.stride + at] = pairs.slope[k * pairs.stride + i]


@wp.kernel
def copy_marked(
    pairs: Pairs, flag: wp.array(dtype=int), place: wp.array(dtype=int), start: int, out: Pairs
):
    """Copy the marked pairs to contiguous arrays."""
    i = start + wp.tid()
    if flag[i] != 0:
        copy_pair(pairs, i, out, place[i] - 1)


@wp.kernel
def copy_all(pairs: Pairs, at: int, start: int, out: Pairs):
    """Copy all pairs to the places from ``at`` on."""
    i = start + wp.tid()
    copy_pair(pairs, i, out, at + i)


@wp.kernel
def hold_out(every: int, start: int, on: wp.array(dtype=wp.uint8)):
    """Mark every ``every``-th pair of two events as held out. These pairs come first in the arrays."""
    i = start + wp.tid()
    if i % every == 0 and on[i] <= ON:
        on[i] = on[i] | HELD


@wp.kernel
def keep_nodes(
    nodes: wp.array(dtype=wp.uint8),
    on: wp.array(dtype=wp.uint8),
    stride: int,
    start: int,
    cell: wp.array(dtype=int),
):
    """Leave out pairs of two events if either event lies off ``nodes``."""
    i = start + wp.tid()
    if cell[i] < 0 or on[i] > ON:
        return
    if nodes[cell[i]] == wp.uint8(0) or nodes[cell[stride + i]] == wp.uint8(0):
        cell[i] = -1
        cell[stride + i] = -1


@wp.kernel
def count_pixels(s: Sorted, start: int, count: wp.array(dtype=int)):
    """Count the events of each pixel."""
    i = start + wp.tid()
    wp.atomic_add(count, int(s.y[i]) * s.columns + int(s.x[i]), 1)


@wp.func
def mirrored(i: int, n: int) -> int:
    """Return the index ``i`` reflected about the centres of the outermost pixels of ``n``.

    On a sensor of one or two pixels, what is reflected beyond the other border becomes the border.
    """
    j = wp.abs(i)
    return wp.clamp(wp.where(j < n, j, 2 * n - 2 - j), 0, n - 1)


@wp.kernel
def mark_hot(count: wp.array2d(dtype=int), tile: int, start: int, tile_of: wp.array(dtype=int)):
    """Exclude hot pixels by setting their tile to -1; the other pixels get the tile ``tile``.

    A pixel is hot if it fires far more than at least 19 of the 25 pixels of the 5 x 5 around it: edges pass all of them
    during whole turns. :func:`amiwarp.kernels.background_activity.mark_hot_pixels` needs no turns, and spares corners.
    """
    i = start + wp.tid()
    rows = count.shape[0]
    columns = count.shape[1]
    busy = float(count[i / columns, i % columns])
    quieter = int(0)
    if busy > hot_threshold(0.0):
        for k in range(25):
            n = float(
                count[
                    mirrored(i / columns + k / 5 - 2, rows),
                    mirrored(i % columns + k % 5 - 2, columns),
                ]
            )
            if busy > hot_threshold(n):
                quieter += 1
    tile_of[i] = wp.where(quieter >= 19, -1, tile)
