"""From the sums of windows to tensors.

A CPU thread computes a row of an image, a GPU thread a pixel: ``length`` pixels.
"""

import warp as wp

from amiwarp.kernels.native_code import load_int, load_int64, read_words, store_float, store_uint8
from amiwarp.kernels.tensors import EARLIEST, WHOLE, Grid

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def pixel_sum(
    grid: Grid, sums: wp.array(dtype=wp.int64), group: int, layer: int, y: int, x: int, end: int
) -> wp.int64:
    """Return one of the two sums of a pixel: ``end`` is 1 for the share of the interval's end, else 0."""
    row = (group * grid.layers + layer) * (grid.height + 2 * grid.border) + y + grid.border
    return load_int64(sums, 2 * (row * (grid.width + 2 * grid.border) + x + grid.border) + end)


@wp.kernel
def read_shares(
    sums: wp.array(dtype=wp.int64),
    grid: Grid,
    bins: int,
    length: int,
    start: int,
    out: wp.array(dtype=float),
):
    """Compute the bins of windows from the sums of the interval that starts there, and of the one that ends."""
    first = (start + wp.tid()) * length
    x, y = first % grid.width, (first / grid.width) % grid.height
    channel = first / (grid.width * grid.height)
    bin_of = channel % bins
    layer = (channel / bins) % grid.layers
    window = channel / bins / grid.layers
    group = window * grid.steps + bin_of
    for k in range(length):
        total = wp.int64(0)
        if bin_of < grid.steps:
            total += pixel_sum(grid, sums, group, layer, y, x + k, 0)
        if bin_of > 0:
            total += pixel_sum(grid, sums, group - 1, layer, y, x + k, 1)
        store_float(out, first + k, float(wp.float64(total) / wp.float64(WHOLE)))


@wp.kernel
def read_bins(
    words: wp.array(dtype=wp.int64),
    grid: Grid,
    bins: int,
    length: int,
    start: int,
    out: wp.array(dtype=float),
):
    """Compute all bins of ``length`` pixels of a window from their words, which are cleared on CPUs."""
    first = (start + wp.tid()) * length
    size = grid.width * grid.height
    window = first / size
    pixel = first % size
    start_of = window * grid.steps * grid.parts * size + pixel
    read_words(
        out,
        window * bins * size + pixel,
        words,
        grid.low,
        start_of,
        size,
        grid.steps,
        grid.parts,
        bins,
        length,
    )


@wp.kernel
def clip_counts(
    counts: wp.array(dtype=int),
    grid: Grid,
    limit: int,
    length: int,
    start: int,
    out: wp.array(dtype=wp.uint8),
):
    """Compute stacked histograms from the counts: the time bins of OFF events, then of ON events."""
    first = (start + wp.tid()) * length
    size = grid.width * grid.height
    channel = first / size
    bin_of = channel % grid.steps
    layer = (channel / grid.steps) % grid.layers
    image = (channel / grid.steps / grid.layers * grid.steps + bin_of) * grid.layers + layer
    for k in range(length):
        store_uint8(
            out, first + k, wp.min(load_int(counts, image * size + first % size + k), limit)
        )


@wp.kernel
def carry_latest(
    latest: wp.array(dtype=wp.int64),
    windows: int,
    size: int,
    earlier: wp.array(dtype=wp.int64),
    start: int,
):
    """Carry the latest times of earlier windows over to later ones, one pixel per thread."""
    pixel = start + wp.tid()
    before = earlier[pixel]
    for window in range(windows):
        before = wp.max(before, latest[window * size + pixel])
        latest[window * size + pixel] = before


@wp.struct
class Decay:
    """Decay of a time surface."""

    tau: wp.float64  # time constant [us]
    linear: int  # 1 if it is linear, 0 if it is exponential


@wp.func
def decayed(decay: Decay, elapsed: wp.int64) -> float:
    """Return the value of a time surface at a time after the latest event [us]; before it, the value is 1."""
    age = wp.float64(wp.max(elapsed, wp.int64(0))) / decay.tau
    if decay.linear == 1:
        return float(wp.max(wp.float64(1.0) - age, wp.float64(0.0)))
    return float(wp.exp(-age))


@wp.kernel
def decay_times(
    latest: wp.array(dtype=wp.int64),
    t_end: wp.array(dtype=wp.int64),
    size: int,
    decay: Decay,
    start: int,
    out: wp.array(dtype=float),
):
    """Compute the time surface: by exponential or linear decay of the latest times until the window's end."""
    i = start + wp.tid()
    out[i] = 0.0
    if latest[i] >= EARLIEST:
        out[i] = decayed(decay, t_end[i / size] - latest[i])


# Mean and standard deviation of the cells that are not zero.


@wp.func
def moments_of(value: wp.float64) -> wp.vec3d:
    """Return 1, the value and its square, or zeros if it is zero."""
    return wp.vec3d(
        wp.where(value != wp.float64(0.0), wp.float64(1.0), wp.float64(0.0)), value, value * value
    )


@wp.kernel
def sum_moments(values: wp.array2d(dtype=float), length: int, sums: wp.array2d(dtype=wp.vec3d)):
    """Sum the moments of ``length`` values of a row per thread, in order."""
    row, part = wp.tid()
    total = wp.vec3d()
    for k in range(part * length, wp.min((part + 1) * length, values.shape[1])):
        total += moments_of(wp.float64(values[row, k]))
    sums[row, part] = total


@wp.kernel
def add_moments(sums: wp.array2d(dtype=wp.vec3d), length: int, out: wp.array2d(dtype=wp.vec3d)):
    """Add up ``length`` sums of a row per thread, in order."""
    row, part = wp.tid()
    total = wp.vec3d()
    for k in range(part * length, wp.min((part + 1) * length, sums.shape[1])):
        total += sums[row, k]
    out[row, part] = total


@wp.kernel
def normalise(moments: wp.array2d(dtype=wp.vec3d), values: wp.array2d(dtype=float)):
    """Shift and scale the values of a row that are not zero to a mean of 0 and a standard deviation of 1.

    The standard deviation has n - 1 degrees of freedom. If it is 0, or there is only one value, only the mean is
    subtracted.
    """
    row, k = wp.tid()
    value = values[row, k]
    if value != 0.0:
        m = moments[row, 0]
        mean = m[1] / m[0]
        variance = wp.max(m[2] - m[1] * mean, wp.float64(0.0)) / wp.max(
            m[0] - wp.float64(1.0), wp.float64(1.0)
        )
        deviation = wp.where(variance > wp.float64(0.0), wp.sqrt(variance), wp.float64(1.0))
        values[row, k] = float((wp.float64(value) - mean) / deviation)
