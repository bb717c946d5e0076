"""Positions of event pairs on the brightness map, for a model and a rotation of the camera."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import warp as wp

from amiwarp.brightness.pair_chains import FEW_BLOCKS, PairChains
from amiwarp.brightness.pair_ends import PairEnds
from amiwarp.kernels import map_positions as kernels
from amiwarp.kernels.launch import RepeatedLaunches
from amiwarp.kernels.pairs import keep_nodes
from amiwarp.kernels.photometric import Geometry
from amiwarp.kernels.residual_slopes import slope_between, slope_of_changes
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.device_camera import pinhole_params
from amiwarp.optics.displacement import model_camera

if TYPE_CHECKING:
    from amiwarp.brightness.event_pairs import PairSet
    from amiwarp.optics.models import Model


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

    def place(self, model: Model, drift: float, camera_rotation: CameraRotation | None) -> None:
        """Compute the positions."""
        self._place(model, drift, camera_rotation, self.geometry)
        self.equations.take_positions()

    def _place(
        self, model: Model, drift: float, camera_rotation: CameraRotation | None, out: Any, image: Any = None
    ) -> None:
        """Compute the positions into ``out``.

        With the map ``image``, on a CPU and if :meth:`_in_blocks`, ``out`` gets the changes of brightness instead.
        """
        arrays, turn = self.pairs.arrays, self._turn(camera_rotation)
        n = arrays.stride if self.device.is_cpu else arrays.count  # CPU kernels also read the padding
        if not self._in_blocks(model, turn):
            inputs = [model.params(self.device), model_camera(model, self.device), arrays, self._atlas]
            self._launch(kernels.place_pairs, n, [*inputs, drift, turn.params()], [out])
            return
        inputs = [model.params(self.device), pinhole_params(model.camera), arrays, self._atlas]
        if not self.device.is_cpu:
            self._launch(kernels.place_still, n, inputs, [out])
            return
        inputs += [drift, turn.params(), self._nothing if image is None else image]
        outputs = [out, self._nothing] if image is None else [self.geometry, out]
        self._launch(kernels.place_blocks, self.equations.threads, inputs, outputs, smallest=FEW_BLOCKS)

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
                self._place(**at, out=change, image=image)
            self._launch(slope_of_changes, len(self.pairs), [*self._changes, width], [out])
            return out
        for side, at in zip(self._sides, both, strict=True):
            self._place(**at, out=side)
        inputs = [self.pairs.arrays, self._atlas, *self._sides, image, width]
        self._launch(slope_between, len(self.pairs), inputs, [out])
        return out

    def keep(self, nodes: wp.array) -> None:
        """Exclude pairs of two events that are off the ``nodes``; see :meth:`BrightnessMap.keep`."""
        inputs = [nodes, self.pairs.arrays.on, self.geometry.stride]
        self._launch(keep_nodes, len(self.pairs), inputs, [self.geometry.cell])
        self.equations.take_positions()
