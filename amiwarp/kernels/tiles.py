"""Voting the same events again and again on CUDA: sorted by image tile once, voted in shared memory, flushed.

A block of threads takes a chunk of one tile's events and a few candidates (parameters) at a time: every event is read
once for all of them. Votes that leave the window around the tile go to the image at once. Used by :mod:`amiwarp.tiles`.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, TurningParams, turn_back
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


@wp.func
def azimuth_of(model: Any, events: TileEvents, i: int, packed: wp.uint32, drift: float):
    turn = int(packed >> wp.uint32(16))
    if events.slope.shape[0] > 0:
        turn = (turn + int(wp.floor(drift * events.slope[i] + 0.5))) & 65535
    c = events.azimuths[2 * turn]
    s = events.azimuths[2 * turn + 1]
    return c * model.phase_cos - s * model.phase_sin, s * model.phase_cos + c * model.phase_sin


@wp.func
def canvas_place(
    model: Any,
    camera: CameraParams,
    events: TileEvents,
    canvas: Canvas,
    i: int,
    packed: wp.uint32,
    chunk: Chunk,
    motion: Motion,
    k: int,
):
    """Where an event falls on the canvas, without its ring, under candidate ``k``."""
    x = float(chunk.x + int(packed & wp.uint32(31)))
    y = float(chunk.y + int((packed >> wp.uint32(5)) & wp.uint32(31)))
    w0, w1 = azimuth_of(model, events, i, packed, motion.drift[k])
    u, v = place(model, camera, x, y, w0, w1)
    if events.time.shape[0] > 0:
        xy = turn_back(camera, wp.vec2(u, v), motion.turning[k], events.time[i])
        u = xy[0]
        v = xy[1]
    if canvas.dither != 0.0:
        dx, dy = somewhere(i)
        u += dx
        v += dy
    return (u + canvas.pad + 0.5) * canvas.scale - 0.5, (v + canvas.pad + 0.5) * canvas.scale - 0.5


@wp.func
def add_outside(
    canvas: Canvas, stride: int, image: wp.array(dtype=wp.int64), base: int, row: int, col: int, votes: int
):
    if row >= 0 and col >= 0 and row < canvas.rows - 2 and col < canvas.columns - 2 and votes != 0:
        wp.atomic_add(image, base + row * stride + col, wp.int64(votes))


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
def cast(
    canvas: Canvas,
    stride: int,
    image: wp.array(dtype=wp.int64),
    base: int,
    corner: int,
    row: int,
    col: int,
    r: int,
    c: int,
    votes: int,
):
    """Into the window, at row ``r`` and column ``c``, or past it into the image."""
    if r >= 0 and c >= 0 and r < WINDOW and c < WINDOW:
        window(1, corner + r * WINDOW + c, votes)
    else:
        add_outside(canvas, stride, image, base, row, col, votes)


@wp.func
def cast_event(
    canvas: Canvas, stride: int, image: wp.array(dtype=wp.int64), base: int, k: int, chunk: Chunk, u: float, v: float
):
    corner = k * WINDOW * WINDOW
    if canvas.nearest != 0:
        u = wp.floor(u + 0.5)
        v = wp.floor(v + 0.5)
    col = int(wp.floor(u))
    row = int(wp.floor(v))
    r = row - chunk.row
    c = col - chunk.column
    if canvas.nearest != 0:
        cast(canvas, stride, image, base, corner, row, col, r, c, 256)
        return
    fx = int((u - float(col)) * 256.0 + 0.5)
    fy = int((v - float(row)) * 256.0 + 0.5)
    b = (fx * fy + 128) >> 8
    cast(canvas, stride, image, base, corner, row, col, r, c, 256 - fx - fy + b)
    cast(canvas, stride, image, base, corner, row, col + 1, r, c + 1, fx - b)
    cast(canvas, stride, image, base, corner, row + 1, col, r + 1, c, fy - b)
    cast(canvas, stride, image, base, corner, row + 1, col + 1, r + 1, c + 1, b)


@wp.kernel
def vote_tiles(
    models: wp.array(dtype=Any),
    camera: CameraParams,
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
    base = layout.first + chunk.layer * layout.layer
    for i in range(thread, candidates * WINDOW * WINDOW, THREADS):
        window(0, i, 0)
    wait_for_block()
    for i in range(chunk.start + thread, chunk.stop, THREADS):
        packed = events.packed[i]
        for k in range(candidates):
            u, v = canvas_place(models[first + k], camera, events, canvas, i, packed, chunk, motion, first + k)
            if u > -1.0e6 and u < 1.0e6 and v > -1.0e6 and v < 1.0e6:
                cast_event(canvas, layout.stride, images[first + k], base, k, chunk, u, v)
    wait_for_block()
    for i in range(thread, candidates * WINDOW * WINDOW, THREADS):
        at = i % (WINDOW * WINDOW)
        image = images[first + i / (WINDOW * WINDOW)]
        votes = window(2, i, 0)
        add_outside(canvas, layout.stride, image, base, chunk.row + at / WINDOW, chunk.column + at % WINDOW, votes)


for _struct in (CircleParams, RadialCircleParams, ExactParams):
    wp.overload(vote_tiles, {"models": wp.array(dtype=_struct)})


@wp.kernel
def read_tiles(votes: wp.array(dtype=wp.int64), start: int, image: wp.array(dtype=float)):
    i = start + wp.tid()
    image[i] = float(wp.float64(votes[i]) / wp.float64(256.0))
