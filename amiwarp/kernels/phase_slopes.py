"""The gradient of the log intensity from first sums in phase, and its divergence."""

import warp as wp

from amiwarp.kernels.phase_spectra import conjugate, times

wp.set_module_options({"enable_backward": False})


@wp.kernel
def write_slopes(
    first: wp.array(dtype=wp.vec2),
    forward: wp.array(dtype=wp.vec2),
    backward: wp.array(dtype=wp.vec2),
    turn: wp.array(dtype=wp.vec2),
    start: int,
    out: wp.array(dtype=wp.vec2),
):
    """Write the gradient at one pixel [thresholds/px], from its first sum.

    With the orbit a exp(iθ) + b exp(-iθ), ``forward`` and ``backward`` are a and b over \\|a\\|² - \\|b\\|² [1/px].
    ``turn`` holds cosine and sine of the lag of events. For waves much longer than the orbit,
    A_1 = i/2 (conj(g) a + g conj(b)).
    """
    i = wp.tid() + start
    # conj(g) a + g conj(b) = s, and its conjugate: two equations for g. s is -2i exp(i lag) times the first sum.
    s = times(wp.vec2(2.0 * turn[0][1], -2.0 * turn[0][0]), first[i])
    out[i] = times(conjugate(s), forward[i]) - times(s, backward[i])


@wp.kernel
def write_divergence(gradient: wp.array2d(dtype=wp.vec2), start: int, out: wp.array2d(dtype=float)):
    """Write the divergence of a gradient at one pixel, which is known between pixels, with no flow over the border."""
    i = wp.tid() + start
    height = out.shape[0]
    width = out.shape[1]
    y = i / width
    x = i % width
    here = gradient[y, x]
    total = float(0.0)
    if x + 1 < width:
        total += 0.5 * (gradient[y, x + 1][0] + here[0])
    if x > 0:
        total -= 0.5 * (here[0] + gradient[y, x - 1][0])
    if y + 1 < height:
        total += 0.5 * (gradient[y + 1, x][1] + here[1])
    if y > 0:
        total -= 0.5 * (here[1] + gradient[y - 1, x][1])
    out[y, x] = total


# As write_divergence, in a form that compilers vectorise
@wp.func_native("""
    const float* __restrict__ pairs = (const float*)gradient.data + 2 * (int64_t)y * width;
    const float* __restrict__ above = y > 0 ? pairs - 2 * (int64_t)width : pairs;
    const float* __restrict__ below = y + 1 < height ? pairs + 2 * (int64_t)width : pairs;
    float* __restrict__ to = (float*)out.data + (int64_t)y * width;
    const float into = y > 0 ? 0.5f : 0.0f;
    const float from = y + 1 < height ? 0.5f : 0.0f;
    for (int x = 0; x < width; ++x) {
        const float here = pairs[2 * x + 1];
        to[x] = from * (below[2 * x + 1] + here) - into * (here + above[2 * x + 1]);
    }
    if (width > 1) {
        to[0] += 0.5f * (pairs[2] + pairs[0]);
        to[width - 1] -= 0.5f * (pairs[2 * width - 2] + pairs[2 * width - 4]);
    }
    for (int x = 1; x + 1 < width; ++x)
        to[x] += 0.5f * (pairs[2 * x + 2] - pairs[2 * x - 2]);
""")
def divergence_of_line(
    gradient: wp.array2d(dtype=wp.vec2),
    y: int,
    width: int,
    height: int,
    out: wp.array2d(dtype=float),
):
    """Write the divergence of a gradient along a line."""


@wp.kernel
def write_divergence_lines(
    gradient: wp.array2d(dtype=wp.vec2), start: int, out: wp.array2d(dtype=float)
):
    """Write what :func:`write_divergence` does, for the pixels of a line; for CPUs."""
    divergence_of_line(gradient, wp.tid() + start, out.shape[1], out.shape[0], out)
