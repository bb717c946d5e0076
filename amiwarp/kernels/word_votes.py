"""Votes into the image of warped events (IWE) on CUDA: one 64-bit addition per event, nearest or bilinear.

A cell is the square between four pixel centres. Its word holds four sums over the events in it: their number n, and the
sums fx, fy and b of x, y and x y in the cell [1/256]. They give the sums of the weights of
:mod:`amiwarp.kernels.votes`. Because the sums are integers, the image does not depend on the order of events and is
bit-identical on every run.

A word overflows after 1,023 events. Either each carry out of a field is added exactly to 64-bit totals at once; or,
faster, words are emptied in time and checked afterwards: see :mod:`amiwarp.imaging.iwe`.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams
from amiwarp.kernels.camera_rotation import CameraRotationParams, undo_camera_rotation
from amiwarp.kernels.events_with_angles import EventsWithAngles, stored_state
from amiwarp.kernels.native_code import load_uint8, load_uint16
from amiwarp.kernels.refraction import displace, state_of
from amiwarp.kernels.votes import Canvas, cell_at, dither_offset

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Number of words for votes outside the image, large enough that no word overflows
TRASH = wp.constant(4096)
CAPACITY = wp.constant(1024)  # number of events at which a word overflows
FIELD_CARRY = wp.constant(wp.int64(1 << 18))  # value of a carry out of the fields fx, fy, b
ONE_EVENT = wp.constant(wp.uint64(1 << 54))  # one event in the field n
# Highest bit of each field
CARRIES = wp.constant(wp.uint64((1 << 63) | (1 << 53) | (1 << 35) | (1 << 17)))


@wp.struct
class Cells:
    """Words of the vote cells of one image, then the trash words, and the totals to which overflows are added."""

    words: wp.array(dtype=wp.uint64)
    totals: wp.array(dtype=wp.int64)


@wp.func
def add_to_totals(
    cells: Cells, cell: int, width: int, n: wp.int64, fx: wp.int64, fy: wp.int64, b: wp.int64
):
    """Add the moments of a cell, in the units of its word, to the 64-bit totals of its four pixels."""
    wp.atomic_add(cells.totals, cell, wp.int64(256) * n - fx - fy + b)
    wp.atomic_add(cells.totals, cell + 1, fx - b)
    wp.atomic_add(cells.totals, cell + width, fy - b)
    wp.atomic_add(cells.totals, cell + width + 1, b)


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
    add_to_totals(
        cells, cell, width, n, FIELD_CARRY * fx, FIELD_CARRY * fy - fx, FIELD_CARRY * b - fy
    )


@wp.func
def add_vote_atomically(cells: Cells, cell: int, width: int, word: wp.uint64):
    """Add a vote to a word with an atomic addition, and move its carries to the totals."""
    old = wp.atomic_add(cells.words, cell, word)
    carry = ((old & word) | ((old | word) & (~(old + word)))) & CARRIES
    if carry != wp.uint64(0):
        add_carries_to_totals(cells, cell, width, carry)


@wp.func
def vote_at(canvas: Canvas, x: float, y: float, layer: int):
    """Return whether a position lies on the canvas, its cell and its word; the word is empty if it does not."""
    inside, cell, fx, fy, b = cell_at(canvas, x, y, layer)
    word = (
        (wp.uint64(b) << wp.uint64(36))
        | (wp.uint64(fy) << wp.uint64(18))
        | wp.uint64(fx)
        | ONE_EVENT
    )
    return inside, cell, wp.where(inside == 1, word, wp.uint64(0))


@wp.func
def event_state(model: Any, events: EventsWithAngles, i: int):
    """Return the optic's state at event ``i``."""
    a, b = stored_state(model, events, i)
    w0, w1 = state_of(model, a, b)
    return w0, w1


@wp.func
def repeat_vote(events: EventsWithAngles, i: int, word: wp.uint64) -> wp.uint64:
    """Return the word of an event's vote times its ``weight``: at most 255, so that no field overflows."""
    if events.weight.shape[0] == 0:
        return word
    return word * wp.uint64(events.weight[i])


@wp.func
def event_vote(model: Any, camera: Any, events: EventsWithAngles, canvas: Canvas, i: int):
    """Compute prism angle, displacement and vote of one event."""
    w0, w1 = event_state(model, events, i)
    x, y = displace(
        model, camera, float(load_uint16(events.x, i)), float(load_uint16(events.y, i)), w0, w1
    )
    dx, dy = dither_offset(i)
    layer = int(load_uint8(events.layer, i)) * canvas.layer
    inside, cell, word = vote_at(canvas, x + canvas.dither * dx, y + canvas.dither * dy, layer)
    return inside, cell, word


@wp.kernel
def vote_events(
    model: Any, camera: Any, events: EventsWithAngles, canvas: Canvas, start: int, cells: Cells
):
    """Vote one event per thread, with a check of every addition for overflow."""
    i = start + wp.tid()
    _inside, cell, word = event_vote(model, camera, events, canvas, i)
    add_vote_atomically(cells, cell, canvas.columns, repeat_vote(events, i, word))


@wp.kernel
def vote_rotating_camera(
    model: Any,
    camera: CameraParams,
    events: EventsWithAngles,
    canvas: Canvas,
    camera_rotation: CameraRotationParams,
    start: int,
    cells: Cells,
):
    """Vote one event per thread, exactly, with the camera's rotation removed."""
    i = start + wp.tid()
    w0, w1 = event_state(model, events, i)
    x, y = displace(model, camera, float(events.x[i]), float(events.y[i]), w0, w1)
    xy = undo_camera_rotation(camera, wp.vec2(x, y), camera_rotation, events.time[i])
    dx, dy = dither_offset(i)
    layer = int(events.layer[i]) * canvas.layer
    _inside, cell, word = vote_at(
        canvas, xy[0] + canvas.dither * dx, xy[1] + canvas.dither * dy, layer
    )
    add_vote_atomically(cells, cell, canvas.columns, word)


@wp.kernel
def vote_quickly(
    model: Any,
    camera: Any,
    events: EventsWithAngles,
    canvas: Canvas,
    trash: int,
    start: int,
    cells: Cells,
):
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
