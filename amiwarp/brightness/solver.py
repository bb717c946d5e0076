"""The scene's log brightness from pairs of events: sparse, matrix-free least squares on the device.

An event states that the log brightness at its pixel changed by one threshold since the last event of that pixel. With L
the map on the prism-free pixel grid and w(x, θ) the compensated coordinates, L(w(x, θ₂)) − L(w(x, θ₁)) = ±C: linear in
L. L is in units of the ON threshold. See ``docs/explanation/photometric.md``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.conjugate_gradients import (
    LEAST_CHUNKS_OF_TWO_THREADS,
    ConjugateGradients,
    NormalEquations,
)
from amiwarp.brightness.multigrid import GridHierarchy
from amiwarp.brightness.pair_chains import FEW_BLOCKS
from amiwarp.brightness.pairs import PairSet
from amiwarp.brightness.positions import PairPositions
from amiwarp.brightness.residuals import Residuals
from amiwarp.brightness.tiles import Tiles
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.kernels import conjugate_gradients as cg
from amiwarp.kernels import equations as eqs
from amiwarp.kernels.launch import BLOCK_DIM, RepeatedLaunches, slice_count
from amiwarp.kernels.program import Program
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model, model_camera

DAMPING = 0.02
"""Weight of the squared map values relative to the equations. It determines unknowns that no equation does."""
CONTRAST = 6.0
"""Mean square of a map [thresholds²] above which its damping may decrease in inverse proportion: the same picture has
larger values in smaller thresholds, and damping that does not follow them flattens it more."""


@dataclass(frozen=True, slots=True)
class Smoothness:
    """Smoothness prior of the map.

    It extends the map into regions without equations, and suppresses isolated outliers.
    """

    weight: float
    """Weight of the squared difference of neighbouring map nodes; an equation from events has weight 1."""
    edge: float = 0.0
    """Difference of neighbouring nodes above which their link weakens (Charbonnier) [thresholds]; 0: all links have
    equal weight."""


class BrightnessMap:
    """Brightness map for a set of pairs of events, and its solver. Owns its buffers; a solve starts from the last map.

    Repeated launches are recorded once (:class:`amiwarp.kernels.program.Program`). No values are copied to
    the host between launches.
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
        """Allocate the buffers.

        ``off_excess``: OFF threshold over ON threshold, minus 1, if it is known; it is then fixed, not solved for.
        ``middle_us``: reference time of a rotating camera, to which the times of the pairs are relative [us]. Raises
        :class:`AmiwarpError` if there are no pairs.
        """
        if not len(pairs):
            raise AmiwarpError(
                "no pixel fired twice in time, so no brightness can be found; give a longer recording",
                ErrorCode.CALIBRATION_REFUSED,
            )
        self.device = wp.get_device(pairs.device)
        self.tiles = tiles
        self.count = len(pairs)
        self.pairs = pairs
        self.middle_us = middle_us
        self.smoothness = smoothness

        self._atlas = eqs.Atlas()
        self._atlas.origin = wp.array(tiles.origin.ravel(), dtype=float, device=self.device)
        self._atlas.rows = tiles.rows
        self._atlas.columns = tiles.columns
        self._atlas.density = tiles.density
        self._atlas.with_leak = float(with_leak)
        self._atlas.with_off = int(off_excess is None)

        # The map, then the sensor's unknowns: leak, and OFF threshold over ON threshold, minus 1.
        unknowns = tiles.nodes + int(cg.EXTRA)
        self._image = self._zeros(unknowns)
        # Sums over the equations in fixed point, a slice for each thread.
        shape = (slice_count(self.device), unknowns)
        self._sums = wp.zeros(shape, dtype=wp.int64, device=self.device)
        self._rows_of_sums = [self._sums[row] for row in range(len(self._sums))]
        self._make_vectors(unknowns)
        self._make_prior(damping, unknowns)
        if off_excess is not None:
            self._prior.held = tiles.nodes + 1  # of the sensor's unknowns, the leak comes first
            self._image[-1:].fill_(off_excess)

        self.residuals = Residuals(pairs, len(tiles.origin))
        self._scale = self._zeros(1)
        self._solved = False
        self._positions = PairPositions(pairs, self._atlas, middle_us)
        self._equations = self._positions.equations
        self._launch = RepeatedLaunches(self.device)

    def _zeros(self, count: int) -> Any:
        return wp.zeros(count, dtype=float, device=self.device)

    def _make_vectors(self, unknowns: int) -> None:
        """Allocate the vectors of the conjugate-gradient method."""
        self._unknowns_per_thread = cg.CPU_WIDTH if self.device.is_cpu else 1
        self._threads = math.ceil(unknowns / self._unknowns_per_thread)
        self._vectors = cg.Unknowns()
        self._vectors.diagonal = self._zeros(unknowns)
        self._vectors.residual = self._zeros(unknowns)
        self._vectors.direction = self._zeros(unknowns)
        self._vectors.product = self._zeros(unknowns)
        # Dot products are sums over parts: one of each thread on a CPU, one of each block on a GPU.
        threads_of_part = 1 if self.device.is_cpu else BLOCK_DIM
        parts = math.ceil(self._threads / threads_of_part)
        self._dots = cg.Dots()
        self._dots.scalars = wp.zeros(2, dtype=wp.float64, device=self.device)
        self._dots.pq = wp.zeros(parts, dtype=wp.float64, device=self.device)
        self._dots.rz = wp.zeros(parts, dtype=wp.float64, device=self.device)

    def _make_prior(self, damping: float, unknowns: int) -> None:
        """Set up damping, smoothness, and the multigrid preconditioner of a single tile."""
        linked = self.smoothness is not None
        links = unknowns if linked else 0
        prior = cg.Prior()
        prior.columns = self.tiles.columns
        prior.damping = wp.full(1, damping, dtype=float, device=self.device)
        prior.linked = int(linked)
        prior.held = unknowns
        prior.right = self._zeros(links)
        prior.down = self._zeros(links)
        prior.smooth = self._zeros(1)
        if self.smoothness is not None:
            prior.smooth.fill_(self.smoothness.weight)
        self._prior = prior
        self._grids = None
        self._preconditioned = self._zeros(0)
        if linked and len(self.tiles.origin) == 1:
            self._grids = GridHierarchy(self.tiles.rows, self.tiles.columns, self.device)
            self._preconditioned = self._zeros(unknowns)

    # -- positions of the pairs

    def place(
        self,
        model: Model,
        *,
        drift: float = 0.0,
        camera_rotation: CameraRotation | None = None,
    ) -> None:
        """Compute the positions of the pairs on the map, for a model and a camera rotation about ``middle_us``."""
        self._positions.place(model, drift, camera_rotation, self._positions.geometry)
        self._equations.take_positions()

    def path_arguments(self, model: Model) -> list[Any]:
        """Return the kernel arguments that describe the map and the paths of the pairs' pixels over it."""
        params = model.params(self.device)
        camera = model_camera(model, self.device)
        return [params, camera, self.pairs.arrays, self._atlas, self._image]

    def find_slope(
        self,
        plus: dict[str, Any],
        minus: dict[str, Any],
        width: float,
    ) -> Any:
        """Return the derivative of each pair's residual along a line in parameter space, for a fixed map.

        It is the change of the residual from the parameters ``minus`` to ``plus``, divided by their distance ``width``.
        Both are keyword arguments of :meth:`place`. They may hold ``arrays`` too, the pairs with other columns, see
        :meth:`PairSet.with_columns`. The positions that :meth:`place` stored remain unchanged.
        """
        return self._positions.find_slope(plus, minus, width, self._image)

    def keep(self, nodes: wp.array) -> None:
        """Exclude pairs of two events, as noise, if either event is off the nodes for which ``nodes`` is 1.

        ``nodes`` is uint8, shape (nodes,), on the device.
        """
        self._positions.keep(nodes)

    # -- solving

    def solve(self, *scales: float, steps: int, rounds: int = 1) -> None:
        """Solve for the map: for each of ``scales``, ``rounds`` times, set the Cauchy weights and run ``steps`` steps.

        The steps are steps of conjugate gradients. A scale is the residual at which an equation gets half weight
        [thresholds]. Afterwards ``residuals`` holds the residual of every pair [thresholds] on the device, NaN for
        pairs off the map.
        """
        for scale in scales:
            self._scale.fill_(scale)
            for _ in range(rounds):
                self._weigh.run()
                self._prepare.run()
                if not self._solved:  # the coarser grids need not follow the weights
                    self._prepare_grids.run()
                    self._solved = True
                self._descent.run(steps)
        self._weigh.run()

    def restart(self, smoothness: float) -> None:
        """Set the map to zero and change the weight of the smoothness prior."""
        self.clear()
        self._prior.smooth.fill_(smoothness)

    def clear(self) -> None:
        """Set the map to zero; leak and threshold remain."""
        self._image[: self.tiles.nodes].zero_()

    def relax_damping(self) -> bool:
        """Reduce the damping if the solved map has a large contrast, and return whether it has."""
        parts = len(self._dots.pq)
        partial = wp.empty((2, parts), dtype=wp.float64, device=self.device)
        # Block sums need whole blocks.
        threads = parts if self.device.is_cpu else parts * BLOCK_DIM
        self._launch(
            cg.sum_seen,
            threads,
            [self._image[: self.tiles.nodes], self._unknowns_per_thread],
            [partial],
            smallest=LEAST_CHUNKS_OF_TWO_THREADS,
        )
        squares, number = partial.numpy().sum(axis=1).tolist()
        if squares <= CONTRAST * number:
            return False
        self.set_damping(DAMPING * CONTRAST * number / squares)
        return True

    def set_damping(self, damping: float) -> None:
        """Change the damping; the map remains, and must be solved again."""
        self._prior.damping.fill_(damping)

    def prepare_projection(self) -> None:
        """Prepare :meth:`unexplained` with the weights that the last :meth:`solve` set."""
        self._prepare.run()

    def add(self, change: Any, factor: float) -> None:
        """Add a change of the map times a factor to the map."""
        self._launch(cg.add_multiple, len(change), [change, factor], [self._image])

    def unexplained(self, target: Any, change: Any = None, *, steps: int) -> Any:
        """Return the part of ``target`` (pairs, on the device) that no change of the map explains.

        This is the projection of variable projection (Golub and Pereyra 1973). It is solved by conjugate gradients that
        start from ``change``, or from none.
        """
        wp.copy(self._projection.residual, target)
        if change is None:
            self._projection.image.zero_()
        else:
            wp.copy(self._projection.image, change)
            self._subtract(change, self._projection.residual)
        self._projection.run(steps)
        unexplained = wp.clone(target)
        self._subtract(self._projection.image, unexplained)
        return unexplained

    def explaining_change(self) -> Any:
        """Return a copy of the change of the map that explains the rest of the last target of :meth:`unexplained`."""
        return wp.clone(self._projection.image)

    def _subtract(self, vector: Any, residual: Any) -> None:
        """Subtract the left sides of the equations, for a ``vector`` of unknowns, from ``residual``."""
        equations = self._equations
        self._launch(
            equations.kernels.subtract,
            equations.threads,
            [*equations.inputs, vector],
            [residual],
            smallest=FEW_BLOCKS,
        )

    @cached_property
    def _weigh(self) -> Any:
        """Program that computes the residuals and the weights of the equations."""
        program = Program(self.device)
        self._add_weigh(program, self.pairs.arrays)
        return program

    def _add_weigh(self, program: Any, pairs: Any) -> None:
        """Add to ``program`` the residuals and weights of ``pairs``, the kernels' struct."""
        equations = self._equations
        _, *positions = equations.inputs
        program.add(
            equations.kernels.weigh,
            equations.threads,
            [pairs, *positions, self._image, self._scale],
            [self.residuals.weight, self.residuals.values],
            smallest=FEW_BLOCKS,
        )

    @cached_property
    def _prepare(self) -> Any:
        """Program that computes the smoothness links and the diagonals for the current weights and map."""
        program = Program(self.device)
        if self.smoothness is not None:
            program.add(
                cg.link,
                self.tiles.nodes,
                [self._image, self.tiles.rows, self.smoothness.edge, self._prior],
                [self._prior.right, self._prior.down],
            )
        self._equations.add_diagonal(program, self.residuals.weight, self._rows_of_sums)
        program.add(
            cg.gather_diagonal,
            len(self._image),
            [self._sums, self._prior],
            [self._vectors.diagonal],
        )
        return program

    @cached_property
    def _prepare_grids(self) -> Any:
        """Program that computes the diagonals of the coarser grids for the current weights."""
        program = Program(self.device)
        if self._grids is not None:
            equations = [self._atlas, self._positions.geometry, self.residuals.weight]
            self._grids.prepare(program, equations, self.count, self._sums, self._rows_of_sums)
        return program

    @cached_property
    def _descent(self) -> ConjugateGradients:
        return ConjugateGradients(self._system, self._image, self.residuals.values)

    @cached_property
    def _projection(self) -> ConjugateGradients:
        image = self._zeros(len(self._image))
        residual = self._zeros(self.pairs.arrays.stride)
        return ConjugateGradients(self._system, image, residual)

    @cached_property
    def _system(self) -> NormalEquations:
        """Normal equations for the current weights, with the buffers that all solutions share."""
        return NormalEquations(
            equations=self._equations,
            weight=self.residuals.weight,
            prior=self._prior,
            grids=self._grids,
            sums=self._sums,
            rows_of_sums=self._rows_of_sums,
            vectors=self._vectors,
            preconditioned=self._preconditioned,
            dots=self._dots,
            unknowns_per_thread=self._unknowns_per_thread,
            threads=self._threads,
            device=self.device,
        )

    # -- results

    @property
    def unknowns(self) -> NDArray[np.float32]:
        """Copy of the unknowns: map, leak [thresholds/s], and OFF threshold over ON threshold, minus 1."""
        values: NDArray[np.float32] = self._image.numpy()
        return values.copy() if self.device.is_cpu else values

    @unknowns.setter
    def unknowns(self, values: NDArray[np.float32] | wp.array) -> None:
        self._image.assign(values)

    def copy_unknowns(self) -> wp.array:
        """Return a copy of the unknowns on the device."""
        return wp.clone(self._image)

    def start_from(self, other: BrightnessMap) -> None:
        """Take map, leak and OFF threshold from ``other``, whose tiles are the same but for their density."""
        step = np.float32(other.tiles.density / self.tiles.density)
        maps = _interpolated(other.maps(), 1, self.tiles.rows, step)
        maps = _interpolated(maps, 2, self.tiles.columns, step)
        self.unknowns = np.concatenate([maps.ravel(), other.extra])

    def maps(self) -> NDArray[np.float32]:
        """Return the map [ON thresholds], shape (tiles, rows, columns)."""
        return self._by_tile(self.unknowns)

    def _by_tile(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return values of the unknowns at the nodes of the map, shape (tiles, rows, columns)."""
        tiles = len(self.tiles.origin)
        of_nodes = values[: self.tiles.nodes]
        return of_nodes.reshape(tiles, self.tiles.rows, self.tiles.columns)

    def coverage(self, scale: float = 1.0) -> NDArray[np.float32]:
        """Return how well pairs of two events determine each node, shape (tiles, rows, columns).

        Each equation contributes its weight for the Cauchy scale ``scale`` [thresholds].
        """
        return self._by_tile(self.coverage_on_device(scale).numpy())

    def coverage_on_device(self, scale: float) -> wp.array:
        """Return :meth:`coverage` as one vector on the device, followed by values of the other unknowns."""
        self._scale.fill_(scale)
        program = Program(self.device)
        # Equations from silence and from the window's ends do not count.
        self._add_weigh(program, self.pairs.with_columns(weak=0.0))
        self._equations.add_diagonal(program, self.residuals.weight, self._rows_of_sums)
        out = self._zeros(len(self._image))
        program.add(cg.gather, len(out), [self._sums], [out])
        program.launch()
        return out

    @property
    def extra(self) -> NDArray[np.float32]:
        """Unknowns after the map: the leak [thresholds/s], and OFF threshold over ON threshold, minus 1."""
        values: NDArray[np.float32] = self._image[self.tiles.nodes :].numpy()
        return values.copy() if self.device.is_cpu else values


def _interpolated(
    maps: NDArray[Any],
    axis: int,
    count: int,
    step: np.float32,
) -> NDArray[Any]:
    """Return maps with ``count`` nodes along an axis, ``step`` of their present nodes apart, interpolated linearly."""
    last = maps.shape[axis] - 1
    place = np.minimum(np.arange(count, dtype=np.float32) * step, last)
    below = np.minimum(place.astype(np.int64), last - 1)
    shape = [1, 1, 1]
    shape[axis] = count
    share = (place - below).reshape(shape)
    of_below = maps.take(below, axis) * (1.0 - share)
    of_above = maps.take(below + 1, axis) * share
    return of_below + of_above
