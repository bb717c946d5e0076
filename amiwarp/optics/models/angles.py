"""Angles of models: wrapped to a turn, and the second angle by the ratio of two speeds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def wrap_angle(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Wrap an angle [rad] to [-pi, pi) in float64. Wrap angles before they are rounded to float32."""
    with np.errstate(invalid="ignore"):  # an infinite angle becomes NaN
        return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def both_angles(theta: NDArray[Any], ratio: float) -> NDArray[np.float64]:
    """Return the angles [rad] of two prisms, shape (..., 2): the second one turns ``ratio`` times as fast."""
    first = np.asarray(theta, np.float64)
    with np.errstate(invalid="ignore"):  # infinity times 0 is NaN
        return np.stack([first, ratio * first], axis=-1)
