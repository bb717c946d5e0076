"""Chains of event pairs on a CPU: positions that successive pairs share are stored once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from amiwarp.kernels import equation_blocks
from amiwarp.kernels.launch import launch
from amiwarp.kernels.pair_chains import BLOCK, Chains, make_chains, weigh_chains

if TYPE_CHECKING:
    from amiwarp.brightness.event_pairs import PairSet

FEW_BLOCKS = 256
"""Smallest number of blocks of pairs for which a second CPU thread is used."""


class PairChains:
    """Positions of pairs on a map in chains, and sums over the pairs' weighted equations on a CPU.

    The sums have a slice for each thread.
    """

    kernels = equation_blocks
    """Kernels over all equations."""

    def __init__(self, pairs: PairSet, atlas: Any, geometry: Any) -> None:
        """Allocate the arrays for ``pairs`` on the map of ``atlas``, whose positions ``geometry`` will hold."""
        self._pairs, self._atlas, self._geometry = pairs.arrays, atlas, geometry
        stride, device = pairs.arrays.stride, pairs.device
        self.threads = stride // int(BLOCK)
        """Number of threads of the kernels, each for a block of pairs."""
        self.arrays = Chains()
        """Columns of the positions: the kernels' struct ``Chains``."""
        for name, dtype in (("cell", int), ("x", float), ("y", float), ("weight", float)):
            setattr(self.arrays, name, wp.empty(2 * stride, dtype=dtype, device=device))
        self.arrays.count = wp.empty(self.threads, dtype=int, device=device)
        self.arrays.end = wp.empty(stride, dtype=wp.uint8, device=device)

    def take_positions(self) -> None:
        """Take the present positions, and join pairs that begin where the pair before them ends."""
        inputs = [self._geometry.cell, self._geometry.part, self._geometry.stride]
        launch(make_chains, self.threads, inputs, [self.arrays], device="cpu", smallest=FEW_BLOCKS)

    @property
    def inputs(self) -> list[Any]:
        """First inputs of the kernels that compute a value for each equation."""
        return [self._pairs, self._atlas, self._geometry, self.arrays]

    def add_product(self, program: Any, weight: Any, vector: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W A vector, for equations A with weights W."""
        self._add(program, equation_blocks.apply_normal, [weight, vector], slices)

    def add_transpose(self, program: Any, weight: Any, residual: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        self._add(program, equation_blocks.apply_transpose, [weight, residual], slices)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A). Later products must have the same weights."""
        program.add(weigh_chains, self.threads, [weight], [self.arrays], smallest=FEW_BLOCKS)
        self._add(program, equation_blocks.add_diagonal, [weight], slices)

    def _add(self, program: Any, kernel: Any, vectors: list[Any], slices: list[Any]) -> None:
        inputs = [self._pairs, self._atlas, self.arrays, *vectors]
        program.add_slices(kernel, self.threads, inputs, slices, smallest=FEW_BLOCKS)
