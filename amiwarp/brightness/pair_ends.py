"""Ends of event pairs on CUDA in the order of the map, so that neighbouring threads add to the same nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from amiwarp.kernels import normal_equations
from amiwarp.kernels.launch import RepeatedLaunches
from amiwarp.kernels.pair_ends import Ends, add_ends, list_ends, take_fractions

if TYPE_CHECKING:
    from amiwarp.brightness.event_pairs import PairSet


class PairEnds:
    """Positions of both ends of pairs in the order of the map, and sums over the pairs' weighted equations on CUDA.

    Its methods are those of :class:`amiwarp.brightness.pair_chains.PairChains`.
    """

    kernels = normal_equations
    """Kernels over all equations."""

    def __init__(self, pairs: PairSet, atlas: Any, geometry: Any) -> None:
        """Allocate the arrays for ``pairs`` on the map of ``atlas``, whose positions ``geometry`` will hold."""
        self._pairs, self._atlas, self._geometry = pairs.arrays, atlas, geometry
        self._nodes = int(atlas.rows * atlas.columns * (atlas.origin.size // 2))
        self.threads, stride = len(pairs), pairs.arrays.stride
        """Number of threads of the kernels, each for a pair."""
        self._device, self._launch = pairs.device, RepeatedLaunches(pairs.device)
        self.arrays = Ends()
        """Columns of the ends: the kernels' struct ``Ends``."""
        self.arrays.part = wp.empty(2 * stride, dtype=wp.vec2, device=self._device)
        self.arrays.order, self.arrays.cell = (wp.empty(4 * stride, dtype=int, device=self._device) for _ in "oc")
        self._flow = wp.empty(stride, dtype=float, device=self._device)

    def take_positions(self) -> None:
        """Take the present positions, and sort them."""
        ends, nodes = 2 * self._geometry.stride, self._nodes
        inputs, outputs = [self._geometry, self.threads, nodes], [self.arrays.cell, self.arrays.order]
        self._launch(list_ends, ends, inputs, outputs)
        wp.utils.radix_sort_pairs(*outputs, ends, end_bit=nodes.bit_length())
        self._launch(take_fractions, ends, [self._geometry], [self.arrays])

    @property
    def inputs(self) -> list[Any]:
        """First inputs of the kernels that compute a value for each equation."""
        return [self._pairs, self._atlas, self._geometry]

    def add_product(self, program: Any, weight: Any, vector: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W A vector, for equations A with weights W."""
        program.add(normal_equations.find_flows, self.threads, [*self.inputs, weight, vector], [self._flow, *slices])
        self._add(program, self._flow, slices)

    def add_transpose(self, program: Any, weight: Any, residual: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        inputs = [self._pairs, self._atlas, weight, residual]
        program.add(normal_equations.weigh_residuals, self.threads, inputs, [self._flow, *slices])
        self._add(program, self._flow, slices)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A)."""
        if self._atlas.with_leak or self._atlas.with_off:
            inputs = [self._pairs, self._atlas, weight]
            program.add(normal_equations.add_sensor_diagonal, self.threads, inputs, slices)
        self._add(program, weight, slices, squared=1)

    def _add(self, program: Any, values: Any, slices: list[Any], squared: int = 0) -> None:
        stride = self._geometry.stride
        inputs = [self.arrays, stride, self._atlas.columns, values, squared]
        program.add(add_ends, 2 * stride, inputs, slices)
