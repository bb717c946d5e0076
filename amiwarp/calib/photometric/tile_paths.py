"""Paths on which the scenes of tiles move in the image of a moving camera: fast changes of rotation, and parallax."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.solver import BrightnessMap
from amiwarp.calib.photometric.cauchy import cauchy_costs
from amiwarp.kernels.map_positions import PATH_TERMS as POWERS

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

PATH_TERMS = int(POWERS)
"""Number of powers of time in the path of a tile. With four, the motion of a hand over two turns leaves under 0.001 px;
with two it leaves 0.015 px."""
FAST_PATH_TERMS = 3
"""The same for a camera in fast motion over a turn and a half. With one, orbits come out larger by up to 0.03 px."""
SLOPE_PX = 0.005
"""Step of the finite differences that give the derivatives of the residuals [px]."""
LONGEST_STEP_PX = 1.0
"""Largest change of a path in one step [px]."""
PATH_RIDGE = 1e-4
"""Damping of the paths of tiles, a share of their mean curvature: a scene of parallel edges does not determine both
directions."""


class TilePaths:
    """Paths on which the scene of each tile of a :class:`BrightnessMap` moves in the image, beyond the rotation.

    A path is a polynomial of time. As the map, it is a nuisance: derivatives by the parameters lose the part that a
    change of the paths explains.
    """

    def __init__(self, brightness: BrightnessMap, terms: int) -> None:
        """Start with tiles at rest. ``terms`` is the number of powers of time."""
        pairs = brightness.pairs
        self._map = brightness
        self.tile: NDArray[np.int32] = pairs.column("tile")
        """Tile of each pair."""
        # Pairs in the order of their tiles, the tiles that have pairs, and the first pair of each of these
        self._order = np.argsort(self.tile, kind="stable")
        self._used, self._starts = np.unique(self.tile[self._order], return_index=True)

        half_s = max(0.5 * float(np.ptp(pairs.some_times)), 1e-6)
        per_px = half_s ** -np.arange(1.0, PATH_TERMS + 1.0)
        powers = np.diag(per_px)[:terms]
        self._units = np.kron(np.eye(2), powers)
        """Factors of the powers of time that move a tile by 1 px at the ends of the window, shape (terms, powers)."""
        tiles = len(brightness.tiles.origin)
        self.moved_px: Vector = np.zeros((tiles, 2 * terms))
        """Motion until the end of the window by each power of time along x, then y [px], shape (tiles, terms)."""
        # Derivatives of the map by each power of time
        self._changes: list[Any] = []
        # Changes of the paths that explain most of each parameter's derivative
        self._slopes: list[Vector] = []

    def set(self, moved_px: Vector) -> None:
        """Set the paths."""
        self.moved_px = moved_px
        self._map.pairs.set_path(self._factors_of_time(moved_px))

    def _factors_of_time(self, moved_px: Vector) -> Vector:
        """Return the factors of the powers of time for paths [px]."""
        return np.asarray(moved_px @ self._units)

    def linearise(
        self,
        v: Vector,
        at: Mapping[str, Any],
        steps: int,
    ) -> None:
        """Compute the derivatives of the residuals by the paths, at a point ``v`` where the map is solved.

        ``at`` are the arguments of :meth:`BrightnessMap.place` there.
        """
        brightness = self._map
        terms = len(self._units)
        known: list[Any] = self._changes or [None] * terms
        columns: list[Vector] = []
        self._at = v
        self._base = self.moved_px
        self._changes = []
        self._slopes = []
        for term, change in enumerate(known):
            slope = self._slope_by(term, at)
            unexplained = brightness.unexplained(slope, change, steps=steps)
            columns.append(self._on_host(unexplained))
            self._changes.append(brightness.explaining_change())

        # The normal equations of each tile, which is independent of the others.
        left = np.stack(columns, axis=1)
        weight = self._on_host(brightness.residuals.weight)
        weighted = left * weight[:, None]
        products = left[:, :, None] * weighted[:, None, :]
        hessian = self._sums(products)
        curvature = np.trace(hessian, axis1=1, axis2=2)
        ridge = PATH_RIDGE * curvature / terms + 1e-9
        damped = hessian + ridge[:, None, None] * np.eye(terms)
        self._left = left
        self._weight = weight
        self._inverse = np.linalg.inv(damped)
        self._step = -self._factors(brightness.residuals.values)

    def _slope_by(self, term: int, at: Mapping[str, Any]) -> Any:
        """Return the derivative of the residuals by one term of all paths, on the device."""
        pairs = self._map.pairs
        step = np.zeros_like(self.moved_px)
        step[:, term] = SLOPE_PX
        further = self._factors_of_time(self.moved_px + step)
        less_far = self._factors_of_time(self.moved_px - step)
        ahead = pairs.with_columns(path=pairs.path_array(further))
        behind = pairs.with_columns(path=pairs.path_array(less_far))
        return self._map.find_slope(
            {**at, "arrays": ahead},
            {**at, "arrays": behind},
            2.0 * SLOPE_PX,
        )

    def unexplained(self, column: Any) -> Any:
        """Return the part of a derivative, on the device, that no change of the paths explains."""
        factors = self._factors(column)
        self._slopes.append(factors)
        factors_of_pairs = factors[self.tile]
        explained = np.einsum("ij,ij->i", self._left, factors_of_pairs)
        rest = column.numpy().copy()
        rest[: len(explained)] -= explained
        return wp.array(rest, dtype=float, device=column.device)

    def gain(self) -> float:
        """Return the share of a tile's squared residuals that the next step of its path removes.

        It is the share that a quarter of the tiles exceed: the others may show moving objects.
        """
        residual = self._on_host(self._map.residuals.values)
        weighted = residual * self._weight
        gradient = self._sums(self._left * weighted[:, None])
        removed = -(gradient * self._step).sum(axis=1)
        squares = self._sums(residual**2 * self._weight)
        share = removed[self._used] / squares[self._used]
        return float(np.quantile(share, 0.75))

    def follow(self, v: Vector) -> None:
        """Change the paths, and the map with them, as :meth:`linearise` predicts for a search vector ``v`` nearby."""
        step = v - self._at
        own_step = np.clip(self._step, -LONGEST_STEP_PX, LONGEST_STEP_PX)
        slopes = self._slopes[: len(step)]
        explained = np.tensordot(step, slopes, 1)
        moved = self._base + own_step - explained
        change = moved - self.moved_px
        self.set(moved)

        # The map of each tile follows its own path.
        tiles = len(change)
        nodes = self._map.tiles.nodes
        image = self._map.unknowns
        for term, derivative in enumerate(self._changes):
            of_map = derivative.numpy()[:nodes]
            followed = of_map.reshape(tiles, -1) * change[:, term, None]
            image[:nodes] -= followed.ravel()
        self._map.unknowns = image

    def costs(self, scale: float) -> Vector:
        """Return the mean Cauchy cost of each tile, relative to the cost without a map; 0 without pairs."""
        padded = self._map.residuals.values.numpy()
        residual = padded[: len(self.tile)].astype(np.float64)
        cost = cauchy_costs(residual, scale)
        count = self._sums(np.ones(len(cost)))
        return self._sums(cost) / np.maximum(count, 1.0)

    def _factors(self, column: Any) -> Vector:
        """Return the changes of the paths that explain most of a column, shape (tiles, terms)."""
        weighted = self._on_host(column) * self._weight
        gradient = self._sums(self._left * weighted[:, None])
        return np.asarray(np.einsum("tij,tj->ti", self._inverse, gradient))

    def _on_host(self, column: Any) -> Vector:
        """Return a column of the pairs as numbers, with 0 for pairs off the map."""
        of_pairs = column.numpy()[: len(self.tile)]
        return np.nan_to_num(of_pairs).astype(np.float64)

    def _sums(self, values: Vector) -> Vector:
        """Return the sums of values of the pairs over each tile."""
        tiles = len(self.moved_px)
        sums = np.zeros((tiles, *values.shape[1:]))
        by_tile = values[self._order]
        sums[self._used] = np.add.reduceat(by_tile, self._starts, axis=0)
        return sums
