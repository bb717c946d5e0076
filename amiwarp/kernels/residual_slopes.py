"""Derivatives of the residuals of event pairs by the parameters, and what their factors are made of."""

import warp as wp

from amiwarp.kernels.equations import Atlas, Geometry, Pairs, difference
from amiwarp.kernels.native_code import load_float, store_float

wp.set_module_options({"enable_backward": False})


@wp.kernel
def slope_between(
    pairs: Pairs,
    atlas: Atlas,
    plus: Geometry,
    minus: Geometry,
    image: wp.array(dtype=float),
    width: float,
    start: int,
    slope: wp.array(dtype=float),
):
    """Compute the derivative of the residuals, by a difference over ``width`` between two geometries.

    It is 0 for a pair that is off the map in either geometry.
    """
    i = start + wp.tid()
    change = difference(image, atlas, pairs, minus, i) - difference(image, atlas, pairs, plus, i)
    slope[i] = wp.where(plus.cell[i] >= 0 and minus.cell[i] >= 0, change / width, 0.0)


@wp.kernel
def slope_of_changes(
    plus: wp.array(dtype=float),
    minus: wp.array(dtype=float),
    width: float,
    start: int,
    slope: wp.array(dtype=float),
):
    """Compute the derivative of the residuals from two changes of brightness, over ``width``; 0 if either is NaN."""
    i = start + wp.tid()
    change = load_float(minus, i) - load_float(plus, i)
    store_float(slope, i, wp.where(change == change, change / width, 0.0))


@wp.kernel
def multiply(
    a: wp.array(dtype=float), b: wp.array(dtype=float), start: int, out: wp.array(dtype=float)
):
    """Multiply two arrays element by element."""
    i = start + wp.tid()
    out[i] = a[i] * b[i]


@wp.kernel
def by_shift(
    first: wp.array(dtype=float),
    second: wp.array(dtype=float),
    shift: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=float),
):
    """Compute derivatives by a factor of ``shift``, changes of the angles at the ends of pairs, like ``Pairs.slope``.

    ``first`` and ``second`` are the derivatives by the angle at either end.
    """
    i = start + wp.tid()
    out[i] = first[i] * shift[i] + second[i] * shift[first.shape[0] + i]


@wp.kernel
def split_by_time(
    pairs: Pairs,
    middle: float,
    spread: float,
    gap: float,
    start: int,
    late: wp.array(dtype=float),
    is_long: wp.array(dtype=float),
):
    """Compute how far the mean time of each pair is from ``middle``, in units of ``spread``.

    ``is_long`` is 1 for pairs with a longer gap than ``gap``, else 0. Times are in seconds.
    """
    i = start + wp.tid()
    first = pairs.time[i]
    second = pairs.time[pairs.stride + i]
    late[i] = (0.5 * (first + second) - middle) / spread
    is_long[i] = wp.where(second - first > gap, 1.0, 0.0)


@wp.kernel
def angle_patterns(pairs: Pairs, cx: float, cy: float, start: int, out: wp.array2d(dtype=float)):
    """Compute patterns of errors of the prism's angle, at both events of each pair.

    The six rows of ``out`` are cosine and sine of the encoder's angle and of twice the angle, and the pixel's distance
    from the image's middle along x and along y [px]. Each has the form of ``Pairs.slope``.
    """
    i = start + wp.tid()
    for k in range(2):
        at = k * pairs.stride + i
        c = pairs.azimuth[2 * k * pairs.stride + i]
        s = pairs.azimuth[(2 * k + 1) * pairs.stride + i]
        out[0, at] = c
        out[1, at] = s
        out[2, at] = c * c - s * s
        out[3, at] = 2.0 * c * s
        out[4, at] = float(pairs.x[i]) - cx
        out[5, at] = float(pairs.y[i]) - cy


@wp.kernel
def by_sector(
    pairs: Pairs,
    angle: int,
    first: wp.array(dtype=float),
    second: wp.array(dtype=float),
    start: int,
    out: wp.array2d(dtype=float),
):
    """Compute derivatives by an offset of an angle in each of its sectors. ``out`` has a row for each sector.

    ``first`` and ``second`` are the derivatives by the angle at either end of a pair; NaN counts as 0. ``angle`` is the
    number of the angle of two; -1 for the only one, of which the pairs store cosine and sine.
    """
    i = start + wp.tid()
    sectors = out.shape[0]
    for k in range(sectors):
        out[k, i] = 0.0
    for end in range(2):
        part = 2 * end * pairs.stride + i
        if angle < 0:
            turned = wp.atan2(pairs.azimuth[part + pairs.stride], pairs.azimuth[part])
        else:
            turned = pairs.azimuth[part + angle * pairs.stride]
        turns = turned / (2.0 * wp.pi)
        sector = wp.min(int((turns - wp.floor(turns)) * float(sectors)), sectors - 1)
        slope = wp.where(end == 0, first[i], second[i])
        if slope == slope:
            out[sector, i] = out[sector, i] + slope
