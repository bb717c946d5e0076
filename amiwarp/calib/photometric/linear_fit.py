"""Linearised fits about the photometric stage's answer: what would change if one more parameter were free.

Near the answer the residuals are linear in the parameters. With the brightness map eliminated, a fit of any few of
them is then a small linear problem. Its sums are kept for each square of pixels, whose scatter gives standard
deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from amiwarp.calib.photometric.cost import Cost

    Vector = NDArray[np.float64]

SIGNIFICANT = 5.0
"""Number of standard deviations from which on a cause is significant."""
SQUARE_PX = 16
"""Side of the squares of pixels over which sums are kept [px]. Pairs of one square are correlated."""
MAP_STEPS = 12
"""Number of conjugate-gradient steps that find the part of a derivative that a change of the map explains."""


@dataclass(frozen=True)
class Estimate:
    """Change of some parameters by a linearised fit, with its covariance."""

    change: Vector
    """Change of the parameters, shape (n,)."""
    gain: float
    """Share of the sum of squared weighted residuals that the change removes."""
    inverse: Vector
    """Inverse of the sum of the Hessians, shape (n, n)."""
    parts: Callable[[], Vector]
    """Function that returns the gradient of each square after the change, shape (squares, n)."""

    @cached_property
    def covariance(self) -> Vector:
        """Covariance of the change by the sandwich estimate, shape (n, n)."""
        parts = self.parts()
        spare = len(parts) / max(1, len(parts) - len(self.change))
        return np.asarray(self.inverse @ (parts.T @ parts) @ self.inverse * spare)

    def significance(self, first: int) -> float:
        """Return how many standard deviations the parameters from number ``first`` on are away from 0."""
        x = self.change[first:]
        return math.sqrt(max(0.0, float(x @ np.linalg.lstsq(self.covariance[first:, first:], x, rcond=1e-15)[0])))


@dataclass(frozen=True)
class LinearFit:
    """Normal equations of the linearised problem for each square of pixels."""

    names: tuple[str, ...]
    """Names of the columns: the free parameters first, then other unknowns."""
    hessian: Vector
    """Products of the columns, shape (squares, columns, columns)."""
    gradient: Vector
    """Products of the columns with the residuals, shape (squares, columns)."""
    xy: Vector
    """Middle of each square [px], shape (squares, 2)."""
    squares_sum: float
    """Sum of the squared weighted residuals [thresholds²]."""
    _known: dict[tuple[str, ...], Estimate] = field(default_factory=dict, repr=False, init=False)
    """Fits in all squares, by the names of their columns."""

    def fit(self, names: tuple[str, ...], where: NDArray[np.bool_] | None = None) -> Estimate:
        """Return the changes of the columns ``names`` that minimise the residuals, in the squares ``where`` or in all.

        The other columns are fixed.
        """
        if where is not None:
            return self._fit(names, where)
        if names not in self._known:
            self._known[names] = self._fit(names, None)
        return self._known[names]

    def _fit(self, names: tuple[str, ...], where: NDArray[np.bool_] | None) -> Estimate:
        k = [self.names.index(n) for n in names]
        all_hessian, all_gradient = self._total if where is None else self._sums(where)
        hessian = all_hessian[np.ix_(k, k)]
        gradient = all_gradient[k]
        scale = np.sqrt(np.maximum(np.diag(hessian), 1e-30))
        scales = np.outer(scale, scale)
        inverse = pseudo_inverse(hessian / scales) / scales
        change = -inverse @ gradient
        gain = float(change @ hessian @ change) / max(self.squares_sum, 1e-30)

        def parts() -> Vector:
            all_changes = np.zeros(len(self.names))
            all_changes[k] = change
            rows = slice(None) if where is None else where
            return np.asarray((self.gradient[rows] + self.hessian[rows] @ all_changes)[:, k])

        return Estimate(change, gain, inverse, parts)

    @cached_property
    def _total(self) -> tuple[Vector, Vector]:
        """Sums over all squares."""
        return self._sums(slice(None))

    def _sums(self, where: NDArray[np.bool_] | slice) -> tuple[Vector, Vector]:
        """Return the sums of the Hessians and of the gradients over some of the squares."""
        return self.hessian[where].sum(axis=0), self.gradient[where].sum(axis=0)

    def adding(self, names: tuple[str, ...], more: tuple[str, ...]) -> tuple[Estimate, float, float]:
        """Return the fit of the columns ``names`` and ``more``, and what ``more`` contributes.

        That is how many standard deviations they are away from 0, and the share of the sum of squares that they remove.
        """
        estimate = self.fit((*names, *more))
        return estimate, estimate.significance(len(names)), estimate.gain - self.fit(names).gain


def pseudo_inverse(matrix: Vector) -> Vector:
    """Return the pseudo-inverse of a symmetric, positive semidefinite matrix, faster than ``numpy.linalg.pinv``.

    Eigenvalues below a millionth of the largest count as 0.
    """
    values, vectors = np.linalg.eigh(matrix)
    large = values > 1e-6 * values[-1]
    return np.asarray(vectors[:, large] / values[large] @ vectors[:, large].T)


def linear_fit(cost: Cost, columns: dict[str, Any]) -> LinearFit:
    """Return the linearised problem of ``columns``, derivatives of the residuals on the device, by name.

    The map must have been solved at the answer.
    """
    cost.brightness.prepare_projection()
    left = [cost.unexplained_column(name, column, steps=MAP_STEPS) for name, column in columns.items()]
    cost.work_meanwhile()
    sums, squares, width = _products_by_square(cost, left)
    xy = np.stack([squares % width, squares // width], axis=1).astype(np.float64)
    return LinearFit(
        names=tuple(columns),
        hessian=sums[:, :-1, :-1],
        gradient=sums[:, :-1, -1],
        xy=(xy + 0.5) * SQUARE_PX,
        squares_sum=float(sums[:, -1, -1].sum()),
    )


def _products_by_square(cost: Cost, columns: list[Any]) -> tuple[Vector, NDArray[np.int64], int]:
    """Return the products of the columns and, as the last one, the residuals, shape (squares, n + 1, n + 1).

    Also return the numbers of the squares that hold pairs, row by row, and how many a row has.
    """
    residuals = cost.brightness.residuals
    camera = cost.space.camera
    width = -(-camera.width // SQUARE_PX)
    height = -(-camera.height // SQUARE_PX)
    sums, squares = residuals.products_by_square([*columns, residuals.values], SQUARE_PX, width, height)
    return sums, squares, width


GATE = 1.0
"""How many standard deviations more than by chance a group of unknowns must be away from 0 to be examined."""
GATE_SHARE = 0.15
"""Share of the gain asked of a group of unknowns that it must have already while the map is fixed. It has 0.2 to 0.6 of
the gain with the map's change where it is wrong."""


def telling(cost: Cost, groups: list[dict[str, Any]], least_gain: float) -> list[dict[str, Any]]:
    """Return those groups of derivatives of the residuals that may remove the share ``least_gain`` of their squares.

    The map has been solved, so that the residuals are nearly orthogonal to what a change of the map explains. So the
    gradient needs no projection, which takes most of the time of a :func:`linear_fit`.
    """
    columns = {name: column for group in groups for name, column in group.items()}
    if not columns:
        return []
    names = [*columns]
    sums, _, _ = _products_by_square(cost, [*columns.values()])
    total = sums.sum(axis=0)

    def square(matrix: Vector, vector: Vector) -> float:
        return max(0.0, float(vector @ np.linalg.lstsq(matrix, vector, rcond=1e-12)[0]))

    def may(group: dict[str, Any]) -> bool:
        k = [names.index(name) for name in group]
        each = sums[:, k, -1]
        gradient = total[k, -1]
        away = math.sqrt(square(each.T @ each, gradient))
        gain = square(total[np.ix_(k, k)], gradient) / max(float(total[-1, -1]), 1e-30)
        return away > math.sqrt(len(group)) + GATE and gain >= GATE_SHARE * least_gain

    return [group for group in groups if group and may(group)]
