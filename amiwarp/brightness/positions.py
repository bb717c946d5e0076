"""Positions of pairs on the brightness map, for a model and a rotation of the camera."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import warp as wp

from amiwarp.brightness.pair_chains import FEW_BLOCKS, PairChains
from amiwarp.brightness.pair_ends import PairEnds
from amiwarp.brightness.pairs import PairSet
from amiwarp.kernels import equations as eqs
from amiwarp.kernels import pairs as pair_kernels
from amiwarp.kernels.camera import pinhole_params
from amiwarp.kernels.launch import RepeatedLaunches
from amiwarp.kernels.map_positions import place_blocks, place_pairs, place_still
from amiwarp.kernels.residual_slopes import slope_between, slope_of_changes
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model, model_camera


class PairPositions:
    """Positions of ``pairs`` on the map of ``atlas``, the kernels' struct. Owns its buffers."""

    def __init__(self, pairs: PairSet, atlas: Any, middle_us: int) -> None:
        """Allocate the buffers. ``middle_us`` is the time to which the times of the pairs are relative [us]."""
        self.pairs = pairs
        self.device = wp.get_device(pairs.device)
        self._atlas = atlas
        self._middle_us = middle_us
        self.geometry = self._new_geometry()
        """Positions: the kernels' struct ``Geometry``."""
        equations = PairChains if self.device.is_cpu else PairEnds
        self.equations = equations(pairs, atlas, self.geometry)
        """Equations of the pairs at these positions."""
        self._nothing = wp.empty(0, dtype=float, device=self.device)
        self._still = CameraRotation(middle_us=middle_us)
        self._launch = RepeatedLaunches(self.device)

    def _new_geometry(self) -> Any:
        stride = self.pairs.arrays.stride
        geometry = eqs.Geometry()
        geometry.stride = stride
        geometry.cell = wp.empty(2 * stride, dtype=int, device=self.device)
        geometry.part = wp.empty(4 * stride, dtype=float, device=self.device)
        return geometry

    def place(
        self,
        model: Model,
        drift: float,
        camera_rotation: CameraRotation | None,
        out: Any,
        image: Any = None,
        arrays: Any = None,
    ) -> None:
        """Compute the positions into ``out``. ``arrays`` replace the columns of the pairs.

        With the map ``image``, on a CPU and if :meth:`_in_blocks`, ``out`` gets the changes of brightness instead.
        """
        arrays = self.pairs.arrays if arrays is None else arrays
        turn = self._turn(camera_rotation)
        # CPU kernels also read the padding
        count = arrays.stride if self.device.is_cpu else arrays.count
        params = model.params(self.device)
        if not self._in_blocks(model, turn, arrays):
            camera = model_camera(model, self.device)
            rotation = turn.params(self.device)
            inputs = [params, camera, arrays, self._atlas, drift, rotation]
            self._launch(place_pairs, count, inputs, [out])
            return

        pinhole = pinhole_params(model.camera)
        if not self.device.is_cpu:
            inputs = [params, pinhole, arrays, self._atlas]
            self._launch(place_still, count, inputs, [out])
            return
        if image is None:
            image = self._nothing
            outputs = [out, self._nothing]
        else:
            outputs = [self.geometry, out]
        rotation = turn.params(self.device)
        inputs = [params, pinhole, arrays, self._atlas, drift, rotation, image]
        self._launch(place_blocks, self.equations.threads, inputs, outputs, smallest=FEW_BLOCKS)

    def _turn(self, camera_rotation: CameraRotation | None) -> CameraRotation:
        """Return the camera's rotation about the middle of the pairs' times."""
        if camera_rotation is None or not camera_rotation.moves:
            return self._still
        return camera_rotation.about(self._middle_us)

    def _in_blocks(self, model: Model, turn: CameraRotation, arrays: Any) -> bool:
        """Return whether the fast kernels apply: no distortion, no slow pixels, and on CUDA only the prism moves."""
        if model.camera.distortion is not None or arrays.lag.shape[0]:
            return False
        if self.device.is_cpu:
            return True
        drifts = arrays.slope.shape[0] > 0
        return not drifts and not turn.moves

    @cached_property
    def _sides(self) -> tuple[Any, Any]:
        """Buffers for the positions at two more parameter values, for finite differences."""
        return self._new_geometry(), self._new_geometry()

    @cached_property
    def _changes(self) -> tuple[Any, Any]:
        """Buffers for the changes of brightness at two parameter values, for finite differences."""
        plus = wp.empty(self.geometry.stride, dtype=float, device=self.device)
        minus = wp.empty(self.geometry.stride, dtype=float, device=self.device)
        return plus, minus

    def find_slope(
        self,
        plus: dict[str, Any],
        minus: dict[str, Any],
        width: float,
        image: Any,
    ) -> Any:
        """Return the derivative of the residuals for the map ``image``; see :meth:`BrightnessMap.find_slope`."""
        count = len(self.pairs)
        slope = wp.empty(self.pairs.arrays.stride, dtype=float, device=self.device)
        if self.device.is_cpu and self._is_in_blocks(plus) and self._is_in_blocks(minus):
            change_plus, change_minus = self._changes
            self.place(**plus, out=change_plus, image=image)
            self.place(**minus, out=change_minus, image=image)
            inputs = [change_plus, change_minus, width]
            self._launch(slope_of_changes, count, inputs, [slope])
            return slope
        side_plus, side_minus = self._sides
        self.place(**plus, out=side_plus)
        self.place(**minus, out=side_minus)
        arrays = plus.get("arrays", self.pairs.arrays)
        inputs = [arrays, self._atlas, side_plus, side_minus, image, width]
        self._launch(slope_between, count, inputs, [slope])
        return slope

    def _is_in_blocks(self, at: dict[str, Any]) -> bool:
        """Return :meth:`_in_blocks` for arguments of :meth:`place`."""
        arrays = at.get("arrays", self.pairs.arrays)
        turn = self._turn(at["camera_rotation"])
        return self._in_blocks(at["model"], turn, arrays)

    def keep(self, nodes: wp.array) -> None:
        """Exclude pairs of two events that are off the ``nodes``; see :meth:`BrightnessMap.keep`."""
        inputs = [nodes, self.pairs.arrays.on, self.geometry.stride]
        self._launch(pair_kernels.keep_nodes, len(self.pairs), inputs, [self.geometry.cell])
        self.equations.take_positions()
