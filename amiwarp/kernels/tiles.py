"""Voting the same events again and again on CUDA: sorted by image tile once, voted in shared memory, flushed.

A block of threads takes a chunk of one tile's events and a few candidates (parameters) at a time: every event is read
once for all of them. Votes that leave the window around the tile go to the image at once.
Used by :mod:`amiwarp.imaging.tile_votes`.
"""

import math
from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, CameraRotationParams, PinholeParams, turn_back
from amiwarp.kernels.native import load_uint32
from amiwarp.kernels.optics import CircleParams, ExactParams, RadialCircleParams, place
from amiwarp.kernels.votes import Canvas, somewhere

# the sums need not be those of a CPU bit for bit here: square roots and divisions may be the GPU's quick ones
wp.set_module_options({"enable_backward": False, "fast_math": True})

TILE = 32  # sensor pixels
COLUMNS = wp.constant(61)  # of a window [canvas px]; odd, so that one column spreads over all banks of the memory
ROWS = wp.constant(64)
SIZE = wp.constant(4 * 61 * 64)  # of a window [bytes]
THREADS = wp.constant(256)
BLOCKS = 4  # of a multiprocessor at once
AT_ONCE = wp.constant(3)  # candidates that share the reading of an event: their windows fill the 48 KiB there are
TURN = wp.constant(2.0 * math.pi / 65536.0)
CHUNK = 1 << 17  # points: 63 * 2**25 of 1/256 votes at most, so that no word of the window overflows


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
    """Events by tile. ``packed``: angle [1/65536 turn], weight less one in 6 bits, y and x in the tile in 5 each."""

    packed: wp.array(dtype=wp.uint32)
    slope: wp.array(dtype=float)  # change of the angle [1/65536 turn] per unit of drift, or empty
    time: wp.array(dtype=float)  # from the window's middle [s], or empty
    chunks: wp.array(dtype=Chunk)


@wp.struct
class Event:
    """One of them, unpacked."""

    x: float  # on the sensor
    y: float
    corner_x: float  # what a place on the sensor, scaled, is moved by to be one in the window: its own for each event,
    corner_y: float  # where these lie somewhere in their pixels
    scale: float
    turn: int
    weight: int


@wp.struct
class Still:
    """Candidates that have nothing besides their model."""

    nothing: int


@wp.struct
class Motion:
    """What candidates have besides the model, one each."""

    drift: wp.array(dtype=float)
    camera_rotation: wp.array(dtype=CameraRotationParams)


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
    weight: wp.array(dtype=wp.uint8),
    order: wp.array(dtype=int),
    size: int,
    out: TileEvents,
):
    i = wp.tid()
    k = order[i]
    place_in_tile = (int(y[k]) % size) * 32 + int(x[k]) % size
    if weight.shape[0] > 0:
        place_in_tile += (int(weight[k]) - 1) * 1024
    out.packed[i] = (wp.uint32(turn[k]) << wp.uint32(16)) | wp.uint32(place_in_tile)
    if slope.shape[0] > 0:
        out.slope[i] = slope[k]
    if time.shape[0] > 0:
        out.time[i] = time[k]


# The block's shared memory goes by its address: looked up once, where an array's name would be at every vote.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int words[3 * 61 * 64];
    unsigned address = (unsigned)__cvta_generic_to_shared(words);
    asm volatile("" : "+r"(address));  // or the compiler would look it up again and again
    return (int)address;
#endif
    return 0;
""")
def window() -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("bar.sync 0;" ::: "memory");
#endif
""")
def wait_for_block(): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("st.shared.u32 [%0], %1;" :: "r"(address), "r"(value) : "memory");
#endif
""")
def set_word(address: int, value: int): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("red.shared.add.u32 [%0], %1;" :: "r"(address), "r"(value));
#endif
""")
def add_to_word(address: int, value: int): ...


@wp.func_native("""
    int value = 0;
#if defined(__CUDA_ARCH__)
    asm volatile("ld.shared.u32 %0, [%1];" : "=r"(value) : "r"(address) : "memory");
#endif
    return value;
""")
def get_word(address: int) -> int: ...


@wp.func
def drifted(motion: Still, events: TileEvents, candidate: int, i: int, turn: int):
    return turn


@wp.func
def drifted(motion: Motion, events: TileEvents, candidate: int, i: int, turn: int):
    if events.slope.shape[0] == 0:
        return turn
    return turn + int(wp.floor(motion.drift[candidate] * events.slope[i] + 0.5))


@wp.func
def turned_back(motion: Still, camera: Any, x: float, y: float, events: TileEvents, candidate: int, i: int):
    return x, y


@wp.func
def turned_back(motion: Motion, camera: CameraParams, x: float, y: float, events: TileEvents, candidate: int, i: int):
    if events.time.shape[0] == 0:
        return x, y
    xy = turn_back(camera, wp.vec2(x, y), motion.camera_rotation[candidate], events.time[i])
    return xy[0], xy[1]


@wp.func
def place_event(model: Any, camera: Any, motion: Any, events: TileEvents, candidate: int, i: int, event: Event):
    """Where an event belongs under a candidate, from the window's corner."""
    angle = float(drifted(motion, events, candidate, i, event.turn)) * TURN
    c = wp.cos(angle)
    s = wp.sin(angle)
    w0 = c * model.phase_cos - s * model.phase_sin
    x, y = place(model, camera, event.x, event.y, w0, s * model.phase_cos + c * model.phase_sin)
    x, y = turned_back(motion, camera, x, y, events, candidate, i)
    return x * event.scale + event.corner_x, y * event.scale + event.corner_y


@wp.func
def add_outside(layout: Layout, canvas: Canvas, chunk: Chunk, image: wp.array(dtype=wp.int64), r: int, c: int, v: int):
    """Votes for row ``r`` and column ``c``, counted from the window's corner, to the image."""
    row = chunk.row + r
    col = chunk.column + c
    if row >= 0 and col >= 0 and row < canvas.rows - 2 and col < canvas.columns - 2 and v != 0:
        wp.atomic_add(image, layout.first + chunk.layer * layout.layer + row * layout.stride + col, wp.int64(v))


@wp.func
def cast_outside(
    layout: Layout, canvas: Canvas, chunk: Chunk, image: wp.array(dtype=wp.int64), u: float, v: float, weight: int
):
    """A vote that does not lie in the window alone, [px] from its corner; NaN, and what is far off, votes nowhere."""
    if not (wp.abs(u) < 16000.0 and wp.abs(v) < 16000.0):
        return
    fine = wp.where(canvas.nearest != 0, 1.0, 256.0)
    x = to_int(u * fine) << wp.where(canvas.nearest != 0, 8, 0)
    y = to_int(v * fine) << wp.where(canvas.nearest != 0, 8, 0)
    b = ((x & 255) * (y & 255) + 128) >> 8
    add_outside(layout, canvas, chunk, image, y >> 8, x >> 8, weight * (256 - (x & 255) - (y & 255) + b))
    add_outside(layout, canvas, chunk, image, y >> 8, (x >> 8) + 1, weight * ((x & 255) - b))
    add_outside(layout, canvas, chunk, image, (y >> 8) + 1, x >> 8, weight * ((y & 255) - b))
    add_outside(layout, canvas, chunk, image, (y >> 8) + 1, (x >> 8) + 1, weight * b)


@wp.func
def to_int(value: float) -> int:
    """The nearest integer, of less than 2**22: an addition, where a conversion takes a GPU four times as long."""
    return wp.cast(value + 12582912.0, int) - 0x4B400000


@wp.func
def cast_nearest(window: int, weight: int, u: float, v: float) -> int:
    """Votes in the window at that address; 1 where the vote does not lie there."""
    c = to_int(u)
    r = to_int(v)
    inside = wp.uint32(c) < wp.uint32(COLUMNS) and wp.uint32(r) < wp.uint32(ROWS)
    # no branch: elsewhere nothing is added to the first word
    add_to_word(window + wp.where(inside, 4 * (r * COLUMNS + c), 0), wp.where(inside, weight << 8, 0))
    return wp.where(inside, 0, 1)


@wp.func
def cast_bilinear(window: int, weight: int, u: float, v: float) -> int:
    """The same, into four pixels."""
    x = to_int(u * 256.0)
    y = to_int(v * 256.0)
    inside = wp.uint32(x) < wp.uint32(256 * (COLUMNS - 1)) and wp.uint32(y) < wp.uint32(256 * (ROWS - 1))
    fx = x & 255
    fy = y & 255
    b = (fx * fy + 128) >> 8
    at = window + wp.where(inside, 4 * ((y >> 8) * COLUMNS + (x >> 8)), 0)
    given = wp.where(inside, weight, 0)
    add_to_word(at, given * (256 - fx - fy + b))
    add_to_word(at + 4, given * (fx - b))
    add_to_word(at + 4 * COLUMNS, given * (fy - b))
    add_to_word(at + 4 * COLUMNS + 4, given * b)
    return wp.where(inside, 0, 1)


@wp.func
def cast_event(
    model: Any, camera: Any, motion: Any, events: TileEvents, nearest: int, window: int, candidate: int, i: int,
    event: Event,
) -> int:  # fmt: skip
    """The vote of event ``i`` under a candidate; 1 where it does not lie in the window."""
    u, v = place_event(model, camera, motion, events, candidate, i, event)
    if nearest != 0:
        return cast_nearest(window, event.weight, u, v)
    return cast_bilinear(window, event.weight, u, v)


@wp.func
def unpack(packed: int, chunk: Chunk, canvas: Canvas, layout: Layout, i: int) -> Event:
    e = Event()
    e.x = float(chunk.x + (packed & 31))
    e.y = float(chunk.y + ((packed >> 5) & 31))
    e.weight = ((packed >> 10) & 63) + 1
    e.turn = packed >> 16  # signed: half a turn either way
    e.scale = canvas.scale
    e.corner_x = layout.shift - float(chunk.column)
    e.corner_y = layout.shift - float(chunk.row)
    if canvas.dither != 0.0:
        dx, dy = somewhere(i)
        e.corner_x += dx * canvas.scale
        e.corner_y += dy * canvas.scale
    return e


@wp.func
def clear_window(window: int, thread: int, many: int):
    for i in range(thread, many * COLUMNS * ROWS, THREADS):
        set_word(window + 4 * i, 0)
    wait_for_block()


@wp.func
def flush_window(
    layout: Layout, canvas: Canvas, chunk: Chunk, images: wp.array2d(dtype=wp.int64), window: int, first: int,
    thread: int, many: int,
):  # fmt: skip
    wait_for_block()
    for i in range(thread, many * COLUMNS * ROWS, THREADS):
        at = i % (COLUMNS * ROWS)
        image = images[first + i / (COLUMNS * ROWS)]
        add_outside(layout, canvas, chunk, image, at / COLUMNS, at % COLUMNS, get_word(window + 4 * i))


@wp.func
def cast_left(
    models: wp.array(dtype=Any), camera: Any, motion: Any, events: TileEvents, canvas: Canvas, layout: Layout,
    chunk: Chunk, images: wp.array2d(dtype=wp.int64), first: int, left: int, i: int, event: Event,
):  # fmt: skip
    """Votes outside the window, of the candidates whose bits are set in ``left``."""
    for k in range(wp.where(left != 0, AT_ONCE, 0)):
        if ((left >> k) & 1) != 0:
            u, v = place_event(models[first + k], camera, motion, events, first + k, i, event)
            cast_outside(layout, canvas, chunk, images[first + k], u, v, event.weight)


@wp.kernel(launch_bounds=(int(THREADS), BLOCKS))
def vote_tiles(
    models: wp.array(dtype=Any), camera: Any, events: TileEvents, motion: Any, canvas: Canvas, layout: Layout,
    images: wp.array2d(dtype=wp.int64),
):  # fmt: skip
    block, thread = wp.tid()
    chunk = events.chunks[block % events.chunks.shape[0]]
    first = (block / events.chunks.shape[0]) * AT_ONCE
    many = wp.min(AT_ONCE, images.shape[0] - first)
    a = models[first]
    b = models[first + wp.min(1, many - 1)]
    c = models[first + many - 1]
    words = window()
    clear_window(words, thread, many)
    packed = int(load_uint32(events.packed, wp.min(chunk.start + thread, chunk.stop - 1)))
    for i in range(chunk.start + thread, chunk.stop, THREADS):
        event = unpack(packed, chunk, canvas, layout, i)
        # under way while this one is voted
        packed = int(load_uint32(events.packed, wp.min(i + THREADS, chunk.stop - 1)))
        left = cast_event(a, camera, motion, events, canvas.nearest, words, first, i, event)
        if many > 1:
            left += 2 * cast_event(b, camera, motion, events, canvas.nearest, words + SIZE, first + 1, i, event)
        if many > 2:
            left += 4 * cast_event(c, camera, motion, events, canvas.nearest, words + 2 * SIZE, first + 2, i, event)
        cast_left(models, camera, motion, events, canvas, layout, chunk, images, first, left, i, event)
    flush_window(layout, canvas, chunk, images, words, first, thread, many)


for _struct in (CircleParams, RadialCircleParams, ExactParams):
    for _camera, _motion in ((PinholeParams, Still), (CameraParams, Still), (CameraParams, Motion)):
        wp.overload(vote_tiles, {"models": wp.array(dtype=_struct), "camera": _camera, "motion": _motion})


@wp.kernel
def read_tiles(votes: wp.array(dtype=wp.int64), start: int, image: wp.array(dtype=float)):
    i = start + wp.tid()
    image[i] = float(wp.float64(votes[i]) / wp.float64(256.0))
