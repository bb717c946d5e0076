"""Which nodes of a map the events determine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.brightness.solver import BrightnessMap

LEAST_COVERAGE = 0.5
"""Smallest sum of equation weights at a node that counts as known."""
HOLDS_SCALE, LEAST_AGREEMENT = 0.25, 0.4
"""A node is known only if enough of the equations around it hold.

HOLDS_SCALE: residual at which an equation gets half weight [thresholds]. LEAST_AGREEMENT: smallest ratio of the sum
with these weights to the sum with full weights.
"""
SMALLEST_REGION = 12
"""Smallest region of known pixels [px]; smaller ones are noise."""
LARGEST_HOLE = 4
"""Largest hole of unknown pixels inside a known region that is set to known [px]: equations surround it."""


def known_nodes(solver: BrightnessMap) -> NDArray[np.bool_]:
    """Return the nodes that events determine: enough equations hold there, and most of those that exist."""
    hold, everything = solver.coverage(HOLDS_SCALE)[0], solver.coverage(1e6)[0]
    return without_small_holes(without_small_regions((hold >= LEAST_COVERAGE) & (hold >= LEAST_AGREEMENT * everything)))


def dilated(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Return the mask, extended ``by`` times to the direct neighbours."""
    for _ in range(by):
        out = mask.copy()
        for one, other in ((out, mask), (out.T, mask.T)):
            one[1:] |= other[:-1]
            one[:-1] |= other[1:]
        mask = out
    return mask


def without_small_regions(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask without regions of fewer than :data:`SMALLEST_REGION` pixels."""
    label, count = ndimage.label(known)
    size = np.bincount(label.ravel(), minlength=count + 1)
    size[0] = 0
    return np.asarray((size >= SMALLEST_REGION)[label])


def without_small_holes(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask with holes of up to :data:`LARGEST_HOLE` pixels closed."""
    label, count = ndimage.label(~known)
    size = np.bincount(label.ravel(), minlength=count + 1)
    return np.asarray(known | (size[label] <= LARGEST_HOLE))
