"""The scene's log brightness from pairs of events: sparse, matrix-free least squares on the device.

An event states that the log brightness at its pixel changed by one threshold since the last event of that pixel. With L
the map on the prism-free pixel grid and w(x, θ) the compensated coordinates, L(w(x, θ₂)) − L(w(x, θ₁)) = ±C: linear in
L. L is in units of the ON threshold. See ``docs/explanation/photometric.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, pairwise
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.event_pairs import FEW_BLOCKS, PairPositions, PairSet
from amiwarp.errors import AmiwarpError
from amiwarp.kernels import conjugate_gradients as cg
from amiwarp.kernels import equations as eqs
from amiwarp.kernels import multilevel
from amiwarp.kernels import slow_pixels as slow_kernels
from amiwarp.kernels.conjugate_gradients import gather
from amiwarp.kernels.launch import BLOCK_DIM, SMALLEST_SLICE, Program, RepeatedLaunches, launch, slice_count, start_read
from amiwarp.optics.camera import CameraRotation
from amiwarp.optics.models import Model, model_camera

_Step = tuple[Any, int, list[Any], list[Any], int]  # kernel, number of threads, inputs, outputs, smallest slice


# Multigrid preconditioner for large maps.
#
# Corrections are computed on coarser and coarser grids, which transport brightness far across the map.

COARSEST = 6
"""Smallest number of rows or columns of a grid; coarser grids are not made."""
STRIDES = (3, 5, 11, 23)
"""Every how many pairs one is used to estimate the diagonal of the first grid, the second, the third, and the further
ones. They have no common divisor with the usual numbers of pairs per silent pixel. With fewer pairs, more steps are
needed."""
SMALL = 2048
"""Largest number of nodes of a grid that a single block of threads processes on CUDA, with all coarser grids."""


class GridHierarchy:
    """Grids over one tile of (rows, columns) map nodes. Each grid has twice the node spacing of the previous grid."""

    def __init__(self, rows: int, columns: int, device: Any) -> None:
        """Allocate the grids over a tile of ``rows`` × ``columns`` nodes."""
        self.shapes = [(rows, columns)]
        while min(self.shapes[-1]) // 2 + 1 >= COARSEST:
            self.shapes.append((self.shapes[-1][0] // 2 + 1, self.shapes[-1][1] // 2 + 1))
        sizes = [r * c for r, c in self.shapes[1:]]
        self._first = [sum(sizes[:k]) for k in range(len(sizes) + 1)]
        self._all = [wp.zeros(sum(sizes), dtype=float, device=device) for _ in range(3)]
        self._diagonal, self._residual, self._correction = (
            [one[a:b] for a, b in pairwise(self._first)] for one in self._all
        )

    def prepare(self, program: Any, equations: list[Any], count: int, sums: Any, slices: list[Any]) -> None:
        """Add to ``program`` the computation of the grids' diagonals for the current weights of the equations."""
        for level, diagonal in enumerate(self._diagonal, start=1):
            stride = STRIDES[min(level, len(STRIDES)) - 1]
            inputs = [*equations, float(2**level), self.shapes[level][1], stride]
            program.add_slices(multilevel.add_coarse_diagonal, count // stride, inputs, slices)
            program.add(gather, len(diagonal), [sums], [diagonal])

    def correct(self, program: Any, diagonal: Any, prior: Any, residual: Any, out: Any) -> None:
        """Add to ``program`` the step ``out`` = sum of the grids' corrections for the finest grid's ``residual``."""
        if not self._correction:
            program.add(multilevel.divide, len(out), [diagonal, residual], [out])
            return
        steps = self._steps_by_rows if program.device.is_cpu else self._steps_by_nodes
        for kernel, n, inputs, outputs, smallest in steps(diagonal, prior, residual, out):
            program.add(kernel, n, inputs, outputs, smallest=smallest)

    def _restrictions(self, residual: Any, prior: Any) -> Iterator[tuple[list[Any], list[Any]]]:
        """Yield inputs and outputs of the restriction to each grid but the finest."""
        fines = [residual, *self._residual]
        for level, (fine, *outputs) in enumerate(zip(fines, self._residual, self._correction, strict=False)):
            yield [fine, *self.shapes[level], self._diagonal[level], prior, 4.0 ** (level + 1)], outputs

    def _steps_by_rows(self, diagonal: Any, prior: Any, residual: Any, out: Any) -> Iterator[_Step]:
        """Yield the launches of :meth:`correct` with a row of nodes per thread."""
        grids = zip(self.shapes[1:], self._restrictions(residual, prior), strict=True)
        for (rows, columns), (inputs, outputs) in grids:
            yield multilevel.restrict_rows, rows, inputs, outputs, SMALLEST_SLICE // (4 * columns) + 1
        for level in range(len(self._correction) - 1, -1, -1):
            rows, columns = self.shapes[level]
            inputs, smallest = [self._correction[level], self.shapes[level + 1][1]], SMALLEST_SLICE // columns + 1
            if level:
                outputs = [self._correction[level - 1]]
                yield multilevel.prolong_rows, rows, [*inputs, columns], outputs, smallest
            else:
                inputs += [rows, columns, diagonal, residual]
                yield multilevel.prolong_rows_to_finest, rows, inputs, [out], smallest

    def _steps_by_nodes(self, diagonal: Any, prior: Any, residual: Any, out: Any) -> Iterator[_Step]:
        """Yield the launches of :meth:`correct` with a node per thread, and the small grids in one block of threads."""
        small = sum(rows * columns <= SMALL for rows, columns in self.shapes[2:])
        large = len(self._correction) - small
        for inputs, outputs in islice(self._restrictions(residual, prior), large):
            yield multilevel.restrict, len(outputs[0]), inputs, outputs, SMALLEST_SLICE
        if small:
            all_diagonals, *outputs = self._all
            inputs = [*self.shapes[large], self._first[large - 1], small, all_diagonals, prior, 4.0**large]
            yield multilevel.correct_small, BLOCK_DIM, inputs, outputs, SMALLEST_SLICE
        for level in range(large if small else large - 1, 0, -1):
            rows, columns = self.shapes[level]
            inputs, outputs = [self._correction[level], rows, columns], [self._correction[level - 1]]
            yield multilevel.prolong, rows * columns, inputs, outputs, SMALLEST_SLICE
        inputs = [self._correction[0], *self.shapes[0], diagonal, residual]
        yield multilevel.prolong_to_finest, len(out), inputs, [out], SMALLEST_SLICE


# Tiles of the brightness map.


@dataclass(frozen=True, slots=True)
class Tiles:
    """Rectangular parts of the map, all of the same size, with nodes ``1 / density`` px apart."""

    origin: NDArray[np.float32]
    """Pixel coordinates (x, y) of each tile's first node [px], shape (tiles, 2)."""
    rows: int
    """Number of rows of nodes per tile."""
    columns: int
    """Number of columns of nodes per tile."""
    density: float = 2.0
    """Map nodes per pixel along each axis."""

    @property
    def nodes(self) -> int:
        """Total number of map nodes."""
        return len(self.origin) * self.rows * self.columns

    def at_density(self, density: float) -> Tiles:
        """Return tiles of the same place and size with another number of nodes per pixel along each axis."""
        rows, columns = (math.ceil((n - 1) * density / self.density) + 1 for n in (self.rows, self.columns))
        return replace(self, rows=rows, columns=columns, density=density)


# Statistics of the residuals of a map's equations, computed on the device: mean cost, sums, median.

CHUNKS = 8
"""Smallest number of chunks of a vector for which a second CPU thread is used."""
SUM_COPIES = 64
"""Number of copies of each tile's sum on a GPU."""


class Residuals:
    """Residuals of the equations of ``pairs`` [thresholds] and the equations' weights.

    A pair off the map has the residual NaN.
    """

    def __init__(self, pairs: PairSet, tiles: int) -> None:
        self.pairs, self.tiles, self.device, self.count = pairs, tiles, wp.get_device(pairs.device), len(pairs)
        n = pairs.arrays.stride
        self.values, self.weight = (wp.zeros(n, dtype=float, device=self.device) for _ in "vw")
        self._width = int(cg.CPU_WIDTH) if self.device.is_cpu else 1
        self._launch = RepeatedLaunches(self.device)

    def start_mean_cost(self, scale: float, *, missing: float = math.nan, held: bool = False) -> Callable[[], float]:
        """Start to compute the mean Cauchy cost of the residuals, and return a function that waits for it.

        That is log(1 + (r / ``scale``)²) for the residuals r of all pairs or the held-out ones. ``held``: whether only
        held-out pairs count. ``missing``: residual of pairs off the map; NaN excludes these pairs.
        """
        threads, parts = self._sum_shape
        partial = self._doubles(2, parts)
        inputs = [self.values, self.pairs.arrays.on, int(eqs.HELD) * held, self.count, scale, missing, self._width]
        self._launch(eqs.sum_costs, threads, inputs, [partial], smallest=CHUNKS)
        sums = start_read(partial)

        def result() -> float:
            total, number = sums().sum(axis=1)
            return float(total / number) if number else math.nan

        return result

    def start_products(self, factors: list[tuple[Any, Any]]) -> Callable[[], NDArray[np.float64]]:
        """Start to sum a · b · weight over the pairs, for each (a, b) on the device.

        Return a function that waits for the sums.
        """
        threads, parts = self._sum_shape
        partial = self._doubles(len(factors), parts)
        for k, (a, b) in enumerate(factors):
            inputs = [a, b, self.weight, self.count, self._width]
            self._launch(eqs.sum_products, threads, inputs, [partial[k]], smallest=CHUNKS)
        sums = start_read(partial)
        return lambda: np.asarray(sums().sum(axis=1))

    def start_clusters(self, slopes: list[Any]) -> Callable[[], NDArray[np.float64]]:
        """Start to sum slope · weight · residual over clusters of neighbouring pairs.

        Return a function that waits for the sums, shape (slopes, clusters).
        """
        size = self.tiles if self.tiles > 1 else 1 << 20
        rows = []
        for slope in slopes:
            # on a GPU, many threads would wait for each other to add to the few sums of the tiles
            copies = SUM_COPIES if self.device.is_cuda and self.tiles > 1 else 1
            sums = wp.zeros((2, size * copies), dtype=wp.int64, device=self.device)
            inputs = [self.pairs.arrays, self.tiles, copies, slope, self.weight, self.values, 0, sums]
            # one CPU thread only: several would add to the same sums
            wp.launch(eqs.add_clusters, self.count, inputs=inputs, device=self.device)
            # the sums of one tile are too large for page-locked memory
            rows.append(start_read(sums) if self.tiles > 1 else sums.numpy)

        def result() -> NDArray[np.float64]:
            both = [row().reshape(2, size, -1).sum(axis=2) for row in rows]
            return np.array([total[number > 0] / 2.0**32 for total, number in both])

        return result

    def products_by_square(
        self, factors: list[Any], side: int, columns: int, rows: int
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return sums of a · b · weight over the pairs of each square of pixels, for all a and b of ``factors``.

        The factors are on the device. The squares have ``side`` pixels along each axis; there are ``columns`` x
        ``rows`` of them. Those without pairs are left out, and so are pairs for which any factor is NaN. Return the
        sums, shape (squares, factors, factors), and the numbers of the squares, row by row, shape (squares,).
        """
        n, squares = self.count, columns * rows
        values = wp.empty((len(factors), n), dtype=float, device=self.device)
        for k, factor in enumerate(factors):
            wp.copy(values[k], factor, count=n)
        square, order = (wp.empty(2 * n, dtype=int, device=self.device) for _ in "so")
        inputs = [self.pairs.arrays, values, side, columns, squares]
        launch(eqs.find_squares, n, inputs, [square, order], device=self.device)
        wp.utils.radix_sort_pairs(square, order, n, end_bit=squares.bit_length())
        starts = wp.empty(squares + 1, dtype=int, device=self.device)
        launch(eqs.find_starts, squares + 1, [square, n], [starts], device=self.device)
        upper = np.triu_indices(len(factors))
        sums = self._doubles(squares, len(upper[0]))
        inputs = [values, self.weight, order, starts]
        if self.device.is_cpu and len(factors) <= eqs.MOST_ROWS:
            launch(eqs.sum_squares, squares, inputs, [sums], device="cpu", smallest=CHUNKS)
        else:
            lanes = 1 if self.device.is_cpu else 32
            inputs += [*(wp.array(k, dtype=int, device=self.device) for k in upper), lanes]
            launch(eqs.sum_square_products, lanes * sums.size, inputs, [sums], device=self.device, smallest=CHUNKS)
        used = np.flatnonzero(np.diff(starts.numpy()))
        found = np.empty((len(used), len(factors), len(factors)))
        found[:, upper[0], upper[1]] = found[:, upper[1], upper[0]] = sums.numpy()[used]
        return found, used

    def median(self) -> float:
        """Return the median absolute residual; NaN if there is none."""
        return self.start_median(self.count)()

    def start_median(self, n: int) -> Callable[[], float]:
        """Start to compute the median absolute residual of the first ``n`` pairs, NaN if there is none.

        Return a function that waits for it.
        """
        if self.device.is_cpu:
            values = np.abs(self.values.numpy()[:n])
            values = values[np.isfinite(values)]
            found = float(np.median(values)) if len(values) else math.nan
            return lambda: found
        keys, order = (wp.empty(2 * n, dtype=t, device=self.device) for t in (float, int))
        number = wp.zeros(1, dtype=int, device=self.device)
        wp.launch(eqs.magnitudes, n, inputs=[self.values, 0, keys, number], device=self.device)
        wp.utils.radix_sort_pairs(keys, order, n)

        def result() -> float:
            known = int(number.numpy()[0])
            return float(keys[(known - 1) // 2 : known // 2 + 1].numpy().mean()) if known else math.nan

        return result

    @cached_property
    def _sum_shape(self) -> tuple[int, int]:
        """Numbers of threads and of partial sums for a sum over all pairs."""
        if self.device.is_cpu:
            threads = -(-self.count // self._width)
            return threads, threads
        blocks = -(-self.count // BLOCK_DIM)  # block sums need whole blocks
        return blocks * BLOCK_DIM, blocks

    def _doubles(self, *shape: int) -> Any:
        return wp.empty(shape, dtype=wp.float64, device=self.device)


FEW_CHUNKS = 16
"""Smallest number of chunks of the unknowns for which a second CPU thread is used. Fewer take less time than the
hand-over to a thread."""
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

    Repeated launches are recorded once (:class:`amiwarp.kernels.launch.Program`). No values are copied to
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
            raise AmiwarpError("no pixel fired twice in time, so no brightness can be found; give a longer recording")
        self.device, self.tiles, self.count = wp.get_device(pairs.device), tiles, len(pairs)
        self.pairs, self.middle_us, self.smoothness = pairs, middle_us, smoothness
        self._atlas = eqs.Atlas()
        self._atlas.origin = wp.array(tiles.origin.ravel(), dtype=float, device=self.device)
        self._atlas.rows, self._atlas.columns, self._atlas.density = tiles.rows, tiles.columns, tiles.density
        self._atlas.with_leak, self._atlas.with_off = float(with_leak), int(off_excess is None)
        unknowns = tiles.nodes + int(cg.EXTRA)
        self._image = self._zeros(unknowns)
        self._sums = wp.zeros((slice_count(self.device), unknowns), dtype=wp.int64, device=self.device)
        self._slices = [self._sums[k] for k in range(len(self._sums))]
        self._make_vectors(unknowns)
        self._make_prior(damping, unknowns)
        if off_excess is not None:
            self._prior.held = tiles.nodes + 1  # of the sensor unknowns, the leak comes first
            self._image[-1:].fill_(off_excess)
        self.residuals = Residuals(pairs, len(tiles.origin))
        self._scale, self._solved = self._zeros(1), False
        self._at = PairPositions(pairs, self._atlas, middle_us)
        self._equations, self._launch = self._at.equations, RepeatedLaunches(self.device)

    def _zeros(self, n: int) -> Any:
        return wp.zeros(n, dtype=float, device=self.device)

    def _make_vectors(self, unknowns: int) -> None:
        """Allocate the vectors of the conjugate-gradient method."""
        self._width = cg.CPU_WIDTH if self.device.is_cpu else 1
        self._threads = -(-unknowns // self._width)
        self._u, self._dots = cg.Unknowns(), cg.Dots()
        for name in ("diagonal", "residual", "direction", "product"):
            setattr(self._u, name, self._zeros(unknowns))
        parts = -(-self._threads // (1 if self.device.is_cpu else BLOCK_DIM))
        for name, n in (("scalars", 2), ("pq", parts), ("rz", parts)):
            setattr(self._dots, name, wp.zeros(n, dtype=wp.float64, device=self.device))

    def _make_prior(self, damping: float, unknowns: int) -> None:
        """Set up damping, smoothness, and the multigrid preconditioner of a single tile."""
        linked = self.smoothness is not None
        self._prior = cg.Prior()
        self._prior.columns = self.tiles.columns
        self._prior.damping = wp.full(1, damping, dtype=float, device=self.device)
        self._prior.linked, self._prior.held = int(linked), unknowns
        self._prior.right, self._prior.down = (self._zeros(unknowns * linked) for _ in "xy")
        self._prior.smooth = self._zeros(1)
        if self.smoothness is not None:
            self._prior.smooth.fill_(self.smoothness.weight)
        one = linked and len(self.tiles.origin) == 1
        self._grids = GridHierarchy(self.tiles.rows, self.tiles.columns, self.device) if one else None
        self._z = self._zeros(unknowns * one)

    # -- positions of the pairs

    def place(self, model: Model, *, drift: float = 0.0, camera_rotation: CameraRotation | None = None) -> None:
        """Compute the positions of the pairs on the map, for a model and a camera rotation about ``middle_us``."""
        self._at.place(model, drift, camera_rotation, self._at.geometry)
        self._equations.take_positions()

    def path_arguments(self, model: Model) -> list[Any]:
        """Return the kernel arguments that describe the map and the paths of the pairs' pixels over it."""
        camera = model_camera(model, self.device)
        return [model.params(self.device), camera, self.pairs.arrays, self._atlas, self._image]

    def find_slope(self, plus: dict[str, Any], minus: dict[str, Any], width: float) -> Any:
        """Return the derivative of each pair's residual along a line in parameter space, for a fixed map.

        It is the change of the residual from the parameters ``minus`` to ``plus``, divided by their distance ``width``.
        Both are keyword arguments of :meth:`place`. The positions that :meth:`place` stored remain unchanged.
        """
        return self._at.find_slope(plus, minus, width, self._image)

    def keep(self, nodes: wp.array) -> None:
        """Exclude pairs of two events, as noise, if either event is off the nodes for which ``nodes`` is 1.

        ``nodes`` is uint8, shape (nodes,), on the device.
        """
        self._at.keep(nodes)

    # -- solving

    def solve(self, *scales: float, steps: int, rounds: int = 1) -> None:
        """Solve for the map: for each of ``scales``, ``rounds`` times, set the Cauchy weights and run ``steps`` steps.

        The steps are those of conjugate gradients. A scale is the residual at which an equation gets half weight
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
        threads = parts if self.device.is_cpu else parts * BLOCK_DIM  # block sums need whole blocks
        inputs = [self._image[: self.tiles.nodes], self._width]
        self._launch(cg.sum_seen, threads, inputs, [partial], smallest=FEW_CHUNKS)
        squares, number = partial.numpy().sum(axis=1).tolist()
        if squares <= CONTRAST * number:
            return False
        self._prior.damping.fill_(DAMPING * CONTRAST * number / squares)
        return True

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
        rest = wp.clone(target)
        self._subtract(self._projection.image, rest)
        return rest

    def explaining_change(self) -> Any:
        """Return a copy of the change of the map that explains the rest of the last target of :meth:`unexplained`."""
        return wp.clone(self._projection.image)

    def _subtract(self, vector: Any, residual: Any) -> None:
        """Subtract the left sides of the equations, for a ``vector`` of unknowns, from ``residual``."""
        equations, inputs = self._equations, [*self._equations.inputs, vector]
        self._launch(equations.kernels.subtract, equations.threads, inputs, [residual], smallest=FEW_BLOCKS)

    @cached_property
    def _weigh(self) -> Any:
        """Program that computes the residuals and the weights of the equations."""
        program = Program(self.device)
        self._add_weigh(program)
        return program

    def _add_weigh(self, program: Any) -> None:
        equations, out = self._equations, [self.residuals.weight, self.residuals.values]
        inputs = [*equations.inputs, self._image, self._scale]
        program.add(equations.kernels.weigh, equations.threads, inputs, out, smallest=FEW_BLOCKS)

    @cached_property
    def _prepare(self) -> Any:
        """Program that computes the smoothness links and the diagonals for the current weights and map."""
        program = Program(self.device)
        if self.smoothness is not None:
            inputs = [self._image, self.tiles.rows, self.smoothness.edge, self._prior]
            program.add(cg.link, self.tiles.nodes, inputs, [self._prior.right, self._prior.down])
        self._equations.add_diagonal(program, self.residuals.weight, self._slices)
        program.add(cg.gather_diagonal, len(self._image), [self._sums, self._prior], [self._u.diagonal])
        return program

    @cached_property
    def _prepare_grids(self) -> Any:
        """Program that computes the diagonals of the coarser grids for the current weights."""
        program = Program(self.device)
        if self._grids is not None:
            equations = [self._atlas, self._at.geometry, self.residuals.weight]
            self._grids.prepare(program, equations, self.count, self._sums, self._slices)
        return program

    @cached_property
    def _descent(self) -> _ConjugateGradients:
        return _ConjugateGradients(self, self._image, self.residuals.values)

    @cached_property
    def _projection(self) -> _ConjugateGradients:
        return _ConjugateGradients(self, self._zeros(len(self._image)), self._zeros(self.pairs.arrays.stride))

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

    def maps(self) -> NDArray[np.float32]:
        """Return the map [ON thresholds], shape (tiles, rows, columns)."""
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        return self.unknowns[: self.tiles.nodes].reshape(shape)

    def coverage(self, scale: float = 1.0) -> NDArray[np.float32]:
        """Return how well pairs of two events determine each node, shape (tiles, rows, columns).

        Each equation contributes its weight for the Cauchy scale ``scale`` [thresholds].
        """
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        found: NDArray[np.float32] = self.coverage_on_device(scale).numpy()
        return found[: self.tiles.nodes].reshape(shape)

    def coverage_on_device(self, scale: float) -> wp.array:
        """Return :meth:`coverage` as one vector on the device, followed by values of the other unknowns."""
        self._scale.fill_(scale)
        weak, self.pairs.arrays.weak = self.pairs.arrays.weak, 0.0
        program = Program(self.device)
        self._add_weigh(program)
        self._equations.add_diagonal(program, self.residuals.weight, self._slices)
        out = self._zeros(len(self._image))
        program.add(cg.gather, len(out), [self._sums], [out])
        program.launch()
        self.pairs.arrays.weak = weak
        return out

    @property
    def extra(self) -> NDArray[np.float32]:
        """Unknowns after the map: the leak [thresholds/s], and OFF threshold over ON threshold, minus 1."""
        values: NDArray[np.float32] = self._image[self.tiles.nodes :].numpy()
        return values.copy() if self.device.is_cpu else values


class _ConjugateGradients:
    """Conjugate gradients on the normal equations, preconditioned by the diagonal or by :class:`GridHierarchy`.

    They change ``image`` to reduce ``residual``, which must be the residual of the initial ``image``.
    """

    def __init__(self, of: BrightnessMap, image: Any, residual: Any) -> None:
        self.image, self.residual = image, residual
        self._map, self._start, self._step = of, Program(of.device), Program(of.device)
        of._equations.add_transpose(self._start, of.residuals.weight, residual, of._slices)
        self._add(self._start, cg.start_descent, [of._sums, of._prior, image], [of._u, of._dots])
        if of._grids is None:
            self._add(self._step, cg.update_search_direction, [], [of._u, of._dots])
        else:
            self._add(self._step, cg.update_search_direction_with, [of._z], [of._u, of._dots])
        of._equations.add_product(self._step, of.residuals.weight, of._u.direction, of._slices)
        self._add(self._step, cg.finish_product, [of._sums, of._prior], [of._u, of._dots])
        self._add(self._step, cg.descend, [], [image, of._u, of._dots])
        if of._grids is not None:
            for program in (self._start, self._step):  # preconditioned residual, and its product with the residual
                of._grids.correct(program, of._u.diagonal, of._prior, of._u.residual, of._z)
                self._add(program, cg.dot, [of._u.residual, of._z], [of._dots.rz])

    def run(self, steps: int) -> None:
        """Start from the current ``image`` and run ``steps`` iterations."""
        self._start.run()
        self._step.run(steps)

    def _add(self, program: Any, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        program.add(kernel, self._map._threads, [*inputs, self._map._width], outputs, smallest=FEW_CHUNKS)


# Pixels with slow photoreceptors: their events come late and from a smaller orbit, the more so the darker they are.
#
# A photoreceptor is modelled as a first-order low-pass filter whose rate is proportional to the light (Delbruck and
# Mead, ISCAS 1994). At an angular speed ω, a filter with time constant τ sees a circular orbit rotated by atan(ω τ) and
# contracted by cos(atan(ω τ)), exactly so where the brightness is linear over the orbit. What the filter's output
# differs from that elsewhere is computed along the prism's path and moved to the right side of the equations.

SAMPLED = 1 << 13
"""Smallest number of pairs whose brightness gives the median of all; all are used if there are fewer."""
THRESHOLD = 0.25
"""Assumed ON threshold [log intensity], which turns the map's brightness into light. Data sheets state 0.1 to 0.4."""


def darkness(brightness: BrightnessMap, model: Model, *, ahead: float = 0.0) -> tuple[Any, float]:
    """Return the time constant at each event, relative to that at the median brightness of all, and that brightness.

    Parameters
    ----------
    brightness : BrightnessMap
        Solved map.
    model : Model
        Model with the phase at which the map was solved.
    ahead : float, default 0.0
        Angle by which the prism is ahead of that phase, because the events come late [rad].

    Returns
    -------
    relative : warp.array
        Relative time constants at the first and the second event of each pair, shape (2, n) padded to (2, m).
    middle : float
        Median brightness [ON thresholds].
    """
    pairs, device = brightness.pairs, brightness.device
    pixels = slow_kernels.Photoreceptor()
    pixels.ahead = ahead

    def compute(every: int, columns: int) -> Any:
        out = wp.empty((2, columns), dtype=float, device=device)
        inputs = [*brightness.path_arguments(model), pixels, every]
        launch(slow_kernels.find_time_constants, -(-len(pairs) // every), inputs, [out], device=device)
        return out

    every = max(1, len(pairs) // SAMPLED)
    pixels.middle = float(np.nanmedian(compute(every, -(-len(pairs) // every)).numpy()))
    pixels.threshold = THRESHOLD
    return compute(1, pairs.arrays.stride), pixels.middle


def set_lags(brightness: BrightnessMap, model: Model, turn: float, *, with_offsets: bool) -> None:
    """Give the pairs the lags of slow pixels, relative to the mean lag, which remains part of the phase.

    Parameters
    ----------
    brightness : BrightnessMap
        Solved map, whose pairs have lags (:meth:`PairSet.clear_lags`).
    model : Model
        Model with the phase at which the map was solved.
    turn : float
        Angle by which the prism turns within the time constant at median brightness [rad].
    with_offsets : bool
        Whether to compute what the filter's output differs from the brightness on the contracted orbit. The map must
        have been solved with lags.
    """
    pairs, ahead = brightness.pairs, math.atan(turn)
    relative, middle = darkness(brightness, model, ahead=ahead if with_offsets else 0.0)
    lag = np.arctan(turn * relative.numpy()[:, : len(pairs)])
    factor = np.cos(lag) * np.exp(1j * (ahead - lag))
    values = np.zeros((4, pairs.arrays.stride), np.float32)
    values[0] = values[2] = 1.0
    values[0::2, : len(pairs)], values[1::2, : len(pairs)] = factor.real, factor.imag
    pairs.arrays.lag.assign(values.ravel())
    pairs.arrays.offset.zero_()
    if with_offsets:
        filtering = slow_kernels.Photoreceptor()
        filtering.threshold, filtering.middle, filtering.turn, filtering.ahead = THRESHOLD, middle, turn, ahead
        inputs = [*brightness.path_arguments(model), filtering]
        launch(slow_kernels.find_offsets, len(pairs), inputs, [pairs.arrays.offset], device=brightness.device)
