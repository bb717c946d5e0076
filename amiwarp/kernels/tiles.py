"""Repeated votes of the same events on CUDA: sorted by image tile once, then voted in shared memory.

A block of threads takes a chunk of one tile's events and a few candidates (parameter sets): it reads each event once
for all of them. Votes outside the window around the tile go directly to the image. Used by
:mod:`amiwarp.imaging.iwe`.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams
from amiwarp.kernels.camera_rotation import CameraRotationParams, undo_camera_rotation
from amiwarp.kernels.native_code import load_uint32
from amiwarp.kernels.prism_angle import THETA_U16_RAD
from amiwarp.kernels.refraction import displace, state_of
from amiwarp.kernels.shared_memory import add_to_word, get_word, set_word, wait_for_block, window
from amiwarp.kernels.votes import Canvas, dither_offset, events_of

# Fast math is on: these sums need not equal a CPU's bit for bit.
wp.set_module_options({"enable_backward": False, "fast_math": True})

TILE = 32  # width and height of a tile [sensor px]
# Columns of a window [canvas px]; odd, so that a column spreads over all memory banks
COLUMNS = wp.constant(61)
ROWS = wp.constant(64)  # rows of a window [canvas px]
SIZE = wp.constant(4 * 61 * 64)  # size of a window [bytes]
THREADS = wp.constant(256)  # number of threads per block
BLOCKS = 4  # number of resident blocks per multiprocessor
# Number of candidates voted per reading of an event; their windows fill 48 KiB
AT_ONCE = wp.constant(3)
# Chunks with fewer events are voted faster into the image than through a window
FEW_EVENTS = wp.constant(1024)
# Events per chunk: at most 63 * 2**25 votes of 1/256, so that no word of the window overflows
CHUNK = 1 << 17


@wp.struct
class Chunk:
    """Run of one tile's events, which have one polarity if the polarities have separate images."""

    start: int
    stop: int
    x: int  # first column of the tile on the sensor
    y: int  # first row of the tile on the sensor
    column: int  # first column of the window on the canvas
    row: int  # first row of the window on the canvas
    layer: int


@wp.struct
class TileEvents:
    """Events sorted by image tile and packed into words.

    ``packed`` holds theta_u16 (16 bits), the weight minus one (6 bits), and y and x in the tile (5 bits each).
    """

    packed: wp.array(dtype=wp.uint32)
    slope: wp.array(dtype=float)  # derivative of theta_u16 by the drift, or empty
    time: wp.array(dtype=float)  # time from the middle of the time window [s], or empty
    chunks: wp.array(dtype=Chunk)


@wp.struct
class UnpackedEvent:
    """Event that was unpacked from :class:`TileEvents`."""

    x: float  # position on the sensor [px]
    y: float
    corner_x: float  # offset in x from scaled sensor coordinates to the window, dither included [canvas px]
    corner_y: float  # offset in y from scaled sensor coordinates to the window, dither included [canvas px]
    scale: float
    turn: int
    weight: int


@wp.struct
class Still:
    """Candidate parameter sets that differ only in their models."""

    nothing: int  # unused field, because a Warp struct needs at least one


@wp.struct
class Motion:
    """Parameters of the candidates besides the model, one array element per candidate."""

    drift: wp.array(dtype=float)
    camera_rotation: wp.array(dtype=CameraRotationParams)


@wp.struct
class Layout:
    """Memory layout of the vote images; see :class:`amiwarp.kernels.iwe.Frame`."""

    stride: int
    layer: int
    first: int
    shift: float  # offset from scaled sensor coordinates to the canvas [canvas px]


@wp.func
def tile_key(x: int, y: int, layer: int, across: int, tiles: int, size: int) -> int:
    """Return the sort key of an event: its image layer and its tile."""
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
    """Compute each event's sort key, and count the events of each key."""
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
    """Pack the events in the order of their keys."""
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


@wp.func
def drifted_theta(motion: Still, events: TileEvents, candidate: int, i: int, turn: int):
    """Return theta_u16 of an event unchanged, for candidates without drift."""
    return turn


@wp.func
def drifted_theta(motion: Motion, events: TileEvents, candidate: int, i: int, turn: int):
    """Return theta_u16 of an event after the candidate's drift."""
    if events.slope.shape[0] == 0:
        return turn
    return turn + int(wp.floor(motion.drift[candidate] * events.slope[i] + 0.5))


@wp.func
def without_camera_rotation(
    motion: Still, camera: Any, x: float, y: float, events: TileEvents, candidate: int, i: int
):
    """Return the position of an event unchanged, for candidates without camera rotation."""
    return x, y


@wp.func
def without_camera_rotation(
    motion: Motion,
    camera: CameraParams,
    x: float,
    y: float,
    events: TileEvents,
    candidate: int,
    i: int,
):
    """Return the position of an event with the candidate's camera rotation removed."""
    if events.time.shape[0] == 0:
        return x, y
    xy = undo_camera_rotation(
        camera, wp.vec2(x, y), motion.camera_rotation[candidate], events.time[i]
    )
    return xy[0], xy[1]


@wp.func
def displace_event(
    model: Any,
    camera: Any,
    motion: Any,
    events: TileEvents,
    candidate: int,
    i: int,
    event: UnpackedEvent,
):
    """Return the position of an event under a candidate, relative to the window's corner [canvas px]."""
    angle = float(drifted_theta(motion, events, candidate, i, event.turn)) * THETA_U16_RAD
    c = wp.cos(angle)
    s = wp.sin(angle)
    w0, w1 = state_of(model, c, s)
    x, y = displace(model, camera, event.x, event.y, w0, w1)
    x, y = without_camera_rotation(motion, camera, x, y, events, candidate, i)
    return x * event.scale + event.corner_x, y * event.scale + event.corner_y


@wp.func
def add_outside(
    layout: Layout,
    canvas: Canvas,
    chunk: Chunk,
    image: wp.array(dtype=wp.int64),
    r: int,
    c: int,
    v: int,
):
    """Add ``v`` to the image at row ``r`` and column ``c``, both relative to the window's corner."""
    row = chunk.row + r
    col = chunk.column + c
    if row >= 0 and col >= 0 and row < canvas.rows - 2 and col < canvas.columns - 2 and v != 0:
        wp.atomic_add(
            image,
            layout.first + chunk.layer * layout.layer + row * layout.stride + col,
            wp.int64(v),
        )


@wp.func
def cast_outside(
    layout: Layout,
    canvas: Canvas,
    chunk: Chunk,
    image: wp.array(dtype=wp.int64),
    u: float,
    v: float,
    weight: int,
):
    """Vote into the image at a position [canvas px] relative to the window's corner.

    For votes that are not entirely inside the window. NaN and positions far away do not vote.
    """
    if not (wp.abs(u) < 16000.0 and wp.abs(v) < 16000.0):
        return
    fine = wp.where(canvas.nearest != 0, 1.0, 256.0)
    x = to_int(u * fine) << wp.where(canvas.nearest != 0, 8, 0)
    y = to_int(v * fine) << wp.where(canvas.nearest != 0, 8, 0)
    b = ((x & 255) * (y & 255) + 128) >> 8
    add_outside(
        layout, canvas, chunk, image, y >> 8, x >> 8, weight * (256 - (x & 255) - (y & 255) + b)
    )
    add_outside(layout, canvas, chunk, image, y >> 8, (x >> 8) + 1, weight * ((x & 255) - b))
    add_outside(layout, canvas, chunk, image, (y >> 8) + 1, x >> 8, weight * ((y & 255) - b))
    add_outside(layout, canvas, chunk, image, (y >> 8) + 1, (x >> 8) + 1, weight * b)


@wp.func
def to_int(value: float) -> int:
    """Return the nearest integer of a value below 2**22 in magnitude.

    The addition that rounds takes a GPU a quarter of the time of a conversion.
    """
    return wp.cast(value + 12582912.0, int) - 0x4B400000


@wp.func
def cast_nearest(window: int, weight: int, u: float, v: float) -> int:
    """Add a nearest vote to the window at address ``window``; return 1 if it lies outside of the window."""
    c = to_int(u)
    r = to_int(v)
    inside = wp.uint32(c) < wp.uint32(COLUMNS) and wp.uint32(r) < wp.uint32(ROWS)
    # without a branch: a vote outside the window adds 0 to the first word
    add_to_word(
        window + wp.where(inside, 4 * (r * COLUMNS + c), 0), wp.where(inside, weight << 8, 0)
    )
    return wp.where(inside, 0, 1)


@wp.func
def cast_bilinear(window: int, weight: int, u: float, v: float) -> int:
    """Add a bilinear vote to four pixels of the window; return 1 if it is not entirely inside."""
    x = to_int(u * 256.0)
    y = to_int(v * 256.0)
    inside = wp.uint32(x) < wp.uint32(256 * (COLUMNS - 1)) and wp.uint32(y) < wp.uint32(
        256 * (ROWS - 1)
    )
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
    model: Any,
    camera: Any,
    motion: Any,
    events: TileEvents,
    nearest: int,
    window: int,
    candidate: int,
    i: int,
    event: UnpackedEvent,
) -> int:
    """Vote event ``i`` under a candidate; return 1 if the vote is not entirely inside the window."""
    u, v = displace_event(model, camera, motion, events, candidate, i, event)
    if nearest != 0:
        return cast_nearest(window, event.weight, u, v)
    return cast_bilinear(window, event.weight, u, v)


@wp.func
def unpack(packed: int, chunk: Chunk, canvas: Canvas, layout: Layout, i: int) -> UnpackedEvent:
    """Unpack event ``i`` of the packed events of a tile."""
    event = UnpackedEvent()
    event.x = float(chunk.x + (packed & 31))
    event.y = float(chunk.y + ((packed >> 5) & 31))
    event.weight = ((packed >> 10) & 63) + 1
    event.turn = packed >> 16  # signed: from -1/2 to 1/2 turn
    event.scale = canvas.scale
    event.corner_x = layout.shift - float(chunk.column)
    event.corner_y = layout.shift - float(chunk.row)
    if canvas.dither != 0.0:
        dx, dy = dither_offset(i)
        event.corner_x += dx * canvas.scale
        event.corner_y += dy * canvas.scale
    return event


@wp.func
def clear_window(window: int, thread: int, many: int):
    """Set the windows of ``many`` candidates in shared memory to zero."""
    for i in range(thread, many * COLUMNS * ROWS, THREADS):
        set_word(window + 4 * i, 0)
    wait_for_block()


@wp.func
def flush_window(
    layout: Layout,
    canvas: Canvas,
    chunk: Chunk,
    images: wp.array2d(dtype=wp.int64),
    window: int,
    first: int,
    thread: int,
    many: int,
):
    """Add the windows of ``many`` candidates in shared memory to their images."""
    wait_for_block()
    for i in range(thread, many * COLUMNS * ROWS, THREADS):
        at = i % (COLUMNS * ROWS)
        image = images[first + i / (COLUMNS * ROWS)]
        add_outside(
            layout, canvas, chunk, image, at / COLUMNS, at % COLUMNS, get_word(window + 4 * i)
        )


@wp.func
def cast_remaining(
    models: wp.array(dtype=Any),
    camera: Any,
    motion: Any,
    events: TileEvents,
    canvas: Canvas,
    layout: Layout,
    chunk: Chunk,
    images: wp.array2d(dtype=wp.int64),
    first: int,
    left: int,
    i: int,
    event: UnpackedEvent,
):
    """Vote into the images of the candidates whose bits are set in ``left``."""
    for k in range(wp.where(left != 0, AT_ONCE, 0)):
        if ((left >> k) & 1) != 0:
            u, v = displace_event(models[first + k], camera, motion, events, first + k, i, event)
            cast_outside(layout, canvas, chunk, images[first + k], u, v, event.weight)


@wp.func
def cast_directly(
    models: wp.array(dtype=Any),
    camera: Any,
    motion: Any,
    events: TileEvents,
    canvas: Canvas,
    layout: Layout,
    chunk: Chunk,
    images: wp.array2d(dtype=wp.int64),
    first: int,
    thread: int,
):
    """Vote a chunk of events into the images of up to :data:`AT_ONCE` candidates, without windows."""
    every = (1 << wp.min(AT_ONCE, images.shape[0] - first)) - 1
    for i in range(chunk.start + thread, chunk.stop, THREADS):
        event = unpack(int(load_uint32(events.packed, i)), chunk, canvas, layout, i)
        cast_remaining(
            models, camera, motion, events, canvas, layout, chunk, images, first, every, i, event
        )


@wp.kernel(launch_bounds=(int(THREADS), BLOCKS))
def vote_tiles(
    models: wp.array(dtype=Any),
    camera: Any,
    events: TileEvents,
    motion: Any,
    canvas: Canvas,
    layout: Layout,
    images: wp.array2d(dtype=wp.int64),
):
    """Vote one chunk of events under up to :data:`AT_ONCE` candidates per block."""
    block, thread = wp.tid()
    chunk = events.chunks[block % events.chunks.shape[0]]
    first = (block / events.chunks.shape[0]) * AT_ONCE
    many = wp.min(AT_ONCE, images.shape[0] - first)
    if chunk.stop - chunk.start < FEW_EVENTS:
        cast_directly(models, camera, motion, events, canvas, layout, chunk, images, first, thread)
        return
    a = models[first]
    b = models[first + wp.min(1, many - 1)]
    c = models[first + many - 1]
    words = window()
    clear_window(words, thread, many)
    packed = int(load_uint32(events.packed, wp.min(chunk.start + thread, chunk.stop - 1)))
    for i in range(chunk.start + thread, chunk.stop, THREADS):
        event = unpack(packed, chunk, canvas, layout, i)
        # load the next event while the present event is voted
        packed = int(load_uint32(events.packed, wp.min(i + THREADS, chunk.stop - 1)))
        left = cast_event(a, camera, motion, events, canvas.nearest, words, first, i, event)
        if many > 1:
            left += 2 * cast_event(
                b, camera, motion, events, canvas.nearest, words + SIZE, first + 1, i, event
            )
        if many > 2:
            left += 4 * cast_event(
                c, camera, motion, events, canvas.nearest, words + 2 * SIZE, first + 2, i, event
            )
        cast_remaining(
            models, camera, motion, events, canvas, layout, chunk, images, first, left, i, event
        )
    flush_window(layout, canvas, chunk, images, words, first, thread, many)


@wp.kernel
def read_tiles(votes: wp.array(dtype=wp.int64), start: int, image: wp.array(dtype=float)):
    """Convert votes [1/256 event] to an image [events]."""
    i = start + wp.tid()
    image[i] = events_of(votes[i])
