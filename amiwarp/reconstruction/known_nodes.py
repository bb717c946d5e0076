"""Which nodes of a brightness map the events determine."""

from __future__ import annotations

import numpy as np
import warp as wp

from amiwarp.brightness.solver import BrightnessMap
from amiwarp.kernels import known_nodes as kernels
from amiwarp.kernels import mask_regions
from amiwarp.kernels.launch import launch
from amiwarp.kernels.loading import load

LEAST_COVERAGE = 0.5
"""Smallest sum of equation weights at a node that counts as known."""
HOLDS_SCALE = 0.25
"""Residual at which an equation gets half weight when it is asked whether the equations at a node hold [thresholds]."""
LEAST_AGREEMENT = 0.4
"""Smallest ratio of the sum of these weights to the sum of full weights at a known node."""
FULL_SCALE = 1e6
"""The same residual for full weights: so large that all equations have them."""
SMALLEST_REGION = 12
"""Smallest number of pixels of a connected known region, at most 16; smaller regions are noise."""
LARGEST_HOLE = 4
"""Largest hole of unknown pixels inside a known region that is marked as known [px], because equations surround the
hole."""


def known_nodes(solver: BrightnessMap) -> wp.array:
    """Return 1 for the nodes that events determine, else 0: uint8, shape (rows, columns), on the device.

    These are nodes with enough equations, most of which hold.
    """
    hold = solver.coverage_on_device(HOLDS_SCALE)
    full = solver.coverage_on_device(FULL_SCALE)
    shape = (solver.tiles.rows, solver.tiles.columns)
    known = wp.empty(shape, dtype=wp.uint8, device=solver.device)
    inputs = [hold, full, LEAST_COVERAGE, LEAST_AGREEMENT]
    launch(kernels.mark_known, known.size, inputs, [known.flatten()], device=solver.device)
    return without_small_holes(without_small_regions(known))


def nodes_near(known: wp.array, by: int) -> wp.array:
    """Return 1 for the nodes at most ``by`` steps from known ones, else 0, shape (nodes,); all 1 if none is known.

    Steps go along rows and columns.
    """
    found = wp.zeros(1, dtype=int, device=known.device)
    launch(kernels.find_marked, known.size, [known.flatten()], [found], device=known.device)
    out = wp.empty(known.size, dtype=wp.uint8, device=known.device)
    launch(kernels.widen, known.size, [known, found, by], [out], device=known.device)
    return out


def without_small_regions(known: wp.array) -> wp.array:
    """Return the mask without connected regions of fewer than :data:`SMALLEST_REGION` pixels."""
    return _without_small(known, 1, SMALLEST_REGION)


def without_small_holes(known: wp.array) -> wp.array:
    """Return the mask with holes of up to :data:`LARGEST_HOLE` pixels filled."""
    return _without_small(known, 0, LARGEST_HOLE + 1)


def _without_small(mask: wp.array, value: int, least: int) -> wp.array:
    """Return the mask without regions of ``value`` that have fewer than ``least`` pixels."""
    if mask.device.is_cuda:
        out = wp.empty_like(mask)
        inputs = [mask, value, least]
        launch(mask_regions.drop_small_regions, mask.size, inputs, [out], device=mask.device)
        return out
    # The kernel finds regions of ones: regions of zeros are found in the inverted mask.
    inverted = np.uint8(1 - value)
    regions = wp.array(mask.numpy() ^ inverted, device="cpu", copy=False)
    large = np.zeros(mask.shape, np.uint8)
    out = wp.array(large, device="cpu", copy=False)
    load(mask_regions.find_large_regions, mask.device)
    wp.launch(mask_regions.find_large_regions, 1, [regions, least, out], device="cpu")
    return wp.array(large ^ inverted, device="cpu", copy=False)
