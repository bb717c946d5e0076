"""Cost of the photometric stage: the robust residual of the equations after the best brightness map was fitted.

A map takes long to solve. So the costs of several parameter spaces share one, see :class:`SharedMap`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.solver import BrightnessMap
from amiwarp.calib.photometric.descent import Slopes
from amiwarp.calib.photometric.tile_paths import TilePaths
from amiwarp.kernels.launch import launch
from amiwarp.kernels.residual_slopes import by_shift
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.parameters import ParameterSpace

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

FIRST_SCALE = 1.0
"""Scale of the Cauchy weights before the first brightness map is solved [thresholds]."""
SLOPE_PX = 0.005
"""Step of the finite differences that give the derivatives of the residuals [px]."""
STEP_RAD = 0.004
"""Step of the finite differences that give the derivatives of the residuals by an angle [rad]."""
PREDICTED_PX = 0.5
"""Longest step for which the change of the brightness map is predicted [px]."""


def place_arguments(space: ParameterSpace, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the keyword arguments of :meth:`BrightnessMap.place` for parameter values."""
    return {
        "model": space.build(values),
        "drift": space.drift(values),
        "camera_rotation": space.camera_rotation(values),
    }


class SharedMap:
    """The brightness map that costs in several spaces share, and what is known about its last solution.

    It is the only state of the stage that changes in place. A cost that uses the map after another one forgets what
    holds in the other space: where the map was solved, and all derivatives. The map itself stays, as a start.
    """

    def __init__(self, brightness: BrightnessMap, steps: int) -> None:
        self.brightness = brightness
        self.steps = steps
        """Number of conjugate-gradient steps of a solution."""
        self.scale = FIRST_SCALE
        """Scale of the Cauchy weights [thresholds]."""
        self.evaluations = 0
        """Number of scores that were computed."""
        self.solved_at: Vector | None = None
        """Search vector at which the map was last solved; None if it was not, or if the map changed afterwards."""
        self.changes: list[Any] = []
        """Derivatives of the brightness map by each parameter [1/px], from which the next solution starts."""
        self.columns: dict[str, tuple[Any, Any]] = {}
        """Derivatives of the residuals at the last solution, on the device, by name; each with the part of it that no
        change of the map explains, or None if that was not needed yet."""
        self.by_angle: dict[int | None, tuple[Any, Any]] = {}
        """Derivatives of the residuals by the angles at the last solution, by the number of the angle; None for all."""
        self._user: Cost | None = None

    def used_by(self, cost: Cost) -> SharedMap:
        """Return the map for use by a cost."""
        if self._user is not cost:
            self._user = cost
            self.changes = []
            self.solved(None)
        return self

    def solved(self, at: Vector | None) -> None:
        """Note at which search vector the map was solved, and forget the derivatives of earlier residuals."""
        self.solved_at = at
        self.columns = {}
        self.by_angle = {}


@dataclass(frozen=True, eq=False)
class Cost:
    """Robust residual of the brightness equations as a function of the search vector of one space.

    Each evaluation starts from the previous brightness map.
    """

    space: ParameterSpace
    """Space of the search vector."""
    shared: SharedMap
    """The map, which other costs may use too."""
    paths: TilePaths | None = None
    """Paths of the tiles; None if their scenes move with the camera's rotation alone."""

    @classmethod
    def on(cls, brightness: BrightnessMap, space: ParameterSpace, steps: int) -> Cost:
        """Return the cost on a map that must be solved yet, in ``steps`` conjugate-gradient steps."""
        return cls(space, SharedMap(brightness, steps))

    def in_space(self, space: ParameterSpace, paths: TilePaths | None = None) -> Cost:
        """Return the cost in another space, on the same map. This cost stays as it is.

        ``paths`` are the paths of the tiles there; None for no such paths.
        """
        return Cost(space, self.shared, paths)

    @property
    def brightness(self) -> BrightnessMap:
        """The brightness map."""
        return self.shared.brightness

    @property
    def steps(self) -> int:
        """Number of conjugate-gradient steps of a solution of the map."""
        return self.shared.steps

    @property
    def scale(self) -> float:
        """Scale of the Cauchy weights of the map's equations [thresholds]."""
        return self.shared.scale

    def set_scale(self, scale: float) -> None:
        """Set the scale of the Cauchy weights [thresholds]."""
        self.shared.scale = scale

    @property
    def evaluations(self) -> int:
        """Number of scores that were computed on the map."""
        return self.shared.evaluations

    def double_steps(self) -> None:
        """Solve the map more accurately from now on."""
        self.shared.steps *= 2

    def warm_up(self, v: Vector) -> None:
        """Solve the first brightness map at the search vector ``v``, and scale the weights by its residuals."""
        self.solve_first(v)
        self.scale_weights(v)

    def solve_first(self, v: Vector) -> None:
        """Start to solve the first brightness map at the search vector ``v``."""
        self.residuals(v, rounds=3)

    def scale_weights(self, v: Vector) -> None:
        """Scale the weights by the residuals of the first map, and solve it again."""
        # a coarse map needs its damping
        is_fine = self.brightness.tiles.density > 1.0
        if is_fine and self.brightness.relax_damping():
            self.residuals(v, rounds=3)
        median = self.brightness.residuals.median()
        self.set_scale(max(0.1, 1.5 * median))
        self.residuals(v)

    def renew(self, v: Vector) -> None:
        """Discard the brightness map and solve a new one at ``v``: a map is biased to the parameters of its fit."""
        shared = self.shared.used_by(self)
        self.brightness.clear()
        shared.solved(None)
        self.brightness.place(**self.at(v))
        self.brightness.solve(FIRST_SCALE, steps=2 * self.steps, rounds=3)

    def replace_map(self, unknowns: wp.array) -> None:
        """Replace the brightness map and the other unknowns; the residuals remain."""
        self.brightness.unknowns = unknowns
        self.shared.used_by(self).solved(None)

    def at(self, v: Vector) -> dict[str, Any]:
        """Return the keyword arguments of :meth:`BrightnessMap.place` for the search vector ``v``."""
        return place_arguments(self.space, self.space.to_values(v))

    def residuals(self, v: Vector, *, rounds: int = 1, steps: int | None = None) -> None:
        """Solve the brightness map at the search vector ``v``. The residuals stay on the device."""
        shared = self.shared.used_by(self)
        self.brightness.place(**self.at(v))
        self.brightness.solve(self.scale, steps=steps or self.steps, rounds=rounds)
        shared.solved(v)

    def _is_solved_at(self, v: Vector) -> bool:
        """Return whether the map was last solved at the search vector ``v``, for this cost."""
        solved_at = self.shared.used_by(self).solved_at
        if solved_at is None:
            return False
        return np.array_equal(solved_at, v)

    def converge(self, v: Vector) -> None:
        """Solve the brightness map at ``v`` in two rounds, unless it was last solved there."""
        if not self._is_solved_at(v):
            self.residuals(v, rounds=2)

    def by_angle(self, v: Vector, angle: int | None = None) -> tuple[Any, Any]:
        """Return the derivatives of the residuals by an angle at the first and at the second events of the pairs.

        ``angle`` is the number of the model's angle that changes while the others stay. Without it, all angles drift: a
        second one turns with the first one by the ratio of their speeds, as in a time that passes. The derivatives are
        on the device, shape (padded pairs,) each. The map must be solved at ``v``.
        """
        known = self.shared.used_by(self).by_angle
        if MODELS[self.space.model].ANGLES == 1:
            angle = None
        if angle not in known:
            values = self.space.to_values(v)
            if angle is None:
                known[None] = self._find_by_drift(values)
            elif angle == 0:
                known[0] = self._find_by_drift({**values, "ratio": 0.0})
            else:
                both_at_first, both_at_second = self._find_by_drift({**values, "ratio": 1.0})
                at_first, at_second = self.by_angle(v, 0)
                known[angle] = (
                    _difference(both_at_first, at_first),
                    _difference(both_at_second, at_second),
                )
        return known[angle]

    def _find_by_drift(self, values: Mapping[str, float]) -> tuple[Any, Any]:
        """Return the derivatives by a drift of the angles at the first and at the second events of the pairs."""
        pairs = self.brightness.pairs
        at = place_arguments(self.space, values)
        found = []
        for end in range(2):
            shape = (2, pairs.arrays.stride)
            shift = wp.zeros(shape, dtype=float, device=self.brightness.device)
            shift[end].fill_(1.0)
            drifting = {**at, "arrays": pairs.with_columns(slope=shift.flatten())}
            up = {**drifting, "drift": STEP_RAD}
            down = {**drifting, "drift": -STEP_RAD}
            found.append(self.brightness.find_slope(up, down, 2.0 * STEP_RAD))
        at_first, at_second = found
        return at_first, at_second

    def known_column(self, name: str) -> Any | None:
        """Return a derivative of the residuals by name, or None if it was not found since the last solution."""
        column, _ = self.shared.used_by(self).columns.get(name, (None, None))
        return column

    def keep_column(self, name: str, column: Any) -> Any:
        """Keep a derivative of the residuals until the next solution of the map, and return it."""
        self.shared.used_by(self).columns[name] = column, None
        return column

    def unexplained_column(self, name: str, column: Any, *, steps: int) -> Any:
        """Return the part of a derivative that no change of the map explains, found once for each solution."""
        columns = self.shared.used_by(self).columns
        known, left = columns.get(name, (None, None))
        if left is None or known is not column:
            left = self.unexplained(column, steps=steps)
            columns[name] = column, left
        return left

    def mean(self) -> float:
        """Return the mean Cauchy cost, relative to the cost without a map.

        Pairs of events off the map keep their cost without a map.
        """
        return self.start_mean()()

    def start_mean(self) -> Callable[[], float]:
        """Start to compute :meth:`mean` for the present residuals. Return a function that waits for it."""
        mean = self.brightness.residuals.start_mean_cost(self.scale, missing=1.0)
        without_map = math.log1p(1.0 / self.scale**2)
        return lambda: mean() / without_map

    def __call__(self, v: Vector) -> float:
        """Return the negative cost at the search vector ``v``, a score to be maximised."""
        self.shared.evaluations += 1
        self.residuals(v)
        return -self.mean()

    def start_settled(self, v: Vector) -> Callable[[], float]:
        """Start to compute the score at ``v``, with the map first changed by :meth:`predict`.

        Return a function that waits for it.
        """
        self.predict(v)
        self.shared.evaluations += 1
        self.residuals(v)
        mean = self.start_mean()
        return lambda: -mean()

    def predict(self, v: Vector) -> None:
        """Change the map as its derivatives by the parameters predict for a ``v`` nearby, if :meth:`slopes` found them.

        After a step in ``v`` the map would converge slowly.
        """
        shared = self.shared.used_by(self)
        if shared.solved_at is None or not shared.changes:
            return
        step = v - shared.solved_at
        if self.paths is not None:
            self.paths.follow(v)
        if np.linalg.norm(step) <= PREDICTED_PX:
            for change, moved in zip(shared.changes, step, strict=True):
                self.brightness.add(change, float(moved))

    def unexplained(self, column: Any, change: Any = None, *, steps: int) -> Any:
        """Return the part of a derivative that no change of the map and of the tiles' paths explains."""
        left = self.brightness.unexplained(column, change, steps=steps)
        if self.paths is None:
            return left
        return self.paths.unexplained(left)

    def slopes(self, v: Vector, *, with_parts: bool = False) -> Slopes:
        """Return the residuals' derivatives at ``v``, minus the part that a change of the map can explain.

        The gradient uses these differences too. The derivatives themselves are a biased gradient: damping makes the map
        too flat, so that a larger orbit explains more.
        """
        return self.start_slopes(v, with_parts=with_parts)()

    def start_slopes(self, v: Vector, *, with_parts: bool = False) -> Callable[[], Slopes]:
        """Start to compute :meth:`slopes`. Return a function that waits for them."""
        n = len(v)
        left = self._unexplained_slopes(v)
        residuals = self.brightness.residuals

        # The upper triangle of the Hessian, then the gradient.
        rows, columns = np.triu_indices(n)
        factors = [(left[i], left[j]) for i, j in zip(rows, columns, strict=True)]
        factors += [(slope, residuals.values) for slope in left]
        products = residuals.start_products(factors)
        clusters = None
        if with_parts:
            camera = self.space.camera
            clusters = residuals.start_clusters(left, camera.width, camera.height)

        def result() -> Slopes:
            sums = products()
            triangle = sums[:-n]
            hessian = np.zeros((n, n))
            hessian[rows, columns] = triangle
            hessian[columns, rows] = triangle
            parts = np.empty((n, 0)) if clusters is None else clusters()
            return Slopes(hessian, sums[-n:], parts)

        return result

    def _unexplained_slopes(self, v: Vector) -> list[Any]:
        """Return the derivatives by the parameters at ``v``, minus the part that a change of the map explains.

        The changes of the map are kept for :meth:`predict`, and as starts at the next point.
        """
        brightness = self.brightness
        if not self._is_solved_at(v):
            self.residuals(v)
        brightness.prepare_projection()
        slopes = []
        for step in np.eye(len(v)) * SLOPE_PX:
            up = self.at(v + step)
            down = self.at(v - step)
            slopes.append(brightness.find_slope(up, down, 2.0 * SLOPE_PX))
        # the derivatives of the map at the last point are near those at this one
        before = self.shared.changes or [None] * len(v)
        left: list[Any] = []
        changes: list[Any] = []
        self.shared.changes = changes
        steps = self.steps // 2
        if self.paths is not None:
            self.paths.linearise(v, self.at(v), steps)
        for slope, change in zip(slopes, before, strict=True):
            left.append(self.unexplained(slope, change, steps=steps))
            changes.append(brightness.explaining_change())
        return left


def _difference(column: Any, other: Any) -> Any:
    """Return the difference of two columns on the device."""
    count = len(column)
    difference = wp.empty_like(column)
    signs = np.repeat([1.0, -1.0], count)
    factors = wp.array(signs, dtype=float, device=column.device)
    launch(by_shift, count, [column, other, factors], [difference], device=column.device)
    return difference


def size_and_phase_directions(space: ParameterSpace, best: Vector) -> list[Vector]:
    """Return unit vectors of the search space along size and phase of each prism, if these are free."""
    units = np.eye(len(best))
    found: list[Vector] = []
    for size, phase in MODELS[space.model].ORBITS:
        free = [k for k, name in enumerate(space.names) if name in (size, phase)]
        if free and free[0] in space.orbits:
            # Both are Cartesian coordinates of the orbit.
            orbit = best[free]
            x, y = orbit / max(float(np.linalg.norm(orbit)), 1e-9)
            unit_x = units[free[0]]
            unit_y = units[free[1]]
            along_size = x * unit_x + y * unit_y
            along_phase = x * unit_y - y * unit_x
            found += [along_size, along_phase]
        else:
            found += [units[k] for k in free]
    return found
