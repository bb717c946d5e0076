"""Cost of the photometric stage: the robust residual of the equations after the best brightness map was fitted."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib.photometric.causes import place_arguments
from amiwarp.calib.photometric.gauss_newton import Slopes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import warp as wp
    from numpy.typing import NDArray

    from amiwarp.brightness.solver import BrightnessMap
    from amiwarp.calib.parameters import ParameterSpace

FIRST_SCALE = 1.0
"""Scale of the Cauchy weights before the first brightness map is solved [thresholds]."""
SLOPE_PX = 0.005
"""Step of the finite differences that give the derivatives of the residuals [px]."""


PREDICTED_PX = 0.5
"""Longest step for which the change of the brightness map is predicted [px]."""


class Cost:
    """Robust residual of the brightness equations as a function of the search vector.

    Each evaluation starts from the previous brightness map.
    """

    def __init__(
        self, space: ParameterSpace, brightness: BrightnessMap, steps: int, meanwhile: Iterator[None] | None = None
    ) -> None:
        self._space, self.brightness, self.steps = space, brightness, steps
        self.scale = FIRST_SCALE
        self.evaluations = 0
        self.meanwhile = iter(()) if meanwhile is None else meanwhile
        """Other work, whose steps are taken where the host would wait for a GPU."""
        self._solved: NDArray[np.float64] | None = None
        self._changes: list[Any] = []
        """Derivatives of the brightness map by each parameter [1/px], from which the next solution starts."""
        self.columns: dict[str, tuple[Any, Any]] = {}
        """Derivatives of the residuals at the last solution, on the device, by name; each with the part of it that no
        change of the map explains."""

    @property
    def space(self) -> ParameterSpace:
        """Space of the search vector."""
        return self._space

    @space.setter
    def space(self, space: ParameterSpace) -> None:
        self._space, self._solved, self._changes, self.columns = space, None, [], {}

    def warm_up(self, v: NDArray[np.float64]) -> None:
        """Solve the first brightness map at the search vector ``v``, and scale the weights by its residuals."""
        self.residuals(v, rounds=3)
        next(self.meanwhile, None)
        # a coarse map needs its damping
        if self.brightness.tiles.density > 1.0 and self.brightness.relax_damping():
            self.residuals(v, rounds=3)
        self.scale = max(0.1, 1.5 * self.brightness.residuals.median())
        self.residuals(v)

    def renew(self, v: NDArray[np.float64]) -> None:
        """Discard the brightness map and solve a new one at ``v``: a map is biased to the parameters of its fit."""
        self.brightness.clear()
        self._solved, self.columns = None, {}
        self.brightness.place(**self.at(v))
        self.brightness.solve(FIRST_SCALE, steps=2 * self.steps, rounds=3)

    def replace_map(self, unknowns: wp.array) -> None:
        """Replace the brightness map and the other unknowns; the residuals remain."""
        self.brightness.unknowns = unknowns
        self._solved, self.columns = None, {}

    def at(self, v: NDArray[np.float64]) -> dict[str, Any]:
        """Return the keyword arguments of :meth:`BrightnessMap.place` for the search vector ``v``."""
        return place_arguments(self.space, self.space.to_values(v))

    def residuals(self, v: NDArray[np.float64], *, rounds: int = 1, steps: int | None = None) -> None:
        """Solve the brightness map at the search vector ``v``. The residuals stay on the device."""
        self.brightness.place(**self.at(v))
        self.brightness.solve(self.scale, steps=steps or self.steps, rounds=rounds)
        self._solved, self.columns = v, {}

    def converge(self, v: NDArray[np.float64]) -> None:
        """Solve the brightness map at ``v`` in two rounds, unless it was last solved there."""
        if self._solved is None or not np.array_equal(self._solved, v):
            self.residuals(v, rounds=2)

    def mean(self) -> float:
        """Return the mean Cauchy cost, relative to that without a map.

        Pairs of events off the map keep their cost without a map.
        """
        return self.start_mean()()

    def start_mean(self) -> Callable[[], float]:
        """Start to compute :meth:`mean` for the present residuals. Return a function that waits for it."""
        mean, without_map = self.brightness.residuals.start_mean_cost(self.scale, missing=1.0), 1.0 / self.scale**2
        return lambda: mean() / math.log1p(without_map)

    def __call__(self, v: NDArray[np.float64]) -> float:
        """Return the negative cost at the search vector ``v``, a score to be maximised."""
        self.evaluations += 1
        self.residuals(v)
        return -self.mean()

    def start_settled(self, v: NDArray[np.float64]) -> Callable[[], float]:
        """Start to compute the score at ``v``, with the map first changed by :meth:`predict`.

        Return a function that waits for it.
        """
        self.predict(v)
        self.evaluations += 1
        self.residuals(v)
        mean = self.start_mean()
        return lambda: -mean()

    def predict(self, v: NDArray[np.float64]) -> None:
        """Change the map as its derivatives by the parameters predict for a ``v`` nearby, if :meth:`slopes` found them.

        After a step in ``v`` the map would converge slowly.
        """
        if self._solved is None or not self._changes:
            return
        step = v - self._solved
        if np.linalg.norm(step) <= PREDICTED_PX:
            for change, moved in zip(self._changes, step, strict=True):
                self.brightness.add(change, float(moved))

    def slopes(self, v: NDArray[np.float64], *, with_parts: bool = False) -> Slopes:
        """Return the residuals' derivatives at ``v``, minus the part that a change of the map can explain.

        The gradient uses these differences too. The derivatives themselves are a biased gradient: damping makes the map
        too flat, so that a larger orbit explains more.
        """
        return self.start_slopes(v, with_parts=with_parts)()

    def start_slopes(self, v: NDArray[np.float64], *, with_parts: bool = False) -> Callable[[], Slopes]:
        """Start to compute :meth:`slopes`. Return a function that waits for them."""
        b, n = self.brightness, len(v)
        left = self._unexplained_slopes(v)
        upper = np.triu_indices(n)
        pairs = [(left[i], left[j]) for i, j in zip(*upper, strict=True)]
        products = b.residuals.start_products([*pairs, *((row, b.residuals.values) for row in left)])
        clusters = b.residuals.start_clusters(left) if with_parts else lambda: np.empty((n, 0))

        def result() -> Slopes:
            sums, hessian = products(), np.zeros((n, n))
            hessian[upper] = sums[:-n]
            hessian.T[upper] = sums[:-n]
            return Slopes(hessian, sums[-n:], clusters())

        return result

    def _unexplained_slopes(self, v: NDArray[np.float64]) -> list[Any]:
        """Return for each parameter the part of the residuals' derivative that no change of the map explains."""
        b, n = self.brightness, len(v)
        if self._solved is None or not np.array_equal(self._solved, v):
            self.residuals(v)
        changes = self._changes or [None] * n
        b.prepare_projection()
        steps = np.eye(n) * SLOPE_PX
        slopes = [b.find_slope(self.at(v + step), self.at(v - step), 2.0 * SLOPE_PX) for step in steps]
        left, self._changes = [], []
        for slope, change in zip(slopes, changes, strict=True):
            left.append(b.unexplained(slope, change, steps=self.steps // 2))
            self._changes.append(b.explaining_change())
        return left
