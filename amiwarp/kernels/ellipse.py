"""Ellipse model: a table of the displacement's offset and first harmonic at each observed pixel, and its fit."""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, PinholeParams, invalid_pixel
from amiwarp.kernels.refraction import compensate, deflect, displace, inverted

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class EllipseParams:
    """Ellipse model: table of the displacement's offset and first harmonic for each pixel."""

    phase: float  # phase of the prism angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    # Per pixel [px]: offset (x, y), factor of cos (x, y), factor of sin (x, y)
    table: wp.array3d(dtype=float)


@wp.func
def ellipse_displacement(m: EllipseParams, row: int, col: int, w0: float, w1: float):
    """Return the displacement of a whole pixel by the ellipse model [px]."""
    x = m.table[row, col, 0] + m.table[row, col, 2] * w0 + m.table[row, col, 4] * w1
    return x, m.table[row, col, 1] + m.table[row, col, 3] * w0 + m.table[row, col, 5] * w1


@wp.func
def interpolate_ellipses(m: EllipseParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the displacement [px] between whole pixels: bilinear, constant beyond the border."""
    x = wp.clamp(xy[0], 0.0, float(m.table.shape[1] - 1))
    y = wp.clamp(xy[1], 0.0, float(m.table.shape[0] - 1))
    col = wp.min(int(x), wp.max(m.table.shape[1] - 2, 0))
    row = wp.min(int(y), wp.max(m.table.shape[0] - 2, 0))
    total = wp.vec2(0.0, 0.0)
    for k in range(4):
        across = wp.min(col + k % 2, m.table.shape[1] - 1)
        down = wp.min(row + k / 2, m.table.shape[0] - 1)
        dx, dy = ellipse_displacement(m, down, across, w[0], w[1])
        weight = (1.0 - wp.abs(x - float(col + k % 2))) * (1.0 - wp.abs(y - float(row + k / 2)))
        total += wp.vec2(dx, dy) * weight
    return total


@wp.func
def compensate(model: EllipseParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the compensated pixel by the ellipse model."""
    if not (wp.length(xy) < 1.0e9):  # a NaN pixel must not become an index
        return invalid_pixel()
    col = int(xy[0])
    row = int(xy[1])
    inside = col >= 0 and row >= 0 and col < model.table.shape[1] and row < model.table.shape[0]
    if inside and float(col) == xy[0] and float(row) == xy[1]:
        dx, dy = ellipse_displacement(model, row, col, w[0], w[1])
        return xy + wp.vec2(dx, dy)
    return xy + interpolate_ellipses(model, xy, w)


@wp.func
def deflect(model: EllipseParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:
    """Return the observed pixel by the ellipse model.

    The table belongs to the observed pixel, so that a fixed-point iteration solves for it.
    """
    return inverted(model, camera, xy, w)


@wp.func
def displace(model: EllipseParams, camera: PinholeParams, x: float, y: float, w0: float, w1: float):
    """Return the compensated position by the ellipse model, for a camera without distortion."""
    dx, dy = ellipse_displacement(model, int(y), int(x), w0, w1)
    return x + dx, y + dy


@wp.kernel
def fit_harmonics(
    model: Any,
    camera: CameraParams,
    angles: wp.array(dtype=wp.vec2),
    start: int,
    table: wp.array3d(dtype=float),
):
    """Fit offset and first harmonic of the displacement of one pixel per thread, by Fourier sums.

    ``angles`` holds the (cos, sin) of evenly spaced tilt azimuths.
    """
    pixel = start + wp.tid()
    row, col = pixel // table.shape[1], pixel % table.shape[1]
    xy = wp.vec2(float(col), float(row))
    mean = wp.vec2(0.0, 0.0)
    c = wp.vec2(0.0, 0.0)
    s = wp.vec2(0.0, 0.0)
    for k in range(angles.shape[0]):
        w = angles[k]
        d = compensate(model, camera, xy, w) - xy
        mean += d
        c += d * w[0]
        s += d * w[1]
    n = float(angles.shape[0])
    for k in range(2):
        table[row, col, k] = mean[k] / n
        table[row, col, 2 + k] = c[k] * (2.0 / n)
        table[row, col, 4 + k] = s[k] * (2.0 / n)
