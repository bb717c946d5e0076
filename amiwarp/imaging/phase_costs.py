"""Cost of orbits: what the scenes that fit sums in phase best leave of them, for some tiles together."""

from __future__ import annotations

import math

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.imaging.bessel import BESSEL_STEP, bessel_table
from amiwarp.imaging.phase import shared_pairs
from amiwarp.kernels.launch import launch
from amiwarp.kernels.phase_cost import tile_costs

DAMPING = 0.01
"""Weight of a flat scene, relative to one squared sum in phase."""
LONGEST_WAVES = 0.15
"""Spatial frequency of the longest waves that count [rad/px]: longer ones hardly fit into a tile."""


def orbit_costs(
    spectra: NDArray[np.complex64], orbits: NDArray[np.complex64], finest: float
) -> NDArray[np.float64]:
    """Return the cost of some candidates over all tiles, 0 to 1, shape (candidates,).

    Takes the same arguments as :func:`tile_squares`.
    """
    left, total = tile_squares(spectra, orbits, finest)
    return np.asarray(left.sum(axis=1) / np.maximum(total.sum(axis=1), 1e-30))


def tile_squares(
    spectra: NDArray[np.complex64],
    orbits: NDArray[np.complex64],
    finest: float,
    *,
    damping: float = DAMPING,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the squares that the best scene of each tile leaves of its sums, and the squares of the sums.

    Both have the shape (candidates, tiles). ``spectra`` are the Fourier transforms of the windowed sums of each tile,
    shape (tiles, harmonics, side, side). ``orbits`` has the rotations of each tile's middle with and against the angle
    [px], shape (candidates, tiles, 2). ``finest`` is the spatial frequency of the finest waves that count [rad/px], and
    ``damping`` the weight of a flat scene: with more of it, small orbits come out larger.
    """
    tiles, harmonics = spectra.shape[:2]
    reach = float(np.abs(orbits).sum(axis=2).max())
    # In steps of 10, so that candidates share tables.
    steps = 10.0 * math.ceil(0.1 * finest * reach + 0.1)
    table = bessel_table(harmonics, steps)
    out = np.empty((len(orbits), tiles, 2))
    inputs = [
        shared_pairs(spectra),
        shared_pairs(orbits),
        wp.array(table, dtype=float, device="cpu", copy=False),
        1.0 / BESSEL_STEP,
        damping,
        LONGEST_WAVES,
        finest,
    ]
    written = wp.array(out, dtype=wp.vec2d, device="cpu", copy=False)
    launch(tile_costs, len(orbits) * tiles, inputs, [written], device="cpu", smallest=1)
    return out[..., 0], out[..., 1]
