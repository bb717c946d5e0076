"""Values of a reconstructed picture."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def exponentiate(log: wp.array2d(dtype=float), contrast: float, out: wp.array2d(dtype=float)):
    """Compute relative linear intensity from log intensity in units of the threshold ``contrast``."""
    i, j = wp.tid()
    out[i, j] = wp.exp(contrast * log[i, j])
