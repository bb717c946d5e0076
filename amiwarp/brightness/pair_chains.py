"""Equations of pairs on a CPU: positions that successive pairs share are stored once."""

from __future__ import annotations

from typing import Any

import warp as wp

from amiwarp.brightness.pairs import PairSet
from amiwarp.kernels import equations_cpu
from amiwarp.kernels.launch import launch

FEW_BLOCKS = 256
"""Smallest number of blocks of pairs for which a second CPU thread is used."""


class PairChains:
    """Positions of pairs on a map in chains, and sums over the pairs' weighted equations on a CPU.

    The sums have a slice for each thread.
    """

    kernels = equations_cpu
    """Kernels over all equations."""

    def __init__(self, pairs: PairSet, atlas: Any, geometry: Any) -> None:
        """Allocate the arrays for ``pairs`` on the map of ``atlas``, whose positions ``geometry`` will hold."""
        self._pairs = pairs.arrays
        self._atlas = atlas
        self._geometry = geometry
        stride = pairs.arrays.stride
        device = pairs.device
        self.threads = stride // int(equations_cpu.BLOCK)
        """Number of threads of the kernels, each for a block of pairs."""
        ends = 2 * stride
        self.arrays = equations_cpu.Chains()
        """Columns of the positions: the kernels' struct ``Chains``."""
        self.arrays.cell = wp.empty(ends, dtype=int, device=device)
        self.arrays.x = wp.empty(ends, dtype=float, device=device)
        self.arrays.y = wp.empty(ends, dtype=float, device=device)
        self.arrays.weight = wp.empty(ends, dtype=float, device=device)
        self.arrays.count = wp.empty(self.threads, dtype=int, device=device)
        self.arrays.end = wp.empty(stride, dtype=wp.uint8, device=device)
        self._columns = (pairs.arrays, atlas, self.arrays)
        """First inputs of the kernels that sum over the equations."""

    def take_positions(self) -> None:
        """Take the present positions, and join pairs that begin where the pair before them ends."""
        positions = self._geometry
        launch(
            equations_cpu.make_chains,
            self.threads,
            [positions.cell, positions.part, positions.stride],
            [self.arrays],
            device="cpu",
            smallest=FEW_BLOCKS,
        )

    @property
    def inputs(self) -> list[Any]:
        """First inputs of the kernels that compute a value for each equation."""
        return [self._pairs, self._atlas, self._geometry, self.arrays]

    def add_product(
        self,
        program: Any,
        weight: Any,
        vector: Any,
        slices: list[Any],
    ) -> None:
        """Add to ``program``: slices += Aᵀ W A vector, for equations A with weights W."""
        inputs = [*self._columns, weight, vector]
        kernel = equations_cpu.apply_normal
        program.add_slices(kernel, self.threads, inputs, slices, smallest=FEW_BLOCKS)

    def add_transpose(
        self,
        program: Any,
        weight: Any,
        residual: Any,
        slices: list[Any],
    ) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        inputs = [*self._columns, weight, residual]
        kernel = equations_cpu.apply_transpose
        program.add_slices(kernel, self.threads, inputs, slices, smallest=FEW_BLOCKS)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A). Later products must have the same weights."""
        program.add(
            equations_cpu.weigh_chains,
            self.threads,
            [weight],
            [self.arrays],
            smallest=FEW_BLOCKS,
        )
        inputs = [*self._columns, weight]
        kernel = equations_cpu.add_diagonal
        program.add_slices(kernel, self.threads, inputs, slices, smallest=FEW_BLOCKS)
