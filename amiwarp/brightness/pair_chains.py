"""Chains of event pairs on a CPU: positions that successive pairs share are stored once."""

from __future__ import annotations

from typing import Any

import warp as wp

from amiwarp.kernels.launch import launch
from amiwarp.kernels.pair_chains import BLOCK, Chains, make_chains, weigh_chains

FEW_BLOCKS = 256
"""Smallest number of blocks of pairs for which a second CPU thread is used."""


class PairChains:
    """Positions of pairs on a map in chains. On CUDA it holds nothing and does nothing."""

    def __init__(self, stride: int, device: Any) -> None:
        """Allocate the arrays for ``stride`` pairs, a whole number of blocks."""
        self._on_cpu = device.is_cpu
        self.blocks = stride // int(BLOCK)
        """Number of blocks of pairs."""
        self.arrays = Chains()
        """Columns of the positions: the kernels' struct ``Chains``."""
        blocks = self.blocks if device.is_cpu else 0
        for name, dtype in (("cell", int), ("x", float), ("y", float), ("weight", float)):
            setattr(self.arrays, name, wp.empty(2 * int(BLOCK) * blocks, dtype=dtype, device=device))
        self.arrays.count = wp.empty(blocks, dtype=int, device=device)
        self.arrays.end = wp.empty(int(BLOCK) * blocks, dtype=wp.uint8, device=device)

    def join(self, geometry: Any) -> None:
        """Take the positions of ``geometry``, and join pairs that begin where the pair before them ends."""
        if self._on_cpu:
            inputs = [geometry.cell, geometry.part, geometry.stride]
            launch(make_chains, self.blocks, inputs, [self.arrays], device="cpu", smallest=FEW_BLOCKS)

    def add_weights(self, program: Any, weight: Any) -> None:
        """Add to ``program`` the step that takes the weights of the pairs."""
        if self._on_cpu:
            program.add(weigh_chains, self.blocks, [weight], [self.arrays], smallest=FEW_BLOCKS)
