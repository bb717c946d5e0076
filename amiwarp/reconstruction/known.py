"""Decision which nodes of a brightness map the events determine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from amiwarp.kernels.launch import load
from amiwarp.kernels.regions import find_large_regions

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.brightness.solver import BrightnessMap

LEAST_COVERAGE = 0.5
"""Smallest sum of equation weights at a node that counts as known."""
HOLDS_SCALE, LEAST_AGREEMENT = 0.25, 0.4
"""Residual [thresholds] at which an equation gets half weight, and smallest ratio of the sum of these weights to the
sum of full weights at a known node.

A node is known only if enough of the equations around it hold.
"""
SMALLEST_REGION = 12
"""Smallest number of pixels of a connected known region; smaller regions are noise."""
LARGEST_HOLE = 4
"""Largest hole of unknown pixels inside a known region that is marked as known [px], because equations surround the
hole."""


def known_nodes(solver: BrightnessMap) -> NDArray[np.bool_]:
    """Return the nodes that events determine: nodes with enough equations, most of which hold."""
    hold, everything = solver.coverage(HOLDS_SCALE)[0], solver.coverage(1e6)[0]
    return without_small_holes(without_small_regions((hold >= LEAST_COVERAGE) & (hold >= LEAST_AGREEMENT * everything)))


def dilated(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Extend the true regions of a mask by ``by`` px, along rows and columns."""
    for _ in range(by):
        out = mask.copy()
        for one, other in ((out, mask), (out.T, mask.T)):
            one[1:] |= other[:-1]
            one[:-1] |= other[1:]
        mask = out
    return mask


def without_small_regions(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask without connected regions of fewer than :data:`SMALLEST_REGION` pixels."""
    return _large_regions(known, SMALLEST_REGION)


def without_small_holes(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask with holes of up to :data:`LARGEST_HOLE` pixels filled."""
    return ~_large_regions(~known, LARGEST_HOLE + 1)


def _large_regions(mask: NDArray[np.bool_], least: int) -> NDArray[np.bool_]:
    """Return the connected regions of a mask of at least ``least`` pixels. The mask is on the host on any device."""
    large, cpu = np.zeros(mask.shape, np.bool_), wp.get_device("cpu")
    arrays = [wp.array(values.view(np.uint8), device=cpu, copy=False) for values in (np.ascontiguousarray(mask), large)]
    load(find_large_regions, cpu)
    wp.launch(find_large_regions, 1, [arrays[0], least, arrays[1]], device=cpu)
    return large
