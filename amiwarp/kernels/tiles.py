"""Voting the same events again and again on CUDA: sorted by image tile once, voted in shared memory, flushed.

A block of threads takes a chunk of one tile's events and a few candidates (parameters) at a time: every event is read
once for all of them. Votes that leave the window around the tile go to the image at once. Used by :mod:`amiwarp.tiles`.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, PinholeParams, TurningParams, turn_back
from amiwarp.kernels.optics import CircleParams, ExactParams, RadialCircleParams, place
from amiwarp.kernels.votes import Canvas, somewhere

# the sums need not be those of a CPU bit for bit here: square roots and divisions may be the GPU's quick ones
wp.set_module_options({"enable_backward": False, "fast_math": True})

TILE = 32  # sensor pixels
WINDOW = wp.constant(62)  # canvas pixels
THREADS = wp.constant(512)
AT_ONCE = wp.constant(3)  # candidates that share the reading of an event: their windows fill the 48 KiB there are
CHUNK = 1 << 16  # events: 2**24 of 1/256 votes at most, so that no word of the window overflows


@wp.struct
class Chunk:
    """A run of one tile's events, of one polarity where these have images of their own."""

    start: int
    stop: int
    x: int  # the tile's first pixel on the sensor
    y: int
    column: int  # the window's first pixel on the canvas
    row: int
    layer: int


@wp.struct
class TileEvents:
    """Events by tile. ``packed``: angle [1/65536 turn], 1 bit free, y and x in the tile of 5 bits each."""

    packed: wp.array(dtype=wp.uint32)
    azimuths: wp.array(dtype=float)
    slope: wp.array(dtype=float)  # change of the angle [1/65536 turn] per unit of drift, or empty
    time: wp.array(dtype=float)  # from the window's middle [s], or empty
    chunks: wp.array(dtype=Chunk)


@wp.struct
class Motion:
    """What candidates have besides the model, one each."""

    drift: wp.array(dtype=float)
    turning: wp.array(dtype=TurningParams)


@wp.struct
class Layout:
    """Of the images, as of :class:`amiwarp.kernels.iwe.Frame`."""

    stride: int
    layer: int
    first: int
    shift: float  # what a place on the sensor, scaled, is moved by to be one on the canvas


@wp.func
def tile_key(x: int, y: int, layer: int, across: int, tiles: int, size: int) -> int:
    return layer * tiles + (y / size) * across + x / size


@wp.kernel
def key_events(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    layer: wp.array(dtype=wp.uint8),
    layers: int,
    across: int,
    tiles: int,
    size: int,
    keys: wp.array(dtype=int),
    order: wp.array(dtype=int),
    counts: wp.array(dtype=int),
):
    i = wp.tid()
    key = tile_key(int(x[i]), int(y[i]), wp.min(int(layer[i]), layers - 1), across, tiles, size)
    keys[i] = key
    order[i] = i
    wp.atomic_add(counts, key, 1)


@wp.kernel
def pack_events(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    turn: wp.array(dtype=wp.uint16),
    slope: wp.array(dtype=float),
    time: wp.array(dtype=float),
    order: wp.array(dtype=int),
    size: int,
    out: TileEvents,
):
    i = wp.tid()
    k = order[i]
    place_in_tile = (int(y[k]) % size) * 32 + int(x[k]) % size
    out.packed[i] = (wp.uint32(turn[k]) << wp.uint32(16)) | wp.uint32(place_in_tile)
    if slope.shape[0] > 0:
        out.slope[i] = slope[k]
    if time.shape[0] > 0:
        out.time[i] = time[k]


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_block(): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int words[3 * 62 * 62];
    if (what == 0) words[at] = 0;
    else if (what == 1) atomicAdd(&words[at], votes);
    else return words[at];
#endif
    return 0;
""")
def window(what: int, at: int, votes: int) -> int:
    """The block's shared memory: sets to zero (0), adds (1), reads (2)."""


@wp.func
def turned_back(camera: PinholeParams, xy: wp.vec2, turning: TurningParams, time: wp.array(dtype=float), i: int):
    return xy  # the camera that turns comes as CameraParams


@wp.func
def turned_back(camera: CameraParams, xy: wp.vec2, turning: TurningParams, time: wp.array(dtype=float), i: int):
    if time.shape[0] == 0:
        return xy
    return turn_back(camera, xy, turning, time[i])


@wp.func
def add_outside(layout: Layout, canvas: Canvas, chunk: Chunk, image: wp.array(dtype=wp.int64), r: int, c: int, v: int):
    """Votes for row ``r`` and column ``c``, counted from the window's corner, to the image."""
    row = chunk.row + r
    col = chunk.column + c
    if row >= 0 and col >= 0 and row < canvas.rows - 2 and col < canvas.columns - 2 and v != 0:
        wp.atomic_add(image, layout.first + chunk.layer * layout.layer + row * layout.stride + col, wp.int64(v))


@wp.func
def cast_outside(
    layout: Layout, canvas: Canvas, chunk: Chunk, image: wp.array(dtype=wp.int64), u: float, v: float, nearest: int
):
    """A vote that does not lie in the window alone; NaN, and what is far off, votes nowhere."""
    if not (wp.abs(u) < 1.0e6 and wp.abs(v) < 1.0e6):
        return
    r = int(wp.floor(v))
    c = int(wp.floor(u))
    fx = wp.where(nearest != 0, 0, int((u - float(c)) * 256.0 + 0.5))
    fy = wp.where(nearest != 0, 0, int((v - float(r)) * 256.0 + 0.5))
    b = (fx * fy + 128) >> 8
    add_outside(layout, canvas, chunk, image, r, c, 256 - fx - fy + b)
    add_outside(layout, canvas, chunk, image, r, c + 1, fx - b)
    add_outside(layout, canvas, chunk, image, r + 1, c, fy - b)
    add_outside(layout, canvas, chunk, image, r + 1, c + 1, b)


@wp.func
def cast_nearest(
    layout: Layout, canvas: Canvas, chunk: Chunk, image: wp.array(dtype=wp.int64), corner: int, u: float, v: float
):
    u += 0.5
    v += 0.5
    if u >= 0.0 and v >= 0.0 and u < float(WINDOW) and v < float(WINDOW):
        window(1, corner + int(v) * WINDOW + int(u), 256)
    else:
        cast_outside(layout, canvas, chunk, image, u, v, 1)


@wp.func
def cast_bilinear(
    layout: Layout, canvas: Canvas, chunk: Chunk, image: wp.array(dtype=wp.int64), corner: int, u: float, v: float
):
    if u >= 0.0 and v >= 0.0 and u < float(WINDOW - 1) and v < float(WINDOW - 1):
        c = int(u)
        r = int(v)
        fx = int((u - float(c)) * 256.0 + 0.5)
        fy = int((v - float(r)) * 256.0 + 0.5)
        b = (fx * fy + 128) >> 8
        at = corner + r * WINDOW + c
        window(1, at, 256 - fx - fy + b)
        window(1, at + 1, fx - b)
        window(1, at + WINDOW, fy - b)
        window(1, at + WINDOW + 1, b)
    else:
        cast_outside(layout, canvas, chunk, image, u, v, 0)


@wp.func
def cast_event(
    model: Any,
    camera: Any,
    events: TileEvents,
    motion: Motion,
    layout: Layout,
    canvas: Canvas,
    chunk: Chunk,
    images: wp.array2d(dtype=wp.int64),
    first: int,
    k: int,
    i: int,
    turn: int,
    x: float,
    y: float,
):
    """The vote of event ``i`` under candidate ``k`` of those from ``first``."""
    if events.slope.shape[0] > 0:
        turn = (turn + int(wp.floor(motion.drift[first + k] * events.slope[i] + 0.5))) & 65535
    c = events.azimuths[2 * turn]
    s = events.azimuths[2 * turn + 1]
    w0 = c * model.phase_cos - s * model.phase_sin
    px, py = place(model, camera, x, y, w0, s * model.phase_cos + c * model.phase_sin)
    xy = turned_back(camera, wp.vec2(px, py), motion.turning[first + k], events.time, i)
    dx, dy = somewhere(i)
    u = (xy[0] + canvas.dither * dx) * canvas.scale + layout.shift - float(chunk.column)
    v = (xy[1] + canvas.dither * dy) * canvas.scale + layout.shift - float(chunk.row)
    if canvas.nearest != 0:
        cast_nearest(layout, canvas, chunk, images[first + k], k * WINDOW * WINDOW, u, v)
    else:
        cast_bilinear(layout, canvas, chunk, images[first + k], k * WINDOW * WINDOW, u, v)


@wp.kernel
def vote_tiles(
    models: wp.array(dtype=Any),
    camera: Any,
    events: TileEvents,
    motion: Motion,
    canvas: Canvas,
    layout: Layout,
    images: wp.array2d(dtype=wp.int64),
):
    block, thread = wp.tid()
    chunk = events.chunks[block % events.chunks.shape[0]]
    first = (block / events.chunks.shape[0]) * AT_ONCE
    candidates = wp.min(AT_ONCE, images.shape[0] - first)
    a = models[first]
    b = models[first + wp.min(1, candidates - 1)]
    c = models[first + candidates - 1]
    for i in range(thread, candidates * WINDOW * WINDOW, THREADS):
        window(0, i, 0)
    wait_for_block()
    for i in range(chunk.start + thread, chunk.stop, THREADS):
        packed = int(events.packed[i])
        turn = (packed >> 16) & 65535
        x = float(chunk.x + (packed & 31))
        y = float(chunk.y + ((packed >> 5) & 31))
        cast_event(a, camera, events, motion, layout, canvas, chunk, images, first, 0, i, turn, x, y)
        if candidates > 1:
            cast_event(b, camera, events, motion, layout, canvas, chunk, images, first, 1, i, turn, x, y)
        if candidates > 2:
            cast_event(c, camera, events, motion, layout, canvas, chunk, images, first, 2, i, turn, x, y)
    wait_for_block()
    for i in range(thread, candidates * WINDOW * WINDOW, THREADS):
        at = i % (WINDOW * WINDOW)
        image = images[first + i / (WINDOW * WINDOW)]
        add_outside(layout, canvas, chunk, image, at / WINDOW, at % WINDOW, window(2, i, 0))


for _struct in (CircleParams, RadialCircleParams, ExactParams):
    for _camera in (PinholeParams, CameraParams):
        wp.overload(vote_tiles, {"models": wp.array(dtype=_struct), "camera": _camera})


@wp.kernel
def read_tiles(votes: wp.array(dtype=wp.int64), start: int, image: wp.array(dtype=float)):
    i = start + wp.tid()
    image[i] = float(wp.float64(votes[i]) / wp.float64(256.0))
