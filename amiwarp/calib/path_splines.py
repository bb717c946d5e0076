"""Cubic splines whose knots are equally far apart in the prism's angle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


SAMPLE_US = 1000
"""Time between samples of a path that was found [us]."""


def knots_over(t: Vector, theta: Vector, per_turn: float) -> Vector:
    """Return the knots of a cubic spline over the times ``t``, ``per_turn`` for each turn of the angle ``theta``."""
    turned = np.maximum.accumulate(np.abs(theta - theta[0])) / math.tau
    turned += 1e-9 * np.arange(len(t))
    pieces = max(1, round(float(turned[-1]) * per_turn))
    inner = np.interp(np.linspace(0.0, float(turned[-1]), pieces + 1), turned, t)
    before = float(inner[1] - inner[0])
    after = float(inner[-1] - inner[-2])
    steps = np.arange(1, 4)
    return np.concatenate([inner[0] - before * steps[::-1], inner, inner[-1] + after * steps])


def spline_matrix(knots: Vector, t: Vector) -> Any:
    """Return the cubic B-splines of the knots at the times ``t``, constant outside: sparse, shape (n, splines)."""
    from scipy.interpolate import BSpline

    return BSpline.design_matrix(np.clip(t, knots[3], knots[-4]), knots, 3)
