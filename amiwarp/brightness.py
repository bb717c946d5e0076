"""The scene's log brightness from pairs of events: sparse least squares, matrix-free, on the device.

An event says that log brightness at its pixel changed by the threshold since that pixel's last event. With L the map on
the prism-free pixel grid and w(x, θ) the compensated place, L(w(x, θ₂)) − L(w(x, θ₁)) = ±C: linear in L. L is in units
of the ON threshold. See ``docs/calibration.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.multilevel import Levels
from amiwarp.optics import model_camera
from amiwarp.pairs import PairSet, Sensor, upload_pairs
from amiwarp.turning import Turning

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.encoder import Encoder
    from amiwarp.optics import Model

WEAK_WEIGHT = 0.05
"""Of a pair that is not of two events (:func:`open_ends`, :func:`quiet_pairs`): right only to within a threshold."""

DAMPING = 0.02
"""Weight of the map's own square beside the equations: it holds unknowns that none determines."""


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
    """The map of a set of pairs and its solver; owns its buffers. Solves warm-start from the last map."""

    def __init__(
        self,
        pairs: PairSet,
        tiles: Tiles,
        encoder: Encoder,
        *,
        sensor: Sensor | None = None,
        slope: NDArray[np.float32] | None = None,
        with_leak: bool = False,
        off_excess: float | None = None,
        damping: float = DAMPING,
        smoothness: Smoothness | None = None,
        weak: float = WEAK_WEIGHT,
        middle_us: int = 0,
        device: Any = "cpu",
    ) -> None:
        """``slope`` (n, 2): change of the encoder's angle at either event per unit of a drifting parameter.

        ``off_excess``: the OFF threshold's excess over the ON threshold where it is known: held, not solved for.
        ``middle_us``: the time to which a turning camera is turned back.
        """
        import warp as wp

        from amiwarp.kernels import descent
        from amiwarp.kernels import photometric as kernels
        from amiwarp.kernels.launch import slice_count
        from amiwarp.kernels.prior import Prior

        if not len(pairs):
            raise AmiwarpError("no pixel fired twice in time: there is no pair of events to learn the brightness from")
        self.device, self.tiles, self.count = wp.get_device(device), tiles, len(pairs)
        self.middle_us = middle_us
        self._pairs = upload_pairs(
            pairs, encoder, sensor or Sensor(), slope, middle_us=self.middle_us, weak=weak, device=self.device
        )
        self._atlas = kernels.Atlas()
        self._atlas.origin = wp.array(tiles.origin, dtype=wp.vec2, device=device)
        self._atlas.rows, self._atlas.columns, self._atlas.density = tiles.rows, tiles.columns, tiles.density
        self._atlas.with_leak = float(with_leak)
        unknowns = tiles.nodes + int(kernels.EXTRA)
        names = ("image", "change", "residual", "direction", "product", "diagonal")
        self._image, self._change, self._r, self._p, self._q, self._diagonal = (
            wp.zeros(unknowns, dtype=float, device=device) for _ in names
        )
        self._sums = wp.zeros((slice_count(device), unknowns), dtype=wp.int64, device=device)
        self._slices = [self._sums[k] for k in range(len(self._sums))]
        self._partial = wp.zeros(-(-unknowns // int(descent.SEGMENT)), dtype=wp.float64, device=device)
        self._scalars = wp.zeros(3, dtype=wp.float64, device=device)
        self.smoothness = smoothness
        self._prior = Prior()
        self._prior.damping, self._prior.columns = damping, tiles.columns
        self._prior.linked, self._prior.held = int(smoothness is not None), unknowns
        links = unknowns if smoothness is not None else 0
        self._prior.right, self._prior.down = (wp.zeros(links, dtype=float, device=device) for _ in "xy")
        one = smoothness is not None and len(tiles.origin) == 1
        self._levels = Levels(tiles.rows, tiles.columns, self.device) if one else None
        self._z = wp.zeros(unknowns if one else 0, dtype=float, device=device)
        if off_excess is not None:
            self._prior.held = tiles.nodes + 1  # the leak comes first
            self._image.assign(np.concatenate([np.zeros(tiles.nodes + 1), [off_excess]]).astype(np.float32))
        self._weight, self._residual, self._scratch, self._other = (
            wp.zeros(self.count, dtype=float, device=device) for _ in range(4)
        )
        self._geometry = kernels.Geometry()
        self._geometry.cell = wp.zeros(self.count, dtype=wp.vec2i, device=device)
        self._geometry.first = wp.zeros(self.count, dtype=wp.vec2, device=device)
        self._geometry.second = wp.zeros(self.count, dtype=wp.vec2, device=device)

    def place(self, model: Model, *, drift: float = 0.0, turning: Turning | None = None) -> None:
        """Where the pairs fall for these parameters, the camera's ``turning`` taken back to ``middle_us``."""
        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.photometric import place_pairs

        inputs = [model.params(self.device), model_camera(model, self.device), self._pairs, self._atlas, drift]
        turning = (turning or Turning()).about(self.middle_us)
        launch(place_pairs, self.count, [*inputs, turning.params()], [self._geometry], device=self.device)

    def solve(self, scale: float, *, steps: int, rounds: int = 1) -> NDArray[np.float32]:
        """``rounds`` of Cauchy weights of ``scale`` [thresholds] and ``steps`` of conjugate gradients each.

        Returns the residual of every pair [thresholds], NaN for pairs off the map.
        """
        for _ in range(rounds):
            self._weigh(scale)
            self._descend(self._image, self._residual, steps)
        self._weigh(scale)
        residual: NDArray[np.float32] = self._residual.numpy()
        return residual.copy()

    def residual(self) -> NDArray[np.float32]:
        """Residual of every pair [thresholds] for the map as it is, where :meth:`place` has put them last."""
        self._weigh(1.0, self._scratch)
        residual: NDArray[np.float32] = self._other.numpy()
        return residual.copy()

    def unexplained(self, target: NDArray[np.float32], *, steps: int) -> NDArray[np.float32]:
        """What of ``target`` (pairs) no change of the map explains, under the weights of the last :meth:`solve`.

        The projection of variable projection (Golub and Pereyra 1973), by conjugate gradients from no change.
        """
        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.photometric import subtract

        self._other.assign(np.nan_to_num(target).astype(np.float32))
        self._change.zero_()
        self._descend(self._change, self._other, steps)
        inputs = [self._pairs, self._atlas, self._geometry, self._change]
        launch(subtract, self.count, inputs, [self._other], device=self.device)
        rest: NDArray[np.float32] = self._other.numpy()
        return rest.copy()

    def _weigh(self, scale: float, weight: Any = None) -> None:
        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.photometric import weigh

        inputs = [self._pairs, self._atlas, self._geometry, self._image, scale]
        outputs = [self._weight, self._residual] if weight is None else [weight, self._other]
        launch(weigh, self.count, inputs, outputs, device=self.device)

    def _descend(self, image: Any, residual: Any, steps: int) -> None:
        """Conjugate gradients on the normal equations, preconditioned by the diagonal or by :class:`Levels`.

        ``image`` moves so that less is left of ``residual``, which is that of ``image`` as it comes in.
        """
        import warp as wp

        from amiwarp.kernels import descent as cg
        from amiwarp.kernels import photometric as k
        from amiwarp.kernels.launch import launch, launch_slices

        equations = [self._pairs, self._atlas, self._geometry, self._weight]
        unknowns = len(image)
        self._link()
        self._find_diagonal()
        if self._levels is not None:
            self._levels.prepare(equations, self.count, self._sums, self._slices)
        launch_slices(k.apply_transpose, self.count, [*equations, residual], self._slices, device=self.device)
        launch(cg.gather, unknowns, [self._sums], [self._r], device=self.device)
        self._by_segment(cg.start_descent, [self._prior, self._diagonal, image, self._r, self._p], [], 0)
        if self._levels is not None:
            self._correct(0)
            wp.copy(self._p, self._z)
        for _ in range(steps):
            launch_slices(k.apply_normal, self.count, [*equations, self._p], self._slices, device=self.device)
            self._by_segment(cg.finish_product, [self._sums, self._prior, self._p, self._q], [], 1)
            inputs = [self._prior, self._scalars, self._diagonal, self._p, self._q, self._r]
            self._by_segment(cg.descend, inputs, [image], 2)
            self._turn()
            wp.copy(self._scalars, self._scalars, 0, 2, 1)

    def _by_segment(self, kernel: Any, inputs: list[Any], outputs: list[Any], at: int) -> None:
        """Run a kernel that leaves partial sums, and put their total into the scalar ``at``."""
        import warp as wp

        from amiwarp.kernels.descent import sum_partial
        from amiwarp.kernels.launch import launch

        launch(kernel, len(self._partial), inputs, [*outputs, self._partial], device=self.device, smallest=64)
        wp.launch(sum_partial, dim=1, inputs=[self._partial, at, self._scalars], device=self.device)

    def _correct(self, at: int) -> None:
        """The preconditioned residual, and its product with the residual into the scalar ``at``."""
        from amiwarp.kernels.multilevel import dot

        assert self._levels is not None
        assert self.smoothness is not None
        self._levels.correct(self._diagonal, self._prior, self.smoothness.weight, self._r, self._z)
        self._by_segment(dot, [self._r, self._z], [], at)

    def _turn(self) -> None:
        """The next direction."""
        from amiwarp.kernels import multilevel
        from amiwarp.kernels.descent import turn
        from amiwarp.kernels.launch import launch

        if self._levels is None:
            inputs = [self._prior, self._scalars, self._diagonal, self._r]
            launch(turn, len(self._image), inputs, [self._p], device=self.device)
            return
        self._correct(2)
        launch(multilevel.turn_to, len(self._image), [self._scalars, self._z], [self._p], device=self.device)

    def _link(self) -> None:
        """Weights of the links between nodes, from the map as it is."""
        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.prior import link

        if self.smoothness is not None:
            weight, edge = self.smoothness.weight, self.smoothness.edge
            inputs = [self._image, self.tiles.rows, self.tiles.columns, weight, edge]
            launch(link, self.tiles.nodes, inputs, [self._prior.right, self._prior.down], device=self.device)

    @property
    def unknowns(self) -> NDArray[np.float32]:
        """A copy of the map and, behind it, the OFF threshold's excess over the ON threshold and the leak [1/s]."""
        values: NDArray[np.float32] = self._image.numpy()
        return values.copy()

    @unknowns.setter
    def unknowns(self, values: NDArray[np.float32]) -> None:
        self._image.assign(values)

    def maps(self) -> NDArray[np.float32]:
        """The map [ON thresholds], shape (tiles, rows, columns)."""
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        return self.unknowns[: self.tiles.nodes].reshape(shape)

    def coverage(self, scale: float = 1.0) -> NDArray[np.float32]:
        """How much pairs of two events say of each node, with weights of ``scale``, shape (tiles, rows, columns)."""
        weak, self._pairs.weak = self._pairs.weak, 0.0
        self._weigh(scale)
        self._find_diagonal()
        self._pairs.weak = weak
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        diagonal: NDArray[np.float32] = self._diagonal.numpy()[: self.tiles.nodes].reshape(shape)
        return diagonal.copy()

    @property
    def extra(self) -> NDArray[np.float32]:
        """The unknowns behind the map: the leak [thresholds/s], and the OFF threshold's excess."""
        return self.unknowns[self.tiles.nodes :]

    def keep(self, nodes: NDArray[np.bool_]) -> None:
        """Pairs of two events that lie off ``nodes`` (tiles, rows, columns), either of them, are left out: noise."""
        import warp as wp

        cell: NDArray[np.int32] = self._geometry.cell.numpy().copy()
        on = nodes.ravel()
        inside = (cell[:, 0] >= 0) & (self._pairs.on.numpy() < 2)
        off = np.zeros(self.count, np.bool_)
        off[inside] = ~(on[cell[inside, 0]] & on[cell[inside, 1]])
        cell[off] = -1
        self._geometry.cell = wp.array(cell, dtype=wp.vec2i, device=self.device)

    def _find_diagonal(self) -> None:
        from amiwarp.kernels import descent as cg
        from amiwarp.kernels import photometric as k
        from amiwarp.kernels.launch import launch, launch_slices

        equations = [self._pairs, self._atlas, self._geometry, self._weight]
        launch_slices(k.add_diagonal, self.count, equations, self._slices, device=self.device)
        launch(cg.gather, len(self._image), [self._sums], [self._diagonal], device=self.device)
