"""Cauchy cost of residuals: it grows slowly, so that outliers count little."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def cauchy_costs(residuals: NDArray[Any], scale: float) -> NDArray[Any]:
    """Return the Cauchy cost of each residual [thresholds], relative to the cost without a map; 1 off the map."""
    without_map = math.log1p(1.0 / scale**2)
    on_map = np.nan_to_num(residuals, nan=1.0)
    return np.asarray(np.log1p((on_map / scale) ** 2) / without_map)
