"""Events of many cameras: sorted by camera, then by time.

The kernels that simulate pixels write keys whose pixel counts through all cameras. They are converted to keys of
``part | camera | time | pixel | reversed lag | polarity``. The part is 0 for events of the chunk, 1 for later ones,
and 2 for events of cameras that start anew, which are dropped. Only a row scan needs the lag; without one, it is left
out.
"""

import warp as wp

from amiwarp.kernels.event_keys import OPTIONS, count_below
from amiwarp.kernels.pixels import LOW_BITS, LOW_MASK
from amiwarp.kernels.readout import LAG_BIT

wp.set_module_options(OPTIONS)


# Lowest bits of a key with a lag: reversed lag (19) and polarity (1)
CAMERA_LOW_BITS = wp.constant(wp.int64(20))


@wp.struct
class CameraKeys:
    """Layout of the keys of the events of many cameras, and the chunk that they belong to."""

    pixels: int  # number of pixels of a camera
    width: int  # width of a camera [px]
    shift: int  # bit position of the time in a key that counts through all pixels
    pixel: int  # bit position of the pixel in a key that is sorted by camera
    time: int  # bit position of the time in a key that is sorted by camera
    camera: int  # bit position of the camera
    part: int  # bit position of the part
    length: wp.int64  # length of the chunk [us]


@wp.func
def low_mask(layout: CameraKeys) -> wp.int64:
    """Return the mask of the bits below the pixel of a key that is sorted by camera."""
    return (wp.int64(1) << wp.int64(layout.pixel)) - wp.int64(1)


@wp.kernel(module="unique", module_options=OPTIONS)
def sort_by_camera(
    layout: CameraKeys, starts: wp.array(dtype=wp.uint8), keys: wp.array(dtype=wp.int64), start: int
):
    """Convert keys that count through the pixels of all cameras to keys that are sorted by camera."""
    i = start + wp.tid()
    t = keys[i] >> wp.int64(layout.shift)
    low = int(keys[i] & wp.int64(LOW_MASK))
    index = int((keys[i] - (t << wp.int64(layout.shift))) >> wp.int64(LOW_BITS))
    camera = index / layout.pixels
    part = wp.where(starts[camera] != wp.uint8(0), 2, wp.where(t < layout.length, 0, 1))
    key = wp.int64(part) << wp.int64(layout.part) | wp.int64(camera) << wp.int64(layout.camera)
    key = (
        key
        | t << wp.int64(layout.time)
        | wp.int64(index - camera * layout.pixels) << wp.int64(layout.pixel)
    )
    keys[i] = key | (wp.int64((low >> LAG_BIT) << 1 | (low & 1)) & low_mask(layout))


@wp.func
def camera_of(layout: CameraKeys, key: wp.int64) -> int:
    """Return the camera of a key that is sorted by camera."""
    return int(
        (key >> wp.int64(layout.camera))
        & ((wp.int64(1) << wp.int64(layout.part - layout.camera)) - wp.int64(1))
    )


@wp.func
def time_of(layout: CameraKeys, key: wp.int64) -> wp.int64:
    """Return the time of a key that is sorted by camera, since the start of its chunk [us]."""
    bits = wp.int64(layout.camera - layout.time)
    return (key >> wp.int64(layout.time)) & ((wp.int64(1) << bits) - wp.int64(1))


@wp.func
def pixel_of(layout: CameraKeys, key: wp.int64) -> int:
    """Return the pixel of a key that is sorted by camera, in its camera."""
    bits = wp.int64(layout.time - layout.pixel)
    return int((key >> wp.int64(layout.pixel)) & ((wp.int64(1) << bits) - wp.int64(1)))


@wp.kernel(module="unique", module_options=OPTIONS)
def carry_over(layout: CameraKeys, keys: wp.array(dtype=wp.int64), start: int):
    """Convert keys that are sorted by camera to keys of the next chunk that count through the pixels of all cameras.

    Counterpart of :func:`sort_by_camera`; the cause is lost, and without a row scan the lag.
    """
    i = start + wp.tid()
    key = keys[i]
    low = int(key & low_mask(layout))
    index = camera_of(layout, key) * layout.pixels + pixel_of(layout, key)
    t = time_of(layout, key) - layout.length
    kept = wp.int64((low >> 1) << LAG_BIT | (low & 1))
    keys[i] = t << wp.int64(layout.shift) | wp.int64(index) << wp.int64(LOW_BITS) | kept


@wp.kernel(module="unique", module_options=OPTIONS)
def find_cameras(
    layout: CameraKeys,
    keys: wp.array(dtype=wp.int64),
    n: int,
    cameras: int,
    start: int,
    found: wp.array(dtype=int),
):
    """Find the first event of each camera in ``n`` sorted keys, then the end of part 0, then the end of part 1."""
    k = start + wp.tid()
    limit = wp.int64(k) << wp.int64(layout.camera)
    if k >= cameras:
        limit = wp.int64(k - cameras + 1) << wp.int64(layout.part)
    found[k] = count_below(keys, n, limit)


@wp.kernel(module="unique", module_options=OPTIONS)
def unpack_cameras(
    layout: CameraKeys,
    keys: wp.array(dtype=wp.int64),
    origin: wp.int64,
    start: int,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
):
    """Convert keys that are sorted by camera to events. ``origin``: time of the start of the chunk [us]."""
    i = start + wp.tid()
    pixel = pixel_of(layout, keys[i])
    row = pixel / layout.width
    x[i] = wp.uint16(pixel - row * layout.width)
    y[i] = wp.uint16(row)
    t[i] = time_of(layout, keys[i]) + origin
    p[i] = wp.uint8(keys[i] & wp.int64(1))
