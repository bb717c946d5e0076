"""Accuracy of detected joints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError


def detected_joints(found: NDArray[Any], truth: NDArray[Any], torso_px: float, *, fraction: float = 0.2) -> float:
    """Return the percentage of detected joints (PDJ), as a share from 0 to 1.

    A joint counts as detected if it is closer to its true place than ``fraction`` of the torso's diameter. ``found``
    and ``truth``: joints in the same order [px], shape (n, 2). A joint that was not found is NaN and counts as not
    detected. True joints that are NaN, as outside the view, do not count. The result is NaN if no true joint counts.

    Source: B. Sapp and B. Taskar, "MODEC: Multimodal Decomposable Models for Human Pose Estimation", CVPR 2013; the
    diameter is the distance from the left shoulder to the right hip.
    Raises :class:`AmiwarpError` for different shapes.
    """
    if found.shape != truth.shape or truth.ndim != 2 or truth.shape[1] != 2:
        raise AmiwarpError(f"found and true joints have shapes {found.shape} and {truth.shape}; give (n, 2) twice")
    known = np.isfinite(truth).all(axis=1)
    if not known.any():
        return float("nan")
    distance = np.hypot(*(found[known] - truth[known]).T)
    return float((distance < fraction * torso_px).mean())  # a comparison with NaN is false
