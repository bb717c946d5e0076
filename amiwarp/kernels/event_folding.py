"""Events that share pixel, polarity and bin of the prism angle, counted as one: by sort keys that hold all of them."""

import warp as wp

from amiwarp.kernels.events_with_angles import EventsWithAngles

OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(OPTIONS)


@wp.kernel(module="unique", module_options=OPTIONS)
def fold_keys(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    layer: wp.array(dtype=wp.uint8),
    turn: wp.array(dtype=wp.uint16),
    bins: int,
    start: int,
    keys: wp.array(dtype=wp.int64),
):
    """Compute a sort key of each event: bin of the prism angle, pixel and polarity, in that order.

    ``layer`` must be a polarity, 0 or 1.
    """
    i = start + wp.tid()
    bin_number = wp.int64((wp.uint32(turn[i]) * wp.uint32(bins)) >> wp.uint32(16))
    pixel = (wp.int64(y[i]) << wp.int64(16)) | wp.int64(x[i])
    keys[i] = (
        (bin_number << wp.int64(33))
        | (pixel << wp.int64(1))
        | wp.int64(wp.where(layer[i] != wp.uint8(0), 1, 0))
    )


@wp.kernel(module="unique", module_options=OPTIONS)
def unfold_keys(keys: wp.array(dtype=wp.int64), bins: int, start: int, events: EventsWithAngles):
    """Recover the events from their sort keys; the prism angle becomes the middle of its bin."""
    i = start + wp.tid()
    key = keys[i]
    events.layer[i] = wp.uint8(key & wp.int64(1))
    events.x[i] = wp.uint16((key >> wp.int64(1)) & wp.int64(65535))
    events.y[i] = wp.uint16((key >> wp.int64(17)) & wp.int64(65535))
    bin_number = key >> wp.int64(33)
    events.turn[i] = wp.uint16((wp.int64(65536) * bin_number + wp.int64(32768)) / wp.int64(bins))
