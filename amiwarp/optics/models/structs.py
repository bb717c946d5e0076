"""Values of the optical models as structs and arrays for kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.optics.models.angles import wrap_angle


def points_on_host(xy: NDArray[Any], theta: NDArray[Any]) -> tuple[Any, Any]:
    """Return pixels, shape (n, 2), and prism angles [rad], shape (n,) or (n, angles), as Warp arrays on the CPU."""
    within_a_turn = wrap_angle(theta).astype(np.float32)
    pixels = wp.array(xy.astype(np.float32), dtype=wp.vec2, device="cpu")
    angles = wp.array(within_a_turn, dtype=float, device="cpu")
    return pixels, angles


def phase_values(phase: float) -> tuple[float, float, float]:
    """Return a phase [rad] with its cosine and sine: three fields of a model's parameters for kernels."""
    return phase, math.cos(phase), math.sin(phase)


def struct_of(kind: Any, values: Sequence[Any]) -> Any:
    """Return a Warp struct with the given values of its fields, in their order."""
    struct = kind()
    for name, value in zip(kind.vars, values, strict=True):
        # A new struct holds zeros, and setting a field takes longer than this check.
        if type(value) in (int, float) and not value:
            continue
        setattr(struct, name, value)
    return struct
