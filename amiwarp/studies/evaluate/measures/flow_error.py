"""Error of optical flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

OUTLIER_PX = 3.0
"""Endpoint error above which a pixel is an outlier [px]."""


@dataclass(frozen=True, slots=True)
class FlowError:
    """Errors of a flow field. They are NaN if no pixel is compared."""

    epe: float
    """Mean endpoint error, in the unit of the flow."""
    outliers: float
    """Share of pixels with an endpoint error above the threshold."""
    pixels: int
    """Number of pixels compared."""


def flow_error(
    flow: NDArray[Any], truth: NDArray[Any], where: NDArray[np.bool_], *, outlier: float = OUTLIER_PX
) -> FlowError:
    """Compare a flow field with the true one, both of shape (height, width, 2), in the pixels of a mask.

    Pixels at which either flow is not finite are left out. Raises :class:`AmiwarpError` for different shapes.
    """
    if flow.shape != truth.shape or flow.shape[:2] != where.shape:
        raise AmiwarpError(f"flow, truth and mask have shapes {flow.shape}, {truth.shape}, {where.shape}; give "
                           "(height, width, 2) twice and (height, width)")  # fmt: skip
    error = np.hypot(*np.moveaxis(flow.astype(np.float64) - truth, -1, 0))[where]
    error = error[np.isfinite(error)]
    if not error.size:
        return FlowError(float("nan"), float("nan"), 0)
    return FlowError(float(error.mean()), float((error > outlier).mean()), int(error.size))
