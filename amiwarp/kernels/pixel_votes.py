"""Votes into the image of warped events (IWE) on a CPU: four sums of integers per event, nearest or bilinear.

An image has one 32-bit sum of weights, in units of 1/256 event, for each pixel. The weights are the weights of
:mod:`amiwarp.kernels.votes`, so that the image is the same as on CUDA to the last bit. They are integers: the image
does not depend on the order of events or the number of threads. Two sums next to each other are added as one 64-bit
word. The caller moves the sums to 64-bit totals before a sum can overflow, at the latest after :data:`CAPACITY` events.

Each thread votes a block of events in short loops, which the compiler vectorises if they contain no branch.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams
from amiwarp.kernels.camera_rotation import CameraRotationParams, undo_camera_rotation
from amiwarp.kernels.events_with_angles import EventsWithAngles, load_states
from amiwarp.kernels.native_code import (
    add_word_pairs,
    copy_bytes,
    copy_floats,
    load_float,
    load_int,
    load_uint8,
    load_uint16,
    store_float,
    store_int,
)
from amiwarp.kernels.plain_models import even, is_even, is_plain, plain
from amiwarp.kernels.refraction import displace, state_of
from amiwarp.kernels.votes import Canvas, cell_at, dither_offset

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK = wp.constant(64)  # number of events per thread
CAPACITY = (1 << 23) - 1  # number of events that the sums of all slices hold together in 31 bits


@wp.func
def displace_block(
    model: Any,
    camera: Any,
    events: EventsWithAngles,
    first: int,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
):
    """Compute the compensated positions of a block of events."""
    states = wp.zeros(shape=(128,), dtype=float)
    load_states(model, events, first, states)
    for k in range(BLOCK):
        w0, w1 = state_of(model, load_float(states, 2 * k), load_float(states, 2 * k + 1))
        i = first + k
        u, v = displace(
            model, camera, float(load_uint16(events.x, i)), float(load_uint16(events.y, i)), w0, w1
        )
        store_float(x, k, u)
        store_float(y, k, v)


@wp.func
def dither_block(canvas: Canvas, first: int, x: wp.array(dtype=float), y: wp.array(dtype=float)):
    """Add a random offset in the pixel to each position of a block, if the canvas wants it."""
    if canvas.dither != 0.0:
        for k in range(BLOCK):
            dx, dy = dither_offset(first + k)
            store_float(x, k, load_float(x, k) + canvas.dither * dx)
            store_float(y, k, load_float(y, k) + canvas.dither * dy)


@wp.func
def share_block(
    canvas: Canvas,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    layers: wp.array(dtype=wp.uint8),
    first: int,
    places: wp.array(dtype=int),
    shares: wp.array(dtype=int),
):
    """Compute the first pixel of each position's cell, and the shares of its four pixels [1/256]."""
    for k in range(BLOCK):
        layer = int(load_uint8(layers, first + k)) * canvas.layer
        _inside, cell, fx, fy, b = cell_at(canvas, load_float(x, k), load_float(y, k), layer)
        store_int(places, k, cell)
        store_int(shares, 4 * k, 256 - fx - fy + b)
        store_int(shares, 4 * k + 1, fx - b)
        store_int(shares, 4 * k + 2, fy - b)
        store_int(shares, 4 * k + 3, b)


@wp.func
def weigh_block(events: EventsWithAngles, first: int, shares: wp.array(dtype=int)):
    """Multiply the shares of each entry by the number of events that it stands for, if that is not one."""
    if events.weight.shape[0] != 0:
        for k in range(4 * BLOCK):
            store_int(shares, k, load_int(shares, k) * int(events.weight[first + k / 4]))


@wp.func
def vote_block(
    events: EventsWithAngles,
    canvas: Canvas,
    first: int,
    n: int,
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    sums: wp.array(dtype=int),
):
    """Vote the first ``n`` compensated positions of a block of events."""
    places = wp.zeros(shape=(64,), dtype=int)
    shares = wp.zeros(shape=(256,), dtype=int)
    dither_block(canvas, first, x, y)
    share_block(canvas, x, y, events.layer, first, places, shares)
    weigh_block(events, first, shares)
    add_word_pairs(sums, places, shares, canvas.columns, n)


@wp.kernel
def vote_event_blocks(
    model: Any,
    camera: Any,
    events: EventsWithAngles,
    canvas: Canvas,
    count: int,
    start: int,
    sums: wp.array(dtype=int),
):
    """Compensate and vote the events of one block per thread."""
    first = (start + wp.tid()) * BLOCK
    n = wp.min(BLOCK, count - first)
    x = wp.zeros(shape=(64,), dtype=float)
    y = wp.zeros(shape=(64,), dtype=float)
    if is_plain(model) == 1:
        displace_block(plain(model), camera, events, first, x, y)
    elif is_even(model) == 1:
        displace_block(even(model), camera, events, first, x, y)
    else:
        displace_block(model, camera, events, first, x, y)
    vote_block(events, canvas, first, n, x, y, sums)


@wp.kernel
def vote_rotating_camera_blocks(
    model: Any,
    camera: CameraParams,
    events: EventsWithAngles,
    canvas: Canvas,
    camera_rotation: CameraRotationParams,
    count: int,
    start: int,
    sums: wp.array(dtype=int),
):
    """Compensate and vote the events of one block per thread, with the camera's rotation removed."""
    first = (start + wp.tid()) * BLOCK
    n = wp.min(BLOCK, count - first)
    x = wp.zeros(shape=(64,), dtype=float)
    y = wp.zeros(shape=(64,), dtype=float)
    displace_block(model, camera, events, first, x, y)
    for k in range(n):
        xy = undo_camera_rotation(
            camera, wp.vec2(x[k], y[k]), camera_rotation, events.time[first + k]
        )
        store_float(x, k, xy[0])
        store_float(y, k, xy[1])
    vote_block(events, canvas, first, n, x, y, sums)


@wp.kernel
def vote_point_blocks(
    x: wp.array(dtype=float),
    y: wp.array(dtype=float),
    layers: wp.array(dtype=wp.uint8),
    canvas: Canvas,
    count: int,
    start: int,
    sums: wp.array(dtype=int),
):
    """Vote one block of points per thread."""
    first = (start + wp.tid()) * BLOCK
    n = wp.min(BLOCK, count - first)
    u = wp.zeros(shape=(64,), dtype=float)
    v = wp.zeros(shape=(64,), dtype=float)
    layer = wp.zeros(shape=(64,), dtype=wp.uint8)
    places = wp.zeros(shape=(64,), dtype=int)
    shares = wp.zeros(shape=(256,), dtype=int)
    copy_floats(u, x, first, n)
    copy_floats(v, y, first, n)
    copy_bytes(layer, layers, first, n)
    share_block(canvas, u, v, layer, 0, places, shares)
    add_word_pairs(sums, places, shares, canvas.columns, n)
