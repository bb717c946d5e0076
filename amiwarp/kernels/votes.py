"""Votes into the image of warped events (IWE): one 64-bit addition per event, nearest or bilinear.

A cell is the square between four pixel centres. Its word holds four sums over the events in it: their number n, and the
sums fx, fy and b of x, y and x y, where x and y are the positions in the cell. The sums fx, fy and b are in units of
1/256. They give the sums of the bilinear weights: n - fx - fy + b for the cell's first pixel, fx - b for the next
column, fy - b for the next row, and b for the pixel diagonally opposite. Because the sums are integers, the image does
not depend on the order of events and is bit-identical on every run.

A word overflows after 1,023 events. Either each carry out of a field is added exactly to 64-bit totals at once; or,
faster on CUDA, words are emptied in time and checked afterwards: see :mod:`amiwarp.imaging.warped_image`.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, CameraRotationParams, PinholeParams, undo_camera_rotation
from amiwarp.kernels.encoder_angle import EncoderParams, theta_u32_at
from amiwarp.kernels.refraction import MODEL_STRUCTS, displace
from amiwarp.kernels.vector_code import add_word, load_float, load_uint8, load_uint16, store_int, store_word

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK = wp.constant(64)  # number of events per CPU thread, which displaces eight at a time and then votes
TRASH = wp.constant(4096)  # number of words for votes outside the image, large enough that no word overflows
CAPACITY = wp.constant(1024)  # number of events at which a word overflows
FIELD_CARRY = wp.constant(wp.int64(1 << 18))  # value of a carry out of the fields fx, fy, b
MIX_1 = wp.constant(wp.uint32(0x85EBCA6B))  # multipliers of MurmurHash3's finaliser
MIX_2 = wp.constant(wp.uint32(0xC2B2AE35))
ONE_EVENT = wp.constant(wp.uint64(1 << 54))  # one event in the field n
CARRIES = wp.constant(wp.uint64((1 << 63) | (1 << 53) | (1 << 35) | (1 << 17)))  # highest bit of each field


@wp.struct
class EventArrays:
    """Events on a device, padded to whole blocks.

    ``layer`` is the image that an event goes to, by its polarity. ``turn`` is theta_u16, the encoder's angle [1/65536
    turn], and ``azimuths`` holds cosine and sine of each such angle. ``time`` [s] counts from the middle of the window;
    it is empty if the camera does not rotate. ``weight`` is the number of events that an entry stands for, or empty.
    """

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    layer: wp.array(dtype=wp.uint8)
    turn: wp.array(dtype=wp.uint16)
    azimuths: wp.array(dtype=float)
    time: wp.array(dtype=float)
    weight: wp.array(dtype=wp.uint8)


@wp.struct
class Canvas:
    """Geometry of the votes: the image grown by ``pad`` pixels on each side, scaled, with a border of one pixel."""

    pad: float  # border around the sensor [px]
    scale: float  # canvas pixels per sensor pixel
    nearest: int  # 1: nearest votes, 0: bilinear votes
    dither: float  # 1: events get a random offset in their pixels; 0: they lie at the centres
    rows: int  # number of rows of cells, including the border
    columns: int
    layer: int  # distance from one image to the next [cells]; 0: one image for all events


@wp.struct
class Cells:
    """Words of the vote cells of one image, then the trash words, and the totals to which overflows are added."""

    words: wp.array(dtype=wp.uint64)
    totals: wp.array(dtype=wp.int64)
    spilled: wp.array(dtype=wp.int32)  # 1 if the totals are not all zero


@wp.func
def add_to_totals(cells: Cells, cell: int, width: int, n: wp.int64, fx: wp.int64, fy: wp.int64, b: wp.int64):
    """Add the moments of a cell, in the units of its word, to the 64-bit totals of its four pixels."""
    wp.atomic_add(cells.totals, cell, wp.int64(256) * n - fx - fy + b)
    wp.atomic_add(cells.totals, cell + 1, fx - b)
    wp.atomic_add(cells.totals, cell + width, fy - b)
    wp.atomic_add(cells.totals, cell + width + 1, b)
    cells.spilled[0] = 1


@wp.func
def carry_bit(carry: wp.uint64, bit: int) -> wp.int64:
    """Return bit ``bit`` of a word's carries."""
    return wp.int64((carry >> wp.uint64(bit)) & wp.uint64(1))


@wp.func
def add_carries_to_totals(cells: Cells, cell: int, width: int, carry: wp.uint64):
    """Add the carries of a word to the 64-bit totals.

    Each field lost its overflow; the field above it received a 1 that does not belong to it.
    """
    fx = carry_bit(carry, 17)
    fy = carry_bit(carry, 35)
    b = carry_bit(carry, 53)
    n = wp.int64(CAPACITY) * carry_bit(carry, 63) - b
    add_to_totals(cells, cell, width, n, FIELD_CARRY * fx, FIELD_CARRY * fy - fx, FIELD_CARRY * b - fy)


@wp.func
def add_vote_atomically(cells: Cells, cell: int, width: int, word: wp.uint64):
    """Add a vote to a word with an atomic addition, and move its carries to the totals."""
    old = wp.atomic_add(cells.words, cell, word)
    carry = ((old & word) | ((old | word) & (~(old + word)))) & CARRIES
    if carry != wp.uint64(0):
        add_carries_to_totals(cells, cell, width, carry)


@wp.func
def add_vote_unshared(cells: Cells, cell: int, width: int, word: wp.uint64):
    """Add a vote as :func:`add_vote_atomically` does, if no other thread adds to these words."""
    carry = add_word(cells.words, cell, word) & CARRIES
    if carry != wp.uint64(0):
        add_carries_to_totals(cells, cell, width, carry)


@wp.func
def dither_offset(i: int):
    """Return a random offset in the pixel, uniform over it, for event ``i``.

    It is the same at every call. The hash is MurmurHash3's finaliser.
    """
    h = wp.uint32(i + 1)
    h = (h ^ (h >> wp.uint32(16))) * MIX_1
    h = (h ^ (h >> wp.uint32(13))) * MIX_2
    h = h ^ (h >> wp.uint32(16))
    scale = 1.0 / 65536.0
    return float(int(h & wp.uint32(0xFFFF))) * scale - 0.5, float(int(h >> wp.uint32(16))) * scale - 0.5


@wp.func
def vote_at(canvas: Canvas, x: float, y: float, layer: int):
    """Return whether a position lies on the canvas, its cell and its word.

    A position off the canvas, or NaN, gets cell 0 and an empty word.
    """
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
    word = (wp.uint64(b) << wp.uint64(36)) | (wp.uint64(fy) << wp.uint64(18)) | wp.uint64(fx) | ONE_EVENT
    cell = row * canvas.columns + col + layer
    return inside, wp.where(inside == 1, cell, 0), wp.where(inside == 1, word, wp.uint64(0))


@wp.func
def azimuth_at(model: Any, events: EventArrays, i: int):
    """Return (cos, sin) of the tilt azimuth of event ``i``."""
    turn = 2 * int(load_uint16(events.turn, i))
    c = load_float(events.azimuths, turn)
    s = load_float(events.azimuths, turn + 1)
    return c * model.phase_cos - s * model.phase_sin, s * model.phase_cos + c * model.phase_sin


@wp.func
def repeat_vote(events: EventArrays, i: int, word: wp.uint64) -> wp.uint64:
    """Return the word of an event's vote times its ``weight``: at most 255, so that no field overflows."""
    if events.weight.shape[0] == 0:
        return word
    return word * wp.uint64(events.weight[i])


@wp.func
def event_vote(model: Any, camera: Any, events: EventArrays, canvas: Canvas, i: int):
    """Compute prism angle, displacement and vote of one event."""
    w0, w1 = azimuth_at(model, events, i)
    x, y = displace(model, camera, float(load_uint16(events.x, i)), float(load_uint16(events.y, i)), w0, w1)
    dx, dy = dither_offset(i)
    layer = int(load_uint8(events.layer, i)) * canvas.layer
    inside, cell, word = vote_at(canvas, x + canvas.dither * dx, y + canvas.dither * dy, layer)
    return inside, cell, word


@wp.kernel
def vote_blocks(
    model: Any, camera: PinholeParams, events: EventArrays, canvas: Canvas, count: int, start: int, cells: Cells
):
    """Vote the events of one block per thread. For CPUs: the loop that computes the votes is vectorised."""
    first = (start + wp.tid()) * BLOCK
    places = wp.zeros(shape=(64,), dtype=int)
    words = wp.zeros(shape=(64,), dtype=wp.uint64)
    for k in range(BLOCK):
        _inside, cell, word = event_vote(model, camera, events, canvas, first + k)
        store_int(places, k, cell)
        store_word(words, k, wp.where(first + k < count, word, wp.uint64(0)))
    for k in range(BLOCK):
        add_vote_unshared(cells, places[k], canvas.columns, repeat_vote(events, first + k, words[k]))


@wp.kernel
def vote_events(model: Any, camera: Any, events: EventArrays, canvas: Canvas, start: int, cells: Cells):
    """Vote one event per thread, with a check of every addition for overflow."""
    i = start + wp.tid()
    _inside, cell, word = event_vote(model, camera, events, canvas, i)
    add_vote_atomically(cells, cell, canvas.columns, repeat_vote(events, i, word))


@wp.kernel
def vote_rotating_camera(
    model: Any,
    camera: CameraParams,
    events: EventArrays,
    canvas: Canvas,
    camera_rotation: CameraRotationParams,
    start: int,
    cells: Cells,
):
    """Vote one event per thread, exactly, with the camera's rotation removed."""
    i = start + wp.tid()
    w0, w1 = azimuth_at(model, events, i)
    x, y = displace(model, camera, float(events.x[i]), float(events.y[i]), w0, w1)
    xy = undo_camera_rotation(camera, wp.vec2(x, y), camera_rotation, events.time[i])
    dx, dy = dither_offset(i)
    layer = int(events.layer[i]) * canvas.layer
    _inside, cell, word = vote_at(canvas, xy[0] + canvas.dither * dx, xy[1] + canvas.dither * dy, layer)
    add_vote_atomically(cells, cell, canvas.columns, word)


@wp.kernel
def vote_quickly(model: Any, camera: Any, events: EventArrays, canvas: Canvas, trash: int, start: int, cells: Cells):
    """Vote one event per thread without checking for carries. For CUDA.

    Votes outside the canvas are counted in the trash words.
    """
    i = start + wp.tid()
    inside, cell, word = event_vote(model, camera, events, canvas, i)
    if inside == 1:
        wp.atomic_add(cells.words, cell, word)
    else:
        wp.atomic_add(cells.words, trash + (i & (TRASH - 1)), ONE_EVENT)


@wp.kernel
def turn_events(encoder: EncoderParams, t: wp.array(dtype=wp.int64), start: int, turn: wp.array(dtype=wp.uint16)):
    """Compute theta_u16 of each event: the prism angle at its time, rounded to 1/65536 turn."""
    i = start + wp.tid()
    turn[i] = wp.uint16((theta_u32_at(encoder, t[i]) + wp.uint32(32768)) >> wp.uint32(16))


@wp.kernel
def time_events(t: wp.array(dtype=wp.int64), middle: wp.int64, start: int, time: wp.array(dtype=float)):
    """Compute the time of each event from the middle of the window [s]."""
    i = start + wp.tid()
    time[i] = float(int(t[i] - middle)) * 1.0e-6


@wp.kernel
def layer_events(
    p: wp.array(dtype=wp.uint8), parts: int, per_polarity: int, start: int, layer: wp.array(dtype=wp.uint8)
):
    """Assign an image to each event: by its part (event i belongs to part i modulo ``parts``), then by its polarity."""
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
    """Compute a sort key of each event: bin of the prism angle, pixel and polarity, in that order."""
    i = start + wp.tid()
    bin_of = wp.int64((wp.uint32(turn[i]) * wp.uint32(bins)) >> wp.uint32(16))
    pixel = (wp.int64(y[i]) << wp.int64(16)) | wp.int64(x[i])
    keys[i] = (bin_of << wp.int64(33)) | (pixel << wp.int64(1)) | wp.int64(wp.where(layer[i] != wp.uint8(0), 1, 0))


@wp.kernel
def unfold_keys(keys: wp.array(dtype=wp.int64), bins: int, start: int, events: EventArrays):
    """Recover the events from their sort keys; the prism angle becomes the middle of its bin."""
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
    """Add the votes of one point per thread to the image, and check every addition for overflow."""
    i = start + wp.tid()
    layer = int(layers[i]) * canvas.layer
    _inside, cell, word = vote_at(canvas, x[i], y[i], layer)
    add_vote_atomically(cells, cell, canvas.columns, word)


@wp.kernel
def vote_point_blocks(
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    layers: wp.array(dtype=wp.uint8),
    canvas: Canvas,
    start: int,
    cells: Cells,
):
    """Vote one block of points per thread. For CPUs."""
    first = (start + wp.tid()) * BLOCK
    places = wp.zeros(shape=(64,), dtype=int)
    words = wp.zeros(shape=(64,), dtype=wp.uint64)
    for k in range(BLOCK):
        layer = int(load_uint8(layers, first + k)) * canvas.layer
        _inside, cell, word = vote_at(canvas, load_float(x, first + k), load_float(y, first + k), layer)
        store_int(places, k, cell)
        store_word(words, k, word)
    for k in range(BLOCK):
        add_vote_unshared(cells, places[k], canvas.columns, words[k])


@wp.kernel
def drift_turns(
    base: wp.array(dtype=wp.uint16),
    slope: wp.array(dtype=float),
    drift: float,
    start: int,
    turn: wp.array(dtype=wp.uint16),
):
    """Compute theta_u16 after a parameter has changed by ``drift``.

    ``slope`` is the derivative of the angle by the parameter [1/65536 turn per unit].
    """
    i = start + wp.tid()
    turn[i] = wp.uint16((int(base[i]) + int(wp.floor(drift * slope[i] + 0.5))) & 65535)


for _struct in MODEL_STRUCTS:
    wp.overload(vote_blocks, {"model": _struct})
    wp.overload(vote_rotating_camera, {"model": _struct})
    for _camera in (PinholeParams, CameraParams):
        wp.overload(vote_events, {"model": _struct, "camera": _camera})
        wp.overload(vote_quickly, {"model": _struct, "camera": _camera})
