"""The scene's log brightness from pairs of events: sparse least squares, matrix-free, on the device.

An event says that log brightness at its pixel changed by the threshold since that pixel's last event. With L the map on
the prism-free pixel grid and w(x, θ) the compensated place, L(w(x, θ₂)) − L(w(x, θ₁)) = ±C: linear in L. L is in units
of the ON threshold. See ``docs/calibration.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.brightness.multigrid import Levels
from amiwarp.brightness.residuals import CHUNKS, Residuals
from amiwarp.errors import AmiwarpError
from amiwarp.kernels import descent as cg
from amiwarp.kernels import photometric as kernels
from amiwarp.kernels import places
from amiwarp.kernels.descent import dot, gather, gather_diagonal
from amiwarp.kernels.launch import launch, slice_count
from amiwarp.kernels.pairs import keep_nodes
from amiwarp.kernels.photometric import BLOCK, Geometry, add_diagonal, subtract, weigh
from amiwarp.kernels.prior import EXTRA, Prior, link
from amiwarp.kernels.replay import BLOCK_DIM, Program
from amiwarp.kernels.slopes import slope_between
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.device_camera import pinhole_params
from amiwarp.optics.models import model_camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.brightness.event_pairs import PairSet
    from amiwarp.optics.models import Model

DAMPING = 0.02
"""Weight of the map's own square beside the equations: it holds unknowns that none determines."""
FEW_BLOCKS = 256
"""Fewer blocks of pairs are not worth a second CPU thread."""


@dataclass(frozen=True, slots=True)
class Smoothness:
    """A prior that carries the map into places without equations, and takes salt out."""

    weight: float
    """Of the squared difference of neighbouring nodes, beside the equations' weight of 1."""
    edge: float = 0.0
    """Neighbours that differ by more [thresholds] are linked the less (Charbonnier); 0 for links of equal weight."""


@dataclass(frozen=True, slots=True)
class Tiles:
    """Parts of the map: equal rectangles, nodes ``1 / density`` px apart."""

    origin: NDArray[np.float32]
    """Pixel of each tile's first node, shape (tiles, 2)."""
    rows: int
    columns: int
    density: float = 2.0

    @property
    def nodes(self) -> int:
        return len(self.origin) * self.rows * self.columns


class BrightnessMap:
    """The map of a set of pairs and its solver; owns its buffers. Solves warm-start from the last map.

    What is done often is recorded once (:class:`amiwarp.kernels.replay.Program`); nothing is read back meanwhile.
    """

    def __init__(
        self,
        pairs: PairSet,
        tiles: Tiles,
        *,
        with_leak: bool = False,
        off_excess: float | None = None,
        damping: float = DAMPING,
        smoothness: Smoothness | None = None,
        middle_us: int = 0,
    ) -> None:
        """``off_excess``: the OFF threshold's excess over the ON threshold where it is known: held, not solved for.

        ``middle_us``: the time to which a turning camera is turned back, the pairs' times being from there.
        """
        if not len(pairs):
            raise AmiwarpError("no pixel fired twice in time: there is no pair of events to learn the brightness from")
        self.device, self.tiles, self.count = wp.get_device(pairs.device), tiles, len(pairs)
        self.pairs, self.middle_us, self.smoothness = pairs, middle_us, smoothness
        self._atlas = kernels.Atlas()
        self._atlas.origin = wp.array(tiles.origin.ravel(), dtype=float, device=self.device)
        self._atlas.rows, self._atlas.columns, self._atlas.density = tiles.rows, tiles.columns, tiles.density
        self._atlas.with_leak, self._atlas.with_off = float(with_leak), int(off_excess is None)
        unknowns = tiles.nodes + int(EXTRA)
        self._image = self._zeros(unknowns)
        self._sums = wp.zeros((slice_count(self.device), unknowns), dtype=wp.int64, device=self.device)
        self._slices = [self._sums[k] for k in range(len(self._sums))]
        self._make_vectors(unknowns)
        self._make_prior(damping, unknowns)
        if off_excess is not None:
            self._prior.held = tiles.nodes + 1  # the leak comes first
            self._image[-1:].fill_(off_excess)
        self.residuals = Residuals(pairs, len(tiles.origin))
        self._scale = self._zeros(1)
        self._geometry = self._new_geometry()

    def _zeros(self, n: int) -> Any:
        return wp.zeros(n, dtype=float, device=self.device)

    def _make_vectors(self, unknowns: int) -> None:
        self._width = cg.CPU_WIDTH if self.device.is_cpu else 1
        self._threads = -(-unknowns // self._width)
        self._u, self._dots = cg.Unknowns(), cg.Dots()
        for name in ("diagonal", "residual", "direction", "product"):
            setattr(self._u, name, self._zeros(unknowns))
        parts = -(-self._threads // (1 if self.device.is_cpu else BLOCK_DIM))
        for name, n in (("scalars", 2), ("pq", parts), ("rz", parts)):
            setattr(self._dots, name, wp.zeros(n, dtype=wp.float64, device=self.device))

    def _make_prior(self, damping: float, unknowns: int) -> None:
        linked = self.smoothness is not None
        self._prior = Prior()
        self._prior.damping, self._prior.columns = damping, self.tiles.columns
        self._prior.linked, self._prior.held = int(linked), unknowns
        self._prior.right, self._prior.down = (self._zeros(unknowns * linked) for _ in "xy")
        self._prior.smooth = self._zeros(1)
        if self.smoothness is not None:
            self._prior.smooth.fill_(self.smoothness.weight)
        one = linked and len(self.tiles.origin) == 1
        self._levels = Levels(self.tiles.rows, self.tiles.columns, self.device) if one else None
        self._z = self._zeros(unknowns * one)

    def _new_geometry(self) -> Any:
        g = Geometry()
        g.stride = self.pairs.arrays.stride
        g.cell = wp.full(2 * g.stride, -1, dtype=int, device=self.device)
        g.part = self._zeros(4 * g.stride)
        return g

    # -- where pairs fall

    def place(self, model: Model, *, drift: float = 0.0, camera_rotation: CameraRotation | None = None) -> None:
        """Where the pairs fall for these parameters, the camera's ``turning`` taken back to ``middle_us``."""
        self._place(model, drift, camera_rotation, self._geometry)

    def _place(self, model: Model, drift: float, camera_rotation: CameraRotation | None, out: Any) -> None:

        arrays, params = self.pairs.arrays, model.params(self.device)
        camera_rotation = (camera_rotation or CameraRotation()).about(self.middle_us)
        pinhole = pinhole_params(model.camera)
        if (
            pinhole is None
            or arrays.slope.shape[0]
            or any(camera_rotation.angular_velocity)
            or any(camera_rotation.angular_acceleration)
        ):
            inputs = [params, model_camera(model, self.device), arrays, self._atlas, drift, camera_rotation.params()]
            launch(places.place_pairs, self.count, inputs, [out], device=self.device)
            return
        inputs = [params, pinhole, arrays, self._atlas]
        if self.device.is_cpu:
            blocks = arrays.stride // int(BLOCK)
            launch(places.place_blocks, blocks, inputs, [out], device=self.device, smallest=FEW_BLOCKS)
        else:
            launch(places.place_still, arrays.stride, inputs, [out], device=self.device)

    @cached_property
    def _sides(self) -> tuple[Any, Any]:
        """Two more geometries, for differences."""
        return self._new_geometry(), self._new_geometry()

    def find_slope(self, plus: dict[str, Any], minus: dict[str, Any], width: float) -> Any:
        """Slope of the residuals, the map as it is, by their difference between two placings, on the device.

        ``plus`` and ``minus``: arguments of :meth:`place`, ``width`` apart; the pairs' own places stay.
        """
        for side, at in zip(self._sides, (plus, minus), strict=True):
            self._place(at["model"], at["drift"], at["camera_rotation"], side)
        out = self._zeros(self.pairs.arrays.stride)
        inputs = [self.pairs.arrays, self._atlas, *self._sides, self._image, width]
        launch(slope_between, self.count, inputs, [out], device=self.device)
        return out

    def keep(self, nodes: NDArray[np.bool_]) -> None:
        """Pairs of two events that lie off ``nodes`` (tiles, rows, columns), either of them, are left out: noise."""
        on = wp.array(nodes.ravel().view(np.uint8), dtype=wp.uint8, device=self.device)
        inputs = [on, self.pairs.arrays.on, self._geometry.stride]
        launch(keep_nodes, self.count, inputs, [self._geometry.cell], device=self.device)

    # -- solving

    def solve(self, scale: float, *, steps: int, rounds: int = 1) -> None:
        """``rounds`` of Cauchy weights of ``scale`` [thresholds] and ``steps`` of conjugate gradients each.

        Leaves the residual of every pair [thresholds], NaN for pairs off the map, in ``residuals`` on the device.
        """
        self._scale.fill_(scale)
        for _ in range(rounds):
            self._weigh.run()
            self._prepare.run()
            self._descent.run(steps)
        self._weigh.run()

    def restart(self, smoothness: float) -> None:
        """From an empty map, with another weight of the prior."""
        self._image[: self.tiles.nodes].zero_()
        self._prior.smooth.fill_(smoothness)

    def prepare_projection(self) -> None:
        """For :meth:`unexplained`, with the weights of the last :meth:`solve`."""
        self._prepare.run()

    def new_change(self) -> Any:
        """No change of the map, on the device: for :meth:`unexplained` to start from."""
        return self._zeros(len(self._image))

    def unexplained(self, target: Any, change: Any, *, steps: int) -> Any:
        """What of ``target`` (pairs, on the device) no change of the map explains.

        The projection of variable projection (Golub and Pereyra 1973), by conjugate gradients from ``change``, a guess
        of the change that explains it; a better one is left there.
        """
        inputs = [self.pairs.arrays, self._atlas, self._geometry, self._projection.image]
        wp.copy(self._projection.image, change)
        wp.copy(self._projection.residual, target)
        launch(subtract, self.count, inputs, [self._projection.residual], device=self.device)
        self._projection.run(steps)
        wp.copy(change, self._projection.image)
        rest = wp.clone(target)
        launch(subtract, self.count, inputs, [rest], device=self.device)
        return rest

    @property
    def _equations(self) -> list[Any]:
        return [self.pairs.arrays, self._atlas, self._geometry, self.residuals.weight]

    @cached_property
    def _weigh(self) -> Any:
        program = Program(self.device)
        self._add_weigh(program)
        return program

    def _add_weigh(self, program: Any) -> None:
        inputs = [self.pairs.arrays, self._atlas, self._geometry, self._image, self._scale]
        program.add(weigh, self.count, inputs, [self.residuals.weight, self.residuals.values])

    @cached_property
    def _prepare(self) -> Any:
        """Links and diagonals, for the weights and the map as they are."""
        program = Program(self.device)
        if self.smoothness is not None:
            inputs = [self._image, self.tiles.rows, self.smoothness.edge, self._prior]
            program.add(link, self.tiles.nodes, inputs, [self._prior.right, self._prior.down])
        program.add_slices(add_diagonal, self.count, self._equations, self._slices)
        program.add(gather_diagonal, len(self._image), [self._sums, self._prior], [self._u.diagonal])
        if self._levels is not None:
            self._levels.prepare(program, self._equations[1:], self.count, self._sums, self._slices)
        return program

    @cached_property
    def _descent(self) -> _Descent:
        return _Descent(self, self._image, self.residuals.values)

    @cached_property
    def _projection(self) -> _Descent:
        return _Descent(self, self._zeros(len(self._image)), self._zeros(self.pairs.arrays.stride))

    # -- what came out

    @property
    def unknowns(self) -> NDArray[np.float32]:
        """A copy of the map and, behind it, the leak [1/s] and the OFF threshold's excess over the ON threshold."""
        values: NDArray[np.float32] = self._image.numpy()
        return values.copy() if self.device.is_cpu else values

    @unknowns.setter
    def unknowns(self, values: NDArray[np.float32]) -> None:
        self._image.assign(values)

    def maps(self) -> NDArray[np.float32]:
        """The map [ON thresholds], shape (tiles, rows, columns)."""
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        return self.unknowns[: self.tiles.nodes].reshape(shape)

    def coverage(self, scale: float = 1.0) -> NDArray[np.float32]:
        """How much pairs of two events say of each node, with weights of ``scale``, shape (tiles, rows, columns)."""
        self._scale.fill_(scale)
        weak, self.pairs.arrays.weak = self.pairs.arrays.weak, 0.0
        program = Program(self.device)
        self._add_weigh(program)
        program.add_slices(add_diagonal, self.count, self._equations, self._slices)
        out = self._zeros(len(self._image))
        program.add(gather, len(out), [self._sums], [out])
        program.launch()
        self.pairs.arrays.weak = weak
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        diagonal: NDArray[np.float32] = out.numpy()[: self.tiles.nodes].reshape(shape)
        return diagonal

    @property
    def extra(self) -> NDArray[np.float32]:
        """The unknowns behind the map: the leak [thresholds/s], and the OFF threshold's excess."""
        return self.unknowns[self.tiles.nodes :]


class _Descent:
    """Conjugate gradients on the normal equations, preconditioned by the diagonal or by :class:`Levels`.

    ``image`` moves so that less is left of ``residual``, which is that of ``image`` as it comes in.
    """

    def __init__(self, of: BrightnessMap, image: Any, residual: Any) -> None:
        self.image, self.residual = image, residual
        self._of, self._begin, self._step = of, Program(of.device), Program(of.device)
        self._add_begin(self._begin)
        self._add_step(self._step)

    def run(self, steps: int) -> None:
        self._begin.run()
        self._step.run(steps)

    def _add_begin(self, program: Any) -> None:
        of = self._of
        program.add_slices(kernels.apply_transpose, of.count, [*of._equations, self.residual], of._slices)
        self._add(program, cg.start_descent, [of._sums, of._prior, self.image], [of._u, of._dots])
        self._correct(program)

    def _add_step(self, program: Any) -> None:
        of = self._of
        if of._levels is None:
            self._add(program, cg.turn, [], [of._u, of._dots])
        else:
            self._add(program, cg.turn_to, [of._z], [of._u, of._dots])
        inputs = [*of._equations, of._u.direction]
        if of.device.is_cpu:
            blocks = of.pairs.arrays.stride // int(kernels.BLOCK)
            program.add_slices(kernels.apply_normal_blocks, blocks, inputs, of._slices, smallest=FEW_BLOCKS)
        else:
            program.add_slices(kernels.apply_normal, of.count, inputs, of._slices)
        self._add(program, cg.finish_product, [of._sums, of._prior], [of._u, of._dots])
        self._add(program, cg.descend, [], [self.image, of._u, of._dots])
        self._correct(program)

    def _correct(self, program: Any) -> None:
        """The preconditioned residual, and its product with the residual."""
        of = self._of
        if of._levels is not None:
            of._levels.correct(program, of._u.diagonal, of._prior, of._u.residual, of._z)
            self._add(program, dot, [of._u.residual, of._z], [of._dots.rz])

    def _add(self, program: Any, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        program.add(kernel, self._of._threads, [*inputs, self._of._width], outputs, smallest=CHUNKS)
