"""Tables of Bessel functions, by which sums in phase hold the waves of a scene."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

BESSEL_STEP = 0.02
"""Step of the tables of Bessel functions [rad]; interpolated linearly they are right within 0.00005."""


@lru_cache(maxsize=8)
def bessel_table(harmonics: int, reach: float) -> NDArray[np.float32]:
    """Return the Bessel functions J_1, J_2, … from 0 to ``reach`` in steps of :data:`BESSEL_STEP`."""
    places = np.arange(math.ceil(reach / BESSEL_STEP) + 2) * BESSEL_STEP
    orders = np.arange(1, harmonics + 1)[:, None]
    return np.ascontiguousarray(jv(orders, places), dtype=np.float32)
