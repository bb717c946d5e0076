"""Equations of pairs on CUDA.

The ends of the pairs lie in the order of the map, so that neighbouring threads add to the same nodes.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from amiwarp.brightness.pairs import PairSet
from amiwarp.kernels import equations_cuda
from amiwarp.kernels.launch import RepeatedLaunches


class PairEnds:
    """Positions of both ends of pairs in the order of the map, and sums over the pairs' weighted equations on CUDA.

    It has the methods of :class:`amiwarp.brightness.pair_chains.PairChains`.
    """

    kernels = equations_cuda
    """Kernels over all equations."""

    def __init__(self, pairs: PairSet, atlas: Any, geometry: Any) -> None:
        """Allocate the arrays for ``pairs`` on the map of ``atlas``, whose positions ``geometry`` will hold."""
        self._pairs = pairs.arrays
        self._atlas = atlas
        self._geometry = geometry
        tiles = atlas.origin.size // 2
        self._nodes = int(atlas.rows * atlas.columns * tiles)
        self.threads = len(pairs)
        """Number of threads of the kernels, each for a pair."""

        device = pairs.device
        self._launch = RepeatedLaunches(device)
        stride = pairs.arrays.stride
        self._ends = 2 * stride
        room_to_sort = 2 * self._ends
        self.arrays = equations_cuda.Ends()
        """Columns of the ends: the kernels' struct ``Ends``."""
        self.arrays.part = wp.empty(self._ends, dtype=wp.vec2, device=device)
        self.arrays.order = wp.empty(room_to_sort, dtype=int, device=device)
        self.arrays.cell = wp.empty(room_to_sort, dtype=int, device=device)
        self._flow = wp.empty(stride, dtype=float, device=device)
        self._end_inputs = [self.arrays, stride, atlas.columns]

    def take_positions(self) -> None:
        """Take the present positions, and sort them."""
        cell = self.arrays.cell
        order = self.arrays.order
        self._launch(
            equations_cuda.list_ends,
            self._ends,
            [self._geometry, self.threads, self._nodes],
            [cell, order],
        )
        bits = self._nodes.bit_length()
        wp.utils.radix_sort_pairs(cell, order, self._ends, end_bit=bits)
        self._launch(
            equations_cuda.take_fractions,
            self._ends,
            [self._geometry],
            [self.arrays],
        )

    @property
    def inputs(self) -> list[Any]:
        """First inputs of the kernels that compute a value for each equation."""
        return [self._pairs, self._atlas, self._geometry]

    def add_product(
        self,
        program: Any,
        weight: Any,
        vector: Any,
        slices: list[Any],
    ) -> None:
        """Add to ``program``: slices += Aᵀ W A vector, for equations A with weights W."""
        program.add(
            equations_cuda.find_flows,
            self.threads,
            [*self.inputs, weight, vector],
            [self._flow, *slices],
        )
        self._add_ends(program, self._flow, 0, slices)

    def add_transpose(
        self,
        program: Any,
        weight: Any,
        residual: Any,
        slices: list[Any],
    ) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        program.add(
            equations_cuda.weigh_residuals,
            self.threads,
            [self._pairs, self._atlas, weight, residual],
            [self._flow, *slices],
        )
        self._add_ends(program, self._flow, 0, slices)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A)."""
        if self._atlas.with_leak or self._atlas.with_off:
            program.add(
                equations_cuda.add_sensor_diagonal,
                self.threads,
                [self._pairs, self._atlas, weight],
                slices,
            )
        self._add_ends(program, weight, 1, slices)

    def _add_ends(
        self,
        program: Any,
        flow: Any,
        squared: int,
        slices: list[Any],
    ) -> None:
        """Add to ``program`` the sums of ``flow`` over the ends at each node, by their shares or ``squared`` shares."""
        inputs = [*self._end_inputs, flow, squared]
        program.add(equations_cuda.add_ends, self._ends, inputs, slices)
