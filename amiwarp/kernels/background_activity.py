"""Search for background activity: events without an earlier event at a neighbouring pixel."""

import warp as wp

wp.set_module_options({"enable_backward": False})

NEVER = wp.constant(wp.int64(-(2**63)))  # time of a pixel without events


@wp.func
def latest_nearby(latest: wp.array(dtype=wp.int64), pixel: int, stride: int) -> wp.int64:
    """Return the latest time of the eight neighbours of a pixel [us]."""
    side = wp.max(latest[pixel - 1], latest[pixel + 1])
    above, below = pixel - stride, pixel + stride
    row = wp.max(wp.max(latest[above - 1], latest[above]), latest[above + 1])
    return wp.max(wp.max(side, row), wp.max(wp.max(latest[below - 1], latest[below]), latest[below + 1]))


@wp.kernel
def mark_background(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    window_us: wp.int64,
    stride: int,
    latest: wp.array(dtype=wp.int64),
    background: wp.array(dtype=wp.bool),
):
    """Pass over all events in their order, in one thread. The surface of times has a border of one pixel."""
    for i in range(t.shape[0]):
        pixel = (int(y[i]) + 1) * stride + int(x[i]) + 1
        near = latest_nearby(latest, pixel, stride)
        background[i] = near == NEVER or t[i] - near > window_us
        latest[pixel] = t[i]
