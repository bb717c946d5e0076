"""Rotations of directions, as three floats; see :mod:`amiwarp.kernels.refraction`."""

import warp as wp

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def rotate_by_deflection(
    x: float, y: float, z: float, w0: float, w1: float, sine: float, versine: float
):
    """Rotate a direction about z × w = (-w1, w0, 0) by Rodrigues' formula.

    A positive ``sine`` rotates the optical axis towards w.
    """
    d = w0 * x + w1 * y
    g = z * sine - d * versine
    return x + g * w0, y + g * w1, z - z * versine - d * sine


@wp.func
def sine_versine(a: float):
    """Return sine and 1 - cosine of an angle up to pi/2.

    Computed by their series, with equal bits on every device.
    """
    b = a * a
    s = 1.0 / 120.0 + b * (-1.0 / 5040.0 + b * (1.0 / 362880.0 - b / 39916800.0))
    v = 1.0 / 720.0 + b * (-1.0 / 40320.0 + b * (1.0 / 3628800.0 - b / 479001600.0))
    return a * (1.0 + b * (-1.0 / 6.0 + b * s)), b * (0.5 + b * (-1.0 / 24.0 + b * v))


@wp.func
def rotate(r: wp.mat33, x: float, y: float, z: float):
    """Return the matrix product r · (x, y, z)."""
    a = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
    b = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
    return a, b, r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
