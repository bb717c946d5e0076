"""Long waves of a picture from its gradient: what is done to each cosine wave and each pixel, and the median."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def weigh_waves(
    divergence: wp.array2d(dtype=float),
    detail: wp.array2d(dtype=float),
    by_divergence: wp.array2d(dtype=float),
    share: wp.array2d(dtype=float),
    start: int,
    out: wp.array2d(dtype=float),
):
    """Write what is added to one cosine wave of the detail: the wave of the gradient, in the place of its share."""
    i = wp.tid() + start
    row = i / out.shape[1]
    column = i % out.shape[1]
    own = share[row, column] * detail[row, column]
    out[row, column] = by_divergence[row, column] * divergence[row, column] - own


@wp.kernel
def add_waves(
    detail: wp.array2d(dtype=float),
    waves: wp.array2d(dtype=float),
    start: int,
    picture: wp.array2d(dtype=float),
    keys: wp.array(dtype=float),
):
    """Write the picture at one pixel, and once more among the keys, which are sorted for the median."""
    i = wp.tid() + start
    row = i / picture.shape[1]
    column = i % picture.shape[1]
    value = detail[row, column] + waves[row, column]
    picture[row, column] = value
    keys[i] = value


@wp.kernel
def take_median(ordered: wp.array(dtype=float), start: int, picture: wp.array2d(dtype=float)):
    """Subtract the median from one pixel. ``ordered`` begins with the sorted pixels."""
    i = wp.tid() + start
    count = picture.shape[0] * picture.shape[1]
    median = 0.5 * (ordered[(count - 1) / 2] + ordered[count / 2])
    picture[i / picture.shape[1], i % picture.shape[1]] -= median
