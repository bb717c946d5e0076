"""Positions of event pairs on the brightness map, for a model and a rotation of the camera."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import warp as wp

from amiwarp.kernels import equations_cpu, equations_cuda
from amiwarp.kernels.equations import Geometry, slope_between, slope_of_changes
from amiwarp.kernels.equations_cpu import BLOCK, Chains, make_chains, weigh_chains
from amiwarp.kernels.equations_cuda import Ends, add_ends, list_ends, take_fractions
from amiwarp.kernels.launch import RepeatedLaunches, launch
from amiwarp.kernels.map_positions import place_blocks, place_pairs, place_still
from amiwarp.kernels.pairs import keep_nodes
from amiwarp.optics.camera import pinhole_params
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.displacement import model_camera

if TYPE_CHECKING:
    from amiwarp.brightness.event_pairs import PairSet
    from amiwarp.optics.models import Model


# Chains of event pairs on a CPU: positions that successive pairs share are stored once.

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
        inputs = [self._pairs, self._atlas, self.arrays, weight, vector]
        program.add_slices(equations_cpu.apply_normal, self.threads, inputs, slices, smallest=FEW_BLOCKS)

    def add_transpose(self, program: Any, weight: Any, residual: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        inputs = [self._pairs, self._atlas, self.arrays, weight, residual]
        program.add_slices(equations_cpu.apply_transpose, self.threads, inputs, slices, smallest=FEW_BLOCKS)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A). Later products must have the same weights."""
        program.add(weigh_chains, self.threads, [weight], [self.arrays], smallest=FEW_BLOCKS)
        inputs = [self._pairs, self._atlas, self.arrays, weight]
        program.add_slices(equations_cpu.add_diagonal, self.threads, inputs, slices, smallest=FEW_BLOCKS)


# Ends of event pairs on CUDA in the order of the map, so that neighbouring threads add to the same nodes.


class PairEnds:
    """Positions of both ends of pairs in the order of the map, and sums over the pairs' weighted equations on CUDA.

    Its methods are those of :class:`amiwarp.brightness.pair_positions.PairChains`.
    """

    kernels = equations_cuda
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
        self._ends, self._end_inputs = 2 * stride, [self.arrays, stride, atlas.columns]

    def take_positions(self) -> None:
        """Take the present positions, and sort them."""
        ends, nodes = self._ends, self._nodes
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
        program.add(equations_cuda.find_flows, self.threads, [*self.inputs, weight, vector], [self._flow, *slices])
        program.add(add_ends, self._ends, [*self._end_inputs, self._flow, 0], slices)

    def add_transpose(self, program: Any, weight: Any, residual: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        inputs = [self._pairs, self._atlas, weight, residual]
        program.add(equations_cuda.weigh_residuals, self.threads, inputs, [self._flow, *slices])
        program.add(add_ends, self._ends, [*self._end_inputs, self._flow, 0], slices)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A)."""
        if self._atlas.with_leak or self._atlas.with_off:
            inputs = [self._pairs, self._atlas, weight]
            program.add(equations_cuda.add_sensor_diagonal, self.threads, inputs, slices)
        program.add(add_ends, self._ends, [*self._end_inputs, weight, 1], slices)


class PairPositions:
    """Positions of ``pairs`` on the map of ``atlas``, the kernels' struct. Owns its buffers."""

    def __init__(self, pairs: PairSet, atlas: Any, middle_us: int) -> None:
        """Allocate the buffers. ``middle_us`` is the time to which the times of the pairs are relative [us]."""
        self.pairs, self.device, self._atlas, self._middle_us = pairs, wp.get_device(pairs.device), atlas, middle_us
        self.geometry = self._new_geometry()
        """Positions: the kernels' struct ``Geometry``."""
        self.equations = (PairChains if self.device.is_cpu else PairEnds)(pairs, atlas, self.geometry)
        """Equations of the pairs at these positions."""
        self._nothing = wp.empty(0, dtype=float, device=self.device)
        self._launch = RepeatedLaunches(self.device)

    def _new_geometry(self) -> Any:
        g = Geometry()
        g.stride = self.pairs.arrays.stride
        g.cell = wp.empty(2 * g.stride, dtype=int, device=self.device)
        g.part = wp.empty(4 * g.stride, dtype=float, device=self.device)
        return g

    def place(
        self, model: Model, drift: float, camera_rotation: CameraRotation | None, out: Any, image: Any = None
    ) -> None:
        """Compute the positions into ``out``.

        With the map ``image``, on a CPU and if :meth:`_in_blocks`, ``out`` gets the changes of brightness instead.
        """
        arrays, turn = self.pairs.arrays, self._turn(camera_rotation)
        n = arrays.stride if self.device.is_cpu else arrays.count  # CPU kernels also read the padding
        if not self._in_blocks(model, turn):
            inputs = [model.params(self.device), model_camera(model, self.device), arrays, self._atlas]
            self._launch(place_pairs, n, [*inputs, drift, turn.params()], [out])
            return
        inputs = [model.params(self.device), pinhole_params(model.camera), arrays, self._atlas]
        if not self.device.is_cpu:
            self._launch(place_still, n, inputs, [out])
            return
        inputs += [drift, turn.params(), self._nothing if image is None else image]
        outputs = [out, self._nothing] if image is None else [self.geometry, out]
        self._launch(place_blocks, self.equations.threads, inputs, outputs, smallest=FEW_BLOCKS)

    def _turn(self, camera_rotation: CameraRotation | None) -> CameraRotation:
        return (camera_rotation or CameraRotation()).about(self._middle_us)

    def _in_blocks(self, model: Model, turn: CameraRotation) -> bool:
        """Return whether the fast kernels apply: no distortion, no slow pixels, and on CUDA only the prism moves."""
        arrays = self.pairs.arrays
        moves = arrays.slope.shape[0] > 0 or any((*turn.angular_velocity, *turn.angular_acceleration))
        return model.camera.distortion is None and not arrays.lag.shape[0] and (self.device.is_cpu or not moves)

    @cached_property
    def _sides(self) -> tuple[Any, Any]:
        """Buffers for the positions at two more parameter values, for finite differences."""
        return self._new_geometry(), self._new_geometry()

    @cached_property
    def _changes(self) -> tuple[Any, Any]:
        """Buffers for the changes of brightness at two parameter values, for finite differences."""
        plus, minus = (wp.empty(self.geometry.stride, dtype=float, device=self.device) for _ in "+-")
        return plus, minus

    def find_slope(self, plus: dict[str, Any], minus: dict[str, Any], width: float, image: Any) -> Any:
        """Return the derivative of the residuals for the map ``image``; see :meth:`BrightnessMap.find_slope`."""
        both = (plus, minus)
        out = wp.empty(self.pairs.arrays.stride, dtype=float, device=self.device)
        if self.device.is_cpu and all(self._in_blocks(at["model"], self._turn(at["camera_rotation"])) for at in both):
            for change, at in zip(self._changes, both, strict=True):
                self.place(**at, out=change, image=image)
            self._launch(slope_of_changes, len(self.pairs), [*self._changes, width], [out])
            return out
        for side, at in zip(self._sides, both, strict=True):
            self.place(**at, out=side)
        inputs = [self.pairs.arrays, self._atlas, *self._sides, image, width]
        self._launch(slope_between, len(self.pairs), inputs, [out])
        return out

    def keep(self, nodes: wp.array) -> None:
        """Exclude pairs of two events that are off the ``nodes``; see :meth:`BrightnessMap.keep`."""
        inputs = [nodes, self.pairs.arrays.on, self.geometry.stride]
        self._launch(keep_nodes, len(self.pairs), inputs, [self.geometry.cell])
        self.equations.take_positions()
