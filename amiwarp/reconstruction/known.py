"""Decision which nodes of a brightness map the events determine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from amiwarp.kernels import known_nodes as kernels
from amiwarp.kernels.launch import launch, load
from amiwarp.kernels.regions import find_large_regions
from amiwarp.kernels.regions_by_node import drop_small_regions

if TYPE_CHECKING:
    from amiwarp.brightness.solver import BrightnessMap

LEAST_COVERAGE = 0.5
"""Smallest sum of equation weights at a node that counts as known."""
HOLDS_SCALE, LEAST_AGREEMENT = 0.25, 0.4
"""Residual [thresholds] at which an equation gets half weight, and smallest ratio of the sum of these weights to the
sum of full weights at a known node.

A node is known only if enough of the equations around it hold.
"""
SMALLEST_REGION = 12
"""Smallest number of pixels of a connected known region, at most 16; smaller regions are noise."""
LARGEST_HOLE = 4
"""Largest hole of unknown pixels inside a known region that is marked as known [px], because equations surround the
hole."""


def known_nodes(solver: BrightnessMap) -> wp.array:
    """Return 1 for the nodes that events determine, else 0: uint8, shape (rows, columns), on the device.

    These are nodes with enough equations, most of which hold.
    """
    hold, everything = (solver.coverage_on_device(scale) for scale in (HOLDS_SCALE, 1e6))
    known = wp.empty((solver.tiles.rows, solver.tiles.columns), dtype=wp.uint8, device=solver.device)
    inputs = [hold, everything, LEAST_COVERAGE, LEAST_AGREEMENT]
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
        launch(drop_small_regions, mask.size, [mask, value, least], [out], device=mask.device)
        return out
    large = np.zeros(mask.shape, np.uint8)
    arrays = [wp.array(array, device="cpu", copy=False) for array in (mask.numpy() ^ np.uint8(1 - value), large)]
    load(find_large_regions, mask.device)
    wp.launch(find_large_regions, 1, [arrays[0], least, arrays[1]], device="cpu")
    return wp.array(large ^ np.uint8(1 - value), device="cpu", copy=False)
