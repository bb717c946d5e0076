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
        self._order = np.argsort(self.tile, kind="stable")
        self._used, self._starts = np.unique(self.tile[self._order], return_index=True)
        half_s = max(0.5 * float(np.ptp(pairs.some_times)), 1e-6)
        powers = np.diag(half_s ** -np.arange(1.0, PATH_TERMS + 1.0))[:terms]
        self._units = np.kron(np.eye(2), powers)
        """Factors of the powers of time that move a tile by 1 px at the ends of the window, shape (terms, powers)."""
        self.moved_px: Vector = np.zeros((len(brightness.tiles.origin), 2 * terms))
        """Motion until the end of the window by each power of time along x, then y [px], shape (tiles, terms)."""
        self._changes: list[Any] = []  # derivatives of the map by each power of time
        self._slopes: list[Vector] = []  # changes of the paths that explain most of each parameter's derivative

    def set(self, moved_px: Vector) -> None:
        """Set the paths."""
        self.moved_px = moved_px
        self._map.pairs.set_path(moved_px @ self._units)

    def linearise(self, v: Vector, at: Mapping[str, Any], steps: int) -> None:
        """Compute the derivatives of the residuals by the paths, at a point ``v`` where the map is solved.

        ``at`` are the arguments of :meth:`BrightnessMap.place` there.
        """
        brightness = self._map
        known: list[Any] = self._changes or [None] * len(self._units)
        left: list[Vector] = []
        self._at = v
        self._base = self.moved_px
        self._changes = []
        self._slopes = []
        for k, change in enumerate(known):
            step = np.zeros_like(self.moved_px)
            step[:, k] = SLOPE_PX
            up = brightness.pairs.path_array((self.moved_px + step) @ self._units)
            down = brightness.pairs.path_array((self.moved_px - step) @ self._units)
            slope = brightness.find_slope({**at, "path": up}, {**at, "path": down}, 2.0 * SLOPE_PX)
            left.append(self._on_host(brightness.unexplained(slope, change, steps=steps)))
            self._changes.append(brightness.explaining_change())
        self._left = np.stack(left, axis=1)
        self._weight = self._on_host(brightness.residuals.weight)
        hessian = self._sums(self._left[:, :, None] * (self._left * self._weight[:, None])[:, None, :])
        ridge = PATH_RIDGE * np.trace(hessian, axis1=1, axis2=2) / hessian.shape[1] + 1e-9
        self._inverse = np.linalg.inv(hessian + ridge[:, None, None] * np.eye(hessian.shape[1]))
        self._step = -self._factors(brightness.residuals.values)

    def unexplained(self, column: Any) -> Any:
        """Return the part of a derivative, on the device, that no change of the paths explains."""
        factors = self._factors(column)
        rest = column.numpy().copy()
        rest[: len(self.tile)] -= np.einsum("ij,ij->i", self._left, factors[self.tile])
        self._slopes.append(factors)
        return wp.array(rest, dtype=float, device=column.device)

    def gain(self) -> float:
        """Return the share of a tile's squared residuals that the next step of its path removes.

        It is the share that a quarter of the tiles exceed: the others may show moving objects.
        """
        residual = self._on_host(self._map.residuals.values)
        removed = -(self._sums(self._left * (residual * self._weight)[:, None]) * self._step).sum(axis=1)
        share = removed[self._used] / self._sums(residual**2 * self._weight)[self._used]
        return float(np.quantile(share, 0.75))

    def follow(self, v: Vector) -> None:
        """Change the paths, and the map with them, as :meth:`linearise` predicts for a search vector ``v`` nearby."""
        step = v - self._at
        moved = self._base + np.clip(self._step, -LONGEST_STEP_PX, LONGEST_STEP_PX)
        moved = moved - np.tensordot(step, self._slopes[: len(step)], 1)
        change = moved - self.moved_px
        nodes = self._map.tiles.nodes
        self.set(moved)
        image = self._map.unknowns
        for by, of_map in zip(change.T, self._changes, strict=True):
            image[:nodes] -= (of_map.numpy()[:nodes].reshape(len(by), -1) * by[:, None]).ravel()
        self._map.unknowns = image

    def costs(self, scale: float) -> Vector:
        """Return the mean Cauchy cost of each tile, relative to that without a map; 0 without pairs."""
        cost = cauchy_costs(self._map.residuals.values.numpy()[: len(self.tile)].astype(np.float64), scale)
        return self._sums(cost) / np.maximum(self._sums(np.ones(len(cost))), 1.0)

    def _factors(self, column: Any) -> Vector:
        """Return the changes of the paths that explain most of a column, shape (tiles, terms)."""
        gradient = self._sums(self._left * (self._on_host(column) * self._weight)[:, None])
        return np.asarray(np.einsum("tij,tj->ti", self._inverse, gradient))

    def _on_host(self, column: Any) -> Vector:
        return np.nan_to_num(column.numpy()[: len(self.tile)]).astype(np.float64)

    def _sums(self, values: Vector) -> Vector:
        """Return the sums of values of the pairs over each tile."""
        out = np.zeros((len(self.moved_px), *values.shape[1:]))
        out[self._used] = np.add.reduceat(values[self._order], self._starts, axis=0)
        return out
