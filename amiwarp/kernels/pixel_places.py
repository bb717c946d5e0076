"""Places of pixels of a sensor in another image, looked up in a table of all pixels."""

import warp as wp

from amiwarp.kernels.native_code import (
    load_one_float,
    load_uint16,
    prefetch_float,
    store_float,
    store_uint8,
)

wp.set_module_options({"enable_backward": False})

AHEAD = wp.constant(16)
"""Number of events after which the place that is fetched now is needed."""


@wp.func
def is_in_image(x: float, y: float, width: int, height: int) -> bool:
    """Return whether a place lies on a pixel of an image; NaN does not."""
    in_columns = x >= -0.5 and x < float(width) - 0.5
    return in_columns and y >= -0.5 and y < float(height) - 0.5


@wp.func
def pixel_of(
    x: wp.array(dtype=wp.uint16), y: wp.array(dtype=wp.uint16), columns: int, i: int
) -> int:
    """Return the number of the pixel of an event, counted row by row."""
    return int(load_uint16(y, i)) * columns + int(load_uint16(x, i))


@wp.kernel
def look_up_places(
    places: wp.array(dtype=float),
    columns: int,
    image: wp.vec2i,
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    place_x: wp.array(dtype=float),
    place_y: wp.array(dtype=float),
    outside: wp.array(dtype=wp.uint8),
    count: int,
):
    """Look up the places of the first events, and whether they lie outside the image of that size.

    ``places`` holds x and y of each pixel of the sensor, row by row, next to each other: in one line of the cache.
    """
    i = int(0)
    while i < count:
        later = wp.min(i + AHEAD, count - 1)
        prefetch_float(places, 2 * pixel_of(x, y, columns, later))
        pixel = pixel_of(x, y, columns, i)
        found_x = load_one_float(places, 2 * pixel)
        found_y = load_one_float(places, 2 * pixel + 1)
        store_float(place_x, i, found_x)
        store_float(place_y, i, found_y)
        store_uint8(outside, i, wp.where(is_in_image(found_x, found_y, image[0], image[1]), 0, 1))
        i += 1
