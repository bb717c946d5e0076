"""Shares of the events' votes in the image of warped events (IWE).

A vote goes to the four pixels around its position, the corners of a cell. The position in the cell is (x, y), in units
of 1/256, and b is x y. The four bilinear weights are 256 - x - y + b for the cell's first pixel, x - b for the next
column, y - b for the next row, and b for the pixel diagonally opposite. These are integers, so that their sums do not
depend on the order of events.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

MIX_1 = wp.constant(wp.uint32(0x85EBCA6B))  # multipliers of MurmurHash3's finaliser
MIX_2 = wp.constant(wp.uint32(0xC2B2AE35))


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


@wp.func
def events_of(votes: wp.int64) -> float:
    """Return a number of events from votes [1/256 event]."""
    return float(wp.float64(votes) / wp.float64(256.0))


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
    return float(int(h & wp.uint32(0xFFFF))) * scale - 0.5, float(
        int(h >> wp.uint32(16))
    ) * scale - 0.5


@wp.func
def cell_at(canvas: Canvas, x: float, y: float, layer: int):
    """Return whether a position lies on the canvas, its cell, and x, y and x y in the cell [1/256].

    A position off the canvas, or NaN, gets the place of cell 0's first pixel, which is outside the image.
    """
    u = (x + canvas.pad + 0.5) * canvas.scale + 0.5
    v = (y + canvas.pad + 0.5) * canvas.scale + 0.5
    inside = wp.where(u > 0.0, wp.where(u < float(canvas.columns - 1), 1, 0), 0)
    inside = wp.where(v > 0.0, wp.where(v < float(canvas.rows - 1), inside, 0), 0)
    # Nearest votes get whole positions, so that the first corner gets all 256.
    u = wp.where(inside == 1, wp.where(canvas.nearest != 0, wp.floor(u + 0.5), u), 0.0)
    v = wp.where(inside == 1, wp.where(canvas.nearest != 0, wp.floor(v + 0.5), v), 0.0)
    col = int(u)
    row = int(v)
    fx = int((u - float(col)) * 256.0 + 0.5)
    fy = int((v - float(row)) * 256.0 + 0.5)
    cell = row * canvas.columns + col + layer
    return inside, wp.where(inside == 1, cell, 0), fx, fy, (fx * fy + 128) >> 8
