"""Decision which nodes of a brightness map the events determine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

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
    from scipy import ndimage

    label, count = ndimage.label(known)
    size = np.bincount(label.ravel(), minlength=count + 1)
    size[0] = 0
    return np.asarray((size >= SMALLEST_REGION)[label])


def without_small_holes(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask with holes of up to :data:`LARGEST_HOLE` pixels filled."""
    from scipy import ndimage

    label, count = ndimage.label(~known)
    size = np.bincount(label.ravel(), minlength=count + 1)
    return np.asarray(known | (size[label] <= LARGEST_HOLE))
