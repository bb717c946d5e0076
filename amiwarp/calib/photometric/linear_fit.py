"""Linearised fits about the photometric stage's answer: what would change if one more parameter were free.

Near the answer the residuals are linear in the parameters. With the brightness map eliminated, a fit of any few of them
is then a small linear problem. Its sums are kept for each square of pixels, whose scatter gives standard deviations.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.photometric.cost import Cost

    Vector = NDArray[np.float64]

SQUARE_PX = 16
"""Side of the squares of pixels over which sums are kept [px]. Pairs of one square are correlated."""
MAP_STEPS = 12
"""Number of conjugate-gradient steps that find the part of a derivative that a change of the map explains."""


@dataclass(frozen=True)
class Estimate:
    """Change of some parameters by a linearised fit, with its covariance."""

    change: Vector
    """Change of the parameters, shape (n,)."""
    covariance: Vector
    """Its covariance by the sandwich estimate, shape (n, n)."""
    gain: float
    """Share of the sum of squared weighted residuals that the change removes."""

    def significance(self, first: int) -> float:
        """Return how many standard deviations the parameters from number ``first`` on are away from 0."""
        x = self.change[first:]
        return math.sqrt(max(0.0, float(x @ np.linalg.pinv(self.covariance[first:, first:]) @ x)))


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

    def fit(self, names: tuple[str, ...], where: NDArray[np.bool_] | None = None) -> Estimate:
        """Return the changes of the columns ``names`` that minimise the residuals, in the squares ``where`` or in all.

        The other columns are fixed.
        """
        k = [self.names.index(n) for n in names]
        rows = np.ones(len(self.xy), np.bool_) if where is None else where
        hessian, gradient = self.hessian[rows][:, k][:, :, k], self.gradient[rows][:, k]
        total = hessian.sum(axis=0)
        scale = np.sqrt(np.maximum(np.diag(total), 1e-30))
        inverse = np.linalg.pinv(total / np.outer(scale, scale), rcond=1e-6, hermitian=True) / np.outer(scale, scale)
        change = -inverse @ gradient.sum(axis=0)
        parts = gradient + hessian @ change
        spare = len(parts) / max(1, len(parts) - len(k))
        gain = float(change @ total @ change) / max(self.squares_sum, 1e-30)
        return Estimate(change, inverse @ (parts.T @ parts) @ inverse * spare, gain)

    def adding(self, names: tuple[str, ...], more: tuple[str, ...]) -> tuple[Estimate, float, float]:
        """Return the fit of the columns ``names`` and ``more``, and what ``more`` contributes.

        That is how many standard deviations they are away from 0, and the share of the sum of squares that they remove.
        """
        estimate = self.fit((*names, *more))
        return estimate, estimate.significance(len(names)), estimate.gain - self.fit(names).gain


def linear_fit(cost: Cost, columns: dict[str, Any]) -> LinearFit:
    """Return the linearised problem of ``columns``, derivatives of the residuals on the device, by name.

    The map must have been solved at the answer.
    """
    b = cost.brightness
    n, pairs = b.count, b.pairs
    b.prepare_projection()
    left = np.array(
        [b.unexplained(c, b.new_change(), steps=MAP_STEPS).numpy()[:n] for c in columns.values()], dtype=np.float64
    )
    weight, residual = (a.numpy()[:n].astype(np.float64) for a in (b.residuals.weight, b.residuals.values))
    known = np.isfinite(residual) & np.isfinite(left).all(axis=0)
    x, y = (pairs.column(name)[known].astype(np.int32) // SQUARE_PX for name in "xy")
    width = int(x.max(initial=0)) + 1
    square = y * width + x
    order = np.argsort(square, kind="stable")
    key, first = np.unique(square[order], return_index=True)
    left, weight, residual = (a[..., known][..., order] for a in (left, weight, residual))
    weighted = left * weight
    parts = [slice(start, end) for start, end in itertools.pairwise([*first.tolist(), len(order)])]
    m = len(left)
    hessian = np.array([weighted[:, part] @ left[:, part].T for part in parts]).reshape(-1, m, m)
    gradient = np.array([weighted[:, part] @ residual[part] for part in parts]).reshape(-1, m)
    xy = (np.stack([key % width, key // width], axis=1) + 0.5) * SQUARE_PX
    return LinearFit(tuple(columns), hessian, gradient, xy, float(np.sum(weight * residual**2)))


def masked(column: Any, factor: NDArray[np.float32]) -> Any:
    """Return a derivative on the device times a factor for each pair."""
    values = column.numpy().copy()
    values[: len(factor)] *= factor
    return wp.array(values, dtype=float, device=column.device)
