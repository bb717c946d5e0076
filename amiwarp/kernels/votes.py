"""Voting events into the image of warped events (IWE): one 64-bit addition an event, nearest or bilinear.

A cell is the square between four pixel centres. Its word holds four sums over the events in it: their number n, and
fx, fy and b = fx fy of their places in it, in 1/256. They are the bilinear weights' sums: n - fx - fy + b for the
cell's first pixel, fx - b for the next column, fy - b for the next row, b for both. Integers: the image does not depend
on order and is the same bit for bit. A word is full with 1,023 events. What is carried out of a field is taken down at
once, exactly, in 64-bit totals; or, faster on CUDA, words are emptied before, and checked:
see :mod:`amiwarp.imaging.warped_image`.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, CameraRotationParams, PinholeParams, turn_back
from amiwarp.kernels.encoder import EncoderParams, angle_at
from amiwarp.kernels.native import add_word, load_float, load_uint8, load_uint16, store_int, store_word
from amiwarp.kernels.optics import MODEL_STRUCTS, place

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK = wp.constant(64)  # events that a CPU places eight at a time before it votes them
TRASH = wp.constant(4096)  # words past the cells: votes outside the image, spread so that none fills up
CAPACITY = wp.constant(1024)  # events that overflow a word
FIELD = wp.constant(wp.int64(1 << 18))  # what a carry out of the fields fx, fy, b is worth
MIX_1 = wp.constant(wp.uint32(0x85EBCA6B))
MIX_2 = wp.constant(wp.uint32(0xC2B2AE35))
ONE = wp.constant(wp.uint64(1 << 54))
CARRIES = wp.constant(wp.uint64((1 << 63) | (1 << 53) | (1 << 35) | (1 << 17)))


@wp.struct
class EventArrays:
    """Events on a device, padded to whole blocks. ``layer``: the image that an event goes to, by its polarity;
    ``turn``: the encoder's angle in 1/65536 turn; ``azimuths``: cosine and sine of each such angle; ``time``: from the
    window's middle [s], or empty where the camera does not turn."""

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    layer: wp.array(dtype=wp.uint8)
    turn: wp.array(dtype=wp.uint16)
    azimuths: wp.array(dtype=float)
    time: wp.array(dtype=float)
    weight: wp.array(dtype=wp.uint8)


@wp.struct
class Canvas:
    """Where votes go: the image grown by ``pad`` pixels on each side, then scaled, within a ring of one pixel."""

    pad: float
    scale: float
    nearest: int
    dither: float  # 1: an event lies somewhere in its pixel, 0: at its centre
    rows: int
    columns: int
    layer: int  # cells from one image to the next; 0: together


@wp.struct
class Cells:
    """The words of one image, trash after the cells, and the totals of what no longer fitted into them."""

    words: wp.array(dtype=wp.uint64)
    totals: wp.array(dtype=wp.int64)
    spilled: wp.array(dtype=wp.int32)  # 1 once there is anything in the totals


@wp.func
def add_moments(cells: Cells, cell: int, width: int, n: wp.int64, fx: wp.int64, fy: wp.int64, b: wp.int64):
    wp.atomic_add(cells.totals, cell, wp.int64(256) * n - fx - fy + b)
    wp.atomic_add(cells.totals, cell + 1, fx - b)
    wp.atomic_add(cells.totals, cell + width, fy - b)
    wp.atomic_add(cells.totals, cell + width + 1, b)
    cells.spilled[0] = 1


@wp.func
def carried(carry: wp.uint64, bit: int) -> wp.int64:
    return wp.int64((carry >> wp.uint64(bit)) & wp.uint64(1))


@wp.func
def take_down(cells: Cells, cell: int, width: int, carry: wp.uint64):
    """Moves carries to the totals: what a field lost, less the one that the next field wrongly got."""
    fx = carried(carry, 17)
    fy = carried(carry, 35)
    b = carried(carry, 53)
    n = wp.int64(CAPACITY) * carried(carry, 63) - b
    add_moments(cells, cell, width, n, FIELD * fx, FIELD * fy - fx, FIELD * b - fy)


@wp.func
def cast_vote(cells: Cells, cell: int, width: int, word: wp.uint64):
    """Adds a word exactly, whatever came before it."""
    old = wp.atomic_add(cells.words, cell, word)
    carry = ((old & word) | ((old | word) & (~(old + word)))) & CARRIES
    if carry != wp.uint64(0):
        take_down(cells, cell, width, carry)


@wp.func
def add_vote(cells: Cells, cell: int, width: int, word: wp.uint64):
    """The same where no other thread adds to these words."""
    carry = add_word(cells.words, cell, word) & CARRIES
    if carry != wp.uint64(0):
        take_down(cells, cell, width, carry)


@wp.func
def somewhere(i: int):
    """A place in the pixel, even over it, the same for event ``i`` at every call (MurmurHash3's finaliser)."""
    h = wp.uint32(i + 1)
    h = (h ^ (h >> wp.uint32(16))) * MIX_1
    h = (h ^ (h >> wp.uint32(13))) * MIX_2
    h = h ^ (h >> wp.uint32(16))
    scale = 1.0 / 65536.0
    return float(int(h & wp.uint32(0xFFFF))) * scale - 0.5, float(int(h >> wp.uint32(16))) * scale - 0.5


@wp.func
def vote_at(canvas: Canvas, x: float, y: float, layer: int):
    """Whether a place lies on the canvas, its cell and its word; NaN lies nowhere, and votes nothing in cell 0."""
    u = (x + canvas.pad + 0.5) * canvas.scale + 0.5
    v = (y + canvas.pad + 0.5) * canvas.scale + 0.5
    inside = wp.where(u > 0.0, wp.where(u < float(canvas.columns - 1), 1, 0), 0)
    inside = wp.where(v > 0.0, wp.where(v < float(canvas.rows - 1), inside, 0), 0)
    u = wp.where(inside == 1, wp.where(canvas.nearest != 0, wp.floor(u + 0.5), u), 0.0)
    v = wp.where(inside == 1, wp.where(canvas.nearest != 0, wp.floor(v + 0.5), v), 0.0)
    col = int(u)
    row = int(v)
    fx = int((u - float(col)) * 256.0 + 0.5)
    fy = int((v - float(row)) * 256.0 + 0.5)
    b = (fx * fy + 128) >> 8
    word = (wp.uint64(b) << wp.uint64(36)) | (wp.uint64(fy) << wp.uint64(18)) | wp.uint64(fx) | ONE
    cell = row * canvas.columns + col + layer
    return inside, wp.where(inside == 1, cell, 0), wp.where(inside == 1, word, wp.uint64(0))


@wp.func
def azimuth_at(model: Any, events: EventArrays, i: int):
    turn = 2 * int(load_uint16(events.turn, i))
    c = load_float(events.azimuths, turn)
    s = load_float(events.azimuths, turn + 1)
    return c * model.phase_cos - s * model.phase_sin, s * model.phase_cos + c * model.phase_sin


@wp.func
def weighted(events: EventArrays, i: int, word: wp.uint64) -> wp.uint64:
    """The word of as many events in one place: up to 255, so that no field overflows."""
    if events.weight.shape[0] == 0:
        return word
    return word * wp.uint64(events.weight[i])


@wp.func
def event_vote(model: Any, camera: Any, events: EventArrays, canvas: Canvas, i: int):
    """Angle, displacement and vote of one event."""
    w0, w1 = azimuth_at(model, events, i)
    x, y = place(model, camera, float(load_uint16(events.x, i)), float(load_uint16(events.y, i)), w0, w1)
    dx, dy = somewhere(i)
    layer = int(load_uint8(events.layer, i)) * canvas.layer
    inside, cell, word = vote_at(canvas, x + canvas.dither * dx, y + canvas.dither * dy, layer)
    return inside, cell, word


@wp.kernel
def vote_blocks(
    model: Any, camera: PinholeParams, events: EventArrays, canvas: Canvas, count: int, start: int, cells: Cells
):
    """For CPUs: a block's votes, found by a loop that vectorises, then cast."""
    first = (start + wp.tid()) * BLOCK
    places = wp.zeros(shape=(64,), dtype=int)
    words = wp.zeros(shape=(64,), dtype=wp.uint64)
    for k in range(BLOCK):
        _inside, cell, word = event_vote(model, camera, events, canvas, first + k)
        store_int(places, k, cell)
        store_word(words, k, wp.where(first + k < count, word, wp.uint64(0)))
    for k in range(BLOCK):
        add_vote(cells, places[k], canvas.columns, weighted(events, first + k, words[k]))


@wp.kernel
def vote_events(model: Any, camera: Any, events: EventArrays, canvas: Canvas, start: int, cells: Cells):
    """One event, exactly."""
    i = start + wp.tid()
    _inside, cell, word = event_vote(model, camera, events, canvas, i)
    cast_vote(cells, cell, canvas.columns, weighted(events, i, word))


@wp.kernel
def vote_turning(
    model: Any,
    camera: CameraParams,
    events: EventArrays,
    canvas: Canvas,
    camera_rotation: CameraRotationParams,
    start: int,
    cells: Cells,
):
    """The same, the camera's own turning taken back."""
    i = start + wp.tid()
    w0, w1 = azimuth_at(model, events, i)
    x, y = place(model, camera, float(events.x[i]), float(events.y[i]), w0, w1)
    xy = turn_back(camera, wp.vec2(x, y), camera_rotation, events.time[i])
    dx, dy = somewhere(i)
    layer = int(events.layer[i]) * canvas.layer
    _inside, cell, word = vote_at(canvas, xy[0] + canvas.dither * dx, xy[1] + canvas.dither * dy, layer)
    cast_vote(cells, cell, canvas.columns, word)


@wp.kernel
def vote_quickly(model: Any, camera: Any, events: EventArrays, canvas: Canvas, trash: int, start: int, cells: Cells):
    """For CUDA: one event, without a look at what its word held; votes outside are counted in the trash."""
    i = start + wp.tid()
    inside, cell, word = event_vote(model, camera, events, canvas, i)
    if inside == 1:
        wp.atomic_add(cells.words, cell, word)
    else:
        wp.atomic_add(cells.words, trash + (i & (TRASH - 1)), ONE)


@wp.kernel
def turn_events(encoder: EncoderParams, t: wp.array(dtype=wp.int64), start: int, turn: wp.array(dtype=wp.uint16)):
    """The encoder's angle at each event's time, to the nearest 1/65536 turn."""
    i = start + wp.tid()
    turn[i] = wp.uint16((angle_at(encoder, t[i]) + wp.uint32(32768)) >> wp.uint32(16))


@wp.kernel
def time_events(t: wp.array(dtype=wp.int64), middle: wp.int64, start: int, time: wp.array(dtype=float)):
    i = start + wp.tid()
    time[i] = float(int(t[i] - middle)) * 1.0e-6


@wp.kernel
def layer_events(
    p: wp.array(dtype=wp.uint8), parts: int, per_polarity: int, start: int, layer: wp.array(dtype=wp.uint8)
):
    """Which image an event goes to: that of its part, every so manieth, and there OFF or ON."""
    i = start + wp.tid()
    layer[i] = wp.uint8((i % parts) * (1 + per_polarity) + per_polarity * wp.where(p[i] != wp.uint8(0), 1, 0))


@wp.kernel
def fold_keys(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    layer: wp.array(dtype=wp.uint8),
    turn: wp.array(dtype=wp.uint16),
    bins: int,
    start: int,
    keys: wp.array(dtype=wp.int64),
):
    """One number for the angle's bin, the pixel and the polarity, in that order."""
    i = start + wp.tid()
    bin_of = wp.int64((wp.uint32(turn[i]) * wp.uint32(bins)) >> wp.uint32(16))
    pixel = (wp.int64(y[i]) << wp.int64(16)) | wp.int64(x[i])
    keys[i] = (bin_of << wp.int64(33)) | (pixel << wp.int64(1)) | wp.int64(wp.where(layer[i] != wp.uint8(0), 1, 0))


@wp.kernel
def unfold_keys(keys: wp.array(dtype=wp.int64), bins: int, start: int, events: EventArrays):
    i = start + wp.tid()
    key = keys[i]
    events.layer[i] = wp.uint8(key & wp.int64(1))
    events.x[i] = wp.uint16((key >> wp.int64(1)) & wp.int64(65535))
    events.y[i] = wp.uint16((key >> wp.int64(17)) & wp.int64(65535))
    bin_of = key >> wp.int64(33)
    events.turn[i] = wp.uint16((wp.int64(65536) * bin_of + wp.int64(32768)) / wp.int64(bins))


@wp.kernel
def vote_points(
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    layers: wp.array(dtype=wp.uint8),
    canvas: Canvas,
    start: int,
    cells: Cells,
):
    i = start + wp.tid()
    layer = int(layers[i]) * canvas.layer
    _inside, cell, word = vote_at(canvas, x[i], y[i], layer)
    cast_vote(cells, cell, canvas.columns, word)


@wp.kernel
def vote_point_blocks(
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    layers: wp.array(dtype=wp.uint8),
    canvas: Canvas,
    start: int,
    cells: Cells,
):
    """For CPUs: a whole block of them."""
    first = (start + wp.tid()) * BLOCK
    places = wp.zeros(shape=(64,), dtype=int)
    words = wp.zeros(shape=(64,), dtype=wp.uint64)
    for k in range(BLOCK):
        layer = int(load_uint8(layers, first + k)) * canvas.layer
        _inside, cell, word = vote_at(canvas, load_float(x, first + k), load_float(y, first + k), layer)
        store_int(places, k, cell)
        store_word(words, k, word)
    for k in range(BLOCK):
        add_vote(cells, places[k], canvas.columns, words[k])


@wp.kernel
def drift_turns(
    base: wp.array(dtype=wp.uint16),
    slope: wp.array(dtype=float),
    drift: float,
    start: int,
    turn: wp.array(dtype=wp.uint16),
):
    """Angles [1/65536 turn] after a parameter changed by ``drift``; ``slope``: their change per unit of it."""
    i = start + wp.tid()
    turn[i] = wp.uint16((int(base[i]) + int(wp.floor(drift * slope[i] + 0.5))) & 65535)


for _struct in MODEL_STRUCTS:
    wp.overload(vote_blocks, {"model": _struct})
    wp.overload(vote_turning, {"model": _struct})
    for _camera in (PinholeParams, CameraParams):
        wp.overload(vote_events, {"model": _struct, "camera": _camera})
        wp.overload(vote_quickly, {"model": _struct, "camera": _camera})
