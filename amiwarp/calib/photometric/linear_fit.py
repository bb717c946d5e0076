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
"""Number of standard deviations above which a cause is significant."""
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
        squares = len(parts)
        degrees_of_freedom = max(1, squares - len(self.change))
        spare = squares / degrees_of_freedom
        scatter = parts.T @ parts
        return np.asarray(self.inverse @ scatter @ self.inverse * spare)

    def significance(self, first: int) -> float:
        """Return how many standard deviations the parameters from number ``first`` on are away from 0."""
        change = self.change[first:]
        covariance = self.covariance[first:, first:]
        weighted, *_ = np.linalg.lstsq(covariance, change, rcond=1e-15)
        square = float(change @ weighted)
        return math.sqrt(max(0.0, square))


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
        columns = [self.names.index(name) for name in names]
        if where is None:
            all_hessian, all_gradient = self._total
        else:
            all_hessian, all_gradient = self._sums(where)
        hessian = all_hessian[np.ix_(columns, columns)]
        gradient = all_gradient[columns]

        # The columns have different units.
        scale = np.sqrt(np.maximum(np.diag(hessian), 1e-30))
        scales = np.outer(scale, scale)
        inverse = pseudo_inverse(hessian / scales) / scales
        change = -inverse @ gradient
        removed = float(change @ hessian @ change)
        gain = removed / max(self.squares_sum, 1e-30)

        def parts() -> Vector:
            all_changes = np.zeros(len(self.names))
            all_changes[columns] = change
            rows = slice(None) if where is None else where
            gradients = self.gradient[rows] + self.hessian[rows] @ all_changes
            return np.asarray(gradients[:, columns])

        return Estimate(change, gain, inverse, parts)

    @cached_property
    def _total(self) -> tuple[Vector, Vector]:
        """Sums over all squares."""
        return self._sums(slice(None))

    def _sums(self, where: NDArray[np.bool_] | slice) -> tuple[Vector, Vector]:
        """Return the sums of the Hessians and of the gradients over some of the squares."""
        hessian = self.hessian[where].sum(axis=0)
        gradient = self.gradient[where].sum(axis=0)
        return hessian, gradient

    def adding(
        self,
        names: tuple[str, ...],
        more: tuple[str, ...],
    ) -> tuple[Estimate, float, float]:
        """Return the fit of the columns ``names`` and ``more``, and what ``more`` contributes.

        They contribute how many standard deviations they are away from 0, and the share of the sum of squares that they
        remove.
        """
        estimate = self.fit((*names, *more))
        significance = estimate.significance(len(names))
        gain = estimate.gain - self.fit(names).gain
        return estimate, significance, gain


def pseudo_inverse(matrix: Vector) -> Vector:
    """Return the pseudo-inverse of a symmetric, positive semidefinite matrix, faster than ``numpy.linalg.pinv``.

    Eigenvalues below a millionth of the largest count as 0.
    """
    values, vectors = np.linalg.eigh(matrix)
    large = values > 1e-6 * values[-1]
    kept = vectors[:, large]
    return np.asarray(kept / values[large] @ kept.T)


def linear_fit(cost: Cost, columns: dict[str, Any]) -> LinearFit:
    """Return the linearised problem of ``columns``, derivatives of the residuals on the device, by name.

    The map must have been solved at the answer.
    """
    cost.brightness.prepare_projection()
    left = []
    for name, column in columns.items():
        left.append(cost.unexplained_column(name, column, steps=MAP_STEPS))
    sums, squares, width = products_by_square(cost, left)
    xy = np.stack([squares % width, squares // width], axis=1).astype(np.float64)
    return LinearFit(
        names=tuple(columns),
        hessian=sums[:, :-1, :-1],
        gradient=sums[:, :-1, -1],
        xy=(xy + 0.5) * SQUARE_PX,
        squares_sum=float(sums[:, -1, -1].sum()),
    )


def products_by_square(
    cost: Cost,
    columns: list[Any],
) -> tuple[Vector, NDArray[np.int64], int]:
    """Return the products of the columns and, as the last one, the residuals, shape (squares, n + 1, n + 1).

    Also return the numbers of the squares that hold pairs, row by row, and how many a row has.
    """
    residuals = cost.brightness.residuals
    camera = cost.space.camera
    width = math.ceil(camera.width / SQUARE_PX)
    height = math.ceil(camera.height / SQUARE_PX)
    with_residuals = [*columns, residuals.values]
    sums, squares = residuals.products_by_square(with_residuals, SQUARE_PX, width, height)
    return sums, squares, width


GATE = 1.0
"""How many standard deviations more than by chance a group of unknowns must be away from 0 to be examined."""
GATE_SHARE = 0.15
"""Share of the gain asked of a group of unknowns that it must have already while the map is fixed. It has 0.2 to 0.6 of
the gain with the map's change where it is wrong."""


def telling(
    cost: Cost,
    groups: list[dict[str, Any]],
    least_gain: float,
) -> list[dict[str, Any]]:
    """Return those groups of derivatives of the residuals that may remove the share ``least_gain`` of their squares.

    The map has been solved, so that the residuals are nearly orthogonal to what a change of the map explains. So the
    gradient needs no projection, which takes most of the time of a :func:`linear_fit`.
    """
    columns: dict[str, Any] = {}
    for group in groups:
        columns |= group
    if not columns:
        return []
    names = list(columns)
    sums, _, _ = products_by_square(cost, list(columns.values()))
    total = sums.sum(axis=0)
    squares_sum = max(float(total[-1, -1]), 1e-30)

    def may_tell(group: dict[str, Any]) -> bool:
        of_group = [names.index(name) for name in group]
        hessian = total[np.ix_(of_group, of_group)]
        gradient = total[of_group, -1]

        # Far from 0 by the scatter of the squares of pixels, and with a notable gain.
        each = sums[:, of_group, -1]
        away = math.sqrt(_weighted_square(each.T @ each, gradient))
        gain = _weighted_square(hessian, gradient) / squares_sum
        is_away = away > math.sqrt(len(group)) + GATE
        return is_away and gain >= GATE_SHARE * least_gain

    return [group for group in groups if group and may_tell(group)]


def _weighted_square(matrix: Vector, vector: Vector) -> float:
    """Return vectorᵀ matrix⁻¹ vector."""
    weighted, *_ = np.linalg.lstsq(matrix, vector, rcond=1e-12)
    return max(0.0, float(vector @ weighted))
